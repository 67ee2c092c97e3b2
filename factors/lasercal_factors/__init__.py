"""GTSAM factors for laser-spot calibration, usable in anybody's own graph.

Names are loaded on first use, so that importing the exceptions does not load GTSAM or numba.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_EXPORTS = {
    "BeamFrame": "beam",
    "CellChart": "chart",
    "CellKeys": "spot",
    "FactorError": "errors",
    "LaserCellFactor": "chart",
    "LaserSpotBatchFactor": "spot",
    "LaserSpotFactor": "spot",
    "LaserSpotHandFactor": "spot_hand",
    "LasercalError": "errors",
    "Loss": "batch",
    "SpotBatch": "batch",
    "State": "arrays",
    "check_jacobians": "checks",
    "custom_factor": "wrap",
    "keys_for": "spot",
}

__all__ = [
    "BeamFrame",
    "CellChart",
    "CellKeys",
    "FactorError",
    "LaserCellFactor",
    "LaserSpotBatchFactor",
    "LaserSpotFactor",
    "LaserSpotHandFactor",
    "LasercalError",
    "Loss",
    "SpotBatch",
    "State",
    "check_jacobians",
    "custom_factor",
    "keys_for",
]

if TYPE_CHECKING:
    from lasercal_factors.arrays import State
    from lasercal_factors.batch import Loss, SpotBatch
    from lasercal_factors.beam import BeamFrame
    from lasercal_factors.chart import CellChart, LaserCellFactor
    from lasercal_factors.checks import check_jacobians
    from lasercal_factors.errors import FactorError, LasercalError
    from lasercal_factors.spot import (
        CellKeys,
        LaserSpotBatchFactor,
        LaserSpotFactor,
        keys_for,
    )
    from lasercal_factors.spot_hand import LaserSpotHandFactor
    from lasercal_factors.wrap import custom_factor


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value
