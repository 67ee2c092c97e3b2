"""The camera from known points in the base: resection, focal lengths from planes, pose.

Image coordinates here are any affine pixels ``xy`` (the scaled ones of `spots.Spots`), so ``K``
maps normalised coordinates to those. Points are in the base, metres; the pose returned is the one
of the rest of the package, ``p_base = R p_camera + T``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.linear import dlt, homogeneous, scaled_solve
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of, nearest_rotation

_ROUNDING = 1e-12
_TILT = (
    "the images of the planes give no focal length: tilt a plane by 20 deg or more against the "
    "image, about an axis that is not the image's u or v axis"
)
FOCAL_GRID = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Focal lengths tried when nothing else gives one, in image diagonals."""


@dataclass(frozen=True)
class KnownIntrinsics:
    """What is known of a camera's intrinsics, in the coordinates of ``xy``; None: not known.

    Attributes
    ----------
    principal_point : (u0, v0)
    skew : entry K[0, 1]
    aspect : f_u / f_v
    focal_lengths : (f_u, f_v)
    centre : stands in for the principal point where the data cannot give it (the image centre)
    """

    principal_point: tuple[float, float] | None = None
    skew: float | None = None
    aspect: float | None = None
    focal_lengths: tuple[float, float] | None = None
    centre: tuple[float, float] = (0.0, 0.0)

    def matrix(self, fu: float, fv: float) -> Array:
        """``K`` (3, 3) with these focal lengths; the stand-ins are the centre and no skew."""
        u0, v0 = self.principal_point or self.centre
        return np.array([[fu, self.skew or 0.0, u0], [0.0, fv, v0], [0.0, 0.0, 1.0]])

    def imposed(self, K: Array) -> Array:
        """``K`` with the known entries put in; the focal lengths keep their geometric mean."""
        K = np.array(K)
        if self.principal_point is not None:
            K[:2, 2] = self.principal_point
        if self.skew is not None:
            K[0, 1] = self.skew
        if self.focal_lengths is not None:
            K[0, 0], K[1, 1] = self.focal_lengths
        elif self.aspect is not None:
            f = np.sqrt(K[0, 0] * K[1, 1])
            K[0, 0], K[1, 1] = f * np.sqrt(self.aspect), f / np.sqrt(self.aspect)
        return K


@dataclass(frozen=True, eq=False)
class Resection:
    """Camera matrix ``K`` (3, 3) and pose ``R`` (3, 3), ``T`` (3,) in the base."""

    K: Array
    R: Array
    T: Array


def upper_triangular_times_rotation(M: Array) -> tuple[Array, Array]:
    """RQ: ``M = K R`` with ``K`` upper triangular and positive on its diagonal, ``K[2,2]`` = 1.

    The scale of ``M`` is dropped.

    Raises
    ------
    DegenerateError
        ``det M`` is not positive (a mirrored or flat camera).
    """
    if not np.linalg.det(M) > 0:
        raise DegenerateError("the camera matrix is singular or mirrored")
    Q, U = np.linalg.qr(M[::-1].T)
    K, R = U.T[::-1, ::-1], Q.T[::-1]
    signs = np.sign(np.diag(K))
    K = K * signs
    return K / K[2, 2], signs[:, None] * R


def resection(points: Array, xy: Array) -> Resection:
    """Camera from 6 or more points that are not in one plane: 3x4 DLT, then RQ.

    Raises
    ------
    DegenerateError
        The points give a flat or mirrored camera, as points in one plane do.
    """
    if len(points) < 6:
        raise DegenerateError(f"resection needs 6 spots or more, got {len(points)}")
    P = dlt(points, xy)
    K, R_cb = upper_triangular_times_rotation(P[:, :3])
    return Resection(K, R_cb.T, np.asarray(-np.linalg.solve(P[:, :3], P[:, 3])))


def impose(camera: Resection, known: KnownIntrinsics, points: Array, xy: Array) -> Resection:
    """Put the known intrinsics into a camera and fit its pose again: rotation, then position."""
    K = known.imposed(camera.K)
    if np.array_equal(K, camera.K):
        return camera
    R = nearest_rotation(np.linalg.solve(K, camera.K) @ camera.R.T).T
    return Resection(K, R, camera_position(K, R, points, xy))


def plane_homographies(plane_xy: list[Array], xy: list[Array]) -> Array:
    """Homography ``(xy, 1) ~ G (plane coordinates, 1)`` for each plane: (P, 3, 3).

    Scaled so that the first two columns have unit norm together.
    """
    G = np.stack([dlt(a, b) for a, b in zip(plane_xy, xy, strict=True)])
    norm = np.linalg.norm(G[:, :, :2], axis=(1, 2))
    return np.asarray(G / norm[:, None, None])


def focal_lengths(G: Array, weights: Array, aspect: float | None = None) -> tuple[float, float]:
    """``f_u, f_v`` from homographies of planes, principal point at 0 and no skew (zhang, zhang_f).

    The images of an orthonormal pair satisfy ``g1' w g2 = 0`` and ``g1' w g1 = g2' w g2`` with
    ``w = diag(1/f_u^2, 1/f_v^2, 1)``, linear in the two unknowns. With an ``aspect`` f_u / f_v
    there is one unknown.

    Parameters
    ----------
    G : (P, 3, 3), `plane_homographies` in centred image coordinates
    weights : (P,), number of spots

    Raises
    ------
    DegenerateError
        No positive solution: planes parallel to the image, or normals in one coordinate plane of
        the camera while both focal lengths are free.
    """
    g1, g2 = G[:, :, 0], G[:, :, 1]
    rows = (
        np.concatenate([g1 * g2, 0.5 * (g1 * g1 - g2 * g2)]) * np.tile(np.sqrt(weights), 2)[:, None]
    )
    if np.abs(rows[:, 2]).max() <= _ROUNDING * np.abs(rows[:, :2]).max():
        raise DegenerateError(_TILT)
    if aspect is None:
        x, gap = scaled_solve(rows[:, :2], -rows[:, 2])
    else:
        x, gap = scaled_solve((rows[:, 0] / aspect**2 + rows[:, 1])[:, None], -rows[:, 2])
        x = np.array([x[0] / aspect**2, x[0]])
    if not (gap > 1e-9 and x.min() > 0 and np.isfinite(x).all()):
        raise DegenerateError(_TILT)
    fu, fv = 1.0 / np.sqrt(x)
    return float(fu), float(fv)


def rotation_from_planes(K: Array, G: Array, frames: Array, weights: Array) -> Array:
    """Camera rotation ``R`` from homographies of planes and ``K``: mean over the planes.

    Parameters
    ----------
    G : (P, 3, 3) homographies from coordinates in ``frames``
    frames : (P, 3, 3); ``[b1 b2 n]`` of each plane in the base
    weights : (P,)
    """
    C = np.linalg.solve(K, G[:, :, :2])
    U, _, Vt = np.linalg.svd(C, full_matrices=False)
    C = U @ Vt
    third = np.cross(C[:, :, 0], C[:, :, 1])
    R_cb = np.concatenate([C, third[:, :, None]], axis=2) @ np.swapaxes(frames, 1, 2)
    return nearest_rotation((weights[:, None, None] * R_cb).sum(axis=0)).T


def camera_position(K: Array, R: Array, points: Array, xy: Array) -> Array:
    """Camera position ``T`` from ``K``, ``R`` and points: rays along ``R' (X - T)``, linear."""
    rays = np.linalg.solve(K, homogeneous(xy).T).T
    rotated = points @ R
    rows = np.zeros((len(points), 2, 3))
    rows[:, :, :2] = np.eye(2)
    rows[:, :, 2] = -rays[:, :2] / rays[:, 2:]
    rhs = (rows @ rotated[..., None])[..., 0]
    local, gap = scaled_solve(rows.reshape(-1, 3), rhs.ravel())
    if not gap > 1e-9:
        raise DegenerateError("the spots of this camera coincide; spread them over the image")
    return R @ local


@dataclass(frozen=True, eq=False)
class PlaneViews:
    """Known points on planes as one camera sees them.

    Attributes
    ----------
    points : (N, 3) in the base; xy : (N, 2)
    frames : (P, 3, 3) ``[b1 b2 n]`` of each plane
    G : (P, 3, 3) `plane_homographies`
    weights : (P,) number of points
    """

    points: Array
    xy: Array
    frames: Array
    G: Array
    weights: Array

    @classmethod
    def of(cls, points: list[Array], frames: Array, xy: list[Array]) -> PlaneViews:
        """From the points of each plane (metres, base) and their images."""
        flat = [
            (X - X.mean(axis=0)) @ frame[:, :2] for X, frame in zip(points, frames, strict=True)
        ]
        counts = np.array([float(len(X)) for X in points])
        return cls(
            np.concatenate(points), np.concatenate(xy), frames, plane_homographies(flat, xy), counts
        )

    def camera_with(self, K: Array) -> Resection:
        """Pose of a camera whose ``K`` is given, from the homographies."""
        R = rotation_from_planes(K, self.G, self.frames, self.weights)
        return Resection(K, R, camera_position(K, R, self.points, self.xy))

    def camera_by_focal_lengths(self, known: KnownIntrinsics, aspect: float | None) -> Resection:
        """Focal lengths by `focal_lengths` (with a given aspect, one), then the pose.

        A skew that is not zero enters through ``skew / f_v``, so it is iterated.

        Raises
        ------
        DegenerateError
            As `focal_lengths`.
        """
        fu = fv = np.inf
        for _ in range(50):
            K = known.matrix(1.0, 1.0)
            K[0, 1] /= fv
            new_fu, new_fv = focal_lengths(
                np.asarray(np.linalg.solve(K, self.G)), self.weights, aspect
            )
            settled = abs(new_fv - fv) <= 1e-14 * new_fv or not known.skew
            fu, fv = new_fu, new_fv
            if settled:
                break
        return self.camera_with(known.matrix(fu, fv))


def cameras_from_points(
    points: list[Array],
    normals: Array,
    xy: list[Array],
    known: KnownIntrinsics,
    diagonal: float,
) -> Iterator[tuple[str, Resection]]:
    """Cameras for known points on planes, by every way there is: a name and a camera each.

    DLT (two planes or more), *zhang* (both focal lengths from the homographies of the planes),
    *zhang_f* (one focal length, or the known aspect) and the `FOCAL_GRID`. What the data do not
    allow is left out.

    Parameters
    ----------
    points : for each plane (n, 3), base, metres
    normals : (P, 3)
    xy : for each plane (n, 2)
    known : known intrinsics in the coordinates of ``xy``
    diagonal : of the image in these coordinates
    """
    if not points:
        return
    views = PlaneViews.of(points, plane_frames(normals), xy)
    if len(points) > 1:
        with suppress(DegenerateError):
            camera = resection(views.points, views.xy)
            yield "DLT", impose(camera, known, views.points, views.xy)
    if known.focal_lengths is not None:
        with suppress(DegenerateError):
            yield "known focal lengths", views.camera_with(known.matrix(*known.focal_lengths))
        return
    if known.aspect is None:
        with suppress(DegenerateError):
            yield "zhang", views.camera_by_focal_lengths(known, None)
    with suppress(DegenerateError):
        yield "zhang_f", views.camera_by_focal_lengths(known, known.aspect or 1.0)
    for f in FOCAL_GRID:
        fv = f * diagonal
        with suppress(DegenerateError):
            K = known.matrix(fv * (known.aspect or 1.0), fv)
            yield f"f = {f:g} diagonals", views.camera_with(K)


def plane_frames(normals: Array) -> Array:
    """``B_p = [b1 b2 n]`` for each plane: (P, 3, 3) rotations."""
    return np.stack([np.column_stack([basis_of(n), n]) for n in normals])
