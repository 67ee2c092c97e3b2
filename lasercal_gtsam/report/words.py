"""Sentences that the report and the command line share; cheap to import."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from lasercal_gtsam.units import DEG_PER_RAD, MM_PER_M

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration, NoiseLevel

# residuals this many times larger than the stated noise deserve a word
_SUSPICIOUS = 1.5
_LEVELS = {
    "sigma_px": ("pixels", 1.0, "px"),
    "hand_sigma_m": ("hand position", MM_PER_M, "mm"),
    "hand_sigma_rad": ("hand rotation", DEG_PER_RAD, "deg"),
}


def noise_sentence(calibration: Calibration) -> str:
    """What sigma0 means here: a pixel sigma, or a check of the stated noise."""
    import numpy as np

    fit, options = calibration.fit, calibration.inputs.options
    if not math.isfinite(fit.sigma0):
        return "There are as many unknowns as measurements: no sigmas can be stated."
    behind = f"{fit.dof:.0f} degrees of freedom"
    pixels_stated = (
        options.sigma_px is not None or not np.isnan(calibration.inputs.observations.cov_uv).all()
    )
    if fit.noise:
        return (
            f"Noise from the residuals (95 % intervals, {behind}): "
            f"{', '.join(map(_level_words, fit.noise))}."
        )
    hand_stated = options.hand_sigma_m > 0 or options.hand_sigma_rad > 0
    if not (pixels_stated or hand_stated):
        return f"Noise of a pixel coordinate, from the residuals: {fit.sigma0:.3g} px ({behind})."
    noise = "the stated noise" if pixels_stated else "1 px and the stated noise of the hand"
    text = f"The residuals are {fit.sigma0:.3g} times what {noise} explains ({behind})"
    if fit.sigma0 > _SUSPICIOUS:
        return (
            f"{text}: poses, planes or the camera are less exact than stated. The sigmas are "
            "widened by that factor."
        )
    return f"{text}; the sigmas are scaled by that factor."


def _level_words(level: NoiseLevel) -> str:
    """``hand translation 1.02 mm (0.9 to 1.1)``."""
    what, factor, unit = _LEVELS[level.name]
    low, high = (size_words(factor * x) for x in (level.low, level.high))
    return f"{what} {size_words(factor * level.value)} {unit} ({low} to {high})"


def sentence(text: str) -> str:
    """The text with a capital in front and a full stop behind."""
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


def count(number: int, noun: str) -> str:
    """``1 spot``, ``2 spots``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def chance_words(value: float) -> str:
    """A probability as text; ``unknown`` where it is not known."""
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.2g}" if value > 1e-15 else "< 1e-15"


def size_words(value: float) -> str:
    """A number with two significant digits, never in powers of ten for usual sizes."""
    if not math.isfinite(value):
        return "unknown"
    if value == 0 or not 1e-4 <= abs(value) < 1e5:
        return f"{value:.2g}"
    decimals = max(0, 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"
