"""One plane: the camera with known principal point and skew, corrected (36)-(54).

``F = diag(f_u, f_v, 1)`` after the principal point is moved to 0. Directions and homographies on a
common scale come from `general.plane_groups`. Three variants for the focal lengths:

- `focal_lengths_two` (43): f_u and f_v, three equations;
- `focal_length_three_rows`: f_u = f_v, the same equations, least squares;
- `rotations_two_rows` (45)-(48): f_u = f_v without the third row; two roots, and the focal length
  comes from the translation step (53).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from lasercal_gtsam.closed_form.camera import KnownIntrinsics, plane_frames
from lasercal_gtsam.closed_form.general import (
    PlaneGroups,
    plane_groups,
    planes_of_groups,
    solve_translations,
    translations,
)
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.linear import null_vector
from lasercal_gtsam.closed_form.solution import Solution
from lasercal_gtsam.closed_form.spots import Index, Spots
from lasercal_gtsam.closed_form.triangulation import SMALLEST_BEAM_SPREAD_RAD
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of, skew


def translation_images(groups: PlaneGroups) -> Array:
    """``P_g = H_g[:, :2] B_g'``: images of translations along the base axes, (G, 3, 3)."""
    return np.asarray(groups.H[:, :, :2] @ np.swapaxes(groups.B, 1, 2))


def plane_normal(groups: PlaneGroups) -> Array:
    """Normal of the plane (3,) from groups with different beams, in place of (40).

    On one scale ``P_g = G (I - u_g n' / (n.u_g))``, so the differences between groups are all
    multiples of ``n'``.

    Raises
    ------
    DegenerateError
        All beams are parallel.
    """
    check_beams(groups.beams)
    P = translation_images(groups)
    return np.asarray(np.linalg.svd((P - P.mean(axis=0)).reshape(-1, 3))[2][0])


def plane_normal_paper(P: Array, beams: Array) -> Array:
    """Normal of the plane (3,) by (40), ``P_g = s_g M [u_g]x``: kernel of ``M``.

    Needs no common scale. Homogeneous in ``M`` and the ``1 / s_g``, 9 + G unknowns.

    Parameters
    ----------
    P : (G, 3, 3), `translation_images`, each on any scale
    beams : (G, 3) in the base
    """
    count = len(P)
    P = P / np.linalg.norm(P, axis=(1, 2))[:, None, None]
    rows = np.zeros((count, 9, 9 + count))
    rows[:, :, :9] = [np.kron(np.eye(3), W.T) for W in skew(beams)]
    for g in range(count):
        rows[g, :, 9 + g] = -P[g].ravel()
    M = null_vector(rows.reshape(-1, 9 + count))[:9].reshape(3, 3)
    return np.asarray(np.linalg.svd(M)[2][-1])


def check_beams(beams: Array) -> None:
    """Refuse beams (G, 3) that are all parallel.

    Raises
    ------
    DegenerateError
        Rms angle about their mean below 0.25 deg.
    """
    s = np.linalg.svd(beams, compute_uv=False)
    if len(s) < 2 or s[1] < SMALLEST_BEAM_SPREAD_RAD * s[0]:
        raise DegenerateError(
            "all groups have parallel beams: add groups with the hand tilted, so that the beam "
            "meets the plane from another direction"
        )


def projected_basis(groups: PlaneGroups, normal: Array, b: Array) -> Array:
    """``G~ = s F R_cb b`` (3, 2) for a basis ``b`` (3, 2) of the plane (42), least squares.

    ``H_g[:, :2] = G~ b' (B_g - u_g n'B_g / (n.u_g))``.
    """
    u, B = groups.beams, groups.B
    along = (normal @ B) / (u @ normal)[:, None]
    flat = np.einsum("ai,gaj->gij", b, B - u[:, :, None] * along[:, None, :])
    left = np.concatenate(list(np.swapaxes(flat, 1, 2)))
    right = np.concatenate(list(np.swapaxes(groups.H[:, :, :2], 1, 2)))
    return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0].T)


def _quadratic_rows(basis: Array) -> Array:
    """Coefficients of ``F^-2 / s^2`` in "columns are orthonormal", ``A_f`` of (43): (3, 3)."""
    g1, g2 = basis[:, 0], basis[:, 1]
    return np.stack([g1 * g1, g2 * g2, g1 * g2])


def focal_lengths_two(basis: Array) -> tuple[float, float]:
    """``f_u, f_v`` by (43), ``A_f x_f = (1, 1, 0)'`` (the printed "= x_f =" is a slip).

    ``x_f = (1/(s f_u)^2, 1/(s f_v)^2, 1/s^2)``.

    Raises
    ------
    DegenerateError
        An entry is not positive: plane parallel to the image, or its normal in the camera's
        x-z or y-z plane.
    """
    with suppress(np.linalg.LinAlgError):
        x = np.linalg.solve(_quadratic_rows(basis), [1.0, 1.0, 0.0])
        if np.isfinite(x).all() and x.min() > 0:
            return float(np.sqrt(x[2] / x[0])), float(np.sqrt(x[2] / x[1]))
    raise DegenerateError(_TILT)


def focal_length_three_rows(basis: Array) -> float:
    """``f_u = f_v = f`` by least squares on the equations of (43), a single solution.

    Raises
    ------
    DegenerateError
        No positive solution: the plane is parallel to the image.
    """
    A = _quadratic_rows(basis)
    A = np.column_stack([A[:, 0] + A[:, 1], A[:, 2]])
    x = np.linalg.lstsq(A, np.array([1.0, 1.0, 0.0]), rcond=1e-12)[0]
    if not (np.isfinite(x).all() and x.min() > 0):
        raise DegenerateError(_TILT)
    return float(np.sqrt(x[1] / x[0]))


_TILT = (
    "the image of the plane gives no focal length: tilt the plane by 20 deg or more against the "
    "image, about an axis that is not the image's u or v axis"
)


def rotations_two_rows(basis: Array, frame: Array) -> Iterator[Array]:
    """Both ``R_cb`` with equal focal lengths from the first two rows of ``G~``, (45)-(48).

    The largest singular value of the 2x2 block is ``s f`` (47). The third row follows from the
    length of the columns up to one sign: two roots, ``R_1 = C B'`` and the corrected
    ``R_2 = (D C D) B'`` with ``D = diag(1, 1, -1)`` and ``B = [b_1 b_2 n]`` (printed ``D R D``).

    Parameters
    ----------
    basis : (3, 2) ``G~``
    frame : (3, 3) ``B``
    """
    block = basis[:2] / np.linalg.svd(basis[:2], compute_uv=False)[0]
    c31, c32 = np.sqrt(np.maximum(0.0, 1.0 - (block**2).sum(axis=0)))
    if block[:, 0] @ block[:, 1] > 0:
        c32 = -c32
    C = orthonormal_frame(np.vstack([block, [c31, c32]]))
    D = np.diag([1.0, 1.0, -1.0])
    yield C @ frame.T
    yield D @ C @ D @ frame.T


def orthonormal_frame(columns: Array) -> Array:
    """``[c_1 c_2 c_1 x c_2]`` (3, 3) with the orthonormal columns nearest to (3, 2) ones."""
    U, _, Vt = np.linalg.svd(columns, full_matrices=False)
    C = U @ Vt
    return np.column_stack([C, np.cross(C[:, 0], C[:, 1])])


def translations_two_rows(groups: PlaneGroups, R_cb: Array) -> tuple[Array, Array, float, float]:
    """``tau``, ``T``, ``lambda``, ``f`` by the corrected (53), linear in ``lambda/f``, ``lambda``.

    ``B' (R (lambda/f h_x, lambda/f h_y, lambda h_z) + T - t) = tau``, (53) across the beam in the
    base frame; printed (53) has the wrong sign of the ``T`` block and lacks an ``R_cb``.

    Raises
    ------
    DegenerateError
        Rank below 7, or a value that is not positive.
    """
    images = groups.images
    to_base = np.swapaxes(groups.B, 1, 2) @ R_cb.T
    flat = np.einsum("gij,gkj->gki", to_base[:, :, :2], images[..., :2])
    deep = np.einsum("gi,gk->gki", to_base[:, :, 2], images[..., 2])
    one: Index = np.zeros(len(groups.plane), dtype=np.int64)
    tau, T, x = solve_translations(groups, np.stack([flat, deep], axis=-1), one, 1)
    per_f, scale = float(x[0, 0]), float(x[0, 1])
    if per_f <= 0 or scale <= 0:
        raise DegenerateError("the plane comes out behind the camera")
    return tau, T, scale, scale / per_f


def solve_one_plane(
    groups: Groups, spots: Spots, u: Array, known: KnownIntrinsics
) -> Iterator[tuple[str, Solution]]:
    """All solutions of section 3.3 for the groups of one plane, with their names.

    The principal point is held: the known one, or the image centre. The skew is taken as 0, as in
    the paper; a known one is put in afterwards.

    Raises
    ------
    DegenerateError
        Where not even the plane's normal is determined; single variants that fail are left out.
    """
    centring = np.eye(3)
    centring[:2, 2] = np.negative(known.principal_point or known.centre)
    at = plane_groups(groups, u, spots.plane_count)
    at = PlaneGroups(
        centring @ at.H,
        at.B,
        at.o,
        at.s,
        at.present,
        at.plane,
        at.lines @ np.linalg.inv(centring),
        u,
    )
    normal = plane_normal(at)
    b = basis_of(normal)
    frame = plane_frames(normal[None])[0]
    basis = projected_basis(at, normal, b)

    def solution(F: Array, R_cb: Array, tau: Array, T: Array, scales: Array) -> Solution:
        normals, points = planes_of_groups(at, R_cb.T @ np.linalg.inv(F), T, scales)
        K = known.imposed(np.asarray(np.linalg.solve(centring, F)))
        K = np.asarray(np.linalg.solve(spots.scaling, K))
        return Solution(K, R_cb.T, T, u, basis_of(u) @ tau, normals, points)

    def full_rows(fu: float, fv: float) -> Solution:
        F = np.diag([fu, fv, 1.0])
        R_cb = orthonormal_frame(np.asarray(np.linalg.solve(F, basis))) @ frame.T
        return solution(F, R_cb, *translations(at, R_cb.T @ np.linalg.inv(F)))

    with suppress(DegenerateError):
        yield "fu and fv (43)", full_rows(*focal_lengths_two(basis))
    with suppress(DegenerateError):
        f = focal_length_three_rows(basis)
        yield "f, three rows (43)", full_rows(f, f)
    for root, R_cb in enumerate(rotations_two_rows(basis, frame), 1):
        with suppress(DegenerateError):
            tau, T, scale, f = translations_two_rows(at, R_cb)
            scales = np.full(len(at.lines), np.nan)
            scales[at.plane[0]] = scale
            F = np.diag([f, f, 1.0])
            yield f"f, two rows (45)-(48), root {root}", solution(F, R_cb, tau, T, scales)
