"""Cells with a known truth: the paper's simulated cell, Table 2's kind of cell, common mounts.

Every function returns a `Cell` in SI units; the numbers in the code are in millimetres and degrees,
as in the paper, and converted here.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_from_zyx
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

IMAGE_SIZE = (640, 480)
_MAX_TRIES = 1000


def paper_cell(
    planes: int = 3, rng: np.random.Generator | None = None, *, k1: float = 0.0, k2: float = 0.0
) -> Cell:
    """The cell of the paper's simulation (section 4.1): planes "1" (a_1), "2" (a_2), "3" (random).

    Parameters
    ----------
    planes : 1, 2 or 3
    rng : draws the third plane (see `random_plane`); ``default_rng(0)`` if left out
    k1, k2 : radial distortion; the paper's simulation has none

    Raises
    ------
    DataError
        ``planes`` is not 1, 2 or 3.
    """
    if planes not in (1, 2, 3):
        raise DataError(f"paper_cell: planes must be 1, 2 or 3, got {planes!r}")
    intrinsics = Intrinsics(fu=550.0, fv=550.0, u0=320.0, v0=240.0, k1=k1, k2=k2)
    camera = Camera(intrinsics, _pose_mm_deg((510, 151, 430), (-90, -10, -170)), IMAGE_SIZE)
    beam = Beam(_direction_deg(21.80, 53.39), _mm(0, -10, 30))
    known = {
        "1": Plane.from_vector(_mm(152.41, 138.34, -163.92)),
        "2": Plane.from_vector(_mm(48.68, 31.47, -153.81)),
    }
    if planes == 3:
        rng = np.random.default_rng(0) if rng is None else rng
        known["3"] = random_plane(camera, tuple(known.values()), rng)
    names = [str(i + 1) for i in range(planes)]
    return Cell({"camera": camera}, {"laser": beam}, {name: known[name] for name in names})


def random_plane(camera: Camera, others: tuple[Plane, ...], rng: np.random.Generator) -> Plane:
    """Draw a plane in front of ``camera`` that adds information to ``others`` (method note 10.2).

    Its normal is tilted 15 to 45 deg to the optical axis, the axis meets it at a depth of 200 to
    400 mm, it makes at least 15 deg with every other plane and passes the base origin at more than
    20 mm.
    """
    R, centre = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    for _ in range(_MAX_TRIES):
        tilt = rng.uniform(15.0, 45.0) * RAD_PER_DEG
        azimuth = rng.uniform(0.0, 2 * np.pi)
        depth = rng.uniform(200.0, 400.0) * M_PER_MM
        normal = R @ _from_axis(tilt, azimuth)
        plane = Plane.from_point(normal, centre + depth * R[:, 2])
        cosines = [abs(float(plane.normal_base @ other.normal_base)) for other in others]
        apart = all(c < np.cos(15.0 * RAD_PER_DEG) for c in cosines)
        if apart and plane.distance > 20.0 * M_PER_MM:
            return plane
    raise DataError(
        f"random_plane: no plane found in {_MAX_TRIES} tries that is 15 deg away from the "
        f"{len(others)} others and 20 mm away from the base origin; give fewer planes"
    )


def table2_cell(planes: int = 2) -> Cell:
    """A cell of the kind of the paper's Table 2: a real small camera with strong distortion.

    The values are representative, not the paper's: they agree with what is known of its tests
    (a beam with phi near 89 deg; strong barrel distortion, k1 about -0.5 and k2 about 1; the
    one-plane tests' plane tilted by 34 deg with its normal 0.4 deg out of the camera's y-z plane,
    which separates f_u and f_v badly), and focal length and distance are such that the sigmas of
    the simulated tests come close to the ones measured for Table 2 (method note 9.3).

    Parameters
    ----------
    planes : 2 (as Tests 3 and 4), or 1 (as Tests 1 and 2: skew zero and the principal point at the
        image centre, since one plane cannot determine them)
    """
    if planes not in (1, 2):
        raise DataError(f"table2_cell: planes must be 1 or 2, got {planes!r}")
    distortion = {"k1": -0.5, "k2": 1.0, "p1": 0.004, "p2": -0.003}
    if planes == 1:
        intrinsics = Intrinsics(fu=905.0, fv=912.0, u0=320.0, v0=240.0, **distortion)
    else:
        intrinsics = Intrinsics(fu=905.0, fv=912.0, skew=1.6, u0=327.0, v0=246.0, **distortion)
    camera = Camera(intrinsics, _pose_mm_deg((498, 132, 330), (-91, -9, -171)), IMAGE_SIZE)
    beam = Beam(_direction_deg(1.4, 88.9), _mm(0, -41, 63))
    # asin(sin 34 cos 89.3) = 0.4 deg out of the camera's y-z plane
    found = {"1": _plane_before(camera, 34.0, 89.3, 215.0)}
    if planes == 2:
        found["2"] = _plane_before(camera, 31.0, 215.0, 205.0)
    return Cell({"camera": camera}, {"laser": beam}, found)


def tool_z_cell(planes: int = 1) -> Cell:
    """The commonest mount: beam along the tool's z axis, a horizontal table, a camera above it.

    Plane "1" is the table (z = -120 mm in the base); plane "2", if wanted, is the slope of a
    wedge of 25 deg on it. The camera looks down at 30 deg to the vertical and is turned by 25 deg
    about its axis, so that the table's normal lies in none of its coordinate planes; mild
    distortion.
    """
    if planes not in (1, 2):
        raise DataError(f"tool_z_cell: planes must be 1 or 2, got {planes!r}")
    intrinsics = Intrinsics(fu=640.0, fv=640.0, u0=320.0, v0=240.0, k1=-0.12, k2=0.08)
    target = _mm(450, 0, -120)
    T = looking_at(_mm(450 - 260, 0, -120 + 450), target, roll=25.0 * RAD_PER_DEG)
    beam = Beam(np.array([0.0, 0.0, 1.0]), _mm(0, 0, 0))
    found = {"1": Plane.from_point(np.array([0.0, 0.0, 1.0]), target)}
    if planes == 2:
        slope = 25.0 * RAD_PER_DEG
        normal = np.array([0.0, np.sin(slope), np.cos(slope)])
        found["2"] = Plane.from_point(normal, target + _mm(0, 0, 40))
    return Cell({"camera": Camera(intrinsics, T, IMAGE_SIZE)}, {"laser": beam}, found)


def looking_at(centre: Array, target: Array, roll: float = 0.0) -> Array:
    """Camera pose in the base (4, 4): optical axis from ``centre`` to ``target`` (metres).

    Without roll the image's u axis is horizontal in the base; ``roll`` (radians) turns the camera
    about its optical axis. A camera that looks straight up or down gets an arbitrary u axis.
    """
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross(z, np.array([0.0, 0.0, 1.0]))
    x = basis_of(z)[:, 0] if np.linalg.norm(x) < 1e-9 else x / np.linalg.norm(x)
    y = np.cross(z, x)
    R = np.column_stack(
        [np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, z]
    )
    return make_pose(R, centre)


def _plane_before(camera: Camera, tilt_deg: float, azimuth_deg: float, depth_mm: float) -> Plane:
    """Plane met by the optical axis at a depth, its normal tilted to an azimuth in the image."""
    R, centre = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    normal = R @ _from_axis(tilt_deg * RAD_PER_DEG, azimuth_deg * RAD_PER_DEG)
    return Plane.from_point(normal, centre + depth_mm * M_PER_MM * R[:, 2])


def _from_axis(tilt: float, azimuth: float) -> Array:
    """Unit vector at ``tilt`` from z, turned to ``azimuth`` from x (radians)."""
    return np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])


def _direction_deg(theta: float, phi: float) -> Array:
    """Beam direction (5): ``phi`` from the hand's z axis, ``theta`` about it (degrees)."""
    return _from_axis(phi * RAD_PER_DEG, theta * RAD_PER_DEG)


def _pose_mm_deg(translation: tuple[float, ...], zyx: tuple[float, ...]) -> Array:
    theta, phi, psi = (angle * RAD_PER_DEG for angle in zyx)
    return make_pose(rotation_from_zyx(theta, phi, psi), _mm(*translation))


def _mm(*values: float) -> Array:
    return np.array(values, dtype=np.float64) * M_PER_MM
