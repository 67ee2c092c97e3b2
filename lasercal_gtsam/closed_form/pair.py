"""All closed-form solutions of one (camera, laser) pair, ranked.

The order of the stages is here and nowhere else: directions, beams, spots, cameras.

The spots are taken as they are, without distortion: with the strong one of the paper's cell
(k1 = -0.55) the start is off by a few per cent and its RMS a few pixels, and the refinement still
ends in the same optimum.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from lasercal_gtsam.closed_form.beam_fit import refine_beam
from lasercal_gtsam.closed_form.camera import (
    KnownIntrinsics,
    Resection,
    cameras_from_points,
    impose,
)
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.general import solve_general
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.one_plane import solve_one_plane
from lasercal_gtsam.closed_form.requirements import check_spots, planes_seen_flat
from lasercal_gtsam.closed_form.search import search_beams
from lasercal_gtsam.closed_form.solution import (
    NEGATIVE_DEPTH_PENALTY_PX,
    Solution,
    beam_towards_spots,
    reprojection,
    spots_on_beams,
)
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL, Spots
from lasercal_gtsam.closed_form.triangulation import (
    PlaneSpots,
    scaled_planes,
    solvable_planes,
    triangulate,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array

SHORTEST_FOCAL, LONGEST_FOCAL = 0.1, 20.0
"""Focal lengths in image diagonals beyond which a solution is dropped."""
PLAUSIBLE_NEGATIVE = 0.02
PLAUSIBLE_RMS = 0.02
"""Root mean square distance in image diagonals; strong distortion, ignored here, gives half."""

GROSS = 0.0125 * IMAGE_DIAGONAL
"""Rms distance of shots from the homographies of their groups that only outliers explain."""


@dataclass(frozen=True, eq=False)
class PairCandidate:
    """One solution of a pair and how well it explains the spots."""

    solution: Solution
    rms_px: float
    negative: float
    method: str

    @property
    def rank(self) -> float:
        """Smaller is better: RMS plus a penalty for spots behind camera or beam."""
        return self.rms_px + NEGATIVE_DEPTH_PENALTY_PX * self.negative


def solve_pair(
    spots: Spots, groups: Groups, known: KnownIntrinsics, *, search: bool = True
) -> list[PairCandidate]:
    """Closed-form solutions of one pair, best first.

    Directions come from the groups; where there are none, or where what they give is implausible,
    from the search without groups. With ``search`` False there is none, and nothing is solved where
    shots of the groups lie far from any homography: for spots among which may be outliers.

    Raises
    ------
    DegenerateError
        The poses cannot determine the cell, or no stage gave a solution.
    """
    check_spots(spots)
    flat = planes_seen_flat(spots)
    groups = groups.subset(np.flatnonzero(~np.isin(groups.plane, flat)))
    planes = [plane for plane in scaled_planes(spots) if plane.index not in flat]
    directions, costs = robust_directions(groups)
    if not search and len(costs) and costs[0] > GROSS**2:
        raise DegenerateError("the spots of groups of non-rotating motions do not fit each other")
    reasons: list[str] = []
    found = _ranked(solutions_from_groups(spots, groups, directions, known, reasons), spots)
    found += _ranked(
        solutions_from_beams(spots, planes, beams_from_directions(directions, planes), known), spots
    )
    if search and not any(plausible(candidate, spots) for candidate in found):
        try:
            beams = [("search", u, q) for u, q in search_beams(planes)]
            found += _ranked(solutions_from_beams(spots, planes, beams, known), spots)
        except DegenerateError as error:
            reasons.append(str(error))
    if not found:
        raise DegenerateError("no solution was found: " + "; ".join(dict.fromkeys(reasons)))
    found.sort(key=lambda candidate: candidate.rank)
    return found


def plausible(candidate: PairCandidate, spots: Spots) -> bool:
    """Whether nearly all spots are possible, and as near as strong distortion leaves them."""
    largest_rms_px = PLAUSIBLE_RMS * float(np.hypot(*spots.image_size))
    return candidate.negative <= PLAUSIBLE_NEGATIVE and candidate.rms_px <= largest_rms_px


def solutions_from_groups(
    spots: Spots, groups: Groups, directions: Array, known: KnownIntrinsics, reasons: list[str]
) -> Iterator[tuple[str, Solution]]:
    """The forms on homographies of groups: `general` for several planes, `one_plane` for one.

    Why a form failed is added to ``reasons``.
    """
    for u in directions:
        try:
            if spots.plane_count > 1:
                solution = solve_general(groups, spots, u)
                yield "general form", _imposed(solution, spots, known)
            else:
                for name, solution in solve_one_plane(groups, spots, u, known):
                    yield f"one plane, {name}", solution
        except DegenerateError as error:
            reasons.append(str(error))


def _imposed(solution: Solution, spots: Spots, known: KnownIntrinsics) -> Solution:
    """The solution with the known intrinsics put in and the camera's pose fitted again."""
    K = np.asarray(spots.scaling @ solution.K)
    points, _ = spots_on_beams(solution, spots)
    good = np.isfinite(points).all(axis=1)
    camera = impose(Resection(K, solution.R, solution.T), known, points[good], spots.xy[good])
    K = np.asarray(np.linalg.solve(spots.scaling, camera.K))
    return replace(solution, K=K, R=camera.R, T=camera.T)


def beams_from_directions(
    directions: Array, planes: list[PlaneSpots]
) -> Iterator[tuple[str, Array, Array]]:
    """Beams (name, u, q) with a given direction, and refined with their direction."""
    for u in directions:
        usable = solvable_planes(planes, u)
        if usable:
            _, q, _ = refine_beam(usable, u, np.zeros(3), point_only=True)
            yield "direction from groups", u, q
            yield "beam from groups and spots", *refine_beam(usable, u, q)[:2]


def solutions_from_beams(
    spots: Spots,
    planes: list[PlaneSpots],
    beams: Iterable[tuple[str, Array, Array]],
    known: KnownIntrinsics,
) -> Iterator[tuple[str, Solution]]:
    """The triangulation form: spots from each beam, then every camera that they give."""
    for beam_name, u, q in beams:
        triangulated = triangulate(planes, spots, u, q)
        seen = np.flatnonzero(np.isfinite(triangulated.normals).all(axis=1))
        rows = [spots.on_plane(int(p)) for p in seen]
        for camera_name, camera in cameras_from_points(
            [triangulated.points[r] for r in rows],
            triangulated.normals[seen],
            [spots.xy[r] for r in rows],
            known,
            IMAGE_DIAGONAL,
        ):
            K = np.asarray(np.linalg.solve(spots.scaling, camera.K))
            yield (
                f"{beam_name}, {camera_name}",
                Solution(K, camera.R, camera.T, u, q, triangulated.normals, triangulated.centres),
            )


def _ranked(solutions: Iterable[tuple[str, Solution]], spots: Spots) -> list[PairCandidate]:
    found = []
    for name, solution in solutions:
        solution = beam_towards_spots(solution, spots)
        rms, negative = reprojection(solution, spots)
        focal = solution.K[[0, 1], [0, 1]] / float(np.hypot(*spots.image_size))
        possible = focal.min() > SHORTEST_FOCAL and focal.max() < LONGEST_FOCAL
        if np.isfinite(rms) and possible:
            found.append(PairCandidate(solution, rms, negative, name))
    return found
