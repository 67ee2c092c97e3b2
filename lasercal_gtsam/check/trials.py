"""Readings put to the test: solved without a start, refined, and judged by what they leave."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from lasercal_gtsam.api import calibrate, closed_form_hints
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.check.diagnosis import CREDIBLE, Judged, Stage
from lasercal_gtsam.check.readings import TURNED, PixelReading, PoseReading
from lasercal_gtsam.check.screening import misfit_px
from lasercal_gtsam.errors import DegenerateError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_batch
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.robust import consensus, lengths_of
from lasercal_gtsam.start import Search

Progress = Callable[[int, int], None]
_Item = TypeVar("_Item")

HOPELESS = 10.0
"""A reading that leaves this many times what the best leaves at first sight is not solved."""
_STARTS = 3
# share of a credible residual at which no further start is tried
_CLEAR = 0.25


class Steps:
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
class Trial:
    """A reading of poses and pixels."""

    pose: PoseReading
    pixels: PixelReading

    @property
    def words(self) -> str:
        """The reading, for a human."""
        return ", ".join(filter(None, [self.pose.words, self.pixels.words]))

    @property
    def change(self) -> tuple[str, ...]:
        """What to change in the capture so that it is read this way."""
        return (*self.pose.change, *self.pixels.change)

    def screened(self, misfit_px: float) -> Judged:
        """What remains of it if it was hopeless at first sight."""
        return Judged(
            self.words, self.change, misfit_px, 0, "screened", harmless=self.pixels is TURNED
        )


@dataclass(frozen=True, eq=False)
class Solved:
    """A trial after the closed form, or after the refinement; ``cells`` are the best first."""

    trial: Trial
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
            off_centre_px=max((off_centre(cell) for cell in self.cells[:1]), default=0.0),
            harmless=self.trial.pixels is TURNED,
            trouble=self.trouble,
        )


@dataclass(frozen=True, eq=False)
class Bench:
    """What all trials share: the spots without covariances (residuals are pixels), and hints."""

    observations: Observations
    options: CalibrationOptions
    hints: Mapping[str, Any]

    @classmethod
    def of(cls, observations: Observations, options: CalibrationOptions) -> Bench:
        """Take what is known of cameras and robot from the options."""
        plain = replace(observations, cov_uv=np.full_like(observations.cov_uv, np.nan))
        hints = closed_form_hints(resolve_holds(plain, options), options)
        return cls(plain, options, hints)

    @property
    def credible_px(self) -> float:
        """Residual above which a reading explains nothing."""
        return CREDIBLE * self.diagonal_px

    @property
    def diagonal_px(self) -> float:
        """Diagonal of the largest picture."""
        return max(float(np.hypot(*size)) for size in self.observations.image_size.values())

    def read(self, trial: Trial) -> Observations:
        """The spots under a reading."""
        uv = self.observations.uv.copy()
        for camera in self.observations.cameras:
            mine = self.observations.camera == camera
            uv[mine] = trial.pixels.apply(uv[mine], self.observations.image_size[camera])
        return replace(self.observations, uv=uv, T_base_hand=trial.pose.T_base_hand)

    def misfits_px(self, trials: Sequence[Trial], steps: Steps) -> Array:
        """What each reading leaves at first sight; hopeless ones are not followed to the end."""
        found: list[float] = []
        give_up = np.inf
        for trial in steps.through(trials):
            found.append(misfit_px(self.read(trial), self.hints["group_tolerance_rad"], give_up))
            if found[-1] > 0:
                give_up = min(give_up, HOPELESS * found[-1])
        return np.array(found)

    def solve(self, trial: Trial) -> Solved:
        """Closed form of a trial."""
        from lasercal_gtsam.closed_form import closed_form_candidates

        seen = self.read(trial)
        holds = resolve_holds(seen, self.options)
        search = Search(seen, make_batch(seen, None), holds, self.options)
        try:
            found = closed_form_candidates(seen, **self.hints)
        except DegenerateError as error:
            nothing = np.full(len(seen), np.inf)
            return Solved(trial, search, (), np.inf, nothing, trouble=str(error))
        cells = [holds.apply(candidate.cell) for candidate in found[:_STARTS]]
        lengths = [lengths_of(search, cell) for cell in cells]
        order = np.argsort([np.median(x) for x in lengths], kind="stable")
        best = lengths[order[0]]
        scale = float(np.median(best) / np.sqrt(2.0 * np.log(2.0)))
        return Solved(trial, search, tuple(cells[k] for k in order), scale, best)

    def refine(self, solved: Solved) -> Solved:
        """Refine with a redescending loss from the closed form's best cells."""
        best = solved
        for cell in solved.cells:
            best = self._better(best, cell)
            if best.stage == "refined" and best.residual_px < _CLEAR * self.credible_px:
                break
        return best

    def retry(self, solved: Solved) -> Solved:
        """Calibrate with all that is done against outliers; they may spoil the closed form."""
        try:
            result = calibrate(solved.search.observations, options=self.options)
        except (DegenerateError, SolveError):
            return solved
        return self._better(solved, result.cell)

    def _better(self, best: Solved, cell: Cell) -> Solved:
        """What a refinement from ``cell`` leaves, if that is less."""
        found = consensus(best.search, cell, cell)
        if found is None or (best.stage == "refined" and found.scale >= best.residual_px):
            return best
        return replace(
            best,
            cells=(found.cell,),
            residual_px=found.scale,
            lengths=found.lengths,
            stage="refined",
            trouble="",
        )


def seen_from_behind(cell: Cell, observations: Observations) -> float:
    """Share of the spots whose plane hides them: camera and hand are on opposite sides of it.

    A picture of one plane in a mirror is that of the plane seen from behind: only this tells them
    apart.
    """
    behind = []
    for k, name in enumerate(observations.plane.tolist()):
        plane = cell.planes[name]
        camera = cell.cameras[str(observations.camera[k])].T_base_camera[:3, 3]
        hand = observations.T_base_hand[k, :3, 3]
        heights = np.array([camera, hand]) @ plane.normal_base - plane.distance
        behind.append(heights[0] * heights[1] < 0)
    return float(np.mean(behind))


def off_centre(cell: Cell) -> float:
    """Largest distance of a principal point from the middle of its picture, px."""
    offsets = [
        (c.intrinsics.u0 - c.image_size[0] / 2, c.intrinsics.v0 - c.image_size[1] / 2)
        for c in cell.cameras.values()
    ]
    return float(np.hypot(*np.array(offsets).T).max())
