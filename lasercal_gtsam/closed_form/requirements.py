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
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.units import MM_PER_M, RAD_PER_DEG

DISTINCT_ORIENTATION_RAD = 0.5 * RAD_PER_DEG
SMALLEST_TURN_RAD = 0.25 * RAD_PER_DEG
"""Rms turn about an axis below which the hand counts as not turned about it."""
SMALLEST_MOTION_M = 1e-4
FLATTEST_IMAGE = 5e-3
"""Pixels of a plane that spread less across a line than this share of its length lie on it."""
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
        Too few spots, pixels in one line, too few hand orientations or all about one axis, or no
        translation; the message says what is missing and what would supply it.
    """
    needed = spots_needed(spots.plane_count)
    if len(spots) < needed:
        raise DegenerateError(
            f"{len(spots)} spots on {_planes(spots.plane_count)} are too few: at least {needed} "
            "are needed, and 30 or more are advisable; add shots"
        )
    if len(planes_seen_flat(spots)) == spots.plane_count:
        raise DegenerateError(
            "the pixels of every plane lie on one line (or in one point): move the spots over the "
            "image in two directions"
        )
    check_orientations(spots.R)
    check_translations(spots.R, spots.t)


def planes_seen_flat(spots: Spots) -> list[int]:
    """Planes whose pixels lie on one line: they give no map from the image to the plane."""
    flat = []
    for p in range(spots.plane_count):
        xy = spots.xy[spots.on_plane(p)]
        if len(xy) >= 3:
            s = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
            if s[1] > FLATTEST_IMAGE * s[0]:
                continue
        flat.append(p)
    return flat


def check_orientations(R: Array) -> None:
    """Refuse hand orientations (N, 3, 3) that leave a shift of the whole scene free.

    Raises
    ------
    DegenerateError
        One orientation only, two, or all turned about one axis.
    """
    turns = (R - R.mean(axis=0)).reshape(-1, 3)
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    turned = s / np.sqrt(len(R)) > SMALLEST_TURN_RAD
    if not turned.any():
        raise DegenerateError(
            f"all {len(R)} shots have the same hand orientation, so the beam's place in the hand "
            f"and the camera's place in the base cannot be told apart: {_THREE}"
        )
    if not turned.all():
        axis = ", ".join(f"{x:.3f}" for x in Vt[2])
        one_plane = np.zeros(len(R), dtype=np.int64)
        what = (
            f"the shots have only two hand orientations, one turned about ({axis}, hand frame) "
            "against the other"
            if group_labels(R, one_plane, DISTINCT_ORIENTATION_RAD).max() == 1
            else f"all hand orientations turn about one axis ({axis} in the hand frame)"
        )
        raise DegenerateError(
            f"{what}, so a shift of everything along that axis stays free: {_THREE}; add a few "
            "shots tilted about another axis"
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


def _planes(count: int) -> str:
    return "1 plane" if count == 1 else f"{count} planes"
