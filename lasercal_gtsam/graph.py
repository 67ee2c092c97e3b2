"""The factor graph of a cell: observations -> factors, state <-> variables.

One vector variable holds a whole cell about its start (`lasercal_factors.chart`), with one factor
for all spots and one for all priors. The only module that reads or writes `gtsam.Values`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt
from lasercal_factors.arrays import State
from lasercal_factors.batch import Loss, SpotBatch
from lasercal_factors.beam import BeamFrame
from lasercal_factors.chart import CellChart, LaserCellFactor
from lasercal_factors.wrap import custom_factor

from lasercal_gtsam import report_map
from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.holds import Holds, check_prior_names, prior_charts
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.report_map import CAMERA_TANGENT
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.table_row import TableRow

CELL_KEY = gtsam.symbol("z", 0)


@dataclass(frozen=True, eq=False)
class CellGraph:
    """Everything that defines the least-squares problem, about one start.

    Attributes
    ----------
    batch : the spots, whitened with their a-priori covariance
    holds : what is not free
    start : the cell the chart is about (all observed parts, in the observations' order)
    loss : robust loss
    scale : factor on the a-priori pixel sigmas (matters against priors only)
    """

    batch: SpotBatch
    holds: Holds
    start: Cell
    loss: Loss
    scale: float = 1.0

    @cached_property
    def chart(self) -> CellChart:
        """Coordinates about the start, in the order of `report_map.tangent_labels`."""
        aspects = tuple(self.holds.aspect.get(name) for name in self.start.cameras)
        return CellChart(state_from_cell(self.start), aspects)

    @cached_property
    def free(self) -> npt.NDArray[np.bool_]:
        """(n,) booleans: coordinates that are estimated (of tied focal lengths ``fv`` is)."""
        free = ~self.holds.held
        for c, aspect in enumerate(self.chart.aspects):
            if aspect is not None:
                free[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("fu")] = False
        return free

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """One factor with all spots, and one with all priors."""
        graph = gtsam.NonlinearFactorGraph()
        batch = self.batch if self.scale == 1.0 else self.batch.scaled(self.scale)
        graph.add(LaserCellFactor(CELL_KEY, self.chart, batch, self.loss, self.holds.held))
        if self.holds.priors:
            graph.add(prior_factor(self.chart, self.holds, self.start))
        return graph

    def start_values(self) -> gtsam.Values:
        """Values of the start: the chart's origin."""
        values = gtsam.Values()
        values.insert(CELL_KEY, np.zeros(self.chart.n))
        return values

    def state(self, values: gtsam.Values) -> State:
        """Plain arrays of the values."""
        return self.chart.state(values.atVector(CELL_KEY))

    def cell(self, values: gtsam.Values) -> Cell:
        """The cell of the values, names and image sizes from the start."""
        return cell_from_state(self.state(values), self.start)

    def rescaled(self, scale: float) -> CellGraph:
        """The same problem with the a-priori pixel sigmas multiplied by ``scale``."""
        return replace(self, scale=scale)

    def anchored(self, cell: Cell) -> CellGraph:
        """The same problem with its chart about ``cell``."""
        return replace(self, start=cell)

    def rows(self, values: gtsam.Values) -> Array:
        """Square-root information of spots and priors at the values, (rows, n), in sigmas."""
        return np.asarray(self.graph.linearize(values).jacobian()[0])

    def spot_pixels(self, camera: int) -> Array:
        """Seen pixels of the camera with that index, (M, 2)."""
        pixels, _, blocks = self.batch.spots
        parts = [pixels[:2, b[3] : b[4]] for b in blocks if b[0] == camera]
        return np.concatenate(parts, axis=1).T if parts else np.empty((0, 2))


def pixel_covariances(observations: Observations, sigma_px: float | None) -> Array:
    """(N, 2, 2) px^2; where a spot has no covariance of its own, that of ``sigma_px`` (or 1 px)."""
    cov = observations.cov_uv
    unknown = np.isnan(cov[:, 0, 0])
    if not unknown.any():
        return cov
    return np.where(unknown[:, None, None], (sigma_px or 1.0) ** 2 * np.eye(2), cov)


def make_batch(observations: Observations, sigma_px: float | None) -> SpotBatch:
    """Spots for the factors, whitened with `pixel_covariances`."""
    return SpotBatch.from_arrays(
        observations.uv,
        pixel_covariances(observations, sigma_px),
        observations.T_base_hand,
        observations.camera_index,
        observations.laser_index,
        observations.plane_index,
    )


def make_graph(
    observations: Observations,
    batch: SpotBatch,
    holds: Holds,
    start: Cell,
    loss: Loss | None = None,
) -> CellGraph:
    """Pose the problem about a start; the start's order of parts becomes the observations'.

    Raises
    ------
    DataError
        A part has spots but is not in the start, or an image size differs.
    """
    start = holds.apply(_ordered(start, observations))
    if holds.priors:
        check_prior_names(holds, start)
    return CellGraph(batch, holds, start, loss or Loss())


def state_from_cell(cell: Cell) -> State:
    """Plain arrays of a cell; each beam is written about itself."""
    cameras, planes = cell.cameras.values(), cell.planes.values()
    frames = beam_frames(cell).values()
    return State(
        np.array([c.T_base_camera[:3, :3] for c in cameras]),
        np.array([c.T_base_camera[:3, 3] for c in cameras]),
        np.array([c.intrinsics.vector for c in cameras]),
        np.array([f.R for f in frames]),
        np.array([f.t for f in frames]),
        np.zeros((len(frames), 4)),
        np.array([p.normal_base for p in planes]),
        np.array([p.distance for p in planes]),
    )


def cell_from_state(state: State, template: Cell) -> Cell:
    """Plain arrays back to a `Cell`; names and image sizes from ``template``."""
    cameras = {
        name: Camera(
            Intrinsics.from_vector(state.cam_K[i]),
            make_pose(state.cam_R[i], state.cam_t[i]),
            camera.image_size,
        )
        for i, (name, camera) in enumerate(template.cameras.items())
    }
    lasers = {
        name: Beam(*BeamFrame(state.beam_R[i], state.beam_t[i]).line(state.beam_l[i]))
        for i, name in enumerate(template.lasers)
    }
    planes = {
        name: Plane(state.plane_n[i], state.plane_d[i]) for i, name in enumerate(template.planes)
    }
    return Cell(cameras, lasers, planes)


def expansion(aspects: Sequence[float | None], free: npt.NDArray[np.bool_]) -> Array:
    """(n, n_free): free coordinates to all of them; tied focal lengths (``fu``) follow ``fv``.

    ``aspects``: of each camera, as in the chart; ``free`` (n,), where a tied ``fu`` is not.
    """
    E = np.eye(len(free))
    for c, aspect in enumerate(aspects):
        if aspect is not None:
            fu = c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("fu")
            E[fu, fu + 1] = aspect
    return E[:, free]


def spread_columns(rows: Array, cell: Cell, observations: Observations) -> Array:
    """Derivatives (N, r, 22) by each spot's own parts as ones by all coordinates, (N, r, n).

    ``rows`` as the kernels give them: camera 15, beam 4, plane 3 (its offset with GTSAM's sign).
    ``cell`` has the observed parts in the observations' order.
    """
    sizes = (len(CAMERA_TANGENT), len(report_map.BEAM_TANGENT), len(report_map.PLANE_TANGENT))
    index = observations.camera_index, observations.laser_index, observations.plane_index
    counts = len(cell.cameras), len(cell.lasers), len(cell.planes)
    out = np.zeros((*rows.shape[:2], int(np.dot(sizes, counts))))
    begin = taken = 0
    each = np.arange(len(rows))[:, None]
    for size, which, count in zip(sizes, index, counts, strict=True):
        at = begin + size * which[:, None] + np.arange(size)
        out[each, :, at] = np.swapaxes(rows[..., taken : taken + size], 1, 2)
        begin, taken = begin + size * count, taken + size
    distances = begin - sizes[2] * counts[2] + 2 + sizes[2] * np.arange(counts[2])
    out[..., distances] *= -1.0
    return out


def beam_frames(cell: Cell) -> dict[str, BeamFrame]:
    """The constant frame of each beam in a chart about ``cell``."""
    return {
        name: BeamFrame.from_line(beam.direction_hand, beam.point_hand)
        for name, beam in cell.lasers.items()
    }


def _ordered(cell: Cell, observations: Observations) -> Cell:
    parts: list[dict[str, Any]] = []
    for kind in ("cameras", "lasers", "planes"):
        have, need = getattr(cell, kind), getattr(observations, kind)
        missing = [name for name in need if name not in have]
        if missing:
            raise DataError(
                f"initial: {kind[:-1]} {missing[0]!r} has spots but is not in the given cell, "
                f"which has {sorted(have)}"
            )
        parts.append({name: have[name] for name in need})
    for name, camera in parts[0].items():
        if camera.image_size != observations.image_size[name]:
            raise DataError(
                f"initial: camera {name!r} has image size {camera.image_size}, the observations "
                f"say {observations.image_size[name]}"
            )
    return Cell(*parts)


def prior_factor(chart: CellChart, holds: Holds, start: Cell) -> gtsam.CustomFactor:
    """All priors as one factor: (row of the table - mean) / sigma; ``aspect`` by its logarithm."""
    prefix = "{}." if len(start.cameras) > 1 else ""
    aspects = {f"{prefix.format(c)}aspect": i for i, c in enumerate(start.cameras)}
    rows = {
        name: TableRow.named(name, start, chart, prior_charts(name, start))
        for name in holds.priors
        if name not in aspects
    }
    focal = len(CAMERA_TANGENT) * np.arange(len(start.cameras)) + CAMERA_TANGENT.index("fu")
    held = holds.held.copy()
    tied = [at for at, aspect in zip(focal, chart.aspects, strict=True) if aspect is not None]
    held[tied] = True

    def residuals(z: Array, K: Array) -> Array:
        e = np.full(len(holds.priors), np.inf)
        if not np.all(K[:, :2] > 0):
            return e
        for r, (name, (mean, sigma)) in enumerate(holds.priors.items()):
            if name in rows:
                e[r] = rows[name].difference(rows[name].value(z), mean) / sigma
            else:
                fu, fv = K[aspects[name], :2]
                e[r] = np.log(fu / fv / mean) * mean / sigma
        return e

    def error(values: Any) -> Array:
        z = values.atVector(CELL_KEY)
        return residuals(z, chart.intrinsics(z))

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        z = values.atVector(CELL_KEY)
        K = chart.intrinsics(z)
        J = np.zeros((len(holds.priors), chart.n))
        for r, (name, (mean, sigma)) in enumerate(holds.priors.items()):
            if name in rows:
                J[r] = rows[name].gradient(z) / sigma
            else:
                at = focal[aspects[name]]
                fu, fv = K[aspects[name], :2]
                J[r, at : at + 2] = mean / sigma * np.array([1 / fu, -1 / fv])
        for at, aspect in zip(focal, chart.aspects, strict=True):
            if aspect is not None:
                J[:, at + 1] += aspect * J[:, at]
        J[:, held] = 0.0
        return residuals(z, K), [J]

    noise = gtsam.noiseModel.Unit.Create(len(holds.priors))
    return custom_factor("priors", noise, [CELL_KEY], [chart.n], error, linearize)
