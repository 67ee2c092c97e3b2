"""Keys of a file that users bring: taken one by one, every problem named with its line."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.wording import at_most
from lasercal_gtsam.io.yaml_text import Lines, Location, parse_yaml

_MISSING = object()


class Fields:
    """A mapping and what is wrong with it; getters give None where something is wrong."""

    def __init__(
        self, data: Mapping[Any, Any], name: str, lines: Lines | None = None, at: Location = ()
    ) -> None:
        self._data, self._name, self._lines, self._at = data, name, lines, at
        self._problems: list[str] = []

    @classmethod
    def yaml(cls, content: bytes, name: str) -> Fields:
        """Fields of a YAML text.

        Raises
        ------
        DataError
            Not UTF-8, not YAML, not a mapping, or a key that is there twice.
        """
        data, lines, problems = parse_yaml(decoded(content, name), name)
        if problems:
            raise DataError(*[f"{name}:{lines.of(at)}: {at[-1]}: {text}" for at, text in problems])
        if not isinstance(data, dict):
            raise DataError(f"{name}: expected a mapping of keys to values, got {data!r:.60}")
        return cls(data, name, lines)

    def __contains__(self, key: str) -> bool:
        return key in self._data

    @property
    def keys(self) -> list[str]:
        """The keys there are."""
        return [str(key) for key in self._data]

    def inside(self, key: str) -> Fields:
        """Fields of a mapping below a key; its problems are this one's."""
        below = self._data.get(key)
        if not isinstance(below, Mapping):
            self.add(key, f"expected a mapping, got {_shown(below)}")
            below = {}
        fields = Fields(below, self._name, self._lines, (*self._at, key))
        fields._problems = self._problems
        return fields

    def add(self, key: str, text: str) -> None:
        """Note a problem."""
        line = "" if self._lines is None else f":{self._lines.of((*self._at, key))}"
        where = ".".join(str(part) for part in (*self._at, key))
        self._problems.append(f"{self._name}{line}: {where}: {text}")

    def check(self) -> None:
        """Raise `DataError` with all problems, if there are any."""
        if self._problems:
            raise DataError(*at_most(self._problems))

    def text(self, key: str, default: str | None = None) -> str | None:
        """A string."""
        value = self._data.get(key, _MISSING if default is None else default)
        if isinstance(value, str) and value:
            return value
        self.add(key, "left out" if value is _MISSING else f"expected a word, got {_shown(value)}")
        return None

    def number(self, key: str, default: float | None = None) -> float | None:
        """A finite number."""
        value = self._data.get(key, _MISSING if default is None else default)
        if _is_number(value):
            return float(value)
        self.add(
            key, "left out" if value is _MISSING else f"expected a number, got {_shown(value)}"
        )
        return None

    def size(self, width: str, height: str) -> tuple[int, int] | None:
        """Width and height of a picture, whole numbers above 0."""
        found = []
        for key in (width, height):
            value = self.number(key)
            if value is not None and (value != int(value) or value <= 0):
                self.add(key, f"expected a whole number of pixels above 0, got {value:g}")
                value = None
            found.append(value)
        if found[0] is None or found[1] is None:
            return None
        return int(found[0]), int(found[1])

    def row(self, key: str, count: int | None, names: str) -> Array | None:
        """A list of ``count`` numbers (any, if None), which ``names`` explains."""
        value = self._data.get(key, _MISSING)
        if value is _MISSING:
            self.add(key, f"left out; expected {names}")
            return None
        if not isinstance(value, list) or not all(map(_is_number, value)):
            self.add(key, f"expected a list of numbers ({names}), got {_shown(value)}")
            return None
        if count is not None and len(value) != count:
            self.add(key, f"expected {count} numbers ({names}), got {len(value)}")
            return None
        return np.array(value, dtype=np.float64)

    def matrix(self, key: str, shape: tuple[int, int] | None = None) -> Array | None:
        """``{rows, cols, data}``, flat; of the given shape, or any row or column."""
        if key not in self._data:
            self.add(key, "left out; expected a mapping {rows, cols, data}")
            return None
        below = self.inside(key)
        if below.keys == []:
            return None
        rows, cols = below.number("rows"), below.number("cols")
        data = below.row("data", None, "rows times cols of them")
        if rows is None or cols is None or data is None:
            return None
        if len(data) != rows * cols:
            below.add("data", f"expected {rows:g} x {cols:g} numbers, got {len(data)}")
        elif shape is not None and (rows, cols) != shape:
            self.add(key, f"expected {shape[0]} x {shape[1]}, got {rows:g} x {cols:g}")
        elif shape is None and data.size and 1 not in (rows, cols):
            self.add(key, f"expected one row or column, got {rows:g} x {cols:g}")
        else:
            return data
        return None

    def add_unless_pinhole(self, key: str, K: Array | None) -> None:
        """Note what is wrong with a camera matrix (9,) or (3, 3)."""
        if K is None:
            return
        M = K.reshape(3, 3)
        if not (M[0, 0] > 0 and M[1, 1] > 0):
            self.add(key, f"focal lengths must be above 0, got {M[0, 0]:g} and {M[1, 1]:g}")
        if M[1, 0] != 0 or (M[2] != [0, 0, 1]).any():
            self.add(key, f"expected [[fu, skew, u0], [0, fv, v0], [0, 0, 1]], got {M.tolist()}")


def decoded(content: bytes, name: str) -> str:
    """Text of UTF-8 bytes; `DataError` where they are none."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DataError(f"{name}:{line}: not UTF-8 text; save the file as UTF-8") from None


def silent_yaml_1_1(text: str) -> Any:
    """Plain data of a YAML text as a YAML 1.1 reader sees it (PyYAML, so Kalibr and ROS 1)."""
    from ruamel.yaml import YAML

    reader = YAML(typ="safe", pure=True)
    reader.version = (1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reader.load(text)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number of hundreds of digits
        return False


def _shown(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return f"a mapping with {', '.join(map(str, list(value)[:5]))}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
