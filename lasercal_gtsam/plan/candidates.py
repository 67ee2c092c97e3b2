"""Hand poses to choose from: a few rotations on each plane, spots all over the view."""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Names
from lasercal_gtsam.plan.limits import Limits
from lasercal_gtsam.projection import beam_plane_distance, ray_in_base
from lasercal_gtsam.rotations import basis_of, rotation_exp
from lasercal_gtsam.simulate.motions import MotionDesign, shortest_turns, spot_in_view

_ROUNDS = 6


def candidate_poses(
    cell: Cell,
    camera: str,
    laser: str,
    rotations: int,
    shots: int,
    limits: Limits,
    rng: np.random.Generator,
) -> tuple[Array, Names]:
    """Draw poses whose spots are in view and whose hands are within the limits.

    Poses of one rotation are translations of each other, which is what the closed form starts from;
    so a plan out of few rotations needs no guess of the cell.

    Parameters
    ----------
    rotations : hand rotations on each plane
    shots : poses of each rotation, at most

    Returns
    -------
    (N, 4, 4) array and (N,) names of planes

    Raises
    ------
    DataError
        The limits leave no pose on one of the planes.
    """
    poses, planes = [], []
    for name in cell.planes:
        found = [
            T
            for _ in range(_ROUNDS * rotations)
            if len(T := _one_rotation(cell, camera, laser, name, shots, limits, rng))
        ]
        # the rotations that leave most of the picture within reach
        found = sorted(found, key=len, reverse=True)[:rotations]
        if not found:
            raise DataError(
                f"plan: within the limits the laser meets plane {name!r} nowhere in the camera's "
                "view; allow longer beams, a wider cone, more reach, or check the cell"
            )
        poses += found
        planes += [name] * sum(len(T) for T in found)
    return np.concatenate(poses), np.array(planes)


def _one_rotation(
    cell: Cell,
    camera: str,
    laser: str,
    plane: str,
    shots: int,
    limits: Limits,
    rng: np.random.Generator,
) -> Array:
    """Poses (n, 4, 4) of one random rotation, spots spread over the picture."""
    seen, beam, part = cell.cameras[camera], cell.lasers[laser], cell.planes[plane]
    n, d, centre = part.normal_base, part.distance, seen.T_base_camera[:3, 3]
    towards = -np.copysign(1.0, n @ centre - d) * n
    cos_angle = rng.uniform(np.cos(limits.cone), 1.0)
    azimuth = rng.uniform(0.0, 2 * np.pi)
    across = basis_of(towards) @ np.array([np.cos(azimuth), np.sin(azimuth)])
    direction = cos_angle * towards + np.sqrt(1 - cos_angle**2) * across
    turn = shortest_turns(limits.posture @ beam.direction_hand, direction[None])[0]
    roll = rng.uniform(-limits.roll, limits.roll)
    R = rotation_exp(roll * direction) @ turn @ limits.posture
    size = np.array(seen.image_size, dtype=np.float64)
    low = limits.margin_px
    uv = low + (size - 1 - 2 * low) * rng.random((shots, 2))
    rays = ray_in_base(uv, seen)
    depth = beam_plane_distance(rays, centre, n, d)
    spots = centre + depth[:, None] * rays
    length = rng.uniform(*limits.beam_length, shots)
    T = np.tile(np.eye(4), (shots, 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = spots - length[:, None] * direction - R @ beam.point_hand
    design = MotionDesign(
        min_ahead=0.5 * limits.beam_length[0], depth=limits.depth, margin_px=limits.margin_px - 1e-6
    )
    good = np.isfinite(spots).all(axis=1) & limits.allow(cell, camera, plane, T)
    good[good] = spot_in_view(seen, beam, part, T[good, :3, :3], T[good, :3, 3], design)
    return T[good]
