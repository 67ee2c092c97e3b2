"""Frozen data with numpy arrays inside: checked, read-only, compared by value."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.errors import DataError

Array = npt.NDArray[np.float64]

LARGEST = 1e12
"""No pixel and no length in metres is larger; squares of such numbers can be added safely."""


class FrozenData:
    """Base for frozen dataclasses that hold arrays: value equality over all fields."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(
            _equal(getattr(self, f.name), getattr(other, f.name))
            for f in dataclasses.fields(self)  # type: ignore[arg-type]
            if f.compare
        )

    __hash__ = None  # type: ignore[assignment]


def _equal(a: Any, b: Any) -> bool:
    """Equality by value through containers; NaN, which stands for "not known", equals NaN."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        numeric = a.dtype.kind == "f" and b.dtype.kind == "f"
        return bool(np.array_equal(a, b, equal_nan=numeric))
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (a != a and b != b)
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(_equal, a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        return all(
            _equal(getattr(a, f.name), getattr(b, f.name))
            for f in dataclasses.fields(a)
            if f.compare
        )
    return bool(a == b)


def set_array(
    owner: object,
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    finite: bool = True,
    largest: float | None = None,
) -> Array:
    """Store ``value`` on a frozen dataclass as a read-only float64 array of the given shape.

    ``None`` in ``shape`` stands for any length; no number may be larger than ``largest``. Raises
    `DataError` naming the field, what was found and what was expected.
    """
    where = f"{type(owner).__name__}.{name}"
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: expected numbers of shape {wanted}, got {value!r}") from error
    matches = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not matches:
        raise DataError(f"{where}: expected shape {wanted}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise DataError(f"{where}: expected finite numbers, got {array[index]} at index {index}")
    if largest is not None and (too_large := np.abs(array) > largest).any():
        index = tuple(int(i) for i in np.argwhere(too_large)[0])
        raise DataError(
            f"{where}: expected numbers up to {largest:g}, got {array[index]:g} at index {index}"
        )
    array.flags.writeable = False
    object.__setattr__(owner, name, array)
    return array
