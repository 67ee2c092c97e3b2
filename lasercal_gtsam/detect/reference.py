"""A laser-off picture made of laser-on pictures: the spot moves, the scene does not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from lasercal_gtsam.detect.candidates import Candidate, Candidates, find_candidates
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.detect.picture import read_frames
from lasercal_gtsam.detect.pipeline import laser_light
from lasercal_gtsam.errors import DetectionError

_MIN_FRAMES = 3
# Light of the spots left in the median, over a spot's own. Measured with spots of sigma 3 px on a
# line: 3 % moves no centre, 5 % by 0.1 to 0.2 px, 20 % by 1 px.
_MAX_LEFT = 0.03
_MAX_EMPTY = 1 / 3  # of the pictures; spots that never move leave nothing in 8 of 15 or more


def median_frame(pictures: Iterable[Any]) -> Any:
    """Middle value of every pixel over pictures of one scene: what is there without the spot.

    A stand-in for an off frame, for a fixed camera that took no picture without the laser. Every
    place must be free of the spot in more than half of the pictures; five to fifteen spread over
    the capture are enough, and all of them are held in memory.

    Parameters
    ----------
    pictures : three or more arrays of one shape and type

    Returns
    -------
    array like one of the pictures

    Raises
    ------
    DetectionError
        Fewer than three pictures, or they differ in size or depth.
    """
    frames = [np.asarray(picture) for picture in pictures]
    if len(frames) < _MIN_FRAMES:
        raise DetectionError(
            f"median of pictures: expected {_MIN_FRAMES} pictures or more, got {len(frames)}"
        )
    first = frames[0]
    for k, frame in enumerate(frames):
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise DetectionError(
                f"median of pictures: picture {k} is {frame.dtype} {frame.shape}, the first is "
                f"{first.dtype} {first.shape}"
            )
    middle = len(frames) // 2
    # row by row: the sorted copy of a row is small
    rows = [
        np.partition(np.stack([frame[y] for frame in frames]), middle, axis=0)[middle]
        for y in range(first.shape[0])
    ]
    return np.stack(rows)


def spots_in_median(
    off: Any, pictures: Iterable[Any], options: DetectionOptions | None = None
) -> str | None:
    """Why a median of pictures holds light of the spot itself; None where it is free of it.

    What the median holds of the spots of many pictures is missing in some other picture, which is
    darker than the median there: a true off frame is nowhere brighter than an on frame. Spots that
    stay where they are leave nothing, or only their speckle, in picture minus median.

    Parameters
    ----------
    off : from `median_frame`
    pictures : those it was made of
    options : for saturation, channel and thresholds

    Returns
    -------
    str or None
        The reason, with numbers.

    Raises
    ------
    DetectionError
        The arrays are no pictures.
    """
    options = options or DetectionOptions()
    found = [_brighter_and_darker(picture, off, options) for picture in pictures]
    peaks = [bright.ranked[0].peak for bright, _ in found if bright.ranked]
    empty = len(found) - len(peaks)
    if empty > _MAX_EMPTY * len(found):
        return (
            f"in {empty} of {len(found)} pictures nothing rises above their median: the spots move "
            "too little, or do not show"
        )
    darkest = max((dark.ranked[0] for _, dark in found if dark.ranked), key=_peak, default=None)
    share = 0.0 if darkest is None else darkest.peak / float(np.median(peaks))
    if darkest is not None and share > _MAX_LEFT:
        return (
            f"at ({darkest.u}, {darkest.v}) their median is brighter than one of them, by "
            f"{share:.0%} of a spot's peak: spots lie on each other there, or the scene changes"
        )
    return None


def _brighter_and_darker(
    on: Any, off: Any, options: DetectionOptions
) -> tuple[Candidates, Candidates]:
    """Blobs of on minus off, and of off minus on."""
    difference = laser_light(read_frames(on, off, options), options)
    turned = replace(difference, light=-difference.light)
    return (
        find_candidates(difference, options.threshold_sigmas),
        find_candidates(turned, options.threshold_sigmas),
    )


def _peak(candidate: Candidate) -> float:
    return candidate.peak
