"""Sub-pixel centre of a spot by a speckle-aware Gaussian fit.

With speckle the standard deviation of a pixel is in proportion to its light, so the fit's weights
are ``1 / (noise^2 + (c model)^2)`` with ``c`` from the residuals (iteratively re-weighted least
squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.difference import Image
from lasercal_gtsam.detect.gaussian import Trust, Window
from lasercal_gtsam.detect.region import Region, squared_distance
from lasercal_gtsam.frozen import Array

CORE = 0.1  # of the fitted peak: pixels that tell of speckle
# of the peak: how well a spot's profile is a Gaussian at best; keeps faint skirts from ruling the
# fit of a bright spot
PROFILE_ERROR = 0.01
_WINDOW_SIGMAS = 3.5
_ROUNDS = 4
_STEPS = 30  # at most, of one round


def cut_window(light: Image, variance: Image, centre: Array, shape: Array) -> Window:
    """Pixels within 3.5 sigma of the centre, sigma enlarged so that it is 2 px or more."""
    grown = shape + np.eye(2) * (2.0 / _WINDOW_SIGMAS) ** 2
    reach = _WINDOW_SIGMAS * np.sqrt(np.diag(grown))
    low = np.maximum(np.floor(centre - reach), 0).astype(int)
    high = np.minimum(np.ceil(centre + reach) + 1, light.shape[::-1]).astype(int)
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    v, u = np.mgrid[part].astype(np.float64)
    inside = squared_distance(u, v, centre, grown) <= _WINDOW_SIGMAS**2
    return Window(
        u=u[inside],
        v=v[inside],
        light=light[part][inside].astype(np.float64),
        variance=variance[part][inside].astype(np.float64),
        inside=inside,
    )


def aperture_centroid(window: Window, start: Array, shape: Array) -> Array:
    """Centroid of the light within 3 sigma, the aperture following it (4 rounds)."""
    centre = start
    for _ in range(4):
        inside = squared_distance(window.u, window.v, centre, shape) <= 9.0
        light = window.light[inside]
        total = float(light.sum())
        if not total > 0:
            return start
        centre = np.array([light @ window.u[inside], light @ window.v[inside]]) / total
    return centre


@dataclass(frozen=True, eq=False)
class SpotFit:
    """The fitted Gaussian and the noise model it was weighted with.

    ``p`` are the parameters of `gaussian`, ``speckle`` the contrast c, ``weights`` (n,) one over
    the variance of each pixel of the window.
    """

    p: Array
    speckle: float
    weights: Array
    settled: bool
    window: Window

    @property
    def uv(self) -> Array:
        """Centre (2,), pixels."""
        return self.p[1:3]

    @property
    def shape(self) -> Array:
        """Covariance (2, 2) of the spot, px^2."""
        return gaussian.shape_of(self.p)


def fit_spot(light: Image, variance: Image, region: Region) -> SpotFit:
    """Gaussian fit with weights that learn the speckle contrast from the residuals."""
    window = cut_window(light, variance, region.centroid, region.shape)
    start = gaussian.parameters(
        max(float(window.light.max()), 1e-9), region.centroid, region.shape, 0.0
    )
    sigma = float(np.sqrt(np.linalg.eigvalsh(region.shape)[1]))
    trust = Trust(distance_px=max(1.0, sigma), width_factor=2.5, smallest_sigma_px=0.3)
    p, settled, speckle = start, False, 0.0
    weights = _weights(window, p, speckle)
    for _ in range(_ROUNDS):
        p, settled = gaussian.fit(window, weights, p, trust, start, _STEPS)
        speckle = speckle_contrast(window, p)
        weights = _weights(window, p, speckle)
    p, settled = gaussian.fit(window, weights, p, trust, start, _STEPS)
    return SpotFit(p, speckle, weights, settled, window)


def _weights(window: Window, p: Array, speckle: float) -> Array:
    model = gaussian.value(p, window.u, window.v) - p[6]
    return np.asarray(1 / (window.variance + (speckle * model) ** 2 + (PROFILE_ERROR * p[0]) ** 2))


def speckle_contrast(window: Window, p: Array) -> float:
    """``c`` of a noise ``variance + (c model)^2`` that explains the residuals in the core."""
    model = gaussian.value(p, window.u, window.v) - p[6]
    core = model > CORE * p[0]
    m2 = model[core] ** 2
    r2 = (window.light - model - p[6])[core] ** 2
    if m2.size <= gaussian.PARAMETERS:
        return 0.0
    excess = float(m2 @ (r2 - window.variance[core])) / float(m2 @ m2)
    return float(np.sqrt(max(excess, 0.0)))
