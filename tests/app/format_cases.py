"""Calibrations with any pose and covariance, and rotations written out from their definitions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from core_cases import simulated
from hypothesis import strategies as st

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate

CAMERA = "camera"
# of the camera's 15 coordinates: rad, m, px, 1
SCALES = np.array([1e-3] * 3 + [1e-4] * 3 + [2, 2, 0.5, 4, 4, 0.02, 0.1, 1e-3, 1e-3])


@cache
def calibrated(skew_held: bool = True, pixel_px: float = 0.3) -> lc.Calibration:
    """Ninety spots on three planes; by default with the skew held at 0."""
    known = {"skew": 0.0} if skew_held else {}
    seen = simulated("paper", 1, pixel_px).observations
    return lc.calibrate(seen, options=lc.CalibrationOptions(known=known))


@cache
def two_cameras() -> lc.Calibration:
    """Two cameras; as simulated, with a made-up second camera, not estimated."""
    one = calibrated()
    first = one.cell.cameras[CAMERA]
    other = replace(first, T_base_camera=pose(rotation_zyx(0.4, -0.2, 2.9), [0.7, -0.2, 0.5]))
    labels = [x for x in one.labels if x.startswith("camera.")]
    rest = [x for x in one.labels if not x.startswith("camera.")]
    names = [*(f"left.{x[7:]}" for x in labels), *(f"right.{x[7:]}" for x in labels), *rest]
    n = len(names)
    A = np.random.default_rng(3).normal(size=(n, n))
    cell = replace(one.cell, cameras={"left": first, "right": other})
    return replace(one, cell=cell, labels=tuple(names), covariance=1e-6 * A @ A.T)


def with_pose(T: np.ndarray, covariance: np.ndarray | None = None) -> lc.Calibration:
    """The calibration with another pose, and another covariance of the camera (15, 15)."""
    base = calibrated()
    camera = replace(base.cell.cameras[CAMERA], T_base_camera=T)
    joint = base.covariance.copy()
    if covariance is not None:
        joint[:] = 0.0
        joint[:15, :15] = covariance
    return replace(base, cell=replace(base.cell, cameras={CAMERA: camera}), covariance=joint)


def random_covariance(seed: int, scales: np.ndarray = SCALES) -> np.ndarray:
    """Positive definite, strongly correlated, with these sigmas up to a factor of some units."""
    A = np.random.default_rng(seed).normal(size=(len(scales), len(scales))) * scales[:, None]
    return A @ A.T


def pose(R: np.ndarray, t: object) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def rotation_of_quaternion(w: float, x: float, y: float, z: float) -> np.ndarray:
    """From ``v -> q v q*``, column by column."""

    def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        v = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
        return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], v])

    q = np.array([w, x, y, z]) / np.sqrt(w * w + x * x + y * y + z * z)
    back = q * [1, -1, -1, -1]
    axes = np.column_stack([np.zeros(3), np.eye(3)])
    return np.column_stack([times(times(q, axis), back)[1:] for axis in axes])


def rotation_zyx(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """``Rz(yaw) Ry(pitch) Rx(roll)``, the definition of a URDF's rpy."""
    (a, b, c), (p, q, r) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    Rz = np.array([[a, -p, 0], [p, a, 0], [0, 0, 1]])
    Ry = np.array([[b, 0, q], [0, 1, 0], [-q, 0, b]])
    Rx = np.array([[1, 0, 0], [0, c, -r], [0, r, c]])
    return Rz @ Ry @ Rx


def exp(w: np.ndarray) -> np.ndarray:
    """Rotation by its power series: slow, simple, for small vectors."""
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    R, term = np.eye(3), np.eye(3)
    for k in range(1, 25):
        term = term @ W / k
        R = R + term
    return R


def _pose_of(q: list[float], t: list[float]) -> np.ndarray:
    return pose(rotation_of_quaternion(*q), t)


_parts = st.floats(-1, 1, allow_subnormal=False)
_quaternions = st.lists(_parts, min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3)
_metres = st.lists(st.floats(-30, 30, allow_subnormal=False), min_size=3, max_size=3)
_angles = st.floats(-np.pi, np.pi, allow_subnormal=False)
_nearly_upright = st.builds(
    lambda sign, power, yaw, roll, t: pose(
        rotation_zyx(yaw, sign * (np.pi / 2 - 10.0**-power), roll), t
    ),
    st.sampled_from([-1, 1]), st.integers(1, 17), _angles, _angles, _metres,
)  # fmt: skip
poses = st.one_of(st.builds(_pose_of, _quaternions, _metres), _nearly_upright)
"""Any pose; every second one has a pitch within 0.1 rad to 1e-17 rad of +-90 deg."""


@cache
def skewed(skew: float = 4.0) -> lc.Calibration:
    """A cell whose skew is many sigmas from 0."""
    simulation = simulate("paper", 2, Noise(pixel_px=0.0))
    cell = simulation.truth
    camera = cell.cameras[CAMERA]
    bent = replace(camera, intrinsics=replace(camera.intrinsics, skew=skew))
    bent_cell = replace(cell, cameras={CAMERA: bent})
    seen = simulation.observations
    uv = lc.project(bent_cell, seen.T_base_hand, plane=seen.plane.tolist())
    noise = np.random.default_rng(5).normal(scale=0.05, size=uv.shape)
    return lc.calibrate(replace(seen, uv=uv + noise))
