"""Numbers of ``calibration.json``: what JSON cannot say, shapes, and what no number can be."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator

from lasercal_gtsam.frozen import LARGEST, Array

# A pixel, a length or a coefficient that is smaller is 0: its square would be.
_SMALLEST = 1e-100

# of correlations; those of a real result are symmetric to the last digit
_COVARIANCE_ROUNDING = 1e-6

_LARGEST_WHOLE = 10**300  # more do not fit into a float

INFINITIES = {"inf": math.inf, "-inf": -math.inf}


def _number(value: Any) -> Any:
    """JSON has no NaN and no infinity: null and two words stand for them."""
    if value is None:
        return math.nan
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > _LARGEST_WHOLE:
        raise ValueError("expected a number, got a whole number with hundreds of digits")
    return INFINITIES.get(value, value) if isinstance(value, str) else value


def _ordinary(value: float) -> float:
    """A number that can be squared, and divided by unless it is 0; or NaN: nothing is known."""
    if abs(value) > LARGEST:
        raise ValueError(f"expected a number up to {LARGEST:g} in size, got {value:g}")
    return 0.0 if abs(value) < _SMALLEST else value


def _array(*shape: int | None, largest: float = math.inf) -> Callable[[Any], Array]:
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"

    def convert(value: Any) -> Array:
        if not isinstance(value, list):
            raise ValueError(f"expected a list of numbers of shape {wanted}, got {value!r:.60}")
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"expected numbers of shape {wanted}, got {value!r:.60}") from None
        if not array.size:
            array = array.reshape([0 if n is None else n for n in shape] if None in shape else -1)
        if array.ndim != len(shape) or any(
            n not in (None, m) for n, m in zip(shape, array.shape, strict=True)
        ):
            raise ValueError(f"expected numbers of shape {wanted}, got shape {array.shape}")
        if (size := np.abs(array[~np.isnan(array)])).size and size.max() > largest:
            raise ValueError(f"expected numbers up to {largest:g}, got {size.max():g}")
        return array

    return convert


def _not_negative(value: float) -> float:
    if value < 0:
        raise ValueError(f"expected a sigma, 0 or more, got {value:g}")
    return value


def _share(value: float) -> float:
    if not 0.0 <= value <= 1.0 + 1e-9:
        raise ValueError(f"expected a weight from 0 to 1, got {value:g}")
    return value


Number = Annotated[float, BeforeValidator(_number)]
Sigma = Annotated[float, BeforeValidator(_number), AfterValidator(_not_negative)]
Ordinary = Annotated[float, BeforeValidator(_number), AfterValidator(_ordinary)]
Weight = Annotated[float, BeforeValidator(_number), AfterValidator(_share)]
Vector2 = Annotated[Array, PlainValidator(_array(2, largest=LARGEST))]
Vector3 = Annotated[Array, PlainValidator(_array(3, largest=LARGEST))]
Vector4 = Annotated[Array, PlainValidator(_array(4, largest=LARGEST))]
Matrix44 = Annotated[Array, PlainValidator(_array(4, 4, largest=LARGEST))]
Matrix = Annotated[Array, PlainValidator(_array(None, None))]
Rows2 = Annotated[Array, PlainValidator(_array(None, 2, largest=LARGEST))]
Rows4 = Annotated[Array, PlainValidator(_array(None, 4, largest=LARGEST))]
Rows16 = Annotated[Array, PlainValidator(_array(None, 16, largest=LARGEST))]
Size = Annotated[list[Annotated[int, Field(gt=0, le=65535)]], Field(min_length=2, max_length=2)]


def may_be_covariance(C: Array) -> bool:
    """Whether it is one up to rounding; not known of one with NaN (no degrees of freedom)."""
    variances = np.diag(C)
    if (variances < 0.0).any():
        return False
    if not np.isfinite(C).all():
        return True
    if C[variances == 0.0].any():
        return False
    root = np.sqrt(variances)
    scale = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlations = C * scale[:, None] * scale
    if not np.abs(correlations).max(initial=0.0) <= 1.0 + _COVARIANCE_ROUNDING:
        return False
    if np.abs(correlations - correlations.T).max(initial=0.0) > _COVARIANCE_ROUNDING:
        return False
    return bool(np.linalg.eigvalsh(correlations).min(initial=0.0) >= -_COVARIANCE_ROUNDING)
