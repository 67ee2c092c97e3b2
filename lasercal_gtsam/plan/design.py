"""Choosing shots by what they take off the error on the planes: greedy, then by exchange.

The calibration is linear in the small: a shot with Jacobian J and noise sigma adds
``J' J / sigma^2`` to the information, and takes ``C J' (sigma^2 + J C J')^-1 J C`` off the
covariance C. The error that counts is the mean square distance by which `locate` is off, averaged
over each plane and over the planes: ``tr(W C)``, with W from the derivative of `locate` on a grid.
What each shot takes off it has a closed form, and all candidates are tried at once (an L-optimal
design by Fedorov's exchange).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Names
from lasercal_gtsam.plan.limits import Limits
from lasercal_gtsam.prediction import CellUncertainty, located_jacobian, spot_jacobian
from lasercal_gtsam.report_map import tangent_labels

Index = npt.NDArray[np.int64]

_GRID = (16, 12)
_SWEEPS = 4
# an exchange must gain this share of the error to be made
_GAIN = 1e-4


@dataclass(frozen=True, eq=False)
class Problem:
    """What the choice of shots is about: the free coordinates, and the error that counts.

    Attributes
    ----------
    cell, camera, laser : what is planned for
    labels : of all tangent coordinates
    basis : (n, m) the directions out of these that are estimated, as columns; a column of the
        identity where a coordinate is free by itself
    grid : plane -> (G, 3, m) derivative of `locate` at the grid along these directions, metres
    places : plane -> (G, 3) the grid's points, base
    """

    cell: Cell
    camera: str
    laser: str
    labels: tuple[str, ...]
    basis: Array
    grid: dict[str, Array]
    places: dict[str, Array]

    @classmethod
    def of(cls, cell: Cell, camera: str, laser: str, basis: Array, limits: Limits) -> Problem:
        """Lay a grid over the part of each plane that the camera sees within the limits' depth.

        Raises
        ------
        DataError
            The camera does not see a plane.
        """
        labels = tangent_labels(cell)
        unknown = CellUncertainty(cell, np.eye(len(labels)), labels)
        width, height = cell.cameras[camera].image_size
        m = limits.margin_px
        u, v = np.meshgrid(
            np.linspace(m, width - 1 - m, _GRID[0]), np.linspace(m, height - 1 - m, _GRID[1])
        )
        uv = np.column_stack([u.ravel(), v.ravel()])
        T = cell.cameras[camera].T_base_camera
        grid, places = {}, {}
        for name in cell.planes:
            points, J, _ = located_jacobian(cell, uv, name, camera)
            depth = (points - T[:3, 3]) @ T[:3, 2]
            seen = np.isfinite(points).all(axis=1)
            seen &= (depth >= limits.depth[0]) & (depth <= limits.depth[1])
            if not seen.any():
                raise DataError(
                    f"plan: the camera sees nothing of plane {name!r} at depths of "
                    f"{limits.depth[0]:g} to {limits.depth[1]:g} m; check the cell"
                )
            full = np.zeros((int(seen.sum()), 3, len(labels)))
            full[:, :, unknown.columns(camera, None, name)] = J[seen]
            grid[name], places[name] = full @ basis, points[seen]
        return cls(cell, camera, laser, labels, basis, grid, places)

    @property
    def weight(self) -> Array:
        """W (m, m): ``tr(W C)`` is the mean square error of `locate`, m^2."""
        m = self.basis.shape[1]
        parts = [np.einsum("gia,gib->ab", G, G, optimize=True) / len(G) for G in self.grid.values()]
        return np.asarray(sum(parts, np.zeros((m, m))) / len(parts))

    def rows(self, T_base_hand: Array, plane: Names) -> Array:
        """Derivative (N, 2, m) of the pixels of shots along the estimated directions."""
        out = np.zeros((len(plane), 2, len(self.labels)))
        unknown = CellUncertainty(self.cell, np.eye(len(self.labels)), self.labels)
        for name in self.cell.planes:
            on = np.flatnonzero(plane == name)
            if len(on):
                _, J = spot_jacobian(self.cell, T_base_hand[on], name, self.camera, self.laser)
                columns = unknown.columns(self.camera, self.laser, name)
                out[on[:, None], :, columns] = np.swapaxes(J, 1, 2)
        return np.asarray(out @ self.basis)

    def error_map(self, covariance: Array) -> dict[str, Array]:
        """Sigma of `locate` at the grid of each plane, (G,) metres: root of the trace."""
        return {
            name: np.sqrt(np.einsum("gia,ab,gib->g", G, covariance, G, optimize=True))
            for name, G in self.grid.items()
        }

    def mean_error(self, covariance: Array) -> dict[str, float]:
        """Root mean square of `error_map`, by plane, metres."""
        found = self.error_map(covariance)
        return {name: float(np.sqrt(np.mean(e**2))) for name, e in found.items()}


def covariance_of(prior: Array, rows: Array, sigma_px: float) -> Array:
    """Covariance (m, m) of information ``prior`` (m, m) and shots ``rows`` (N, 2, m)."""
    J = rows.reshape(-1, rows.shape[-1]) / sigma_px
    scale = 1.0 / np.sqrt(np.diag(prior))
    H = (prior + J.T @ J) * np.outer(scale, scale)
    inverse = np.linalg.inv(0.5 * (H + H.T))
    return np.asarray(inverse * np.outer(scale, scale))


def choose(prior: Array, rows: Array, weight: Array, sigma_px: float, count: int) -> Index:
    """Indices (count,) of the shots to take, in the order in which they help most.

    Greedy; then each is exchanged for a better one until none is left that gains.

    Parameters
    ----------
    prior : (m, m) information before, positive definite
    rows : (N, 2, m) of the candidates
    weight : (m, m), `Problem.weight`
    sigma_px : noise of a pixel coordinate
    count : how many; at most N

    Raises
    ------
    DataError
        Fewer candidates than shots to take.
    """
    if count > len(rows):
        raise DataError(
            f"plan: only {len(rows)} poses are possible within the limits, {count} are asked for"
        )
    J = rows / sigma_px
    covariance = covariance_of(prior, rows[:0], sigma_px)
    chosen: list[int] = []
    for _ in range(count):
        drop = _drops(covariance, J, weight)
        drop[chosen] = -np.inf
        best = int(np.argmax(drop))
        chosen.append(best)
        covariance = covariance_of(prior, rows[chosen], sigma_px)
    for _ in range(_SWEEPS):
        changed = False
        for i in range(count):
            others = chosen[:i] + chosen[i + 1 :]
            without = covariance_of(prior, rows[others], sigma_px)
            drop = _drops(without, J, weight)
            drop[others] = -np.inf
            best = int(np.argmax(drop))
            left = float(np.sum(weight * without)) - drop[best]
            if best != chosen[i] and drop[best] - drop[chosen[i]] > _GAIN * left:
                chosen[i] = best
                changed = True
        if not changed:
            break
    return np.array(chosen, dtype=np.int64)


def _drops(covariance: Array, J: Array, weight: Array) -> Array:
    """What each shot (N, 2, m), whitened, would take off ``tr(W C)``: (N,)."""
    CJ = J @ covariance
    S = np.eye(2) + CJ @ np.swapaxes(J, 1, 2)
    A = CJ @ weight @ np.swapaxes(CJ, 1, 2)
    determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] * S[:, 1, 0]
    trace = S[:, 1, 1] * A[:, 0, 0] + S[:, 0, 0] * A[:, 1, 1]
    return np.asarray((trace - 2.0 * S[:, 0, 1] * A[:, 0, 1]) / determinant)
