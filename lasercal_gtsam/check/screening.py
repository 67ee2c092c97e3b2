"""A quick look at a reading of the hand poses: what is hopeless need not be solved.

Two looks, some hundredths of a second each. Within a group of pure translations the pixels are a
homography of the motion across the beam (`closed_form.direction`); rotations that are read wrongly
seldom leave one. And from the beam directions that this gives, the triangulation form makes a cell
without search and without rounds against outliers; its median distance is a first residual.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.groups import find_groups
from lasercal_gtsam.closed_form.pair import beams_from_directions, solutions_from_beams
from lasercal_gtsam.closed_form.solution import beam_towards_spots, spot_distances
from lasercal_gtsam.closed_form.spots import Spots, pairs_of
from lasercal_gtsam.closed_form.triangulation import scaled_planes
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations

_DIRECTIONS = 2


def misfit_px(
    observations: Observations, group_tolerance_rad: float, give_up_px: float = np.inf
) -> float:
    """Residual (px) that a reading leaves at first sight, of the worst camera and laser.

    0 where the shots form no groups that say anything of the beam.
    From ``give_up_px`` on nobody wants to know it more exactly.
    """
    worst = 0.0
    for camera, laser in pairs_of(observations):
        spots = Spots.of_pair(observations, camera, laser)
        directions, costs = robust_directions(find_groups(spots, group_tolerance_rad))
        if not len(costs):
            continue
        of_groups = float(np.sqrt(0.5 * costs[0])) / float(spots.scaling[0, 0])
        worst = max(worst, of_groups)
        if worst < give_up_px:
            worst = max(worst, _of_cells(spots, directions[:_DIRECTIONS]))
    return worst


def _of_cells(spots: Spots, directions: Array) -> float:
    """Least median distance of the cells that beams of these directions give; 0 without cells."""
    planes = scaled_planes(spots)
    beams = beams_from_directions(directions, planes)
    found = []
    try:
        for _, solution in solutions_from_beams(spots, planes, beams, KnownIntrinsics()):
            # in a mirrored picture the right beam leaves all spots behind the camera: not hopeless
            distances = spot_distances(beam_towards_spots(solution, spots), spots)
            found.append(float(np.median(distances)))
    except DegenerateError:
        pass
    return min(found, default=0.0)
