"""The light of the laser alone: on minus off, matched for lamp flicker and camera shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_MATCH_SAMPLES = 15_000
_SAMPLES = 40_000  # pixels that a global statistic is taken from
_ALBEDO_BLUR = 0.8  # px; against the noise of the off frame
_ALBEDO_RANGE = 4.0  # prints on one surface differ by less
_BACKGROUND_SCALE = 16  # a background pixel averages this many pixels each way


@dataclass(frozen=True, eq=False)
class Difference:
    """Laser light of one channel with what is known of its background.

    Attributes
    ----------
    light : (height, width) float32
        On minus off (matched), or on minus its smooth background.
    noise : float
        Standard deviation of a background pixel of ``light``.
    clutter : (height, width) float32, or 0
        What a further shift or flicker between the frames could leave over.
    off : (height, width) float32 or None
        The off frame.
    off_noise : float
        Noise of one off pixel.
    """

    light: Image
    noise: float
    clutter: Image | float
    off: Image | None
    off_noise: float


def pair_difference(
    on: Image,
    off: Image,
    step: float,
    clutter_shift_px: float,
    clutter_gain: float,
    blind: Mask | None = None,
) -> Difference:
    """Difference of a laser-on and a laser-off frame of the same scene.

    To first order a lamp brighter by ``g`` and a camera moved by ``s`` leave
    ``g off - s . grad(off)`` in the difference. Both are estimated over the whole picture (the
    spot is clipped away as an outlier) and taken out.

    Parameters
    ----------
    on, off : (height, width) float32
    step : quantisation step of the pictures, 0 if unknown
    clutter_shift_px, clutter_gain : see `DetectionOptions`
    blind : clipped pixels of the off frame; nothing can be told there
    """
    light = on - off
    gx, gy = _gradient(off)
    gain, shift = _match(light, off, gx, gy)
    light -= np.float32(gain) * off
    light += np.float32(shift[0]) * gx
    light += np.float32(shift[1]) * gy
    if blind is not None:
        # clipped in both frames, they did not follow the lamp
        light[blind] = np.minimum(light[blind], 0)
    clutter = cv2.magnitude(gx, gy)
    cv2.addWeighted(clutter, clutter_shift_px, off, clutter_gain, 0.0, dst=clutter)
    noise = noise_sigma(light, step * np.sqrt(2))
    return Difference(light, noise, np.asarray(clutter), off, noise / np.sqrt(2))


def single_difference(on: Image, step: float) -> Difference:
    """On frame minus its own smooth background (a median over some 80 px)."""
    light = on - smooth_background(on)
    noise = noise_sigma(light, step)
    return Difference(light, noise, 0.0, None, noise)


def smooth_background(image: Image) -> Image:
    """Median over about 80 px: what is left when spots, dirt and lines are taken away."""
    height, width = image.shape
    small = (max(width // _BACKGROUND_SCALE, 1), max(height // _BACKGROUND_SCALE, 1))
    coarse = cv2.medianBlur(cv2.resize(image, small, interpolation=cv2.INTER_AREA), 5)
    return _image(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))


def noise_sigma(image: Image, step: float = 0.0) -> float:
    """Standard deviation of the pixel noise, blind to smooth structure.

    Mixed second differences of 2x2 blocks cancel every gradient; their standard deviation is
    twice the noise's. Outliers are clipped at 3 sigma. (The median absolute deviation would be
    quantised on integer pictures.) Never below the quantisation noise ``step / sqrt(12)``.
    """
    stride = max(1, int(np.sqrt(image.size / 4 / _SAMPLES)))
    rows = np.arange(0, image.shape[0] - 1, 2 * stride)
    columns = np.arange(0, image.shape[1] - 1, 2 * stride)
    top, bottom = image[rows], image[rows + 1]
    second = (top[:, columns] - top[:, columns + 1]) - (bottom[:, columns] - bottom[:, columns + 1])
    quantisation = float(step / np.sqrt(12))
    return max(0.5 * clipped_sigma(second.ravel()), quantisation, 1e-12)


def clipped_sigma(values: Image, clip: float = 3.0, rounds: int = 5) -> float:
    """Standard deviation about zero of a sample with outliers, clipped and corrected for it."""
    values = np.abs(values)
    # start from the median of a few (rough, and quantised on integers), or where that is zero,
    # from all
    few = values[:: max(1, values.size // 2000)]
    sigma = 1.4826 * float(np.median(few)) or float(np.sqrt(np.mean(values * values)))
    for _ in range(rounds):
        kept = values[values <= clip * sigma]
        if kept.size == 0:
            break
        # a Gaussian cut at 3 sigma keeps 0.9733 of its variance
        new = float(np.sqrt(float(kept @ kept) / kept.size / 0.9733))
        if abs(new - sigma) < 1e-3 * sigma:
            return new
        sigma = new
    return sigma


def _gradient(image: Image) -> tuple[Image, Image]:
    """Central differences. They leave the pixel itself out, so its noise stays uncorrelated."""
    kernel = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)
    gx = cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
    gy = cv2.filter2D(image, cv2.CV_32F, kernel.T, borderType=cv2.BORDER_REPLICATE)
    return _image(gx), _image(gy)


def _match(light: Image, off: Image, gx: Image, gy: Image) -> tuple[float, npt.NDArray[np.float64]]:
    """Lamp gain and camera shift between the frames by clipped least squares on a sample."""
    stride = max(1, int(np.sqrt(light.size / _MATCH_SAMPLES)))
    part = (slice(None, None, stride), slice(None, None, stride))
    A = np.stack([off[part].ravel(), -gx[part].ravel(), -gy[part].ravel()])
    y = light[part].ravel()
    keep = np.ones_like(y)
    solution: npt.NDArray[np.float64] = np.zeros(3)
    for _ in range(4):
        kept = A * keep
        normal, right = (kept @ A.T).astype(np.float64), (kept @ y).astype(np.float64)
        # a scene without light or without structure says nothing of gain or shift: stay at zero
        normal += (1e-6 * np.trace(normal) + 1e-12) * np.eye(3)
        solution = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        residual = np.abs(y - solution.astype(np.float32) @ A)
        keep = (residual <= 3 * clipped_sigma(residual)).astype(np.float32)
    return float(solution[0]), solution[1:]


def _image(array: Any) -> Image:
    return np.asarray(array, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Patch:
    """Part of a difference around a spot; ``corner`` is (u, v) of its first pixel.

    ``variance`` is the background noise of each pixel, squared.
    """

    light: Image
    variance: Image
    corner: tuple[int, int]


def cut_patch(
    difference: Difference,
    box: tuple[int, int, int, int],
    margin: int,
    black_level: float,
    divide: bool,
) -> Patch:
    """Cut out a box (u0, v0, width, height) and its surroundings, albedo divided out if asked.

    Ambient light shows the reflectance of the surface: relative to its median in the box it
    divides the laser's light. Left alone where the off frame is too dark (10 sigma), shows nothing
    but its noise, or varies so much that it must be a highlight or a deep shadow and no print.
    """
    u0, v0, width, height = box
    rows = slice(max(v0 - margin, 0), min(v0 + height + margin, difference.light.shape[0]))
    columns = slice(max(u0 - margin, 0), min(u0 + width + margin, difference.light.shape[1]))
    light = difference.light[rows, columns]
    variance = np.full(light.shape, difference.noise**2, dtype=np.float32)
    corner = (columns.start, rows.start)
    if not divide or difference.off is None:
        return Patch(light, variance, corner)
    ambient = cv2.GaussianBlur(
        difference.off[rows, columns] - np.float32(black_level), (0, 0), _ALBEDO_BLUR
    )
    reference = float(np.median(ambient))
    low, high = float(ambient.min()), float(ambient.max())
    # white noise after a Gaussian blur
    noise = difference.off_noise / (2 * np.sqrt(np.pi) * _ALBEDO_BLUR)
    blank = float(ambient.std()) < 1.5 * noise
    if blank or low < 10 * difference.off_noise or high > _ALBEDO_RANGE * low:
        return Patch(light, variance, corner)
    albedo = _image(ambient / np.float32(reference))
    return Patch(_image(light / albedo), _image(variance / albedo**2), corner)
