"""All closed-form solutions of one (camera, laser) pair, ranked.

The order of the stages is here and nowhere else: directions, beams, spots, cameras.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.beam_fit import refine_beam
from lasercal_gtsam.closed_form.camera import (
    KnownIntrinsics,
    cameras_from_points,
)
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.requirements import check_beam, check_spots
from lasercal_gtsam.closed_form.search import search_beams
from lasercal_gtsam.closed_form.solution import (
    NEGATIVE_DEPTH_PENALTY_PX,
    Solution,
    beam_towards_spots,
    reprojection,
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

PLAUSIBLE_NEGATIVE = 0.02
PLAUSIBLE_RMS = 0.02
"""Root mean square distance in image diagonals; strong distortion, ignored here, gives half."""


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


def beams_from_groups(
    groups: Groups, planes: list[PlaneSpots]
) -> Iterator[tuple[str, Array, Array]]:
    """Beams (name, u, q) whose direction comes from the groups; the point from `beam_fit`."""
    directions, _ = robust_directions(groups)
    for u in directions:
        usable = solvable_planes(planes, u)
        if not usable:
            continue
        u_fixed, q, _ = refine_beam(usable, u, np.zeros(3), point_only=True)
        yield "direction from groups", u_fixed, q
        yield "beam from groups and spots", *refine_beam(usable, u, q)[:2]


def solve_pair(spots: Spots, groups: Groups, known: KnownIntrinsics) -> list[PairCandidate]:
    """Closed-form solutions of one pair, best first.

    Directions come from the groups; where there are none, or where what they give is implausible,
    from the search without groups.

    Raises
    ------
    DegenerateError
        The poses cannot determine the cell, or no stage gave a solution.
    """
    check_spots(spots)
    planes = scaled_planes(spots)
    found = _candidates(spots, planes, beams_from_groups(groups, planes), known)
    largest_rms_px = PLAUSIBLE_RMS * float(np.hypot(*spots.image_size))
    if not any(_plausible(candidate, largest_rms_px) for candidate in found):
        beams = (("search", u, q) for u, q in search_beams(planes))
        found += _candidates(spots, planes, beams, known)
    if not found:
        raise DegenerateError(
            "no solution was found: each plane needs 6 spots or more that are not in one line, "
            "made with hand orientations that turn the beam"
        )
    found.sort(key=lambda candidate: candidate.rank)
    check_beam(spots.R, spots.t, found[0].solution.u)
    return found


def _plausible(candidate: PairCandidate, largest_rms_px: float) -> bool:
    return candidate.negative <= PLAUSIBLE_NEGATIVE and candidate.rms_px <= largest_rms_px


def _candidates(
    spots: Spots,
    planes: list[PlaneSpots],
    beams: Iterable[tuple[str, Array, Array]],
    known: KnownIntrinsics,
) -> list[PairCandidate]:
    found = []
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
            solution = Solution(
                np.asarray(np.linalg.solve(spots.scaling, camera.K)),
                camera.R,
                camera.T,
                u,
                q,
                triangulated.normals,
                triangulated.centres,
            )
            solution = beam_towards_spots(solution, spots)
            rms, negative = reprojection(solution, spots)
            if np.isfinite(rms):
                found.append(PairCandidate(solution, rms, negative, f"{beam_name}, {camera_name}"))
    return found
