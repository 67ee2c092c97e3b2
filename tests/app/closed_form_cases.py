"""Captures with a known truth for the tests of the closed-form start."""

from __future__ import annotations

from functools import cache

import numpy as np

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.groups import Groups, find_groups
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import project
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.simulate import Noise, Simulation, simulate, simulate_cell


@cache
def exact(preset: str = "paper", seed: int = 0, groups: int | None = None) -> Simulation:
    return simulate(preset, seed, groups=groups)


@cache
def noisy(preset: str, seed: int, level: float) -> Simulation:
    return simulate(preset, seed, Noise.table1(level))


def spots_of(sim: Simulation, camera: str = "camera", laser: str = "laser") -> Spots:
    return Spots.of_pair(sim.observations, camera, laser)


def groups_of(sim: Simulation) -> Groups:
    return find_groups(spots_of(sim))


def camera_of(cell: Cell, name: str = "camera") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K, R (camera to base), T."""
    camera = cell.cameras[name]
    pose = camera.T_base_camera
    return camera.intrinsics.K, pose[:3, :3], pose[:3, 3]


def beam_of(cell: Cell, name: str = "laser") -> tuple[np.ndarray, np.ndarray]:
    return cell.lasers[name].direction_hand, cell.lasers[name].point_hand


def known_centre(sim: Simulation) -> KnownIntrinsics:
    """The true principal point in scaled pixels, and no skew."""
    scaling = spots_of(sim).scaling
    K = camera_of(sim.truth)[0]
    u0, v0, _ = scaling @ K[:, 2]
    return KnownIntrinsics(principal_point=(float(u0), float(v0)), skew=0.0)


def plane_before(camera: Camera, tilt_deg: float, azimuth_deg: float, depth: float) -> Plane:
    """Plane that the optical axis meets at a depth (m), its normal tilted against the axis."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    R, T = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    n = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    return Plane.from_point(R @ np.array(n), T + depth * R[:, 2])


def variant(
    *,
    beam: Beam | None = None,
    planes: dict[str, Plane] | None = None,
    camera: Camera | None = None,
    groups: int = 3,
    shots: int = 10,
    seed: int = 0,
    noise: Noise | None = None,
) -> Simulation:
    """The paper's cell with some parts replaced."""
    cell = exact().truth
    cell = Cell(
        {"camera": camera or cell.cameras["camera"]},
        {"laser": beam or cell.lasers["laser"]},
        planes or cell.planes,
    )
    return simulate_cell(cell, groups=groups, shots=shots, seed=seed, noise=noise)


def shots_at(cell: Cell, rotations: list[np.ndarray], positions: np.ndarray) -> Observations:
    """Spots for given hand poses, every pose on every plane; those out of view are left out."""
    poses = np.array([make_pose(R, t) for R, t in zip(rotations, positions, strict=True)])
    names = list(cell.planes)
    uv = np.concatenate([project(cell, poses, plane=name) for name in names])
    poses = np.concatenate([poses] * len(names))
    plane = np.repeat(names, len(rotations))
    seen = np.isfinite(uv).all(axis=1)
    camera = next(iter(cell.cameras.values()))
    return Observations.from_arrays(
        uv[seen], poses[seen], plane=list(plane[seen]), image_size=camera.image_size
    )


def largest_error(found: Cell, truth: Cell) -> float:
    """Largest relative error over all parts: f, centre, skew (by f), R, T, beam and planes.

    Lengths are relative to the distance of the camera from the base, beams are compared as lines.
    """
    errors = []
    for name, camera in truth.cameras.items():
        K, R, T = camera_of(truth, name)
        K2, R2, T2 = camera_of(found, name)
        errors += [np.abs(K2 - K).max() / K[0, 0], np.abs(R2 - R).max()]
        errors.append(np.linalg.norm(T2 - T) / np.linalg.norm(T))
        size = np.linalg.norm(camera.T_base_camera[:3, 3])
    for name in truth.lasers:
        u, q = beam_of(truth, name)
        u2, q2 = beam_of(found, name)
        errors += [np.abs(u2 - u).max(), np.linalg.norm(np.cross(u, q2 - q)) / size]
    for name, plane in truth.planes.items():
        other = found.planes[name]
        errors.append(np.abs(other.normal_base - plane.normal_base).max())
        errors.append(abs(other.distance - plane.distance) / size)
    return float(max(errors))
