"""The robust losses of the kernels as formulas on arrays, and what they cost in precision.

``m`` is the squared whitened length of a spot's residual in units of the residual scale. A loss
``rho(m)`` has the weight ``w = rho'(m)``; the influence of a spot is ``psi = w(m) r``, a vector, so
that a loss treats all directions in the picture alike.
"""

from __future__ import annotations

import numpy as np
from lasercal_factors.batch import Loss, LossName

from lasercal_gtsam.frozen import Array

# thresholds at which an estimate is 95 % efficient for two-dimensional Gaussian residuals:
# E[w + w' m]^2 / E[w^2 m / 2] = 0.95 with m ~ chi^2 of two degrees of freedom. Those in textbooks
# (1.345, 2.385) belong to one dimension.
THRESHOLDS: dict[LossName, float] = {"huber": 1.5011, "cauchy": 2.5486, "geman-mcclure": 4.0956}


def efficient_loss(name: LossName) -> Loss:
    """The loss at its threshold of 95 % efficiency."""
    return Loss(name, THRESHOLDS[name])


def loss_weights(loss: Loss, m: Array) -> Array:
    """Weight ``rho'(m)`` of each spot, 0 to 1."""
    c2 = loss.threshold**2
    if loss.name == "huber":
        return np.asarray(np.sqrt(c2 / np.maximum(m, c2)))
    if loss.name == "cauchy":
        return np.asarray(c2 / (c2 + m))
    if loss.name == "geman-mcclure":
        return np.asarray((c2 / (c2 + m)) ** 2)
    return np.ones_like(m)


def weight_slopes(loss: Loss, m: Array) -> Array:
    """Derivative ``rho''(m)`` of the weights, not above zero."""
    c2 = loss.threshold**2
    if loss.name == "huber":
        beyond = np.maximum(m, c2)
        return np.where(m > c2, -0.5 * np.sqrt(c2 / beyond) / beyond, 0.0)
    if loss.name == "cauchy":
        return np.asarray(-c2 / (c2 + m) ** 2)
    if loss.name == "geman-mcclure":
        return np.asarray(-2.0 * c2**2 / (c2 + m) ** 3)
    return np.zeros_like(m)


def sensitivity_and_spread(loss: Loss, residuals: Array, unknowns: float) -> tuple[float, float]:
    """``a = E[psi']`` and ``b = K^2 E[psi^2]`` of one coordinate, from the fitted residuals.

    With them the covariance is ``b / a^2 (J^T J)^-1``: Huber, Robust Statistics (1981), section
    7.6, eq. (6.5), with his small-sample factor ``K = 1 + p/n var(psi') / E[psi']^2`` and ``n - p``
    below the sum of squares. It is preferred to the full sandwich, whose middle is made of single
    residuals: with few spots those are too short where the leverage is high. What it asks for is
    that being an outlier does not depend on where the spot is; a bias by outliers that agree with
    each other is not in it, as it is in no sigma.

    Parameters
    ----------
    residuals : (N, 2) whitened, in units of the scale
    unknowns : how many were estimated from them

    Returns
    -------
    a, b : for no loss 1 and the a-posteriori variance
    """
    m = np.einsum("ni,ni->n", residuals, residuals)
    w, slope = loss_weights(loss, m), weight_slopes(loss, m)
    rows = residuals.size
    derivatives = w[:, None] + 2.0 * slope[:, None] * residuals**2
    a = float(derivatives.mean())
    K = 1.0 + unknowns / rows * float(derivatives.var()) / a**2
    return a, K**2 * float(np.sum(w * w * m)) / max(rows - unknowns, 1.0)


def truncated_weights(lengths: Array, limit: float, mu: float) -> Array:
    """Weights of graduated truncated least squares (Yang et al. 2020, eq. 14), 0 to 1.

    1 below ``mu / (mu + 1)`` of the squared limit, 0 above ``(mu + 1) / mu`` of it, and
    ``limit / length sqrt(mu (mu + 1)) - mu`` between. The larger ``mu``, the sharper the cut.
    """
    shortest = np.sqrt(mu / (mu + 1.0)) * limit
    between = np.sqrt(mu * (mu + 1.0)) * limit / np.maximum(lengths, shortest) - mu
    return np.asarray(np.clip(between, 0.0, 1.0))
