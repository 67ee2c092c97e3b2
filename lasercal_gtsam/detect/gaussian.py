"""Elliptic Gaussian on a constant background: value, Jacobian, and its weighted fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect.difference import Mask
from lasercal_gtsam.frozen import Array

# parameters: amplitude, u, v, l1, l2, l3, background; with L = [[l1, l2], [0, l3]] the shape's
# inverse covariance is L'L, positive definite for any l1, l3 > 0
PARAMETERS = 7


@dataclass(frozen=True, eq=False)
class Window:
    """Pixels around a spot: coordinates, light and noise variance, arrays (n,), float64.

    ``inside`` is the mask (height, width) of the n pixels in their bounding box.
    """

    u: Array
    v: Array
    light: Array
    variance: Array
    inside: Mask


def parameters(amplitude: float, uv: Array, shape: Array, background: float) -> Array:
    """Pack a Gaussian of the given covariance ``shape`` (2, 2), px^2."""
    L = np.linalg.cholesky(np.linalg.inv(shape)).T
    return np.array([amplitude, uv[0], uv[1], L[0, 0], L[0, 1], L[1, 1], background])


def shape_of(p: Array) -> Array:
    """Covariance (2, 2) of the Gaussian, px^2."""
    L = np.array([[p[3], p[4]], [0.0, p[5]]])
    inverse = np.linalg.inv(L)
    return np.asarray(inverse @ inverse.T)


def value(p: Array, u: Array, v: Array) -> Array:
    """Light of the model at the pixels, (n,)."""
    a, b = _whitened(p, u, v)
    return np.asarray(p[0] * np.exp(-0.5 * (a * a + b * b)) + p[6])


def value_and_jacobian(p: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Light (n,) and its derivatives (7, n) with respect to the parameters."""
    a, b = _whitened(p, u, v)
    g = np.exp(-0.5 * (a * a + b * b))
    model = p[0] * g
    ma, mb = model * a, model * b
    du, dv = u - p[1], v - p[2]
    J = np.empty((PARAMETERS, len(u)))
    J[0] = g
    J[1] = ma * p[3]
    J[2] = ma * p[4] + mb * p[5]
    J[3] = -ma * du
    J[4] = -ma * dv
    J[5] = -mb * dv
    J[6] = 1.0
    return model + p[6], J


def _whitened(p: Array, u: Array, v: Array) -> tuple[Array, Array]:
    du, dv = u - p[1], v - p[2]
    return p[3] * du + p[4] * dv, p[5] * dv


@dataclass(frozen=True)
class Trust:
    """Where a fit may go: how far from the start's centre, and how much wider or narrower."""

    distance_px: float
    width_factor: float
    smallest_sigma_px: float


def fit(
    window: Window, weights: Array, start: Array, trust: Trust, origin: Array, iterations: int
) -> tuple[Array, bool]:
    """Minimise ``sum weights (light - model)^2`` by Levenberg-Marquardt inside a trust region.

    Steps that leave the region about ``origin`` (a parameter vector) are refused like steps that
    raise the cost. Returns the parameters and whether the fit came to rest.
    """
    p = start.copy()
    model, J = value_and_jacobian(p, window.u, window.v)
    residual = window.light - model
    cost = float(weights @ (residual * residual))
    damping = 1e-3
    for _ in range(iterations):
        WJ = weights * J
        H, gradient = WJ @ J.T, WJ @ residual
        diagonal = np.maximum(np.diag(H), 1e-12 * np.max(np.diag(H)))
        while True:
            step = np.linalg.solve(H + np.diag(damping * diagonal), gradient)
            trial = p + step
            if inside_trust(trial, origin, trust):
                trial_model, trial_J = value_and_jacobian(trial, window.u, window.v)
                trial_residual = window.light - trial_model
                trial_cost = float(weights @ (trial_residual * trial_residual))
                if trial_cost <= cost:
                    break
            damping *= 8
            if damping > 1e8:
                # nowhere to go: a minimum to rounding, or the wall of the trust region
                return p, _flat(gradient, diagonal, cost)
        moved = float(np.hypot(step[1], step[2]))
        gained = cost - trial_cost
        p, J, residual, cost = trial, trial_J, trial_residual, trial_cost
        damping = max(damping / 8, 1e-9)
        if moved < 1e-4 and gained <= 1e-5 * cost:
            return p, True
    return p, False


def _flat(gradient: Array, diagonal: Array, cost: float) -> bool:
    """The gradient is small in units of its own curvature and cost."""
    return bool(np.max(gradient**2 / diagonal) <= 1e-4 * cost)


def inside_trust(p: Array, origin: Array, trust: Trust) -> bool:
    """The parameters lie within the trust region about ``origin``."""
    if not np.isfinite(p).all() or p[0] <= 0 or p[3] <= 0 or p[5] <= 0:
        return False
    if np.hypot(p[1] - origin[1], p[2] - origin[2]) > trust.distance_px:
        return False
    small, large = np.linalg.eigvalsh(shape_of(p))
    low, high = np.linalg.eigvalsh(shape_of(origin))
    factor = trust.width_factor**2
    return bool(small >= max(low / factor, trust.smallest_sigma_px**2) and large <= high * factor)
