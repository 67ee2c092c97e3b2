"""The forward chain beam -> plane -> camera -> pixel and the ways back, equation by equation.

Plain numpy over many spots, written to be read. The compiled kernels in `lasercal_factors` are the
same chain with derivatives; tests hold the two against each other.
Numbers in brackets are equations of the paper; corrected ones are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array

T = TypeVar("T")
Index = npt.NDArray[np.int64]
Names = str | Sequence[str] | None


# --- one part at a time: arrays in, arrays out -------------------------------------------------


def beam_in_base(T_base_hand: Array, beam: Beam) -> tuple[Array, Array]:
    """Direction and point of the beam in the base (7): two arrays (N, 3)."""
    R, t = T_base_hand[..., :3, :3], T_base_hand[..., :3, 3]
    return R @ beam.direction_hand, R @ beam.point_hand + t


def beam_plane_distance(u: Array, q: Array, n: Array, distance: Array | float) -> Array:
    """Signed length along the beam to the plane, corrected (8): ``(d - n.q) / (n.u)``, (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((distance - (n * q).sum(-1)) / (n * u).sum(-1))


def distort(xy: Array, intrinsics: Intrinsics) -> Array:
    """Normalised coordinates with radial and tangential distortion (2), (3): (N, 2)."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    g = 1 + r2 * (intrinsics.k1 + intrinsics.k2 * r2)
    p1, p2 = intrinsics.p1, intrinsics.p2
    xd = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([xd, yd], axis=-1)


def fold_radius_squared(intrinsics: Intrinsics) -> float:
    """Squared radius (normalised, undistorted) where the radial distortion turns back, or inf.

    The slope ``1 + 3 k1 r^2 + 5 k2 r^4`` first vanishes there. Beyond it the model shows again what
    it has shown before: no lens does that.
    """
    a, b = 5.0 * intrinsics.k2, 3.0 * intrinsics.k1
    discriminant = b * b - 4.0 * a
    if discriminant < 0.0:
        return float("inf")
    root = np.sqrt(discriminant)
    # 1/r^2 solves x^2 + b x + a = 0; the larger x is the smaller radius
    largest = 0.5 * (root - b) if b <= 0.0 else (-2.0 * a / (root + b))
    return float(1.0 / largest) if largest > 0.0 else float("inf")


def undistort(xyd: Array, intrinsics: Intrinsics, iterations: int = 50) -> Array:
    """Inverse of `distort` by Newton's method from ``xyd``; NaN where there is none.

    Only points inside the fold of the distortion count (`fold_radius_squared`): beyond it Newton's
    method would find mirrored ones.
    """
    k1, k2, p1, p2 = intrinsics.k1, intrinsics.k2, intrinsics.p1, intrinsics.p2
    xy = np.array(xyd, dtype=np.float64)
    error = np.zeros_like(xy)
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            error = distort(xy, intrinsics) - xyd
            x, y = xy[..., 0], xy[..., 1]
            r2 = x * x + y * y
            g, dg = 1 + r2 * (k1 + k2 * r2), k1 + 2 * k2 * r2
            a = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
            b = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
            c = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
            det = a * c - b * b
            ex, ey = error[..., 0], error[..., 1]
            step = np.stack([(c * ex - b * ey) / det, (a * ey - b * ex) / det], axis=-1)
            xy -= step
            if np.nanmax(np.abs(step), initial=0.0) < 1e-15:
                break
        error = distort(xy, intrinsics) - xyd
        good = np.abs(error).max(axis=-1) < 1e-10
        good &= (xy * xy).sum(axis=-1) < fold_radius_squared(intrinsics)
    xy[~good] = np.nan
    return xy


def pixel_from_normalized(xyd: Array, intrinsics: Intrinsics) -> Array:
    """Distorted normalised coordinates to pixels (1): (N, 2)."""
    u = intrinsics.fu * xyd[..., 0] + intrinsics.skew * xyd[..., 1] + intrinsics.u0
    return np.stack([u, intrinsics.fv * xyd[..., 1] + intrinsics.v0], axis=-1)


def normalized_from_pixel(uv: Array, intrinsics: Intrinsics) -> Array:
    """Pixels to undistorted normalised coordinates; NaN where the model cannot be inverted."""
    y = (uv[..., 1] - intrinsics.v0) / intrinsics.fv
    x = (uv[..., 0] - intrinsics.u0 - intrinsics.skew * y) / intrinsics.fu
    return undistort(np.stack([x, y], axis=-1), intrinsics)


def project_points(points_base: Array, camera: Camera) -> Array:
    """Base points (N, 3) to pixels (N, 2); NaN where the camera cannot see them.

    That is behind the camera, or outside the fold of the distortion (`fold_radius_squared`).
    """
    R, t = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    p = (points_base - t) @ R
    z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    xy = p[..., :2] / z[..., None]
    xy[~((xy * xy).sum(axis=-1) < fold_radius_squared(camera.intrinsics))] = np.nan
    return pixel_from_normalized(distort(xy, camera.intrinsics), camera.intrinsics)


def point_jacobian(points_base: Array, camera: Camera) -> Array:
    """Derivative of `project_points` by the base point, (N, 2, 3) px/m."""
    R, i = camera.T_base_camera[:3, :3], camera.intrinsics
    p = (points_base - camera.T_base_camera[:3, 3]) @ R
    z = p[:, 2]
    x, y = p[:, 0] / z, p[:, 1] / z
    r2 = x * x + y * y
    g, dg = 1 + r2 * (i.k1 + i.k2 * r2), i.k1 + 2 * i.k2 * r2
    a = g + 2 * x * x * dg + 2 * i.p1 * y + 6 * i.p2 * x
    b = 2 * x * y * dg + 2 * i.p1 * x + 2 * i.p2 * y
    c = g + 2 * y * y * dg + 6 * i.p1 * y + 2 * i.p2 * x
    # pixel by (x, y)
    D = np.stack(
        [
            np.stack([i.fu * a + i.skew * b, i.fu * b + i.skew * c], -1),
            np.stack([i.fv * b, i.fv * c], -1),
        ],
        axis=1,
    )
    across = np.concatenate([D, -(D * np.stack([x, y], -1)[:, None]).sum(-1, keepdims=True)], -1)
    return np.asarray(across / z[:, None, None] @ R.T)


def ray_in_base(uv: Array, camera: Camera) -> Array:
    """Viewing rays in the base, ``R (x, y, 1)`` (10): (N, 3), not normalised; depth 1 along z."""
    xy = normalized_from_pixel(uv, camera.intrinsics)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    return np.asarray(rays @ camera.T_base_camera[:3, :3].T)


# --- the same on a whole cell, parts chosen by name --------------------------------------------


def project(
    cell: Cell,
    T_base_hand: Array,
    *,
    plane: Names = None,
    camera: Names = None,
    laser: Names = None,
) -> Array:
    """Pixels where the camera sees the laser spot (1)-(9).

    Parameters
    ----------
    cell : Cell
    T_base_hand : (N, 4, 4) or (4, 4), metres
    plane, camera, laser : a name, N names, or None where the cell has only one

    Returns
    -------
    (N, 2) array
        Pixels; NaN where the beam points away from the plane, the spot lies behind the camera, or
        outside the fold of its distortion.

    Raises
    ------
    DataError
        A name is unknown, or left out where the cell has several; an array has the wrong shape.
    """
    points = spot_on_beam(cell, T_base_hand, plane=plane, laser=laser)
    uv = np.full((len(points), 2), np.nan)
    for part, rows in _select(cell.cameras, camera, len(points), "camera"):
        uv[rows] = project_points(points[rows], part)
    return uv


def spot_on_beam(
    cell: Cell, T_base_hand: Array, *, plane: Names = None, laser: Names = None
) -> Array:
    """Spot as the hit of the beam on the plane, corrected (8), (9): base points (N, 3), metres.

    NaN where the beam is parallel to the plane or points away from it.
    """
    T_base_hand = _stack(T_base_hand, (4, 4), "T_base_hand")
    count = len(T_base_hand)
    u, q = np.empty((count, 3)), np.empty((count, 3))
    for part, rows in _select(cell.lasers, laser, count, "laser"):
        u[rows], q[rows] = beam_in_base(T_base_hand[rows], part)
    n, distance = _plane_arrays(cell, plane, count)
    length = beam_plane_distance(u, q, n, distance)
    length = np.where((length > 0) & (length < np.inf), length, np.nan)
    return np.asarray(q + length[:, None] * u)


def spot_on_ray(cell: Cell, uv: Array, *, plane: Names = None, camera: Names = None) -> Array:
    """Spot as the hit of the camera ray on the plane (12) with the corrected (11): (N, 3), metres.

    NaN where the ray does not meet the plane in front of the camera.
    """
    uv = _stack(uv, (2,), "uv")
    n, distance = _plane_arrays(cell, plane, len(uv))
    points = np.full((len(uv), 3), np.nan)
    for part, rows in _select(cell.cameras, camera, len(uv), "camera"):
        rays, centre = ray_in_base(uv[rows], part), part.T_base_camera[:3, 3]
        depth = beam_plane_distance(rays, centre, n[rows], distance[rows])
        depth = np.where((depth > 0) & (depth < np.inf), depth, np.nan)
        points[rows] = centre + depth[:, None] * rays
    return points


def spot_triangulated(
    cell: Cell, uv: Array, T_base_hand: Array, *, camera: Names = None, laser: Names = None
) -> Array:
    """Spot as the point nearest to beam and camera ray, corrected (14): (N, 3), metres.

    The midpoint of the shortest segment between the two lines; no plane is needed. NaN where the
    lines are parallel.
    """
    uv = _stack(uv, (2,), "uv")
    T_base_hand = _stack(T_base_hand, (4, 4), "T_base_hand")
    count = len(uv)
    if len(T_base_hand) != count:
        raise DataError(f"spot_triangulated: {count} pixels but {len(T_base_hand)} hand poses")
    points = np.full((count, 3), np.nan)
    u, q = np.empty((count, 3)), np.empty((count, 3))
    for beam, rows in _select(cell.lasers, laser, count, "laser"):
        u[rows], q[rows] = beam_in_base(T_base_hand[rows], beam)
    for part, rows in _select(cell.cameras, camera, count, "camera"):
        ray = ray_in_base(uv[rows], part)
        points[rows] = nearest_point(u[rows], q[rows], ray, part.T_base_camera[:3, 3])
    return points


def nearest_point(u: Array, q: Array, ray: Array, centre: Array) -> Array:
    """Midpoint of the shortest segment between lines ``q + a u`` and ``centre + b ray`` (14)."""
    offset = centre - q
    uu, rr, ur = (u * u).sum(-1), (ray * ray).sum(-1), (u * ray).sum(-1)
    uo, ro = (u * offset).sum(-1), (ray * offset).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = uu * rr - ur * ur
        a = (rr * uo - ur * ro) / det
        b = (ur * uo - uu * ro) / det
        return np.asarray(0.5 * (q + a[:, None] * u + centre + b[:, None] * ray))


def _stack(value: Array, shape: tuple[int, ...], name: str) -> Array:
    """The array as a stack of items of that shape; a single item becomes a stack of one."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape[-len(shape) :] != shape or array.ndim > len(shape) + 1:
        wanted = ", ".join(map(str, shape))
        raise DataError(f"{name}: expected shape ({wanted}) or (N, {wanted}), got {array.shape}")
    return array.reshape(-1, *shape)


def _plane_arrays(cell: Cell, plane: Names, count: int) -> tuple[Array, Array]:
    n, distance = np.empty((count, 3)), np.empty(count)
    for part, rows in _select(cell.planes, plane, count, "plane"):
        n[rows], distance[rows] = part.normal_base, part.distance
    return n, distance


def _select(
    parts: Mapping[str, T], names: Names, count: int, kind: str
) -> list[tuple[T, Index | slice]]:
    """Pairs (part, rows that use it)."""
    if names is None:
        if len(parts) != 1:
            raise DataError(f"{kind}: the cell has {sorted(parts)}; say which one is meant")
        names = next(iter(parts))
    wanted = [names] if isinstance(names, str) else [str(x) for x in np.unique(np.asarray(names))]
    for name in wanted:
        if name not in parts:
            raise DataError(f"{kind}: {name!r} is not in the cell, which has {sorted(parts)}")
    if isinstance(names, str):
        return [(parts[names], slice(None))]
    column = np.asarray(names, dtype=np.str_)
    if column.shape != (count,):
        raise DataError(f"{kind}: expected one name or {count} names, got {column.shape}")
    return [(parts[name], np.flatnonzero(column == name)) for name in wanted]
