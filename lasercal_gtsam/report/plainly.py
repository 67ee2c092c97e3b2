"""Arrays as short lists: rounded to what a figure can show, holes as None."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

PX, MM, M, SHARE = 3, 4, 6, 4
"""Decimals of pixels, millimetres, metres, and of shares and correlations."""
_DIGITS = 6


def numbers(values: npt.ArrayLike, decimals: int) -> Any:
    """Nested lists of an array of any shape, rounded; None where it is not finite."""
    array = np.round(np.asarray(values, dtype=np.float64), decimals) + 0.0
    listed = array.tolist()
    return listed if np.isfinite(array).all() else _with_holes(listed)


def number(value: float | None, digits: int = _DIGITS) -> float | None:
    """The number with so many significant digits; None where it is not finite."""
    if value is None or not np.isfinite(value):
        return None
    return float(f"{float(value):.{digits}g}")


def _with_holes(value: Any) -> Any:
    if isinstance(value, list):
        return [_with_holes(item) for item in value]
    return value if np.isfinite(value) else None
