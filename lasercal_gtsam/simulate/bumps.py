"""A cell in which something was knocked, and spots that come one after the other since."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from lasercal_gtsam.cell import Beam, Cell, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.rotations import basis_of, rotation_exp
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.simulation import simulate_cell


def bumped(
    cell: Cell,
    kind: Literal["camera", "laser", "plane"],
    name: str,
    turn_rad: float,
    shift_m: float,
    rng: np.random.Generator,
    middle: Array | None = None,
) -> Cell:
    """The cell with one part displaced in random directions by given amounts.

    A camera is turned about its centre and shifted; a laser is turned about its point in the hand,
    about an axis across the beam, and shifted across; a plane is tilted about an axis in it through
    ``middle`` (3,) (base, metres; the foot from the base origin if left out) and shifted along its
    normal, either way.
    """
    if kind == "camera":
        camera = cell.cameras[name]
        T = camera.T_base_camera.copy()
        T[:3, :3] = T[:3, :3] @ rotation_exp(turn_rad * _unit(rng.standard_normal(3)))
        T[:3, 3] += shift_m * _unit(rng.standard_normal(3))
        cameras = {**cell.cameras, name: replace(camera, T_base_camera=T)}
        return replace(cell, cameras=cameras)
    if kind == "laser":
        beam = cell.lasers[name]
        across = basis_of(beam.direction_hand)
        turn = rotation_exp(turn_rad * across @ _unit(rng.standard_normal(2)))
        point = beam.point_hand + shift_m * across @ _unit(rng.standard_normal(2))
        lasers = {**cell.lasers, name: Beam(turn @ beam.direction_hand, point)}
        return replace(cell, lasers=lasers)
    plane = cell.planes[name]
    n = plane.normal_base
    tilt = rotation_exp(turn_rad * basis_of(n) @ _unit(rng.standard_normal(2)))
    point = plane.vector if middle is None else middle
    point = point + shift_m * rng.choice([-1.0, 1.0]) * n
    return cell.with_planes({**cell.planes, name: Plane.from_point(tilt @ n, point)})


def spots_in_turn(
    cell: Cell, count: int, seed: int, noise: Noise | None = None, prefix: str = "n"
) -> Observations:
    """``count`` spots at arbitrary hand poses, one plane after the other, all in view.

    Raises
    ------
    DataError
        No poses were found that keep the spots in view.
    """
    planes = len(cell.planes)
    groups = -(-count // planes)
    made = simulate_cell(cell, groups=groups, shots=1, seed=seed, noise=noise, prefix=prefix)
    order = np.arange(groups * planes).reshape(planes, groups).T.ravel()
    return made.observations[order[:count]]


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))
