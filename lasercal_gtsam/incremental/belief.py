"""What is known of a cell, as a Gaussian, and how spots add to it.

A belief stands for spots that are no longer looked at one by one: older ones, or those from before
something moved. Its coordinates are the tangent coordinates at its own cell (`report_map`), so that
no direction is singular and nothing depends on how the table writes angles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import gtsam
import numpy as np
import numpy.typing as npt
from lasercal_factors import kernels
from lasercal_factors.arrays import State
from lasercal_factors.batch import Loss, SpotBatch
from lasercal_factors.chart import CellChart, LaserCellFactor
from lasercal_factors.wrap import custom_factor

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError, DegenerateError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import (
    CELL_KEY,
    beam_frames,
    cell_from_state,
    expansion,
    state_from_cell,
)
from lasercal_gtsam.observability import SINGULAR, RangeSvd, undetermined
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.report_map import (
    BEAM_TANGENT,
    CAMERA_TANGENT,
    PLANE_TANGENT,
    tangent_labels,
)
from lasercal_gtsam.rotations import basis_of, rotation_log

Part = Literal["camera", "laser", "plane"]
Named = tuple[Part, str]
Mask = npt.NDArray[np.bool_]
POSE = 6  # the camera's pose comes first of its coordinates
# coordinates that a move changes: of a camera its pose
MOVABLE: dict[Part, int] = {"camera": POSE, "laser": 4, "plane": 3}
_MAX_ITERATIONS = 100
_CONVERGED_SIGMAS = 0.1


@dataclass(frozen=True, eq=False)
class Belief:
    """A cell and how well it is known: Gaussian in the tangent coordinates at the cell.

    Attributes
    ----------
    cell : the mean
    information : (n, n) inverse covariance, in the order of `report_map.tangent_labels`, SI units;
        zero rows where nothing is known, and for constants
    held : (n,) booleans: constants (of tied focal lengths ``fu`` is one)
    aspect : camera to ``fu / fv``, where tied
    """

    cell: Cell
    information: Array
    held: Mask
    aspect: Mapping[str, float]

    @classmethod
    def of(cls, calibration: Calibration) -> Belief:
        """What a calibration knows, by its joint covariance.

        Raises
        ------
        DataError
            The calibration has no sigmas (no degrees of freedom were left).
        """
        cell = calibrated_parts(calibration)
        aspect = tied_aspects(calibration)
        if not np.isfinite(calibration.covariance).all():
            raise DataError(
                "the calibration has no sigmas (there were as many unknowns as measurements), so "
                "that new spots cannot be weighed against it: calibrate with more spots"
            )
        held = np.diag(calibration.covariance) == 0.0
        for c, name in enumerate(cell.cameras):
            if name in aspect:
                held[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("fu")] = True
        free = np.flatnonzero(~held)
        information = np.zeros_like(calibration.covariance)
        information[np.ix_(free, free)] = np.linalg.inv(calibration.covariance[np.ix_(free, free)])
        return cls(cell, 0.5 * (information + information.T), held, aspect)

    def columns(self, kind: Part, name: str) -> slice:
        """Columns of a part; of a camera its pose only."""
        names = {"camera": self.cell.cameras, "laser": self.cell.lasers, "plane": self.cell.planes}
        if name not in names[kind]:
            raise DataError(f"{kind} {name!r} is not in the cell, which has {sorted(names[kind])}")
        at = part_offset(self.cell, kind, name)
        return slice(at, at + MOVABLE[kind])

    def without(self, columns: slice) -> Belief:
        """Forget these columns: the rest keeps exactly what it knows (marginalised, by Schur)."""
        return replace(self, information=marginalised(self.information, columns, self.held))

    def with_prior(self, columns: slice, sigmas: npt.ArrayLike) -> Belief:
        """Add independent knowledge: the belief's own cell +- ``sigmas`` on these columns."""
        information = self.information.copy()
        where = np.arange(len(information))[columns]
        information[where, where] += 1.0 / np.asarray(sigmas, dtype=np.float64) ** 2
        information[self.held], information[:, self.held] = 0.0, 0.0
        return replace(self, information=information)

    @property
    def expansion(self) -> Array:
        """(n, n_free): free coordinates to all of them; see `graph.expansion`."""
        return expansion([self.aspect.get(name) for name in self.cell.cameras], ~self.held)

    @property
    def covariance(self) -> Array:
        """(n, n); zero for constants.

        Raises
        ------
        DegenerateError
            Something is not known; names the directions.
        """
        R = kernels.cholesky(self.information)
        svd = RangeSvd.of(R, tangent_labels(self.cell), ~self.held)
        weak = svd.weak_directions(SINGULAR)
        if weak:
            raise DegenerateError(undetermined(weak))
        E = self.expansion
        return np.asarray(E @ svd.covariance() @ E.T)


@dataclass(frozen=True, eq=False)
class Fused:
    """A belief and some spots, together.

    Attributes
    ----------
    cell : the optimum
    belief : what is known there
    prior_cost, spot_cost : sums of squares (robust: losses) at the optimum
    lengths : (m,) whitened residual lengths; infinite where no spot can be
    troubles : sentences; empty if all is well
    """

    cell: Cell
    belief: Belief
    prior_cost: float
    spot_cost: float
    lengths: Array
    troubles: tuple[str, ...]


def fuse(
    belief: Belief,
    observations: Observations,
    cov_uv: Array,
    start: Cell | None = None,
    loss: Loss | None = None,
) -> Fused:
    """Most likely cell given a belief and spots, by Levenberg-Marquardt.

    Parameters
    ----------
    belief : has all the parts that the spots involve
    observations : m spots
    cov_uv : (m, 2, 2) covariances of their pixels, px^2
    start : where to begin; the belief's cell if left out
    loss : robust loss on the whitened residual lengths

    Raises
    ------
    SolveError
        The start is impossible (a beam misses its plane, a spot behind the camera).
    """
    cell, loss = belief.cell, loss or Loss()
    index = [
        np.array([list(names).index(x) for x in column.tolist()], dtype=np.int64)
        for names, column in (
            (cell.cameras, observations.camera),
            (cell.lasers, observations.laser),
            (cell.planes, observations.plane),
        )
    ]
    batch = SpotBatch.from_arrays(observations.uv, cov_uv, observations.T_base_hand, *index)
    aspects = tuple(belief.aspect.get(name) for name in cell.cameras)
    chart = CellChart(state_from_cell(cell), aspects)
    R = kernels.cholesky(belief.information)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(LaserCellFactor(CELL_KEY, chart, batch, loss, belief.held))
    graph.add(_belief_factor(R))
    values = gtsam.Values()
    values.insert(CELL_KEY, np.zeros(chart.n) if start is None else coordinates(cell, start))
    if not np.isfinite(graph.error(values)):
        raise SolveError("the start is impossible: spots behind the camera, or beams off the plane")
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(_MAX_ITERATIONS)
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    z = optimizer.optimize().atVector(CELL_KEY)
    state = chart.state(z)
    fused = cell_from_state(state, cell)
    values.update(CELL_KEY, z)
    H, b = graph.linearize(values).hessian()
    H, b = np.asarray(H), np.asarray(b)
    step = np.linalg.lstsq(H, b, rcond=1e-14)[0]
    decrement = math.sqrt(max(float(b @ step), 0.0))
    H[belief.held], H[:, belief.held] = 0.0, 0.0
    lengths = batch.whitened_lengths(state)
    lengths = np.where(np.isnan(lengths), np.inf, lengths)
    troubles: list[str] = []
    if not decrement < _CONVERGED_SIGMAS:
        troubles.append(f"not converged: one more step would move {decrement:.2g} sigma")
    if optimizer.iterations() >= _MAX_ITERATIONS:
        troubles.append(f"not converged in {_MAX_ITERATIONS} iterations")
    after = replace(belief, cell=fused, information=carried(H, chart, z, state))
    prior = float(np.sum((R @ z) ** 2))
    return Fused(fused, after, prior, batch.total_loss(state, loss), lengths, tuple(troubles))


def part_offset(cell: Cell, kind: Part, name: str) -> int:
    """First tangent column of a part."""
    lasers = len(cell.cameras) * len(CAMERA_TANGENT)
    planes = lasers + len(cell.lasers) * len(BEAM_TANGENT)
    if kind == "camera":
        return list(cell.cameras).index(name) * len(CAMERA_TANGENT)
    if kind == "laser":
        return lasers + list(cell.lasers).index(name) * len(BEAM_TANGENT)
    return planes + list(cell.planes).index(name) * len(PLANE_TANGENT)


def coordinates(reference: Cell, cell: Cell) -> Array:
    """Chart coordinates (n,) of ``cell`` about ``reference`` (which has the same parts).

    The inverse of `lasercal_factors.chart.CellChart.state`.
    """
    parts: list[Array] = []
    for name, old in reference.cameras.items():
        new = cell.cameras[name]
        R, t = old.T_base_camera[:3, :3], old.T_base_camera[:3, 3]
        parts += [
            rotation_log(R.T @ new.T_base_camera[:3, :3]),
            R.T @ (new.T_base_camera[:3, 3] - t),
            new.intrinsics.vector - old.intrinsics.vector,
        ]
    for name, frame in beam_frames(reference).items():
        beam = cell.lasers[name]
        parts.append(frame.coordinates(beam.direction_hand, beam.point_hand))
    for name, plane in reference.planes.items():
        n, d = cell.planes[name].normal_base, cell.planes[name].distance
        along = float(n @ plane.normal_base)
        sign = -1.0 if along < 0 else 1.0
        tilt = basis_of(plane.normal_base).T @ n / along
        parts.append(np.append(tilt, sign * d - plane.distance))
    return np.concatenate(parts)


def carried(information: Array, chart: CellChart, z: Array, state: State) -> Array:
    """Information in chart coordinates at ``z`` as one in the tangent coordinates of its cell."""
    back = np.linalg.inv(cell_tangent_map(chart, z, state))
    return np.asarray(back.T @ information @ back)


def cell_tangent_map(chart: CellChart, z: Array, state: State) -> Array:
    """(n, n): a step in ``z`` to a step in the tangent coordinates of the `Cell` at ``z``.

    That is the chart's own map, and `Plane`'s turning round of a normal with a negative distance.
    """
    M = chart.tangent_map(z)
    first = chart.n - len(PLANE_TANGENT) * len(state.plane_d)
    for p, (n, d) in enumerate(zip(state.plane_n, state.plane_d, strict=True)):
        if d < 0:
            at = first + len(PLANE_TANGENT) * p
            turn = np.zeros((3, 3))
            turn[:2, :2] = -basis_of(-n).T @ basis_of(n)
            turn[2, 2] = -1.0
            M[at : at + 3] = turn @ M[at : at + 3]
    return M


def marginalised(information: Array, columns: slice, held: Mask) -> Array:
    """Information of the rest where these columns are not looked at; their rows become zero."""
    out, gone = np.zeros_like(information), np.zeros(len(information), np.bool_)
    gone[columns] = True
    a = np.flatnonzero(gone & ~held)
    b = np.flatnonzero(~gone & ~held)
    A, B = information[np.ix_(a, a)], information[np.ix_(a, b)]
    # scaled, so that rank is judged without units
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    X = np.linalg.lstsq(A / np.outer(scale, scale), B / scale[:, None], rcond=1e-14)[0]
    rest = information[np.ix_(b, b)] - (B / scale[:, None]).T @ X
    out[np.ix_(b, b)] = 0.5 * (rest + rest.T)
    return out


def calibrated_parts(calibration: Calibration) -> Cell:
    """The parts of the calibrated cell that the covariance is about."""
    cell = calibration.cell
    labels = set(calibration.labels)
    return Cell(
        {name: part for name, part in cell.cameras.items() if f"{name}.rot_x" in labels},
        {name: part for name, part in cell.lasers.items() if f"{name}.slope_a" in labels},
        {name: part for name, part in cell.planes.items() if f"plane {name}.distance" in labels},
    )


def tied_aspects(calibration: Calibration) -> dict[str, float]:
    """Ratios ``fu / fv`` that the calibration's options hold, by camera."""
    known = calibration.inputs.options.known
    found = {c: known.get(f"{c}.aspect", known.get("aspect")) for c in calibration.cell.cameras}
    return {c: float(a) for c, a in found.items() if a is not None}


def _belief_factor(R: Array) -> gtsam.CustomFactor:
    """``R z``: the belief about the chart's own reference."""
    n = len(R)

    def error(values: Any) -> Array:
        return np.asarray(R @ values.atVector(CELL_KEY))

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        return R @ values.atVector(CELL_KEY), [np.asfortranarray(R)]

    noise = gtsam.noiseModel.Unit.Create(n)
    return custom_factor("belief", noise, [CELL_KEY], [n], error, linearize)
