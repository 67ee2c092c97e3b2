"""How long residuals are, how long they may be, and what is said of those that are longer."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.start import Search

Mask = npt.NDArray[np.bool_]

# probability that any spot of a clean capture is rejected
FALSE_ALARM = 1e-3
# relative standard error of the median of N Rayleigh lengths, times sqrt(N): 1 / (2 ln 2)
MEDIAN_ERROR = float(1.0 / (2.0 * np.log(2.0)))
_MEDIAN_RAYLEIGH = float(np.sqrt(2.0 * np.log(2.0)))
_MIN_SCALE = 1e-6
# spots that a part of the cell must keep, of those it had
_FEWEST_KEPT = 3


def rejection_length(count: int) -> float:
    """Length (in robust scales) that the longest of ``count`` good residuals hardly ever exceeds.

    The quantile of the Rayleigh distribution, ``sqrt(-2 ln p)``, exceeded once in a thousand
    captures, with a margin of two standard errors for the scale, a median.
    """
    count = max(count, 1)
    quantile = math.sqrt(-2.0 * math.log(FALSE_ALARM / count))
    return quantile * (1.0 + 2.0 * MEDIAN_ERROR / math.sqrt(count))


def robust_scale(lengths: Array, unknowns: int) -> float:
    """Scale of whitened residual lengths (N,) by their median, corrected for the unknowns."""
    rows = 2 * len(lengths)
    correction = float(np.sqrt(rows / max(rows - unknowns, 1)))
    return max(float(np.median(lengths)) / _MEDIAN_RAYLEIGH * correction, _MIN_SCALE)


def lengths_of(search: Search, cell: Cell) -> Array:
    """Whitened residual length (sigmas) of every spot, (N,); infinite where no spot can be."""
    return lengths_in(search.batch, cell)


def lengths_in(batch: SpotBatch, cell: Cell) -> Array:
    """The same for the spots of a batch."""
    lengths = batch.whitened_lengths(state_from_cell(cell))
    return np.where(np.isnan(lengths), np.inf, lengths)


def outliers(lengths: Array, unknowns: int, rejected: Mask) -> Mask:
    """Spots with residuals too long for the scale of the spots not rejected so far."""
    limit = rejection_length(len(lengths)) * robust_scale(lengths[~rejected], unknowns)
    return np.asarray(~(lengths <= limit))


def unknowns_of(search: Search) -> int:
    """How many coordinates are estimated."""
    return int((~search.holds.held).sum())


def outlier_reasons(search: Search, lengths: Array, rejected: Mask) -> tuple[str | None, ...]:
    """For each spot why it was rejected, None if it was not."""
    limit = rejection_length(len(lengths))
    scale = robust_scale(lengths[~rejected], unknowns_of(search))
    words = [
        f"residual {x / scale:.1f} sigma, limit {limit:.1f}"
        if np.isfinite(x)
        else "no spot can be there"
        for x in lengths
    ]
    return tuple(w if out else None for w, out in zip(words, rejected, strict=True))


def refuse_emptied(observations: Observations, rejected: Mask) -> None:
    """Refuse to leave a camera, laser or plane with hardly any spot.

    Raises
    ------
    DegenerateError
        Names it, and how many of its spots do not fit.
    """
    for kind in ("camera", "laser", "plane"):
        names = getattr(observations, kind)
        for name in getattr(observations, kind + "s"):
            mine = names == name
            left = int((mine & ~rejected).sum())
            if left < min(_FEWEST_KEPT, int(mine.sum())):
                raise DegenerateError(
                    f"{kind} {name!r}: {int(mine.sum()) - left} of its {int(mine.sum())} spots do "
                    f"not fit the rest. Is every spot on the {kind} that it is said to be, and "
                    "did nothing move?"
                )
