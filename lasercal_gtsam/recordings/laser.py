"""Whether the laser is on in a picture: seen in the pictures of one stop, or told by a topic."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.detect.candidates import FINE, find_candidates
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
# Share of the spot's light above which the laser is on, and below which it is off; pictures in
# between were exposed while it was switched.
_LIT, _DARK = 0.75, 0.25
_PATCH = 32  # px about the spot that are looked at
_COARSE_PIXELS = 1_500_000


@dataclass(frozen=True, eq=False)
class LaserStates:
    """What was seen in the pictures of a stop.

    Attributes
    ----------
    state : (N,) `ON`, `OFF` or `UNKNOWN`
    uniform : the pictures show the same; whether the laser is on or off cannot be told, and `ON`
        stands for those that are alike
    """

    state: States
    uniform: bool


@dataclass(frozen=True)
class Change:
    """A compact light that one picture has and another has not.

    ``height`` is that of the light in pixel values after a blur by 1.2 px, negative where the
    first picture lacks it; (u, v) is where, and ``channel`` in which colour.
    """

    height: float
    u: int = 0
    v: int = 0
    channel: str = "auto"


def states_of(pictures: Sequence[Picture]) -> LaserStates:
    """Tell laser-on from laser-off pictures of one stop.

    The camera and the hand stand still, so a compact light that one picture has and another has
    not is the spot. Each picture is compared with the first (or the next, where most differ from it
    by more than a spot); where the clearest difference is, the light is measured in all of them.
    Pictures exposed while the laser was switched (25 % to 75 % of the spot's light) and pictures
    that differ both ways (somebody walked through) are `UNKNOWN`.
    """
    shown = [_coarse(picture) for picture in pictures]
    state = np.zeros(len(pictures), dtype=np.int8)
    for reference in shown:
        changes = [_change(picture, reference) for picture in shown]
        clear = [change for change in changes if change is not None]
        if 2 * len(clear) > len(shown):
            break
    else:
        return LaserStates(state, uniform=False)
    known = np.array([change is not None for change in changes])
    clearest = max(clear, key=lambda change: abs(change.height))
    if clearest.height == 0:
        state[known] = ON
        return LaserStates(state, uniform=True)
    level = np.full(len(shown), np.nan)
    level[known] = [_light_at(shown[k], reference, clearest) for k in np.flatnonzero(known)]
    share = (level - np.nanmin(level)) / (np.nanmax(level) - np.nanmin(level))
    state[share >= _LIT] = ON
    state[share <= _DARK] = OFF
    return LaserStates(state, uniform=False)


def spot_appears(picture: Picture, reference: Picture) -> bool | None:
    """Whether ``picture`` has a spot that ``reference`` has not; None where they differ otherwise.

    False where the two are alike, and where it is the reference that has it.
    """
    change = _change(_coarse(picture), _coarse(reference))
    return None if change is None else change.height > 0


def _change(picture: Picture, reference: Picture) -> Change | None:
    """The spot by which two pictures differ; None where each has light that the other has not."""
    if picture.shape != reference.shape or picture.dtype != reference.dtype:
        return None
    more, less = _appearing(picture, reference), _appearing(reference, picture)
    if more.height >= _CLEARLY * less.height:
        return more
    return replace(less, height=-less.height) if less.height >= _CLEARLY * more.height else None


def _appearing(on: Picture, off: Picture) -> Change:
    options = DetectionOptions()
    frames = read_frames(on, off, options)
    ranked = find_candidates(laser_light(frames, options), options.threshold_sigmas).ranked
    if not ranked:
        return Change(0.0)
    channel = "auto" if on.ndim == 2 else frames.channel
    return Change(ranked[0].peak, ranked[0].u, ranked[0].v, channel)


def _light_at(picture: Picture, reference: Picture, spot: Change) -> float:
    """Light at the spot's place above that of the reference; the lamp's flicker is taken out."""
    import cv2

    rows = slice(max(spot.v - _PATCH, 0), spot.v + _PATCH + 1)
    columns = slice(max(spot.u - _PATCH, 0), spot.u + _PATCH + 1)
    options = DetectionOptions(channel=spot.channel)
    frames = read_frames(picture[rows, columns], reference[rows, columns], options)
    assert frames.off is not None
    light = frames.on - frames.off
    blurred = cv2.GaussianBlur(light, (0, 0), FINE, borderType=cv2.BORDER_REPLICATE)
    return float(blurred[spot.v - rows.start, spot.u - columns.start] - np.median(light))


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
