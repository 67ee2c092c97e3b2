"""Judge a measured spot: is it one, is it alone, can its centre be trusted."""

from __future__ import annotations

import cv2
import numpy as np

from lasercal_gtsam.detect.detection import RunnerUp, Verdict
from lasercal_gtsam.detect.measure import Measurement
from lasercal_gtsam.detect.options import DetectionOptions

# of the spot's most: less light at the centre means two spots that touch (equal ones from 3.6 sigma
# apart). One spot in 100 of speckle contrast 0.6 has less than 0.70
_HOLLOW = 0.65


def judge(
    spot: Measurement,
    noise: float,
    rival: RunnerUp | None,
    image_size: tuple[int, int],
    single_frame: bool,
    options: DetectionOptions,
) -> tuple[Verdict, str]:
    """Verdict and its reason. The first gate that fails decides.

    Parameters
    ----------
    spot : the strongest candidate, measured
    noise : of a background pixel
    rival : the strongest light that is not the spot's own
    image_size : (width, height)
    single_frame : no off frame was given
    """
    width, height = image_size
    margin = options.edge_margin_px
    u0, v0, w, h = spot.box
    u, v = spot.centre.uv
    if u0 < margin or v0 < margin or u0 + w > width - margin or v0 + h > height - margin:
        return "edge", f"the spot at ({u:.0f}, {v:.0f}) reaches the edge of the picture"
    if options.region is not None:
        polygon = np.array(options.region, dtype=np.float32).reshape(-1, 1, 2)
        if cv2.pointPolygonTest(polygon, (float(u), float(v)), False) < 0:
            return "outside", f"the spot at ({u:.0f}, {v:.0f}) lies outside the given region"
    if spot.bright_area < options.min_area_px:
        return "too_small", (
            f"{spot.bright_area} pixels above 10 % of the peak, fewer than "
            f"{options.min_area_px}: a hot pixel?"
        )
    if spot.area > options.max_area_px:
        return "too_large", (
            f"{spot.area} pixels above 20 % of the peak, more than {options.max_area_px}"
        )
    minor, major = np.sqrt(np.linalg.eigvalsh(spot.centre.shape))
    if major > options.max_elongation * minor:
        return "elongated", (
            f"the axes are {major / minor:.1f} to 1, more than {options.max_elongation:g}: "
            "a line or a reflection?"
        )
    if spot.saturated_share > options.max_saturated_share:
        return "saturated", (
            f"{spot.n_saturated} pixels are saturated, {spot.saturated_share:.0%} of the spot's "
            "core: expose less"
        )
    if spot.peak < options.min_snr * noise:
        return "weak", f"peak over noise is {spot.peak / noise:.1f}, less than {options.min_snr:g}"
    limit = options.ambiguous_ratio_single if single_frame else options.ambiguous_ratio
    if rival is not None and rival.ratio > limit:
        return "ambiguous", (
            f"a second spot at ({rival.uv[0]:.0f}, {rival.uv[1]:.0f}) has {rival.ratio:.0%} of the "
            f"peak, more than {limit:.0%}"
        )
    if spot.fill < _HOLLOW:
        return "ambiguous", (
            f"the light at the centre is {spot.fill:.0%} of the spot's most: two spots that touch?"
        )
    sigma = float(np.sqrt(np.linalg.eigvalsh(spot.centre.cov_uv)[1]))
    if sigma > options.max_sigma_px:
        return "uncertain", (
            f"the centre has a sigma of {sigma:.2f} px, more than {options.max_sigma_px:g}"
        )
    return "used", f"peak over noise {spot.peak / noise:.0f}, sigma of the centre {sigma:.3f} px"
