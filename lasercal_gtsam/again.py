"""A calibration taken up again: its own spots, and what it held, as it held it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import INTRINSIC_NAMES, Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.holds import Holds, resolve_holds
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.report_map import CAMERA_TANGENT, tangent_labels


def refuse_unfit(calibration: Calibration, who: str) -> None:
    """Refuse what cannot be solved again from its own spots, or has no sigmas.

    ``who`` asks, for the message.

    Raises
    ------
    DataError
        The calibration is not to be trusted, does not hold all its spots, or states no sigmas.
    """
    fit, inputs = calibration.fit, calibration.inputs
    if not fit.converged:
        raise DataError(
            f"{who}: the sigmas of an answer that is not to be trusted mean nothing: {fit.status}"
        )
    stored, counted = len(inputs.observations), fit.n_spots + fit.n_rejected
    if stored < counted:
        raise DataError(
            f"{who}: the calibration holds {stored} of its {counted} spots; the others live "
            "on as prior knowledge only, so that their geometry cannot be simulated. Check a "
            "calibration made from all spots ('lasercal calibrate')"
        )
    if not (np.isfinite(fit.sigma0) and np.isfinite(calibration.covariance).all()):
        raise DataError(
            f"{who}: the calibration states no sigmas (no degrees of freedom are left to "
            "estimate the noise from); add spots"
        )


def options_as_held(
    calibration: Calibration, cell: Cell, seen: Observations, who: str, started: bool = True
) -> tuple[CalibrationOptions, Holds]:
    """Options that hold what the calibration held, each at its value in ``cell``, and the holds.

    Parameters
    ----------
    calibration : the calibration
    cell : its estimate, with the parts that have spots in the observations' order
    seen : the spots that counted
    who : asks, for the message
    started : whether ``cell`` will be given as the start, so that what was fixed stays fixed there

    Raises
    ------
    DataError
        Its covariance is not that of the parts that have spots, or contradicts its options.
    """
    if tangent_labels(cell) != calibration.labels:
        alone = sorted(set(calibration.labels) - set(tangent_labels(cell)))
        raise DataError(
            f"{who}: the covariance is not that of the parts that have spots"
            + (f" ({alone[0]} has none)" if alone else "")
            + "; calibrate anew"
        )
    options = calibration.inputs.options
    if options.distortion == "auto":  # which terms were chosen is given, as the sigmas take it
        options = replace(options, distortion="all")
    if not started:
        options = replace(options, fixed=())
    stated = np.diag(calibration.covariance) == 0.0
    holds = resolve_holds(seen, options, cell)
    known, dropped = dict(options.known), set[str]()
    for c, (name, camera) in enumerate(cell.cameras.items()):
        for term in INTRINSIC_NAMES:
            at = c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index(term)
            if stated[at] and (not started or not holds.held[at]):
                known[f"{name}.{term}"] = getattr(camera.intrinsics, term)
                dropped |= {term, f"{name}.{term}"}
    # a fit may have ended with fewer terms than it was asked for; priors on these have no meaning
    priors = {k: v for k, v in options.priors.items() if k not in dropped}
    options = replace(options, known=known, priors=priors)
    holds = resolve_holds(seen, options, cell)
    wrong = np.flatnonzero(holds.held != stated)
    if len(wrong):
        label = calibration.labels[wrong[0]]
        says = "holds it" if holds.held[wrong[0]] else "does not"
        raise DataError(
            f"{who}: by its covariance the calibration "
            f"{'holds' if stated[wrong[0]] else 'estimates'} {label}, by its options it {says}; "
            "calibrate anew"
        )
    return options, holds
