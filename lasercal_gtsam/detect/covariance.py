"""Covariance of a spot's centre: noise, speckle grains, saturation, disagreement, floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.centre import CORE, PROFILE_ERROR, SpotFit
from lasercal_gtsam.frozen import Array

SATURATION_PX = (
    0.15  # centre error per root of n_saturated / pi: clipped cores hide a shifted flare
)

# a small spot holds few grains and tells little of its own speckle: then laser light is supposed
# to be as usual. Contrast, grain area (px^2), and how many grains that prior is worth
_PRIOR_CONTRAST = 0.15
_PRIOR_GRAIN = 3.0
_PRIOR_WEIGHT = 3.0
_MAX_GRAIN = 40.0  # px^2; a larger correlation area is a misfit of the profile, not speckle
_MAX_ABSORBED = 0.5


@dataclass(frozen=True)
class Speckle:
    """Contrast in the picture (after lens and pixels) and area of a grain, px^2."""

    contrast: float
    grain: float


def fit_covariance(spot: SpotFit) -> Array:
    """Covariance (2, 2) of the fitted centre, px^2.

    ``P J'W V W J P`` with ``P = (J'WJ)^-1`` and ``V`` the noise that the pixels have:
    background noise plus ``A (c model)^2``. Neighbours share a speckle grain of ``A`` pixels; as
    the derivatives are smooth over a grain, that is the same as independent pixels of ``A`` times
    the variance.
    """
    window, p = spot.window, spot.p
    model, J = gaussian.value_and_jacobian(p, window.u, window.v)
    speckle = estimate_speckle(spot)
    variance = window.variance + speckle.grain * (speckle.contrast * (model - p[6])) ** 2
    variance = variance + (PROFILE_ERROR * p[0]) ** 2
    WJ = spot.weights * J
    H = WJ @ J.T
    scale = 1 / np.sqrt(np.diag(H))
    P = scale[:, None] * np.linalg.pinv(scale[:, None] * H * scale, hermitian=True) * scale
    return np.asarray((P @ (WJ * variance) @ WJ.T @ P)[1:3, 1:3])


def estimate_speckle(spot: SpotFit) -> Speckle:
    """Speckle contrast and grain from the residuals in the spot's core.

    The grain is ``A = pi / -ln(rho)`` with ``rho`` the correlation of neighbours, for a Gaussian
    autocorrelation. The fit's parameters absorb a share ``f`` of the residuals' power, and as
    they are smooth, of their neighbours' covariance too: both are put back.
    """
    window, p = spot.window, spot.p
    model = gaussian.value(p, window.u, window.v) - p[6]
    core = model > CORE * p[0]
    residual = window.light - model - p[6]
    rho = _neighbour_correlation(spot, residual, core)
    m2, r2, n2 = model[core] ** 2, residual[core] ** 2, window.variance[core]
    count = float(m2.size)
    grain = contrast2 = 0.0
    freedom = 0.0
    for _ in range(5):
        absorbed = min(gaussian.PARAMETERS * max(grain, 1.0) / count, _MAX_ABSORBED)
        whole = min(rho * (1 - absorbed) + absorbed, 0.999) if rho > 0 else 0.0
        grain = float(np.clip(np.pi / -np.log(whole), 1.0, _MAX_GRAIN)) if whole > 0 else 1.0
        freedom = (1 - absorbed) * count / grain
        contrast2 = max(float(m2 @ (r2 / (1 - absorbed) - n2)) / float(m2 @ m2), 0.0)
    trust = freedom / (freedom + _PRIOR_WEIGHT)
    return Speckle(
        contrast=float(np.sqrt(trust * contrast2 + (1 - trust) * _PRIOR_CONTRAST**2)),
        grain=trust * grain + (1 - trust) * _PRIOR_GRAIN,
    )


def _neighbour_correlation(spot: SpotFit, residual: Array, core: gaussian.Mask) -> float:
    """Correlation of the weighted residuals of core pixels that touch."""
    grid = np.full(spot.window.inside.shape, np.nan)
    grid[spot.window.inside] = np.where(core, residual * np.sqrt(spot.weights), np.nan)
    pairs = np.concatenate([(grid[:, 1:] * grid[:, :-1]).ravel(), (grid[1:] * grid[:-1]).ravel()])
    pairs = pairs[np.isfinite(pairs)]
    power = float(np.mean(grid[np.isfinite(grid)] ** 2))
    return float(np.mean(pairs)) / power if pairs.size and power > 0 else 0.0


def saturation_variance(n_saturated: int) -> float:
    """Variance per axis that clipped pixels add, px^2."""
    return SATURATION_PX**2 * n_saturated / np.pi
