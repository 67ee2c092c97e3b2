"""The noise of pixels and hand poses, as in the paper's Table 1 (method note 10.2)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.options import LARGEST_SIGMA
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.units import M_PER_MM, RAD_PER_DEG


@dataclass(frozen=True)
class Noise:
    """Gaussian noise, one standard deviation per axis.

    Attributes
    ----------
    pixel_px : of u and of v
    hand_translation_m : of each coordinate of the hand's position, base axes
    hand_rotation_rad : of each coordinate of the hand's rotation vector, base axes
    """

    pixel_px: float = 0.0
    hand_translation_m: float = 0.0
    hand_rotation_rad: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not 0 <= value <= LARGEST_SIGMA:  # nor NaN
                raise DataError(
                    f"Noise.{f.name}: expected a number from 0 to {LARGEST_SIGMA:g}, got {value!r}"
                )
            object.__setattr__(self, f.name, float(value))

    @classmethod
    def table1(cls, level: float = 1.0) -> Noise:
        """The paper's Table 1 at a level between 0 and 1: 1 px, 1 mm and 0.05 deg at level 1."""
        return cls(level, level * M_PER_MM, level * 0.05 * RAD_PER_DEG)

    def moved_hands(self, T_base_hand: Array, rng: np.random.Generator) -> Array:
        """Where the hand really went: ``exp([w]x) R_k`` and ``t_k + e``, every shot on its own.

        Parameters
        ----------
        T_base_hand : (N, 4, 4) commanded poses, metres
        """
        count = len(T_base_hand)
        turn = self.hand_rotation_rad * rng.standard_normal((count, 3))
        shift = self.hand_translation_m * rng.standard_normal((count, 3))
        moved = np.array(T_base_hand, dtype=np.float64)
        if self.hand_rotation_rad > 0:
            moved[:, :3, :3] = rotation_exp(turn) @ moved[:, :3, :3]
        moved[:, :3, 3] += shift
        return moved
