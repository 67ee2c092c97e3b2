"""Choose the centre: the fit where centroids bear it out, else a centroid that cannot run away.

Measured with a tenth of the power in a shifted skirt and speckle of contrast 0.3: up to a peak of
twice saturation the fit is best (0.06 to 0.13 px); at 4, 8 and 30 times it is off by 0.15, 0.34
and 1.5 px and the centroid above half of the clipped peak by 0.06, 0.07 and 0.20 px. On
photographs of saturated spots that centroid comes nearest to the one in an unsaturated channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect.background import Background
from lasercal_gtsam.detect.centre import SpotFit, aperture_centroid
from lasercal_gtsam.detect.covariance import fit_covariance, saturation_variance
from lasercal_gtsam.detect.region import Region
from lasercal_gtsam.frozen import Array

CORE_LEVEL = 0.5  # of the peak, for the centroid of a clipped spot
CLIPPED_SHARE = 0.65  # of the core's pixels: above, the fit would follow the flare
# fit and centroid agree within the larger of these: pixels, and sigmas of the spot
_AGREE_PX, _AGREE_SIGMAS = 0.4, 0.45


@dataclass(frozen=True, eq=False)
class Centre:
    """Centre (2,) px, its covariance (2, 2) px^2, the spot's shape (2, 2) px^2, the method."""

    uv: Array
    cov_uv: Array
    shape: Array
    method: str


def choose_centre(
    spot: SpotFit,
    region: Region,
    core: Region,
    n_saturated: int,
    background: Background,
    floor_px: float,
) -> Centre:
    """Choose, and let the covariance know how far fit and centroid are apart.

    Parameters
    ----------
    spot : the fit
    region, core : the spot above 20 % and above 50 % of its peak
    n_saturated : clipped pixels of the spot
    background : structure around the spot
    floor_px : standard deviation that is always added
    """
    always = (floor_px**2 + saturation_variance(n_saturated)) * np.eye(2)
    if n_saturated > CLIPPED_SHARE * core.area:
        apart = core.centroid - region.centroid
        cov = always + np.outer(apart, apart)
        return Centre(core.centroid, cov, region.shape, "centroid")
    noise = fit_covariance(spot, background.grain)
    apart = spot.uv - region.centroid
    if spot.settled and _borne_out(spot, region):
        cov = always + noise + 0.25 * np.outer(apart, apart)
        return Centre(spot.uv, cov, spot.shape, "fit")
    return Centre(
        region.centroid, always + noise + np.outer(apart, apart), region.shape, "centroid"
    )


def _borne_out(spot: SpotFit, region: Region) -> bool:
    """One of two centroids agrees with the fit: above 20 % of the peak, or within 3 sigma."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(region.shape)[1]))
    tolerance = max(_AGREE_PX, _AGREE_SIGMAS * sigma)
    aperture = aperture_centroid(spot.window, region.centroid, region.shape)
    return any(
        float(np.linalg.norm(spot.uv - other)) <= tolerance for other in (region.centroid, aperture)
    )
