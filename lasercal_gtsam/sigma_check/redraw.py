"""New spots for a calibration's own hand poses: its estimate is the truth, its noise the noise.

What is simulated is what the stated covariance assumes. Pixel noise and declared robot noise both
count times ``sigma0``, as they do in the covariance; where the pixel sigma was found beside a
declared robot noise, ``sigma0`` is that pixel sigma and the robot's noise is as declared.

Priors: the covariance then is that of the posterior, which does not promise to cover one fixed
truth (an estimate drawn to the prior's mean scatters less, and is biased), but the truth on the
average over the prior. Drawing the truth from priors as wide as the one-plane ones would make
lenses that show none of the user's spots; so the truth stays and what the prior says is drawn about
it, like one more measurement. For a linear problem the error has the same distribution either way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import LossName

from lasercal_gtsam.again import options_as_held, refuse_unfit
from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import pixel_covariances
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.losses import efficient_loss, loss_weights
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import project
from lasercal_gtsam.report_map import (
    CAMERA_TANGENT,
    BeamChart,
    row_names,
    row_values,
)
from lasercal_gtsam.robust import rejection_length
from lasercal_gtsam.simulate import Noise

Mask = npt.NDArray[np.bool_]

_MAX_REDRAWS = 100
# pixel noise below which nothing but rounding would be simulated
_ROUNDING_PX = 1e-6
# pose and parts, which only a start can hold
_NEEDS_START = ("T_base_camera", "camera:", "laser:", "plane:")


@dataclass(frozen=True)
class Drawn:
    """Spots of one trial, what to solve them with, and how many had to be drawn again."""

    observations: Observations
    options: CalibrationOptions
    redrawn: int


@dataclass(frozen=True, eq=False)
class Redraw:
    """Everything that a trial is made of.

    Attributes
    ----------
    truth : the estimate, with the parts that have spots
    observations : the spots that counted, as they were seen
    cov_uv : (N, 2, 2) px^2, of the noise to be drawn
    hand : noise of the hand poses to be drawn
    options : to solve with; held intrinsics are held at the truth's values
    priors : row of the table -> (true value, prior's sigma)
    outliers : (N,) spots that an M-estimate kept though they are none of the noise; they stay as
        far off as they were, in a direction drawn anew
    distance_px : (N,) how far off each spot was
    free : (n,) tangent coordinates that are estimated
    left_out : number of spots that were rejected
    """

    truth: Cell
    observations: Observations
    cov_uv: Array
    hand: Noise
    options: CalibrationOptions
    priors: Mapping[str, tuple[float, float]]
    outliers: Mask
    distance_px: Array
    free: Mask
    left_out: int

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Spots of one trial.

        Raises
        ------
        DataError
            The noise of the hand makes some spot impossible again and again.
        """
        seen = self.observations
        axes = np.linalg.cholesky(self.cov_uv)
        uv = np.empty((len(seen), 2))
        rows, redrawn = np.arange(len(seen)), 0
        for _ in range(_MAX_REDRAWS):
            part = seen[rows]
            hands = self.hand.moved_hands(part.T_base_hand, rng)
            for members in part.shared_stops:  # one standing of the hand, one error
                hands[members] = hands[members[:, :1]]
            exact = _seen_at(self.truth, part, hands)
            z = rng.standard_normal((len(rows), 2))
            noise = np.einsum("nij,nj->ni", axes[rows], z)
            direction = z / np.linalg.norm(z, axis=1, keepdims=True)
            far = self.outliers[rows]
            noise[far] = (self.distance_px[rows, None] * direction)[far]
            uv[rows] = exact + noise
            lost = np.isnan(exact[:, 0])
            for members in part.shared_stops:
                lost[members] = lost[members].any(axis=1, keepdims=True)
            rows = rows[lost]
            if not len(rows):
                break
            redrawn += len(rows)
        else:
            raise DataError(
                f"check-sigma: with the declared robot noise {some(seen.id[rows].tolist())} "
                f"cannot be seen in {_MAX_REDRAWS} draws; are hand_sigma_m and hand_sigma_rad "
                "right?"
            )
        return Drawn(replace(seen, uv=uv), self._told(rng), redrawn)

    def _told(self, rng: np.random.Generator) -> CalibrationOptions:
        """The options with what the priors say drawn about the truth."""
        if not self.priors:
            return self.options
        priors = {}
        for name, (value, sigma) in self.priors.items():
            z = rng.standard_normal()
            if name.rpartition(".")[2] == "aspect":  # a ratio, compared by its logarithm
                priors[name] = (value * np.exp(sigma / value * z), sigma)
            else:
                priors[name] = (value + sigma * z, sigma)
        return replace(self.options, priors=priors)


def redraw_of(calibration: Calibration, from_data: bool) -> Redraw:
    """What the trials of a calibration are made of.

    Raises
    ------
    DataError
        The calibration is not to be trusted (an open alarm, not converged), states no sigmas, does
        not hold all its spots, or contradicts itself.
    """
    refuse_unfit(calibration, "check-sigma")
    inputs, spots = calibration.inputs, calibration.spots
    used = np.array([reason is None for reason in spots.rejected], dtype=np.bool_)
    seen = inputs.observations[used]
    cell = calibration.cell
    truth = Cell(
        {name: cell.cameras[name] for name in seen.cameras},
        {name: cell.lasers[name] for name in seen.lasers},
        {name: cell.planes[name] for name in seen.planes},
    )
    options, holds = _options_of(calibration, truth, seen, from_data)
    cov_uv, hand = _noise_of(calibration, seen)
    lost = np.isnan(_seen_at(truth, seen, seen.T_base_hand)[:, 0])
    if lost.any():
        raise DataError(
            f"check-sigma: by the calibration itself {some(seen.id[lost].tolist())} cannot be seen "
            "(beam away from its plane, behind the camera, or in the fold of the distortion); "
            "calibrate anew"
        )
    return Redraw(
        truth,
        seen,
        cov_uv,
        hand,
        options,
        _true_priors(truth, holds),
        _outliers(options, spots.weight[used]),
        np.linalg.norm(spots.residual_px[used], axis=1),
        _free(calibration, truth, holds),
        int((~used).sum()),
    )


def _noise_of(calibration: Calibration, seen: Observations) -> tuple[Array, Noise]:
    options, sigma0 = calibration.options_used, calibration.fit.sigma0
    missing = np.isnan(seen.cov_uv[:, 0, 0])
    hand = options.hand_sigma_m, options.hand_sigma_rad
    found = max(hand) > 0 and options.sigma_px is None and bool(missing.any())
    cov = pixel_covariances(seen, options.sigma_px)
    scale = np.where(missing | (not found), sigma0**2, 1.0)
    cov = scale[:, None, None] * cov
    typical = float(np.sqrt(np.median(np.trace(cov, axis1=1, axis2=2)) / 2))
    if not typical > _ROUNDING_PX:
        raise DataError(
            f"check-sigma: the residuals are zero to rounding (noise of {typical:.1g} px), so that "
            "there is no noise to simulate and no sigma to check"
        )
    factor = 1.0 if found else sigma0
    return cov, Noise(0.0, factor * hand[0], factor * hand[1])


def _outliers(options: CalibrationOptions, weights: Array) -> Mask:
    """Spots that an M-estimate kept with a weight that noise alone does not give."""
    if options.robust in ("auto", "none", "gnc-tls"):
        return np.zeros(len(weights), dtype=np.bool_)
    loss = efficient_loss(cast(LossName, options.robust))
    least = loss_weights(loss, np.array([rejection_length(len(weights)) ** 2]))[0]
    return np.asarray(weights < least)


def _options_of(
    calibration: Calibration, truth: Cell, seen: Observations, from_data: bool
) -> tuple[CalibrationOptions, Holds]:
    """Options that hold what the calibration held, each at its value there."""
    if from_data:
        fixed = calibration.inputs.options.fixed
        kept = tuple(f for f in fixed if any(part in f for part in _NEEDS_START))
        if kept:
            raise DataError(
                f"check-sigma: {', '.join(kept)} was held at the value of a given start; without a "
                "start (--from-data) it cannot be"
            )
    options, holds = options_as_held(calibration, truth, seen, "check-sigma", not from_data)
    return replace(options, priors=dict(holds.priors)), holds


def _true_priors(truth: Cell, holds: Holds) -> dict[str, tuple[float, float]]:
    charts = {name: BeamChart.of(beam) for name, beam in truth.lasers.items()}
    names = [name for name, _ in row_names(truth, charts)]
    values = dict(zip(names, row_values(truth, charts).tolist(), strict=True))
    prefix = "{}." if len(truth.cameras) > 1 else ""
    for name, camera in truth.cameras.items():
        ratio = camera.intrinsics.fu / camera.intrinsics.fv
        values[prefix.format(name) + "aspect"] = ratio
    return {name: (values[name], sigma) for name, (_, sigma) in holds.priors.items()}


def _free(calibration: Calibration, truth: Cell, holds: Holds) -> Mask:
    """Coordinates with a variance of their own; a tied ``fu`` has that of ``fv``."""
    free = np.diag(calibration.covariance) > 0.0
    for c, name in enumerate(truth.cameras):
        if name in holds.aspect:
            free[c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("fu")] = False
    return free


def _seen_at(truth: Cell, spots: Observations, T_base_hand: Array) -> Array:
    names = {kind: getattr(spots, kind).tolist() for kind in ("plane", "camera", "laser")}
    return project(truth, T_base_hand, **names)
