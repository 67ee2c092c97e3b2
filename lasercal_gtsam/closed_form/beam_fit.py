"""Stage 2: direction and point of the beam from the reduced systems of `triangulation`.

The right beam makes the reduced system of every plane singular. `refine_beam` minimises what is
left over the four degrees of freedom of the beam, or over its point alone, by variable projection.
It needs beams in two directions on each plane, while the lifted system needs three hand
orientations, and its errors are half as large.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.triangulation import PlaneSpots, pixel_map
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of

_LARGEST_TURN_RAD = 0.3
_ROUNDING = 1e-14


def beam_residuals(planes: list[PlaneSpots], u: Array, q: Array) -> tuple[Array, Array]:
    """Residuals of all reduced systems at their best ``A, c``, and the Jacobian for the beam.

    Divided by the root of the number of rows of each plane. The Jacobian is the one of variable
    projection in Kaufman's form: the part of the change that no ``A, c`` can make up for.

    Returns
    -------
    residuals (M,) and Jacobian (M, 4) for steps of ``u`` and of ``q`` (metres) along ``E_u``
    """
    E = basis_of(u)
    residuals, jacobians = [], []
    for plane in planes:
        found = pixel_map(plane, E, E.T @ q)
        depth = plane.m @ found.c
        beam = plane.R @ u
        free = np.zeros((len(plane), 2, 4))
        # turning u by alpha along E_u turns e_i by -alpha_i u, also in tau_i = e_i'q
        along = (beam * plane.t).sum(-1) + (u @ q) / plane.rho
        turned = along * depth - (beam * (plane.m @ found.A.T)).sum(-1)
        free[:, 0, 0] = free[:, 1, 1] = turned
        free[:, 0, 2] = free[:, 1, 3] = -depth / plane.rho
        J = free.reshape(-1, 4)
        weight = 1.0 / np.sqrt(len(J))
        residuals.append(weight * found.residuals)
        jacobians.append(weight * (J - found.followed @ (found.followed.T @ J)))
    return np.concatenate(residuals), np.concatenate(jacobians)


def refine_beam(
    planes: list[PlaneSpots], u: Array, q: Array, *, point_only: bool = False, rounds: int = 30
) -> tuple[Array, Array, float]:
    """Minimise what is left of the reduced systems over the beam.

    Levenberg-Marquardt on `beam_residuals`; every plane must have beams in two directions.

    Parameters
    ----------
    u, q : start; unit direction and point in the hand frame, metres
    point_only : keep ``u``

    Returns
    -------
    u, q and the root mean square of the residuals
    """
    free = slice(2, 4) if point_only else slice(0, 4)
    r, J = beam_residuals(planes, u, q)
    cost, damping = float(r @ r), 1e-3
    for _ in range(rounds):
        scale = np.maximum(np.linalg.norm(J[:, free], axis=0), 1e-300)
        Js = J[:, free] / scale
        step = np.zeros(4)
        step[free] = -np.linalg.solve(Js.T @ Js + damping * np.eye(len(scale)), Js.T @ r) / scale
        turn = float(np.linalg.norm(step[:2]))
        step *= min(1.0, _LARGEST_TURN_RAD / max(turn, 1e-300))
        E = basis_of(u)
        new_u = u + E @ step[:2]
        new_u /= np.linalg.norm(new_u)
        new_q = q + E @ step[2:]
        new_r, new_J = beam_residuals(planes, new_u, new_q)
        new_cost = float(new_r @ new_r)
        if new_cost < cost:
            finished = cost - new_cost < 1e-6 * cost
            u, q, r, J, cost = new_u, new_q, new_r, new_J, new_cost
            damping = max(0.1 * damping, 1e-9)
        else:
            finished = damping > 1e3
            damping *= 10.0
        if finished or cost < len(planes) * _ROUNDING**2:
            break
    return u, q, float(np.sqrt(cost))
