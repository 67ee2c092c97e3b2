"""Shared by the tests of the incremental package: bumps of known size, spots after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, simulate_cell


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def bumped(
    cell: lc.Cell,
    kind: str,
    name: str,
    deg: float,
    mm: float,
    rng: np.random.Generator,
    middle: np.ndarray | None = None,
) -> lc.Cell:
    """The cell with one part turned by ``deg`` and shifted by ``mm`` in random directions.

    A camera about its centre, a laser about its point, a plane about ``middle`` and along its
    normal.
    """
    turn, shift = np.deg2rad(deg) * unit(rng.standard_normal(3)), unit(rng.standard_normal(3))
    shift *= mm * 1e-3
    if kind == "camera":
        camera = cell.cameras[name]
        T = camera.T_base_camera @ make_pose(rotation_exp(turn), np.zeros(3))
        T[:3, 3] += shift
        return with_part(cell, kind, name, replace(camera, T_base_camera=T))
    if kind == "laser":
        beam = cell.lasers[name]
        across = basis_of(beam.direction_hand)
        axis = across @ unit(rng.standard_normal(2))
        shift = mm * 1e-3 * across @ unit(rng.standard_normal(2))
        direction = rotation_exp(np.deg2rad(deg) * axis) @ beam.direction_hand
        return with_part(cell, kind, name, lc.Beam(direction, beam.point_hand + shift))
    plane = cell.planes[name]
    axis = basis_of(plane.normal_base) @ unit(rng.standard_normal(2))
    normal = rotation_exp(np.deg2rad(deg) * axis) @ plane.normal_base
    side = mm * 1e-3 * rng.choice([-1.0, 1.0])
    point = plane.vector if middle is None else middle
    return with_part(
        cell, kind, name, lc.Plane.from_point(normal, point + side * plane.normal_base)
    )


def with_part(cell: lc.Cell, kind: str, name: str, part: object) -> lc.Cell:
    return replace(cell, **{f"{kind}s": {**getattr(cell, f"{kind}s"), name: part}})


def without_part(cell: lc.Cell, kind: str, name: str) -> lc.Cell:
    rest = {k: v for k, v in getattr(cell, f"{kind}s").items() if k != name}
    return replace(cell, **{f"{kind}s": rest})


def spots_in_turn(
    cell: lc.Cell, count: int, seed: int, pixel_px: float = 0.0, hand: Noise | None = None
) -> lc.Observations:
    """``count`` spots at arbitrary poses, cycling over the planes, all in view."""
    noise = replace(hand or Noise(), pixel_px=pixel_px)
    groups = -(-count // len(cell.planes))
    made = simulate_cell(cell, groups=groups, shots=1, seed=seed, noise=noise, prefix="n")
    order = np.arange(groups * len(cell.planes)).reshape(len(cell.planes), groups).T.ravel()
    return made.observations[order[:count]]


def with_sigma(observations: lc.Observations, sigma_px: float) -> lc.Observations:
    cov = np.broadcast_to(sigma_px**2 * np.eye(2), (len(observations), 2, 2))
    return replace(observations, cov_uv=cov)


def outliers_among(
    observations: lc.Observations, rows: list[int], rng: np.random.Generator
) -> lc.Observations:
    """Some spots somewhere else in the image."""
    uv = observations.uv.copy()
    for row in rows:
        width, height = observations.image_size[str(observations.camera[row])]
        uv[row] = rng.uniform((0, 0), (width - 1, height - 1))
    return replace(observations, uv=uv)
