"""One row of the table as a function of the chart's coordinates, by its own part of the cell alone.

`report_map` gives all rows of a cell at once; what asks for a few of them again and again (priors,
profiles) asks here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lasercal_factors.arrays import State
from lasercal_factors.beam import BeamFrame
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report_map import (
    BEAM_TANGENT,
    CAMERA_ROWS,
    CAMERA_TANGENT,
    PLANE_TANGENT,
    BeamChart,
    beam_jacobian,
    beam_rows,
    camera_jacobian,
    camera_rows,
    plane_jacobian,
    row_names,
)
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.units import MM_PER_M


@dataclass(frozen=True, eq=False)
class TableRow:
    """A row of the table.

    Attributes
    ----------
    chart : of the coordinates ``z`` (n,)
    name, unit : of the row
    first : coordinate where its part of the cell begins
    part, index : number of the part (of its kind), and of the row within it
    """

    chart: CellChart
    name: str
    unit: str
    first: int
    part: int
    index: int

    @staticmethod
    def named(name: str, cell: Cell, chart: CellChart, charts: dict[str, BeamChart]) -> TableRow:
        """The row of that name.

        Parameters
        ----------
        cell : the chart's origin
        charts : how each beam is written

        Raises
        ------
        KeyError
            There is no such row.
        """
        names = row_names(cell, charts)
        at = {row: i for i, (row, _) in enumerate(names)}[name]
        unit = names[at][1]
        first = 0
        for part, camera in enumerate(cell.cameras.values()):
            if at < len(CAMERA_ROWS):
                head = CAMERA_ROWS[at][0]
                if head in CAMERA_TANGENT:
                    index = CAMERA_TANGENT.index(head)
                    return _IntrinsicRow(chart, name, unit, first, part, index)
                return _CameraRow(chart, name, unit, first, part, at, camera.image_size)
            at, first = at - len(CAMERA_ROWS), first + len(CAMERA_TANGENT)
        for part, laser in enumerate(cell.lasers):
            if at < len(charts[laser].rows):
                return _BeamRow(chart, name, unit, first, part, at, charts[laser])
            at, first = at - len(charts[laser].rows), first + len(BEAM_TANGENT)
        part, index = divmod(at, len(PLANE_TANGENT))
        return _PlaneRow(chart, name, unit, first + len(PLANE_TANGENT) * part, part, index)

    @property
    def bending(self) -> range:
        """Coordinates by which the gradient changes."""
        raise NotImplementedError

    def difference(self, a: float, b: float) -> float:
        """``a - b``, on the circle where it is an angle."""
        return (a - b + 180.0) % 360.0 - 180.0 if self.unit == "deg" else a - b

    def value(self, z: Array) -> float:
        """The row at ``z``."""
        raise NotImplementedError

    def gradient(self, z: Array) -> Array:
        """Its derivative by ``z``, (n,)."""
        raise NotImplementedError

    def _spread(self, own: Array, z: Array) -> Array:
        """From a derivative by the tangent coordinates of the part's cell at ``z``."""
        out = np.zeros(self.chart.n)
        out[self.first : self.first + len(own)] = own
        return np.asarray(out @ self.chart.tangent_map(z))


class _IntrinsicRow(TableRow):
    """An intrinsic that is a coordinate itself; ``index`` within the camera's coordinates."""

    @property
    def bending(self) -> range:
        return range(0)

    def value(self, z: Array) -> float:
        index = self.index - CAMERA_TANGENT.index("fu")
        return float(self.chart.intrinsics(z)[self.part, index])

    def gradient(self, z: Array) -> Array:
        out = np.zeros(self.chart.n)
        out[self.first + self.index] = 1.0
        return out


@dataclass(frozen=True, eq=False)
class _CameraRow(TableRow):
    image_size: tuple[int, int]

    @property
    def bending(self) -> range:
        return range(self.first, self.first + len(CAMERA_TANGENT))

    def value(self, z: Array) -> float:
        return float(camera_rows(self._camera(self.chart.state(z)))[self.index])

    def gradient(self, z: Array) -> Array:
        own = camera_jacobian(self._camera(self.chart.state(z)))[self.index]
        return self._spread(own, z)

    def _camera(self, state: State) -> Camera:
        pose = make_pose(state.cam_R[self.part], state.cam_t[self.part])
        return Camera(Intrinsics.from_vector(state.cam_K[self.part]), pose, self.image_size)


@dataclass(frozen=True, eq=False)
class _BeamRow(TableRow):
    beam_chart: BeamChart

    @property
    def bending(self) -> range:
        return range(self.first, self.first + len(BEAM_TANGENT))

    def value(self, z: Array) -> float:
        return float(beam_rows(self._beam(z), self.beam_chart)[self.index])

    def gradient(self, z: Array) -> Array:
        own = beam_jacobian(self._beam(z), self.beam_chart, self._frame)[self.index]
        return self._spread(own, z)

    @property
    def _frame(self) -> BeamFrame:
        about = self.chart.reference
        return BeamFrame(about.beam_R[self.part], about.beam_t[self.part])

    def _beam(self, z: Array) -> Beam:
        return Beam(*self._frame.line(self.chart.state(z).beam_l[self.part]))


class _PlaneRow(TableRow):
    """A component of ``a = d n``, at the normal as it stands: `Plane` may turn it round."""

    @property
    def bending(self) -> range:
        return range(self.first, self.first + len(PLANE_TANGENT))

    def value(self, z: Array) -> float:
        state = self.chart.state(z)
        return float(MM_PER_M * state.plane_d[self.part] * state.plane_n[self.part, self.index])

    def gradient(self, z: Array) -> Array:
        state = self.chart.state(z)
        normal, distance = state.plane_n[self.part], float(state.plane_d[self.part])
        return self._spread(plane_jacobian(normal, distance)[self.index], z)
