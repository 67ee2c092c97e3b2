"""The tables of a capture: hand poses and spots, row by row, in SI units and ``T_base_hand``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture_head import CaptureHead
from lasercal_gtsam.io.conventions import (
    rotation_format,
    rotation_problems,
    rotations_from_columns,
    rounding_of_rotations,
)
from lasercal_gtsam.io.tables import Table, read_table
from lasercal_gtsam.io.wording import did_you_mean, quoted, some
from lasercal_gtsam.units import MM_PER_M

DEFAULT_LASER = "laser"
USED = "used"
# A pixel may lie this far outside the outermost pixel centres: spots at the border, no slips.
OUTSIDE_TOLERANCE_PX = 1.0
# Rotations with six decimals and more are not worth a word.
ROUNDING_WORTH_A_WARNING = 2e-6
# Hand positions beyond these are rather a wrong unit than a robot.
LARGEST_PLAUSIBLE_M, SMALLEST_PLAUSIBLE_M = 50.0, 0.01
LARGEST_PLAUSIBLE_RAD = 4 * np.pi
# No length, angle or pixel in any unit is larger; squares of such numbers can be added safely.
LARGEST_NUMBER = 1e9
SMALLEST_SIGMA_PX, LARGEST_SIGMA_PX, LARGEST_CORRELATION = 1e-9, 1e6, 1 - 1e-9


@dataclass(frozen=True)
class Rows:
    """What the tables of a capture say; arrays over its N rows.

    ``uv`` and ``cov_uv`` are NaN where nothing is given. ``verdict`` is "" where nothing was said
    about a spot, ``used`` where its pixel is given, else why it must not be used. ``stops``: as of
    `Observations`, "" where a row has none; None without such a column.
    """

    ids: list[str]
    planes: list[str]
    cameras: list[str]
    lasers: list[str]
    T_base_hand: Array
    uv: Array
    cov_uv: Array
    verdict: list[str]
    reason: list[str]
    warnings: list[str]
    has_spots: bool
    stops: list[str] | None = None


def read_rows(head: CaptureHead, folder: Path) -> Rows:
    """Read the pose table and, if there is one, the spot table.

    Raises
    ------
    DataError
        With every problem of both files, each with file, line and column.
    """
    poses = read_table(folder / head.poses.file, head.poses.file)
    spots = None
    if head.spots is not None:
        spots = read_table(folder / head.spots.file, head.spots.file)
    rows = rows_of(head, poses, spots)
    problems = [*poses.problems(), *([] if spots is None else spots.problems())]
    if problems:
        raise DataError(*problems)
    return rows


def rows_of(head: CaptureHead, poses: Table, spots: Table | None) -> Rows:
    """Take the rows out of the tables; what is wrong is noted in the tables.

    Rows with problems hold placeholders: whoever reads asks the tables.
    """
    count = len(poses)
    warnings: list[str] = []
    ids = poses.unique("id") if poses.require(["id"], "which names each row") else [""] * count
    planes = _planes(poses, head)
    cameras = _cameras(poses, head)
    lasers = poses.text("laser") if "laser" in poses.columns else [DEFAULT_LASER] * count
    T_base_hand = _poses(poses, head, warnings)
    sizes = {camera.name: (camera.width, camera.height) for camera in head.camera}
    uv, cov = spot_pixels(poses, [sizes.get(name) for name in cameras])
    verdict = [USED if given else "" for given in _complete(uv)]
    reason = [""] * count
    if spots is not None:
        if "u" in poses.columns:
            poses.add_file_problem(
                f"spots are given here (columns u, v) and in {spots.name}; drop one of them"
            )
        size_of = {i: sizes.get(camera) for i, camera in zip(ids, cameras, strict=True)}
        _merge_spots(spots, ids, size_of, (uv, cov, verdict, reason), poses)
    return Rows(
        ids=ids,
        planes=planes,
        cameras=cameras,
        lasers=lasers,
        T_base_hand=T_base_hand,
        uv=uv,
        cov_uv=cov,
        verdict=verdict,
        reason=reason,
        warnings=warnings,
        has_spots=head.spots is not None or "u" in poses.columns,
        stops=poses.columns.get("stop"),
    )


def _planes(poses: Table, head: CaptureHead) -> list[str]:
    if not poses.require(["plane"], "which names the working plane of each row"):
        return [""] * len(poses)
    planes = poses.text("plane")
    if head.planes is not None:
        _check_names(poses, "plane", planes, head.planes)
    return planes


def _cameras(poses: Table, head: CaptureHead) -> list[str]:
    names = [camera.name for camera in head.camera]
    if "camera" in poses.columns:
        cameras = poses.text("camera")
        _check_names(poses, "camera", cameras, names)
        return cameras
    if len(names) > 1:
        poses.require(["camera"], f"needed because there are {len(names)} cameras")
    return names[:1] * len(poses)


def _check_names(table: Table, column: str, found: list[str], allowed: list[str]) -> None:
    for row, name in enumerate(found):
        if name and name not in allowed:
            table.add_problem(
                row,
                f"{column}: unknown {column} {quoted(name)}{did_you_mean(name, allowed)}; "
                f"capture.yaml has {some(allowed)}",
            )


# --- hand poses ---------------------------------------------------------------------------------


def _poses(table: Table, head: CaptureHead, warnings: list[str]) -> Array:
    """Hand poses (N, 4, 4) in metres as ``T_base_hand``; identity where a row is wrong."""
    T = np.tile(np.eye(4), (len(table), 1, 1))
    fmt = rotation_format(head.poses.rotation)
    has_position = table.require(["x", "y", "z"], "the position of the hand")
    has_rotation = table.require(fmt.columns, f"needed by rotation {fmt.name}")
    if has_position:
        position = table.numbers(["x", "y", "z"], largest=LARGEST_NUMBER)
        T[:, :3, 3] = position / MM_PER_M if head.poses.length == "mm" else position
        warnings += _length_warnings(T[:, :3, 3], head, table.name)
    if has_rotation:
        values = table.numbers(fmt.columns, largest=LARGEST_NUMBER)
        good = _complete(values)
        for row, text in rotation_problems(fmt.name, values):
            if good[row]:
                table.add_problem(row, f"{', '.join(fmt.columns)}: {text}")
                good[row] = False
        T[good, :3, :3] = rotations_from_columns(fmt.name, values[good])
        warnings += _rotation_warnings(fmt.name, values[good], T[good, :3, :3], table.name)
    if head.poses.transform == "T_hand_base":
        T = inverse_poses(T)
    return T


def inverse_poses(T: Array) -> Array:
    """Inverse of rigid transforms (N, 4, 4)."""
    inverse = T.copy()
    inverse[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    inverse[:, :3, 3] = -np.einsum("nij,nj->ni", inverse[:, :3, :3], T[:, :3, 3])
    return inverse


def _length_warnings(position_m: Array, head: CaptureHead, name: str) -> list[str]:
    reach = float(np.nanmax(np.linalg.norm(position_m, axis=1), initial=0.0))
    said = f"{name}: poses.length is {head.poses.length}, so the hand is up to"
    if reach > LARGEST_PLAUSIBLE_M:
        return [f"{said} {reach:.4g} m away from its base; is the unit mm?"]
    if 0 < reach < SMALLEST_PLAUSIBLE_M:
        return [f"{said} {reach * MM_PER_M:.4g} mm away from its base; is the unit m?"]
    return []


def _rotation_warnings(fmt: str, values: Array, R: Array, name: str) -> list[str]:
    rounding = rounding_of_rotations(fmt, values, R)
    if rounding > ROUNDING_WORTH_A_WARNING:
        return [
            f"{name}: rotations are rounded; elements had to be changed by up to {rounding:.1g} "
            f"(about {np.rad2deg(rounding):.1g} deg) to make them rotations"
        ]
    largest = float(np.abs(values).max(initial=0.0))
    if rotation_format(fmt).unit == "rad" and largest > LARGEST_PLAUSIBLE_RAD:
        return [f"{name}: rotation {fmt} is in radians, but values reach {largest:.4g}; degrees?"]
    return []


# --- spots --------------------------------------------------------------------------------------


def spot_pixels(table: Table, sizes: Sequence[tuple[int, int] | None]) -> tuple[Array, Array]:
    """Pixels (N, 2) and covariances (N, 2, 2) of a table; NaN where cells are empty.

    ``sizes`` of the rows' pictures, where known; pixels must lie inside.
    """
    count = len(table)
    uv, cov = np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan)
    if not {"u", "v"} & set(table.columns):
        return uv, cov
    if not table.require(["u", "v"], "a spot needs both"):
        return uv, cov
    uv = table.numbers(["u", "v"], allow_empty=True, largest=LARGEST_NUMBER)
    for row, size in enumerate(sizes):
        u, v = (table.columns[name][row] for name in ("u", "v"))
        if bool(u) != bool(v):
            given, empty = ("u", "v") if u else ("v", "u")
            table.add_problem(row, f"{empty}: empty, but {given} is given")
        elif size is not None:
            _check_inside(table, row, uv[row], size)
    return uv, _covariances(table)


def _complete(values: Array) -> npt.NDArray[np.bool_]:
    """Rows in which every number is known."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _check_inside(table: Table, row: int, uv: Array, size: tuple[int, int]) -> None:
    for name, value, pixels in zip(("u", "v"), uv, size, strict=True):
        lowest, highest = -OUTSIDE_TOLERANCE_PX, pixels - 1 + OUTSIDE_TOLERANCE_PX
        if value < lowest or value > highest:
            table.add_problem(
                row,
                f"{name}: {value:g} lies outside the picture, whose pixels go from 0 to "
                f"{pixels - 1}",
            )


def _covariances(table: Table) -> Array:
    cov = np.full((len(table), 2, 2), np.nan)
    if not {"sigma_u", "sigma_v", "rho_uv"} & set(table.columns):
        return cov
    if not table.require(["sigma_u", "sigma_v"], "a covariance needs both"):
        return cov
    sigma = table.numbers(["sigma_u", "sigma_v"], allow_empty=True, largest=LARGEST_SIGMA_PX)
    rho = np.zeros(len(table))
    if "rho_uv" in table.columns:
        rho = table.numbers(["rho_uv"], allow_empty=True)[:, 0]
    for row in range(len(table)):
        cells = [table.columns[name][row] for name in ("sigma_u", "sigma_v")]
        if not any(cells):
            continue
        if not all(cells):
            table.add_problem(row, "sigma_u, sigma_v: one is empty; give both or none")
        elif not table.columns["u"][row]:
            table.add_problem(row, "sigma_u, sigma_v: given without a pixel u, v")
        elif (sigma[row] < SMALLEST_SIGMA_PX).any():
            few = f"expected numbers above 0 (at least {SMALLEST_SIGMA_PX:g}), got {cells}"
            table.add_problem(row, f"sigma_u, sigma_v: {few}")
        elif abs(rho[row]) > LARGEST_CORRELATION:
            table.add_problem(row, f"rho_uv: expected a correlation in (-1, 1), got {rho[row]:g}")
        else:
            su, sv = sigma[row]
            off_diagonal = 0.0 if np.isnan(rho[row]) else rho[row] * su * sv
            cov[row] = [[su * su, off_diagonal], [off_diagonal, sv * sv]]
    return cov


def _merge_spots(
    table: Table,
    ids: list[str],
    size_of: Mapping[str, tuple[int, int] | None],
    into: tuple[Array, Array, list[str], list[str]],
    poses: Table,
) -> None:
    """Enter the spots of a spot table into the rows with the same id."""
    if not table.require(["id"], "which says whose spot it is"):
        return
    if not table.require(["u", "v"], "the pixel of the spot"):
        return
    uv_rows, cov_rows, verdict_rows, reason_rows = into
    row_of = {name: row for row, name in enumerate(ids)}
    found = table.unique("id")
    uv, cov = spot_pixels(table, [size_of.get(name) for name in found])
    verdicts = table.columns.get("verdict", [""] * len(table))
    reasons = table.columns.get("reason", [""] * len(table))
    for row, name in enumerate(found):
        if name not in row_of:
            if poses.whole:
                table.add_problem(row, f"id: {quoted(name)} is not in {poses.name}")
            continue
        target = row_of[name]
        empty = not (table.columns["u"][row] or table.columns["v"][row])
        if verdicts[row].lower() == USED and empty:
            table.add_problem(row, "u, v: empty, but the verdict is 'used'")
        elif verdicts[row].lower() in ("", USED) and not empty:
            uv_rows[target], cov_rows[target], verdict_rows[target] = uv[row], cov[row], USED
        elif verdicts[row]:
            verdict_rows[target] = verdicts[row]
            reason_rows[target] = reasons[row] or f"verdict in {table.name}"
