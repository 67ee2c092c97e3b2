"""Stages 2-6 in the triangulation form: spots first, then the camera (recommended).

Needs the laser beam only, no groups. The spot lies on the beam, ``e_i' R_k' (X_k - t_k) = tau_i``
for i = 1, 2 with ``q = E_u tau``, and on one plane it is a homography of the pixel,
``X_k = A m_k / (c' m_k)`` with the vanishing line ``c``. Multiplied out, every spot gives two
linear equations in the 12 entries of ``A`` and ``c``, the *reduced* system::

    (R_k e_i)' A m_k - (e_i' R_k' t_k + tau_i) c'm_k = 0

With ``d_i = tau_i c`` as further unknowns it is the *lifted* system, which needs no ``tau``. Both
replace (18)-(35) of the paper and stay exact for parallel planes, where those have no solution.

The scale is fixed by ``|c| = 1`` and not by all 12 entries: then the residual of a spot is its
distance from the beam times ``c'm``, and a beam point far away cannot make all residuals small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.linear import hartley, homogeneous, transformed
from lasercal_gtsam.closed_form.spots import Index, Spots
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.units import RAD_PER_DEG

SPOTS_FOR_REDUCED = 6
SMALLEST_BEAM_SPREAD_RAD = 0.25 * RAD_PER_DEG
"""Rms angle of beams about their mean below which they count as parallel."""


@dataclass(frozen=True, eq=False)
class PlaneSpots:
    """The spots of one plane, scaled: ``m`` = Hartley's pixels, ``t`` = (hand - o) / rho.

    Attributes
    ----------
    m : (n, 3); R : (n, 3, 3); t : (n, 3)
    rows : (n,) indices of the spots
    o, rho : (3,), float; centre and rms spread of the hand positions, metres
    index : plane index
    """

    m: Array
    R: Array
    t: Array
    rows: Index
    o: Array
    rho: float
    index: int

    def __len__(self) -> int:
        return len(self.m)


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Solution of one reduced system.

    Attributes
    ----------
    A, c : (3, 3), (3,), with ``X = o + rho A m / (c'm)`` and ``|c| = 1``
    residuals : (2n,) of the scaled equations
    followed : (2n, 11) orthonormal; changes of the rows that other ``A, c`` can make up for
    """

    A: Array
    c: Array
    residuals: Array
    followed: Array


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Spots in the base without any camera.

    Attributes
    ----------
    u, q : (3,) beam in the hand frame (sign of ``u`` still free), metres
    points : (N, 3) spots in the base, metres; NaN on planes that were left out
    normals, centres : (P, 3); NaN on planes that were left out
    """

    u: Array
    q: Array
    points: Array
    normals: Array
    centres: Array


def scaled_planes(spots: Spots, smallest: int = SPOTS_FOR_REDUCED) -> list[PlaneSpots]:
    """Split the spots by plane and scale them; planes with fewer than ``smallest`` are left out."""
    planes = []
    for p in range(spots.plane_count):
        rows = spots.on_plane(p)
        if len(rows) < smallest:
            continue
        xy = spots.xy[rows]
        o = spots.t[rows].mean(axis=0)
        rho = float(np.sqrt(((spots.t[rows] - o) ** 2).sum(axis=1).mean())) or 1.0
        m = homogeneous(transformed(hartley(xy), xy))
        planes.append(PlaneSpots(m, spots.R[rows], (spots.t[rows] - o) / rho, rows, o, rho, p))
    return planes


def beam_spread(plane: PlaneSpots, u: Array) -> float:
    """Rms angle (radians) of the plane's beams in the base about their mean direction.

    At zero the reduced system has no unique solution: any shift of spots along the common
    direction is free.
    """
    beams = plane.R @ u
    s = np.linalg.svd(beams, compute_uv=False)
    return float(s[1] / s[0])


def solvable_planes(planes: list[PlaneSpots], u: Array) -> list[PlaneSpots]:
    """The planes whose beams have at least two directions."""
    return [plane for plane in planes if beam_spread(plane, u) > SMALLEST_BEAM_SPREAD_RAD]


def reduced_system(plane: PlaneSpots, E: Array, tau: Array) -> Array:
    """Rows for ``(A, c)`` with the beam point ``E_u tau`` known: (2n, 12); ``tau`` (2,) metres."""
    axes = np.swapaxes(plane.R @ E, 1, 2)
    rows = np.empty((len(plane), 2, 12))
    rows[..., :9] = (axes[..., :, None] * plane.m[:, None, None, :]).reshape(-1, 2, 9)
    offset = (axes * plane.t[:, None, :]).sum(-1) + tau / plane.rho
    rows[..., 9:] = -offset[..., None] * plane.m[:, None, :]
    return rows.reshape(-1, 12)


def pixel_map(plane: PlaneSpots, E: Array, tau: Array) -> PixelMap:
    """Solve a reduced system: eliminate ``A``, then ``c`` is a null vector of length 1.

    The sign is chosen so that ``c'm`` is positive on most spots.
    """
    system = reduced_system(plane, E, tau)
    Q, upper = np.linalg.qr(system[:, :9])
    of_c = system[:, 9:]
    on_A = Q.T @ of_c
    U, s, Vt = np.linalg.svd(of_c - Q @ on_A, full_matrices=False)
    c = Vt[-1]
    if np.sign(plane.m @ c).sum() < 0:
        c = -c
    # least squares proper only where A is not determined; the caller avoids or rejects that
    a = -np.linalg.lstsq(upper, on_A @ c, rcond=1e-13)[0]
    return PixelMap(
        a.reshape(3, 3), c, s[-1] * U[:, -1] * (c @ Vt[-1]), np.column_stack([Q, U[:, :-1]])
    )


def triangulate(planes: list[PlaneSpots], spots: Spots, u: Array, q: Array) -> Triangulated:
    """All spots in the base from direction and point of the beam: reduced systems, then planes."""
    E = basis_of(u)
    points = np.full((len(spots), 3), np.nan)
    normals = np.full((spots.plane_count, 3), np.nan)
    centres = np.full((spots.plane_count, 3), np.nan)
    for plane in solvable_planes(planes, u):
        found = pixel_map(plane, E, E.T @ q)
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = (plane.m @ found.A.T) / (plane.m @ found.c)[:, None]
        if np.isfinite(scaled).all():
            points[plane.rows] = plane.o + plane.rho * scaled
            normals[plane.index], centres[plane.index] = fit_plane(points[plane.rows])
    return Triangulated(u, q, points, normals, centres)


def fit_plane(points: Array) -> tuple[Array, Array]:
    """Unit normal and centroid of the plane nearest to points (n, 3)."""
    centre = points.mean(axis=0)
    return np.linalg.svd(points - centre, full_matrices=False)[2][-1], centre
