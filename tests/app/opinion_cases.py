"""Captures of simulated cells with a fault planted: what the opinions must find."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Camera, Intrinsics
from lasercal_gtsam.closed_form.groups import group_labels
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    distort,
    pixel_from_normalized,
    project_points,
)
from lasercal_gtsam.rotations import basis_of, rotation_exp
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.simulation import Simulation, simulate

Array = npt.NDArray[np.float64]

# fault -> (part, kind) that must be named
FAULTS = {
    "bent": ("plane", "bent"),
    "moved": ("plane", "moved"),
    "scale-z": ("robot", "scale"),
    "joint": ("robot", "orientation"),
    "orientations": ("robot", "orientation"),
    "lens": ("camera", "lens"),
    "fisheye": ("camera", "lens"),
}
PIXELS = Noise(pixel_px=0.3)
BENT_M, MOVED_M, SCALE = 0.0005, 0.002, 1.005
JOINT_RAD, TURN_RAD, PIVOT_M = np.deg2rad(0.3), np.deg2rad(0.2), 0.1


def labels_of(seen: Observations) -> npt.NDArray[np.int64]:
    return group_labels(seen.T_base_hand[:, :3, :3], seen.plane_index)


def capture(
    preset: str, seed: int, fault: str | None = None, noise: Noise = PIXELS
) -> tuple[Observations, Simulation]:
    """What is seen of a simulated cell with a fault: the hand poses are the commanded ones."""
    made = simulate(preset, seed)
    seen, cell = made.observations, made.truth
    rng = np.random.default_rng([seed, 77])
    camera, beam = next(iter(cell.cameras.values())), next(iter(cell.lasers.values()))
    T = _where_the_hand_was(seen, fault, rng)
    T = noise.moved_hands(T, rng)
    u, q = beam_in_base(T, beam)
    n = np.array([cell.planes[p].normal_base for p in seen.plane])
    d = np.array([cell.planes[p].distance for p in seen.plane])
    last = np.flatnonzero(seen.plane == seen.planes[-1])
    if fault == "moved":  # before the plane's second group, or its last
        g = labels_of(seen)[last]
        first = np.argmax(g != g[0]) if seed % 2 else np.argmax(g == g[-1])
        d[last[first:]] += MOVED_M
    points = q + beam_plane_distance(u, q, n, d)[:, None] * u
    if fault == "bent":  # a cylinder, by its height at the outermost spot
        axis = basis_of(n[last[0]])[:, 0]
        middle = points[last].mean(axis=0)
        half = np.abs((points[last] - middle) @ axis).max()
        for _ in range(3):
            height = np.zeros(len(d))
            height[last] = BENT_M * ((points[last] - middle) @ axis / half) ** 2
            points = q + beam_plane_distance(u, q, n, d + height)[:, None] * u
    uv = _seen_at(points, camera, fault) + noise.pixel_px * rng.standard_normal((len(d), 2))
    return replace(seen, uv=uv), made


def _where_the_hand_was(seen: Observations, fault: str | None, rng: np.random.Generator) -> Array:
    T = np.array(seen.T_base_hand)
    R = np.array(T[:, :3, :3])
    if fault == "scale-z":
        T[:, 2, 3] *= SCALE
    if fault == "scale":
        T[:, :3, 3] *= SCALE
    if fault == "joint":  # about a horizontal axis across the hand's x axis, behind the hand
        axis = np.cross([0.0, 0.0, 1.0], R[:, :, 0])
        turn = rotation_exp(JOINT_RAD * axis / np.linalg.norm(axis, axis=1)[:, None])
        pivot = T[:, :3, 3] - PIVOT_M * R[:, :, 2]
        T[:, :3, 3] = pivot + np.einsum("nij,nj->ni", turn, T[:, :3, 3] - pivot)
        T[:, :3, :3] = turn @ R
    if fault == "orientations":
        labels = labels_of(seen)
        turns = TURN_RAD * rng.standard_normal((labels.max() + 1, 3))
        T[:, :3, :3] = R @ rotation_exp(turns[labels])
    return T


def _seen_at(points: Array, camera: Camera, fault: str | None) -> Array:
    if fault not in ("lens", "fisheye"):
        return project_points(points, camera)
    p = (points - camera.T_base_camera[:3, 3]) @ camera.T_base_camera[:3, :3]
    xy = p[:, :2] / p[:, 2:]
    if fault == "lens":  # a common wide lens, calibrated without distortion
        lens = replace(camera.intrinsics, k1=-0.25, k2=0.1, p1=0.003, p2=0.0)
        return pixel_from_normalized(distort(xy, lens), lens)
    r = np.linalg.norm(xy, axis=1, keepdims=True)
    plain = Intrinsics(**{k: getattr(camera.intrinsics, k) for k in ("fu", "fv", "u0", "v0")})
    return pixel_from_normalized(xy * np.arctan(r) / r, plain)


@cache
def calibrated(
    preset: str,
    seed: int,
    fault: str | None = None,
    noise: Noise = PIXELS,
    sigma_px: float | None = None,
) -> Calibration:
    """The calibration of such a capture, from the truth; "lens" and "fisheye" undistorted."""
    seen, made = capture(preset, seed, fault, noise)
    lens = fault in ("lens", "fisheye")
    options = CalibrationOptions(
        known=made.known,
        sigma_px=sigma_px,
        distortion="none" if lens else "all",
        robust="none" if lens else "auto",
    )
    return calibrate(seen, initial=made.truth, options=options)
