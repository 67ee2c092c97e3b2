"""The laser method's closed forms one by one; `calibrate` itself takes the best of all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.candidates import known_intrinsics
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.groups import Groups, find_groups
from lasercal_gtsam.closed_form.pair import (
    beams_from_directions,
    solutions_from_beams,
    solutions_from_groups,
)
from lasercal_gtsam.closed_form.planes_many import solve_paper
from lasercal_gtsam.closed_form.solution import (
    NEGATIVE_DEPTH_PENALTY_PX,
    Solution,
    beam_towards_spots,
    reprojection,
)
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.closed_form.triangulation import scaled_planes
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Observations

FORMS = ("paper", "general", "triangulation")


def closed_form(
    form: str, observations: Observations, known: Mapping[str, Any] | None = None
) -> Cell:
    """Solve with one of `FORMS` alone; of several solutions that with the smallest residual.

    Parameters
    ----------
    form : ``"paper"``, the chain (16)-(35) of several planes; ``"general"``, ours in its place for
        any translations, and for one plane (36)-(54); ``"triangulation"``, from spots before the
        camera
    observations : of one camera and one laser
    known : ``principal_point`` (px), ``skew`` (px) and ``aspect`` as in `CalibrationOptions`; the
        paper's chain uses none of them

    Raises
    ------
    DegenerateError
        The form gives no solution on these data.
    """
    camera, laser = observations.cameras[0], observations.lasers[0]
    spots = Spots.of_pair(observations, camera, laser)
    groups = find_groups(spots)
    known = known or {}
    fixed = known_intrinsics(
        spots.image_size,
        known.get("principal_point"),
        known.get("skew"),
        known.get("aspect"),
        None,
    )
    solutions = {"paper": _paper, "general": _general, "triangulation": _triangulation}[form]
    best = min(
        (beam_towards_spots(s, spots) for s in solutions(spots, groups, fixed)),
        key=lambda s: _rank(s, spots),
        default=None,
    )
    if best is None or not np.isfinite(_rank(best, spots)):
        raise DegenerateError(f"the {form} form gives no solution")
    return best.to_cell(spots, camera, laser)


def _paper(spots: Spots, groups: Groups, known: KnownIntrinsics) -> Iterable[Solution]:
    return [solve_paper(groups, spots)]


def _general(spots: Spots, groups: Groups, known: KnownIntrinsics) -> Iterable[Solution]:
    directions, _ = robust_directions(groups, keep=1)
    return (s for _, s in solutions_from_groups(spots, groups, directions, known, []))


def _triangulation(spots: Spots, groups: Groups, known: KnownIntrinsics) -> Iterable[Solution]:
    directions, _ = robust_directions(groups, keep=1)
    planes = scaled_planes(spots)
    beams = beams_from_directions(directions, planes)
    return (s for _, s in solutions_from_beams(spots, planes, beams, known))


def _rank(solution: Solution, spots: Spots) -> float:
    rms, negative = reprojection(solution, spots)
    return rms + NEGATIVE_DEPTH_PENALTY_PX * negative
