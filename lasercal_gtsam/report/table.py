"""The parameters: the paper's Table 2 with intervals, frames and what each number means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtrit

from lasercal_gtsam.calibration import (
    Calibration,
    Parameter,
    plain_number,
    table_decimals,
    table_row,
)
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.report.plainly import number
from lasercal_gtsam.report_map import BeamChart

LEVEL = 0.95
MANY_DOF = 1000
"""Degrees of freedom from which on Student's t and the normal distribution agree to 0.2 %."""

_CAMERA = {
    "fu": ("focal length across", "picture", "Focal length in columns of pixels."),
    "fv": ("focal length down", "picture", "Focal length in rows of pixels."),
    "alpha_c": ("skew", "picture", "Skew of the pixel axes over fu; 0: they are at right angles."),
    "u0": ("principal point, u", "picture", "Column where the optical axis meets the picture."),
    "v0": ("principal point, v", "picture", "Row where the optical axis meets the picture."),
    "k1": ("radial distortion", "", "Factor of r^2 in the radial distortion (OpenCV's k1)."),
    "k2": ("radial distortion", "", "Factor of r^4 in the radial distortion (OpenCV's k2)."),
    "p1": ("tangential distortion", "", "First tangential term (OpenCV's p1)."),
    "p2": ("tangential distortion", "", "Second tangential term (OpenCV's p2)."),
    "theta": ("camera's turn about z", "base", "R = Rz(theta) Ry(phi) Rx(psi), camera to base."),
    "phi": ("camera's turn about y", "base", "R = Rz(theta) Ry(phi) Rx(psi), camera to base."),
    "psi": ("camera's turn about x", "base", "R = Rz(theta) Ry(phi) Rx(psi), camera to base."),
    "Tx": ("camera's position, x", "base", "Where the camera's centre of projection is."),
    "Ty": ("camera's position, y", "base", "Where the camera's centre of projection is."),
    "Tz": ("camera's position, z", "base", "Where the camera's centre of projection is."),
}
_LASER = {
    "laser_theta": ("beam's azimuth", "About the hand's z axis, from its x axis: atan2(uy, ux)."),
    "laser_phi": ("beam's polar angle", "From the hand's z axis."),
    "laser_tilt_x": ("beam's tilt in x", "atan(ux / uz); the beam runs nearly along z."),
    "laser_tilt_y": ("beam's tilt in y", "atan(uy / uz); the beam runs nearly along z."),
    "laser_x": ("beam's crossing, x", "Where the beam crosses {}."),
    "laser_y": ("beam's crossing, y", "Where the beam crosses {}."),
    "laser_z": ("beam's crossing, z", "Where the beam crosses {}."),
}
_PLANE = "The plane's vector: its unit normal times its distance from the base's origin (eq. 4)."


Intervals = Mapping[str, tuple[float, float]]


def parameters_section(
    calibration: Calibration, intervals: Intervals | None = None
) -> dict[str, Any]:
    """Rows with sigma and interval, and what the interval is.

    ``intervals``: 95 % intervals of all rows that were estimated (`lasercal_gtsam.intervals`), to
    be printed instead of those by sigma.
    """
    factor, distribution = interval_factor(calibration.fit.dof)
    known = any(p.sigma > 0 for p in calibration.parameters)
    if intervals is not None:
        factor, distribution = float("nan"), "likelihood"
    who = zip(calibration.parameters, _owners(calibration), strict=True)
    return {
        "heading": "Parameters",
        "words": [
            "Initial: the closed form's start, or the one that was given. Refined: the answer. "
            "Sigma: one standard deviation, from the residuals. The rows go together: read the "
            "correlations before using one sigma alone.",
        ],
        "missing": None,
        "rows": [_row(p, part, said, _ends(p, factor, intervals)) for p, (part, said) in who],
        "interval": {
            "level": LEVEL,
            "distribution": distribution if known else None,
            "dof": number(calibration.fit.dof),
            "factor": number(factor) if known else None,
            "words": _interval_words(calibration.fit.dof, factor, distribution),
        },
        "rms_px": number(calibration.fit.rms_px),
    }


def interval_factor(dof: float, level: float = LEVEL) -> tuple[float, str]:
    """Half the width of an interval in sigmas, and ``t`` or ``normal``; NaN without a sigma.

    The scale of the sigmas comes from the residuals, so that Student's t with their degrees of
    freedom is right; with very many the normal distribution is the same.
    """
    if not dof >= 1:
        return float("nan"), "t"
    tail = 0.5 + level / 2
    if dof >= MANY_DOF:
        return float(ndtri(tail)), "normal"
    return float(stdtrit(dof, tail)), "t"


def _ends(p: Parameter, factor: float, intervals: Intervals | None) -> tuple[float, float]:
    """Low and high end of a row's interval; NaN where it has none."""
    if not p.sigma > 0:
        return float("nan"), float("nan")
    if intervals is not None:
        return intervals[p.name]
    return p.refined - factor * p.sigma, p.refined + factor * p.sigma


def _interval_words(dof: float, factor: float, distribution: str) -> str:
    if distribution == "likelihood":
        return (
            "95 % interval: from the likelihood, all other rows free, so that it need not lie "
            "evenly about the answer. It covers noise, not a model that is wrong."
        )
    if not np.isfinite(factor):
        return "There are no degrees of freedom left, so no sigmas and no intervals."
    name = (
        "the normal distribution"
        if distribution == "normal"
        else f"Student's t with {dof:.0f} degrees of freedom"
    )
    return (
        f"95 % interval: refined \N{PLUS-MINUS SIGN} {factor:.3g} sigma, by {name}. It covers "
        "noise, not a model that is wrong."
    )


def _row(
    p: Parameter, part: str, said: tuple[str, str, str], ends: tuple[float, float]
) -> dict[str, Any]:
    label, frame, meaning = said
    held = p.sigma == 0
    _, initial, refined, sigma, _ = table_row(p)
    decimals = table_decimals(p)
    return {
        "name": p.name,
        "label": label,
        "part": part,
        "unit": p.unit,
        "frame": frame,
        "initial": number(p.initial, 12),
        "refined": number(p.refined, 12),
        "sigma": number(p.sigma),
        "low": number(ends[0], 12),
        "high": number(ends[1], 12),
        "held": held,
        "meaning": meaning,
        "text": {
            "initial": initial,
            "refined": refined,
            "sigma": sigma,
            "low": _end_text(ends[0], decimals),
            "high": _end_text(ends[1], decimals),
        },
    }


def _end_text(value: float, decimals: int) -> str:
    return "no bound" if np.isinf(value) else plain_number(value, decimals)


def _owners(calibration: Calibration) -> Iterator[tuple[str, tuple[str, str, str]]]:
    """Part, and label, frame and meaning, of each row of the table."""
    cell = calibrated_cell(calibration)
    for name in cell.cameras:
        for said in _CAMERA.values():
            yield f"camera '{name}'", said
    for name, beam in cell.lasers.items():
        chart = BeamChart.of(beam)
        plane = f"the hand's {'xyz'[chart.axis]} = 0 plane"
        for row, _ in chart.rows:
            label, meaning = _LASER[row]
            yield f"laser '{name}'", (label, "hand", meaning.format(plane))
    for name in cell.planes:
        for axis in "xyz":
            yield f"plane '{name}'", (f"plane's vector, {axis}", "base", _PLANE)
