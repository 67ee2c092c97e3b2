"""Two halves of the spots, calibrated on their own: whether they agree within their sigmas."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DegenerateError, LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import beam_frames
from lasercal_gtsam.opinions.bench import orientation_groups
from lasercal_gtsam.opinions.chances import f_above
from lasercal_gtsam.report_map import BeamChart, row_jacobian, row_names, row_values

_TURN_DEG = 360.0
# singular values of the standardised covariance of the difference that count as zero
_RANK = 1e-9


@dataclass(frozen=True)
class RowDifference:
    """A row of the table: first half minus second, its sigma, and their ratio."""

    name: str
    unit: str
    difference: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """The difference in sigmas."""
        return self.difference / self.sigma


@dataclass(frozen=True)
class Split:
    """The halves against each other.

    Attributes
    ----------
    rows : of everything that was estimated
    chi2, dof : squared difference of all unknowns together, in sigmas, and their number: right to
        first order only, and too large where half the spots leave a direction so weak that the
        cameras of the halves are far apart
    chance : probability in a good calibration of sums of squares that fall so much when each half
        has its own cell (Chow's test). It compares what the cells predict, not their parameters,
        and so stands up where the sigmas of the halves do not
    failure : why a half could not be calibrated; the rest is then empty
    """

    rows: tuple[RowDifference, ...]
    chi2: float
    dof: int
    chance: float
    failure: str | None = None


def halves(calibration: Calibration) -> npt.NDArray[np.bool_]:
    """(N,) booleans: spots of the first half, every second one of each camera, plane and group.

    Where groups have an odd number of spots, they take turns in which half has one more. Spots that
    were left out are in neither half (the second array of `split` leaves them out too).
    """
    seen = calibration.inputs.observations
    group = orientation_groups(seen, calibration.inputs.options)
    used = calibration.spots.weight > 0
    order = np.lexsort((np.arange(len(seen)), group, seen.plane_index, seen.camera_index))
    order = order[used[order]]
    out = np.zeros(len(seen), dtype=np.bool_)
    out[order[::2]] = True
    return out


def fit_halves(calibration: Calibration) -> tuple[Calibration, Calibration]:
    """Calibrate each half alone, from the whole's estimate and with the whole's outliers left out.

    Raises
    ------
    SolveError
        A half cannot be calibrated; the message says which, and why.
    """
    seen, options = calibration.inputs.observations, calibration.options_used
    if not (calibration.spots.weight > 0).any():
        raise SolveError("the calibration does not hold its spots, so there are no halves of them")
    # outliers were told apart by all the spots; half of them might disagree about that
    if options.robust in ("auto", "gnc-tls"):
        options = replace(options, robust="none")
    first = halves(calibration)
    second = (calibration.spots.weight > 0) & ~first
    found: list[Calibration] = []
    for which, mask in (("first", first), ("second", second)):
        try:
            part = calibrate(seen[mask], initial=calibration.cell, options=options)
        except DegenerateError:
            raise SolveError(
                f"the {which} half alone does not determine the cell: take twice as many spots for "
                "this opinion"
            ) from None
        except LasercalError as error:
            raise SolveError(f"the {which} half alone cannot be calibrated: {error}") from error
        if not part.fit.converged or not np.isfinite(part.fit.sigma0):
            raise SolveError(f"the {which} half alone: {part.fit.status}")
        found.append(part)
    if any(part.labels != calibration.labels for part in found):
        raise SolveError("a half has no spots of some camera, laser or plane")
    return found[0], found[1]


def split(calibration: Calibration, parts: tuple[Calibration, Calibration] | None = None) -> Split:
    """Compare the two halves, which `fit_halves` gives unless they are at hand.

    The halves share no spot, so that the covariance of the difference is the sum of theirs, both
    with the noise of the whole. With priors they share those, and differ less than that.
    """
    try:
        first, second = parts or fit_halves(calibration)
    except SolveError as error:
        return Split((), float("nan"), 0, float("nan"), str(error))
    return _compare(calibration, first, second)


def _compare(whole: Calibration, a: Calibration, b: Calibration) -> Split:
    charts = {name: BeamChart.of(beam) for name, beam in whole.cell.lasers.items()}
    names = row_names(whole.cell, charts)
    difference = row_values(a.cell, charts) - row_values(b.cell, charts)
    for i, (_, unit) in enumerate(names):
        if unit == "deg":
            difference[i] = (difference[i] + _TURN_DEG / 2) % _TURN_DEG - _TURN_DEG / 2
    total = np.zeros((len(names), len(names)))
    for part in (a, b):
        F = row_jacobian(part.cell, charts, beam_frames(part.cell))
        noise = whole.fit.sigma0 / part.fit.sigma0
        total += noise**2 * F @ part.covariance @ F.T
    sigma = np.sqrt(np.diag(total))
    free = np.flatnonzero(sigma > 0)
    rows = tuple(RowDifference(*names[i], float(difference[i]), float(sigma[i])) for i in free)
    chi2, rank = _chi2(difference[free] / sigma[free], total[np.ix_(free, free)], sigma[free])
    return Split(rows, chi2, rank, _chow(whole, a, b))


def _chow(whole: Calibration, a: Calibration, b: Calibration) -> float:
    """F test of one cell for all spots against one for each half."""
    sums = [part.fit.dof * part.fit.sigma0**2 for part in (whole, a, b)]
    rest = a.fit.dof + b.fit.dof
    unknowns = whole.fit.dof - rest
    fall = max(sums[0] - sums[1] - sums[2], 0.0)
    return f_above((fall / unknowns) / ((sums[1] + sums[2]) / rest), unknowns, rest)


def _chi2(z: Array, covariance: Array, sigma: Array) -> tuple[float, int]:
    """Squared length of ``z`` under its correlation, and the correlation's rank."""
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    keep = values > _RANK * values[-1]
    parts = vectors[:, keep].T @ z
    return float(np.sum(parts**2 / values[keep])), int(keep.sum())
