"""Levenberg-Marquardt on the cell's graph, and the checks that turn its end into an answer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from lasercal_gtsam.cell import Cell, Intrinsics
from lasercal_gtsam.errors import DegenerateError, LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CELL_KEY, CellGraph, state_from_cell
from lasercal_gtsam.observability import SINGULAR, RangeSvd, undetermined
from lasercal_gtsam.report_map import tangent_labels

# Newton decrement (distance to the optimum in sigmas) at which a solution counts as reached
CONVERGED_SIGMAS = 1e-3
_POLISHED_SIGMAS = 1e-6
_MAX_POLISH = 6
# residual scale below which data are exact to rounding and sigmas have no meaning (px)
_ROUNDING_PX = 1e-7
_MAX_SCALE_ROUNDS = 12
_MIN_SCALE = 1e-7


@dataclass(frozen=True)
class Solution:
    """Where the optimiser ended.

    Attributes
    ----------
    problem : the graph it was solved on (with its final ``scale``)
    cell : the estimate
    cost : sum of the squared whitened residuals (robust: of the losses) at ``scale`` 1, without
        priors
    total_cost : the same with the priors, in units of the final scale
    iterations : Levenberg-Marquardt iterations in all
    decrement : distance to the optimum in sigmas by one more Newton step
    troubles : sentences; empty if every check passed
    """

    problem: CellGraph
    cell: Cell
    cost: float
    total_cost: float
    iterations: int
    decrement: float
    troubles: tuple[str, ...]

    @property
    def objective(self) -> float:
        """What is compared between solutions: ``cost`` plus the priors in the same units."""
        return self.total_cost * self.problem.scale**2

    @property
    def plausible(self) -> bool:
        """Whether every check passed."""
        return not self.troubles


def solve(problem: CellGraph, max_iterations: int = 100, find_scale: bool = True) -> Solution:
    """Minimise from the problem's start.

    Where priors are set, their weight against the data follows from the residual scale, so that the
    scale is found along with the unknowns (unless ``find_scale`` is False: the problem's is kept).

    Raises
    ------
    SolveError
        The start itself is impossible (a beam misses its plane, a spot behind the camera, ...).
    """
    values = problem.start_values()
    if not np.isfinite(problem.graph.error(values)):
        raise SolveError(
            "the start is impossible: " + (_impossible(problem, problem.start) or "not finite")
        )
    iterations, decrement, stopped = 0, np.inf, False
    search = find_scale and bool(problem.holds.priors)
    for _ in range(_MAX_SCALE_ROUNDS if search else 1):
        values, used = _optimise(problem, values, max_iterations)
        iterations, stopped = iterations + used, used >= max_iterations
        values, decrement = _polish(problem, values)
        if not search:
            break
        scale = max(_data_scale(problem, values), _MIN_SCALE)
        if abs(np.log(scale / problem.scale)) < 0.005:
            break
        problem = problem.rescaled(scale)
    cell = problem.cell(values)
    cost = problem.batch.total_loss(problem.state(values), problem.loss)
    total = 2.0 * float(problem.graph.error(values))
    limit = f", stopped by the limit of {max_iterations} for one solve" if stopped else ""
    troubles = _troubles(problem, cell, cost, f"{iterations} iterations{limit}", decrement)
    return Solution(problem, cell, cost, total, iterations, decrement, troubles)


def degrees_of_freedom(problem: CellGraph, values: gtsam.Values) -> float:
    """Residuals minus the unknowns that the data (not the priors) determine."""
    rows = 2.0 * len(problem.batch.order)
    if not problem.holds.priors:
        return rows - float(problem.free.sum())
    A = problem.rows(values)[:, problem.free]
    data = A[: len(A) - len(problem.holds.priors)]
    return rows - float(np.trace(np.linalg.lstsq(A.T @ A, data.T @ data, rcond=None)[0]))


def refuse_if_singular(problem: CellGraph, values: gtsam.Values) -> RangeSvd:
    """Decompose the information; `DegenerateError` names directions that are not determined."""
    svd = RangeSvd.of(problem.rows(values), tangent_labels(problem.start), problem.free)
    weak = svd.weak_directions(SINGULAR)
    if weak:
        raise DegenerateError(
            f"{undetermined(weak)}. Add hand orientations (at least three, not about one axis), "
            "longer translations or a tilted plane, or hold what is known"
        )
    return svd


def _optimise(
    problem: CellGraph, values: gtsam.Values, max_iterations: int
) -> tuple[gtsam.Values, int]:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(1e-10)
    params.setAbsoluteErrorTol(1e-18)
    optimizer = gtsam.LevenbergMarquardtOptimizer(problem.graph, values, params)
    result = optimizer.optimize()
    return result, int(optimizer.iterations())


def _polish(problem: CellGraph, values: gtsam.Values) -> tuple[gtsam.Values, float]:
    """Undamped Newton steps while they lower the error; the last step's length in sigmas."""
    error = problem.graph.error(values)
    rows = 2.0 * len(problem.batch.order)
    decrement = np.inf
    for _ in range(_MAX_POLISH):
        linear = problem.graph.linearize(values)
        try:
            step = linear.optimize()
        except RuntimeError:  # GTSAM's pivots know nothing of units
            step = _scaled_step(problem, values, linear)
        decrement = float(np.sqrt(max(0.0, -step.dot(linear.gradientAtZero()))))
        if decrement < max(
            _POLISHED_SIGMAS * np.sqrt(2 * error / rows), 1e-6 * _ROUNDING_PX / problem.scale
        ):
            break
        moved = values.retract(step)
        new_error = problem.graph.error(moved)
        if not new_error < error:
            break
        values, error = moved, new_error
    return values, decrement


def _scaled_step(
    problem: CellGraph, values: gtsam.Values, linear: gtsam.GaussianFactorGraph
) -> gtsam.VectorValues:
    """Newton's step by a decomposition in plausible ranges; `DegenerateError` if singular."""
    svd = refuse_if_singular(problem, values)
    A, b = linear.jacobian()
    root = svd.root()
    step = np.zeros(problem.chart.n)
    step[problem.free] = root @ (root.T @ (A[:, problem.free].T @ b))
    found = gtsam.VectorValues()
    found.insert(CELL_KEY, step)
    return found


def _data_scale(problem: CellGraph, values: gtsam.Values) -> float:
    cost = problem.batch.total_loss(problem.state(values), problem.loss)
    return float(np.sqrt(cost / max(degrees_of_freedom(problem, values), 1.0)))


def _troubles(
    problem: CellGraph,
    cell: Cell,
    cost: float,
    effort: str,
    decrement: float,
) -> tuple[str, ...]:
    found: list[str] = []
    if not np.isfinite(cost):
        found.append("the error is not finite")
    rows = 2 * int(problem.batch.used.sum())
    sigma = max(np.sqrt(cost / rows), _ROUNDING_PX) / problem.scale
    if not decrement < CONVERGED_SIGMAS * sigma:
        found.append(
            f"not converged: one more step would move {decrement / sigma:.2g} sigma after {effort}"
        )
    impossible = _impossible(problem, cell)
    if impossible:
        found.append(impossible)
    found += implausible_cameras(problem, cell)
    return tuple(found)


def _impossible(problem: CellGraph, cell: Cell) -> str | None:
    try:
        residuals = problem.batch.residuals(state_from_cell(cell))
        bad = np.isnan(residuals[:, 0]) & problem.batch.used
    except LasercalError as error:
        return str(error)
    if not bad.any():
        return None
    return (
        f"{int(bad.sum())} of {len(bad)} spots cannot be (beam away from its plane, behind the "
        f"camera, or in the fold of the distortion); first: spot number {int(np.argmax(bad))}"
    )


def implausible_cameras(problem: CellGraph, cell: Cell) -> list[str]:
    """What no real camera does (method 6.2): focal length far off, or distortion that folds.

    The distortion folds where the distorted radius stops growing. Inside the region of the spots
    (10 % margin) that is no answer; `fold_warnings` names folds between the spots and the corners.
    """
    found: list[str] = []
    for c, (name, camera) in enumerate(cell.cameras.items()):
        width = camera.image_size[0]
        for f_name in ("fu", "fv"):
            f = getattr(camera.intrinsics, f_name)
            if not 0.1 * width < f < 50 * width:
                found.append(
                    f"camera {name!r}: {f_name} = {f:.4g} px is outside 0.1 to 50 image widths"
                )
        fold = fold_radius(camera.intrinsics)
        if fold < 1.1 * float(_radii(problem.spot_pixels(c), camera.intrinsics).max()):
            found.append(
                f"camera {name!r}: {_fold_words(camera.intrinsics, fold)} inside the spots"
            )
    return found


def fold_warnings(cell: Cell) -> list[str]:
    """Cameras whose distortion folds before the farthest image corner: not to be used out there."""
    found: list[str] = []
    for name, camera in cell.cameras.items():
        fold = fold_radius(camera.intrinsics)
        width, height = camera.image_size
        corners = np.array([[x, y] for x in (0.0, width - 1) for y in (0.0, height - 1)])
        if fold < float(_radii(corners, camera.intrinsics).max()):
            found.append(
                f"camera {name!r}: {_fold_words(camera.intrinsics, fold)} inside the image but "
                "beyond the spots: do not use the model out there, or take spots there, or hold k2"
            )
    return found


def fold_radius(intrinsics: Intrinsics) -> float:
    """Largest distorted radius (normalised) before the radial distortion turns back; inf if never.

    The slope ``1 + 3 k1 r^2 + 5 k2 r^4`` first vanishes there.
    """
    k1, k2 = intrinsics.k1, intrinsics.k2
    # smallest positive root r^2 of the slope, in the form that does not cancel
    discriminant = 9 * k1 * k1 - 20 * k2
    if (k1 >= 0 and k2 >= 0) or discriminant < 0:
        return math.inf
    r2 = 2.0 / (math.sqrt(discriminant) - 3 * k1)
    return math.sqrt(r2) * (1 + k1 * r2 + k2 * r2 * r2)


def _radii(uv: Array, i: Intrinsics) -> Array:
    """Distorted normalised radii of pixels, (N,)."""
    y = (uv[:, 1] - i.v0) / i.fv
    return np.asarray(np.hypot((uv[:, 0] - i.u0 - i.skew * y) / i.fu, y))


def _fold_words(i: Intrinsics, fold: float) -> str:
    return (
        f"the distortion (k1 {i.k1:.3g}, k2 {i.k2:.3g}) folds {fold * i.fu:.0f} px from the "
        "principal point,"
    )
