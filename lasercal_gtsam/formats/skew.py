"""A skew where the target has no place for one: refused, left out within its sigma, or refitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Camera
from lasercal_gtsam.errors import DataError

# sigmas from 0 at which a skew is rather there than not
_CLEARLY = 3.0


def skew_cost_px(camera: Camera) -> float:
    """Largest change of a pixel of the image when the skew is dropped and nothing else moves (px).

    That is ``skew * yd`` (2), and ``yd = (v - v0) / fv`` is largest at the upper or lower border.
    """
    lens, height = camera.intrinsics, camera.image_size[1]
    farthest = max(abs(lens.v0), abs(height - 1 - lens.v0))
    return abs(lens.skew) * farthest / lens.fv


def check_skew(calibration: Calibration, cameras: tuple[str, ...], form: str) -> tuple[str, ...]:
    """Words on skews that are left out; `DataError` where one is not zero within its sigma.

    Parameters
    ----------
    calibration : the result
    cameras : names of those that are exported
    form : name of the format, for the message
    """
    words: list[str] = []
    problems: list[str] = []
    for name in cameras:
        camera = calibration.cell.cameras[name]
        skew = camera.intrinsics.skew
        if skew == 0:
            continue
        sigma = _skew_sigma(calibration, name)
        about = (
            f"camera {name!r}: {form} has no place for the skew of {skew:.3g} +- {sigma:.2g} px; "
            f"leaving it out moves pixels by up to {skew_cost_px(camera):.2g} px"
        )
        if abs(skew) <= sigma:
            words.append(f"{about}, and it is zero within its sigma: left out")
        else:
            problems.append(
                f"{about}: calibrate again with the skew held at 0, by --skew refit here "
                "(skew='refit'; for all files that belong together) or by 'lasercal calibrate "
                "CAPTURE --known skew=0'"
            )
    if problems:
        raise DataError(*problems)
    return tuple(words)


def refit_without_skew(calibration: Calibration) -> tuple[Calibration, str]:
    """Calibrate again from the result's own inputs, with every camera's skew held at 0.

    Returns
    -------
    the new calibration, and words on what the refit changed

    Raises
    ------
    DataError
        The result no longer holds the spots it was made from, or the refit did not converge.
    """
    from lasercal_gtsam.api import calibrate

    fit, inputs = calibration.fit, calibration.inputs
    if all(camera.intrinsics.skew == 0 for camera in calibration.cell.cameras.values()):
        return calibration, "the skew is 0 already: not fitted again"
    if len(inputs.observations) < fit.n_spots + fit.n_rejected:
        raise DataError(
            f"the calibration holds {len(inputs.observations)} of the "
            f"{fit.n_spots + fit.n_rejected} spots it was made from, so that it cannot be fitted "
            "again; calibrate from the capture with --known skew=0"
        )
    options = inputs.options
    known = {k: v for k, v in options.known.items() if k.rpartition(".")[2] != "skew"}
    priors = {k: v for k, v in options.priors.items() if k.rpartition(".")[2] != "alpha_c"}
    again = calibrate(
        inputs.observations,
        initial=calibration.cell,
        options=replace(options, known={**known, "skew": 0.0}, priors=priors),
    )
    if not again.fit.converged:
        raise DataError(f"fitted again with the skew held at 0: {again.fit.status}")
    told = [*(set(options.known) - set(known)), *(set(options.priors) - set(priors))]
    instead = f" (in place of what was stated of {', '.join(sorted(told))})" if told else ""
    moved = np.linalg.norm(again.spots.residual_px - calibration.spots.residual_px, axis=1)
    words = (
        f"fitted again with the skew held at 0{instead}: RMS {fit.rms_px:.4g} px before, "
        f"{again.fit.rms_px:.4g} px after; the predicted spots move by up to "
        f"{np.max(moved[np.isfinite(moved)], initial=0.0):.2g} px"
    )
    return again, "; ".join([words, *_against(calibration)])


def _against(calibration: Calibration) -> list[str]:
    """Words where the spots do not agree with a skew of 0."""
    words = []
    for name, camera in calibration.cell.cameras.items():
        skew, sigma = camera.intrinsics.skew, _skew_sigma(calibration, name)
        if sigma > 0 and abs(skew) > _CLEARLY * sigma:
            words.append(
                f"the spots speak for a skew of {skew:.3g} +- {sigma:.2g} px of camera {name!r}: "
                "the residuals, and with them the errors, are now systematic in part"
            )
    return words


def _skew_sigma(calibration: Calibration, camera: str) -> float:
    """Sigma of the skew in px; 0 where it is held or not known."""
    label = f"{camera}.skew"
    if label not in calibration.labels:
        return 0.0
    i = calibration.labels.index(label)
    variance = float(calibration.covariance[i, i])
    return float(np.sqrt(variance)) if variance > 0 else 0.0
