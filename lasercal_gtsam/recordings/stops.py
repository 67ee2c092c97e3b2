"""Where the hand stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.recordings.motion import Motion
from lasercal_gtsam.recordings.stamps import NS_PER_S, Stamps, duration_text
from lasercal_gtsam.rotations import rotation_log
from lasercal_gtsam.units import DEG_PER_RAD, M_PER_MM, MM_PER_M, RAD_PER_DEG

_SAMPLES = 30  # in a window
_LONGEST_PERIOD = NS_PER_S // 100
_CHUNK = 50_000


@dataclass(frozen=True)
class StillLimits:
    """When a hand counts as standing still.

    Attributes
    ----------
    move_m, turn_rad : most that it may move and turn within the window. The defaults are above the
        jitter of joint encoders and of the order of a robot's repeatability
    window_ns : it is still at a time if it stays within the limits from half a window before to
        half a window after. So vibrations get half a window to settle, and clocks of camera and
        robot may differ by about as much
    max_gap_ns : between poses farther apart than this nothing is known
    """

    move_m: float = 0.2 * M_PER_MM
    turn_rad: float = 0.05 * RAD_PER_DEG
    window_ns: int = 3 * NS_PER_S // 10
    max_gap_ns: int = NS_PER_S // 4

    def __post_init__(self) -> None:
        for name in ("move_m", "turn_rad", "window_ns", "max_gap_ns"):
            if not getattr(self, name) > 0:
                raise DataError(
                    f"StillLimits.{name}: expected more than 0, got {getattr(self, name)}"
                )


@dataclass(frozen=True)
class Stop:
    """A time during which the hand stands still, nanoseconds, both ends included."""

    first: int
    last: int


def find_stops(motion: Motion, limits: StillLimits) -> tuple[Stop, ...]:
    """Times at which the hand stands still, in order.

    The pose is sampled 30 times in a window, at least every 10 ms. How far it moves within a window
    is bounded from above by the diagonal of the box about its positions, and how far it turns by
    that of the box about its rotation matrices over sqrt(2) (two rotations an angle a apart are
    ``2 sqrt(2) sin(a/2)`` apart in the Frobenius norm).

    Raises
    ------
    DataError
        The poses are too few, or the hand never stands still; the message says how close it came.
    """
    _check_often(motion, limits)
    period = max(min(limits.window_ns // _SAMPLES, _LONGEST_PERIOD), 1)
    half = -(-limits.window_ns // (2 * period))
    stops: list[Stop] = []
    quietest: tuple[float, float] | None = None
    for first, last in motion.runs(limits.max_gap_ns):
        stamps = np.arange(first, last + 1, period, dtype=np.int64)
        if len(stamps) < 2 * half + 1:
            continue
        inner = slice(half, len(stamps) - half)  # whose windows lie within the run
        moved, turned = _extents(motion, stamps, half, limits.max_gap_ns)[:, inner]
        still = (moved <= limits.move_m) & (turned <= limits.turn_rad)
        edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(np.int8)))
        times = stamps[inner]
        stops += [
            Stop(int(times[start]), int(times[end - 1]))
            for start, end in zip(edges[::2], edges[1::2], strict=True)
        ]
        k = int(np.argmin(np.maximum(moved / limits.move_m, turned / limits.turn_rad)))
        calm = float(moved[k]), float(turned[k])
        if quietest is None or _excess(calm, limits) < _excess(quietest, limits):
            quietest = calm
    if not stops:
        raise _never_still(motion, quietest, limits)
    return tuple(stops)


def stops_of_pictures(motion: Motion, stamps: Stamps, limits: StillLimits) -> tuple[Stop, ...]:
    """Stops where every picture was taken at a standstill: one for each run of equal poses.

    Parameters
    ----------
    motion : the hand's poses
    stamps : (N,) stamps of the pictures, increasing. Where the pose is not known there is no stop
    limits : poses that differ by less are one
    """
    T, known = motion.at(stamps, limits.max_gap_ns)
    stops: list[Stop] = []
    start: Array | None = None
    for stamp, pose, is_known in zip(stamps.tolist(), T, known, strict=True):
        if not is_known:
            start = None
        elif start is not None and same_pose(start, pose, limits):
            stops[-1] = Stop(stops[-1].first, stamp)
        else:
            start = pose
            stops.append(Stop(stamp, stamp))
    return tuple(stops)


def same_pose(A: Array, B: Array, limits: StillLimits) -> bool:
    """Whether two poses (4, 4) differ by no more than a hand that stands still."""
    moved = float(np.linalg.norm(A[:3, 3] - B[:3, 3]))
    turned = float(np.linalg.norm(rotation_log(A[:3, :3].T @ B[:3, :3])))
    return moved <= limits.move_m and turned <= limits.turn_rad


def split_stops(motion: Motion, stops: Sequence[Stop], limits: StillLimits) -> int:
    """How many stops begin, within a second, at the very pose of the stop before."""
    ends = np.array([[stop.first, stop.last] for stop in stops], dtype=np.int64)
    T, _ = motion.at(ends.ravel(), limits.max_gap_ns)
    return sum(
        stops[k].first - stops[k - 1].last < NS_PER_S and same_pose(T[2 * k - 1], T[2 * k], limits)
        for k in range(1, len(stops))
    )


def _check_often(motion: Motion, limits: StillLimits) -> None:
    """Refuse poses that come too seldom; single gaps are only times without a stop."""
    slowest = max(motion.moving, key=lambda series: series.typical_gap)
    if slowest.typical_gap <= limits.max_gap_ns:
        return
    what = (
        f"its poses come every {duration_text(slowest.typical_gap)}"
        if len(slowest.stamps) > 1
        else "there is one pose only"
    )
    raise DataError(
        f"{slowest.name}: {what}, and between poses more than "
        f"{duration_text(limits.max_gap_ns)} apart nothing is assumed; allow more (--max-gap) if "
        "the hand does not move unseen in between, or give --every-picture if there is a pose for "
        "each picture, taken at a standstill"
    )


def _extents(motion: Motion, stamps: Stamps, half: int, max_gap: int) -> Array:
    """How far the hand moves (m) and turns (rad) within ``half`` samples of each stamp; (2, M).

    Hours of recording are sampled some minutes at a time.
    """
    pieces = []
    for start in range(0, len(stamps), _CHUNK):
        before = max(start - half, 0)
        T, _ = motion.at(stamps[before : start + _CHUNK + half], max_gap)
        both = np.stack(
            [
                _diagonal(T[:, :3, 3], half),
                _diagonal(T[:, :3, :3].reshape(-1, 9), half) / np.sqrt(2),
            ]
        )
        pieces.append(both[:, start - before : start - before + _CHUNK])
    return np.concatenate(pieces, axis=1)


def _diagonal(values: Array, half: int) -> Array:
    """Diagonal of the box about ``values`` (M, k) within ``half`` samples of each; (M,)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    size = 2 * half + 1
    extent = maximum_filter1d(values, size, axis=0) - minimum_filter1d(values, size, axis=0)
    return np.asarray(np.linalg.norm(extent, axis=1))


def _excess(calm: tuple[float, float], limits: StillLimits) -> float:
    return max(calm[0] / limits.move_m, calm[1] / limits.turn_rad)


def _never_still(
    motion: Motion, quietest: tuple[float, float] | None, limits: StillLimits
) -> DataError:
    window = duration_text(limits.window_ns)
    if quietest is None:
        return DataError(
            f"{motion.hand} in {motion.base} is nowhere known for {window} without a gap of more "
            f"than {duration_text(limits.max_gap_ns)}: it cannot be seen where the hand stands "
            "still; allow longer gaps (--max-gap) or a shorter stop (--still-s)"
        )
    moved, turned = quietest
    return DataError(
        f"the hand never stands still: the least that it moves within {window} is "
        f"{moved * MM_PER_M:.3g} mm and {turned * DEG_PER_RAD:.3g} deg, the limits are "
        f"{limits.move_m * MM_PER_M:.3g} mm and {limits.turn_rad * DEG_PER_RAD:.3g} deg; raise "
        "them (--still-mm, --still-deg) if this is noise of the poses, or record with stops"
    )
