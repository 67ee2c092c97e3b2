"""How well one row of the table is known when the problem bends: likelihood profiles.

A sigma is a linear matter. Where a parameter enters strongly nonlinearly over its own sigma (the
distortion of few spots does), the estimate scatters unlike a normal variable and `estimate +- 1.96
sigma` covers less than it says. The likelihood itself does not mind: the row is held at a value,
all else is fitted again, and what that costs is the signed root

    r = sign(estimate - value) sqrt((S(value) - S(estimate)) / s^2),

the same in whatever parameters the problem is written. Its distribution is normal to first order.
Barndorff-Nielsen's ``r* = r + log(q / r) / r`` is to third, with Fraser and Reid's ``q`` (Fraser,
Reid, Wu, Biometrika 86, 1999, for a nonlinear regression with normal errors):

    q = |phi(estimate) - phi(value), dphi/dl (value)| / |dphi/dx (estimate)|
        * sqrt(|j(estimate)| / |j_ll(value)|),     phi(x) = J(estimate)^T eta(x) / s^2,

with ``eta`` what is predicted, ``J`` its derivative, ``j`` the observed information, and ``l`` the
unknowns that are fitted again. That the noise's scale is estimated too is met by Student's t.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg import null_space, solve_triangular
from scipy.special import stdtrit

from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.errors import LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import (
    CELL_KEY,
    CellGraph,
    beam_frames,
    expansion,
    prior_factor,
    spread_columns,
)
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import DISTORTION_NAMES
from lasercal_gtsam.report_map import CAMERA_ROWS, BeamChart, row_jacobian, row_names
from lasercal_gtsam.solve import Solution, refuse_if_singular
from lasercal_gtsam.table_row import TableRow

# steps of differences, in sigmas
_STEP = 1e-3
# Gauss-Newton steps before Newton's, for these converge where the problem bends
_FIRST_STEPS, _MAX_STEPS, _NEAR, _SETTLED, _SLOW = 6, 30, 0.3, 1e-3, 0.3
_HALVINGS = 14
# below this root the correction tends to 0 / 0, and no end of an interval of 2/3 or more is there
_SMALL_ROOT = 0.9
# Gauss-Newton step at which such a root is known well enough
_ROUGH = 0.03
# relative change of a sigma within one sigma from which on a row counts as bent
_BENT = math.log(1.15)
INTRINSIC_ROWS = tuple(name for name, _ in CAMERA_ROWS[: len(INTRINSIC_NAMES)])
_MAX_TRIES, _PRECISION, _FARTHEST = 25, 2e-3, 30.0


class Standing(NamedTuple):
    """How a value of a row stands with the data.

    Attributes
    ----------
    root : signed root of what holding the row there costs; positive below the estimate
    adjusted : the same corrected to the third order: a standard normal variable if the value is the
        true one and the noise is known, Student's t otherwise
    where : (m,) the other unknowns fitted again, in sigmas from the estimate
    """

    root: float
    adjusted: float
    where: Array


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The likelihood about a solution, in coordinates ``w`` (m,) of unit covariance.

    Attributes
    ----------
    problem : the graph, its chart about the estimate
    observations : the spots
    basis : (n, m) steps in ``w`` as ones in the chart's coordinates
    unit : factor on the sigmas that the graph is whitened with
    dof : degrees of freedom behind ``unit``
    """

    problem: CellGraph
    observations: Observations
    basis: Array
    unit: float
    dof: float

    @classmethod
    def of(
        cls, solution: Solution, observations: Observations, sigma0: float, dof: float
    ) -> Likelihood:
        """Of a solution by least squares; ``sigma0`` is the scale of the batch's sigmas.

        Raises
        ------
        DegenerateError
            The information is singular.
        """
        problem = solution.problem.anchored(solution.cell)
        svd = refuse_if_singular(problem, problem.start_values())
        unit = sigma0 / problem.scale
        basis = expansion(problem.chart.aspects, problem.free) @ svd.root() * unit
        return cls(problem, observations, basis, unit, dof)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.basis.shape[1])

    def cost(self, w: Array) -> float:
        """Half the squared residuals in units of the noise; infinite where no spot can be."""
        return float(self.problem.graph.error(self._values(w))) / self.unit**2

    def linearized(self, w: Array) -> tuple[Array, Array]:
        """Gradient of `cost` (m,) and its Gauss-Newton Hessian (m, m).

        Raises
        ------
        LasercalError
            No spot can be there.
        """
        R, b = self.problem.graph.linearize(self._values(w)).jacobian()
        J = np.asarray(R) @ self.basis / self.unit
        return -(J.T @ np.asarray(b)) / self.unit, J.T @ J

    def _values(self, w: Array) -> gtsam.Values:
        values = self.problem.start_values()
        values.update(CELL_KEY, self.basis @ w)
        return values

    def rows(self, w: Array) -> tuple[Array, Array]:
        """Derivative (M, m) of all residuals, priors too, and the residuals (M,), of unit noise."""
        problem, z = self.problem, self.basis @ w
        batch, chart = problem.batch, problem.chart
        each = batch.rows(chart.state(z)) / problem.scale
        derivative = spread_columns(each[..., :-1], problem.start, self.observations)
        both = batch.decorrelated(np.concatenate([derivative, each[..., -1:]], axis=2))
        both = both[batch.used].reshape(-1, chart.n + 1)
        J, e = both[:, :-1] @ (chart.tangent_map(z) @ self.basis), both[:, -1]
        if problem.holds.priors:
            factor = prior_factor(chart, problem.holds, problem.start)
            P, p = factor.linearize(self._values(w)).jacobian()
            J, e = np.vstack([J, np.asarray(P) @ self.basis]), np.append(e, -np.asarray(p))
        return J / self.unit, e / self.unit

    @cached_property
    def at_estimate(self) -> tuple[Array, Array, float]:
        """Derivative and residuals there, and the log determinant of the observed information."""
        here = np.zeros(self.size)
        H = np.empty((self.size, self.size))
        for k, step in enumerate(_STEP * np.eye(self.size)):
            H[:, k] = (self.linearized(step)[0] - self.linearized(-step)[0]) / (2 * _STEP)
        return *self.rows(here), _log_determinant(H)

    def limit(self, level: float) -> float:
        """Student's quantile that holds ``level`` between minus it and it."""
        return float(stdtrit(self.dof, 0.5 + 0.5 * level))


@dataclass(frozen=True, eq=False)
class RowProfile:
    """One row of the table about a solution.

    Attributes
    ----------
    likelihood : of the solution
    row : which
    estimate : the row's value there
    sigma : its linear sigma
    """

    likelihood: Likelihood
    row: TableRow
    estimate: float
    sigma: float

    @classmethod
    def of(
        cls, likelihood: Likelihood, name: str, charts: dict[str, BeamChart] | None = None
    ) -> RowProfile:
        """Of the row of that name; ``charts``: how beams are written (as the table does).

        Raises
        ------
        KeyError
            There is no such row.
        """
        problem = likelihood.problem
        charts = charts or {k: BeamChart.of(beam) for k, beam in problem.start.lasers.items()}
        row = TableRow.named(name, problem.start, problem.chart, charts)
        here = np.zeros(problem.chart.n)
        gradient = row.gradient(here) @ likelihood.basis
        return cls(likelihood, row, row.value(here), float(np.linalg.norm(gradient)))

    def standing(self, value: float, start: Array | None = None) -> Standing | None:
        """How a value stands; None where it cannot be reached (the model folds or turns back).

        Near the estimate (a root below 0.9) ``adjusted`` is the root itself.
        """
        found = self._held_at(value, np.zeros(self.likelihood.size) if start is None else start)
        if found is None:
            return None
        w, H = found
        rise = self.likelihood.cost(w) - self.likelihood.cost(np.zeros(len(w)))
        below = math.copysign(1.0, -self._difference(value))
        root = below * math.sqrt(max(2.0 * rise, 0.0))
        if H is None or abs(root) < _SMALL_ROOT:
            return Standing(root, root, w)
        J0, e0, log_j = self.likelihood.at_estimate
        J, e = self.likelihood.rows(w)
        others = null_space(self._gradient(w)[None, :])
        log_ll = _log_determinant(others.T @ H @ others)
        log_phi = _log_determinant(
            np.column_stack([J0.T @ (e0 - e), J0.T @ J @ others]), signed=False
        )
        log_q = log_phi - _log_determinant(J0.T @ J0) + 0.5 * (log_j - log_ll)
        if not math.isfinite(log_q):
            return Standing(root, root, w)
        return Standing(root, root + (log_q - math.log(abs(root))) / root, w)

    def end(self, side: float, limit: float) -> float:
        """The value below (``side`` -1) or above (+1) whose adjusted root is ``limit``.

        Infinite where the likelihood does not fall far enough on that side.

        Raises
        ------
        SolveError
            The search does not settle.
        """
        near, near_at, start = 0.0, 0.0, np.zeros(self.likelihood.size)
        far: float | None = None
        reach = limit
        for _ in range(_MAX_TRIES):
            value = self.estimate + side * reach * self.sigma
            found = self.standing(value, start * (reach / near) if near else None)
            at = math.nan if found is None else -side * found.adjusted
            if found is None:
                far = reach
                if far - near < _PRECISION * max(far, 1.0):
                    return side * math.inf
                reach = 0.5 * (near + reach)
                continue
            if abs(at - limit) < _PRECISION:
                return value
            if at > limit:
                far, slope = reach, (at - near_at) / (reach - near)
                step = near + (limit - near_at) / slope
                reach = min(max(step, near + 0.05 * (far - near)), far - 0.05 * (far - near))
            else:
                slope = (at - near_at) / (reach - near)
                near, near_at, start = reach, at, found.where
                step = near + (limit - at) / max(slope, 0.2)
                reach = min(step, 0.5 * (near + far)) if far is not None else step
            if reach > _FARTHEST:
                return side * math.inf
        raise SolveError(
            f"{self.row.name}: no end of the interval was found {'above' if side > 0 else 'below'} "
            f"{self.estimate:.6g} in {_MAX_TRIES} tries"
        )

    def _difference(self, value: float) -> float:
        return self.row.difference(value, self.estimate)

    def _gradient(self, w: Array) -> Array:
        return self.row.gradient(self.likelihood.basis @ w) @ self.likelihood.basis

    def _held_at(self, value: float, w: Array) -> tuple[Array, Array | None] | None:
        """All else fitted again, and the Hessian of the Lagrangian there; None: not reached.

        No Hessian where the value is so near the estimate that none is needed.
        """
        try:
            return self._minimised(value, w)
        except (LasercalError, np.linalg.LinAlgError):
            return None

    def _minimised(self, value: float, w: Array) -> tuple[Array, Array | None] | None:
        """Newton's method on the Lagrangian, begun by Gauss-Newton steps.

        Steps are shortened until the error with the violated constraint beside it falls.
        """
        likelihood, cost = self.likelihood, self.likelihood.cost(w)
        if not math.isfinite(cost):
            w = np.zeros(likelihood.size)
            cost = likelihood.cost(w)
        small = likelihood.cost(np.zeros(likelihood.size)) + 0.5 * _SMALL_ROOT**2
        lagrangian: Array | None = None
        last = math.inf
        for count in range(_MAX_STEPS):
            gradient, H = likelihood.linearized(w)
            g = self._gradient(w)
            missing = self.row.difference(value, self.row.value(likelihood.basis @ w))
            if lagrangian is not None:
                H = lagrangian
            step, pull = _constrained_step(H, gradient, g, missing)
            length = float(np.linalg.norm(step))
            if lagrangian is not None and length < _SETTLED:
                return w, lagrangian
            if length < _ROUGH and cost < small:
                return w, None
            # the Hessian is made anew where the last one does not lead on
            if (length < _NEAR or count >= _FIRST_STEPS) and length > _SLOW * last:
                lagrangian = self._lagrangian(w, gradient, g)
                if lagrangian is not None:
                    step, pull = _constrained_step(lagrangian, gradient, g, missing)
                    length = float(np.linalg.norm(step))
            last = length if lagrangian is not None else 0.0
            weight = 2.0 * abs(pull) + 1.0 / self.sigma
            before = cost + weight * abs(missing)
            for half in range(_HALVINGS):
                moved = w + 0.5**half * step
                new_cost = likelihood.cost(moved)
                if not math.isfinite(new_cost):
                    continue
                off = self.row.difference(value, self.row.value(likelihood.basis @ moved))
                if new_cost + weight * abs(off) <= before + 1e-10 * (1.0 + cost):
                    break
            else:
                return None
            w, cost = moved, new_cost
        return None

    def _lagrangian(self, w: Array, gradient: Array, g: Array) -> Array | None:
        """Hessian of cost minus multiplier times the row, (m, m), by differences.

        None where it is not positive across the row: no minimum is near.
        """
        likelihood, basis = self.likelihood, self.likelihood.basis
        H = np.empty((len(w), len(w)))
        for k, step in enumerate(_STEP * np.eye(len(w))):
            H[:, k] = likelihood.linearized(w + step)[0] - gradient
        H /= _STEP
        z, bend = basis @ w, np.zeros((basis.shape[0], basis.shape[0]))
        own = self.row.gradient(z)
        for j in self.row.bending:
            h = _STEP * float(np.linalg.norm(basis[j]))
            if h > 0.0:
                step = np.zeros(len(z))
                step[j] = h
                bend[:, j] = (self.row.gradient(z + step) - own) / h
        H -= float(g @ gradient) / float(g @ g) * (basis.T @ bend @ basis)
        H = 0.5 * (H + H.T)
        others = null_space(g[None, :])
        return H if np.linalg.eigvalsh(others.T @ H @ others)[0] > 0 else None


def bent_rows(likelihood: Likelihood) -> tuple[str, ...]:
    """Rows whose sigmas are not to be taken for straight: they change by 15 % within one sigma.

    Looked for along the intrinsics, each moved by its sigma both ways with all else following. The
    lens is what bends: without a distortion term to estimate nothing is looked for.
    """
    cell, basis = likelihood.problem.start, likelihood.basis
    charts = {name: BeamChart.of(beam) for name, beam in cell.lasers.items()}
    names = [name for name, _ in row_names(cell, charts)]
    F = row_jacobian(cell, charts, beam_frames(cell)) @ basis
    sizes = np.linalg.norm(F, axis=1)
    free = np.flatnonzero(sizes > 0)
    movable = [i for i in free if names[i].rpartition(".")[2] in INTRINSIC_ROWS]
    if not any(names[i].rpartition(".")[2] in DISTORTION_NAMES for i in movable):
        return ()
    change = np.zeros(len(names))
    for i in movable:
        for side in (-1.0, 1.0):
            try:
                root = np.linalg.cholesky(likelihood.linearized(side * F[i] / sizes[i])[1])
            except (LasercalError, RuntimeError, np.linalg.LinAlgError):
                change[i] = np.inf  # no spot can be there
                continue
            moved = np.linalg.norm(solve_triangular(root, F[free].T, lower=True), axis=0)
            change[free] = np.maximum(change[free], np.abs(np.log(moved / sizes[free])))
    return tuple(name for name, c in zip(names, change, strict=True) if c > _BENT)


def _constrained_step(H: Array, gradient: Array, g: Array, missing: float) -> tuple[Array, float]:
    """Least of ``gradient . d + d H d / 2`` with ``g . d = missing``, and the multiplier."""
    m = len(g)
    scale = float(np.linalg.norm(g))
    K = np.zeros((m + 1, m + 1))
    K[:m, :m], K[:m, m], K[m, :m] = H, -g / scale, g / scale
    solved = np.linalg.solve(K, np.append(-gradient, missing / scale))
    return solved[:m], float(solved[m]) / scale


def _log_determinant(M: Array, signed: bool = True) -> float:
    """Of a matrix; NaN where it is not positive (unless only its size matters)."""
    sign, log = np.linalg.slogdet(M)
    return float(log) if sign > 0 or (not signed and sign != 0) else math.nan
