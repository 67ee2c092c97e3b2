"""How a camera, a laser or a plane moves, in coordinates that mean something.

The tangent coordinates of `report_map` suit the solver; a displacement is better described as turns
(rad) and shifts (m) about a place that does not depend on the chart: a camera's centre, the beam's
point nearest to the hand's origin, the middle of a plane's spots.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.cell import Beam, Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.incremental.belief import Part
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import spot_triangulated
from lasercal_gtsam.rotations import basis_of, rotation_log

TURNS: dict[Part, int] = {"camera": 3, "laser": 2, "plane": 2}
"""Turns come first of the coordinates of a change, shifts after them."""


def change_basis(cell: Cell, kind: Part, name: str, middle: Array) -> Array:
    """(k, k): turns and shifts of a part, small ones, to its tangent coordinates.

    Camera (6): turns and shifts along its own axes, its centre being the pivot. Laser (4): slopes
    about the beam's point nearest to the hand's origin, shifts across the beam. Plane (3): tilts
    about axes through ``middle`` (3,), the middle of its spots (base, m), and a shift along the
    normal.
    """
    if kind == "camera":
        return np.eye(6)
    if kind == "laser":
        beam = cell.lasers[name]
        D = np.eye(4)
        # the chart's offsets are those at the beam's own point, this far beyond the nearest one
        D[[2, 3], [0, 1]] = float(beam.point_hand @ beam.direction_hand)
        return D
    D = np.eye(3)
    D[2, :2] = basis_of(cell.planes[name].normal_base).T @ middle
    return D


def middle_of_spots(cell: Cell, observations: Observations, plane: str) -> Array:
    """Point of a plane (3,) in the middle of its spots, base, metres.

    The spots are triangulated (14), so that they need not lie on the plane as it is in the cell;
    their median is dropped onto it. The foot from the base origin if there are none.
    """
    seen = observations[observations.plane == plane]
    points = spot_triangulated(
        cell, seen.uv, seen.T_base_hand, camera=seen.camera.tolist(), laser=seen.laser.tolist()
    )
    points = points[np.isfinite(points).all(axis=1)]
    part = cell.planes[plane]
    middle = np.median(points, axis=0) if len(points) else part.vector
    n = part.normal_base
    return np.asarray(middle + (part.distance - float(n @ middle)) * n)


def change_between(
    before: Cell, after: Cell, kind: Part, name: str, middle: Array
) -> tuple[float, float]:
    """How far a part is turned (rad) and shifted (m) between two cells; exact for any size.

    Shift: of a camera its centre; of a beam its point nearest to the hand's origin; of a plane
    along its old normal at ``middle``.
    """
    if kind == "camera":
        A, B = before.cameras[name].T_base_camera, after.cameras[name].T_base_camera
        turn = float(np.linalg.norm(rotation_log(A[:3, :3].T @ B[:3, :3])))
        return turn, float(np.linalg.norm(B[:3, 3] - A[:3, 3]))
    if kind == "laser":
        a, b = before.lasers[name], after.lasers[name]
        shift = nearest_to_origin(b) - nearest_to_origin(a)
        return _angle(a.direction_hand, b.direction_hand), float(np.linalg.norm(shift))
    p, q = before.planes[name], after.planes[name]
    turn = _angle(p.normal_base, q.normal_base)
    turn = min(turn, np.pi - turn)
    along = float(q.normal_base @ p.normal_base)
    return turn, abs((q.distance - float(q.normal_base @ middle)) / along)


def nearest_to_origin(beam: Beam) -> Array:
    """The beam's point nearest to the hand's origin, (3,), hand frame, metres."""
    return np.asarray(
        beam.point_hand - (beam.point_hand @ beam.direction_hand) * beam.direction_hand
    )


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
