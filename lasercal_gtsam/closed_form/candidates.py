"""The automatic start: closed-form solutions of a whole capture, ranked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.complete import complete_cell
from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD, find_groups
from lasercal_gtsam.closed_form.pair import PairCandidate, solve_pair
from lasercal_gtsam.closed_form.solution import NEGATIVE_DEPTH_PENALTY_PX, cell_reprojection
from lasercal_gtsam.closed_form.spots import Spots, pixel_scaling
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Observations

MAX_CANDIDATES = 40


@dataclass(frozen=True, eq=False)
class Candidate:
    """A start for the refinement.

    Attributes
    ----------
    cell : cameras (without distortion), lasers and planes; complete
    rms_px : root mean square distance over all spots, pixels
    method : how it was found, for the log
    negative_depths : fraction of spots behind the camera or behind the laser
    """

    cell: Cell
    rms_px: float
    method: str
    negative_depths: float

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


def closed_form_candidates(
    observations: Observations,
    *,
    principal_point: Mapping[str, tuple[float, float]] | None = None,
    skew: Mapping[str, float] | None = None,
    aspect: Mapping[str, float] | None = None,
    group_tolerance_rad: float = GROUP_TOLERANCE_RAD,
) -> tuple[Candidate, ...]:
    """Solve a capture in closed form, without any guess: several starts, best first.

    Every (camera, laser) pair is solved on its own spots. A camera, a laser or a plane that several
    pairs share is taken from the pair with most spots; one that no pair could give (too few
    spots of its own) is then found from the rest.

    Parameters
    ----------
    observations : the spots; pixels are taken without weights and without distortion
    principal_point, skew, aspect : by camera name, where known: (u0, v0) px, px, f_u / f_v. A
        camera that sees one plane only gets the image centre and no skew where they are not known
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
        camera: _known(
            size,
            (principal_point or {}).get(camera),
            (skew or {}).get(camera),
            (aspect or {}).get(camera),
        )
        for camera, size in observations.image_size.items()
    }
    pairs: list[_Pair] = []
    reasons: list[str] = []
    for camera, laser in sorted(set(zip(observations.camera, observations.laser, strict=True))):
        spots = Spots.of_pair(observations, camera, laser)
        try:
            found = solve_pair(spots, find_groups(spots, group_tolerance_rad), known[camera])
        except DegenerateError as error:
            reasons.append(f"camera {str(camera)!r} with laser {str(laser)!r}: {error}")
            continue
        pairs.append(_Pair(str(camera), str(laser), spots, found))
    if not pairs:
        raise DegenerateError("\n".join(reasons) or "there are no spots")
    pairs.sort(key=lambda pair: len(pair.spots))
    candidates: list[Candidate] = []
    refusal: DegenerateError | None = None
    for k in range(min(MAX_CANDIDATES, max(len(pair.found) for pair in pairs))):
        chosen = [pair.found[min(k, len(pair.found) - 1)] for pair in pairs]
        try:
            cell = complete_cell(_merged(pairs, chosen), observations, known, reasons)
        except DegenerateError as error:
            refusal = refusal or error
            continue
        rms, negative = cell_reprojection(cell, observations)
        candidates.append(Candidate(cell, rms, chosen[-1].method, negative))
    if not candidates and refusal:
        raise refusal
    return tuple(sorted(candidates, key=lambda candidate: candidate.rank))


def _known(
    size: tuple[int, int],
    principal_point: tuple[float, float] | None,
    skew: float | None,
    aspect: float | None,
) -> KnownIntrinsics:
    """Known intrinsics in scaled pixels."""
    scaling = pixel_scaling(size)
    if principal_point is not None:
        u, v, _ = scaling @ (*principal_point, 1.0)
        principal_point = float(u), float(v)
    return KnownIntrinsics(principal_point, None if skew is None else skew * scaling[0, 0], aspect)


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
