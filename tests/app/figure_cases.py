"""Calibrations that the tests of figures and report share."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from test_core_cameras import capture, two_eyed_cell

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import Inputs, SpotResults
from lasercal_gtsam.simulate import Noise, simulate

SPOILED = 20


@cache
def usual(pixel_px: float = 0.3) -> lc.Calibration:
    """One camera, one laser, three planes."""
    made = simulate("paper-distorted", 1, Noise(pixel_px=pixel_px))
    return lc.calibrate(made.observations, initial=made.truth)


@cache
def one_plane() -> lc.Calibration:
    made = simulate("table2-2", 1, Noise(pixel_px=0.3))
    return lc.calibrate(
        made.observations, initial=made.truth, options=lc.CalibrationOptions(known=made.known)
    )


@cache
def two_cameras() -> lc.Calibration:
    """Two cameras, two lasers, three planes, robot noise, and spots that are none."""
    cell, noise = two_eyed_cell(), Noise(0.3, 3e-4, 3e-4)
    pairs = [("left", "blue"), ("right", "blue"), ("left", "red"), ("right", "red")]
    seen = capture(cell, pairs, noise)
    rng = np.random.default_rng(1)
    rows = rng.choice(len(seen), SPOILED, replace=False)
    uv = seen.uv.copy()
    uv[rows] = rng.uniform(0.0, 1.0, (SPOILED, 2)) * (639, 479)
    options = lc.CalibrationOptions(sigma_px=0.3, hand_sigma_m=3e-4, hand_sigma_rad=3e-4)
    return lc.calibrate(replace(seen, uv=uv), initial=cell, options=options)


@cache
def without_spots() -> lc.Calibration:
    """What is left when only the estimate was kept."""
    whole = usual()
    names = np.zeros(0, dtype=np.str_)
    spots = SpotResults(names, names, names, names, np.zeros((0, 2)), np.zeros(0), ())
    nothing = whole.inputs.observations[np.zeros(0, dtype=np.int64)]
    return replace(whole, spots=spots, inputs=Inputs(nothing, whole.inputs.options))


@cache
def no_freedom() -> lc.Calibration:
    """As many unknowns as measurements: there are no sigmas."""
    made = simulate("paper", 3, Noise(pixel_px=0.05))
    truth = made.truth.cameras["camera"].intrinsics
    known = {n: getattr(truth, n) for n in ("skew", "u0", "v0")} | {"aspect": 1.0}
    options = lc.CalibrationOptions(
        known=known, distortion="none", fixed=("T_base_camera",), robust="none"
    )
    return lc.calibrate(made.observations[[0, 5, 12, 25]], initial=made.truth, options=options)
