"""How each part differs, in turns and shifts that do not depend on anybody's chart."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from lasercal_factors.beam import BeamFrame

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import INTRINSIC_NAMES, Beam, Cell, Plane
from lasercal_gtsam.comparison.result import Motion, PartChange, PartKind
from lasercal_gtsam.comparison.together import Together
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures.spots import places_of_spots, used_spots
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.opinions.chances import f_above, holm
from lasercal_gtsam.report_map import BEAM_TANGENT, CAMERA_TANGENT, PLANE_TANGENT
from lasercal_gtsam.rotations import basis_of, rotation_log, skew
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

SURE = 0.01
"""Chance below which noise does not explain a difference."""
_TURNS = {"camera": 3, "lens": 0, "laser": 2, "plane": 2}
"""Turns come first of the coordinates of a difference, shifts after them."""
# variance of a difference, in that of two separate estimates, below which it cannot differ by noise
_RANK = 1e-8


@dataclass(frozen=True, eq=False)
class Difference:
    """A part's difference ``value`` (k,) and its derivatives (k, n) by the errors of both."""

    kind: PartKind
    name: str
    value: Array
    J_a: Array
    J_b: Array


def differences(
    a: Calibration, b: Calibration, common: Cell, at_cells: tuple[Cell, Cell]
) -> list[Difference]:
    """Every part of ``common`` (A's cell, the parts that both have) in its coordinates.

    The derivatives are by the tangent coordinates of ``common``, in their order, of either cell of
    ``at_cells`` (`Together.cells`).

    Raises
    ------
    DataError
        The beams of a laser are 90 deg or more apart.
    """
    n_camera, n_beam, n_plane = len(CAMERA_TANGENT), len(BEAM_TANGENT), len(PLANE_TANGENT)
    n = n_camera * len(common.cameras) + n_beam * len(common.lasers) + n_plane * len(common.planes)
    found: list[Difference] = []
    at = 0
    for name in common.cameras:
        A, B = a.cell.cameras[name], b.cell.cameras[name]
        J_a, J_b = _pose_jacobians(*(cell.cameras[name].T_base_camera for cell in at_cells))
        found.append(
            _placed("camera", name, _pose(A.T_base_camera, B.T_base_camera), J_a, J_b, at, n)
        )
        change = B.intrinsics.vector - A.intrinsics.vector
        found.append(_placed("lens", name, change, np.eye(9), np.eye(9), at + 6, n))
        at += n_camera
    for name in common.lasers:
        frame = _frame_at_origin(a.cell.lasers[name])
        two = b.cell.lasers[name]
        if not float(two.direction_hand @ a.cell.lasers[name].direction_hand) > 0:
            raise DataError(
                f"laser {name!r}: its beam in B is 90 deg or more away from that in A: these are "
                "two lasers, or the hand's frame is another one; give them different names"
            )
        value = frame.coordinates(two.direction_hand, two.point_hand)
        J_a, J_b = (_line_jacobian(cell.lasers[name], frame) for cell in at_cells)
        found.append(_placed("laser", name, value, J_a, J_b, at, n))
        at += n_beam
    for name in common.planes:
        p, q = a.cell.planes[name], b.cell.planes[name]
        middle = _middle(a, b, name)
        value = _flat(q, p, middle)[0] - _flat(p, p, middle)[0]
        J_a, J_b = (_flat(cell.planes[name], p, middle)[1] for cell in at_cells)
        found.append(_placed("plane", name, value, J_a, J_b, at, n))
        at += n_plane
    return found


def _placed(
    kind: PartKind, name: str, value: Array, J_a: Array, J_b: Array, at: int, n: int
) -> Difference:
    wide = [np.zeros((len(value), n)) for _ in range(2)]
    for whole, J in zip(wide, (J_a, J_b), strict=True):
        whole[:, at : at + J.shape[1]] = J
    return Difference(kind, name, value, *wide)


def _pose(A: Array, B: Array) -> Array:
    """Turn about the base's axes (rad) and shift of the centre in base (m), (6,)."""
    return np.concatenate([rotation_log(B[:3, :3] @ A[:3, :3].T), B[:3, 3] - A[:3, 3]])


def _pose_jacobians(A: Array, B: Array) -> tuple[Array, Array]:
    """Derivatives (6, 6) of `_pose`'s two ends by right perturbations of each.

    ``log(R_b exp(b) exp(-a) R_a^T)``: both errors are turned by ``R_b`` into the base, and then
    act through the inverse left Jacobian of the turn, ``I - W/2 + c W^2``.
    """
    w = rotation_log(B[:3, :3] @ A[:3, :3].T)
    angle = float(np.linalg.norm(w))
    W = skew(w)
    c = (
        1.0 / 12.0
        if angle < 1e-4
        else 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    )
    turn = (np.eye(3) - 0.5 * W + c * W @ W) @ B[:3, :3]
    J_a, J_b = np.zeros((6, 6)), np.zeros((6, 6))
    J_a[:3, :3] = J_b[:3, :3] = turn
    J_a[3:, 3:], J_b[3:, 3:] = A[:3, :3], B[:3, :3]
    return J_a, J_b


def _frame_at_origin(beam: Beam) -> BeamFrame:
    """Frame of a beam about its point nearest to the hand's origin."""
    along = float(beam.point_hand @ beam.direction_hand)
    return BeamFrame.from_line(beam.direction_hand, beam.point_hand - along * beam.direction_hand)


def _line_jacobian(beam: Beam, frame: BeamFrame) -> Array:
    """Derivative (4, 4) of a beam's coordinates in ``frame`` by those about the beam itself."""
    own = BeamFrame.from_line(beam.direction_hand, beam.point_hand)
    M = frame.R.T @ own.R
    v, q = M[:, 2], frame.R.T @ (own.t - frame.t)
    slope = v[:2] / v[2]
    by_v = np.column_stack([np.eye(2), -slope]) / v[2]  # of v[:2] / v[2]
    J = np.zeros((4, 4))
    J[:2, :2] = by_v @ M[:, :2]
    J[2:, :2] = -q[2] * J[:2, :2]
    J[2:, 2:] = M[:2, :2] - np.outer(slope, M[2, :2])
    return J


def _flat(plane: Plane, reference: Plane, middle: Array) -> tuple[Array, Array]:
    """Tilts (2,) against ``reference`` and shift along its normal at ``middle``, and derivatives.

    Tilts are ``E0^T n / n.n0``, the shift is ``(d - n.x) / n.n0``: both the same for ``-n, -d``, so
    that a normal may have been turned round (``d >= 0`` asks for that near the base's origin).
    """
    n0, E0 = reference.normal_base, basis_of(reference.normal_base)
    n, d, E = plane.normal_base, plane.distance, basis_of(plane.normal_base)
    along = float(n @ n0)
    value = np.array([*(E0.T @ n / along), (d - float(n @ middle)) / along])
    by_n = np.vstack([E0.T - np.outer(E0.T @ n, n0) / along, -middle - value[2] * n0]) / along
    J = np.column_stack([by_n @ E, [0.0, 0.0, 1.0 / along]])
    return value, J


def _middle(a: Calibration, b: Calibration, plane: str) -> Array:
    """Point (3,) of A's plane in the middle of both calibrations' spots; its foot if none."""
    part, points = a.cell.planes[plane], [np.zeros((0, 3))]
    for one in (a, b):
        rows = np.flatnonzero(used_spots(one) & (one.inputs.observations.plane == plane))
        places = places_of_spots(one, rows)
        points.append(places[np.isfinite(places).all(axis=1)])
    every = np.concatenate(points)
    if not len(every):
        return part.vector
    middle, n = np.median(every, axis=0), part.normal_base
    return np.asarray(middle + (part.distance - float(n @ middle)) * n)


def distance_of(value: Array, J_a: Array, J_b: Array, errors: Together) -> tuple[float, int, float]:
    """Mahalanobis distance of a difference, its unknowns, and the chance of so large a one.

    Directions in which noise cannot make the two differ (both hold them, or the same spots give
    them) are left out. ``T^2 / k`` has an F distribution, since the scale of the covariance comes
    from the residuals; with separate scales its degrees of freedom are Satterthwaite's.
    """
    if not errors.known:
        return np.nan, 0, np.nan
    from_a, from_b = J_a @ errors.root_a, J_b @ errors.root_b
    unit = np.sqrt(np.square(from_a).sum(axis=1) + np.square(from_b).sum(axis=1))
    free = unit > 0
    if not free.any():
        return 0.0, 0, np.nan
    from_a, from_b = (x[free] / unit[free, None] for x in (from_a, from_b))
    U, s, _ = np.linalg.svd(from_b - from_a, full_matrices=False)
    keep = s**2 > _RANK
    k = int(keep.sum())
    if not k:
        return 0.0, 0, np.nan
    white = U[:, keep] / s[keep]
    square = float(np.sum((white.T @ (value[free] / unit[free])) ** 2))
    share_a = float(np.square(white.T @ from_a).sum()) / k
    return float(np.sqrt(square)), k, f_above(square / k, k, errors.freedom(share_a))


def part_changes(found: list[Difference], errors: Together) -> tuple[PartChange, ...]:
    """Size, distance and chance of every part."""
    parts = [_change(one, errors) for one in found]
    said = [i for i, part in enumerate(parts) if np.isfinite(part.chance)]
    for i, chance in zip(said, holm([parts[i].chance for i in said]), strict=True):
        parts[i] = replace(parts[i], corrected=chance)
    changed = [i for i in said if parts[i].corrected < SURE]
    for i, motion in _alone(found, changed, errors).items():
        parts[i] = replace(parts[i], alone=motion)
    return tuple(parts)


def _alone(found: list[Difference], changed: list[int], errors: Together) -> dict[int, Motion]:
    """Motions of the parts that changed, given that the others did not: their conditional means.

    Nothing where noise does not explain the others.
    """
    rest = [one for i, one in enumerate(found) if i not in changed]
    moved = [i for i in changed if found[i].kind != "lens"]
    if not (moved and rest):
        return {}
    value = np.concatenate([one.value for one in rest])
    J_a, J_b = np.vstack([one.J_a for one in rest]), np.vstack([one.J_b for one in rest])
    if not distance_of(value, J_a, J_b, errors)[2] >= SURE:
        return {}
    root = J_b @ errors.root_b - J_a @ errors.root_a
    unit = np.linalg.norm(root, axis=1)
    root, value = root[unit > 0] / unit[unit > 0, None], value[unit > 0] / unit[unit > 0]
    motions = {}
    for i in moved:
        mine = found[i].J_b @ errors.root_b - found[i].J_a @ errors.root_a
        gain = np.linalg.lstsq(root.T, mine.T)[0].T
        motions[i] = _motion(found[i].kind, found[i].value - gain @ value, mine - gain @ root)
    return motions


def _motion(kind: PartKind, value: Array, root: Array) -> Motion:
    turns = _TURNS[kind]
    turn, turn_sigma = _size(value[:turns], root[:turns])
    shift, shift_sigma = _size(value[turns:], root[turns:])
    return Motion(
        DEG_PER_RAD * turn, DEG_PER_RAD * turn_sigma, MM_PER_M * shift, MM_PER_M * shift_sigma
    )


def _change(one: Difference, errors: Together) -> PartChange:
    distance, unknowns, chance = distance_of(one.value, one.J_a, one.J_b, errors)
    root = one.J_b @ errors.root_b - one.J_a @ errors.root_a
    motion = _motion(one.kind, one.value, root)
    known = 1.0 if errors.known else np.nan
    lens = one.kind == "lens"
    still = ~(root.any(axis=1)) & (one.value != 0.0)
    return PartChange(
        kind=one.kind,
        name=one.name,
        distance=distance,
        unknowns=unknowns,
        chance=chance,
        corrected=np.nan,
        turn_deg=np.nan if lens else motion.turn_deg,
        turn_sigma_deg=np.nan if lens else known * motion.turn_sigma_deg,
        shift_mm=np.nan if lens else motion.shift_mm,
        shift_sigma_mm=np.nan if lens else known * motion.shift_sigma_mm,
        held=tuple(INTRINSIC_NAMES[i] for i in np.flatnonzero(still))
        if lens and errors.known
        else (),
    )


def _size(value: Array, root: Array) -> tuple[float, float]:
    """Length of a vector and one sigma of it along itself."""
    length = float(np.linalg.norm(value))
    if length == 0.0:
        return 0.0, float(np.linalg.norm(root)) / max(np.sqrt(len(value)), 1.0)
    return length, float(np.linalg.norm(value @ root)) / length
