"""The trials: new spots, a new solution of each, and how far it is from the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError, LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import beam_frames
from lasercal_gtsam.incremental.belief import coordinates
from lasercal_gtsam.report_map import BeamChart, row_jacobian, row_names, row_values
from lasercal_gtsam.sigma_check.judge import judged
from lasercal_gtsam.sigma_check.redraw import Mask, Redraw, redraw_of
from lasercal_gtsam.sigma_check.result import SigmaCheck
from lasercal_gtsam.sigma_check.statistics import Trials
from lasercal_gtsam.simulate.streams import NOISE, stream

Progress = Callable[[int, int], None]

FEWEST_TRIALS = 20
# eigenvalues of the correlation below this share of the largest are rounding
_ROUNDING = 1e-13


def check_sigma(
    calibration: Calibration,
    *,
    trials: int = 200,
    seed: int = 0,
    from_data: bool = False,
    progress: Progress | None = None,
) -> SigmaCheck:
    """Check the sigmas of a calibration on its own geometry by simulation.

    The estimate is the truth. Each trial draws new spots at the calibration's hand poses, with the
    noise that its sigmas stand for (`redraw`), and solves them with its options. Then the errors
    are compared with the sigmas, and the whole vector with the joint covariance.

    Parameters
    ----------
    calibration : one that holds its spots
    trials : number of them, 20 or more; a standard deviation is known to ``1 / sqrt(2 trials)``
    seed : integer >= 0. The same numbers come out for the same seed, and trial k is the same
        however many there are
    from_data : solve each trial without a start, as for a new cell, instead of from the estimate.
        Slower; shows also wrong optima
    progress : called with (done, total)

    Returns
    -------
    SigmaCheck

    Raises
    ------
    DataError
        The calibration is not to be trusted (an open alarm, not converged), holds no spots, or
        states no sigmas; or ``trials`` or ``seed`` are not what they may be.
    SolveError
        Not a single trial has a solution.

    Notes
    -----
    What is checked is how well a linear propagation of Gaussian noise describes this estimator on
    this geometry. Noise that is not what the calibration takes it for (a robot worse than declared,
    a wrong model) does not show here, but in the residuals.
    """
    if isinstance(trials, bool) or not isinstance(trials, int | np.integer):
        raise DataError(f"check-sigma: trials: expected an integer, got {trials!r}")
    if trials < FEWEST_TRIALS:
        raise DataError(
            f"check-sigma: trials: expected {FEWEST_TRIALS} or more, got {trials}; fewer say "
            "nothing about a sigma"
        )
    stream(seed, NOISE)  # refuse a bad seed before any work
    redraw = redraw_of(calibration, from_data)
    target = _Target.of(calibration, redraw)
    again = _solved_again(redraw)
    errors, own, whitened = [], [], []
    failures: dict[int, str] = {}
    rejected = redrawn = 0
    for k in range(int(trials)):
        drawn = redraw.draw(stream(seed, NOISE, k))
        redrawn += drawn.redrawn
        try:
            found = calibrate(
                drawn.observations,
                initial=None if from_data else redraw.truth,
                options=drawn.options,
            )
        except LasercalError as error:
            failures[k] = str(error)
        else:
            if found.fit.converged:
                rejected += found.fit.n_rejected
                errors.append(target.error(found))
                own.append(target.own_sigmas(found))
                whitened.append(target.whitened(found))
            else:
                failures[k] = found.fit.status
        if progress is not None:
            progress(k + 1, int(trials))
    run = Trials(
        names=target.names,
        units=target.units,
        sigma=target.sigma,
        expected_sigma=target.own_sigmas(again),
        errors=np.array(errors).reshape(len(errors), len(target.names)),
        own_sigma=np.array(own).reshape(len(own), len(target.names)),
        whitened=np.array(whitened).reshape(len(whitened), len(target.whitening)),
        combinations=target.whitening * np.sqrt(np.diag(calibration.covariance)),
        labels=calibration.labels,
        volume=target.volume(again),
        failures=failures,
        trials=int(trials),
        seed=int(seed),
        from_data=from_data,
        spots=len(redraw.observations),
        dof=calibration.fit.dof,
        left_out=redraw.left_out,
        rejected=rejected,
        redrawn=redrawn,
        noise_px=float(np.median(np.sqrt(np.trace(redraw.cov_uv, axis1=1, axis2=2) / 2))),
        priors=tuple(redraw.priors),
        outliers=int(redraw.outliers.sum()),
    )
    return judged(run)


@dataclass(frozen=True, eq=False)
class _Target:
    """What the trials are measured against.

    ``rows``: indices of the estimated rows of the table; ``charts``: the beam's parameterisation in
    the table, kept over the trials; ``whitening``: (d, n) with which a tangent error (n,) has unit
    covariance.
    """

    redraw: Redraw
    charts: dict[str, BeamChart]
    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: Any
    truth: Array
    sigma: Array
    whitening: Array

    @classmethod
    def of(cls, calibration: Calibration, redraw: Redraw) -> _Target:
        charts = {name: BeamChart.of(beam) for name, beam in redraw.truth.lasers.items()}
        names = row_names(redraw.truth, charts)
        stated = {p.name: p.sigma for p in calibration.parameters}
        missing = [name for name, _ in names if name not in stated]
        if missing:
            raise DataError(
                f"check-sigma: the calibration's table has no row {missing[0]!r}; calibrate anew"
            )
        sigma = np.array([stated[name] for name, _ in names])
        rows = np.flatnonzero((sigma > 0) & np.isfinite(sigma))
        if not len(rows):
            raise DataError("check-sigma: every row of the table is held: there is no sigma")
        return cls(
            redraw,
            charts,
            tuple(names[i][0] for i in rows),
            tuple(names[i][1] for i in rows),
            rows,
            row_values(redraw.truth, charts)[rows],
            sigma[rows],
            _whitening(calibration.covariance, redraw.free),
        )

    def error(self, found: Calibration) -> Array:
        """Estimate minus truth of every row, angles on the circle."""
        error = row_values(found.cell, self.charts)[self.rows] - self.truth
        angle = np.array(self.units) == "deg"
        error[angle] = (error[angle] + 180.0) % 360.0 - 180.0
        return np.asarray(error)

    def own_sigmas(self, found: Calibration) -> Array:
        """Sigmas that the trial states for the same rows."""
        F = row_jacobian(found.cell, self.charts, beam_frames(found.cell))[self.rows]
        variances = np.einsum("ij,jk,ik->i", F, found.covariance, F)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def whitened(self, found: Calibration) -> Array:
        """Error of all free coordinates together, with unit covariance if the stated one holds."""
        return np.asarray(self.whitening @ coordinates(self.redraw.truth, found.cell))

    def volume(self, found: Calibration) -> float:
        """Determinant of another covariance over the stated one, per coordinate."""
        own = self.whitening @ found.covariance @ self.whitening.T
        return float(np.exp(np.linalg.slogdet(own)[1] / len(own)))


def _solved_again(redraw: Redraw) -> Calibration:
    """The calibration's own spots, solved at once from its estimate."""
    try:
        again = calibrate(redraw.observations, initial=redraw.truth, options=redraw.options)
    except LasercalError as error:
        trouble = str(error)
    else:
        if again.fit.converged:
            return again
        trouble = again.fit.status
    raise DataError(
        "check-sigma: the calibration's own spots cannot be solved again from its estimate with "
        f"its options: {trouble}"
    )


def _whitening(covariance: Array, free: Mask) -> Array:
    at = np.flatnonzero(free)
    scale = np.sqrt(np.diag(covariance)[at])
    values, vectors = np.linalg.eigh(covariance[np.ix_(at, at)] / np.outer(scale, scale))
    if values[0] < -_ROUNDING * values[-1] * 1e3:
        raise DataError(
            "check-sigma: the joint covariance of the calibration is not positive definite; the "
            "file was changed, or calibrate anew"
        )
    good = values > _ROUNDING * values[-1]
    whitening = np.zeros((int(good.sum()), len(covariance)))
    whitening[:, at] = (vectors[:, good] / np.sqrt(values[good])).T / scale
    return np.asarray(whitening)
