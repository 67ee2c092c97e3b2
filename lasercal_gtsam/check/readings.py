"""The ways in which the numbers of a capture may be meant: as declared, and the usual mistakes.

Nobody can tell from a pose list alone whether it holds ``T_base_hand`` or the inverse, which axes
its angles turn about, or in which order a quaternion stands. Here the same numbers are read in
every usual way; `doctor` asks the spots which of them is right. The unit of length is not among
them: it scales the whole cell and moves no pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.io.capture_head import CaptureHead, read_head
from lasercal_gtsam.io.capture_rows import inverse_poses
from lasercal_gtsam.io.conventions import (
    ROTATION_FORMATS,
    RotationFormat,
    rotation_format,
    rotations_from_columns,
)
from lasercal_gtsam.io.tables import Table, read_table
from lasercal_gtsam.units import MM_PER_M

TRANSFORMS = ("T_base_hand", "T_hand_base")
_AXES = [a + b + c for a, b, c in product("xyz", repeat=3) if a != b and b != c]
EULER_ORDERS = (*_AXES, *(order.upper() for order in _AXES))
LARGEST_RAD = 2.0 * np.pi + 1e-3
"""Angles beyond a full turn are not in radians."""
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class RawPoses(FrozenData):
    """The pose table of a capture as it is written.

    Attributes
    ----------
    ids : label of each of the N rows
    position_m : (N, 3) columns x, y, z in metres by the declared unit
    values : (N, k) numbers of the rotation in the order of the declared format's columns
    file_columns : those columns in the order in which they stand in the file
    transform, rotation : as declared
    """

    ids: tuple[str, ...]
    position_m: Array
    values: Array
    file_columns: tuple[str, ...]
    transform: str
    rotation: str

    @classmethod
    def of_capture(cls, path: Path) -> RawPoses:
        """Read the pose table of a ``capture.yaml`` that `load_capture` accepts."""
        head, _ = read_head(path)
        table = read_table(path.parent / head.poses.file, head.poses.file)
        return cls.of_table(head, table)

    @classmethod
    def of_table(cls, head: CaptureHead, table: Table) -> RawPoses:
        """Take the numbers out of the table.

        Raises
        ------
        DataError
            Cells that are no numbers, or columns that are missing.
        """
        columns = rotation_format(head.poses.rotation).columns
        if not table.require(["x", "y", "z", *columns], "the hand poses"):
            raise DataError(*table.problems())
        position, values = table.numbers(["x", "y", "z"]), table.numbers(columns)
        if problems := table.problems():
            raise DataError(*problems)
        return cls(
            ids=tuple(table.columns["id"]),
            position_m=position / MM_PER_M if head.poses.length == "mm" else position,
            values=values,
            file_columns=tuple(name for name in table.columns if name in columns),
            transform=head.poses.transform,
            rotation=head.poses.rotation,
        )


@dataclass(frozen=True, eq=False)
class PoseReading:
    """One way to read the pose table.

    Attributes
    ----------
    words : for a human, such as ``T_hand_base, kuka``
    change : what to change in the capture so that it is read this way; () for the declared one
    T_base_hand : (N, 4, 4), metres
    """

    words: str
    change: tuple[str, ...]
    T_base_hand: Array


@dataclass(frozen=True)
class PixelReading:
    """One way to read the pixels: ``apply`` takes (N, 2) pixels and the image's (width, height)."""

    words: str
    change: tuple[str, ...]
    apply: Callable[[Array, tuple[int, int]], Array]


def pose_readings(raw: RawPoses) -> list[PoseReading]:
    """Every usual reading of the pose table, the declared one first; equal ones only once.

    Both directions of the transform, each with every rotation that the same numbers can mean:
    quaternions with the scalar first or last, all 24 orders of three angles and the rotation vector
    (in degrees and, where the numbers allow it, in radians), and the declared rotation transposed
    beside a position that is not.
    """
    found: list[PoseReading] = []
    transforms = sorted(TRANSFORMS, key=lambda name: name != raw.transform)
    rotations = list(_rotations(raw))
    for transform in transforms:
        turn = () if transform == raw.transform else (_setting("transform", transform),)
        for name, change, R in rotations:
            T = np.tile(np.eye(4), (len(R), 1, 1))
            T[:, :3, :3], T[:, :3, 3] = R, raw.position_m
            if transform == "T_hand_base":
                T = inverse_poses(T)
            if not any(np.abs(T - other.T_base_hand).max() < _SAME for other in found):
                found.append(PoseReading(f"{transform}, {name}", (*turn, *change), T))
    return found


def _rotations(raw: RawPoses) -> Iterator[tuple[str, tuple[str, ...], Array]]:
    """Name, change in the capture and matrices of every rotation, the declared one first."""
    declared = rotation_format(raw.rotation)
    R = rotations_from_columns(raw.rotation, raw.values)
    yield raw.rotation, (), R
    match declared.kind:
        case "quaternion":
            yield from _quaternions(raw, declared)
        case "euler" | "rotvec":
            yield from _three_numbers(raw, declared)
    yield (
        f"{raw.rotation} of the transposed rotation",
        (_transposing(declared),),
        np.swapaxes(R, 1, 2),
    )


def _quaternions(
    raw: RawPoses, declared: RotationFormat
) -> Iterator[tuple[str, tuple[str, ...], Array]]:
    """The four numbers in the order of the file, with the scalar first and with it last."""
    in_file = raw.values[:, [declared.columns.index(name) for name in raw.file_columns]]
    for name in ("quat_wxyz", "quat_xyzw"):
        columns = rotation_format(name).columns
        change = (
            f"in the pose table, name the columns {', '.join(columns)} (they are named "
            f"{', '.join(raw.file_columns)})"
        )
        yield (
            f"quaternion in the order {name[-4:]}",
            (change,),
            rotations_from_columns(name, in_file),
        )


def _three_numbers(
    raw: RawPoses, declared: RotationFormat
) -> Iterator[tuple[str, tuple[str, ...], Array]]:
    units = ["deg"]
    if declared.unit == "rad" or np.abs(raw.values).max(initial=0.0) <= LARGEST_RAD:
        units = sorted(["deg", "rad"], key=lambda unit: unit != declared.unit)
    for unit in units:
        names = [f"rotvec_{unit}", *(f"euler:{order}:{unit}" for order in EULER_ORDERS)]
        for name in names:
            chosen = _as_named(rotation_format(name), declared.columns)
            change = [_setting("rotation", chosen.name)]
            if chosen.columns != declared.columns:
                change.append(
                    f"in the pose table, name the columns {', '.join(chosen.columns)} (they are "
                    f"named {', '.join(declared.columns)})"
                )
            yield chosen.name, tuple(change), rotations_from_columns(name, raw.values)


def _as_named(fmt: RotationFormat, columns: Sequence[str]) -> RotationFormat:
    """The format of the same meaning that also has these column names, if there is one."""
    same = [
        other
        for other in ROTATION_FORMATS.values()
        if (other.kind, other.order, other.unit) == (fmt.kind, fmt.order, fmt.unit)
        and other.columns == tuple(columns)
    ]
    return same[0] if same else fmt


def _setting(key: str, value: str) -> str:
    return f"in capture.yaml, under poses, write '{key}: {value}'"


def _transposing(fmt: RotationFormat) -> str:
    if fmt.kind == "matrix":
        by_columns = ", ".join(f"r{i}{j}" for j in (1, 2, 3) for i in (1, 2, 3))
        return f"in the pose table, name the nine columns by columns of the matrix: {by_columns}"
    signs = {"quaternion": "qx, qy, qz", "rotvec": ", ".join(fmt.columns)}
    if fmt.kind in signs:
        return f"in the pose table, change the signs of {signs[fmt.kind]}"
    return (
        "the pose table holds the inverse rotation beside a position that is not inverted: write "
        "the hand's rotation in the base there"
    )


AS_DECLARED = PixelReading("", (), lambda uv, size: uv)
TURNED = PixelReading(
    "image turned by 180 deg",
    ("turn the pictures by 180 deg, or replace u by width - 1 - u and v by height - 1 - v",),
    lambda uv, size: np.array(size, dtype=np.float64) - 1.0 - uv,
)
"""No mistake: it only turns the camera's own axes."""
MIRRORED = (
    PixelReading(
        "u and v swapped",
        ("exchange the columns u and v of the spots",),
        lambda uv, size: uv[:, ::-1],
    ),
    PixelReading(
        "image mirrored left to right",
        ("flip the pictures left to right, or replace u by width - 1 - u",),
        lambda uv, size: np.array([size[0] - 1.0, 0.0]) + uv * np.array([-1.0, 1.0]),
    ),
    PixelReading(
        "image mirrored top to bottom",
        ("flip the pictures top to bottom, or replace v by height - 1 - v",),
        lambda uv, size: np.array([0.0, size[1] - 1.0]) + uv * np.array([1.0, -1.0]),
    ),
)
"""The usual mistakes about pixels; each is a mirror image, up to a turn of the camera."""


def swapped_pixels(head: CaptureHead, folder: Path) -> list[str]:
    """A sentence if spots lie outside the picture, but none with u and v exchanged."""
    names = [head.poses.file, *([head.spots.file] if head.spots else [])]
    width, height = (
        min(getattr(camera, side) for camera in head.camera) for side in ("width", "height")
    )
    for name in names:
        table = read_table(folder / name, name)
        if not {"u", "v"} <= set(table.columns):
            continue
        uv = table.numbers(["u", "v"], allow_empty=True)
        uv = uv[np.isfinite(uv).all(axis=1)]
        outside = (uv > np.array([width, height])).any()
        if len(uv) and outside and (uv[:, ::-1] <= np.array([width, height])).all():
            return [
                f"{name}: with u and v exchanged all spots lie inside the picture: exchange the "
                "columns u and v"
            ]
    return []
