"""What the comparison methods see, and what they find."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD
from lasercal_gtsam.closed_form.spots import pixel_scaling
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.observations import Index


@dataclass(frozen=True, eq=False)
class HandViews(FrozenData):
    """Shots of J points on the hand, by a fixed camera without distortion.

    Attributes
    ----------
    uv : (S, J, 2) px; row j is the same point in every shot
    T_base_hand : (S, 4, 4), metres
    image_size : (width, height) px
    """

    uv: Array
    T_base_hand: Array
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        uv = set_array(self, "uv", self.uv, (None, None, 2))
        set_array(self, "T_base_hand", self.T_base_hand, (len(uv), 4, 4))

    @property
    def R(self) -> Array:
        """(S, 3, 3) hand rotations."""
        return self.T_base_hand[:, :3, :3]

    @property
    def t(self) -> Array:
        """(S, 3) hand positions, metres."""
        return self.T_base_hand[:, :3, 3]

    @property
    def scaling(self) -> Array:
        """(3, 3): pixels to coordinates of the order of one (``T_n``)."""
        return pixel_scaling(self.image_size)

    @property
    def xy(self) -> Array:
        """(S, J, 3) scaled pixels, homogeneous."""
        rows = np.concatenate([self.uv, np.ones((*self.uv.shape[:2], 1))], axis=-1)
        return np.asarray(rows @ self.scaling.T)

    def orientations(self) -> list[Index]:
        """Shots of each hand orientation, in their order; the first is the translations' start.

        Commanded rotations within 0.05 deg are one orientation, as for the laser method: robots
        round what they report.
        """
        found: list[list[int]] = []
        for k, R in enumerate(self.R):
            for group in found:
                if np.linalg.norm(R - self.R[group[0]]) < GROUP_TOLERANCE_RAD * np.sqrt(2.0):
                    group.append(k)
                    break
            else:
                found.append([k])
        return [np.array(group, dtype=np.int64) for group in found]

    def need(self, method: str, points: int) -> None:
        """Refuse views with fewer points than the method needs."""
        if self.uv.shape[1] < points:
            raise DataError(
                f"{method}: needs {points} points on the hand or more, got {self.uv.shape[1]}"
            )


@dataclass(frozen=True, eq=False)
class EyeToHand(FrozenData):
    """A camera in the robot base, and where the hand carries the points it saw.

    Attributes
    ----------
    K : (3, 3) px
    T_base_camera : (4, 4), metres
    points_hand : (J, 3), metres
    """

    K: Array
    T_base_camera: Array
    points_hand: Array

    def __post_init__(self) -> None:
        set_array(self, "K", self.K, (3, 3))
        set_array(self, "T_base_camera", self.T_base_camera, (4, 4))
        set_array(self, "points_hand", self.points_hand, (None, 3))

    def predicted(self, T_base_hand: Array) -> Array:
        """Pixels (S, J, 2) of the points in shots ``T_base_hand`` (S, 4, 4)."""
        R, t = T_base_hand[:, :3, :3], T_base_hand[:, :3, 3]
        base = self.points_hand @ np.swapaxes(R, 1, 2) + t[:, None]
        camera = (base - self.T_base_camera[:3, 3]) @ self.T_base_camera[:3, :3]
        seen = camera @ self.K.T
        return np.asarray(seen[..., :2] / seen[..., 2:])
