"""Pictures as they come from a camera or a file: checked, and one channel of them as float32."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from lasercal_gtsam.detect.difference import Image, Mask, noise_sigma, smooth_background
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.errors import DetectionError

_COLOURS = ("blue", "green", "red")
_PLATEAU = 4  # equal pixels at the maximum that betray clipping below the type's largest value
_NEAR = 15  # px about the brightest point in which a channel's clipped pixels are counted
_USEFUL_SHARE = 0.1  # of the strongest channel's peak: below, an unclipped channel is no help
_USEFUL_SNR = 5.0


@dataclass(frozen=True, eq=False)
class Frames:
    """One channel of a picture and of its laser-off partner.

    ``step`` is the quantisation step (0 if unknown), ``saturated`` the mask of clipped pixels of
    the on frame, ``blind`` that of the off frame: no laser can be seen on what is white without it.
    """

    channel: str
    on: Image
    off: Image | None
    step: float
    saturated: Mask
    blind: Mask | None


def read_frames(on: Any, off: Any, options: DetectionOptions) -> Frames:
    """Check the arrays and take the channel to work on.

    Raises
    ------
    DetectionError
        Not a picture (type, dimensions, not finite, smaller than 8 x 8), or the two differ in size
        or depth.
    """
    on = _checked(on, "on")
    if off is not None:
        off = _checked(off, "off")
        if off.shape != on.shape or off.dtype != on.dtype:
            raise DetectionError(
                f"off frame: expected the same size and depth as the on frame "
                f"({_describe(on)}), got {_describe(off)}"
            )
    step = 1.0 if on.dtype.kind == "u" else 0.0
    level = options.saturation_level
    if on.ndim == 2:
        return _frames("mono", on, off, step, level)
    if options.channel == "gray":
        return Frames(
            channel="gray",
            on=_gray(on),
            off=None if off is None else _gray(off),
            step=step,
            saturated=_any_clipped(on, level),
            blind=None if off is None else _any_clipped(off, level),
        )
    if options.channel == "auto":
        channel = _lit_channel(on, off, level)
    else:
        channel = _COLOURS.index(options.channel)
    off_channel = None if off is None else off[..., channel]
    return _frames(_COLOURS[channel], on[..., channel], off_channel, step, level)


def _frames(channel: str, on: Any, off: Any, step: float, level: float | None) -> Frames:
    return Frames(
        channel=channel,
        on=_float(on),
        off=None if off is None else _float(off),
        step=step,
        saturated=_clipped(on, level),
        blind=None if off is None else _clipped(off, level),
    )


def _gray(image: Any) -> Image:
    return _float(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _any_clipped(image: Any, level: float | None) -> Mask:
    """Pixels with a clipped channel."""
    return np.asarray(np.logical_or.reduce([_clipped(image[..., k], level) for k in range(3)]))


def _float(image: Any) -> Image:
    return np.ascontiguousarray(image, dtype=np.float32)


def _checked(picture: Any, name: str) -> Any:
    if not isinstance(picture, np.ndarray):
        raise DetectionError(
            f"{name} frame: expected an array, got {type(picture).__name__} "
            "(a file that cannot be read gives None)"
        )
    if picture.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise DetectionError(
            f"{name} frame: expected uint8, uint16, float32 or float64, got {picture.dtype}"
        )
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    if picture.ndim == 3 and picture.shape[2] == 4:
        picture = np.ascontiguousarray(picture[..., :3])  # without transparency
    if picture.ndim != 2 and not (picture.ndim == 3 and picture.shape[2] == 3):
        raise DetectionError(
            f"{name} frame: expected (height, width) or (height, width, 3), got {picture.shape}"
        )
    if min(picture.shape[:2]) < 8:
        raise DetectionError(
            f"{name} frame: expected 8 x 8 pixels or more, got {_describe(picture)}"
        )
    if picture.dtype.kind == "f":
        with np.errstate(over="ignore"):
            picture = picture.astype(np.float32)
        bad = int(np.count_nonzero(~np.isfinite(picture)))
        if bad:
            raise DetectionError(f"{name} frame: {bad} pixels are not finite")
    return picture


def _describe(picture: Any) -> str:
    kind = "colour" if picture.ndim == 3 else "mono"
    return f"{picture.shape[1]} x {picture.shape[0]} {picture.dtype} {kind}"


def _clipped(image: Any, level: float | None) -> Mask:
    """Pixels at saturation; see `DetectionOptions.saturation_level`."""
    if level is not None:
        return np.asarray(image >= level)
    if image.dtype == np.uint8:
        return np.asarray(image == 255)
    top = image.max()
    at_top = np.asarray(image == top)
    full = image.dtype == np.uint16 and top == 65535
    if full or (np.count_nonzero(at_top) >= _PLATEAU and image.min() < top):
        return at_top
    return np.zeros(image.shape, dtype=bool)


def _lit_channel(on: Any, off: Any, level: float | None) -> int:
    """Index of the channel that the laser lights most without clipping (BGR)."""
    peaks, places, noises, clipped = [], [], [], []
    for k in range(3):
        channel = _float(on[..., k])
        dark = smooth_background(channel) if off is None else _float(off[..., k])
        light = channel - dark
        _, peak, _, place = cv2.minMaxLoc(cv2.GaussianBlur(light, (0, 0), 1.2))
        peaks.append(peak)
        places.append(place)
        noises.append(noise_sigma(light))
        clipped.append(_clipped(on[..., k], level))
    strongest = int(np.argmax(peaks))
    u, v = places[strongest]
    near = (slice(max(v - _NEAR, 0), v + _NEAR + 1), slice(max(u - _NEAR, 0), u + _NEAR + 1))
    counts = [int(np.count_nonzero(c[near])) for c in clipped]
    useful = [
        k
        for k in range(3)
        if peaks[k] >= _USEFUL_SHARE * peaks[strongest] and peaks[k] >= _USEFUL_SNR * noises[k]
    ]
    # fewest clipped pixels first, then the most light
    return min(useful or [strongest], key=lambda k: (counts[k], -peaks[k]))
