"""Pixels and points with the covariance that the calibration leaves them, to first order.

Everything is differentiated by the tangent coordinates of `report_map` at the calibrated cell:
camera 15, beam 4, plane 3. Frames and units as there; formulas by the chain rule along (1)-(12).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from lasercal_factors.beam import BeamFrame

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    distort,
    point_jacobian,
    project,
    spot_on_beam,
    spot_on_ray,
)
from lasercal_gtsam.report_map import BEAM_TANGENT, CAMERA_TANGENT, PLANE_TANGENT
from lasercal_gtsam.rotations import basis_of, skew

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class CellUncertainty:
    """A cell with its joint covariance and the names of the coordinates."""

    cell: Cell
    covariance: Array
    labels: tuple[str, ...]

    def columns(self, camera: str | None, laser: str | None, plane: str) -> Index:
        """Columns of these parts; DataError where one was not estimated."""
        wanted = [] if camera is None else [f"{camera}.{t}" for t in CAMERA_TANGENT]
        wanted += [] if laser is None else [f"{laser}.{t}" for t in BEAM_TANGENT]
        wanted += [f"plane {plane}.{t}" for t in PLANE_TANGENT]
        where = {label: i for i, label in enumerate(self.labels)}
        missing = [label for label in wanted if label not in where]
        if missing:
            part = missing[0].rpartition(".")[0]
            raise DataError(f"{part!r} has no covariance: no spot of it was in the calibration")
        return np.array([where[label] for label in wanted], dtype=np.int64)


def predict(
    known: CellUncertainty, T_base_hand: Array, plane: str, camera: str, laser: str
) -> tuple[Array, Array]:
    """Pixels of the spot for hand poses (1)-(9) and their covariance.

    Parameters
    ----------
    known : the calibrated cell
    T_base_hand : (N, 4, 4), metres
    plane, camera, laser : names

    Returns
    -------
    (N, 2) and (N, 2, 2) arrays
        Pixels, and their covariance from the calibration alone (px^2). NaN where no spot can be.
    """
    uv, J = spot_jacobian(known.cell, T_base_hand, plane, camera, laser)
    columns = known.columns(camera, laser, plane)
    return uv, _propagate(J, known.covariance[np.ix_(columns, columns)])


def spot_jacobian(
    cell: Cell, T_base_hand: Array, plane: str, camera: str, laser: str
) -> tuple[Array, Array]:
    """Pixels of the spot (N, 2) and their derivative (N, 2, 22) by camera, beam and plane."""
    T = np.asarray(T_base_hand, dtype=np.float64).reshape(-1, 4, 4)
    uv = project(cell, T, plane=plane, camera=camera, laser=laser)
    points = spot_on_beam(cell, T, plane=plane, laser=laser)
    J_point = point_jacobian(points, cell.cameras[camera])
    J = np.concatenate(
        [
            pixel_by_camera(points, cell.cameras[camera]),
            J_point @ _by_beam(T, cell.lasers[laser], cell.planes[plane]),
            J_point @ _by_plane(points, T, cell.lasers[laser], cell.planes[plane]),
        ],
        axis=2,
    )
    return uv, J


def locate(
    known: CellUncertainty, uv: Array, plane: str, camera: str, sigma_px: float
) -> tuple[Array, Array]:
    """Points of a plane that are seen at pixels (12) and their covariance.

    Parameters
    ----------
    known : the calibrated cell
    uv : (N, 2) px
    plane, camera : names
    sigma_px : noise of the pixels themselves, added to that of the calibration

    Returns
    -------
    (N, 3) and (N, 3, 3) arrays
        Base points (metres) and their covariance (m^2; flat across the plane but for the plane's
        own uncertainty). NaN where the ray does not meet the plane.
    """
    points, J, by_pixel = located_jacobian(known.cell, uv, plane, camera)
    columns = known.columns(camera, None, plane)
    cov = _propagate(J, known.covariance[np.ix_(columns, columns)])
    return points, cov + sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, 1, 2)


def located_jacobian(cell: Cell, uv: Array, plane: str, camera: str) -> tuple[Array, Array, Array]:
    """Points of a plane seen at pixels, and their derivatives.

    Returns
    -------
    (N, 3), (N, 3, 18) and (N, 3, 2) arrays
        Base points (metres), derivative by camera and plane, derivative by the pixel. NaN where
        the ray does not meet the plane.
    """
    uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    part, seen = cell.planes[plane], cell.cameras[camera]
    points = spot_on_ray(cell, uv, plane=plane, camera=camera)
    # the point moves so that its pixel stays and it stays on the plane: M dX = rhs
    M = np.empty((len(uv), 3, 3))
    M[:, :2] = point_jacobian(points, seen)
    M[:, 2] = part.normal_base
    rhs = np.zeros((len(uv), 3, len(CAMERA_TANGENT) + len(PLANE_TANGENT)))
    rhs[:, :2, : len(CAMERA_TANGENT)] = -pixel_by_camera(points, seen)
    rhs[:, 2, len(CAMERA_TANGENT) : -1] = -points @ basis_of(part.normal_base)
    rhs[:, 2, -1] = 1.0
    seen_at = np.isfinite(points).all(axis=1)
    M[~seen_at] = np.eye(3)
    inverse = np.linalg.inv(M)
    inverse[~seen_at] = np.nan
    return points, inverse @ rhs, np.asarray(inverse[:, :, :2])


def only(names: Sequence[str], given: str | None, kind: str) -> str:
    """The name given, or the only one there is; DataError otherwise."""
    if given is None and len(names) == 1:
        return names[0]
    if given is None or given not in names:
        found = "none was named" if given is None else f"{given!r} is not among them"
        raise DataError(f"{kind}: the cell has {', '.join(names)}; {found}")
    return given


def _propagate(J: Array, covariance: Array) -> Array:
    return np.asarray(J @ covariance @ np.swapaxes(J, 1, 2))


def pixel_by_camera(points: Array, camera: Camera) -> Array:
    """Derivative of the pixels of fixed base points by `CAMERA_TANGENT`, (N, 2, 15)."""
    R, i = camera.T_base_camera[:3, :3], camera.intrinsics
    p = (points - camera.T_base_camera[:3, 3]) @ R
    by_p = point_jacobian(points, camera) @ R
    xy = p[:, :2] / p[:, 2:]
    x, y = xy.T
    r2 = x * x + y * y
    xd, yd = distort(xy, i).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    # distorted coordinates by k1, k2, p1, p2, then pixels
    by_terms = np.array(
        [
            [x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x],
            [y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y],
        ]
    )
    terms = np.moveaxis(by_terms, 2, 0)
    terms = np.array([[i.fu, i.skew], [0.0, i.fv]]) @ terms
    lens = np.moveaxis(np.array([[xd, zero, yd, one, zero], [zero, yd, zero, zero, one]]), 2, 0)
    return np.concatenate([by_p @ skew(p), -by_p, lens, terms], axis=2)


def _by_beam(T: Array, beam: Beam, plane: Plane) -> Array:
    """Derivative of the hit point by `BEAM_TANGENT` about the beam itself, (N, 3, 4)."""
    u, q = beam_in_base(T, beam)
    n = plane.normal_base
    length = beam_plane_distance(u, q, n, plane.distance)[:, None, None]
    across = np.eye(3) - u[:, :, None] * n / (u @ n)[:, None, None]
    frame = BeamFrame.from_line(beam.direction_hand, beam.point_hand)
    offsets = across @ T[:, :3, :3] @ frame.R[:, :2]
    return np.concatenate([length * offsets, offsets], axis=2)


def _by_plane(points: Array, T: Array, beam: Beam, plane: Plane) -> Array:
    """Derivative of the hit point by `PLANE_TANGENT`, (N, 3, 3)."""
    u, _ = beam_in_base(T, beam)
    along = u / (u @ plane.normal_base)[:, None]
    tilt = -points @ basis_of(plane.normal_base)
    rows = np.concatenate([tilt, np.ones((len(points), 1))], axis=1)
    return np.asarray(along[:, :, None] * rows[:, None, :])
