"""The convention doctor: which reading of a capture's numbers agrees with its spots.

Every reading is solved without a start, as a calibration would be, and judged by the robust
residual that is left. Most wrong readings are found out much earlier, at first sight (`screening`),
and not solved.

Nothing is switched: the doctor only says what it found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

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
from lasercal_gtsam.check.screening import misfit_px
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_batch
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Index, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.robust import consensus, lengths_of, rejection_length
from lasercal_gtsam.start import Search

Progress = Callable[[int, int], None]
_Item = TypeVar("_Item")

_MOST_SPOTS = 300
# a reading that leaves this many times what the best leaves at first sight is not solved; where
# even the best leaves too much, this many are, for nobody can say why
_HOPELESS = 10.0
_KEPT = 6
_MOST_REFINED = 5
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
    steps = _Steps(progress, len(poses))
    trials = [_Trial(pose, AS_DECLARED) for pose in poses]
    misfits = bench.misfits_px(trials, steps)
    likely = int(np.argmin(misfits))
    credible = CREDIBLE * bench.diagonal_px
    if misfits[likely] > credible:  # perhaps only because the pixels are mirrored
        mirrored = bench.misfits_px([_Trial(pose, MIRRORED[0]) for pose in poses], steps)
        likely = int(np.argmin(mirrored))
    more = [_Trial(poses[0], TURNED)]
    more += [_Trial(poses[k], pixels) for k in sorted({0, likely}) for pixels in MIRRORED]
    misfits = np.concatenate([misfits, bench.misfits_px(more, steps)])
    trials += more
    worth = _worth_solving(misfits, credible)
    solved = {k: bench.solve(trials[k]) for k in steps.through(worth)}
    if all(s.trouble for s in solved.values()):
        raise DegenerateError(next(iter(solved.values())).trouble)
    ranked = sorted(solved, key=lambda k: solved[k].residual_px)
    refined = {*ranked[:_MOST_REFINED], *(k for k in solved if trials[k].pose is poses[0])}
    for k in steps.through(sorted(refined)):
        solved[k] = bench.refine(solved[k])
    limit_px = rejection_length(len(rows)) * min(s.residual_px for s in solved.values())
    judged = [
        solved[k].judged(limit_px) if k in solved else trial.screened(float(misfits[k]))
        for k, trial in enumerate(trials)
    ]
    return judge(judged, len(rows), bench.diagonal_px)


def _worth_solving(misfits_px: Array, credible_px: float) -> list[int]:
    """Trials that are not hopeless at first sight; where all are, the declared (0) and the best."""
    best = float(np.min(misfits_px[misfits_px > 0], initial=np.inf))  # 0: nothing can be said
    if np.isfinite(best) and best <= credible_px:
        return [int(k) for k in np.flatnonzero(misfits_px <= _HOPELESS * best)]
    if not misfits_px.any():
        return list(range(len(misfits_px)))
    order = np.argsort(misfits_px, kind="stable")[:_KEPT]
    return sorted({0, *(int(k) for k in order)})


def _evenly(observations: Observations) -> Index:
    """Rows of an even choice of spots, whole groups where possible: a reading needs no more."""
    from lasercal_gtsam.closed_form.groups import thinned
    from lasercal_gtsam.closed_form.spots import Spots, pairs_of

    chosen = [
        thinned(Spots.of_pair(observations, camera, laser), _MOST_SPOTS).rows
        for camera, laser in pairs_of(observations)
    ]
    return np.sort(np.concatenate(chosen))


class _Steps:
    """Counts what is done, for the progress bar; more to do may turn up on the way."""

    def __init__(self, show: Progress | None, total: int) -> None:
        self.show, self.total, self.done = show, total, 0

    def through(self, todo: Sequence[_Item]) -> Iterator[_Item]:
        """Go through a list."""
        self.total = max(self.total, self.done + len(todo))
        for item in todo:
            yield item
            self.done += 1
            if self.show is not None:
                self.show(self.done, self.total)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A reading of poses and pixels."""

    pose: PoseReading
    pixels: PixelReading

    @property
    def words(self) -> str:
        return ", ".join(filter(None, [self.pose.words, self.pixels.words]))

    @property
    def change(self) -> tuple[str, ...]:
        return (*self.pose.change, *self.pixels.change)

    def screened(self, misfit_px: float) -> Judged:
        """What remains of it if it was hopeless at first sight."""
        return Judged(
            self.words, self.change, misfit_px, 0, "screened", harmless=self.pixels is TURNED
        )


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

    def judged(self, limit_px: float) -> Judged:
        """What remains of it; spots with a residual up to ``limit_px`` fit."""
        seen = self.search.observations
        return Judged(
            self.trial.words,
            self.trial.change,
            self.residual_px,
            int((self.lengths <= limit_px).sum()),
            self.stage,
            wrong_side=bool(self.cells) and seen_from_behind(self.cells[0], seen) > 0.5,
            off_centre_px=max((_off_centre(cell) for cell in self.cells[:1]), default=0.0),
            harmless=self.trial.pixels is TURNED,
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

    def read(self, trial: _Trial) -> Observations:
        """The spots under a reading."""
        uv = self.observations.uv.copy()
        for camera in self.observations.cameras:
            mine = self.observations.camera == camera
            uv[mine] = trial.pixels.apply(uv[mine], self.observations.image_size[camera])
        return replace(self.observations, uv=uv, T_base_hand=trial.pose.T_base_hand)

    def misfits_px(self, trials: Sequence[_Trial], steps: _Steps) -> Array:
        """What each reading leaves at first sight; hopeless ones are not followed to the end."""
        found: list[float] = []
        give_up = np.inf
        for trial in steps.through(trials):
            found.append(misfit_px(self.read(trial), self.hints["group_tolerance_rad"], give_up))
            if found[-1] > 0:
                give_up = min(give_up, _HOPELESS * found[-1])
        return np.array(found)

    def solve(self, trial: _Trial) -> _Solved:
        """Closed form of a trial."""
        from lasercal_gtsam.closed_form import closed_form_candidates

        seen = self.read(trial)
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
