"""What the figures share: which spots were used, and a fair sample where there are too many."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.projection import spot_on_ray

Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

MOST_SPOTS = 1500
"""Spots that a figure shows one by one; of more it shows a sample, and says so."""


def rejected_spots(calibration: Calibration) -> Mask:
    """(N,) which spots were left out of the fit, with a reason or by a weight of zero."""
    named = np.array([why is not None for why in calibration.spots.rejected], dtype=np.bool_)
    return np.asarray(named | ~(calibration.spots.weight > 0))


def used_spots(calibration: Calibration) -> Mask:
    """(N,) which spots the fit used."""
    return ~rejected_spots(calibration)


def sampled(rows: Index, most: int = MOST_SPOTS) -> Index:
    """At most so many of the rows, evenly over their order."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]


def places_of_spots(calibration: Calibration, rows: Index) -> Array:
    """(len(rows), 3) where the camera saw these spots on their planes (12), base, metres.

    NaN where a ray misses its plane.
    """
    seen = calibration.inputs.observations
    return (
        spot_on_ray(
            calibration.cell,
            seen.uv[rows],
            plane=seen.plane[rows].tolist(),
            camera=seen.camera[rows].tolist(),
        )
        if len(rows)
        else np.zeros((0, 3))
    )
