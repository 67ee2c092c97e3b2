"""Covariance of a spot's centre: noise, speckle grains, saturation, disagreement, floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.centre import CORE, PROFILE_ERROR, SpotFit
from lasercal_gtsam.detect.difference import Mask
from lasercal_gtsam.frozen import Array

# centre error per radius of the clipped core: what is clipped hides a shifted flare
SATURATION_ERROR = 0.05


# a small spot holds few grains and tells little of its own speckle: then laser light is supposed
# to be as usual. Contrast, grain area (px^2), and how many grains that prior is worth
_PRIOR_CONTRAST = 0.15
_PRIOR_GRAIN = 3.0
_PRIOR_WEIGHT = 2.0
_MAX_GRAIN = 25.0  # px^2; a larger correlation area is a misfit of the profile, not speckle
_MAX_ABSORBED = 0.5


@dataclass(frozen=True)
class Speckle:
    """Contrast in the picture (after lens and pixels) and area of a grain, px^2."""

    contrast: float
    grain: float


def fit_covariance(spot: SpotFit, background_grain: float = 1.0) -> Array:
    """Covariance (2, 2) of the fitted centre, px^2.

    ``P J'W V W J P`` with ``P = (J'WJ)^-1`` and ``V`` the noise that the pixels have:
    background noise plus ``A (c model)^2``. Neighbours share a speckle grain of ``A`` pixels; as
    the derivatives are smooth over a grain, that is the same as independent pixels of ``A`` times
    the variance. ``background_grain`` is that factor for structure in the background.
    """
    window, p = spot.window, spot.p
    model, J = gaussian.value_and_jacobian(p, window.u, window.v)
    speckle = estimate_speckle(spot)
    variance = (
        background_grain * window.variance
        + speckle.grain * (speckle.contrast * (model - p[6])) ** 2
    )
    variance = variance + (PROFILE_ERROR * p[0]) ** 2
    WJ = spot.weights * J
    H = WJ @ J.T
    scale = 1 / np.sqrt(np.diag(H))
    P = scale[:, None] * np.linalg.pinv(scale[:, None] * H * scale, hermitian=True) * scale
    return np.asarray((P @ (WJ * variance) @ WJ.T @ P)[1:3, 1:3])


def estimate_speckle(spot: SpotFit) -> Speckle:
    """Speckle contrast and grain from the residuals in the spot's core.

    The model is ``E r_i^2 = n_i^2 + (c m_i)^2`` for a pixel and ``E r_i r_j = rho c^2 m_i m_j``
    for neighbours, with background noise ``n`` and model ``m``; then ``A = pi / -ln(rho)`` for a
    Gaussian autocorrelation. The fit's parameters absorb a share ``f`` of the residuals' power,
    and as they are smooth, of their neighbours' covariance too: both are put back. What few
    grains in much noise cannot tell is taken from the prior.
    """
    window, p = spot.window, spot.p
    model = gaussian.value(p, window.u, window.v) - p[6]
    core = model > CORE * p[0]
    residual = window.light - model - p[6]
    m2, r2, n2 = model[core] ** 2, residual[core] ** 2, window.variance[core]
    pair_power, pair_weight = _neighbours(window, residual, model, core)
    count = float(m2.size)
    contrast2, grain, absorbed = 0.0, 1.0, 0.0
    for _ in range(5):
        absorbed = min(gaussian.PARAMETERS * grain / count, _MAX_ABSORBED)
        whole = r2 / (1 - absorbed)
        contrast2 = max(float(m2 @ (whole - n2)) / float(m2 @ m2), 0.0)
        if contrast2 == 0.0:
            break
        missing = absorbed * float(m2 @ whole) / float(m2 @ m2)
        # what noise alone would make of contrast2 keeps the ratio of two small numbers small
        spread = float(np.sqrt(2 * (m2 * n2) @ (m2 * n2))) / float(m2 @ m2)
        rho = (pair_power / pair_weight + missing) / (contrast2 + spread) if pair_weight > 0 else 0
        grain = float(np.clip(np.pi / -np.log(np.clip(rho, 1e-9, 0.99)), 1.0, _MAX_GRAIN))
    # a pixel counts as far as speckle of the usual contrast would show above its noise
    visible = max(contrast2, _PRIOR_CONTRAST**2) * m2
    share = visible / (visible + n2)
    freedom = (1 - absorbed) * float(share @ share) / grain
    trust = freedom / (freedom + _PRIOR_WEIGHT)
    return Speckle(
        contrast=float(np.sqrt(trust * contrast2 + (1 - trust) * _PRIOR_CONTRAST**2)),
        grain=trust * grain + (1 - trust) * _PRIOR_GRAIN,
    )


def _neighbours(
    window: gaussian.Window, residual: Array, model: Array, core: Mask
) -> tuple[float, float]:
    """Sums of ``m_i m_j r_i r_j`` and ``(m_i m_j)^2`` over core pixels that touch."""
    product, weight = np.zeros(window.inside.shape), np.zeros(window.inside.shape)
    product[window.inside] = np.where(core, residual * model, 0.0)
    weight[window.inside] = np.where(core, model * model, 0.0)
    return (
        float((product[:, 1:] * product[:, :-1]).sum() + (product[1:] * product[:-1]).sum()),
        float((weight[:, 1:] * weight[:, :-1]).sum() + (weight[1:] * weight[:-1]).sum()),
    )


def saturation_variance(n_saturated: int) -> float:
    """Variance per axis that clipped pixels add, px^2."""
    return SATURATION_ERROR**2 * n_saturated / np.pi
