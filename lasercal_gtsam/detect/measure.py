"""Measure one candidate: where exactly, how certain, how large, how clipped, what is beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.background import measure_background
from lasercal_gtsam.detect.candidates import FINE, Candidate
from lasercal_gtsam.detect.centre import SpotFit, fit_spot
from lasercal_gtsam.detect.difference import Difference, Image, Mask, Patch, cut_patch
from lasercal_gtsam.detect.guard import CORE_LEVEL, Centre, choose_centre
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.detect.picture import Frames
from lasercal_gtsam.detect.region import Region, find_region, squared_distance
from lasercal_gtsam.frozen import Array

RIVAL_SIGMAS = 2.5  # light beyond this is not the spot's own
_FILL_BLUR = 0.6  # of the minor sigma
_BRIGHT_LEVEL = 0.1
_CLIPPED_DIVIDE = 0.1  # of the spot's pixels
_MARGIN = 12  # px of surroundings that are looked at beside the spot


@dataclass(frozen=True, eq=False)
class Measurement:
    """What is known of one candidate, before it is judged; positions in the whole picture.

    Attributes
    ----------
    centre
        Centre with covariance, and the spot's shape.
    peak
        Height of the spot (pixel values).
    n_saturated, saturated_share
        Clipped pixels of the spot, and per pixel above half of its peak.
    box, area
        Bounding box (u0, v0, width, height) and number of pixels above 20 % of the peak.
    bright_area
        Pixels above 10 % of the peak without the blur that all else is seen through.
    fill
        Light at the centre over the most in the spot, after a blur that speckle does not survive.
    beside, beside_uv
        Strongest light beyond 2.5 sigma in the surroundings, over the spot's, and where.
    """

    centre: Centre
    peak: float
    n_saturated: int
    saturated_share: float
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
    """Measure the spot that a candidate stands for.

    Parameters
    ----------
    frames, difference : the pictures and the laser's light in them
    blurred : the difference blurred by `FINE`
    candidate : the blob to measure
    options : for the albedo and the floor
    """
    whole = find_region(blurred, candidate)
    if whole.area > options.max_area_px:
        return _too_large(frames, blurred, candidate, whole)
    n_saturated = int(np.count_nonzero(frames.saturated[_slices(whole)]))
    reach = int(3 * np.sqrt(np.linalg.eigvalsh(whole.shape)[1])) + _MARGIN
    # dividing a clipped plateau would only print the texture on it
    divide = options.divide_albedo and n_saturated <= _CLIPPED_DIVIDE * whole.area
    patch = cut_patch(difference, whole.box, reach, options.black_level, divide)
    corner = np.array(patch.corner, dtype=np.float64)

    smooth = _smooth(patch.light)
    again = _strongest(smooth, whole, patch)
    region, core = find_region(smooth, again), find_region(smooth, again, CORE_LEVEL)
    background = measure_background(patch, region)
    variance = np.asarray(patch.variance * background.excess, dtype=np.float32)
    spot = fit_spot(patch.light, variance, region)
    centre = choose_centre(spot, region, core, n_saturated, background, options.floor_px)
    beside, beside_uv = _light_beside(patch.light, smooth, spot, centre)
    u0, v0, width, height = region.box
    return Measurement(
        centre=Centre(centre.uv + corner, centre.cov_uv, centre.shape, centre.method),
        peak=float(spot.p[0]) if centre.method == "fit" else again.peak,
        n_saturated=n_saturated,
        saturated_share=n_saturated / core.area,
        box=(u0 + patch.corner[0], v0 + patch.corner[1], width, height),
        area=region.area,
        bright_area=_bright_area(patch.light, region, difference.noise),
        fill=_fill(patch.light, region, centre),
        beside=beside,
        beside_uv=beside_uv + corner,
    )


def _too_large(frames: Frames, blurred: Image, candidate: Candidate, whole: Region) -> Measurement:
    """Only where it is, as certain as its own size: a fit would take long, and not be used."""
    return Measurement(
        centre=Centre(whole.centroid, whole.shape, whole.shape, "centroid"),
        peak=candidate.peak,
        n_saturated=int(np.count_nonzero(frames.saturated[_slices(whole)])),
        saturated_share=0.0,
        box=whole.box,
        area=whole.area,
        bright_area=whole.area,
        fill=1.0,
        beside=0.0,
        beside_uv=whole.centroid,
    )


def _strongest(smooth: Image, whole: Region, patch: Patch) -> Candidate:
    """The candidate again, in the patch (dividing by the albedo may have moved it)."""
    u0, v0, width, height = whole.box
    left, top = u0 - patch.corner[0], v0 - patch.corner[1]
    inside = np.where(whole.mask, smooth[top : top + height, left : left + width], -np.inf)
    v, u = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return Candidate(left + int(u), top + int(v), float(inside[v, u]))


def _slices(region: Region) -> tuple[slice, slice]:
    u0, v0, width, height = region.box
    return slice(v0, v0 + height), slice(u0, u0 + width)


def _bright_area(light: Image, region: Region, noise: float) -> int:
    """Pixels that connect to the region's brightest one above 10 % of it, without a blur.

    A spot of sigma 0.5 px has five; a hot pixel has one, as long as the noise is kept out.
    """
    inside = np.where(region.mask, light[_slices(region)], 0)
    above: Mask = inside > max(_BRIGHT_LEVEL * float(inside.max()), 3 * noise)
    above.flat[int(np.argmax(inside))] = True
    _, labels = cv2.connectedComponents(above.view(np.uint8), connectivity=8)
    return int(np.count_nonzero(labels == labels.ravel()[int(np.argmax(inside))]))


def _fill(light: Image, region: Region, centre: Centre) -> float:
    sigma = _FILL_BLUR * float(np.sqrt(np.linalg.eigvalsh(centre.shape)[0]))
    smooth = _smooth(light, max(sigma, FINE))
    return _at(smooth, centre.uv) / float(smooth[_slices(region)][region.mask].max())


def _at(image: Image, uv: Array) -> float:
    """Pixel nearest to ``uv``."""
    u, v = (int(x) for x in np.clip(np.rint(uv), 0, np.array(image.shape[::-1]) - 1))
    return float(image[v, u])


def _light_beside(
    light: Image, smooth: Image, spot: SpotFit, centre: Centre
) -> tuple[float, Array]:
    """Strongest light beyond 2.5 sigma over the spot's own (both blurred), and its pixel.

    What is left over by the fit, where that is trusted.
    """
    v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    rest, own = smooth.copy(), _at(smooth, centre.uv)
    if centre.method == "fit":
        model = gaussian.value(spot.p, u.ravel(), v.ravel()).reshape(light.shape)
        own = float(_smooth(np.asarray(model - spot.p[6], dtype=np.float32)).max())
        rest = _smooth(np.asarray(light - model, dtype=np.float32))
    rest[squared_distance(u, v, centre.uv, centre.shape) <= RIVAL_SIGMAS**2] = -np.inf
    y, x = np.unravel_index(int(np.argmax(rest)), rest.shape)
    return max(float(rest[y, x]) / max(own, 1e-12), 0.0), np.array([float(x), float(y)])


def _smooth(image: Image, sigma: float = FINE) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
