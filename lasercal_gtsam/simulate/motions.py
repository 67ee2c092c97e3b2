"""Hand motions planned so that every spot is in view (method note 10.3).

A group is a start pose and pure translations along three orthogonal axes: all its poses share one
rotation matrix, bit for bit. Candidates are drawn and judged many at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Beam, Camera, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.projection import (
    beam_plane_distance,
    distort,
    pixel_from_normalized,
    ray_in_base,
)
from lasercal_gtsam.rotations import basis_of, rotation_exp, rotation_from_zyx
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

Mask = npt.NDArray[np.bool_]

MONOTONIC_LIMIT = 0.2
_SHRINK = 0.9
_BATCH = 16
_MAX_BATCHES = 500


@dataclass(frozen=True)
class MotionDesign:
    """How hand motions are drawn. Lengths in metres, angles in radians.

    Attributes
    ----------
    beam_length : range of the distance from the beam's point in the hand to the spot at the start
    cone : half angle of the cone about the plane's normal out of which the beam comes
    roll : largest turn of the hand about the beam, either way
    longest, shortest : a translation is as long as the view allows within this range
    centre : the start's spot lies in this central fraction of the image (width and height)
    min_ahead : least distance of the spot ahead of the beam's point
    depth : range of the spot's depth before the camera
    margin_px : least distance of a spot from the image's edge
    """

    beam_length: tuple[float, float] = (80 * M_PER_MM, 160 * M_PER_MM)
    cone: float = 40 * RAD_PER_DEG
    roll: float = 40 * RAD_PER_DEG
    longest: float = 90 * M_PER_MM
    shortest: float = 35 * M_PER_MM
    centre: float = 0.5
    min_ahead: float = 15 * M_PER_MM
    depth: tuple[float, float] = (20 * M_PER_MM, 700 * M_PER_MM)
    margin_px: float = 12.0

    def __post_init__(self) -> None:
        problems = []
        for name in ("beam_length", "depth"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                problems.append(f"{name}: expected 0 < low <= high (metres), got {(low, high)}")
        if not 0 < self.shortest <= self.longest:
            problems.append(
                f"shortest, longest: expected 0 < shortest <= longest (metres), got "
                f"{self.shortest}, {self.longest}"
            )
        if not 0 <= self.cone < np.pi / 2 or not 0 <= self.roll <= np.pi:
            problems.append(
                f"cone, roll: expected radians below pi/2 and pi, got {self.cone}, {self.roll}"
            )
        if not 0 < self.centre <= 1:
            problems.append(f"centre: expected a fraction in (0, 1], got {self.centre}")
        if problems:
            raise DataError(*(f"MotionDesign.{p}" for p in problems))
        object.__setattr__(self, "roll", self.roll + 0.0)  # no -0.0: no range ends there


_NEAR = MotionDesign(centre=0.75, shortest=10 * M_PER_MM, longest=70 * M_PER_MM)
_MID = replace(_NEAR, longest=100 * M_PER_MM, beam_length=(200 * M_PER_MM, 400 * M_PER_MM))
_FAR = replace(
    _MID,
    beam_length=(400 * M_PER_MM, 800 * M_PER_MM),
    cone=50 * RAD_PER_DEG,
    roll=60 * RAD_PER_DEG,
)
DESIGNS = {
    "paper": MotionDesign(),
    "near": _NEAR,
    "mid": _MID,
    "far": _FAR,
    "near-narrow": replace(_NEAR, cone=15 * RAD_PER_DEG, roll=15 * RAD_PER_DEG),
    "table": MotionDesign(
        beam_length=(100 * M_PER_MM, 250 * M_PER_MM),
        longest=200 * M_PER_MM,
        shortest=60 * M_PER_MM,
        centre=0.6,
        depth=(20 * M_PER_MM, 1500 * M_PER_MM),
    ),
    "arbitrary": MotionDesign(centre=0.85),
}


def design_named(name: str) -> MotionDesign:
    """The design of that name out of `DESIGNS`, or a `DataError` that lists the choices."""
    if name not in DESIGNS:
        raise DataError(f"motion design {name!r} is unknown; choose one of {', '.join(DESIGNS)}")
    return DESIGNS[name]


def plan_motions(
    camera: Camera,
    beam: Beam,
    plane: Plane,
    groups: int,
    shots: int,
    design: MotionDesign,
    rng: np.random.Generator,
) -> Array:
    """Draw hand poses whose spots on ``plane`` are all in view of ``camera``.

    Parameters
    ----------
    camera, beam, plane : the true cell
    groups : number of hand rotations
    shots : poses per group: a start, then translations dealt to three orthogonal axes, evenly
        spaced along each; 1 gives poses that share no rotation
    design : ranges of the motions
    rng : source of the draws

    Returns
    -------
    (groups, shots, 4, 4) array
        Hand poses T_base_hand, metres; the rotation is the same within a group to the last bit.

    Raises
    ------
    DataError
        Not enough motions in view were found in a bounded number of tries.
    """
    poses = np.empty((0, shots, 4, 4))
    for _ in range(_MAX_BATCHES):
        R, t = _draw_starts(camera, beam, plane, design, rng)
        offsets, found = _draw_translations(camera, beam, plane, R, t, shots, design, rng)
        batch = np.zeros((_BATCH, shots, 4, 4))
        batch[:, :, :3, :3] = R[:, None]
        batch[:, :, :3, 3] = t[:, None] + offsets
        batch[:, :, 3, 3] = 1.0
        poses = np.concatenate([poses, batch[found]])
        if len(poses) >= groups:
            return poses[:groups]
    raise DataError(
        f"plan_motions: only {len(poses)} of {groups} groups of {shots} hand poses keep the spot "
        f"in view after {_MAX_BATCHES * _BATCH} tries; allow shorter translations or beam lengths, "
        f"or move plane and camera so that the optical axis meets the plane"
    )


def spot_in_view(
    camera: Camera, beam: Beam, plane: Plane, R: Array, t: Array, design: MotionDesign
) -> Mask:
    """Whether the spot of hand poses ``R`` (..., 3, 3), ``t`` (..., 3) is well in view: (...,).

    Ahead of the beam, within the depth range, inside the image by the margin, and where the
    distortion is monotonic from the axis out to the spot.
    """
    intrinsics, (width, height) = camera.intrinsics, camera.image_size
    u = R @ beam.direction_hand
    q = R @ beam.point_hand + t
    length = beam_plane_distance(u, q, plane.normal_base, plane.distance)
    with np.errstate(all="ignore"):
        points = q + length[..., None] * u
        p = (points - camera.T_base_camera[:3, 3]) @ camera.T_base_camera[:3, :3]
        xy = p[..., :2] / p[..., 2:]
        uv = pixel_from_normalized(distort(xy, intrinsics), intrinsics)
        low, high = design.margin_px, np.array([width, height]) - 1 - design.margin_px
        return np.asarray(
            (length >= design.min_ahead)
            & (p[..., 2] >= design.depth[0])
            & (p[..., 2] <= design.depth[1])
            & np.all((uv >= low) & (uv <= high), axis=-1)
            & (radial_slope(intrinsics, (xy * xy).sum(-1)) > MONOTONIC_LIMIT)
        )


def radial_slope(intrinsics: Intrinsics, r2: Array) -> Array:
    """Least slope of ``r (1 + k1 r^2 + k2 r^4)`` over radii from 0 to ``sqrt(r2)``.

    The slope ``1 + 3 k1 s + 5 k2 s^2`` is a parabola in ``s = r^2``: its least value over 0..r2
    lies at an end or, where it opens upwards, at its vertex.
    """
    k1, k2 = intrinsics.k1, intrinsics.k2
    at_end = 1 + r2 * (3 * k1 + 5 * k2 * r2)
    if k2 <= 0:
        return np.asarray(np.minimum(1.0, at_end))
    vertex = np.clip(-3 * k1 / (10 * k2), 0.0, r2)
    return np.asarray(1 + vertex * (3 * k1 + 5 * k2 * vertex))


def _draw_starts(
    camera: Camera, beam: Beam, plane: Plane, design: MotionDesign, rng: np.random.Generator
) -> tuple[Array, Array]:
    """A batch of start poses: rotations (B, 3, 3) and translations (B, 3)."""
    size = np.array(camera.image_size, dtype=np.float64)
    uv = (size - 1) / 2 + design.centre * size * (rng.random((_BATCH, 2)) - 0.5)
    rays, centre = ray_in_base(uv, camera), camera.T_base_camera[:3, 3]
    depth = beam_plane_distance(rays, centre, plane.normal_base, plane.distance)
    spots = centre + depth[:, None] * rays

    side = plane.normal_base @ centre - plane.distance
    towards_plane = -np.copysign(1.0, side) * plane.normal_base
    cos_angle = rng.uniform(np.cos(design.cone), 1.0, _BATCH)
    azimuth = rng.uniform(0.0, 2 * np.pi, _BATCH)
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], -1) @ basis_of(towards_plane).T
    sin_angle = np.sqrt(1 - cos_angle**2)
    direction = cos_angle[:, None] * towards_plane + sin_angle[:, None] * across

    posture = rotation_from_zyx(0.0, 0.0, np.pi)
    roll = rng.uniform(-design.roll, design.roll, _BATCH)
    turn = shortest_turns(posture @ beam.direction_hand, direction)
    R = rotation_exp(roll[:, None] * direction) @ turn @ posture
    length = rng.uniform(*design.beam_length, _BATCH)
    t = spots - length[:, None] * direction - R @ beam.point_hand
    return R, t


def _draw_translations(
    camera: Camera,
    beam: Beam,
    plane: Plane,
    R: Array,
    t: Array,
    shots: int,
    design: MotionDesign,
    rng: np.random.Generator,
) -> tuple[Array, Mask]:
    """Offsets (B, shots, 3) from the starts, and which starts have a whole group in view (B,).

    Along every axis of a random triad the longest length is taken, either way, that keeps all of
    the axis' spots in view.
    """
    triads = _random_rotations(rng, len(R))
    prefer_back = rng.random((len(R), 3)) < 0.5
    found = spot_in_view(camera, beam, plane, R, t, design)
    offsets = np.zeros((len(R), shots, 3))
    steps = int(np.log(design.shortest / design.longest) / np.log(_SHRINK) + 1e-9) + 1
    lengths = design.longest * _SHRINK ** np.arange(steps)
    row = 1
    for axis in range(3):
        count = (shots - 1 + 2 - axis) // 3  # the first axes take what does not divide by three
        if count == 0:
            continue
        fractions = np.arange(1, count + 1) / count
        signs = np.where(prefer_back[:, axis, None], [-1.0, 1.0], [1.0, -1.0])
        # (batch, length, sign, position): the first that is feasible is the longest, preferred way
        reach = lengths[None, :, None, None] * signs[:, None, :, None] * fractions
        move = reach[..., None] * triads[:, None, None, None, :, axis]
        places = t[:, None, None, None, :] + move
        ok = spot_in_view(camera, beam, plane, R[:, None, None, None], places, design).all(-1)
        choice = ok.reshape(len(R), -1)
        found &= choice.any(-1)
        best = choice.argmax(-1)
        chosen = move.reshape(len(R), -1, count, 3)[np.arange(len(R)), best]
        offsets[:, row : row + count] = chosen
        row += count
    return offsets, found


def _random_rotations(rng: np.random.Generator, count: int) -> Array:
    """Uniformly distributed orthonormal triads as columns: (count, 3, 3)."""
    Q, upper = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    diagonal = np.sign(np.diagonal(upper, axis1=-2, axis2=-1))
    return np.asarray(Q * diagonal[:, None, :])


def shortest_turns(start: Array, ends: Array) -> Array:
    """Shortest rotations that take the unit vector ``start`` to each of ``ends`` (N, 3)."""
    across = np.cross(start, ends)
    sin, cos = np.linalg.norm(across, axis=-1), ends @ start
    fallback = basis_of(start)[:, 0]  # any axis across will do where the vectors are (anti)parallel
    axis = np.where(sin[:, None] > 1e-12, across / np.maximum(sin, 1e-12)[:, None], fallback)
    return rotation_exp(np.arctan2(sin, cos)[:, None] * axis)
