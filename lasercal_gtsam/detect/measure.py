"""Measure one candidate: where exactly, how certain, how large, how clipped, what is beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.candidates import FINE, Candidate
from lasercal_gtsam.detect.centre import (
    LEVEL,
    Region,
    SpotFit,
    aperture_centroid,
    find_region,
    fit_spot,
    squared_distance,
)
from lasercal_gtsam.detect.covariance import fit_covariance, saturation_variance
from lasercal_gtsam.detect.difference import Difference, Image, Patch, cut_patch
from lasercal_gtsam.detect.gaussian import Mask
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.detect.picture import Frames
from lasercal_gtsam.frozen import Array

# fit and centroid agree within the larger of these: pixels, and sigmas of the spot
_AGREE_PX, _AGREE_SIGMAS = 0.4, 0.45
_CLIPPED_SHARE = 0.5  # of the spot's pixels: above, the fit follows the flare
RIVAL_SIGMAS = 2.5  # light beyond this is not the spot's own
_MARGIN = 12  # px of surroundings that are looked at beside the spot


@dataclass(frozen=True, eq=False)
class Measurement:
    """What is known of one candidate, before it is judged.

    Attributes
    ----------
    uv, cov_uv, shape
        Centre (2,), px; its covariance and that of the spot (2, 2), px^2.
    method
        ``fit`` or ``centroid``.
    disagreement_px
        Distance between fit and centroid.
    peak
        Height of the spot (pixel values).
    n_saturated
        Clipped pixels of the spot.
    box, area
        Bounding box (u0, v0, width, height) and number of pixels above 20 % of the peak after a
        blur, and
    bright_area
        the same before it: a hot pixel has one.
    fill
        Light at the centre over the most in the spot, after a blur.
    beside
        Strongest light beyond 2.5 sigma in the surroundings, over the peak, after a blur, and
    beside_uv
        where that is.
    """

    uv: Array
    cov_uv: Array
    shape: Array
    method: str
    disagreement_px: float
    peak: float
    n_saturated: int
    box: tuple[int, int, int, int]
    area: int
    bright_area: int
    fill: float
    beside: float
    beside_uv: Array


def measure_spot(
    frames: Frames,
    difference: Difference,
    blurred: Image,
    candidate: Candidate,
    options: DetectionOptions,
) -> Measurement:
    """Measure the spot that a candidate stands for."""
    whole = find_region(blurred, candidate)
    margin = _MARGIN + int(3 * np.sqrt(np.linalg.eigvalsh(whole.shape)[1]))
    patch = cut_patch(difference, whole.box, margin, options.black_level, options.divide_albedo)
    corner = np.array(patch.corner, dtype=np.float64)
    smooth = _smooth(patch.light)
    region = find_region(smooth, _strongest(smooth, whole, patch))
    spot = fit_spot(patch.light, patch.variance, region)

    saturated = _near(frames.saturated, patch, region)
    uv, cov, method = _centre(spot, region, saturated, options.floor_px)
    shape = spot.shape if method == "fit" else region.shape
    beside, beside_uv = _light_beside(patch.light, spot)
    u, v = (int(x) for x in np.clip(np.rint(uv), 0, np.array(smooth.shape[::-1]) - 1))
    top = float(smooth[_slices(region)][region.mask].max())
    u0, v0, width, height = region.box
    return Measurement(
        uv=uv + corner,
        cov_uv=cov,
        shape=shape,
        method=method,
        disagreement_px=float(np.linalg.norm(spot.uv - region.centroid)),
        peak=float(spot.p[0]),
        n_saturated=saturated,
        box=(u0 + patch.corner[0], v0 + patch.corner[1], width, height),
        area=region.area,
        bright_area=_bright_area(patch.light, region),
        fill=float(smooth[v, u]) / top,
        beside=beside,
        beside_uv=beside_uv + corner,
    )


def _strongest(smooth: Image, whole: Region, patch: Patch) -> Candidate:
    """The candidate again, in the patch (dividing by the albedo may have moved it)."""
    u0, v0, width, height = whole.box
    left, top = u0 - patch.corner[0], v0 - patch.corner[1]
    inside = np.where(whole.mask, smooth[top : top + height, left : left + width], -np.inf)
    v, u = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return Candidate(left + int(u), top + int(v), float(inside[v, u]))


def _centre(
    spot: SpotFit, region: Region, saturated: int, floor_px: float
) -> tuple[Array, Array, str]:
    """Fit or centroid, with a covariance that knows of their disagreement."""
    offset = spot.uv - region.centroid
    aperture = aperture_centroid(spot.window, region.centroid, region.shape)
    sigma = float(np.sqrt(np.linalg.eigvalsh(region.shape)[1]))
    tolerance = max(_AGREE_PX, _AGREE_SIGMAS * sigma)
    agrees = min(np.linalg.norm(offset), np.linalg.norm(spot.uv - aperture)) <= tolerance
    trusted = spot.settled and agrees and saturated <= _CLIPPED_SHARE * region.area
    share = 0.25 if trusted else 1.0
    cov = fit_covariance(spot) + share * np.outer(offset, offset)
    cov = cov + (floor_px**2 + saturation_variance(saturated)) * np.eye(2)
    return (spot.uv, cov, "fit") if trusted else (region.centroid, cov, "centroid")


def _slices(region: Region) -> tuple[slice, slice]:
    u0, v0, width, height = region.box
    return slice(v0, v0 + height), slice(u0, u0 + width)


def _near(saturated: Mask, patch: Patch, region: Region) -> int:
    """Clipped pixels in the spot's box."""
    u0, v0, width, height = region.box
    u0, v0 = u0 + patch.corner[0], v0 + patch.corner[1]
    return int(np.count_nonzero(saturated[v0 : v0 + height, u0 : u0 + width]))


def _bright_area(light: Image, region: Region) -> int:
    """Pixels that connect to the brightest one of the region above 20 % of it, without a blur."""
    inside = np.where(region.mask, light[_slices(region)], 0)
    above = (inside > LEVEL * inside.max()).view(np.uint8)
    _, labels = cv2.connectedComponents(above, connectivity=8)
    brightest = labels.ravel()[int(np.argmax(inside))]
    return int(np.count_nonzero(labels == brightest))


def _light_beside(light: Image, spot: SpotFit) -> tuple[float, Array]:
    """What the fitted spot leaves beyond 2.5 sigma: ratio of the peaks after a blur, and pixel."""
    v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    model = gaussian.value(spot.p, u.ravel(), v.ravel()).reshape(light.shape)
    own = float(_smooth(np.asarray(model - spot.p[6], dtype=np.float32)).max())
    rest = _smooth(np.asarray(light - model, dtype=np.float32))
    rest[squared_distance(u, v, spot.uv, spot.shape) <= RIVAL_SIGMAS**2] = -np.inf
    y, x = np.unravel_index(int(np.argmax(rest)), rest.shape)
    return max(float(rest[y, x]) / own, 0.0), np.array([float(x), float(y)])


def _smooth(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), FINE, borderType=cv2.BORDER_REPLICATE))
