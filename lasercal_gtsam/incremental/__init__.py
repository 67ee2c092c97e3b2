"""Re-calibration as spots arrive: constant time for each, and a word when something has moved."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_EXPORTS = {
    "Alarm": "update",
    "Cause": "update",
    "Event": "update",
    "IncrementalCalibrator": "calibrator",
    "Innovations": "update",
    "Missing": "update",
    "Rejection": "update",
    "Update": "update",
}

__all__ = [
    "Alarm",
    "Cause",
    "Event",
    "IncrementalCalibrator",
    "Innovations",
    "Missing",
    "Rejection",
    "Update",
]

if TYPE_CHECKING:
    from lasercal_gtsam.incremental.calibrator import IncrementalCalibrator
    from lasercal_gtsam.incremental.update import (
        Alarm,
        Cause,
        Event,
        Innovations,
        Missing,
        Rejection,
        Update,
    )


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value
