"""Spots as JSON lines: what a robot program sends, checked line by line.

A spot is ``{"id": "s17", "plane": "table", "uv": [312.4, 208.9], "T_base_hand": [[...], ...]}``,
the pose in metres; or in place of the matrix the pose's columns as in ``poses.csv``, under the
convention that ``capture.yaml`` states. ``sigma_px`` or ``cov_uv`` (px^2), ``camera`` and ``laser``
may be added. Other lines: ``{"image_size": [640, 480]}`` (or by camera), ``{"reset": {"camera":
"left"}}`` and ``{"dismiss": true}``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture_head import PosesHead
from lasercal_gtsam.io.capture_rows import (
    DEFAULT_LASER,
    LARGEST_CORRELATION,
    LARGEST_NUMBER,
    LARGEST_PLAUSIBLE_M,
    LARGEST_SIGMA_PX,
    OUTSIDE_TOLERANCE_PX,
    SMALLEST_SIGMA_PX,
    inverse_poses,
)
from lasercal_gtsam.io.conventions import (
    rotation_format,
    rotation_problems,
    rotations_from_columns,
)
from lasercal_gtsam.io.wording import cannot_be_a_name, did_you_mean, quoted, some
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.units import MM_PER_M

PARTS = ("camera", "laser", "plane")
_POSITION = ("x", "y", "z")


@dataclass(frozen=True)
class Reset:
    """A wish that a part be freed because it was moved."""

    part: str
    name: str


@dataclass(frozen=True)
class Dismiss:
    """A wish that an alarm be closed: nothing has moved."""


@dataclass(frozen=True)
class Sizes:
    """Image sizes by camera, pixels; "" stands for the only camera."""

    image_size: Mapping[str, tuple[int, int]]


class LineError(DataError):
    """A line that cannot be taken; ``id`` is that of its spot, as far as it could be read."""

    def __init__(self, text: str, id: str | None = None) -> None:
        super().__init__(text)
        self.id = id


class SpotLines:
    """Reads lines; it knows the image sizes and what there is only one of.

    Parameters
    ----------
    image_size : camera name to (width, height), pixels; may be empty until a line says it
    poses : how poses are written where they come as columns; None: only as matrices
    planes : names that a plane may have; None: any
    lasers : the lasers so far; a spot's laser may be left out where it is the only one
    sigma_px : given to spots without noise of their own; None: they are left without
    """

    def __init__(
        self,
        image_size: Mapping[str, tuple[int, int]],
        *,
        poses: PosesHead | None = None,
        planes: Sequence[str] | None = None,
        lasers: Sequence[str] = (),
        sigma_px: float | None = None,
    ) -> None:
        self.image_size = dict(image_size)
        self._poses, self._planes, self._lasers = poses, planes, dict.fromkeys(lasers)
        self._sigma_px = sigma_px
        self._columns = () if poses is None else rotation_format(poses.rotation).columns
        pose = ("T_base_hand", *(() if poses is None else (*_POSITION, *self._columns)))
        self._keys = ("id", "plane", "uv", *pose, "sigma_px", "cov_uv", "camera", "laser")

    def read(self, line: bytes) -> Observations | Reset | Dismiss | Sizes:
        """What one line says; a spot is given as `Observations` of one.

        Raises
        ------
        LineError
            The line is not JSON (with the column), or says something that cannot be.
        """
        data = _object(line)
        if "image_size" in data:
            return self._sizes(data)
        if "reset" in data:
            return _reset(data)
        if "dismiss" in data:
            if data != {"dismiss": True}:
                raise LineError(f'dismiss: expected {{"dismiss": true}}, got {_shown(data)}')
            return Dismiss()
        name = _label(data)
        try:
            return self._spot(name, data)
        except DataError as error:
            raise LineError("; ".join(error.problems), name) from None

    def _sizes(self, data: Mapping[str, Any]) -> Sizes:
        said = data["image_size"]
        by_camera = said if isinstance(said, dict) else {"": said}
        good = len(data) == 1 and bool(by_camera) and all(map(_is_size, by_camera.values()))
        if not good:
            raise LineError(
                'image_size: expected {"image_size": [width, height]} in pixels, or {"image_size'
                f'": {{"<camera>": [width, height], ...}}}}, got {_shown(data)}'
            )
        return Sizes({name: (size[0], size[1]) for name, size in by_camera.items()})

    def _spot(self, name: str, data: Mapping[str, Any]) -> Observations:
        unknown = [key for key in data if key not in self._keys]
        if unknown:
            near = did_you_mean(unknown[0], self._keys)
            raise DataError(
                f"unknown key {quoted(unknown[0])}{near}; allowed are {some(self._keys, 30)}"
            )
        camera = self._camera(data)
        return Observations(
            uv=self._pixel(data, self.image_size[camera])[None],
            cov_uv=self._covariance(data)[None],
            T_base_hand=self._pose(data)[None],
            camera=np.array([camera]),
            laser=np.array([self._laser(data)]),
            plane=np.array([self._plane(data)]),
            id=np.array([name]),
            image_size=self.image_size,
        )

    def _camera(self, data: Mapping[str, Any]) -> str:
        if not self.image_size:
            raise DataError(
                'the image size is not known yet: send a line {"image_size": [width, height]} '
                "first, or name a CAPTURE whose capture.yaml says it"
            )
        return _only("camera", data, tuple(self.image_size))

    def _laser(self, data: Mapping[str, Any]) -> str:
        laser = DEFAULT_LASER
        if "laser" in data or self._lasers:
            laser = _only("laser", data, tuple(self._lasers), others=True)
        self._lasers[laser] = None
        return laser

    def _plane(self, data: Mapping[str, Any]) -> str:
        plane = _name("plane", data)
        if self._planes is not None and plane not in self._planes:
            raise DataError(
                f"plane: unknown plane {quoted(plane)}{did_you_mean(plane, self._planes)}; "
                f"capture.yaml has {some(list(self._planes))}"
            )
        return plane

    def _pixel(self, data: Mapping[str, Any], size: tuple[int, int]) -> Array:
        uv = _numbers("uv", data, (2,), "[u, v] in pixels")
        for axis, value, pixels in zip("uv", uv, size, strict=True):
            if not -OUTSIDE_TOLERANCE_PX <= value <= pixels - 1 + OUTSIDE_TOLERANCE_PX:
                raise DataError(
                    f"uv: {axis} = {value:g} lies outside the picture, whose pixels go from 0 to "
                    f"{pixels - 1}"
                )
        return uv

    def _covariance(self, data: Mapping[str, Any]) -> Array:
        if "sigma_px" in data and "cov_uv" in data:
            raise DataError("sigma_px, cov_uv: give one of them")
        if "cov_uv" in data:
            cov = _numbers("cov_uv", data, (2, 2), "[[uu, uv], [uv, vv]] in px^2")
            least, product = np.diag(cov).min(), float(cov[0, 0] * cov[1, 1])
            symmetric = abs(cov[0, 1] - cov[1, 0]) <= 1e-9 * (cov[0, 0] + cov[1, 1])
            inside = least >= SMALLEST_SIGMA_PX**2 and np.diag(cov).max() <= LARGEST_SIGMA_PX**2
            apart = inside and (abs(cov[0, 1]) <= LARGEST_CORRELATION * math.sqrt(product))
            if not (symmetric and apart):
                raise DataError(
                    f"cov_uv: expected a symmetric, positive definite matrix, got {cov.tolist()}"
                )
            return cov
        sigma = self._sigma_px
        if "sigma_px" in data:
            sigma = float(_numbers("sigma_px", data, (), "a number above 0"))
            if sigma < SMALLEST_SIGMA_PX:
                least = f"above 0 (at least {SMALLEST_SIGMA_PX:g})"
                raise DataError(f"sigma_px: expected a number {least}, got {sigma:g}")
            if sigma > LARGEST_SIGMA_PX:
                raise DataError(
                    f"sigma_px: expected a number up to {LARGEST_SIGMA_PX:g}, got {sigma:g}"
                )
        return np.full((2, 2), np.nan) if sigma is None else sigma**2 * np.eye(2)

    def _pose(self, data: Mapping[str, Any]) -> Array:
        if "T_base_hand" in data:
            extra = [key for key in (*_POSITION, *self._columns) if key in data]
            if extra:
                raise DataError(f"T_base_hand, {extra[0]}: the pose is given twice")
            return _rigid(_numbers("T_base_hand", data, (4, 4), "a 4x4 matrix, metres"))
        if self._poses is None:
            raise DataError("T_base_hand: left out; expected a 4x4 matrix, metres")
        position = np.array([float(_numbers(k, data, (), "a number")) for k in _POSITION])
        values = np.array([[float(_numbers(k, data, (), "a number")) for k in self._columns]])
        problems = rotation_problems(self._poses.rotation, values)
        if problems:
            raise DataError(f"{', '.join(self._columns)}: {problems[0][1]}")
        R = rotations_from_columns(self._poses.rotation, values)[0]
        T = _near(make_pose(R, position / MM_PER_M if self._poses.length == "mm" else position))
        return inverse_poses(T[None])[0] if self._poses.transform == "T_hand_base" else T


def _rigid(T: Array) -> Array:
    problems = rotation_problems("matrix", T[None, :3, :3].reshape(1, 9))
    if problems:
        raise DataError(f"T_base_hand: {problems[0][1]}")
    if not np.array_equal(T[3], [0, 0, 0, 1]):
        raise DataError(f"T_base_hand: expected the last row 0, 0, 0, 1, got {T[3].tolist()}")
    R = rotations_from_columns("matrix", T[None, :3, :3].reshape(1, 9))[0]
    return _near(make_pose(R, T[:3, 3]))


def _near(T: Array) -> Array:
    """Refuse a pose in another unit."""
    far = float(np.linalg.norm(T[:3, 3]))
    if far > LARGEST_PLAUSIBLE_M:
        raise DataError(f"the pose says that the hand is {far:.4g} m away; is the unit mm?")
    return T


def _object(line: bytes) -> dict[str, Any]:
    try:
        data = json.loads(
            line.decode("utf-8"), object_pairs_hook=_once, parse_constant=_not_a_number
        )
    except UnicodeDecodeError as error:
        raise LineError(f"column {error.start + 1}: not UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise LineError(f"column {error.colno}: not JSON: {error.msg}") from None
    except RecursionError:
        raise LineError("not JSON: nested too deeply") from None
    except ValueError:  # Python's limit of digits
        raise LineError("a whole number with thousands of digits") from None
    if not isinstance(data, dict):
        raise LineError(f"expected an object {{...}}, got {_shown(data)}")
    return data


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        label = data.get("id")
        raise LineError(
            f"the key {quoted(twice)} is there twice", None if label is None else str(label)
        )
    return data


def _not_a_number(word: str) -> float:
    raise LineError(f"expected finite numbers, got {word}")


def _label(data: Mapping[str, Any]) -> str:
    try:
        return _name("id", data)
    except DataError as error:
        raise LineError(str(error)) from None


def _name(key: str, data: Mapping[str, Any]) -> str:
    """A name, which may be written as a whole number."""
    value = data.get(key)
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if not isinstance(value, str) or not value.strip():
        found = _shown(value) if key in data else "nothing"
        raise DataError(f"{key}: expected a name, got {found}")
    if (odd := cannot_be_a_name(value.strip())) is not None:
        raise DataError(f"{key}: {odd}")
    return value.strip()


def _only(key: str, data: Mapping[str, Any], names: tuple[str, ...], others: bool = False) -> str:
    """The name given, or the only one there is; with ``others`` new names may be given."""
    if key not in data:
        if len(names) == 1:
            return names[0]
        raise DataError(f"{key}: left out, but there are {some(list(names))}: say which")
    name = _name(key, data)
    if name not in names and not others:
        near = did_you_mean(name, names)
        raise DataError(f"{key}: unknown {key} {quoted(name)}{near}; there are {some(list(names))}")
    return name


def _numbers(key: str, data: Mapping[str, Any], shape: tuple[int, ...], expected: str) -> Array:
    value = data.get(key)
    if key not in data:
        raise DataError(f"{key}: left out; expected {expected}")
    numbers: list[float] = []
    if not (_collect(value, shape, numbers) and all(map(math.isfinite, numbers))):
        raise DataError(f"{key}: expected {expected}, got {_shown(value)}")
    return np.array(numbers, dtype=np.float64).reshape(shape)


def _collect(value: Any, shape: tuple[int, ...], into: list[float]) -> bool:
    if not shape:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        into.append(float(value) if abs(value) <= LARGEST_NUMBER else math.inf)
        return True
    if not isinstance(value, list) or len(value) != shape[0]:
        return False
    return all(_collect(item, shape[1:], into) for item in value)


def _is_size(size: Any) -> bool:
    return (
        isinstance(size, list)
        and len(size) == 2
        and all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in size)
    )


def _reset(data: Mapping[str, Any]) -> Reset:
    said = data["reset"]
    good = len(data) == 1 and isinstance(said, dict) and len(said) == 1
    part, name = next(iter(said.items())) if good else ("", "")
    if part not in PARTS or not isinstance(name, str):
        raise LineError(
            'reset: expected {"reset": {"camera": "<name>"}}, or laser or plane, got '
            f"{_shown(data)}"
        )
    return Reset(part, name)


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
