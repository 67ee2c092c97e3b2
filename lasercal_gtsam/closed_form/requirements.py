"""What the data must hold, checked before anything is solved, and said in plain words.

Shifting the whole scene by ``w`` and scaling it by ``1 + s`` changes no pixel if the beams can
follow, that is if ``s t_k + w = R_k d`` (apart from motions along the beam) for some shift ``d`` of
the beam in the hand. So the poses must leave ``[t_k, I, -R_k]`` of full rank: hand orientations
about more than one axis, and motions that are not rotations about one point. This holds for any
number of planes and is the rank of the translation steps (30)-(32) and (53).
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.groups import group_labels
from lasercal_gtsam.closed_form.linear import null_vector_and_gap
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.units import MM_PER_M, RAD_PER_DEG

DISTINCT_ORIENTATION_RAD = 0.5 * RAD_PER_DEG
SMALLEST_TURN_RAD = 0.25 * RAD_PER_DEG
"""Rms turn about an axis below which the hand counts as not turned about it."""
SMALLEST_MOTION_M = 1e-4
SMALLEST_TRANSLATION_GAP = 1e-3
"""Of `translation_gap`; beams within about half a degree of each other fall below."""
_THREE = (
    "three or more hand orientations are needed, turned by 20 deg or more about two axes or more"
)


def spots_needed(plane_count: int) -> int:
    """Least number of spots: two equations each for 6 + 4 + 3P unknowns and the intrinsics.

    Five intrinsics count with several planes, the two focal lengths with one.
    """
    intrinsics = 2 if plane_count == 1 else 5
    return -(-(intrinsics + 10 + 3 * plane_count) // 2)


def check_spots(spots: Spots) -> None:
    """Refuse a pair that cannot be solved whatever its pixels are.

    Raises
    ------
    DegenerateError
        Too few spots, too few hand orientations or all about one axis, or no translation; the
        message says what is missing and what would supply it.
    """
    needed = spots_needed(spots.plane_count)
    if len(spots) < needed:
        raise DegenerateError(
            f"{len(spots)} spots on {_planes(spots.plane_count)} are too few: at least {needed} "
            "are needed, and 30 or more are advisable; add shots"
        )
    check_orientations(spots.R)
    check_translations(spots.R, spots.t)


def check_orientations(R: Array) -> None:
    """Refuse hand orientations (N, 3, 3) that leave a shift of the whole scene free.

    Raises
    ------
    DegenerateError
        One orientation only, two, or all turned about one axis.
    """
    count = 1 + int(
        group_labels(R, np.zeros(len(R), dtype=np.int64), DISTINCT_ORIENTATION_RAD).max()
    )
    if count == 1:
        raise DegenerateError(
            f"all {len(R)} shots have the same hand orientation, so the beam's place in the hand "
            f"and the camera's place in the base cannot be told apart: {_THREE}"
        )
    turns = (R - R.mean(axis=0)).reshape(-1, 3)
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    if s[2] / np.sqrt(len(R)) < SMALLEST_TURN_RAD:
        axis = ", ".join(f"{x:.3f}" for x in Vt[2])
        what = (
            "the shots have only two hand orientations"
            if count == 2
            else f"all hand orientations turn about one axis ({axis} in the hand frame)"
        )
        raise DegenerateError(
            f"{what}, so a shift along that axis stays free: {_THREE}; add a few shots tilted "
            f"about another axis"
        )


def check_translations(R: Array, t: Array) -> None:
    """Refuse poses that are rotations about one point: they leave the scale free.

    Raises
    ------
    DegenerateError
        ``t_k = w + R_k d`` within `SMALLEST_MOTION_M`.
    """
    centred = t - t.mean(axis=0)
    turns = (R - R.mean(axis=0)).reshape(-1, 3)
    d = np.linalg.lstsq(turns, centred.ravel(), rcond=1e-9)[0]
    left = float(np.sqrt(((centred.ravel() - turns @ d) ** 2).sum() / len(t)))
    if left < SMALLEST_MOTION_M:
        raise DegenerateError(
            "the hand only turns about one point (apart from that it moves by "
            f"{left * MM_PER_M:.2g} mm), which gives no scale: translate it by several centimetres "
            "between shots"
        )


def translation_gap(R: Array, t: Array, u: Array) -> float:
    """How well poses and direction determine scale, camera position and beam point together.

    Ratio of the smallest to the largest singular value of the column-scaled system
    ``E_u' R_k' (s t_k + w) - tau`` (2N x 6), the one-plane translation step.
    """
    B = R @ basis_of(u)
    rows = np.zeros((len(R), 2, 6))
    rows[:, :, 0] = ((t - t.mean(axis=0))[:, None, :] @ B)[:, 0]
    rows[:, :, 1:4] = np.swapaxes(B, 1, 2)
    rows[:, :, 4:] = -np.eye(2)
    A = rows.reshape(-1, 6)
    scale = np.linalg.norm(A, axis=0)
    s = np.linalg.svd(A / np.where(scale > 0, scale, 1.0), compute_uv=False)
    return float(s[-1] / s[0])


def check_beam(R: Array, t: Array, u: Array) -> None:
    """Refuse poses that only turn the hand about the beam, once the direction is known.

    Raises
    ------
    DegenerateError
        `translation_gap` is below `SMALLEST_TRANSLATION_GAP`.
    """
    if translation_gap(R, t, u) >= SMALLEST_TRANSLATION_GAP:
        return
    beams = R @ u
    if null_vector_and_gap(beams)[1] < SMALLEST_TURN_RAD:
        raise DegenerateError(
            "the hand only turns about the laser beam, so all beams are parallel and a shift along "
            "them stays free: tilt the hand so that the beam turns by 20 deg or more"
        )
    raise DegenerateError(
        "the motions across the beam leave scale, camera position or beam point free: "
        "translate the hand by several centimetres across the beam, with three orientations or more"
    )


def _planes(count: int) -> str:
    return "1 plane" if count == 1 else f"{count} planes"
