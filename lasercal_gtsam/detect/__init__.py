"""Detect laser spots in pictures: pixel, covariance and a verdict for each picture.

`detect_spot` is the entry; `contact_sheet` draws what was found. Nothing here reads or writes
files.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_EXPORTS = {
    "Detection": "detection",
    "DetectionOptions": "options",
    "RunnerUp": "detection",
    "contact_sheet": "sheet",
    "detect_spot": "pipeline",
    "median_frame": "reference",
    "spots_in_median": "reference",
}

__all__ = [
    "Detection",
    "DetectionOptions",
    "RunnerUp",
    "contact_sheet",
    "detect_spot",
    "median_frame",
    "spots_in_median",
]

if TYPE_CHECKING:
    from lasercal_gtsam.detect.detection import Detection, RunnerUp
    from lasercal_gtsam.detect.options import DetectionOptions
    from lasercal_gtsam.detect.pipeline import detect_spot
    from lasercal_gtsam.detect.reference import median_frame, spots_in_median
    from lasercal_gtsam.detect.sheet import contact_sheet


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value
