"""`calibrate`: observations in, calibration with sigmas out. No files, no printing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lasercal_gtsam.calibration import (
    Calibration,
    Fit,
    Inputs,
    Observability,
    SpotResults,
    rms_px,
)
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError, DegenerateError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_batch, state_from_cell
from lasercal_gtsam.hand_noise.refine import refine_with_hand_noise
from lasercal_gtsam.holds import Holds, resolve_holds
from lasercal_gtsam.lens_choice import choose_lens
from lasercal_gtsam.losses import THRESHOLDS
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.profile import Likelihood, bent_rows
from lasercal_gtsam.random_parts import parts_of
from lasercal_gtsam.reweight import refine_truncated, refine_with_loss
from lasercal_gtsam.robust import (
    Accepted,
    Finished,
    Mask,
    Ways,
    lengths_of,
    refine_without_outliers,
)
from lasercal_gtsam.solve import Solution, fold_warnings
from lasercal_gtsam.start import Search, refine_candidates, refine_given
from lasercal_gtsam.uncertainty import (
    Uncertainty,
    estimate_uncertainty,
    report_notes,
    table_parameters,
)

if TYPE_CHECKING:
    from lasercal_gtsam.closed_form import Candidate

# weight of a spot that hardly counts, worth a word in the status
_FAINT = 0.1


def calibrate(
    observations: Observations,
    *,
    initial: Cell | None = None,
    options: CalibrationOptions | None = None,
) -> Calibration:
    """Estimate cameras, beams and planes of a cell, with their joint covariance.

    Parameters
    ----------
    observations : Observations
        Spots with their hand poses.
    initial : Cell, optional
        A start, for instance from drawings. Left out, the start comes from the data alone by the
        paper's closed form (sections 3.2, 3.3).
    options : CalibrationOptions, optional

    Returns
    -------
    Calibration
        ``fit.converged`` is False, and ``fit.status`` says why, where a check was not passed.

    Raises
    ------
    DataError
        The input is inconsistent (names, options).
    DegenerateError
        The data cannot determine what was asked; names what is missing.
    SolveError
        No start could be refined.
    """
    options = options or CalibrationOptions()
    _check_request(observations, initial, options)
    holds = resolve_holds(observations, options, initial)
    batch = make_batch(observations, options.sigma_px)
    search = Search(observations, batch, holds, options)
    ways = _given_start(initial) if initial is not None else _closed_form_starts(search)
    notes: tuple[str, ...] = ()
    if options.distortion == "auto":
        begun = _with_most_terms(search, ways)
        start = initial or begun.start
        lens = choose_lens(search, begun.finished.solution, start)
        search = replace(search, holds=lens.holds)
        ways, notes = _given_start(lens.cell), lens.notes
        accepted = _begun_by(begun, _without_outliers(search, ways))._replace(start=start)
    else:
        accepted = _without_outliers(search, ways)
    if options.robust == "gnc-tls":
        finish = partial(_finish, search)
        accepted = refine_truncated(search, accepted, ways.refine, finish)
    elif options.robust not in ("auto", "none"):
        accepted = refine_with_loss(search, accepted, options.robust)
    if initial is not None:
        accepted = accepted._replace(start=initial)
    return assemble(search, accepted, notes)


def _without_outliers(search: Search, ways: Ways) -> Accepted:
    """Least squares on the spots that fit; on all of them with ``robust="none"``."""
    finish = partial(_finish, search)
    if search.options.robust != "none":
        return refine_without_outliers(search, ways, finish)
    nobody = np.zeros(len(search.batch), np.bool_)
    finished = finish(ways.refine(search, ways.starts), nobody)
    return Accepted(finished, (None,) * len(nobody), ways.starts[0])


def _finish(search: Search, solution: Solution, rejected: Mask) -> Finished:
    if search.options.noisy_hand:
        found = refine_with_hand_noise(search, solution, rejected)
        levels = found.levels
        return Finished(*found[:3], levels.found, levels.words)
    return Finished(solution, lengths_of(search, solution.cell))


def _begun_by(first: Accepted, then: Accepted) -> Accepted:
    """The second answer, with the iterations of the first that led to it."""
    solution = then.finished.solution
    iterations = first.finished.solution.iterations + solution.iterations
    solution = replace(solution, iterations=iterations)
    return then._replace(finished=then.finished._replace(solution=solution))


def _with_most_terms(search: Search, ways: Ways) -> Accepted:
    """With all distortion terms or, where that has no good answer, with none."""
    try:
        accepted = _without_outliers(search, ways)
        if accepted.finished.solution.plausible:
            return accepted
    except (DegenerateError, SolveError):
        pass
    return _without_outliers(replace(search, holds=search.holds.without_distortion()), ways)


def stop_notes(observations: Observations, options: CalibrationOptions) -> list[str]:
    """A word where hand poses repeat to the last digit, and it was not said what that means."""
    if observations.stop is not None or not options.noisy_hand:
        return []
    poses = observations.T_base_hand.reshape(len(observations), -1)
    repeated = len(poses) - len(np.unique(poses, axis=0))
    if not repeated:
        return []
    return [
        f"{repeated} hand poses are those of other spots to the last digit; each counts as another "
        "visit with an error of its own. Where the hand stood still between them, give these spots "
        "the same stop"
    ]


def _given_start(initial: Cell) -> Ways:
    return Ways([initial], lambda search, cells: refine_given(search, cells[0]))


def closed_form_hints(holds: Holds, options: CalibrationOptions) -> dict[str, Any]:
    """What is known of the cameras and of the robot, as arguments of `closed_form_candidates`."""
    from lasercal_gtsam.closed_form.groups import GROUP_TOLERANCE_RAD

    known = holds.known.items()
    return {
        "principal_point": {c: (k["u0"], k["v0"]) for c, k in known if {"u0", "v0"} <= set(k)},
        "skew": {c: k["skew"] for c, k in known if "skew" in k},
        "aspect": holds.aspect,
        "focal_lengths": {c: (k["fu"], k["fv"]) for c, k in known if {"fu", "fv"} <= set(k)},
        # hand poses that are read back differ by the robot's noise (method 3.1)
        "group_tolerance_rad": max(GROUP_TOLERANCE_RAD, 4 * options.hand_sigma_rad),
    }


def _closed_form_starts(search: Search) -> Ways:
    """Starts from the data alone, told what is known of the cameras and of the robot."""
    from lasercal_gtsam.closed_form import closed_form_candidates

    holds, options = search.holds, search.options
    hints = closed_form_hints(holds, options)
    failure: DegenerateError | None = None
    found: Sequence[Candidate] = ()
    try:
        found = closed_form_candidates(search.observations, **hints)
    except DegenerateError as error:
        failure = error

    aside = found[0].set_aside if found else ()

    def refine(search: Search, cells: Sequence[Cell]) -> Solution:
        if failure is not None and not cells:
            raise failure
        return refine_candidates(search, cells)

    def closed_form(part: Observations) -> Cell:
        return closed_form_candidates(part, **hints)[0].cell

    return Ways(
        [holds.apply(candidate.cell) for candidate in found],
        refine,
        parts_of(search.observations, closed_form, options.seed),
        agreed=~np.isin(search.observations.id, aside) if aside else None,
    )


def assemble(search: Search, accepted: Accepted, remarks: Sequence[str] = ()) -> Calibration:
    """Sigmas, table, spots and the status sentence of a solution.

    The residuals refer to the spots as observed, with the commanded hand poses.
    """
    observations, options, batch = search.observations, search.options, search.batch
    finished, reasons, start, weights = accepted
    solution, sigma_px = finished.solution, finished.sigma_px
    uncertainty = estimate_uncertainty(solution)
    bent = _bent_notes(solution, uncertainty, observations)
    if sigma_px is not None:  # found on the way; what is left of the scale is about 1
        uncertainty = replace(uncertainty, sigma0=sigma_px * uncertainty.sigma0)
    problem = solution.problem
    cell = _with_unobserved(solution.cell, start)
    residuals = batch.residuals(state_from_cell(solution.cell))
    used = np.array([reason is None for reason in reasons])
    weights = used.astype(np.float64) if weights is None else weights
    warnings = fold_warnings(solution.cell)
    fit = _fit(solution, uncertainty, residuals[used], weights[used], int((~used).sum()), warnings)
    fit = replace(fit, noise=finished.noise)
    notes = (
        *warnings,
        *report_notes(solution.cell, uncertainty),
        *bent,
        *finished.words,
        *stop_notes(observations, options),
        *remarks,
    )
    return Calibration(
        cell=cell,
        initial=start,
        parameters=table_parameters(solution.cell, start.restricted(solution.cell), uncertainty),
        covariance=uncertainty.covariance,
        labels=uncertainty.labels,
        fit=fit,
        spots=SpotResults(
            observations.id,
            observations.plane,
            observations.camera,
            observations.laser,
            residuals,
            weights,
            reasons,
            uncertainty.leverage,
        ),
        observability=Observability(uncertainty.weak, problem.holds.words, notes),
        inputs=Inputs(observations, options),
    )


def _bent_notes(
    solution: Solution, uncertainty: Uncertainty, observations: Observations
) -> list[str]:
    """A word where sigmas, being linear, promise too much."""
    if solution.troubles or solution.problem.loss.name != "none" or not uncertainty.dof >= 1:
        return []
    likelihood = Likelihood.of(solution, observations, uncertainty.sigma0, uncertainty.dof)
    names = bent_rows(likelihood)
    if not names:
        return []
    return [
        f"{', '.join(names)}: the sigma itself changes by 15 % or more within one sigma, so that "
        "twice the sigma need not hold 95 %; ask for the interval (calibration.interval, or "
        "lasercal report), take more spots, or estimate fewer distortion terms"
    ]


def _fit(
    solution: Solution,
    uncertainty: Uncertainty,
    residuals: Array,
    weights: Array,
    n_rejected: int,
    warnings: list[str],
) -> Fit:
    # an answer that is not to be trusted may leave spots where none can be seen
    seen = np.isfinite(residuals).all(axis=1)
    counted = weights[seen]
    share = counted / counted.mean() if counted.any() else counted
    rms = rms_px(residuals[seen] * np.sqrt(share)[:, None])
    if solution.troubles:
        status = "not to be trusted: " + "; ".join(solution.troubles)
    else:
        status = (
            f"converged ({solution.iterations} iterations): {len(residuals)} spots, "
            f"RMS {rms:.3g} px"
        )
        if n_rejected:
            status += f", {n_rejected} rejected as outliers"
        if faint := int((weights < _FAINT).sum()):
            status += f", {faint} with a weight below {_FAINT:g}"
        if uncertainty.dof < 1:
            status += "; no degrees of freedom left, so no sigmas: add spots"
        if warnings:
            status += "; but " + "; ".join(warnings)
    return Fit(
        rms_px=rms,
        sigma0=uncertainty.sigma0,
        dof=uncertainty.dof,
        iterations=solution.iterations,
        converged=not solution.troubles,
        status=status,
        n_spots=len(residuals),
        n_rejected=n_rejected,
    )


def _with_unobserved(estimate: Cell, start: Cell) -> Cell:
    """The estimate, and the start's parts that nothing was observed of, unchanged."""
    return Cell(
        {**start.cameras, **estimate.cameras},
        {**start.lasers, **estimate.lasers},
        {**start.planes, **estimate.planes},
    )


def _check_request(
    observations: Observations, initial: Cell | None, options: CalibrationOptions
) -> None:
    if not len(observations):
        raise DataError("calibrate: there are no spots")
    if initial is not None and not isinstance(initial, Cell):
        raise DataError(f"initial: expected a Cell, got {type(initial).__name__}")
    if options.noisy_hand and observations.shared_stops and options.robust in THRESHOLDS:
        raise DataError(
            f"options.robust: {options.robust!r} weighs spots one by one, which those of one stop "
            "with a common error of the hand cannot be; use 'auto', 'gnc-tls' or 'none', or leave "
            "Observations.stop out"
        )
