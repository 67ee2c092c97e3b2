"""Direction and point of the beam from the systems of `triangulation`, for any hand poses.

The right direction makes the lifted system of every plane singular, the right direction and point
the reduced one. No groups of motions are needed:

1. `trial_directions` ranks a hemisphere of directions by smallest singular values;
2. `search_beams` refines the best together with the beam point (`beam_fit.refine_beam`).
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.beam_fit import refine_beam
from lasercal_gtsam.closed_form.direction import best_distinct_index, hemisphere
from lasercal_gtsam.closed_form.triangulation import (
    SMALLEST_BEAM_SPREAD_RAD,
    PlaneSpots,
    solvable_planes,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.units import RAD_PER_DEG

SPOTS_FOR_SEARCH = 10
"""Spots a plane needs before its lifted system says anything of the direction."""
HEMISPHERE_POINTS = 500
_DISTINCT_RAD = 12.0 * RAD_PER_DEG
_FIRST_ROUNDS = 8
_MERGED_RAD = 0.5 * RAD_PER_DEG


def direction_forms(plane: PlaneSpots) -> tuple[Array, Array]:
    """The systems of one plane as quadratic forms in the direction, whatever the number of spots.

    Both systems are linear in the axes ``e_i``, and ``e_1 e_1' + e_2 e_2' = I - u u'``. So the
    normal matrix of the reduced system for ``tau = 0``, and that of the lifted system after
    ``d_1, d_2`` are eliminated, are ``sum_ab (I - u u')_ab W_ab`` with constant 12 x 12 matrices.

    Returns
    -------
    reduced, lifted : (3, 3, 12, 12) each, divided by the number of spots
    """
    n = len(plane)
    rotated_t = (plane.t[:, None, :] @ plane.R)[:, 0]
    # row of the reduced system for the hand axis a: ((R_k)_{.a} x m, -(R_k' t)_a m)
    coefficient = np.concatenate([np.swapaxes(plane.R, 1, 2), -rotated_t[:, :, None]], axis=2)
    rows = coefficient[:, :, :, None] * plane.m[:, None, None, :]
    rows = rows.reshape(n, 3, 12)
    flat = rows.reshape(n, 36)
    reduced = (flat.T @ flat / n).reshape(3, 12, 3, 12).transpose(0, 2, 1, 3)
    mixed = (flat.T @ plane.m / n).reshape(36, 3)
    gram = plane.m.T @ plane.m / n
    explained = (mixed @ np.linalg.solve(gram, mixed.T)).reshape(3, 12, 3, 12)
    return reduced, reduced - explained.transpose(0, 2, 1, 3)


def direction_costs(form: Array, u: Array) -> Array:
    """Smallest eigenvalue of a form of `direction_forms` for directions (D, 3): (D,)."""
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    matrices = (across.reshape(-1, 9) @ form.reshape(9, 144)).reshape(-1, 12, 12)
    return np.asarray(np.maximum(np.linalg.eigvalsh(matrices)[:, 0], 0.0))


def trial_directions(planes: list[PlaneSpots], keep: int = 6) -> Array:
    """Directions on a hemisphere with the lowest costs, at least 12 deg apart: (<= 2 ``keep``, 3).

    Half of them by the lifted systems; half by the reduced ones with the beam through the hand's
    origin, which serves where the spots or orientations are too few for the lifted ones.
    """
    u = hemisphere(HEMISPHERE_POINTS)
    chosen: list[int] = []
    forms = [direction_forms(plane) for plane in planes]
    for kind in (1, 0):
        least = SPOTS_FOR_SEARCH if kind == 1 else 0
        used = [
            form[kind] for plane, form in zip(planes, forms, strict=True) if len(plane) >= least
        ]
        if used:
            cost = np.sum([direction_costs(form, u) for form in used], axis=0)
            chosen += [int(i) for i in best_distinct_index(u, cost, keep, _DISTINCT_RAD)]
    return u[list(dict.fromkeys(chosen))]


def search_beams(planes: list[PlaneSpots], keep: int = 4) -> list[tuple[Array, Array]]:
    """Beams (u, q) that fit the spots of all planes best, from no start, best first.

    Raises
    ------
    DegenerateError
        The planes with two hand orientations or more have too few spots: fewer equations than
        unknowns (11 a plane and 4 of the beam).
    """
    planes = [plane for plane in planes if _orientation_spread(plane) > SMALLEST_BEAM_SPREAD_RAD]
    surplus = sum(2 * len(plane) - 11 for plane in planes)
    if surplus < 4:
        raise DegenerateError(
            "the search without groups needs 8 spots or more on one plane, or 7 on each of two, "
            "made with different hand orientations, and 10 or more are advisable"
        )
    found = []
    for u in trial_directions(planes):
        usable = solvable_planes(planes, u)
        if usable:
            found.append(refine_beam(usable, u, np.zeros(3), rounds=_FIRST_ROUNDS))
    found.sort(key=lambda beam: beam[2])
    u, cost = np.array([beam[0] for beam in found]), np.array([beam[2] for beam in found])
    best = best_distinct_index(u, cost, keep, _MERGED_RAD)
    polished = [
        refine_beam(usable, *found[i][:2])
        for i in best
        if (usable := solvable_planes(planes, found[i][0]))
    ]
    return [(u, q) for u, q, _ in sorted(polished, key=lambda beam: beam[2])]


def _orientation_spread(plane: PlaneSpots) -> float:
    """Rms angle (radians) of a plane's hand orientations about their mean, roughly."""
    return float(np.linalg.norm(plane.R - plane.R.mean(axis=0)) / np.sqrt(2.0 * len(plane)))
