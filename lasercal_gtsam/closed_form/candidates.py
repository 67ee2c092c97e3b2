"""The automatic start: closed-form solutions of a whole capture, ranked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.complete import SPOTS_FOR_PLANE, complete_cell, is_complete
from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD, thinned
from lasercal_gtsam.closed_form.information import check_information
from lasercal_gtsam.closed_form.outliers import Mask, set_aside, solve_pair_without_outliers
from lasercal_gtsam.closed_form.pair import PairCandidate
from lasercal_gtsam.closed_form.solution import NEGATIVE_DEPTH_PENALTY_PX, cell_reprojection
from lasercal_gtsam.closed_form.spots import Index, Spots, pairs_of, pixel_scaling
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Observations

MAX_CANDIDATES = 40


@dataclass(frozen=True, eq=False)
class Candidate:
    """A start for the refinement.

    Attributes
    ----------
    cell : cameras (without distortion), lasers and planes; complete
    rms_px : root mean square distance over the spots that were used, pixels
    method : how it was found, for the log
    negative_depths : fraction of spots behind the camera or behind the laser
    set_aside : labels of spots that none of the starts used: far off from the best, or in no
        agreement with the others
    """

    cell: Cell
    rms_px: float
    method: str
    negative_depths: float
    set_aside: tuple[str, ...] = ()

    @property
    def rank(self) -> float:
        """Smaller is better: RMS plus a penalty for spots behind camera or laser."""
        return self.rms_px + NEGATIVE_DEPTH_PENALTY_PX * self.negative_depths


@dataclass(frozen=True, eq=False)
class _Pair:
    camera: str
    laser: str
    spots: Spots
    found: list[PairCandidate]
    aside: Index


def closed_form_candidates(
    observations: Observations,
    *,
    principal_point: Mapping[str, tuple[float, float]] | None = None,
    skew: Mapping[str, float] | None = None,
    aspect: Mapping[str, float] | None = None,
    focal_lengths: Mapping[str, tuple[float, float]] | None = None,
    group_tolerance_rad: float = GROUP_TOLERANCE_RAD,
) -> tuple[Candidate, ...]:
    """Solve a capture in closed form, without any guess: several starts, best first.

    Every (camera, laser) pair is solved on its own spots. A camera, a laser or a plane that several
    pairs share is taken from the pair with most spots; one that no pair could give (too few
    spots of its own) is then found from the rest.

    Parameters
    ----------
    observations : the spots; pixels are taken without weights and without distortion. Of a pair
        with more than 3000 spots an even choice is solved; all of them are ranked on
    principal_point, skew, aspect, focal_lengths : by camera name, where known: (u0, v0) px, px,
        f_u / f_v, (f_u, f_v) px. A camera that sees one plane only gets the image centre and no
        skew where they are not known
    group_tolerance_rad : largest angle within a group of non-rotating motions; for poses read back
        from the robot about four times their rotation noise

    Returns
    -------
    tuple of Candidate
        Ranked by RMS plus 1000 times the fraction of spots behind camera or laser.

    Raises
    ------
    DegenerateError
        The data cannot give the cell; the message names what is missing and what would supply it.
    """
    known = {
        camera: known_intrinsics(
            size,
            (principal_point or {}).get(camera),
            (skew or {}).get(camera),
            (aspect or {}).get(camera),
            (focal_lengths or {}).get(camera),
        )
        for camera, size in observations.image_size.items()
    }
    pairs: list[_Pair] = []
    reasons: list[str] = []
    for camera, laser in pairs_of(observations):
        everything = Spots.of_pair(observations, camera, laser)
        spots = thinned(everything, tolerance_rad=group_tolerance_rad)
        try:
            found, aside = solve_pair_without_outliers(spots, known[camera], group_tolerance_rad)
        except DegenerateError as error:
            reasons.append(f"camera {camera!r} with laser {laser!r}: {error}")
            continue
        if len(spots) < len(everything):
            aside = set_aside(found[0].solution, everything)
        pairs.append(_Pair(camera, laser, everything, found, everything.rows[aside]))
    if not pairs:
        raise DegenerateError("\n".join(reasons) or "there are no spots")
    pairs.sort(key=lambda pair: len(pair.spots))
    agreed, used = _agreed_and_used(observations, pairs)
    left_out = tuple(str(name) for name in observations.id[~used])
    judges, usable = observations[agreed], observations[used]
    candidates: list[Candidate] = []
    refusal: DegenerateError | None = None
    for k in range(min(MAX_CANDIDATES, max(len(pair.found) for pair in pairs))):
        chosen = [pair.found[min(k, len(pair.found) - 1)] for pair in pairs]
        cell = _merged(pairs, chosen)
        whole = is_complete(cell, usable)
        # what the better start could not complete, a worse one completes from its errors only
        if refusal and not whole:
            continue
        if not whole:
            try:
                cell = complete_cell(cell, usable, known, reasons)
            except DegenerateError as error:
                refusal = error
                continue
        rms, negative = cell_reprojection(cell, judges)
        candidates.append(Candidate(cell, rms, chosen[-1].method, negative, left_out))
    if not candidates and refusal:
        raise refusal
    candidates.sort(key=lambda candidate: candidate.rank)
    check_information(candidates[0].cell, observations, known, candidates[0].rms_px)
    return tuple(candidates)


def _agreed_and_used(observations: Observations, pairs: list[_Pair]) -> tuple[Mask, Mask]:
    """Which spots agree, (N,), and these with all of the planes that they could not give."""
    agreed = np.ones(len(observations), dtype=np.bool_)
    for pair in pairs:
        agreed[pair.aside] = False
    used = agreed.copy()
    for p in range(len(observations.planes)):
        mine = observations.plane_index == p
        if agreed[mine].sum() < SPOTS_FOR_PLANE:
            used[mine] = True
    return agreed, used


def known_intrinsics(
    size: tuple[int, int],
    principal_point: tuple[float, float] | None,
    skew: float | None,
    aspect: float | None,
    focal_lengths: tuple[float, float] | None,
) -> KnownIntrinsics:
    """Known intrinsics in scaled pixels."""
    scaling = pixel_scaling(size)
    if principal_point is not None:
        u, v, _ = scaling @ (*principal_point, 1.0)
        principal_point = float(u), float(v)
    scale = float(scaling[0, 0])
    if focal_lengths is not None:
        focal_lengths = scale * focal_lengths[0], scale * focal_lengths[1]
    return KnownIntrinsics(
        principal_point, None if skew is None else scale * skew, aspect, focal_lengths
    )


def _merged(pairs: list[_Pair], chosen: list[PairCandidate]) -> Cell:
    """One cell of several pairs; where pairs share a part, the later one (more spots) wins."""
    cameras: dict[str, Camera] = {}
    lasers: dict[str, Beam] = {}
    planes: dict[str, Plane] = {}
    for pair, candidate in zip(pairs, chosen, strict=True):
        cell = candidate.solution.to_cell(pair.spots, pair.camera, pair.laser)
        cameras.update(cell.cameras)
        lasers.update(cell.lasers)
        planes.update(cell.planes)
    return Cell(cameras, lasers, planes)
