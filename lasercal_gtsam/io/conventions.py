"""Rotations as robot controllers and files write them, and rotation matrices.

Every format is one of four kinds (quaternion, matrix, rotation vector, three angles about axes)
with its column names, its axes and its unit. The kinds are converted here in plain numpy over all
rows at once, without singular cases: any rotation written and read again is the same matrix to
rounding, also where the middle angle locks the other two.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.wording import at_most, did_you_mean
from lasercal_gtsam.rotations import nearest_rotation

# What rounding to three decimals does to a unit quaternion or a rotation matrix; more than that
# is not rounding but another convention or a slip.
ROUNDING_TOLERANCE = 1e-3
# Matrices this close to a rotation are taken as they are, so that files come back exactly.
EXACT_TOLERANCE = 1e-12


@dataclass(frozen=True)
class RotationFormat:
    """How a file writes a rotation.

    Attributes
    ----------
    name : name in ``capture.yaml``
    kind : what the numbers are
    columns : column names in the order of the numbers
    order : axes of three angles, as in scipy: lower case about fixed axes, upper case about
        moving axes, first angle first
    unit : unit of the angles or of the rotation vector ("" for quaternion and matrix)
    meaning : formula of the rotation matrix, for messages and documentation
    """

    name: str
    kind: Literal["quaternion", "matrix", "rotvec", "euler"]
    columns: tuple[str, ...]
    order: str
    unit: Literal["", "deg", "rad"]
    meaning: str


_QUAT_WXYZ, _RXYZ, _ABC = ("qw", "qx", "qy", "qz"), ("rx", "ry", "rz"), ("a", "b", "c")
_MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
_EULER_COLUMNS = ("e1", "e2", "e3")

ROTATION_FORMATS: Mapping[str, RotationFormat] = MappingProxyType(
    {
        fmt.name: fmt
        for fmt in (
            RotationFormat("quat_wxyz", "quaternion", _QUAT_WXYZ, "", "", "unit quaternion"),
            RotationFormat(
                "quat_xyzw", "quaternion", ("qx", "qy", "qz", "qw"), "", "", "unit quaternion"
            ),
            RotationFormat("matrix", "matrix", _MATRIX, "", "", "row i, column j is r<i><j>"),
            RotationFormat("rotvec_rad", "rotvec", _RXYZ, "", "rad", "exp([r]x)"),
            RotationFormat("rotvec_deg", "rotvec", _RXYZ, "", "deg", "exp([r]x)"),
            RotationFormat("staubli", "euler", _RXYZ, "XYZ", "deg", "Rx(rx) Ry(ry) Rz(rz)"),
            RotationFormat("kuka", "euler", _ABC, "ZYX", "deg", "Rz(a) Ry(b) Rx(c)"),
            RotationFormat("fanuc", "euler", ("w", "p", "r"), "xyz", "deg", "Rz(r) Ry(p) Rx(w)"),
            RotationFormat("yaskawa", "euler", _RXYZ, "xyz", "deg", "Rz(rz) Ry(ry) Rx(rx)"),
            RotationFormat("abb", "quaternion", _QUAT_WXYZ, "", "", "q1 = qw, ..., q4 = qz"),
            RotationFormat("ur", "rotvec", _RXYZ, "", "rad", "exp([r]x)"),
            RotationFormat("kawasaki", "euler", ("o", "a", "t"), "ZYZ", "deg", "Rz(o) Ry(a) Rz(t)"),
            RotationFormat("mitsubishi", "euler", _ABC, "xyz", "deg", "Rz(c) Ry(b) Rx(a)"),
        )
    }
)
"""The named formats; ``euler:<order>:<deg|rad>`` adds all orders of three angles."""

ROTATION_CHOICES = (*ROTATION_FORMATS, "euler:<order>:<deg|rad>")


def rotation_format(name: str) -> RotationFormat:
    """Look up a format by its name in ``capture.yaml``.

    Raises
    ------
    DataError
        Unknown name; the message lists the choices and the nearest one.
    """
    if name in ROTATION_FORMATS:
        return ROTATION_FORMATS[name]
    if name.startswith("euler"):
        return _euler_format(name)
    raise DataError(
        f"rotation: {name!r} is not a known format{did_you_mean(name, ROTATION_FORMATS)}; "
        f"allowed are {', '.join(ROTATION_CHOICES)}"
    )


def _euler_format(name: str) -> RotationFormat:
    match = re.fullmatch(r"euler:([xyz]{3}|[XYZ]{3}):(deg|rad)", name)
    order = match[1] if match else ""
    if match is None or order[0] == order[1] or order[1] == order[2]:
        raise DataError(
            f"rotation: {name!r} is not of the form euler:<order>:<deg|rad>; <order> is three "
            "axes, neighbours different: lower case about fixed axes (euler:xyz:deg is "
            "Rz(e3) Ry(e2) Rx(e1)), upper case about moving axes (euler:ZYX:deg is "
            "Rz(e1) Ry(e2) Rx(e3))"
        )
    factors = [f"R{axis.lower()}(e{k})" for k, axis in enumerate(order, start=1)]
    meaning = " ".join(factors if order.isupper() else reversed(factors))
    unit: Literal["deg", "rad"] = "deg" if match[2] == "deg" else "rad"
    return RotationFormat(name, "euler", _EULER_COLUMNS, order, unit, meaning)


def rotation_columns(fmt: str) -> tuple[str, ...]:
    """Column names of a format, in the order of the numbers (lower case)."""
    return rotation_format(fmt).columns


def rotations_from_columns(fmt: str, values: Array) -> Array:
    """Rotation matrices from the numbers of a file.

    Parameters
    ----------
    fmt : name of the format
    values : (N, k) array
        Numbers in the order of `rotation_columns`, in the format's own unit.

    Returns
    -------
    (N, 3, 3) array
        The matrix that the numbers mean; for a hand pose given as ``T_base_hand`` it maps hand
        coordinates into base coordinates. Quaternions are normalised, and matrices rounded to a
        few decimals are replaced by the nearest rotation.

    Raises
    ------
    DataError
        Unknown format, wrong number of columns, or rows that are no rotation (all of them are
        named).
    """
    description = rotation_format(fmt)
    values = _check_shape(description, values)
    problems = rotation_problems(fmt, values)
    if problems:
        raise DataError(*at_most([f"rotation, row {k}: {text}" for k, text in problems]))
    match description.kind:
        case "quaternion":
            return matrix_from_quat(_to_wxyz(description, values))
        case "matrix":
            return _clean_matrices(values.reshape(-1, 3, 3))
        case "rotvec":
            return matrix_from_rotvec(_to_radians(description, values))
        case "euler":
            return matrix_from_euler(description.order, _to_radians(description, values))


def columns_from_rotations(fmt: str, R: Array) -> Array:
    """The numbers that a file of this format holds for rotation matrices (N, 3, 3): (N, k).

    Quaternions have ``qw >= 0``, rotation vectors at most half a turn, the middle one of three
    angles lies in [-90, 90] deg, or in [0, 180] deg where first and third axis are the same.
    """
    description = rotation_format(fmt)
    R = np.asarray(R, dtype=np.float64).reshape(-1, 3, 3)
    match description.kind:
        case "quaternion":
            return _from_wxyz(description, quat_from_matrix(R))
        case "matrix":
            return R.reshape(-1, 9).copy()
        case "rotvec":
            angles = rotvec_from_matrix(R)
        case "euler":
            angles = euler_from_matrix(description.order, R)
    return np.rad2deg(angles) if description.unit == "deg" else angles


def rotation_problems(fmt: str, values: Array) -> list[tuple[int, str]]:
    """Rows that are no rotation, as pairs (row index, what is wrong); empty if all are good."""
    description = rotation_format(fmt)
    values = _check_shape(description, values)
    finite = np.isfinite(values).all(axis=1)
    problems = [
        (int(k), "expected finite numbers, got " + _numbers(values[k]))
        for k in np.flatnonzero(~finite)
    ]
    rows = np.flatnonzero(finite)
    if description.kind == "quaternion":
        norm = np.linalg.norm(values[rows], axis=1)
        problems += [
            (int(k), f"quaternion of norm {norm[i]:.6g}, expected 1 (within {ROUNDING_TOLERANCE})")
            for i, k in enumerate(rows)
            if not abs(norm[i] - 1) <= ROUNDING_TOLERANCE
        ]
    elif description.kind == "matrix":
        M = values[rows].reshape(-1, 3, 3)
        problems += [(int(rows[i]), text) for i, text in _matrix_problems(M)]
    return sorted(problems)


def rounding_of_rotations(fmt: str, values: Array, R: Array) -> float:
    """How far the numbers of a file are from the clean rotations read from them (largest element).

    Zero for formats that cannot be inconsistent (angles, rotation vectors).
    """
    description = rotation_format(fmt)
    if description.kind == "quaternion":
        return float(np.abs(np.linalg.norm(values, axis=1) - 1).max(initial=0.0))
    if description.kind == "matrix":
        return float(np.abs(values.reshape(-1, 3, 3) - R).max(initial=0.0))
    return 0.0


# --- the four kinds, radians and (N, ...) arrays ------------------------------------------------


def matrix_from_quat(quat_wxyz: Array) -> Array:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in the order w, x, y, z (any norm > 0)."""
    q = quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
    w, x, y, z = q.T
    R = np.empty((len(q), 3, 3))
    R[:, 0, 0] = 1 - 2 * (y * y + z * z)
    R[:, 1, 1] = 1 - 2 * (x * x + z * z)
    R[:, 2, 2] = 1 - 2 * (x * x + y * y)
    R[:, 0, 1], R[:, 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    R[:, 0, 2], R[:, 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    R[:, 1, 2], R[:, 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return R


def quat_from_matrix(R: Array) -> Array:
    """Unit quaternions (N, 4) in the order w, x, y, z, with w >= 0, of matrices (N, 3, 3).

    Row k of the symmetric matrix ``4 q q'`` is q times 4 q_k; the row of the largest component
    never cancels (Shepperd, J. Guidance and Control 1, 1978).
    """
    a, b, c = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    Q = np.empty((len(R), 4, 4))
    Q[:, 0, 0], Q[:, 1, 1] = 1 + a + b + c, 1 + a - b - c
    Q[:, 2, 2], Q[:, 3, 3] = 1 - a + b - c, 1 - a - b + c
    Q[:, 0, 1] = Q[:, 1, 0] = R[:, 2, 1] - R[:, 1, 2]
    Q[:, 0, 2] = Q[:, 2, 0] = R[:, 0, 2] - R[:, 2, 0]
    Q[:, 0, 3] = Q[:, 3, 0] = R[:, 1, 0] - R[:, 0, 1]
    Q[:, 1, 2] = Q[:, 2, 1] = R[:, 0, 1] + R[:, 1, 0]
    Q[:, 1, 3] = Q[:, 3, 1] = R[:, 0, 2] + R[:, 2, 0]
    Q[:, 2, 3] = Q[:, 3, 2] = R[:, 1, 2] + R[:, 2, 1]
    largest = np.argmax(np.diagonal(Q, axis1=1, axis2=2), axis=1)
    q = Q[np.arange(len(R)), largest]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(np.where(q[:, :1] < 0, -q, q))


def matrix_from_rotvec(rotvec: Array) -> Array:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3), radians."""
    half = 0.5 * np.linalg.norm(rotvec, axis=1, keepdims=True)
    return matrix_from_quat(np.hstack([np.cos(half), 0.5 * rotvec * np.sinc(half / np.pi)]))


def rotvec_from_matrix(R: Array) -> Array:
    """Rotation vectors (N, 3), radians, at most half a turn long, of matrices (N, 3, 3)."""
    q = quat_from_matrix(R)
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(sine > 0, 2 * np.arctan2(sine, q[:, :1]) / sine, 2.0)
    return np.asarray(q[:, 1:] * scale)


def matrix_from_euler(order: str, angles: Array) -> Array:
    """Rotation matrices (N, 3, 3) of angles (N, 3), radians, about ``order`` (as in scipy)."""
    order, angles = _moving(order, angles)
    first, second, third = (
        _axis_rotation("XYZ".index(axis), angles[:, k]) for k, axis in enumerate(order)
    )
    return np.asarray(first @ second @ third)


def euler_from_matrix(order: str, R: Array) -> Array:
    """Three angles (N, 3), radians, about ``order`` (as in scipy), of matrices (N, 3, 3).

    The second and third angle are read from what remains after the first is undone, so that
    the product is right to rounding even where only the sum of first and third is determined.
    """
    i, j, k = ("XYZ".index(axis) for axis in order.upper()[:: 1 if order.isupper() else -1])
    other = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    # E_i(a) E_j(b) turns axis k by b out of its place and then by a about i
    if k == i:
        first = np.arctan2(R[:, j, i], -sign * R[:, other, i])
    else:
        first = np.arctan2(-sign * R[:, j, k], R[:, k, k])
    rest = _axis_rotation(i, -first) @ R
    if k == i:
        second = np.arctan2(-sign * rest[:, other, i], rest[:, i, i])
        third = np.arctan2(-sign * rest[:, j, other], rest[:, j, j])
    else:
        second = np.arctan2(sign * rest[:, i, k], rest[:, k, k])
        third = np.arctan2(sign * rest[:, j, i], rest[:, j, j])
    angles = np.stack([first, second, third], axis=1)
    return angles if order.isupper() else angles[:, ::-1].copy()


def _moving(order: str, angles: Array) -> tuple[str, Array]:
    """Angles about fixed axes are those about moving axes in reverse order."""
    return (order, angles) if order.isupper() else (order[::-1].upper(), angles[:, ::-1])


def _axis_rotation(axis: int, angle: Array) -> Array:
    """Rotations (N, 3, 3) about coordinate axis 0, 1 or 2."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R = np.zeros((len(angle), 3, 3))
    R[:, axis, axis] = 1.0
    R[:, j, j] = R[:, k, k] = np.cos(angle)
    R[:, k, j] = np.sin(angle)
    R[:, j, k] = -R[:, k, j]
    return R


# --- checks -------------------------------------------------------------------------------------


def _check_shape(description: RotationFormat, values: Array) -> Array:
    values = np.asarray(values, dtype=np.float64)
    width = len(description.columns)
    if values.ndim != 2 or values.shape[1] != width:
        raise DataError(
            f"rotation {description.name}: expected an array of shape (N, {width}) with columns "
            f"{', '.join(description.columns)}, got shape {values.shape}"
        )
    return values


def _matrix_problems(M: Array) -> list[tuple[int, str]]:
    problems = []
    distance = np.abs(M - nearest_rotation(M)).max(axis=(1, 2))
    for k in np.flatnonzero(~(distance <= ROUNDING_TOLERANCE)):
        determinant = float(np.linalg.det(M[k]))
        mirrored = -nearest_rotation(-M[k][None])[0]
        if determinant < 0 and np.abs(M[k] - mirrored).max() <= ROUNDING_TOLERANCE:
            text = "matrix of determinant -1, a reflection and not a rotation: an axis is reversed"
        else:
            text = (
                f"not a rotation matrix: the nearest rotation differs by {distance[k]:.2g} "
                f"(allowed {ROUNDING_TOLERANCE}), determinant {determinant:.6g}, expected 1"
            )
        problems.append((int(k), text))
    return problems


def _clean_matrices(M: Array) -> Array:
    nearest = nearest_rotation(M)
    exact = np.abs(M - nearest).max(axis=(1, 2)) <= EXACT_TOLERANCE
    return np.where(exact[:, None, None], M, nearest)


def _to_wxyz(description: RotationFormat, values: Array) -> Array:
    return values[:, [description.columns.index(c) for c in _QUAT_WXYZ]]


def _from_wxyz(description: RotationFormat, quat_wxyz: Array) -> Array:
    return quat_wxyz[:, [_QUAT_WXYZ.index(c) for c in description.columns]]


def _to_radians(description: RotationFormat, values: Array) -> Array:
    return np.deg2rad(values) if description.unit == "deg" else values


def _numbers(row: Sequence[float] | Array) -> str:
    return ", ".join(f"{x:g}" for x in row)
