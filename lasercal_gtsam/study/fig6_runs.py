"""Fig. 6: relative errors of f_u, R and T against the noise, for four methods (section 4.1).

A run is one trial at one level. The cell's random plane, the motions and every draw of the noise
follow from the trial's number, so that the levels of a trial differ in the size of the noise only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.cell import Camera, Cell
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.simulate import Noise, Simulation
from lasercal_gtsam.simulate.streams import stream
from lasercal_gtsam.study.captures import (
    CORNER_OBJECT_M,
    MALM_PATTERN_M,
    horaud_views,
    ma_views,
    malm_views,
)
from lasercal_gtsam.study.cells import StudyCell
from lasercal_gtsam.study.errors import camera_errors, relative_errors
from lasercal_gtsam.study.laser import closed_form
from lasercal_gtsam.study.methods import (
    EyeToHand,
    HandViews,
    calibrate_horaud_dornaika,
    calibrate_ma,
    calibrate_malm_heyden,
    refine_views,
)

LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
TRIALS = 200

PAPER_CLOSED = "M1 paper's closed form"
GENERAL = "M1 general closed form"
TRIANGULATION = "M1 triangulation closed form"
REFINED = "M1 refined"
REFINED_FROM_PAPER = "M1 refined from the paper's"
HAND_NOISE = "M1 refined, robot noise modelled"
MA, MA_REFINED = "M2 Ma", "M2 refined"
MALM, MALM_REFINED = "M3 Malm & Heyden", "M3 refined"
HORAUD, HORAUD_CLOSED = "M4 Horaud & Dornaika", "M4 closed form"
METHODS = (
    PAPER_CLOSED,
    GENERAL,
    TRIANGULATION,
    REFINED_FROM_PAPER,
    REFINED,
    HAND_NOISE,
    MA,
    MA_REFINED,
    MALM,
    MALM_REFINED,
    HORAUD_CLOSED,
    HORAUD,
)

# the chain (16)-(35), which needs two planes or more
_OF_SEVERAL_PLANES = {PAPER_CLOSED, REFINED_FROM_PAPER}
_MA_STREAM, _MALM_STREAM, _HORAUD_STREAM = 101, 102, 103
_FLAT_PATTERN_M = np.column_stack([MALM_PATTERN_M, np.zeros(len(MALM_PATTERN_M))])

Errors = tuple[float, float, float] | None
T = TypeVar("T")


def fig6_run(spec: Mapping[str, Any], k: int) -> dict[str, list[float] | None]:
    """One trial at one level: errors of f_u, R and T by method, None where it failed.

    On one plane without the methods that need several.

    Parameters
    ----------
    spec : ``cell`` (`StudyCell.to_plain`), ``levels``, ``entropy``, ``methods``
    k : level ``k mod L`` of trial ``k div L``
    """
    levels: Sequence[float] = spec["levels"]
    trial, level = k // len(levels), levels[k % len(levels)]
    cell = StudyCell.from_plain(spec["cell"])
    seed = trial_seed(spec["entropy"], trial)
    noise = Noise.table1(level)
    wanted = set(spec["methods"])
    if cell.plane_count < 2:
        wanted -= _OF_SEVERAL_PLANES
    found: dict[str, Errors] = {}
    if wanted & set(METHODS[:6]):
        made = cell.simulated(seed, noise)
        options = CalibrationOptions(robust="none", distortion="none", known=made.known)
        found |= laser_errors(made, wanted, options)
    camera = cell.camera(seed)
    if wanted & {MA, MA_REFINED}:
        found |= _ma(camera, noise, stream(seed, _MA_STREAM))
    if wanted & {MALM, MALM_REFINED}:
        found |= _malm(camera, noise, stream(seed, _MALM_STREAM))
    if wanted & {HORAUD, HORAUD_CLOSED}:
        found |= _horaud(camera, noise, stream(seed, _HORAUD_STREAM))
    return {m: None if (e := found[m]) is None else list(e) for m in METHODS if m in wanted}


def trial_seed(entropy: int, trial: int) -> int:
    """Seed of one trial: its own, whatever else runs (``SeedSequence``'s ``spawn_key``)."""
    sequence = np.random.SeedSequence(entropy, spawn_key=(trial,))
    return int(sequence.generate_state(1, np.uint64)[0])


def laser_errors(
    made: Simulation, wanted: Collection[str], options: CalibrationOptions
) -> dict[str, Errors]:
    """Errors of the laser method's forms that are wanted, by name."""
    seen, truth = made.observations, made.truth
    found: dict[str, Errors] = {}
    paper: Cell | None = None
    if {PAPER_CLOSED, REFINED_FROM_PAPER} & set(wanted):
        paper = _or_none(partial(closed_form, "paper", seen))
        found[PAPER_CLOSED] = _errors(paper, truth)
    for name, form in ((GENERAL, "general"), (TRIANGULATION, "triangulation")):
        if name in wanted:
            cell = _or_none(partial(closed_form, form, seen, made.known))
            found[name] = _errors(cell, truth)
    if REFINED_FROM_PAPER in wanted:
        found[REFINED_FROM_PAPER] = (
            None if paper is None else _errors(_refined(seen, options, paper), truth)
        )
    refined: Cell | None = None
    if {REFINED, HAND_NOISE} & set(wanted):
        refined = _refined(seen, options, None)
        found[REFINED] = _errors(refined, truth)
    if HAND_NOISE in wanted:
        noise = made.noise
        if noise != Noise():
            known = replace(
                options,
                sigma_px=noise.pixel_px,
                hand_sigma_m=noise.hand_translation_m,
                hand_sigma_rad=noise.hand_rotation_rad,
            )
            refined = _refined(seen, known, refined)
        found[HAND_NOISE] = _errors(refined, truth)
    return found


def _refined(seen: Observations, options: CalibrationOptions, start: Cell | None) -> Cell | None:
    return _or_none(lambda: calibrate(seen, initial=start, options=options).cell)


def _ma(camera: Camera, noise: Noise, rng: np.random.Generator) -> dict[str, Errors]:
    made = ma_views(camera, noise, rng)
    closed = _or_none(lambda: calibrate_ma(made.views))
    return {
        MA: _view_errors(closed, made.truth),
        MA_REFINED: _view_errors(_views_refined(made.views, closed, None), made.truth),
    }


def _malm(camera: Camera, noise: Noise, rng: np.random.Generator) -> dict[str, Errors]:
    made = malm_views(camera, noise, rng)
    closed = _or_none(lambda: calibrate_malm_heyden(made.views, MALM_PATTERN_M))
    refined = _views_refined(made.views, closed, _FLAT_PATTERN_M)
    return {
        MALM: _view_errors(closed, made.truth),
        MALM_REFINED: _view_errors(refined, made.truth),
    }


def _horaud(camera: Camera, noise: Noise, rng: np.random.Generator) -> dict[str, Errors]:
    """Errors of the object in the hand, as in the paper; f_u is the same before and after."""
    made = horaud_views(camera, noise, rng)
    found = _or_none(lambda: calibrate_horaud_dornaika(made.views, CORNER_OBJECT_M))
    if found is None:
        return {HORAUD: None, HORAUD_CLOSED: None}
    fu, true_fu = found.camera.K[0, 0], made.truth.K[0, 0]
    return {
        HORAUD: relative_errors(fu, found.T_hand_object, true_fu, made.T_hand_target),
        HORAUD_CLOSED: relative_errors(fu, found.T_hand_object_closed, true_fu, made.T_hand_target),
    }


def _views_refined(
    views: HandViews, start: EyeToHand | None, pattern: Array | None
) -> EyeToHand | None:
    return None if start is None else _or_none(lambda: refine_views(views, start, pattern))


def _view_errors(found: EyeToHand | None, truth: EyeToHand) -> Errors:
    if found is None:
        return None
    return relative_errors(found.K[0, 0], found.T_base_camera, truth.K[0, 0], truth.T_base_camera)


def _errors(cell: Cell | None, truth: Cell) -> Errors:
    return None if cell is None else camera_errors(cell, truth)


def _or_none(solve: Callable[[], T]) -> T | None:
    """What a method finds, or None where it says that it cannot."""
    try:
        return solve()
    except (LasercalError, np.linalg.LinAlgError):
        return None
