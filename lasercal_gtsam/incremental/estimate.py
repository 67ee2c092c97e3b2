"""What the running estimate knew at one moment, to be read whenever somebody asks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lasercal_factors.arrays import State
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import cell_from_state, expansion
from lasercal_gtsam.incremental.belief import Belief, Mask, carried, cell_tangent_map


@dataclass(frozen=True)
class Estimate:
    """The estimate with its square-root information, in the coordinates of a chart.

    Attributes
    ----------
    chart, template : coordinates, and the names of the parts
    held : (n,) constants
    open : (n,) coordinates that are not determined yet
    z : (n,) the estimate
    R : (n+1, n+1) square root of the information
    cost, dof : sum of squares (a-priori sigmas) and degrees of freedom
    weight, square : number of the used spots and their squared residuals (px^2), those that were
        folded into the prior included
    """

    chart: CellChart
    template: Cell
    held: Mask
    open: Mask
    z: Array
    R: Array
    cost: float
    dof: float
    weight: float
    square: float

    @property
    def sigma0(self) -> float:
        """A-posteriori scale of the a-priori pixel sigmas; NaN without degrees of freedom."""
        return float(np.sqrt(self.cost / self.dof)) if self.dof >= 1 else float("nan")

    @property
    def rms_px(self) -> float:
        """Residual RMS of the used spots, px."""
        return float(np.sqrt(self.square / self.weight)) if self.weight > 0 else 0.0

    @property
    def state(self) -> State:
        """Plain arrays of the estimate."""
        return self.chart.state(self.z)

    @property
    def cell(self) -> Cell:
        """The estimate."""
        return cell_from_state(self.state, self.template)

    def belief(self, scale: float | None = None) -> Belief:
        """The estimate as a `Belief`; in units of ``scale`` (``sigma0``; 1 where there is none)."""
        n, state = len(self.z), self.state
        H = self.R[:n, :n].T @ self.R[:n, :n]
        out = self.held | self.open
        H[out], H[:, out] = 0.0, 0.0
        scale = self.sigma0 if scale is None else scale
        scale = scale if np.isfinite(scale) and scale > 0 else 1.0
        information = carried(H, self.chart, self.z, state) / scale**2
        return Belief(cell_from_state(state, self.template), information, self.fixed, self._aspect)

    def covariance(self) -> Array:
        """(n, n) in the tangent coordinates of `cell`, scaled by ``sigma0``.

        Zero for constants, NaN for what is not determined yet and where there is no scale; all NaN
        where some combination is not determined.
        """
        root = self.root()
        covariance = np.asarray(self.sigma0**2 * root @ root.T)
        constant = ~np.any(self._expansion != 0, axis=1) & ~self.open
        covariance[constant], covariance[:, constant] = 0.0, 0.0
        covariance[self.open], covariance[:, self.open] = np.nan, np.nan
        return covariance

    def root(self) -> Array:
        """(n, m) square root of the covariance that the a-priori sigmas give, at `cell`.

        In tangent coordinates; NaN where some combination is not determined.
        """
        free = np.flatnonzero(~(self.fixed | self.open))
        R = self.R[np.ix_(free, free)]
        root = np.linalg.inv(R) if np.all(np.diag(R) > 0) else np.full_like(R, np.nan)
        return cell_tangent_map(self.chart, self.z, self.state) @ self._expansion @ root

    @property
    def _expansion(self) -> Array:
        """(n, m): all coordinates from those that are estimated."""
        return expansion(self.chart.aspects, ~(self.fixed | self.open))

    @property
    def _aspect(self) -> dict[str, float]:
        pairs = zip(self.template.cameras, self.chart.aspects, strict=True)
        return {name: aspect for name, aspect in pairs if aspect is not None}

    @property
    def fixed(self) -> Mask:
        """Constants, and the focal lengths that follow others."""
        fixed = self.held.copy()
        fixed[15 * np.flatnonzero(~np.isnan(self.chart.aspect_array)) + 6] = True
        return fixed
