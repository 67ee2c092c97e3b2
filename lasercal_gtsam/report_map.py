"""From the solver's state to the rows of the paper's Table 2, with exact derivatives.

The state is what solves well (rotation matrix, line, normal and offset); the rows are what the
paper prints: Euler angles z-y-x, beam angles and crossing point (5)-(6), plane vectors ``a`` (4).
Units of the rows: px, mm, deg. The derivatives carry the covariance over (change of variables).

Tangent coordinates (columns of the Jacobians), SI units:
camera 15: rotation 3 and translation 3 in the camera frame, then the nine intrinsics;
beam 4: slopes and intercepts ``a, b, x, y`` about a `BeamFrame`;
plane 3: normal 2 along `tangent_basis`, distance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from lasercal_factors.beam import BeamFrame

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of, zyx_from_rotation
from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

CAMERA_ROWS = (
    ("fu", "px"), ("fv", "px"), ("alpha_c", "1"), ("u0", "px"), ("v0", "px"),
    ("k1", "1"), ("k2", "1"), ("p1", "1"), ("p2", "1"),
    ("theta", "deg"), ("phi", "deg"), ("psi", "deg"), ("Tx", "mm"), ("Ty", "mm"), ("Tz", "mm"),
)  # fmt: skip
CAMERA_TANGENT = (
    "rot_x", "rot_y", "rot_z", "trans_x", "trans_y", "trans_z",
    "fu", "fv", "skew", "u0", "v0", "k1", "k2", "p1", "p2",
)  # fmt: skip
BEAM_TANGENT = ("slope_a", "slope_b", "offset_x", "offset_y")
PLANE_TANGENT = ("normal_1", "normal_2", "distance")

# below this sine the polar angle theta of the paper's (5) loses its meaning
MIN_SIN_PHI = 0.1
# below this the crossing with x = 0 runs away (method: 30 mm sigma at 0.03)
MIN_CROSSING = 0.3
AXES = "xyz"


@dataclass(frozen=True)
class BeamChart:
    """Which angles and which crossing point describe a beam.

    ``polar``: the paper's (theta, phi); otherwise, for a beam along the hand's z axis where theta
    is undefined, the tilts ``atan(ux/uz)``, ``atan(uy/uz)``. ``axis``: the coordinate plane that is
    crossed; the paper's is x = 0 (axis 0).
    """

    polar: bool
    axis: int

    @classmethod
    def of(cls, beam: Beam) -> BeamChart:
        """The paper's chart wherever it is well-behaved, else the best alternative."""
        u = np.abs(beam.direction_hand)
        axis = 0 if u[0] >= MIN_CROSSING else int(np.argmax(u))
        return cls(bool(np.hypot(u[0], u[1]) >= MIN_SIN_PHI), axis)

    @classmethod
    def having(cls, row: str, beam: Beam) -> BeamChart:
        """The chart of `of`, or the nearest one that has the row: what somebody named stays named.

        Where no chart has it, that of `of`.
        """
        usual = cls.of(beam)
        axes = [usual.axis, *np.argsort(-np.abs(beam.direction_hand)).tolist()]
        for polar in (usual.polar, not usual.polar):
            for axis in axes:
                chart = cls(polar, axis)
                if row in (name for name, _ in chart.rows):
                    return chart
        return usual

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """Row names and units."""
        names = ("laser_theta", "laser_phi") if self.polar else ("laser_tilt_x", "laser_tilt_y")
        crossing = [f"laser_{a}" for i, a in enumerate(AXES) if i != self.axis]
        return tuple((n, "deg") for n in names) + tuple((n, "mm") for n in crossing)


def camera_rows(camera: Camera) -> Array:
    """Values of `CAMERA_ROWS`, (15,)."""
    i, T = camera.intrinsics, camera.T_base_camera
    head = i.vector
    head[2] = i.alpha_c
    return np.concatenate([head, zyx_from_rotation(T[:3, :3]) * DEG_PER_RAD, T[:3, 3] * MM_PER_M])


def camera_jacobian(camera: Camera) -> Array:
    """Derivative of `camera_rows` by `CAMERA_TANGENT`, (15, 15).

    Infinite angle rows at gimbal lock (phi = +-90 deg), where the angles are not defined.
    """
    i, R = camera.intrinsics, camera.T_base_camera[:3, :3]
    F = np.zeros((15, 15))
    F[:9, 6:] = np.eye(9)
    F[2, 8] = 1 / i.fu
    F[2, 6] = -i.skew / i.fu**2
    _, phi, psi = zyx_from_rotation(R)
    s, c, cp, tp = np.sin(psi), np.cos(psi), np.cos(phi), np.tan(phi)
    F[9:12, :3] = DEG_PER_RAD * np.array([[0, s / cp, c / cp], [0, c, -s], [1, s * tp, c * tp]])
    F[12:, 3:6] = MM_PER_M * R
    return F


def beam_rows(beam: Beam, chart: BeamChart) -> Array:
    """Beam angles (deg) and crossing point (mm) in the chart, (4,); not finite where undefined."""
    u, q = beam.direction_hand, beam.point_hand
    if chart.polar:
        angles = np.array([np.arctan2(u[1], u[0]), np.arctan2(np.hypot(u[0], u[1]), u[2])])
    else:
        # atan(u / uz), so that a beam against the axis has small tilts too, not +-180 deg
        angles = np.arctan2(np.copysign(1.0, u[2]) * u[:2], abs(u[2]))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossing = np.delete(q - q[chart.axis] / u[chart.axis] * u, chart.axis)
    return np.concatenate([angles * DEG_PER_RAD, crossing * MM_PER_M])


def beam_jacobian(beam: Beam, chart: BeamChart, frame: BeamFrame) -> Array:
    """Derivative of `beam_rows` by `BEAM_TANGENT` about ``frame``, (4, 4)."""
    u = beam.direction_hand
    E = frame.R[:, :2]
    # u = R (a, b, 1) / norm: the step is projected across u and shrunk by the norm
    dU = (E - np.outer(u, u @ E)) * (u @ frame.R[:, 2])
    q = frame.t + E @ frame.coordinates(u, beam.point_hand)[2:]
    i = chart.axis
    across = np.eye(3)
    across[:, i] -= u / u[i]
    F = np.zeros((4, 4))
    if chart.polar:
        h2 = u[0] ** 2 + u[1] ** 2
        F[0, :2] = (u[0] * dU[1] - u[1] * dU[0]) / h2
        F[1, :2] = -dU[2] / np.sqrt(h2)
    else:
        for j in range(2):
            F[j, :2] = (u[2] * dU[j] - u[j] * dU[2]) / (u[j] ** 2 + u[2] ** 2)
    F[:2] *= DEG_PER_RAD
    keep = [j for j in range(3) if j != i]
    F[2:, 2:] = MM_PER_M * (across @ E)[keep]
    F[2:, :2] = -MM_PER_M * q[i] / u[i] * (across @ dU)[keep]
    return F


def plane_rows(plane: Plane) -> Array:
    """The paper's vector ``a`` (4) in mm, (3,)."""
    return plane.vector * MM_PER_M


def plane_jacobian(normal: Array, distance: float) -> Array:
    """Derivative of `plane_rows` by `PLANE_TANGENT`, (3, 3): ``da = n dd + d dn``."""
    return MM_PER_M * np.column_stack([distance * basis_of(normal), normal])


def row_names(cell: Cell, charts: dict[str, BeamChart]) -> tuple[tuple[str, str], ...]:
    """Names and units of all rows in the order of the paper's Table 2.

    Cameras first, then lasers, then planes; names are prefixed by the part's name where there are
    several cameras (or lasers).
    """
    rows: list[tuple[str, str]] = []
    for name in cell.cameras:
        rows += [(_prefix(cell.cameras, name) + row, unit) for row, unit in CAMERA_ROWS]
    for name in cell.lasers:
        rows += [(_prefix(cell.lasers, name) + row, unit) for row, unit in charts[name].rows]
    for name in cell.planes:
        rows += [(f"a_{name}_{axis}", "mm") for axis in AXES]
    return tuple(rows)


def row_values(cell: Cell, charts: dict[str, BeamChart]) -> Array:
    """Values of all rows, in the order of `row_names`."""
    parts = [camera_rows(c) for c in cell.cameras.values()]
    parts += [beam_rows(b, charts[name]) for name, b in cell.lasers.items()]
    parts += [plane_rows(p) for p in cell.planes.values()]
    return np.concatenate(parts)


def row_jacobian(cell: Cell, charts: dict[str, BeamChart], frames: dict[str, BeamFrame]) -> Array:
    """Derivative of all rows by all tangent coordinates: square, block diagonal."""
    blocks = [camera_jacobian(c) for c in cell.cameras.values()]
    blocks += [beam_jacobian(b, charts[k], frames[k]) for k, b in cell.lasers.items()]
    blocks += [plane_jacobian(p.normal_base, p.distance) for p in cell.planes.values()]
    size = sum(len(b) for b in blocks)
    F, at = np.zeros((size, size)), 0
    for block in blocks:
        F[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return F


def tangent_labels(cell: Cell) -> tuple[str, ...]:
    """Names of all tangent coordinates: ``camera.rot_x``, ``laser.slope_a``, ...."""
    labels = [f"{name}.{t}" for name in cell.cameras for t in CAMERA_TANGENT]
    labels += [f"{name}.{t}" for name in cell.lasers for t in BEAM_TANGENT]
    labels += [f"plane {name}.{t}" for name in cell.planes for t in PLANE_TANGENT]
    return tuple(labels)


def _prefix(parts: Mapping[str, object], name: str) -> str:
    return f"{name}." if len(parts) > 1 else ""
