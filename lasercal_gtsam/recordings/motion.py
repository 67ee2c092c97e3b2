"""The hand's motion: poses over time, interpolated between neighbours and never beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.io.capture_rows import inverse_poses
from lasercal_gtsam.io.conventions import (
    matrix_from_rotvec,
    rotation_problems,
    rotations_from_columns,
    rotvec_from_matrix,
)
from lasercal_gtsam.io.wording import at_most
from lasercal_gtsam.recordings.stamps import Stamps, as_stamps, duration_text, seconds_text

Known = npt.NDArray[np.bool_]
QuaternionOrder = Literal["quat_xyzw", "quat_wxyz"]


@dataclass(frozen=True, eq=False)
class PoseSeries(FrozenData):
    """Poses of one frame in another over time.

    Attributes
    ----------
    name : what it is, for messages ("tf base_link -> link_1", "/hand_pose")
    stamps : (N,) nanoseconds, strictly increasing; N is 1 or more
    T : (N, 4, 4), metres
    fixed : the one pose (N = 1) holds at all times, as of a static transform
    notes : what was found odd, one sentence each
    """

    name: str
    stamps: Stamps
    T: Array
    fixed: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamps", as_stamps(self.stamps))
        set_array(self, "T", self.T, (len(self.stamps), 4, 4))
        if not len(self.stamps) or (np.diff(self.stamps) <= 0).any():
            raise DataError(f"{self.name}: expected stamps that increase, one or more")

    @property
    def typical_gap(self) -> float:
        """Median time from one pose to the next, nanoseconds; infinite for a single pose."""
        return float(np.median(np.diff(self.stamps))) if len(self.stamps) > 1 else np.inf

    def runs(self, max_gap: int) -> list[tuple[int, int]]:
        """First and last stamps of the stretches without a gap of more than ``max_gap``."""
        gaps = np.flatnonzero(np.diff(self.stamps) > max_gap)
        firsts, lasts = np.r_[0, gaps + 1], np.r_[gaps, len(self.stamps) - 1]
        return list(zip(self.stamps[firsts].tolist(), self.stamps[lasts].tolist(), strict=True))

    def at(self, stamps: Stamps, max_gap: int) -> tuple[Array, Known]:
        """Poses (M, 4, 4) at stamps (M,), and whether each is known; see `Motion.at`."""
        if self.fixed:
            return np.tile(self.T[0], (len(stamps), 1, 1)), np.ones(len(stamps), dtype=bool)
        last = len(self.stamps) - 1
        after = np.clip(np.searchsorted(self.stamps, stamps), 0, last)
        exact = self.stamps[after] == stamps
        before = np.where(exact, after, np.maximum(after - 1, 0))
        gap = self.stamps[after] - self.stamps[before]
        inside = (self.stamps[before] <= stamps) & (stamps <= self.stamps[after])
        known = inside & (gap <= np.where(exact, 0, max_gap))
        share = np.where(known, stamps - self.stamps[before], 0) / np.maximum(gap, 1)
        return _between(self.T[before], self.T[after], share), known


def _between(A: Array, B: Array, share: Array) -> Array:
    """Poses a share of the way from A to B: straight line, constant turning rate (slerp)."""
    T = A.copy()
    turn = rotvec_from_matrix(np.swapaxes(A[:, :3, :3], 1, 2) @ B[:, :3, :3])
    T[:, :3, :3] = A[:, :3, :3] @ matrix_from_rotvec(share[:, None] * turn)
    T[:, :3, 3] += share[:, None] * (B[:, :3, 3] - A[:, :3, 3])
    exact = share == 0
    T[exact] = A[exact]
    return T


@dataclass(frozen=True)
class Motion:
    """The hand in the base over time, as a chain of pose series.

    ``T_base_hand(t)`` is the product of the links' poses, each at time t; interpolating each joint
    of a robot on its own is exact where its product would cut the corner.

    Attributes
    ----------
    base, hand : names of the frames, for messages
    links : pairs (series, inverted); an inverted one enters the product as its inverse
    """

    base: str
    hand: str
    links: tuple[tuple[PoseSeries, bool], ...]

    @property
    def moving(self) -> tuple[PoseSeries, ...]:
        """The links that are not fixed."""
        return tuple(series for series, _ in self.links if not series.fixed)

    @property
    def span(self) -> tuple[int, int]:
        """First and last stamp at which every link is known."""
        first = max(int(series.stamps[0]) for series in self.moving)
        return first, min(int(series.stamps[-1]) for series in self.moving)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found odd in the series."""
        return tuple(note for series, _ in self.links for note in series.notes)

    def runs(self, max_gap: int) -> list[tuple[int, int]]:
        """Times (first, last) between which every link is known without a gap beyond ``max_gap``.

        Runs of a single stamp are left out.
        """
        runs = [self.span]
        for series in self.moving:
            runs = [
                (max(a, c), min(b, d))
                for a, b in runs
                for c, d in series.runs(max_gap)
                if max(a, c) < min(b, d)
            ]
        return runs

    def at(self, stamps: Stamps, max_gap: int) -> tuple[Array, Known]:
        """Hand poses at given times.

        Parameters
        ----------
        stamps : (M,) nanoseconds
        max_gap : two neighbouring poses farther apart than this (ns) say nothing about the time
            between them

        Returns
        -------
        T_base_hand : (M, 4, 4), metres; arbitrary where not known
        known : (M,) bool; False outside the recorded poses and in gaps. Nothing is extrapolated.
        """
        stamps = np.asarray(stamps, dtype=np.int64)
        T = np.tile(np.eye(4), (len(stamps), 1, 1))
        known = np.ones(len(stamps), dtype=bool)
        for series, inverted in self.links:
            link, link_known = series.at(stamps, max_gap)
            T = T @ (inverse_poses(link) if inverted else link)
            known &= link_known
        return T, known


def chain(base: str, hand: str, links: Sequence[tuple[PoseSeries, bool]]) -> Motion:
    """A motion out of links, after a check that something moves and all is known at some time.

    Raises
    ------
    DataError
        No link moves, or the links' times do not overlap.
    """
    motion = Motion(base, hand, tuple(links))
    if not motion.moving:
        raise DataError(
            f"{hand} does not move in {base}: only fixed transforms lie between them; is "
            f"{hand!r} the hand, and does the recording hold the robot's joints (/tf)?"
        )
    first, last = motion.span
    if first > last:
        parts = [
            f"{series.name}: {seconds_text(int(series.stamps[0]))} to "
            f"{seconds_text(int(series.stamps[-1]))} s"
            for series in motion.moving
        ]
        raise DataError(f"{base} -> {hand}: the times of its parts do not overlap", *parts)
    return motion


def pose_series(
    name: str,
    stamps: Stamps,
    position_m: Array,
    quaternion: Array,
    order: QuaternionOrder,
) -> PoseSeries:
    """Poses out of raw numbers: checked, brought into the order of time, repeats dropped.

    Of several poses with one stamp the first is kept, as tf does; where they differ a note says so.

    Parameters
    ----------
    name : see `PoseSeries`
    stamps : (N,) nanoseconds, in the order received
    position_m : (N, 3)
    quaternion : (N, 4)
    order : order of the quaternion's numbers

    Raises
    ------
    DataError
        Numbers that are not finite, quaternions that are not unit, or a clock that jumps back.
    """
    problems = [
        f"{name}, stamp {seconds_text(int(stamps[k]))}: position {position_m[k].tolist()} is not "
        "finite"
        for k in np.flatnonzero(~np.isfinite(position_m).all(axis=1))
    ]
    problems += [
        f"{name}, stamp {seconds_text(int(stamps[k]))}: {text}"
        for k, text in rotation_problems(order, quaternion)
    ]
    back = np.maximum.accumulate(stamps) - stamps
    if back.max(initial=0) > _CLOCK_JUMP:
        k = int(np.argmax(back > _CLOCK_JUMP))
        problems.append(
            f"{name}: the clock jumps back by {duration_text(float(back[k]))} to "
            f"{seconds_text(int(stamps[k]))}; was a simulation restarted, or are two recordings in "
            "one? Cut the recording there"
        )
    if problems:
        raise DataError(*at_most(problems))
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, :3, :3] = rotations_from_columns(order, quaternion)
    T[:, :3, 3] = position_m
    ordered = np.argsort(stamps, kind="stable")
    stamps, T = stamps[ordered], T[ordered]
    repeated = np.r_[False, np.diff(stamps) == 0]
    first = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(stamps))))
    differing = int((np.abs(T - T[first]).max(axis=(1, 2)) > _SAME).sum())
    notes = []
    if differing:
        notes.append(
            f"{name}: {differing} poses have the stamp of another one but differ from it; the "
            "first of each was taken. Do two nodes publish it?"
        )
    return PoseSeries(name, stamps[~repeated], T[~repeated], notes=tuple(notes))


# Messages overtake each other by less than this.
_CLOCK_JUMP = 1_000_000_000
_SAME = 1e-9
