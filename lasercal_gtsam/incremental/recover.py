"""A part set free and given back by its spots, everything else keeping what it knows."""

from __future__ import annotations

from dataclasses import replace

from lasercal_factors.batch import Loss

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.incremental.belief import Belief, Fused, Part, fuse
from lasercal_gtsam.incremental.relocate import camera_candidates, locate_laser, locate_plane
from lasercal_gtsam.observations import Observations


def recover(
    belief: Belief,
    kind: Part,
    name: str,
    observations: Observations,
    cov_uv: Array,
    *,
    start: Cell | None = None,
    loss: Loss | None = None,
) -> Fused:
    """The cell after one part has moved: the best of several starts.

    What was known of the part is forgotten; its old place, the closed form of `relocate` and
    ``start`` are starts for least squares. One alone may be a trap: a steep step would leave a spot
    without an image, and the optimiser stops.

    Parameters
    ----------
    belief : before the move
    kind, name : the part that is set free; of a camera its pose
    observations : m spots since the move, of any parts
    cov_uv : (m, 2, 2) covariances of their pixels, px^2
    start : one more start, such as `Diagnosis.cell`
    loss : robust loss on the whitened residual lengths

    Raises
    ------
    SolveError
        No start is possible.
    """
    free = belief.without(belief.columns(kind, name))
    mine = getattr(observations, kind) == name
    starts = [belief.cell] if start is None else [belief.cell, start]
    if mine.any():
        starts += relocated(belief.cell, observations[mine], cov_uv[mine], kind, name)
    found: list[Fused] = []
    for cell in starts:
        try:
            found.append(fuse(free, observations, cov_uv, cell, loss))
        except LasercalError as error:
            problem = error
    if not found:
        raise SolveError(f"{kind} {name!r} cannot be given back: {problem}")
    return min(found, key=lambda fused: fused.prior_cost + fused.spot_cost)


def relocated(
    cell: Cell, observations: Observations, cov_uv: Array, kind: Part, name: str
) -> list[Cell]:
    """The cell with the part located anew from its spots alone, the best first, if any."""
    seen = replace(observations, cov_uv=cov_uv)
    try:
        if kind == "camera":
            cameras = camera_candidates(cell, seen)
            return [replace(cell, cameras={**cell.cameras, name: c}) for c in cameras]
        if kind == "laser":
            return [replace(cell, lasers={**cell.lasers, name: locate_laser(cell, seen)})]
        return [cell.with_planes({**cell.planes, name: locate_plane(cell, seen)})]
    except LasercalError:
        return []
