"""From closed-form candidates to the optimum: staged refinement and restarts (method 6.2, 6.3).

Deterministic: the same observations and options give the same path and the same answer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.cell import Camera, Cell, Intrinsics
from lasercal_gtsam.errors import DegenerateError, LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CellGraph, make_graph, state_from_cell
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES, CalibrationOptions
from lasercal_gtsam.report_map import CAMERA_TANGENT
from lasercal_gtsam.solve import (
    Solution,
    fold_warnings,
    solve,
)

# method 6.3: how many candidates are refined shortly, and how many different ones fully
_SHORT_LIST = 6
_FULL_LIST = 3
_SHORT_ITERATIONS = 40
# a candidate with fewer possible spots than this is not refined
_MIN_POSSIBLE = 0.8
# two costs closer than this (relative) are the same minimum
_SAME_COST = 1e-3
# a fold-free minimum is preferred to a folding one if it costs at most this many chi-square more
_FOLD_CHI2 = 9.0
# residual level (px) at which the weak priors of the staged start are weighed
_STAGE_SIGMA_PX = 3.0
_RESTART_STEPS = (0.01, -0.01, 0.03, -0.03, 0.1, -0.1)
# k2 restarts are skipped where they would begin more than this many sigmas away
_RESTART_SIGMAS = 10.0


@dataclass(frozen=True)
class Search:
    """What every refinement needs."""

    observations: Observations
    batch: SpotBatch
    holds: Holds
    options: CalibrationOptions

    def attempt(self, cell: Cell, holds: Holds | None = None) -> Solution | LasercalError:
        """Full refinement, or why there is none: impossible start, path out of the model, ...

        Raises
        ------
        DataError
            The start lacks a part.
        """
        problem = make_graph(self.observations, self.batch, holds or self.holds, cell)
        try:
            return solve(problem, self.options.max_iterations)
        except LasercalError as error:
            return error

    def without(self, aside: npt.NDArray[np.bool_]) -> Search:
        """The same search with some spots (N,) left out."""
        return replace(self, batch=self.batch.weighted(~aside)) if aside.any() else self

    def solve_from(self, cell: Cell, holds: Holds | None = None) -> Solution | None:
        """Full refinement, or None."""
        result = self.attempt(cell, holds)
        return result if isinstance(result, Solution) else None


def refine_given(search: Search, initial: Cell) -> Solution:
    """Refine a start given by the user; staged from there only if the direct way fails.

    Raises
    ------
    SolveError
        The start is impossible and no staged way leads out of it.
    DegenerateError
        The data do not determine the cell.
    DataError
        A part is missing in ``initial``.
    """
    direct = search.attempt(initial)
    if isinstance(direct, Solution):
        return direct if direct.plausible else refine_candidates(search, [initial], direct)
    if isinstance(direct, DegenerateError):
        raise direct
    try:
        return refine_candidates(search, [initial])
    except SolveError:
        # say why the start itself is impossible
        raise SolveError(f"the given start cannot be refined: {direct}") from direct


def refine_candidates(
    search: Search, candidates: Sequence[Cell], also: Solution | None = None
) -> Solution:
    """Best solution over candidate starts, the likeliest first (method 6.3 steps 3-5).

    Raises
    ------
    SolveError
        No candidate could be refined at all.
    DegenerateError
        None could, and for one of them because the data do not determine the cell.
    """
    staged = _short_refinements(search, candidates)
    full: list[Solution] = [also] if also is not None else []
    for cell in staged:
        solution = search.attempt(cell)
        if isinstance(solution, DegenerateError) and not full:
            raise solution
        if not isinstance(solution, Solution):
            continue
        again = any(_same_cost(solution, other) for other in full if other.plausible)
        full.append(solution)
        if (again and solution.plausible) or len(full) >= _FULL_LIST:
            break
    if not full:
        raise SolveError(
            "no start could be refined: every closed-form candidate leaves spots behind the camera "
            "or beams that miss their plane. Check the pose convention and units, the plane names, "
            "and that laser and camera look at the same plane"
        )
    best = best_of(full)
    best = best_of([best, *_k2_restarts(search, best)])
    if not best.plausible:
        best = best_of([best, *_fewer_distortion_terms(search, best, staged)])
    return best


def best_of(solutions: Iterable[Solution]) -> Solution:
    """Plausible before implausible, then the lowest cost.

    A model without a fold in the image is preferred to one that folds beyond the spots where the
    data do not speak against it.
    """
    ranked = sorted(solutions, key=lambda s: (len(s.troubles) > 0, s.objective))
    best = ranked[0]
    if fold_warnings(best.cell):
        noise = best.cost / max(2 * best.problem.batch.used.sum() - best.problem.free.sum(), 1)
        for other in ranked[1:]:
            close = other.objective <= best.objective + _FOLD_CHI2 * noise
            if close and other.plausible == best.plausible and not fold_warnings(other.cell):
                return other
    return best


def fits_distortion(holds: Holds, cameras: int) -> bool:
    """Whether any distortion term of any camera is estimated."""
    size = len(CAMERA_TANGENT)
    columns = [c * size + CAMERA_TANGENT.index(t) for c in range(cameras) for t in DISTORTION_NAMES]
    return not bool(holds.held[columns].all())


def _short_refinements(search: Search, candidates: Sequence[Cell]) -> list[Cell]:
    """Stages (a) without distortion and (b) with k1, weak priors; cheapest first, no doubles."""
    with_distortion = fits_distortion(search.holds, len(search.observations.cameras))
    priors = _stage_priors(search)
    stages = [replace(search.holds.without_distortion(), priors=priors)]
    if with_distortion:
        stages.append(replace(search.holds.without_distortion(("k1",)), priors=priors))
    found: list[tuple[float, Cell]] = []
    for cell in candidates[:_SHORT_LIST]:
        cost = np.inf
        for holds in stages:
            result = _short(search, holds, cell)
            if result is None:
                break
            cell, cost = result
        if np.isfinite(cost) and not any(abs(cost - c) < _SAME_COST * c for c, _ in found):
            found.append((cost, cell))
    return [cell for _, cell in sorted(found, key=lambda pair: pair[0])]


def _short(search: Search, holds: Holds, cell: Cell) -> tuple[Cell, float] | None:
    """One short refinement on the spots that are possible at its start."""
    problem = make_graph(search.observations, search.batch, holds, cell)
    good = ~np.isnan(search.batch.residuals(state_from_cell(problem.start))[:, 0])
    possible = float(good[search.batch.used].mean())
    if possible < _MIN_POSSIBLE:
        return None
    if possible < 1.0:
        problem = replace(problem, batch=search.batch.weighted(good))
    problem = problem.rescaled(_STAGE_SIGMA_PX / typical_sigma(search))
    try:
        solution = solve(problem, _SHORT_ITERATIONS, find_scale=False)
    except LasercalError:
        return None
    return solution.cell, solution.total_cost / possible


def typical_sigma(search: Search) -> float:
    """Typical a-priori pixel sigma of the batch (px)."""
    return float(1.0 / np.median(search.batch.spots.pixels[4]))


def _stage_priors(search: Search) -> dict[str, tuple[float, float]]:
    """Weak priors of the staged start (method 6.2): principal point, skew, aspect."""
    observations = search.observations
    several = len(observations.cameras) > 1
    priors: dict[str, tuple[float, float]] = {}
    for c, name in enumerate(observations.cameras):
        width, height = observations.image_size[name]
        spread = 0.12 * float(np.hypot(width, height))
        terms = {
            "u0": (width / 2, spread),
            "v0": (height / 2, spread),
            "skew": (0.0, 0.02),
            "aspect": (1.0, 0.05),
        }
        for term, prior in terms.items():
            tangent = "fu" if term == "aspect" else term
            if search.holds.held[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index(tangent)]:
                continue
            if term == "aspect" and name in search.holds.aspect:
                continue
            row = "alpha_c" if term == "skew" else term
            priors[(f"{name}." if several else "") + row] = prior
    return priors


def _same_cost(a: Solution, b: Solution) -> bool:
    return math.isclose(a.objective, b.objective, rel_tol=_SAME_COST, abs_tol=1e-12)


def _k2_restarts(search: Search, best: Solution) -> list[Solution]:
    """Restarts with k2 moved: k1 lowered to compensate, the rest settled around it, then all free.

    Method 6.2, remedy 4; settling around the moved k2 first reaches minima that a step misses.
    """
    found: list[Solution] = []
    for c, name in enumerate(search.observations.cameras):
        column = c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("k2")
        if search.holds.held[column]:
            continue
        camera = best.cell.cameras[name]
        r2 = _squared_radii(best.problem, c, camera)
        r95 = float(np.quantile(r2, 0.95))
        sigma = _quick_sigma(best, column)
        k2_held = replace(search.holds, held=search.holds.held.copy())
        k2_held.held[column] = True
        for step in _RESTART_STEPS:
            change = step / r95**2
            if abs(change) > _RESTART_SIGMAS * sigma:
                continue
            k1 = camera.intrinsics.k1 - change * float(np.mean(r2**3) / np.mean(r2**2))
            moved = replace(camera.intrinsics, k1=k1, k2=camera.intrinsics.k2 + change)
            cameras = dict(best.cell.cameras)
            cameras[name] = Camera(moved, camera.T_base_camera, camera.image_size)
            moved_cell = Cell(cameras, best.cell.lasers, best.cell.planes)
            settled = search.solve_from(moved_cell, k2_held)
            solution = None if settled is None else search.solve_from(settled.cell)
            if solution is not None:
                found.append(solution)
    return found


def _quick_sigma(solution: Solution, column: int) -> float:
    """Marginal sigma of one tangent coordinate; infinite where it is undetermined."""
    problem = solution.problem.anchored(solution.cell)
    R, free = problem.rows(problem.start_values()), problem.free
    unit = np.zeros(problem.chart.n)
    unit[column] = 1.0
    x, _, rank, _ = np.linalg.lstsq(R[:, free].T @ R[:, free], unit[free], rcond=None)
    scale = (
        np.sqrt(solution.cost / max(2 * problem.batch.used.sum() - free.sum(), 1)) / problem.scale
    )
    return float(scale * np.sqrt(x @ unit[free])) if rank == free.sum() else float("inf")


def _squared_radii(problem: CellGraph, camera_index: int, camera: Camera) -> Array:
    i: Intrinsics = camera.intrinsics
    uv = problem.spot_pixels(camera_index)
    x = (uv - np.array([i.u0, i.v0])) / np.array([i.fu, i.fv])
    return np.asarray((x**2).sum(axis=1))


def _fewer_distortion_terms(
    search: Search, best: Solution, cells: Sequence[Cell]
) -> list[Solution]:
    """Where the full distortion gives no plausible answer: k1 only, then none, and say so."""
    cameras = search.observations.cameras
    prefix = "{}." if len(cameras) > 1 else ""
    for keep in (("k1",), ()):
        fewer = search.holds.without_distortion(keep)
        if np.array_equal(fewer.held, search.holds.held):
            continue
        newly = fewer.held & ~search.holds.held
        known, dropped = dict(fewer.known), set[str]()
        for c, camera in enumerate(cameras):
            first = c * len(CAMERA_TANGENT)
            zeros = [t for t in DISTORTION_NAMES if newly[first + CAMERA_TANGENT.index(t)]]
            known[camera] = known[camera] | dict.fromkeys(zeros, 0.0)
            dropped |= {prefix.format(camera) + t for t in zeros}
        fewer = replace(
            fewer,
            known=known,
            priors={k: v for k, v in fewer.priors.items() if k not in dropped},
            words=(
                *fewer.words,
                f"{', '.join(sorted(dropped))} held at zero: fitted freely, {best.troubles[0]}",
            ),
        )
        found = [s for s in (search.solve_from(c, fewer) for c in cells) if s and s.plausible]
        if found:
            return found
    return []
