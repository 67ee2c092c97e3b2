"""A calibration laid out for judging: whitened residuals, derivatives, what projects them out.

At the optimum the residuals are ``r = (I - H) e`` to first order, with ``e`` the noise and ``H``
the projector on the columns of the whitened derivative ``A``. Every opinion is linear algebra on
``r`` and ``A``: a fault that shifts the pixels by ``B x`` shows as ``(I - H) B x``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import SpotBatch, whitening_from_covariance

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD, group_labels
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import (
    CellGraph,
    make_batch,
    make_graph,
    pixel_covariances,
    prior_factor,
    state_from_cell,
)
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import point_jacobian, spot_on_beam
from lasercal_gtsam.report_map import BEAM_TANGENT, CAMERA_TANGENT, PLANE_TANGENT, tangent_labels

Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

CAMERA, BEAM, PLANE = slice(0, 15), slice(15, 19), slice(19, 22)
"""Columns of ``parts``: tangent coordinates of each spot's own camera, laser and plane."""

_HAND_ROUNDS = 3
# residual scale below which data are exact and their residuals are rounding (px)
_EXACT_PX = 1e-6
# singular values of columns of length one that count as zero
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Bench:
    """The N spots that a calibration used, in sigmas of their noise (estimated scale included).

    Attributes
    ----------
    observations : the spots used, input order, with the hand poses that were given
    cell : the estimate
    labels : names of the free coordinates, m of them
    parts : (N, 2, 22) whitened derivative by each spot's own camera, laser and plane, per SI unit
    hand : (N, 2, 6) whitened derivative by the hand pose: translation in base, rotation in hand
    whitening : (N, 2, 2) ``W`` with ``W^T W`` the inverse covariance of a residual (1/px)
    batch : the spots that were used, of all that there are
    A : (2 N + P, m) whitened derivative by the free coordinates, P rows of priors at the end
    r : (2 N + P,) whitened residuals, predicted minus seen; with stated robot noise linearised at
        the likeliest hand poses. All derivatives are those at the given poses: the likeliest ones
        have the residuals in them, and directions that only their scatter tells apart would fit
        every residual
    group : (N,) labels of equal plane and hand orientation
    orientation : (N,) labels of equal hand orientation
    exact : the residuals are rounding: there is no noise to judge by
    unit : estimated scale that is in all of the above: in it, a residual's sigma is one
    stated : whether the noise was stated (pixels, or pixels and hand), so that ``unit`` is a factor
        on it; else ``unit`` is in px
    """

    observations: Observations
    cell: Cell
    labels: tuple[str, ...]
    parts: Array
    hand: Array
    whitening: Array
    batch: SpotBatch
    A: Array
    r: Array
    group: Index
    orientation: Index
    exact: bool
    unit: float
    stated: bool

    def __len__(self) -> int:
        return len(self.observations)

    @cached_property
    def Q(self) -> Array:
        """(2 N + P, rank) orthonormal basis of the columns of ``A``."""
        return column_space(self.A)

    @cached_property
    def residuals(self) -> Array:
        """(2 N + P,) residuals without the last bit that a further step would take away."""
        return np.asarray(self.r - self.Q @ (self.Q.T @ self.r))

    @cached_property
    def sse(self) -> float:
        """Sum of the squared whitened residuals; `dof` is what to expect."""
        return float(self.residuals @ self.residuals)

    @property
    def dof(self) -> int:
        """Whitened residuals, priors among them, minus unknowns."""
        return len(self.r) - int(self.Q.shape[1])

    @cached_property
    def free_shares(self) -> Array:
        """(2 N,) diagonal of ``I - H``: variance of each residual in units of the noise's."""
        taken = np.square(self.Q[: 2 * len(self)]).sum(axis=1)
        return np.asarray(np.maximum(1.0 - taken, 0.0))

    @cached_property
    def points(self) -> Array:
        """(N, 3) spots on their planes by the beams (8), (9), base, metres."""
        seen = self.observations
        return spot_on_beam(
            self.cell, seen.T_base_hand, plane=seen.plane.tolist(), laser=seen.laser.tolist()
        )

    @cached_property
    def by_point(self) -> Array:
        """(N, 2, 3) whitened derivative of the pixel by the spot's base point."""
        out = np.empty((len(self), 2, 3))
        for name in self.observations.cameras:
            rows = self.observations.camera == name
            out[rows] = point_jacobian(self.points[rows], self.cell.cameras[name])
        return np.asarray(self.whitening @ out)

    def columns(self, blocks: Array) -> Array:
        """(N, 2, k) whitened columns as (2 N + P, k): no prior knows of them."""
        spread = np.zeros((len(self.batch), 2, blocks[0].size // 2))
        spread[self.batch.used] = blocks.reshape(len(self), 2, -1)
        flat = self.batch.decorrelated(spread)[self.batch.used].reshape(2 * len(self), -1)
        return np.concatenate([flat, np.zeros((len(self.r) - len(flat), flat.shape[1]))])


def lay_out(calibration: Calibration) -> Bench:
    """Lay a calibration out.

    Spots that were left out are left out here; weights of a robust loss weigh here too. Stated
    robot noise is part of each spot's covariance, with the hand poses corrected as in the fit.

    Raises
    ------
    DataError
        There are no sigmas to judge by (as many unknowns as measurements), or no spot can be where
        the estimate has it.
    """
    seen, options = calibration.inputs.observations, calibration.options_used
    fit = calibration.fit
    if not (calibration.spots.weight > 0).any():
        raise DataError("the calibration does not hold its spots: there are no residuals to judge")
    if not np.isfinite(fit.sigma0):
        raise DataError(
            "the calibration has no degrees of freedom left: nothing checks it; add spots"
        )
    used = np.flatnonzero(calibration.spots.weight > 0)
    plain = make_batch(seen, options.sigma_px)
    problem = make_graph(
        seen, plain, resolve_holds(seen, options, calibration.cell), calibration.cell
    )
    problem = problem.anchored(problem.start)
    cell = problem.start
    given, S, residual, unit = _whitened(calibration, cell)
    exact = unit < _EXACT_PX
    unit = max(unit, _EXACT_PX)
    strength = np.sqrt(calibration.spots.weight) / unit
    rows = given.rows(state_from_cell(cell))[..., :-1] * strength[:, None, None]
    rows[..., 21] *= -1.0  # the kernels' offset of a plane is minus its distance
    w = whitening_from_covariance(S) * strength[:, None]
    W = np.zeros((len(seen), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = w.T
    if not np.isfinite(residual[used]).all():
        raise DataError(
            "some spots cannot be where the estimate has them (behind the camera, or the beam "
            "misses the plane): the calibration is not one"
        )
    batch = given.weighted(calibration.spots.weight > 0)
    A, r = _system(problem, rows, np.einsum("nij,nj->ni", W, residual), batch)
    kept = seen[used]
    B, _ = linearized(kept, cell, np.zeros((len(used), 6)))
    return Bench(
        observations=kept,
        cell=cell,
        labels=tuple(
            label for label, free in zip(tangent_labels(cell), problem.free, strict=True) if free
        ),
        parts=rows[used],
        hand=W[used] @ B,
        whitening=W[used],
        batch=batch,
        A=A,
        r=r,
        group=orientation_groups(kept, options),
        orientation=orientation_groups(kept, options, by_plane=False),
        exact=exact,
        unit=unit,
        stated=options.sigma_px is not None or not np.isnan(seen.cov_uv).any(),
    )


def orientation_groups(
    observations: Observations, options: CalibrationOptions, by_plane: bool = True
) -> Index:
    """(N,) labels of equal hand orientation (within four times its noise), and equal plane."""
    tolerance = max(GROUP_TOLERANCE_RAD, 4 * options.hand_sigma_rad)
    plane = observations.plane_index if by_plane else np.zeros(len(observations), np.int64)
    return group_labels(observations.T_base_hand[:, :3, :3], plane, tolerance)


def _whitened(calibration: Calibration, cell: Cell) -> tuple[SpotBatch, Array, Array, float]:
    """Spots with their whole covariance, at the given hand poses; it, the residuals, the scale."""
    seen, options = calibration.inputs.observations, calibration.options_used
    noise, state = HandNoise.of(options), state_from_cell(cell)
    unit = calibration.fit.sigma0
    if not noise.variances.any():
        batch = make_batch(seen, options.sigma_px)
        return batch, pixel_covariances(seen, options.sigma_px), batch.residuals(state), unit
    if options.sigma_px is None and np.isnan(seen.cov_uv).any():
        # the fit found the pixel sigma beside the stated noise of the hand: the scale is in it
        cov, unit = pixel_covariances(seen, unit), 1.0
    else:
        cov = pixel_covariances(seen, options.sigma_px)
    as_given = np.zeros((len(seen), 6))
    eta = as_given
    for _ in range(_HAND_ROUNDS):
        B, free = linearized(seen, cell, eta)
        aside = calibration.spots.weight <= 0
        eta = corrections(B, free, cov, noise, seen.shared_stops, aside)
    residual = corrected_batch(seen, cov, cell, noise, eta).residuals(state)
    B, _ = linearized(seen, cell, as_given)
    S = cov + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
    return corrected_batch(seen, cov, cell, noise, as_given), S, residual, unit


def _system(
    problem: CellGraph, rows: Array, residual: Array, batch: SpotBatch
) -> tuple[Array, Array]:
    """Rows of spots and priors over the free coordinates, and their residuals.

    Those of spots that share an error of the hand are made independent.
    """
    used = batch.used
    cell, n = problem.start, problem.chart.n
    sizes = (len(CAMERA_TANGENT), len(BEAM_TANGENT), len(PLANE_TANGENT))
    lasers = sizes[0] * len(cell.cameras)
    planes = lasers + sizes[1] * len(cell.lasers)
    full = np.zeros((len(rows), 2, n))
    for c, l, p, first, last in problem.batch.spots.blocks:  # noqa: E741
        members = problem.batch.order[first:last]
        at = np.concatenate(
            [
                begin + size * k + np.arange(size)
                for begin, size, k in zip((0, lasers, planes), sizes, (c, l, p), strict=True)
            ]
        )
        full[members[:, None, None], np.arange(2)[:, None], at] = rows[members]
    A = batch.decorrelated(full)[used].reshape(-1, n)
    r = batch.decorrelated(residual[..., None])[used].ravel()
    if problem.holds.priors:
        factor = prior_factor(problem.chart, problem.holds, cell)
        linear = factor.linearize(problem.start_values())
        J, b = linear.jacobian()
        A, r = np.concatenate([A, J]), np.concatenate([r, -b])
    for c, aspect in enumerate(problem.chart.aspects):
        if aspect is not None:  # fv is free and takes fu along
            fu = c * sizes[0] + CAMERA_TANGENT.index("fu")
            A[: 2 * used.sum(), fu + 1] += aspect * A[: 2 * used.sum(), fu]
    return A[:, problem.free], r


def column_space(A: Array, tolerance: float = _RANK_TOLERANCE) -> Array:
    """Orthonormal basis (rows, rank) of the columns of ``A``, whatever their units."""
    length = np.linalg.norm(A, axis=0)
    A = A[:, length > 0] / length[length > 0]
    if not A.size:
        return np.zeros((len(A), 0))
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    return np.asarray(U[:, s > tolerance * s[0]])
