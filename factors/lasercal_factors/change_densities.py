"""Densities of a whitened innovation, compiled: expected, or a gross outlier.

- expected: bivariate t with ``nu`` degrees of freedom (sigma0 is itself an estimate),
  ``t(e; V) = |V|^-1/2 (1 + e^T V^-1 e / nu)^-(nu+2)/2 / (2 pi)``;
- gross outlier: half uniform over the picture, half falling as 1/r^2 from 3 sigma to the size
  of the picture, so that outliers that crowd near their spot are no surprise either;
- unchanged ``p``: ``(1 - eps)`` of the first, ``eps`` of the second, ``eps`` the running rate.
"""

from __future__ import annotations

import math

from lasercal_factors.kernels import jit

_CORE = 3.0  # sigma; flat part of the crowded half of the outliers


@jit
def expected_density(m, dof):
    """Bivariate t density at squared length ``m``, unit scale matrix; a Gaussian for large dof."""
    if dof < 1e7:
        return math.exp(-0.5 * (dof + 2.0) * math.log1p(m / dof)) / (2.0 * math.pi)
    return math.exp(-0.5 * m) / (2.0 * math.pi)


@jit
def outlier_density(m, area):
    """Density of a gross outlier at squared length ``m``: half uniform, half crowded.

    The crowded half is flat to `_CORE` and falls as 1/r^2 to the radius of a disc of that area.
    """
    edge = max(math.sqrt(area / math.pi), 10.0 * _CORE)
    crowd = 1.0 / (2.0 * math.pi * (0.5 + math.log(edge / _CORE)) * max(m, _CORE * _CORE))
    return 0.5 * (1.0 / area + crowd)


@jit
def gate_length(rate, area, dof):
    """Length beyond which an innovation is more probably an outlier than not.

    Fixed point of ``(1 - eps) t(r) = eps out(r)``; the right side changes slowly with r.
    """
    r2 = 25.0
    for _ in range(8):
        level = 2.0 * math.pi * rate / (1.0 - rate) * outlier_density(r2, area)
        if dof < 1e7:
            r2 = dof * (math.exp(-2.0 / (dof + 2.0) * math.log(level)) - 1.0)
        else:
            r2 = -2.0 * math.log(level)
        r2 = max(r2, _CORE * _CORE)
    return math.sqrt(r2)
