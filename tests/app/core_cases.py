"""Shared by the tests of the core: cases with a known truth, and a second, independent solver.

The second solver knows nothing of graphs, factors or charts: parameters of its own, SciPy's
Levenberg-Marquardt and Jacobians by differences of `lasercal_gtsam.project`, which has tests of its
own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import lasercal_gtsam as lc
from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.simulate import Noise, Simulation, simulate


@cache
def simulated(preset: str = "paper", seed: int = 0, pixel_px: float = 0.0) -> Simulation:
    return simulate(preset, seed, Noise(pixel_px=pixel_px))


def rows_of(cell: lc.Cell, charts_of: lc.Cell | None = None) -> dict[str, float]:
    """Table rows of a cell, in the charts of another."""
    beams = (charts_of or cell).lasers
    charts = {name: BeamChart.of(beam) for name, beam in beams.items()}
    names = [name for name, _ in row_names(cell, charts)]
    return dict(zip(names, row_values(cell, charts).tolist(), strict=True))


def distance_in_sigmas(a: lc.Calibration, b: lc.Calibration | lc.Cell) -> float:
    """Largest difference of a row, in sigmas of ``a``; held rows must be equal to rounding."""
    other = rows_of(b.cell if isinstance(b, lc.Calibration) else b, a.cell)
    worst = 0.0
    for row in a.parameters:
        difference = abs(row.refined - other[row.name])
        if row.unit == "deg":
            difference = min(difference, abs(360.0 - difference))
        if row.sigma > 0:
            worst = max(worst, difference / row.sigma)
        else:
            assert difference <= 1e-12 * max(1.0, abs(row.refined)), row.name
    return worst


def shuffled(observations: lc.Observations, seed: int = 0) -> lc.Observations:
    return observations[np.random.default_rng(seed).permutation(len(observations))]


@dataclass(frozen=True)
class OtherSolver:
    """Least squares on one camera and one laser about a reference cell.

    ``x``: rotation vector on the left of the camera's rotation, camera position (m), the nine
    intrinsics, two tilts and two shifts (m) of the beam, the vector ``a`` (m) of every plane.
    """

    observations: lc.Observations
    reference: lc.Cell
    free: np.ndarray

    @classmethod
    def about(
        cls, observations: lc.Observations, reference: lc.Cell, held: tuple[str, ...] = ()
    ) -> OtherSolver:
        free = np.ones(19 + 3 * len(observations.planes), dtype=bool)
        for name in held:
            free[6 + INTRINSIC_NAMES.index(name)] = False
        return cls(observations, reference, free)

    def start(self) -> np.ndarray:
        (camera,) = self.reference.cameras.values()
        planes = [self.reference.planes[name].vector for name in self.observations.planes]
        return np.concatenate(
            [
                np.zeros(3),
                camera.T_base_camera[:3, 3],
                camera.intrinsics.vector,
                np.zeros(4),
                *planes,
            ]
        )

    def cell(self, x: np.ndarray) -> lc.Cell:
        ((camera_name, camera),) = self.reference.cameras.items()
        ((laser_name, beam),) = self.reference.lasers.items()
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ camera.T_base_camera[:3, :3]
        intrinsics = lc.Intrinsics.from_vector(x[6:15])
        across = null_space(beam.direction_hand[None])
        direction = beam.direction_hand + across @ x[15:17]
        point = beam.point_hand + across @ x[17:19]
        planes = {
            name: lc.Plane.from_vector(x[19 + 3 * i : 22 + 3 * i])
            for i, name in enumerate(self.observations.planes)
        }
        return lc.Cell(
            {camera_name: lc.Camera(intrinsics, make_pose(R, x[3:6]), camera.image_size)},
            {laser_name: lc.Beam(direction, point)},
            planes,
        )

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Whitened residuals, 1 px where a spot has no covariance of its own."""
        seen = self.observations
        error = lc.project(self.cell(x), seen.T_base_hand, plane=seen.plane) - seen.uv
        if np.isnan(seen.cov_uv).any():
            return error.ravel()
        L = np.linalg.cholesky(seen.cov_uv)
        return np.linalg.solve(L, error[..., None]).ravel()

    def solve(
        self,
        extra: Callable[[lc.Cell], np.ndarray] | None = None,
        tie: Callable[[np.ndarray], np.ndarray] = lambda x: x,
    ) -> Found:
        """Minimise residuals and ``extra`` ones; ``tie`` maps free ``x`` to the one that counts."""
        start = self.start()

        def whole(y: np.ndarray) -> np.ndarray:
            x = start.copy()
            x[self.free] = y
            return tie(x)

        def function(y: np.ndarray) -> np.ndarray:
            r = self.residuals(whole(y))
            return r if extra is None else np.concatenate([r, extra(self.cell(whole(y)))])

        options = {"method": "lm", "jac": "3-point", "x_scale": "jac"}
        y = start[self.free]
        for _ in range(2):
            y = least_squares(function, y, ftol=1e-15, xtol=1e-15, gtol=1e-15, **options).x
        J = differences(function, y)
        F = differences(
            lambda y: np.array(list(rows_of(self.cell(whole(y)), self.reference).values())), y
        )
        # the last digits by Newton steps with the better Jacobian
        y = y - np.linalg.lstsq(J, function(y), rcond=None)[0]
        scale = np.linalg.norm(J, axis=0)
        information = (J / scale).T @ (J / scale)
        covariance = np.linalg.inv(information) / np.outer(scale, scale)
        sigma2 = float(np.sum(self.residuals(whole(y)) ** 2))
        return Found(self.cell(whole(y)), sigma2, len(y), F @ covariance @ F.T)


@dataclass(frozen=True)
class Found:
    """Optimum of `OtherSolver`: cell, sum of squares, unknowns, covariance of the rows at 1 px."""

    cell: lc.Cell
    cost: float
    unknowns: int
    covariance: np.ndarray


def differences(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Derivative by central differences of fourth order."""
    columns = []
    for i, value in enumerate(x):
        h = 1e-4 * max(abs(value), 1e-1)
        e = np.zeros(len(x))
        e[i] = h
        first = function(x + e) - function(x - e)
        second = function(x + 2 * e) - function(x - 2 * e)
        columns.append((8 * first - second) / (12 * h))
    return np.stack(columns, axis=-1)


def moved_intrinsics(cell: lc.Cell, **changes: float) -> lc.Cell:
    """The cell with other intrinsics."""
    cameras = {
        name: replace(camera, intrinsics=replace(camera.intrinsics, **changes))
        for name, camera in cell.cameras.items()
    }
    return replace(cell, cameras=cameras)
