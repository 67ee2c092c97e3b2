"""How probable spots are under an explanation: marginal likelihood by Laplace's method.

An explanation says which part of the cell was displaced, and how much noise there is. With
``z = L a + D b`` the chart coordinates of the cell, ``a`` and ``b`` standard normal, ``L L'`` the
covariance of the belief and ``D`` the scale of the displacement (zero where nothing moved), the
spots' residuals ``r_i(z)`` have the density

    p(spots) = int prod_i [(1 - e) N(r_i; 0, S_i) + e / A] N(a; 0, I) N(b; 0, I) da db

(e: outlier rate, A: area of the picture, where an outlier may be). What was known of the part stays
correlated with the rest: a small displacement is measured against the old place itself, however
badly that is known. Laplace's method (D. MacKay, Information Theory, Inference, and Learning
Algorithms, 2003, ch. 27) approximates the integral at its mode ``y = (a, b)``, where the mixture is
maximised by weights, the probabilities that a spot is good (expectation maximisation), and damped
Gauss-Newton steps:

    log p = sum_i log[...] - |y|^2 / 2 - log det(I + sum_i w_i J_i' S_i^-1 J_i) / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from lasercal_factors import kernels
from lasercal_factors.arrays import Spots, State
from lasercal_factors.batch import SpotBatch
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import cell_from_state, state_from_cell
from lasercal_gtsam.incremental.belief import Belief, part_offset
from lasercal_gtsam.observations import Observations

Index = npt.NDArray[np.int64]

_MAX_STEPS = 30
# a mode counts as found when a step promises less than this change of the log density
_SETTLED = 1e-3
_LARGEST_DAMPING = 1e6


@dataclass(frozen=True, eq=False)
class Mode:
    """Where the integrand is largest, and the integral.

    Attributes
    ----------
    y : (p,) mode
    log_evidence : natural logarithm of the integral (density of the pixels, px^-2 a spot)
    log_density : of the integrand at the mode
    information : (p, p) its negative second derivative there
    good : (m,) probability that a spot is no outlier
    """

    y: Array
    log_evidence: float
    log_density: float
    information: Array
    good: Array


@dataclass(frozen=True, eq=False)
class Scene:
    """A belief and the spots that are to be explained; build it with `of`.

    Attributes
    ----------
    belief : before the change
    chart : about its cell
    spots : for the kernels, pixels not whitened, sorted
    place : (m,) where each observation is among ``spots``
    where : indices into (m, 2, n) of the kernels' columns, in the observations' order
    signs : (22,) of the kernels' columns (their plane offset is GTSAM's, -d)
    known : (n, k) square root ``L`` of the belief's covariance, rows of what the spots involve
    log_outlier : (m,) log of rate over picture area, log px^-2
    outlier_rate : share of outliers in the stream
    """

    belief: Belief
    chart: CellChart
    spots: Spots
    place: Index
    where: tuple[Index, Index, Index]
    signs: Array
    known: Array
    log_outlier: Array
    outlier_rate: float

    @classmethod
    def of(cls, belief: Belief, observations: Observations, outlier_rate: float) -> Scene:
        """Prepare.

        Raises
        ------
        DegenerateError
            The belief does not determine what the spots involve.
        """
        cell, m = belief.cell, len(observations)
        index = [
            np.array([list(names).index(x) for x in column.tolist()], dtype=np.int64)
            for names, column in (
                (cell.cameras, observations.camera),
                (cell.lasers, observations.laser),
                (cell.planes, observations.plane),
            )
        ]
        unit = np.broadcast_to(np.eye(2), (m, 2, 2))
        batch = SpotBatch.from_arrays(observations.uv, unit, observations.T_base_hand, *index)
        first = [part_offset(cell, "camera", x) + np.arange(15) for x in observations.camera]
        second = [part_offset(cell, "laser", x) + np.arange(4) for x in observations.laser]
        third = [part_offset(cell, "plane", x) + np.arange(3) for x in observations.plane]
        columns = np.concatenate([first, second, third], axis=1)
        aspects = tuple(belief.aspect.get(name) for name in cell.cameras)
        sizes = [observations.image_size[x] for x in observations.camera.tolist()]
        area = np.array([float(w) * float(h) for w, h in sizes])
        return cls(
            belief,
            CellChart(state_from_cell(cell), aspects),
            batch.spots,
            np.argsort(batch.order),
            (np.arange(m)[:, None, None], np.arange(2)[None, :, None], columns[:, None, :]),
            np.where(np.arange(22) == 21, -1.0, 1.0),
            _square_root(belief, np.unique(columns)),
            np.log(outlier_rate / area),
            outlier_rate,
        )

    def cell(self, z: Array) -> Cell:
        """The cell at chart coordinates."""
        return cell_from_state(self.chart.state(z), self.belief.cell)

    def mode(
        self, S: Array, D: Array, start: Array | None = None, *, trusting: bool = False
    ) -> Mode:
        """Mode and evidence of one explanation.

        Parameters
        ----------
        S : (m, 2, 2) px^2, noise of the spots
        D : (n, j) displacement for one standard deviation of each of ``b``; (n, 0) for none
        start : (k + j,) ``y``; zeros if left out
        trusting : take every spot as good at first, so that far ones still pull
        """
        A = np.concatenate([self.known, D], axis=1)
        y = np.zeros(A.shape[1]) if start is None else start
        noise = _Noise.of(S, self.log_outlier, self.outlier_rate)
        if trusting:
            y = self._climb(y, A, noise, trusting=True)[0]
        y, log_density, H, good = self._climb(y, A, noise, trusting=False)
        log_det = 2.0 * float(np.log(np.diag(np.linalg.cholesky(H))).sum())
        return Mode(y, log_density - 0.5 * log_det, log_density, H, good)

    def _climb(
        self, y: Array, A: Array, noise: _Noise, *, trusting: bool
    ) -> tuple[Array, float, Array, Array]:
        """Levenberg-Marquardt from ``y``: mode, log density, information, weights."""
        damping = 1e-6
        r = self._residuals(self.chart.state(A @ y))
        density, weight = noise.judged(r, trusting)
        density -= 0.5 * float(y @ y)
        g, H = self._normal(y, A, r, weight, noise)
        for _ in range(_MAX_STEPS):
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            promised = -0.5 * float(step @ g)
            new = y + step
            new_r = self._residuals(self.chart.state(A @ new))
            new_density, new_weight = noise.judged(new_r, trusting)
            new_density -= 0.5 * float(new @ new)
            if new_density > density:
                y, r, density, weight = new, new_r, new_density, new_weight
                damping = max(0.1 * damping, 1e-9)
                g, H = self._normal(y, A, r, weight, noise)
            else:
                damping = max(10.0 * damping, 1e-3)
            if promised < _SETTLED or damping > _LARGEST_DAMPING:
                break
        return y, density, H, weight

    def _residuals(self, state: State) -> Array:
        """Predicted minus seen pixel (m, 2); NaN where no spot can be."""
        return np.asarray(kernels.residuals(self.spots, state)[self.place])

    def _normal(
        self, y: Array, A: Array, r: Array, weight: Array, noise: _Noise
    ) -> tuple[Array, Array]:
        """Gradient and information of the negative log density."""
        z, m = A @ y, len(self.place)
        rows = kernels.rows(self.spots, self.chart.state(z))[self.place, :, :22]
        use = weight > 0.0
        root = np.where(use, np.sqrt(weight), 0.0)[:, None, None] * noise.whitening
        e = (root @ np.where(use[:, None], r, 0.0)[:, :, None]).ravel()
        rows = root @ np.where(use[:, None, None], rows * self.signs, 0.0)
        J = np.zeros((m, 2, self.chart.n))
        J[self.where] = rows
        # steps of the displaced cell's own tangent coordinates, then of y
        J = J.reshape(2 * m, -1) @ (self.chart.tangent_map(z) @ A)
        H = J.T @ J
        H.flat[:: len(y) + 1] += 1.0
        return y + J.T @ e, H


@dataclass(frozen=True, eq=False)
class _Noise:
    """Density of a residual: good with covariance S, or an outlier anywhere in the picture."""

    whitening: Array
    log_good: Array
    log_outlier: Array

    @classmethod
    def of(cls, S: Array, log_outlier: Array, rate: float) -> _Noise:
        L = np.linalg.cholesky(S)
        log_det = np.log(L[:, 0, 0]) + np.log(L[:, 1, 1])
        return cls(np.linalg.inv(L), np.log1p(-rate) - np.log(2 * np.pi) - log_det, log_outlier)

    def judged(self, r: Array, trusting: bool) -> tuple[float, Array]:
        """Log density of all residuals and the probabilities (m,) that they are good."""
        e = (self.whitening @ r[:, :, None])[:, :, 0]
        good = self.log_good - 0.5 * (e * e).sum(axis=1)
        good[np.isnan(good)] = -np.inf
        if trusting:
            # far enough below any possible spot for a step that loses one to be refused
            possible = np.isfinite(good)
            return float(np.where(possible, good, -1e12).sum()), possible.astype(np.float64)
        both = np.logaddexp(good, self.log_outlier)
        return float(both.sum()), np.exp(good - both)


def _square_root(belief: Belief, columns: Index) -> Array:
    """``L`` (n, k) with ``L L'`` the covariance of these columns; zero rows elsewhere."""
    information, n = belief.information, len(belief.held)
    known = ~belief.held & (np.diag(information) > 0)
    rows = np.flatnonzero(known)
    scale = 1.0 / np.sqrt(np.diag(information)[rows])
    try:
        if not (known | belief.held)[columns].all():
            raise np.linalg.LinAlgError
        C = np.linalg.cholesky(information[np.ix_(rows, rows)] * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise DegenerateError(
            "what the spots involve is not determined by what is known before"
        ) from None
    free = np.flatnonzero(~belief.held)
    L = np.zeros((len(free), len(rows)))
    L[np.searchsorted(free, rows)] = scale[:, None] * np.linalg.inv(C).T
    whole = np.zeros((n, len(rows)))
    whole[columns] = (belief.expansion @ L)[columns]
    # as few standard normal numbers as there are columns
    R = np.asarray(np.linalg.qr(whole[columns].T)[1])
    out = np.zeros((n, len(R)))
    out[columns] = R.T
    return out
