"""The laser beam as a 4-dof variable without singular directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_factors.errors import FactorError

Array = npt.NDArray[np.float64]


def basis_across(v: Array) -> Array:
    """(3, 2) orthonormal basis across the unit vector ``v``, with ``e1 x e2 = v``.

    Built from the coordinate axis least aligned with ``v``, as `gtsam.Unit3.basis` is.
    """
    x, y, z = (float(c) for c in v)
    i = min(range(3), key=(abs(x), abs(y), abs(z)).__getitem__)
    # v x axis, without the overhead of a general cross product
    a, b, c = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[i]
    length = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
    return np.array([[a, y * c - z * b], [b, z * a - x * c], [c, x * b - y * a]])


@dataclass(frozen=True, eq=False)
class BeamFrame:
    """Constant frame about which a beam is written as slope and intercept ``(a, b, x, y)``.

    In hand coordinates the beam runs along ``R (a, b, 1)`` through ``t + R (x, y, 0)``: a plain
    vector variable with additive updates, singular only 90 deg away from the frame's z axis. Take
    the frame from the start value (`from_line`) and its coordinates begin at zero.

    Attributes
    ----------
    R : (3, 3) rotation, third column near the beam
    t : (3,) point near the beam, metres
    """

    R: Array
    t: Array

    @classmethod
    def from_line(cls, direction: npt.ArrayLike, point: npt.ArrayLike) -> BeamFrame:
        """Frame whose z axis is the beam itself and whose origin is ``point`` (metres).

        Raises
        ------
        FactorError
            The direction is zero or not finite.
        """
        w = np.array(direction, dtype=np.float64)
        length = float(np.linalg.norm(w))
        if not 0 < length < np.inf:
            raise FactorError(f"beam direction: expected a finite non-zero vector, got {w}")
        w /= length
        return cls(np.column_stack([basis_across(w), w]), np.array(point, dtype=np.float64))

    def coordinates(self, direction: npt.ArrayLike, point: npt.ArrayLike) -> Array:
        """``(a, b, x, y)`` of a line (direction of any length, any point on it, hand frame).

        Raises
        ------
        FactorError
            The line is 90 deg or more away from the frame's z axis.
        """
        u = self.R.T @ np.asarray(direction, dtype=np.float64)
        q = self.R.T @ (np.asarray(point, dtype=np.float64) - self.t)
        if not u[2] > 1e-9 * float(np.linalg.norm(u)):
            raise FactorError("beam direction is 90 deg or more away from its reference frame")
        slope = u[:2] / u[2]
        return np.concatenate([slope, q[:2] - slope * q[2]])

    def line(self, coordinates: Array) -> tuple[Array, Array]:
        """Unit direction and point on the beam in the hand frame, from ``(a, b, x, y)``."""
        a, b, x, y = coordinates
        u = self.R @ np.array([a, b, 1.0])
        return u / np.linalg.norm(u), self.t + self.R @ np.array([x, y, 0.0])
