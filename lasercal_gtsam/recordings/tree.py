"""The tree of coordinate frames in a recording, and the way from base to hand in it."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.wording import did_you_mean, some
from lasercal_gtsam.recordings.motion import Motion, PoseSeries, chain, pose_series
from lasercal_gtsam.recordings.stamps import as_stamps, duration_text

_STATIC_TOLERANCE = 1e-9


@dataclass
class _Edge:
    """Transforms of one child in one parent, as received."""

    static: bool
    stamps: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))


class TransformTree:
    """Transforms as /tf and /tf_static give them; ``T_parent_child`` maps child into parent."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], _Edge] = {}

    def add(
        self,
        parent: str,
        child: str,
        stamp: int,
        position_m: Sequence[float],
        quat_xyzw: Sequence[float],
        *,
        static: bool,
    ) -> None:
        """Add one transform. A leading slash of a frame's name (ROS 1) does not count."""
        key = parent.lstrip("/"), child.lstrip("/")
        edge = self._edges.setdefault(key, _Edge(static))
        edge.static &= static  # seen on /tf too, it may move
        edge.stamps.append(stamp)
        edge.numbers.extend((*position_m, *quat_xyzw))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({name for edge in self._edges for name in edge}))

    def motion(self, base: str, hand: str) -> Motion:
        """The motion of ``hand`` in ``base``.

        A transform on /tf that never changes is as good as a static one, however rarely it comes.

        Raises
        ------
        DataError
            A frame is not there (all are listed), no chain of transforms leads from one to the
            other, a frame has two parents, a static transform changes, or nothing moves.
        """
        base, hand = base.lstrip("/"), hand.lstrip("/")
        frames = self.frames
        if not frames:
            raise DataError("the recording holds no transforms (/tf)")
        problems = [
            f"{option}: there is no frame {name!r}{did_you_mean(name, frames)}; the recording has "
            f"{some(frames, 30)}"
            for option, name in (("base", base), ("hand", hand))
            if name not in frames
        ]
        if not problems and base == hand:
            problems.append(f"base and hand are the same frame {base!r}")
        if problems:
            raise DataError(*problems)
        up, down = self._to_root(base), self._to_root(hand)
        common = next((name for name in up if name in down), None)
        if common is None:
            raise DataError(
                f"no chain of transforms leads from {base!r} to {hand!r}: {base!r} hangs on "
                f"{up[-1]!r}, {hand!r} on {down[-1]!r}, and nothing joins the two"
            )
        rising = up[: up.index(common) + 1]
        falling = down[: down.index(common) + 1]
        links = [(self._series(p, c), True) for c, p in pairwise(rising)]
        tail = [(self._series(p, c), False) for c, p in pairwise(falling)]
        return chain(base, hand, links + tail[::-1])

    def lines(self) -> list[str]:
        """The tree in words, a line for each frame, children indented."""
        children: dict[str, list[str]] = {}
        for parent, child in self._edges:
            children.setdefault(parent, []).append(child)
        below = {child for _, child in self._edges}
        lines: list[str] = []
        seen: set[str] = set()

        def show(name: str, depth: int, about: str) -> None:
            lines.append(f"{'  ' * depth}{name}{about}")
            if name in seen:
                return
            seen.add(name)
            for child in sorted(children.get(name, [])):
                show(child, depth + 1, self._about(name, child))

        for root in sorted(set(children) - below):
            show(root, 0, "")
        return lines

    def _about(self, parent: str, child: str) -> str:
        edge = self._edges[parent, child]
        if edge.static:
            return " (static)"
        gaps = np.diff(np.unique(np.asarray(edge.stamps, dtype=np.int64)))
        return f" (every {duration_text(float(np.median(gaps)))})" if len(gaps) else " (once)"

    def _to_root(self, name: str) -> list[str]:
        """The frame and its parents up to the root."""
        way = [name]
        while parents := [parent for parent, child in self._edges if child == way[-1]]:
            if len(parents) > 1:
                raise DataError(
                    f"the frame {way[-1]!r} has {len(parents)} parents, {some(sorted(parents))}: "
                    "which one holds cannot be told; do two nodes publish it?"
                )
            if parents[0] in way:
                raise DataError(f"the transforms go round in a circle at {parents[0]!r}")
            way.append(parents[0])
        return way

    def _series(self, parent: str, child: str) -> PoseSeries:
        edge = self._edges[parent, child]
        name = f"tf {parent} -> {child}"
        stamps = np.asarray(edge.stamps, dtype=np.int64)
        numbers = np.asarray(edge.numbers, dtype=np.float64).reshape(-1, 7)
        same = bool((np.abs(numbers - numbers[0]) <= _STATIC_TOLERANCE).all())
        if not edge.static and not same:
            return pose_series(name, stamps, numbers[:, :3], numbers[:, 3:], "quat_xyzw")
        if not same:
            raise DataError(
                f"{name}: this static transform changes in the recording; which value holds when "
                "cannot be told. Make one recording for each"
            )
        one = pose_series(name, stamps[:1], numbers[:1, :3], numbers[:1, 3:], "quat_xyzw")
        return PoseSeries(name, as_stamps(one.stamps), one.T, fixed=True)
