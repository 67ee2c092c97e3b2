"""How far an estimate is from the truth, as the paper's section 4.1 counts it."""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array

QUANTITIES = ("f_u", "R", "T")
# an estimate with a larger error of f_u than this is a failure (method note 10.1)
FAILED = 0.5


def relative_errors(
    fu: float, T: Array, true_fu: float, true_T: Array
) -> tuple[float, float, float] | None:
    """Relative errors of f_u, of the rotation (Frobenius, over sqrt 3) and of the position.

    Parameters
    ----------
    fu, true_fu : px
    T, true_T : (4, 4) pose, metres: the camera in the base, or what the method finds instead

    Returns
    -------
    tuple or None
        None where the estimate is a failure: not finite, or f_u off by more than half.
    """
    R, t, R0, t0 = T[:3, :3], T[:3, 3], true_T[:3, :3], true_T[:3, 3]
    found = (
        abs(fu - true_fu) / true_fu,
        float(np.linalg.norm(R - R0)) / np.sqrt(3.0),
        float(np.linalg.norm(t - t0) / np.linalg.norm(t0)),
    )
    if not np.isfinite(found).all() or found[0] > FAILED:
        return None
    return float(found[0]), float(found[1]), float(found[2])


def camera_errors(cell: Cell, truth: Cell) -> tuple[float, float, float] | None:
    """`relative_errors` of a cell with one camera."""
    (found,), (true,) = cell.cameras.values(), truth.cameras.values()
    return relative_errors(
        found.intrinsics.fu, found.T_base_camera, true.intrinsics.fu, true.T_base_camera
    )
