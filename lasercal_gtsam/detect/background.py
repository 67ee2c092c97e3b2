"""Structure around a spot that the pixel noise does not explain: texture, most of all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.detect.difference import Patch, clipped_sigma
from lasercal_gtsam.detect.region import Region, squared_distance

_RING_SIGMAS = 4.0
_MIN_RING = 200  # px, to tell structure from noise
_MAX_STRUCTURE = 150.0  # px^2; what is wider is a slope, which the fit's background takes up


@dataclass(frozen=True)
class Background:
    """Structure around a spot that the noise does not explain: texture, most of all.

    ``excess`` is its variance plus the noise's over the noise's, ``grain`` the factor by which it
    counts in a centre because neighbours share it.
    """

    excess: float
    grain: float


def measure_background(patch: Patch, region: Region) -> Background:
    """Variance and correlation of the light beyond 4 sigma from the spot, outliers clipped."""
    light = np.asarray(patch.light / np.sqrt(patch.variance), dtype=np.float32)
    v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
    ring = squared_distance(u, v, region.centroid, region.shape) > _RING_SIGMAS**2
    count = int(np.count_nonzero(ring))
    if count < _MIN_RING:
        return Background(1.0, 1.0)
    light = light - np.float32(np.median(light[ring]))
    spread = clipped_sigma(light[ring])
    kept = np.where(ring & (np.abs(light) <= 3 * spread), light, np.float32(0))
    # pure noise would exceed its own variance by chance by this much
    chance = 2 * np.sqrt(2 / count)
    structure = spread**2 - 1 - chance
    if structure <= 0:
        return Background(1.0, 1.0)
    pairs = float((kept[:, 1:] * kept[:, :-1]).sum() + (kept[1:] * kept[:-1]).sum())
    rho = np.clip(0.5 * pairs / count / structure, 1e-9, 0.99)
    area = float(np.clip(np.pi / -np.log(rho), 1.0, _MAX_STRUCTURE))
    return Background(1 + structure, (1 + area * structure) / (1 + structure))
