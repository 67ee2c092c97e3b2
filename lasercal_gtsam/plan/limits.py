"""Where the hand may go, and how far the picture's edge stays away."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.rotations import rotation_from_zyx
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG

Mask = npt.NDArray[np.bool_]


def _tool_down() -> Array:
    return rotation_from_zyx(0.0, 0.0, np.pi)


@dataclass(frozen=True, eq=False)
class Limits(FrozenData):
    """Limits of a plan. Lengths in metres, angles in radians, base frame.

    Attributes
    ----------
    beam_length : range of the distance from the beam's point in the hand to the spot
    cone : half angle of the cone about a plane's normal out of which the beam comes
    roll : largest turn of the hand about the beam, either way, from ``posture``
    posture : (3, 3) hand rotation that the robot takes with ease; the hand is turned from it by the
        shortest way so that the beam comes as it should. By default the tool points down
    margin_px : least distance of a spot from the picture's edge; allow for how roughly the cell is
        known
    depth : range of the spot's depth before the camera
    box : ((x, y, z) lowest, (x, y, z) highest) of the hand's positions; None: anywhere
    reach : range of the hand's distance from the base's origin; None: any
    clearance : least distance of the hand's origin from the plane that it points at, on the
        camera's side; other planes end somewhere, nobody says where

    Raises
    ------
    DataError
        A range is empty or a number is not what it may be; names all of them.
    """

    beam_length: tuple[float, float] = (80 * M_PER_MM, 160 * M_PER_MM)
    cone: float = 40 * RAD_PER_DEG
    roll: float = 40 * RAD_PER_DEG
    posture: Array = field(default_factory=_tool_down)
    margin_px: float = 12.0
    depth: tuple[float, float] = (20 * M_PER_MM, 2.0)
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    reach: tuple[float, float] | None = None
    clearance: float = 0.0

    def __post_init__(self) -> None:
        set_array(self, "posture", self.posture, (3, 3))
        problems = []
        for name in ("beam_length", "depth", "reach"):
            value = getattr(self, name)
            if value is not None and not 0 <= value[0] <= value[1] < np.inf:
                problems.append(f"{name}: expected 0 <= low <= high (metres), got {value}")
        if not 0 <= self.cone < np.pi / 2 or not 0 <= self.roll <= np.pi:
            problems.append(
                f"cone, roll: expected radians below pi/2 and up to pi, got {self.cone}, "
                f"{self.roll}"
            )
        if not self.margin_px >= 0 or not np.isfinite(self.clearance):
            problems.append(
                f"margin_px, clearance: expected a number >= 0 and a length, got "
                f"{self.margin_px}, {self.clearance}"
            )
        if self.box is not None and not np.all(np.array(self.box[0]) <= np.array(self.box[1])):
            problems.append(f"box: expected lowest <= highest in x, y and z, got {self.box}")
        R = self.posture
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            problems.append(f"posture: expected a rotation matrix, got {R.tolist()}")
        if problems:
            raise DataError(*(f"plan: {p}" for p in problems))
        object.__setattr__(self, "roll", self.roll + 0.0)  # no -0.0: no range ends there

    def allow(self, cell: Cell, camera: str, plane: str, T_base_hand: Array) -> Mask:
        """Which of the poses (N, 4, 4) the hand may take to point at ``plane``, (N,)."""
        t = T_base_hand[:, :3, 3]
        good = np.ones(len(t), dtype=np.bool_)
        if self.box is not None:
            low, high = np.array(self.box[0]), np.array(self.box[1])
            good &= np.all((t >= low) & (t <= high), axis=1)
        if self.reach is not None:
            distance = np.linalg.norm(t, axis=1)
            good &= (distance >= self.reach[0]) & (distance <= self.reach[1])
        if self.clearance > 0:
            centre, part = cell.cameras[camera].T_base_camera[:3, 3], cell.planes[plane]
            side = np.sign(part.normal_base @ centre - part.distance)
            good &= side * (t @ part.normal_base - part.distance) >= self.clearance
        return good
