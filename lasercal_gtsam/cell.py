"""The robot cell as plain frozen data: intrinsics, cameras, beams, planes (SI units)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array

if TYPE_CHECKING:
    import gtsam

INTRINSIC_NAMES = ("fu", "fv", "skew", "u0", "v0", "k1", "k2", "p1", "p2")
ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole with skew, two radial and two tangential terms (method note 1.2, `Cal3DS2`).

    ``u = fu*xd + skew*yd + u0``, ``v = fv*yd + v0``; focal lengths, skew and principal point in
    pixels, distortion dimensionless. The paper's ``alpha_c`` is ``skew / fu``.
    """

    fu: float
    fv: float
    skew: float = 0.0
    u0: float = 0.0
    v0: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            try:
                number = float(value)
            except (TypeError, ValueError):
                raise DataError(f"Intrinsics.{f.name}: expected a number, got {value!r}") from None
            if not np.isfinite(number):
                raise DataError(f"Intrinsics.{f.name}: expected a finite number, got {number}")
            object.__setattr__(self, f.name, number)
        if self.fu <= 0 or self.fv <= 0:
            raise DataError(
                f"Intrinsics: focal lengths must be positive, got fu={self.fu}, fv={self.fv}"
            )

    @classmethod
    def from_vector(cls, vector: Array) -> Intrinsics:
        """Build from the nine numbers in `INTRINSIC_NAMES` order (that of `Cal3DS2.vector`)."""
        return cls(*(float(x) for x in vector))

    @property
    def vector(self) -> Array:
        """The nine numbers in `INTRINSIC_NAMES` order (that of `Cal3DS2.vector`)."""
        return np.array([getattr(self, name) for name in INTRINSIC_NAMES])

    @property
    def K(self) -> Array:
        """Camera matrix (3, 3), pixels."""
        return np.array([[self.fu, self.skew, self.u0], [0.0, self.fv, self.v0], [0.0, 0.0, 1.0]])

    @property
    def dist_coeffs(self) -> Array:
        """Distortion in OpenCV's order ``k1, k2, p1, p2, k3`` with ``k3 = 0``, shape (5,)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, 0.0])

    @property
    def alpha_c(self) -> float:
        """The paper's skew coefficient ``skew / fu``."""
        return self.skew / self.fu

    def to_gtsam(self) -> gtsam.Cal3DS2:
        """Return the same model as a `gtsam.Cal3DS2`."""
        import gtsam

        return gtsam.Cal3DS2(*self.vector)


@dataclass(frozen=True, eq=False)
class Camera(FrozenData):
    """A fixed camera: intrinsics, pose in the base (optical frame: z forward), image (w, h) px."""

    intrinsics: Intrinsics
    T_base_camera: Array
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        check_pose(set_array(self, "T_base_camera", self.T_base_camera, (4, 4)), "T_base_camera")
        object.__setattr__(self, "image_size", check_image_size(self.image_size))


@dataclass(frozen=True, eq=False)
class Beam(FrozenData):
    """The laser beam in the hand frame: unit direction and any point on it (metres).

    The direction is normalised on construction.
    """

    direction_hand: Array
    point_hand: Array

    def __post_init__(self) -> None:
        direction = set_array(self, "direction_hand", self.direction_hand, (3,))
        set_array(self, "direction_hand", _unit(direction, "Beam.direction_hand"), (3,))
        set_array(self, "point_hand", self.point_hand, (3,))


@dataclass(frozen=True, eq=False)
class Plane(FrozenData):
    """A working plane in the base frame: ``normal_base . x = distance`` (unit normal, metres).

    The paper's vector (eq. 4) is `vector` = ``distance * normal_base``. A negative distance is
    turned round, so that ``distance >= 0`` always holds. (`gtsam.OrientedPlane3` writes
    ``n.x + d = 0``; only ``graph.py`` converts.)
    """

    normal_base: Array
    distance: float

    def __post_init__(self) -> None:
        normal = set_array(self, "normal_base", self.normal_base, (3,))
        distance = float(self.distance)
        if not np.isfinite(distance):
            raise DataError(f"Plane.distance: expected a finite number, got {distance}")
        sign = -1.0 if distance < 0 else 1.0
        set_array(self, "normal_base", sign * _unit(normal, "Plane.normal_base"), (3,))
        object.__setattr__(self, "distance", sign * distance)

    @classmethod
    def from_point(cls, normal_base: Array, point_base: Array) -> Plane:
        """Plane through ``point_base`` (metres) with the given normal (any length)."""
        normal = _unit(np.asarray(normal_base, dtype=np.float64), "Plane.normal_base")
        return cls(normal, float(normal @ np.asarray(point_base, dtype=np.float64)))

    @classmethod
    def from_vector(cls, a: Array) -> Plane:
        """Plane from the paper's vector ``a = distance * normal`` (metres, eq. 4)."""
        a = np.asarray(a, dtype=np.float64)
        return cls(a, float(np.linalg.norm(a)))

    @property
    def vector(self) -> Array:
        """The paper's ``a`` (eq. 4), metres: foot of the perpendicular from the base origin."""
        return self.distance * self.normal_base


class _Named(Protocol):
    """Has cameras, lasers and planes by name."""

    @property
    def cameras(self) -> Iterable[str]: ...
    @property
    def lasers(self) -> Iterable[str]: ...
    @property
    def planes(self) -> Iterable[str]: ...


@dataclass(frozen=True)
class Cell:
    """Everything that is calibrated, by name."""

    cameras: Mapping[str, Camera]
    lasers: Mapping[str, Beam]
    planes: Mapping[str, Plane] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, kind in (("cameras", Camera), ("lasers", Beam), ("planes", Plane)):
            found: Any = getattr(self, name)
            if not isinstance(found, Mapping) or not all(
                isinstance(k, str) and isinstance(v, kind) for k, v in found.items()
            ):
                raise DataError(f"Cell.{name}: expected a dict of name -> {kind.__name__}")
            object.__setattr__(self, name, dict(found))

    def restricted(self, like: _Named) -> Cell:
        """The parts that ``like`` (a cell, or observations) has, in its order."""
        return Cell(
            {name: self.cameras[name] for name in like.cameras},
            {name: self.lasers[name] for name in like.lasers},
            {name: self.planes[name] for name in like.planes},
        )

    def with_planes(self, planes: Mapping[str, Plane]) -> Cell:
        """Return a copy with other planes."""
        return replace(self, planes=planes)


def check_pose(T: Array, name: str) -> Array:
    """Return ``T``, one or a stack of rigid transforms (..., 4, 4); else raise `DataError`."""
    R = T[..., :3, :3]
    error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    bad = (error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    bad |= np.abs(T[..., 3, :] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=-1) > 0
    if np.any(bad):
        at = "" if T.ndim == 2 else f" at index {int(np.argmax(bad))}"
        raise DataError(
            f"{name}{at}: expected a rigid transform (rotation matrix orthonormal to "
            f"{ROTATION_TOLERANCE:g} with determinant +1, last row 0 0 0 1); orthonormality error "
            f"{float(np.max(error)):.2g}, determinant {float(np.min(np.linalg.det(R))):.6g}"
        )
    return T


def check_image_size(size: Any) -> tuple[int, int]:
    """Return ``(width, height)`` as positive ints or raise `DataError`."""
    try:
        width, height = size
        if int(width) != width or int(height) != height or width <= 0 or height <= 0:
            raise ValueError
    except (TypeError, ValueError):
        raise DataError(f"image_size: expected (width, height) in pixels, got {size!r}") from None
    return int(width), int(height)


def _unit(v: Array, name: str) -> Array:
    length = float(np.linalg.norm(v))
    if not length > 0:
        raise DataError(f"{name}: expected a direction, got the zero vector")
    # leave a vector that is unit to rounding untouched: saving and loading must be exact
    return v if abs(length - 1.0) < 4e-16 else np.asarray(v / length)
