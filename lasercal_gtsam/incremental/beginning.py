"""How a running calibration begins: from its first spots, or from a calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.closed_form.requirements import spots_needed
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.holds import Holds, resolve_holds
from lasercal_gtsam.incremental.belief import (
    Belief,
    Mask,
    Named,
    calibrated_parts,
    tied_aspects,
)
from lasercal_gtsam.incremental.filter import Filter
from lasercal_gtsam.incremental.settings import Settings
from lasercal_gtsam.incremental.store import LEFT_OUT, USED, SpotStore
from lasercal_gtsam.incremental.update import Missing
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.report_map import tangent_labels

# degrees of freedom (the second where spots were rejected) and spots before a first solution counts
_FIRST_DOF, _FIRST_DOF_WITH_OUTLIERS, _FIRST_SPOTS = 20, 40, 15
# residual RMS, as a share of the image diagonal, above which it does not
_CREDIBLE = 0.005
# squared sigmas by which another solution must be better to take over
_TOLD_APART = 9.0


def too_few(store: SpotStore) -> Missing | None:
    """What is missing by number alone."""
    planes = {path[2] for path in store.paths}
    seen, need = len(store), max(spots_needed(len(planes)), _FIRST_SPOTS)
    if seen >= need:
        return None
    words = f"at least {need} spots are needed, 30 or more are advisable: {seen} so far"
    return Missing("cell", "", seen, need, words)


def first_solution(
    observations: Observations, options: CalibrationOptions
) -> Calibration | Missing:
    """The batch solution of the first spots, or what is missing."""
    seen = len(observations)
    try:
        found = calibrate(observations, options=options)
    except LasercalError as error:
        return Missing("cell", "", seen, seen + 1, str(error))
    fit = found.fit
    if not fit.converged:
        return Missing("cell", "", seen, seen + 1, fit.status)
    diagonal = max(float(np.hypot(*size)) for size in observations.image_size.values())
    if fit.rms_px > _CREDIBLE * diagonal:
        words = (
            f"the {seen} spots do not fit each other: the best solution leaves {fit.rms_px:.2g} px "
            "RMS. More spots may tell the bad ones apart; check pose convention and plane names"
        )
        return Missing("cell", "", seen, seen + 1, words)
    # some good fits of few spots come from calling the others outliers
    wanted = _FIRST_DOF_WITH_OUTLIERS if fit.n_rejected else _FIRST_DOF
    lacking = int(np.ceil((wanted - fit.dof) / 2))
    if lacking > 0:
        words = f"the {seen} spots fit, but {lacking} more are needed to judge how well"
        return Missing("cell", "", seen, seen + lacking, words)
    return found


def better_solution(
    store: SpotStore, filter: Filter, settings: Settings
) -> tuple[Calibration, str] | None:
    """A fresh start from all used spots, if it ends better than the running estimate.

    With few spots the first solution may be another minimum, or its pixel sigma may be poorly told
    apart from the robot's noise. Outliers stay out: looking for them anew would take seconds.
    """
    spots = store.observations()[np.flatnonzero(store.marks() == USED)]
    try:
        found = calibrate(spots, options=replace(settings.options, robust="none"))
    except LasercalError:
        return None
    fit, now = found.fit, filter.estimate
    if not fit.converged:
        return None
    if settings.finds_sigma:
        return found, f"anew with {fit.n_spots} spots: their noise is {fit.sigma0:.3g} px"
    if now.cost - fit.dof * fit.sigma0**2 > _TOLD_APART * now.sigma0**2:
        return found, f"anew with {fit.n_spots} spots: a better solution was found"
    return None


def holds_its_spots(calibration: Calibration) -> bool:
    """Whether a calibration can be continued from its spots, not by its covariance alone."""
    fit, observations = calibration.fit, calibration.inputs.observations
    waiting = any((r or "").startswith("held back") for r in calibration.spots.rejected)
    complete = len(observations) == fit.n_spots + fit.n_rejected
    return complete and not waiting and bool(np.isfinite(fit.sigma0))


def begun(store: SpotStore, found: Calibration, settings: Settings) -> Filter:
    """From a batch solution of all stored spots, or of those that are used so far."""
    fit = found.fit
    if fit.n_spots + fit.n_rejected == len(store):
        rejected = [reason is not None for reason in found.spots.rejected]
        store.mark_each(store.first, np.where(rejected, LEFT_OUT, USED).astype(np.uint8))
    cell, aspects = calibrated_parts(found), tied_aspects(found)
    filter = Filter(
        store,
        cell,
        np.diag(found.covariance) == 0.0,
        tuple(aspects.get(name) for name in cell.cameras),
        priors=holds_of(store, settings.options, cell).priors,
        weighing=settings.weighing,
        scale=fit.sigma0 / settings.unit,
        robust=settings.robust,
    )
    filter.use(store.first, store.end)
    filter.relinearise()
    return filter


def continued(store: SpotStore, calibration: Calibration, settings: Settings) -> Filter:
    """With the calibration's covariance as the prior.

    Raises
    ------
    DataError
        The calibration has no sigmas.
    """
    belief, fit = Belief.of(calibration), calibration.fit
    n, scale = len(belief.information), fit.sigma0 / settings.unit
    prior = np.zeros((n + 1, n + 1))
    prior[:n, :n] = scale**2 * belief.information
    prior[n, n] = scale**2 * fit.dof
    filter = Filter(
        store,
        belief.cell,
        np.diag(calibration.covariance) == 0.0,
        tuple(belief.aspect.get(name) for name in belief.cell.cameras),
        prior=prior,
        prior_rows=fit.dof + float(n - belief.held.sum()),
        weighing=settings.weighing,
        scale=scale,
        robust=settings.robust,
    )
    filter.folded = fit.n_spots * np.array([1.0, fit.rms_px**2])
    return filter


def holds_of(store: SpotStore, options: CalibrationOptions, cell: Cell) -> Holds:
    """What the options hold of the parts that stored spots show, as ``cell`` orders them."""
    labels = tangent_labels(cell)
    seen = store.observations()
    seen = seen[determined(seen, cell)]
    if not len(seen):
        return Holds(np.zeros(len(labels), np.bool_), {}, {}, frozenset(), {}, ())
    holds = resolve_holds(seen, options, cell)
    ordered = cell.restricted(seen)
    where = dict(zip(tangent_labels(ordered), holds.held.tolist(), strict=True))
    held = [where.get(label, False) for label in labels]
    return replace(holds, held=np.array(held, dtype=np.bool_))


def determined(observations: Observations, cell: Cell, unknown: Iterable[Named] = ()) -> Mask:
    """(N,) spots all of whose parts are in the cell and not unknown."""
    good = np.isin(observations.camera, list(cell.cameras))
    good &= np.isin(observations.laser, list(cell.lasers))
    good &= np.isin(observations.plane, list(cell.planes))
    for kind, name in unknown:
        good &= getattr(observations, kind) != name
    return np.asarray(good)
