"""Where the hand stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.recordings.motion import Known, Motion
from lasercal_gtsam.recordings.stamps import NS_PER_S, Stamps, duration_text
from lasercal_gtsam.rotations import rotation_log
from lasercal_gtsam.units import DEG_PER_RAD, M_PER_MM, MM_PER_M, RAD_PER_DEG

_SAMPLES = 30  # in a window


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

    The pose is sampled 30 times in a window. How far it moves within a window is bounded from
    above by the diagonal of the box about its positions, and how far it turns by that of the box
    about its rotation matrices over sqrt(2) (two rotations an angle a apart are
    ``2 sqrt(2) sin(a/2)`` apart in the Frobenius norm).

    Raises
    ------
    DataError
        The hand never stands still; the message says how close it came to it.
    """
    first, last = motion.span
    period = max(limits.window_ns // _SAMPLES, 1)
    half = limits.window_ns // (2 * period)
    stamps = np.arange(first, last + 1, period, dtype=np.int64)
    T, known = motion.at(stamps, limits.max_gap_ns)
    _check_known(motion, known, limits)
    if len(stamps) < 2 * half + 1:
        raise DataError(
            f"{motion.hand} in {motion.base} is known for {duration_text(last - first)} only; the "
            f"hand must be seen to stand still for {duration_text(limits.window_ns)}"
        )
    moved = _diagonal(T[:, :3, 3], half)
    turned = _diagonal(T[:, :3, :3].reshape(-1, 9), half) / np.sqrt(2)
    whole = _everywhere(known, half)
    still = whole & (moved <= limits.move_m) & (turned <= limits.turn_rad)
    if not still.any():
        raise _never_still(moved, turned, whole, limits)
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(np.int8)))
    return tuple(
        Stop(int(stamps[start]), int(stamps[end - 1]))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    )


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


def _check_known(motion: Motion, known: Known, limits: StillLimits) -> None:
    """Refuse poses that come too seldom; single gaps are only times without a stop."""
    if known.mean() > 0.5:
        return
    slowest = max(motion.moving, key=lambda series: series.typical_gap)
    raise DataError(
        f"{slowest.name}: its poses come every {duration_text(slowest.typical_gap)}, and between "
        f"poses more than {duration_text(limits.max_gap_ns)} apart nothing is assumed; allow more "
        "(--max-gap) if the hand does not move unseen in between"
    )


def _diagonal(values: Array, half: int) -> Array:
    """Diagonal of the box about ``values`` (M, k) within ``half`` samples of each; (M,)."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    size = 2 * half + 1
    extent = maximum_filter1d(values, size, axis=0) - minimum_filter1d(values, size, axis=0)
    return np.asarray(np.linalg.norm(extent, axis=1))


def _everywhere(known: Known, half: int) -> Known:
    """Whether all is known within ``half`` samples; nothing is beyond the ends."""
    from scipy.ndimage import minimum_filter1d

    whole = minimum_filter1d(known.astype(np.uint8), 2 * half + 1, mode="constant", cval=0)
    return np.asarray(whole > 0)


def _never_still(moved: Array, turned: Array, whole: Known, limits: StillLimits) -> DataError:
    window = duration_text(limits.window_ns)
    if not whole.any():
        return DataError(
            f"the poses have gaps of more than {duration_text(limits.max_gap_ns)} in every "
            f"{window}: it cannot be seen where the hand stands still; allow more (--max-gap)"
        )
    excess = np.maximum(moved / limits.move_m, turned / limits.turn_rad)
    k = int(np.flatnonzero(whole)[np.argmin(excess[whole])])
    return DataError(
        f"the hand never stands still: the least that it moves within {window} is "
        f"{moved[k] * MM_PER_M:.3g} mm and {turned[k] * DEG_PER_RAD:.3g} deg, the limits are "
        f"{limits.move_m * MM_PER_M:.3g} mm and {limits.turn_rad * DEG_PER_RAD:.3g} deg; raise "
        "them (--still-mm, --still-deg) if this is noise of the poses, or record with stops"
    )
