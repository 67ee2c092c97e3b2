"""Whether the laser is on in a picture: seen in the pictures of one stop, or told by a topic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.detect.candidates import find_candidates
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.detect.picture import read_frames
from lasercal_gtsam.detect.pipeline import laser_light
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.pictures import Picture
from lasercal_gtsam.recordings.stamps import Stamps, last_before

ON, OFF, UNKNOWN = 1, -1, 0
States = npt.NDArray[np.int8]
LaserAt = Callable[[int], int]
"""State of the laser (`ON`, `OFF`, `UNKNOWN`) at a stamp."""

# One picture must outshine the other by this factor; people and shadows do both.
_CLEARLY = 2.0
# Pictures whose spot is weaker than this share of the strongest were exposed while it switched.
_FULLY_LIT = 0.8
_COARSE_PIXELS = 1_500_000


@dataclass(frozen=True, eq=False)
class LaserStates:
    """What was seen in the pictures of a stop.

    Attributes
    ----------
    state : (N,) `ON`, `OFF` or `UNKNOWN`
    uniform : all pictures show the same; whether the laser is on or off cannot be told
    """

    state: States
    uniform: bool


def states_of(pictures: Sequence[Picture]) -> LaserStates:
    """Tell laser-on from laser-off pictures of one stop by comparing each with the first.

    The camera and the hand stand still, so a compact light that one picture has and another has
    not is the spot. Pictures exposed while the laser was switched (spot weaker than 80 % of the
    strongest) and pictures that differ both ways (somebody walked through) are `UNKNOWN`.
    """
    change = np.array([0.0, *(spot_change(p, pictures[0]) for p in pictures[1:])])
    unclear = np.isnan(change)
    strength = np.where(unclear, 0.0, change)
    state = np.zeros(len(pictures), dtype=np.int8)
    brighter, darker = strength > 0, strength < 0
    if not (brighter.any() or darker.any()):
        return LaserStates(state, uniform=True)
    state[brighter & (strength >= _FULLY_LIT * strength.max())] = ON
    state[darker & (strength <= _FULLY_LIT * strength.min())] = OFF
    if not (brighter.any() and darker.any()):  # else the first is itself between on and off
        state[(strength == 0) & ~unclear] = OFF if brighter.any() else ON
    return LaserStates(state, uniform=False)


def spot_change(picture: Picture, reference: Picture) -> float:
    """Height of the spot that ``picture`` has and ``reference`` has not; negative the other way.

    Zero where neither has light that the other has not, NaN where both have (or the pictures are
    of another kind). The height is in pixel values after a blur by 1.2 px.
    """
    if picture.shape != reference.shape or picture.dtype != reference.dtype:
        return float("nan")
    a, b = _coarse(picture), _coarse(reference)
    more, less = _appearing(a, b), _appearing(b, a)
    if more == less == 0:
        return 0.0
    if more >= _CLEARLY * less:
        return more
    return -less if less >= _CLEARLY * more else float("nan")


def _appearing(on: Picture, off: Picture) -> float:
    options = DetectionOptions()
    difference = laser_light(read_frames(on, off, options), options)
    ranked = find_candidates(difference, options.threshold_sigmas).ranked
    return ranked[0].peak if ranked else 0.0


def _coarse(picture: Picture) -> Picture:
    """Picture binned until it has about a million pixels: enough to see that there is a spot."""
    import cv2

    height, width = picture.shape[:2]
    binning = int(np.ceil(np.sqrt(height * width / _COARSE_PIXELS)))
    if binning <= 1:
        return picture
    size = (width // binning, height // binning)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def most_central(
    stamps: Stamps, chosen: npt.NDArray[np.bool_], first: int, last: int
) -> int | None:
    """Of the chosen pictures the one farthest in time from motion and from all other pictures.

    Near the ends of a stop the hand may still shake, and next to a picture of another state the
    laser was being switched. The earliest of equals; None where nothing is chosen.

    Parameters
    ----------
    stamps : (N,) nanoseconds
    chosen : (N,) which to choose from
    first, last : ends of the stop
    """
    if not chosen.any():
        return None
    distance: Array = np.minimum(stamps - first, last - stamps).astype(np.float64)
    if not chosen.all():
        others = np.abs(stamps[:, None] - stamps[~chosen][None, :]).min(axis=1)
        distance = np.minimum(distance, others)
    distance[~chosen] = -np.inf
    return int(np.argmax(distance))


def latched_laser(stamps: Stamps, values: Sequence[bool]) -> LaserAt:
    """State of the laser by what was last said of it; unknown before the first word.

    Parameters
    ----------
    stamps : (N,) nanoseconds, increasing
    values : N times whether it is on from then
    """

    def at(stamp: int) -> int:
        k = last_before(stamps, stamp)
        return UNKNOWN if k is None else ON if values[k] else OFF

    return at
