"""Confidence intervals that hold where the problem bends: from the likelihood, not from a sigma."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from lasercal_gtsam.again import options_as_held, refuse_unfit
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError, SolveError
from lasercal_gtsam.graph import make_batch
from lasercal_gtsam.hand_noise.refine import refine_with_hand_noise
from lasercal_gtsam.profile import Likelihood, RowProfile
from lasercal_gtsam.solve import Solution
from lasercal_gtsam.start import Search, refine_given
from lasercal_gtsam.uncertainty import estimate_uncertainty

_WHO = "intervals"
_BY_LEAST_SQUARES = ("auto", "none", "gnc-tls")


def intervals(
    calibration: Calibration, names: Iterable[str] | None = None, *, level: float = 0.95
) -> dict[str, tuple[float, float]]:
    """Confidence intervals of rows of the table from the likelihood (`profile`).

    They need not lie evenly about the estimate, and are right to the third order where a sigma is
    to the first: with all distortion terms on few spots they cover what they say. They take some
    tenths of a second a row.

    Parameters
    ----------
    calibration : by least squares, with its spots
    names : of rows; None: all that are estimated
    level : probability with which an interval holds the true value

    Returns
    -------
    name -> (low, high)
        In the table's units (px, mm, deg); infinite where the data set no bound on that side.

    Raises
    ------
    DataError
        No such row, or one that is held; a calibration that is not to be trusted, states no sigmas,
        does not hold its spots, or was made with a loss; or the level is not between 0 and 1.
    SolveError
        The spots cannot be solved again, or the search for an end does not settle.
    """
    if not (isinstance(level, float | int) and 0.0 < level < 1.0):
        raise DataError(f"{_WHO}: level: expected a number between 0 and 1, got {level!r}")
    rows = {p.name: p for p in calibration.parameters}
    chosen = [n for n, p in rows.items() if p.sigma > 0] if names is None else list(names)
    for name in chosen:
        if name not in rows:
            raise DataError(f"{_WHO}: unknown row {name!r}; there are {', '.join(rows)}")
        if rows[name].sigma == 0.0:
            raise DataError(f"{_WHO}: {name} is held: it has no interval")
    likelihood = likelihood_of(calibration)
    limit = likelihood.limit(level)
    found = {}
    for name in chosen:
        profile = RowProfile.of(likelihood, name)
        found[name] = (profile.end(-1.0, limit), profile.end(1.0, limit))
    return found


def likelihood_of(calibration: Calibration) -> Likelihood:
    """The likelihood of a calibration, from its own spots.

    Raises
    ------
    DataError, SolveError
        As for `intervals`.
    """
    refuse_unfit(calibration, _WHO)
    options = calibration.inputs.options
    if options.robust not in _BY_LEAST_SQUARES:
        raise DataError(
            f"{_WHO}: made with the {options.robust} loss, which is no likelihood of the noise; "
            "calibrate with robust='auto', 'gnc-tls' or 'none'"
        )
    used = np.array([reason is None for reason in calibration.spots.rejected], dtype=np.bool_)
    seen = calibration.inputs.observations[used]
    cell = calibration.cell.restricted(seen)
    options, holds = options_as_held(calibration, cell, seen, _WHO)
    search = Search(seen, make_batch(seen, options.sigma_px), holds, options)
    solution = refine_given(search, cell)
    if options.noisy_hand:
        nobody = np.zeros(len(seen), dtype=np.bool_)
        solution = refine_with_hand_noise(search, solution, nobody).solution
    _refuse_elsewhere(solution)
    uncertainty = estimate_uncertainty(solution)
    if not math.isfinite(uncertainty.sigma0):
        raise DataError(f"{_WHO}: no degrees of freedom are left to estimate the noise from")
    return Likelihood.of(solution, seen, uncertainty.sigma0, uncertainty.dof)


def _refuse_elsewhere(solution: Solution) -> None:
    if not solution.plausible:
        raise SolveError(
            f"{_WHO}: the calibration's own spots cannot be solved again from its estimate: "
            + "; ".join(solution.troubles)
        )
