"""Simulated views for the comparison methods, in front of the paper's camera (method note 10.3).

Ninety points for each method, as the laser method gets ninety spots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.cell import Camera
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.rotations import make_pose, rotation_exp, rotation_from_zyx
from lasercal_gtsam.simulate import Noise
from lasercal_gtsam.study.methods import EyeToHand, HandViews
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

_MARGIN_PX = 8.0
_LEAST_DEPTH_M = 80 * M_PER_MM
_MAX_TRIES = 5000
_ORIENTATIONS = 3

# a triad of orthogonal axes, each at the same angle (54.7 deg) to the third coordinate axis
_SYMMETRIC_TRIAD = np.column_stack(
    [
        [np.sqrt(2 / 3) * np.cos(a), np.sqrt(2 / 3) * np.sin(a), np.sqrt(1 / 3)]
        for a in (0.0, 2 * np.pi / 3, 4 * np.pi / 3)
    ]
)

MALM_PATTERN_M = (
    np.array([[x, y] for y in (-30.0, 30.0) for x in (-50.0, -25.0, 0.0, 25.0, 50.0)]) * M_PER_MM
)
"""(10, 2): five points 25 mm apart, in two rows 60 mm apart."""

CORNER_OBJECT_M = (
    np.array(
        [
            *([0, y, z] for y, z in ((5, 5), (75, 5), (40, 45), (5, 85), (75, 85))),
            *([x, 0, z] for x, z in ((10, 5), (95, 5), (55, 45), (10, 85), (95, 85))),
        ],
        dtype=np.float64,
    )
    * M_PER_MM
)
"""(10, 3): five points on each of two faces of a corner of 100 x 80 x 90 mm."""


@dataclass(frozen=True, eq=False)
class Views(FrozenData):
    """Simulated views with the truth.

    Attributes
    ----------
    views : noisy pixels and the commanded hand poses
    truth : camera and points in the hand
    T_hand_target : (4, 4) pose of pattern or object in the hand; identity for loose points
    """

    views: HandViews
    truth: EyeToHand
    T_hand_target: Array


@dataclass(frozen=True)
class _Design:
    """Where the hand holds its points before the camera; angles in radians, lengths in metres."""

    depth: tuple[float, float]
    tilt: tuple[float, float]
    centre: float = 0.5
    roll: float = np.pi
    lengths: tuple[float, float] = (60 * M_PER_MM, 110 * M_PER_MM)


_MA = _Design((0.26, 0.34), (0.0, 50 * RAD_PER_DEG))
_MALM = _Design((0.20, 0.30), (20 * RAD_PER_DEG, 60 * RAD_PER_DEG))
_HORAUD = _Design((0.22, 0.32), (0.0, 55 * RAD_PER_DEG), roll=50 * RAD_PER_DEG)
_MA_TRIADS = 3
_MA_JITTER_RAD = 8 * RAD_PER_DEG
_MALM_TRANSLATIONS = 2
_MALM_OUT_OF_PLANE_RAD = 30 * RAD_PER_DEG
_HORAUD_SHOTS = 9


def ma_views(camera: Camera, noise: Noise, rng: np.random.Generator) -> Views:
    """Three loose points; per orientation a start and three triads of orthogonal translations.

    The triads lie symmetrically about the optical axis, turned by some degrees; the points are
    spread over 35 mm about a place 80 mm before the flange.

    Raises
    ------
    DataError
        The camera's view is too narrow for these motions.
    """
    middle = np.array([0.0, 0.0, 80 * M_PER_MM])
    points = middle + _spread_points(rng)
    T_hand_target = make_pose(np.eye(3), middle)
    groups = []
    for _ in range(_ORIENTATIONS):
        for _ in range(_MAX_TRIES):
            start = _held_before(camera, _MA, rng, T_hand_target)
            moves = [np.zeros((1, 3))]
            for _ in range(_MA_TRIADS):
                about_axis = rotation_from_zyx(float(rng.uniform(0, 2 * np.pi)), 0.0, 0.0)
                jitter = rotation_exp(_MA_JITTER_RAD * rng.standard_normal(3) / np.sqrt(3.0))
                triad = jitter @ about_axis @ _SYMMETRIC_TRIAD
                reach = rng.uniform(*_MA.lengths, 3) * rng.choice([-1.0, 1.0], 3)
                moves.append((triad * reach).T)
            shots = _moved(camera, start, np.concatenate(moves))
            if _in_view(camera, shots, points):
                groups.append(shots)
                break
        else:
            _give_up("Ma's")
    return _take(camera, np.concatenate(groups), points, np.eye(4), noise, rng)


def malm_views(camera: Camera, noise: Noise, rng: np.random.Generator) -> Views:
    """`MALM_PATTERN_M`, 70 mm before the flange; per orientation a start and two translations.

    The pattern is tilted 20 to 60 deg to the image; the translations are orthogonal to each other
    and make 30 deg or more with the pattern.

    Raises
    ------
    DataError
        As in `ma_views`.
    """
    T_hand_target = make_pose(np.eye(3), np.array([0.0, 0.0, 70 * M_PER_MM]))
    flat = np.column_stack([MALM_PATTERN_M, np.zeros(len(MALM_PATTERN_M))])
    points = flat + T_hand_target[:3, 3]
    groups = []
    for _ in range(_ORIENTATIONS):
        for _ in range(_MAX_TRIES):
            start = _held_before(camera, _MALM, rng, T_hand_target)
            normal = camera.T_base_camera[:3, :3].T @ start[:3, 2]
            directions = np.linalg.qr(rng.standard_normal((3, _MALM_TRANSLATIONS)))[0].T
            reach = rng.uniform(*_MALM.lengths, (_MALM_TRANSLATIONS, 1))
            shots = _moved(camera, start, np.concatenate([np.zeros((1, 3)), reach * directions]))
            out = np.all(np.abs(directions @ normal) >= np.sin(_MALM_OUT_OF_PLANE_RAD))
            if out and _in_view(camera, shots, points):
                groups.append(shots)
                break
        else:
            _give_up("Malm and Heyden's")
    return _take(camera, np.concatenate(groups), points, T_hand_target, noise, rng)


def horaud_views(camera: Camera, noise: Noise, rng: np.random.Generator) -> Views:
    """`CORNER_OBJECT_M`, 90 mm before the flange, in nine poses that share nothing.

    Raises
    ------
    DataError
        As in `ma_views`.
    """
    T_hand_target = make_pose(np.eye(3), np.array([20.0, -20.0, 90.0]) * M_PER_MM)
    points = CORNER_OBJECT_M + T_hand_target[:3, 3]
    shots = []
    for _ in range(_HORAUD_SHOTS):
        for _ in range(_MAX_TRIES):
            pose = _held_before(camera, _HORAUD, rng, make_pose(np.eye(3), points.mean(axis=0)))
            if _in_view(camera, pose[None], points):
                shots.append(pose)
                break
        else:
            _give_up("Horaud and Dornaika's")
    return _take(camera, np.array(shots), points, T_hand_target, noise, rng)


def _spread_points(rng: np.random.Generator) -> Array:
    """Three points within +-35 mm that are far from one line (second singular value 20 mm)."""
    for _ in range(_MAX_TRIES):
        points = rng.uniform(-35.0, 35.0, (3, 3))
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] > 20.0:
            return np.asarray(points * M_PER_MM)
    raise DataError("study: no three points off one line were drawn")


def _held_before(
    camera: Camera, design: _Design, rng: np.random.Generator, T_hand_target: Array
) -> Array:
    """Hand pose (4, 4) that holds the target's origin in the middle of the view, facing it."""
    width, height = camera.image_size
    size = np.array([width, height], dtype=np.float64)
    uv = (size - 1) / 2 + design.centre * size * (rng.random(2) - 0.5)
    ray = np.linalg.solve(camera.intrinsics.K, np.append(uv, 1.0))
    place = rng.uniform(*design.depth) * ray
    azimuth, tilt = rng.uniform(0.0, 2 * np.pi), rng.uniform(*design.tilt)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    roll = rotation_from_zyx(float(rng.uniform(-design.roll, design.roll)), 0.0, 0.0)
    R_camera_hand = rotation_exp(tilt * axis) @ rotation_from_zyx(0.0, 0.0, np.pi) @ roll
    R = camera.T_base_camera[:3, :3] @ R_camera_hand
    origin = camera.T_base_camera[:3, :3] @ place + camera.T_base_camera[:3, 3]
    return make_pose(R, origin - R @ T_hand_target[:3, 3])


def _moved(camera: Camera, start: Array, moves: Array) -> Array:
    """The start and its translations by ``moves`` (M, 3) in camera axes: (M, 4, 4)."""
    shots = np.repeat(start[None], len(moves), axis=0)
    shots[:, :3, 3] += moves @ camera.T_base_camera[:3, :3].T
    return shots


def _in_view(camera: Camera, T_base_hand: Array, points: Array) -> bool:
    width, height = camera.image_size
    R, T = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    base = points @ np.swapaxes(T_base_hand[:, :3, :3], 1, 2) + T_base_hand[:, None, :3, 3]
    seen = (base - T) @ R
    if not (seen[..., 2] > _LEAST_DEPTH_M).all():
        return False
    uv = EyeToHand(camera.intrinsics.K, camera.T_base_camera, points).predicted(T_base_hand)
    high = np.array([width, height]) - 1 - _MARGIN_PX
    return bool(np.all((uv >= _MARGIN_PX) & (uv <= high)))


def _take(
    camera: Camera,
    T_base_hand: Array,
    points: Array,
    T_hand_target: Array,
    noise: Noise,
    rng: np.random.Generator,
) -> Views:
    truth = EyeToHand(camera.intrinsics.K, camera.T_base_camera, points)
    uv = truth.predicted(noise.moved_hands(T_base_hand, rng))
    uv = uv + noise.pixel_px * rng.standard_normal(uv.shape)
    return Views(HandViews(uv, T_base_hand, camera.image_size), truth, T_hand_target)


def _give_up(whose: str) -> None:
    raise DataError(
        f"study: no motions for {whose} method keep its points in the camera's view; it needs a "
        "wider view at 0.2 to 0.35 m. Leave the method out, or take another cell"
    )
