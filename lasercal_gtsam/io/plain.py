"""Frozen data as plain dicts and lists for JSON, exact to the last digit."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.conventions import quat_from_matrix
from lasercal_gtsam.observations import Observations

_LINE_LENGTH = 160


def plain(value: Any) -> Any:
    """Dicts, lists, strings and numbers; NaN becomes None, infinities "inf" and "-inf".

    JSON has no NaN; None and the two words are read back by the types in `json_numbers`.
    """
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, np.ndarray):
        return value.tolist() if _is_plain(value) else [plain(item) for item in value]
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        number = float(value)
        if math.isfinite(number):
            return number
        return None if math.isnan(number) else str(number)
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return [plain(item) for item in value]


def _is_plain(value: np.ndarray[Any, Any]) -> bool:
    return value.dtype.kind != "f" or bool(np.isfinite(value).all())


def option_text(value: Any) -> str:
    """An option as a person writes it."""
    value = plain(value)
    if value is None or value in ([], {}):
        return "none"
    if isinstance(value, dict):
        return ", ".join(f"{name} = {option_text(item)}" for name, item in value.items())
    if isinstance(value, list):
        return ", ".join(option_text(item) for item in value)
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def pose_to_dict(T: Array) -> dict[str, Any]:
    """A transform as translation (m) and quaternion for readers, and as the exact matrix."""
    return {
        "translation_m": plain(T[:3, 3]),
        "quat_wxyz": plain(quat_from_matrix(T[None, :3, :3])[0]),
        "matrix": plain(T),
    }


def cell_to_dict(cell: Cell) -> dict[str, Any]:
    """Cameras, lasers and planes of a cell (SI units, units in the names)."""
    return {
        "cameras": {
            name: {
                "image_size": list(camera.image_size),
                "intrinsics": plain(camera.intrinsics),
                "T_base_camera": pose_to_dict(camera.T_base_camera),
            }
            for name, camera in cell.cameras.items()
        },
        "lasers": {
            name: {
                "direction_hand": plain(beam.direction_hand),
                "point_hand_m": plain(beam.point_hand),
            }
            for name, beam in cell.lasers.items()
        },
        "planes": {
            name: {"normal_base": plain(plane.normal_base), "distance_m": plane.distance}
            for name, plane in cell.planes.items()
        },
    }


def observations_to_dict(observations: Observations) -> dict[str, Any]:
    """Observations as columns; poses and covariances row-major, one row a spot."""
    count = len(observations)
    cov = observations.cov_uv.reshape(count, 4)
    return {
        "id": observations.id.tolist(),
        "plane": observations.plane.tolist(),
        "camera": observations.camera.tolist(),
        "laser": observations.laser.tolist(),
        "image_size": {name: list(size) for name, size in observations.image_size.items()},
        "uv": plain(observations.uv),
        "cov_uv": None if np.isnan(cov).all() else plain(cov),
        "T_base_hand": plain(observations.T_base_hand.reshape(count, 16)),
        **({} if observations.stop is None else {"stop": observations.stop.tolist()}),
    }


def to_json(value: Any, indent: int = 0) -> str:
    """JSON for people: short things and rows of numbers on one line, the rest indented."""
    items = value.values() if isinstance(value, dict) else value
    nested = isinstance(value, dict) or (
        isinstance(value, list) and any(isinstance(item, dict | list) for item in items)
    )
    if not nested:
        return _encode(value)
    if _is_short(value):
        compact = _encode(value)
        if len(compact) + indent <= _LINE_LENGTH:
            return compact
    pad, close = " " * (indent + 1), " " * indent
    lines = [pad + to_json(item, indent + 1) for item in items]
    if isinstance(value, dict):
        keys = [f"{pad}{_encode(key)}: " for key in value]
        lines = [key + line.lstrip(" ") for key, line in zip(keys, lines, strict=True)]
        return "{\n" + ",\n".join(lines) + f"\n{close}}}"
    return "[\n" + ",\n".join(lines) + f"\n{close}]"


_encode = json.JSONEncoder(allow_nan=False, ensure_ascii=False).encode


def _is_short(value: Any) -> bool:
    """Whether it can fit on a line at all; spares writing large things twice."""
    todo, seen = [value], 0
    while todo:
        item = todo.pop()
        seen += 1
        if seen > _LINE_LENGTH // 3:
            return False
        if isinstance(item, dict):
            todo += item.values()
        elif isinstance(item, list):
            if len(item) > _LINE_LENGTH // 3:
                return False
            todo += item
    return True
