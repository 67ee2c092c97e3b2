"""The factor graph of a cell: keys, state <-> `gtsam.Values`, observations -> factors.

The only module that reads or writes `gtsam.Values`; also the only one that knows that
`gtsam.OrientedPlane3` stores ``n.x + d = 0`` where we write ``n.x = d``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from lasercal_factors.beam import BeamFrame
from lasercal_factors.spot import (
    CellKeys,
    LaserSpotBatchFactor,
    Loss,
    SpotBatch,
    State,
    keys_for,
)
from lasercal_factors.wrap import custom_factor

from lasercal_gtsam import report_map
from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.holds import Holds, check_prior_names
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.report_map import BeamChart
from lasercal_gtsam.rotations import make_pose


@dataclass(frozen=True, eq=False)
class CellGraph:
    """Everything that defines the least-squares problem, about one start.

    Attributes
    ----------
    batch : the spots, whitened with their a-priori covariance
    keys : variables; beams are written about the start's beams
    holds : what is not free
    start : the cell the charts are anchored at (all observed parts, in the observations' order)
    loss : robust loss
    scale : factor on the a-priori pixel sigmas (matters against priors only)
    """

    batch: SpotBatch
    keys: CellKeys
    holds: Holds
    start: Cell
    loss: Loss
    scale: float = 1.0

    @cached_property
    def charts(self) -> dict[str, BeamChart]:
        """Report charts of the beams, those of the start."""
        return {name: BeamChart.of(beam) for name, beam in self.start.lasers.items()}

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Batch factor of all spots, and one factor with all priors."""
        graph = gtsam.NonlinearFactorGraph()
        batch = self.batch if self.scale == 1.0 else self.batch.scaled(self.scale)
        graph.add(LaserSpotBatchFactor(self.keys, batch, self.loss, self.holds.held))
        if self.holds.priors:
            graph.add(_prior_factor(self.keys, self.holds, self.start, self.charts))
        return graph

    def values(self, cell: Cell | None = None) -> gtsam.Values:
        """Values of a cell (the start if left out)."""
        cell = self.start if cell is None else cell
        values = gtsam.Values()
        for (x, k), camera in zip(self.keys.cameras, cell.cameras.values(), strict=True):
            values.insert(x, gtsam.Pose3(camera.T_base_camera))
            values.insert(k, camera.intrinsics.to_gtsam())
        lasers = zip(self.keys.lasers, self.keys.frames, cell.lasers.values(), strict=True)
        for key, frame, beam in lasers:
            values.insert(key, frame.coordinates(beam.direction_hand, beam.point_hand))
        for key, plane in zip(self.keys.planes, cell.planes.values(), strict=True):
            a, b, c = plane.normal_base
            values.insert(key, gtsam.OrientedPlane3(a, b, c, -plane.distance))
        return values

    def cell(self, values: gtsam.Values) -> Cell:
        """The cell of the values, names and image sizes from the start."""
        return cell_from_state(self.keys.read(values), self.start, self.keys.frames)

    def rescaled(self, scale: float) -> CellGraph:
        """The same problem with the a-priori pixel sigmas multiplied by ``scale``."""
        return replace(self, scale=scale)

    def anchored(self, cell: Cell) -> CellGraph:
        """The same problem with its charts anchored at ``cell``."""
        frames = _frames(cell)
        return replace(self, start=cell, keys=replace(self.keys, frames=frames))

    def spot_pixels(self, camera: int) -> Array:
        """Seen pixels of the camera with that index, (M, 2)."""
        parts = [self.batch.pixels[:2, b[3] : b[4]] for b in self.batch.blocks if b[0] == camera]
        return np.concatenate(parts, axis=1).T if parts else np.empty((0, 2))

    def residuals(self, cell: Cell) -> Array:
        """Predicted minus seen pixel of each spot in input order, (N, 2); NaN where impossible."""
        return self.batch.residuals(self.keys.read(self.values(cell)))


def make_batch(observations: Observations, sigma_px: float | None) -> SpotBatch:
    """Spots for the factors; where a spot has no covariance of its own, ``sigma_px`` (or 1 px)."""
    cov = observations.cov_uv
    unknown = np.isnan(cov[:, 0, 0])
    if unknown.any():
        cov = np.where(unknown[:, None, None], (sigma_px or 1.0) ** 2 * np.eye(2), cov)
    return SpotBatch.from_arrays(
        observations.uv,
        cov,
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
    frames = _frames(start)
    aspects = tuple(holds.aspect.get(name) for name in start.cameras)
    keys = keys_for(len(start.cameras), len(frames), len(start.planes), frames, aspects)
    problem = CellGraph(batch, keys, holds, start, loss or Loss())
    if holds.priors:
        check_prior_names(holds, start, problem.charts)
    return problem


def cell_from_state(state: State, template: Cell, frames: tuple[BeamFrame, ...]) -> Cell:
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
        name: Beam(*frames[i].line(state.beam_l[i])) for i, name in enumerate(template.lasers)
    }
    planes = {
        name: Plane(state.plane_n[i], state.plane_d[i]) for i, name in enumerate(template.planes)
    }
    return Cell(cameras, lasers, planes)


def _frames(cell: Cell) -> tuple[BeamFrame, ...]:
    return tuple(BeamFrame.from_line(b.direction_hand, b.point_hand) for b in cell.lasers.values())


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


def _prior_factor(
    keys: CellKeys, holds: Holds, template: Cell, charts: dict[str, BeamChart]
) -> gtsam.CustomFactor:
    """All priors as one factor: (row of the table - mean) / sigma; ``aspect`` by its logarithm."""
    rows = report_map.row_names(template, charts)
    index = {name: i for i, (name, _) in enumerate(rows)}
    prefix = "{}." if len(template.cameras) > 1 else ""
    aspects = {f"{prefix.format(c)}aspect": i for i, c in enumerate(template.cameras)}
    frames = dict(zip(template.lasers, keys.frames, strict=True))
    columns = keys.columns
    focal = [columns[2 * c + 1].start for c in range(len(template.cameras))]

    def residual(cell: Cell) -> Array:
        values = report_map.row_values(cell, charts)
        intrinsics = [camera.intrinsics for camera in cell.cameras.values()]
        e = np.empty(len(holds.priors))
        for r, (name, (mean, sigma)) in enumerate(holds.priors.items()):
            if name in aspects:
                ratio = intrinsics[aspects[name]].fu / intrinsics[aspects[name]].fv
                e[r] = np.log(ratio / mean) * mean / sigma
                continue
            difference = values[index[name]] - mean
            if rows[index[name]][1] == "deg":
                difference = (difference + 180.0) % 360.0 - 180.0
            e[r] = difference / sigma
        return e

    def error(values: Any) -> Array:
        return residual(cell_from_state(keys.read(values), template, keys.frames))

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        state = keys.read(values)
        cell = cell_from_state(state, template, keys.frames)
        F = report_map.row_jacobian(cell, charts, frames)
        for i, c in enumerate(columns[len(columns) - len(keys.planes) :]):
            # at GTSAM's normal, whichever way it points, and its offset -d
            F[c, c] = report_map.plane_jacobian(state.plane_n[i], state.plane_d[i])
            F[c, c.stop - 1] *= -1.0
        J = np.zeros((len(holds.priors), keys.n))
        for r, (name, (mean, sigma)) in enumerate(holds.priors.items()):
            if name in aspects:
                camera = aspects[name]
                fu, fv = state.cam_K[camera, :2]
                J[r, focal[camera] : focal[camera] + 2] = mean / sigma * np.array([1 / fu, -1 / fv])
            else:
                J[r] = F[index[name]] / sigma
        held = holds.held.copy()
        for first, aspect in zip(focal, keys.aspects, strict=True):
            if aspect is not None:
                J[:, first + 1] += aspect * J[:, first]
                held[first] = True
        J[:, held] = 0.0
        return residual(cell), [J[:, c] for c in columns]

    noise = gtsam.noiseModel.Unit.Create(len(holds.priors))
    return custom_factor("priors", noise, keys.keys, keys.dims, error, linearize)
