"""Cutting the surroundings of a spot out of a picture, so that they can be looked at."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

View = npt.NDArray[np.uint8]

OUTSIDE = 24
"""Brightness of what lies outside the picture."""


def as_bgr8(picture: Any) -> View:
    """Picture as 8-bit BGR, brightened to its own maximum where it uses more or fewer bits."""
    picture = np.asarray(picture)
    if picture.ndim == 3:
        picture = picture[..., :3]
    if picture.dtype != np.uint8:
        top = max(float(picture.max()), 1e-12)
        picture = np.clip(picture * (255.0 / top), 0, 255).astype(np.uint8)
    if picture.ndim == 2 or picture.shape[2] == 1:
        picture = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_GRAY2BGR)
    return np.asarray(picture, dtype=np.uint8)


def cut(view: View, box: tuple[int, int, int]) -> View:
    """Square crop (u0, v0, side), dark where it leaves the picture."""
    u0, v0, side = box
    crop = np.full((side, side, 3), OUTSIDE, np.uint8)
    left, top = max(u0, 0), max(v0, 0)
    right, bottom = min(u0 + side, view.shape[1]), min(v0 + side, view.shape[0])
    if right > left and bottom > top:
        crop[top - v0 : bottom - v0, left - u0 : right - u0] = view[top:bottom, left:right]
    return crop


def stretched(crop: View) -> View:
    """Brightness from the crop's darkest to its brightest: a faint spot shows as well."""
    low, high = (float(x) for x in np.percentile(crop, (1.0, 100.0)))
    scale = 255.0 / max(high - low, 1.0)
    return np.asarray(np.clip((crop - low) * scale, 0, 255), dtype=np.uint8)
