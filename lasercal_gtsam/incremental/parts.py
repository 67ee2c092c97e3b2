"""Cells with a part more, less or elsewhere, and what is known of them beforehand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import gtsam
import numpy as np
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CELL_KEY, prior_factor, state_from_cell
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.incremental.belief import Mask, Part
from lasercal_gtsam.incremental.relocate import locate_camera, locate_laser, locate_plane
from lasercal_gtsam.observations import Observations

KINDS: tuple[Part, ...] = ("camera", "laser", "plane")


def with_part(cell: Cell, kind: Part, name: str, part: Camera | Beam | Plane) -> Cell:
    """The cell with that part in it, in its old place or at the end."""
    return replace(cell, **{f"{kind}s": {**getattr(cell, f"{kind}s"), name: part}})


def without_parts(cell: Cell, parts: Iterable[tuple[Part, str]]) -> Cell:
    """The cell without those parts."""
    gone = set(parts)
    kept = {
        f"{kind}s": {
            name: part
            for name, part in getattr(cell, f"{kind}s").items()
            if (kind, name) not in gone
        }
        for kind in KINDS
    }
    return Cell(**kept)


def located(kind: Part, name: str, observations: Observations, cell: Cell) -> Camera | Beam | Plane:
    """The part from its spots whose other parts are in the cell (see `relocate`)."""
    good = getattr(observations, kind) == name
    for other in KINDS:
        if other != kind:
            good &= np.isin(getattr(observations, other), list(getattr(cell, f"{other}s")))
    spots = observations[good]
    if kind == "camera":
        return locate_camera(cell, spots)
    return locate_laser(cell, spots) if kind == "laser" else locate_plane(cell, spots)


def soft_priors(
    cell: Cell,
    aspects: tuple[float | None, ...],
    held: Mask,
    priors: Mapping[str, tuple[float, float]],
) -> Callable[[Array], Array] | None:
    """Priors on rows of the table, as augmented information about a point of the cell's chart.

    None where there are none. The function takes chart coordinates (n,) and gives
    ``[J r]^T [J r]``, (n+1, n+1), at that point.
    """
    if not priors:
        return None
    chart = CellChart(state_from_cell(cell), aspects)
    holds = Holds(held, {}, {}, frozenset(), dict(priors), ())
    factor = prior_factor(chart, holds, cell)

    def information(z: Array) -> Array:
        values = gtsam.Values()
        values.insert(CELL_KEY, z)
        A, b = factor.linearize(values).jacobian()
        rows = np.column_stack([A, -b])
        return np.asarray(rows.T @ rows)

    return information
