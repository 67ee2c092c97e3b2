"""A laser-off picture made of laser-on pictures: the spot moves, the scene does not."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from lasercal_gtsam.errors import DetectionError

_MIN_FRAMES = 3


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
