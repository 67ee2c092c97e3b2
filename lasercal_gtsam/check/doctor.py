"""The convention doctor: which reading of a capture's numbers agrees with its spots.

Every reading is solved without a start, as a calibration would be, and judged by the robust
residual that is left. Most wrong readings are found out much earlier: within a group of pure
translations the pixels must be a homography of the motion across the beam, and with the wrong
rotations they are not (`closed_form.direction`); what is hopeless there is not solved.

Nothing is switched: the doctor only says what it found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lasercal_gtsam.api import closed_form_hints
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.check.diagnosis import CREDIBLE, Diagnosis, Judged, Stage, judge
from lasercal_gtsam.check.readings import (
    AS_DECLARED,
    MIRRORED,
    TURNED,
    PixelReading,
    PoseReading,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_batch
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Index, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.robust import consensus, lengths_of, rejection_length
from lasercal_gtsam.start import Search

Progress = Callable[[int, int], None]

_MOST_SPOTS = 300
# a reading whose groups leave this many times what the best leaves is not solved, unless it is one
# of the best few
_HOPELESS = 10.0
_KEPT_ANYWAY = 6
# readings that mirrored pixels are tried on, and readings that are refined
_MOST_MIRRORED = 3
_MOST_REFINED = 6
_STARTS = 3
# share of a credible residual at which no further start is tried
_CLEAR = 0.25


def diagnose(
    observations: Observations,
    poses: Sequence[PoseReading],
    options: CalibrationOptions,
    progress: Progress | None = None,
) -> Diagnosis:
    """Try the readings of a capture on its spots.

    Parameters
    ----------
    observations : N spots; of more than 300 of a camera and a laser an even choice is tried
    poses : readings of the hand poses of the same N spots, the declared one first
    options : as for the calibration; what is known of cameras and robot is used
    progress : called with (readings done, readings to do)

    Raises
    ------
    DataError
        The options do not fit the observations.
    DegenerateError
        No reading can be solved, whatever the pixels are: the poses do not suffice.
    """
    rows = _evenly(observations)
    poses = [replace(pose, T_base_hand=pose.T_base_hand[rows]) for pose in poses]
    bench = _Bench.of(observations[rows], options)
    misfits = np.array([bench.group_misfit_px(pose) for pose in poses])
    hopeless = misfits > _HOPELESS * misfits.min()
    hopeless[np.argsort(misfits, kind="stable")[:_KEPT_ANYWAY]] = False
    hopeless[0] = False
    kept = np.flatnonzero(~hopeless)
    trials = [_Trial(poses[k], AS_DECLARED, misfits[k]) for k in kept]
    trials.append(_Trial(poses[0], TURNED))
    total = len(trials) + len(MIRRORED) * min(len(kept), _MOST_MIRRORED)
    solved: list[_Solved] = []

    def solve(trial: _Trial) -> None:
        solved.append(bench.solve(trial))
        if progress is not None:
            progress(len(solved), total)

    for trial in trials:
        solve(trial)
    # a mirrored picture passes the screening like a right one: look for it where that was passed
    for found in [solved[0], *sorted(solved[1 : len(kept)], key=_Solved.rank)][:_MOST_MIRRORED]:
        for pixels in MIRRORED:
            solve(_Trial(found.trial.pose, pixels))
    if all(s.trouble for s in solved):
        raise DegenerateError(solved[0].trouble)
    order = np.argsort([s.residual_px for s in solved], kind="stable")
    refined = {0, len(kept), *(int(k) for k in order[:_MOST_REFINED])}
    solved = [bench.refine(s) if k in refined else s for k, s in enumerate(solved)]
    limit_px = rejection_length(len(rows)) * min(s.residual_px for s in solved)
    judged = [s.judged(limit_px) for s in solved]
    judged += [
        Judged(poses[k].words, poses[k].change, float(misfits[k]), 0, "screened")
        for k in np.flatnonzero(hopeless)
    ]
    return judge(judged, len(rows), bench.diagonal_px)


def _evenly(observations: Observations) -> Index:
    """Rows of an even choice of spots, whole groups where possible: a reading needs no more."""
    from lasercal_gtsam.closed_form.groups import thinned
    from lasercal_gtsam.closed_form.spots import Spots, pairs_of

    chosen = [
        thinned(Spots.of_pair(observations, camera, laser), _MOST_SPOTS).rows
        for camera, laser in pairs_of(observations)
    ]
    return np.sort(np.concatenate(chosen))


@dataclass(frozen=True, eq=False)
class _Trial:
    """A reading of poses and pixels, and what the pose reading's groups leave (px)."""

    pose: PoseReading
    pixels: PixelReading
    misfit_px: float = 0.0


@dataclass(frozen=True, eq=False)
class _Solved:
    """A trial after the closed form, or after the refinement; ``cells`` are the best first."""

    trial: _Trial
    search: Search
    cells: tuple[Cell, ...]
    residual_px: float
    lengths: Array
    stage: Stage = "closed form"
    trouble: str = ""

    def rank(self) -> tuple[float, float]:
        """Smaller is likelier to be the right reading of the poses."""
        return self.trial.misfit_px, self.residual_px

    def judged(self, limit_px: float) -> Judged:
        """What remains of it; spots with a residual up to ``limit_px`` fit."""
        pose, pixels = self.trial.pose, self.trial.pixels
        seen = self.search.observations
        return Judged(
            ", ".join(filter(None, [pose.words, pixels.words])),
            (*pose.change, *pixels.change),
            self.residual_px,
            int((self.lengths <= limit_px).sum()),
            self.stage,
            wrong_side=bool(self.cells) and seen_from_behind(self.cells[0], seen) > 0.5,
            off_centre_px=max((_off_centre(cell) for cell in self.cells[:1]), default=0.0),
            harmless=pixels is TURNED,
            trouble=self.trouble,
        )


@dataclass(frozen=True, eq=False)
class _Bench:
    """What all trials share: the spots without covariances (residuals are pixels), and hints."""

    observations: Observations
    options: CalibrationOptions
    hints: Mapping[str, Any]

    @classmethod
    def of(cls, observations: Observations, options: CalibrationOptions) -> _Bench:
        plain = replace(observations, cov_uv=np.full_like(observations.cov_uv, np.nan))
        hints = closed_form_hints(resolve_holds(plain, options), options)
        return cls(plain, options, hints)

    @property
    def diagonal_px(self) -> float:
        return max(float(np.hypot(*size)) for size in self.observations.image_size.values())

    def group_misfit_px(self, pose: PoseReading) -> float:
        """Rms residual of the homographies of all groups; 0 where no group says anything."""
        from lasercal_gtsam.closed_form.direction import robust_directions
        from lasercal_gtsam.closed_form.groups import find_groups
        from lasercal_gtsam.closed_form.spots import Spots, pairs_of

        seen = replace(self.observations, T_base_hand=pose.T_base_hand)
        worst = 0.0
        for camera, laser in pairs_of(seen):
            spots = Spots.of_pair(seen, camera, laser)
            groups = find_groups(spots, self.hints["group_tolerance_rad"])
            _, costs = robust_directions(groups)
            if len(costs):
                worst = max(worst, float(np.sqrt(0.5 * costs[0])) / float(spots.scaling[0, 0]))
        return worst

    def solve(self, trial: _Trial) -> _Solved:
        """Closed form of a trial."""
        from lasercal_gtsam.closed_form import closed_form_candidates

        seen = self.observations
        uv = seen.uv.copy()
        for camera in seen.cameras:
            mine = seen.camera == camera
            uv[mine] = trial.pixels.apply(uv[mine], seen.image_size[camera])
        seen = replace(seen, uv=uv, T_base_hand=trial.pose.T_base_hand)
        holds = resolve_holds(seen, self.options)
        search = Search(seen, make_batch(seen, None), holds, self.options)
        try:
            found = closed_form_candidates(seen, **self.hints)
        except DegenerateError as error:
            nothing = np.full(len(seen), np.inf)
            return _Solved(trial, search, (), np.inf, nothing, trouble=str(error))
        cells = [holds.apply(candidate.cell) for candidate in found[:_STARTS]]
        lengths = [lengths_of(search, cell) for cell in cells]
        order = np.argsort([np.median(x) for x in lengths], kind="stable")
        best = lengths[order[0]]
        scale = float(np.median(best) / np.sqrt(2.0 * np.log(2.0)))
        return _Solved(trial, search, tuple(cells[k] for k in order), scale, best)

    def refine(self, solved: _Solved) -> _Solved:
        """Refine with a redescending loss from the closed form's best cells."""
        best = solved
        for cell in solved.cells:
            found = consensus(solved.search, cell, cell)
            if found is None or (best.stage == "refined" and found.scale >= best.residual_px):
                continue
            best = replace(
                solved,
                cells=(found.cell,),
                residual_px=found.scale,
                lengths=found.lengths,
                stage="refined",
            )
            if found.scale < _CLEAR * CREDIBLE * self.diagonal_px:
                break
        return best


def seen_from_behind(cell: Cell, observations: Observations) -> float:
    """Share of the spots whose plane hides them: the camera is not on the side the beam comes from.

    A picture of one plane in a mirror is that of the plane seen from behind: only this tells them
    apart.
    """
    behind = []
    for k, name in enumerate(observations.plane.tolist()):
        plane, T = cell.planes[name], observations.T_base_hand[k]
        beam = cell.lasers[str(observations.laser[k])]
        centre = cell.cameras[str(observations.camera[k])].T_base_camera[:3, 3]
        along = float(plane.normal_base @ (T[:3, :3] @ beam.direction_hand))
        height = float(plane.normal_base @ centre) - plane.distance
        behind.append(along * height > 0)
    return float(np.mean(behind))


def _off_centre(cell: Cell) -> float:
    """Largest distance of a principal point from the middle of its picture, px."""
    offsets = [
        (c.intrinsics.u0 - c.image_size[0] / 2, c.intrinsics.v0 - c.image_size[1] / 2)
        for c in cell.cameras.values()
    ]
    return float(np.hypot(*np.array(offsets).T).max())
