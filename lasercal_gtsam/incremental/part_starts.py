"""Closed-form candidates for one part of a cell, from the smallest samples of its spots.

Every function compares its candidates on all spots by a robust cost and returns them the best
first; nothing here needs a guess. Numbers in brackets are equations of the paper.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import combinations
from math import comb

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import whitening_from_covariance

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.closed_form.camera import (
    KnownIntrinsics,
    Resection,
    cameras_from_points,
    resection,
)
from lasercal_gtsam.closed_form.linear import transformed
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL, pixel_scaling
from lasercal_gtsam.errors import DegenerateError, LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import pixel_covariances
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    normalized_from_pixel,
    project_points,
    spot_on_beam,
    spot_on_ray,
    spot_triangulated,
)
from lasercal_gtsam.rotations import make_pose, rotation_exp

Index = npt.NDArray[np.int64]

_SAMPLES = 30
# spots of a sample for resection, which takes six exact ones
_RESECTED = 8
# squared length (sigmas) where a residual stops to matter, and of a spot that cannot be
_THRESHOLD = 2.385**2
_IMPOSSIBLE = 1e12
# a beam's point lies at least this far behind every spot of its own (m), and these are no farther
# from the beam than that
_AHEAD, _BESIDE = 0.02, 0.03


def planes_through_three(cell: Cell, seen: Observations) -> list[Plane]:
    """Planes through triangulated spots (14), the best first."""
    u, q = _beams(cell, seen)
    points = spot_triangulated(
        cell, seen.uv, seen.T_base_hand, camera=seen.camera.tolist(), laser=seen.laser.tolist()
    )
    X = points[_samples(points, 3)]
    across = np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0])
    size = np.linalg.norm(across, axis=1)
    good = size > 0
    n, X = across[good] / size[good, None], X[good, 0]
    distance = (n * X).sum(axis=1)
    best = _best(_costs(cell, seen, _hits(u, q, n[:, None], distance[:, None])))
    return [Plane(n[i], distance[i]) for i in best]


def beams_through_two(cell: Cell, seen: Observations, name: str) -> list[Beam]:
    """Beams through spots where the rays meet the planes (11)-(12), the best first.

    A line has two directions: that of the cell's beam of this name, which a bump does not reverse,
    or from the hand to the spots.
    """
    plane = seen.plane.tolist()
    points = spot_on_ray(cell, seen.uv, plane=plane, camera=seen.camera.tolist())
    R, t = seen.T_base_hand[:, :3, :3], seen.T_base_hand[:, :3, 3]
    points = np.einsum("nji,nj->ni", R, points - t)
    X = points[_samples(points, 2)]
    along = X[:, 1] - X[:, 0]
    size = np.linalg.norm(along, axis=1)
    good = size > 0
    u, X = along[good] / size[good, None], X[good, 0]
    if not len(u):
        return []
    seen_at = points[np.isfinite(points).all(axis=1)]
    ahead = u @ seen_at.T
    known = cell.lasers.get(name)
    forward = np.median(ahead, axis=1) if known is None else u @ known.direction_hand
    sign = np.where(forward < 0, -1.0, 1.0)[:, None]
    u, ahead = sign * u, sign * ahead
    q = X - (u * X).sum(axis=1)[:, None] * u
    # every spot of this beam is to lie ahead of its point; bad spots have no say
    across = np.linalg.norm(seen_at - q[:, None] - ahead[..., None] * u[:, None], axis=2)
    first = np.where(across < _BESIDE, ahead, np.inf).min(axis=1)
    q += np.minimum(0.0, first - _AHEAD)[:, None] * u
    u_base = np.einsum("nij,kj->kni", R, u)
    q_base = np.einsum("nij,kj->kni", R, q) + t
    n = np.array([cell.planes[p].normal_base for p in plane])
    distance = np.array([cell.planes[p].distance for p in plane])
    best = _best(_costs(cell, seen, _hits(u_base, q_base, n, distance)))
    return [Beam(u[i], q[i]) for i in best]


def cameras_from_three(
    cell: Cell, seen: Observations, name: str, intrinsics: Intrinsics | None
) -> list[Camera]:
    """Cameras from spots where the beams meet the planes (8)-(9), the best first."""
    points = spot_on_beam(
        cell, seen.T_base_hand, plane=seen.plane.tolist(), laser=seen.laser.tolist()
    )
    size = seen.image_size[name]
    if intrinsics is None:
        found = list(_resected(cell, seen, points, size))
    else:
        xy = normalized_from_pixel(seen.uv, intrinsics)
        found = [Camera(intrinsics, T, size) for T in _poses_from_three(points, xy)]
    if not found:
        return []
    cost = [_cost_of(seen, project_points(points, camera)) for camera in found]
    return [found[i] for i in _best(np.array(cost))]


def _poses_from_three(points: Array, xy: Array) -> Iterator[Array]:
    """``T_base_camera`` from samples of three points and their normalised image points."""
    import cv2

    both = np.concatenate([points, xy], axis=1)
    for rows in _samples(both, 3):
        _, turns, shifts = cv2.solveP3P(
            points[rows], xy[rows], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_P3P
        )
        for turn, shift in zip(turns, shifts, strict=True):
            T = make_pose(rotation_exp(np.asarray(turn, dtype=np.float64).ravel()).T, np.zeros(3))
            T[:3, 3] = -T[:3, :3] @ shift.ravel()
            if np.isfinite(T).all():
                yield T


def _resected(
    cell: Cell, seen: Observations, points: Array, size: tuple[int, int]
) -> Iterator[Camera]:
    """Cameras with intrinsics from known points: every way of `closed_form.camera`.

    Resection is tried on samples too, in case some spots are bad.
    """
    good = np.isfinite(points).all(axis=1)
    scaling = pixel_scaling(size)
    xy = transformed(scaling, seen.uv)
    found: list[Resection] = []
    samples = _samples(points, _RESECTED) if good.sum() > _RESECTED else ()
    for sample in (np.flatnonzero(good), *samples):
        with suppress(DegenerateError, np.linalg.LinAlgError):
            found.append(resection(points[sample], xy[sample]))
    planes = [p for p in seen.planes if (good & (seen.plane == p)).sum() >= 4]
    rows = [np.flatnonzero(good & (seen.plane == p)) for p in planes]
    normals = np.array([cell.planes[p].normal_base for p in planes])
    with suppress(DegenerateError, np.linalg.LinAlgError):
        found += [
            camera
            for _, camera in cameras_from_points(
                [points[r] for r in rows], normals, [xy[r] for r in rows],
                KnownIntrinsics(), IMAGE_DIAGONAL,
            )
        ]  # fmt: skip
    for camera in found:
        K = np.linalg.solve(scaling, camera.K)
        with suppress(LasercalError):
            lens = Intrinsics(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2])
            yield Camera(lens, make_pose(camera.R, camera.T), size)


def _samples(points: Array, size: int) -> Index:
    """Up to `_SAMPLES` sets of ``size`` of the finite points, (k, size): all of them, or a draw."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if comb(len(rows), size) <= _SAMPLES:
        chosen = list(combinations(range(len(rows)), size))
    else:
        rng = np.random.default_rng(0)
        chosen = [tuple(rng.permutation(len(rows))[:size]) for _ in range(_SAMPLES)]
    return rows[np.array(chosen, dtype=np.int64).reshape(-1, size)]


def _beams(cell: Cell, seen: Observations) -> tuple[Array, Array]:
    u, q = np.empty((len(seen), 3)), np.empty((len(seen), 3))
    for name in seen.lasers:
        rows = np.flatnonzero(seen.laser == name)
        u[rows], q[rows] = beam_in_base(seen.T_base_hand[rows], cell.lasers[name])
    return u, q


def _hits(u: Array, q: Array, n: Array, distance: Array) -> Array:
    length = beam_plane_distance(u, q, n, distance)
    return np.asarray(np.where(length > 0, length, np.nan)[..., None] * u + q)


def _costs(cell: Cell, seen: Observations, points: Array) -> Array:
    """Cost (k,) of k sets of spots (k, m, 3) against the seen pixels."""
    uv = np.full((*points.shape[:2], 2), np.nan)
    for name in seen.cameras:
        rows = np.flatnonzero(seen.camera == name)
        uv[:, rows] = project_points(points[:, rows], cell.cameras[name])
    return _cost_of(seen, uv)


def _cost_of(seen: Observations, uv: Array) -> Array:
    """Robust cost (...) of pixels (..., m, 2)."""
    W = whitening_from_covariance(pixel_covariances(seen, None))
    du, dv = np.moveaxis(uv - seen.uv, -1, 0)
    squared = (W[:, 0] * du + W[:, 1] * dv) ** 2 + (W[:, 2] * dv) ** 2
    squared = np.where(np.isnan(squared), _IMPOSSIBLE, squared)
    return np.asarray(np.log1p(squared / _THRESHOLD).sum(axis=-1))


def _best(costs: Array) -> list[int]:
    return [int(i) for i in np.argsort(costs, kind="stable")]
