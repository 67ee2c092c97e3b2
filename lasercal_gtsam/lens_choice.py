"""Which distortion terms the spots can carry: ``distortion="auto"``.

A term that is not needed costs: what it takes from the noise it gives to everything that moves with
it. A term that is left out although it is there bends everything. The corrected Akaike criterion
(Hurvich and Tsai, Biometrika 76, 1989) weighs the two by the expected error of a prediction,

    AICc = N ln(S / N) + 2 N (p + 1) / (N - p - 2),

with ``S`` the sum of squared residuals over ``N`` rows, and ``p`` the number of unknowns that the
spots (not the priors) determine (Hurvich, Simonoff, Tsai 1998). The logarithm is there because the
scale of the noise is estimated, always: stated sigmas only give the weights, here as in the
covariance. BIC asks another question, which model is the true one; lenses have all terms, and where
a small one is dropped for being doubtful all sigmas are wrong (measured: coverage down to 78 %, by
AICc to 84 %).

The models are nested in the order in which lenses need them; tangential terms without a radial one
are none. Several cameras choose in turn until nobody changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.cell import Camera, Cell
from lasercal_gtsam.errors import DegenerateError, LasercalError
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.options import DISTORTION_NAMES
from lasercal_gtsam.report_map import CAMERA_TANGENT
from lasercal_gtsam.solve import Solution, degrees_of_freedom, refuse_if_singular
from lasercal_gtsam.start import Search

Terms = tuple[str, ...]

MODELS: tuple[Terms, ...] = (
    (),
    ("k1",),
    ("k1", "k2"),
    ("k1", "p1", "p2"),
    ("k1", "k2", "p1", "p2"),
)
_MAX_ROUNDS = 3
# residuals below this (in stated sigmas, or px) are rounding: no model is better than another
_ROUNDING = 1e-6


class LensChoice(NamedTuple):
    """The outcome.

    ``holds``: with the terms that were left out held; ``cell``: the optimum of that model, to start
    from; ``notes``: what was chosen and why, one sentence for each camera.
    """

    holds: Holds
    cell: Cell
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Tried:
    """A model that was fitted: its criterion and optimum, or why there is none."""

    terms: Terms
    criterion: float
    cell: Cell | None
    trouble: str = ""


def choose_lens(search: Search, solution: Solution, start: Cell) -> LensChoice:
    """Choose the distortion terms of every camera.

    Terms that are known, fixed or have a prior of the user's own are no matter of choice.

    Parameters
    ----------
    search : observations and options; its holds leave open what may be chosen
    solution : a fit with as many terms as could be fitted, on the spots that were accepted
    start : holds the values of the terms that are left out

    Raises
    ------
    DegenerateError
        No model can be fitted.
    """
    # its spots: without the outliers and, with a noisy robot, at corrected hand poses
    used = replace(search, batch=solution.problem.batch)
    cameras = search.observations.cameras
    open_terms = {camera: _open_terms(search, camera) for camera in cameras}
    chosen = {camera: open_terms[camera] for camera in cameras}
    cell, tried = solution.cell, dict[str, list[_Tried]]()
    for _ in range(_MAX_ROUNDS):
        before = dict(chosen)
        for camera in cameras:
            tried[camera] = [
                _fitted(used, {**chosen, camera: terms}, camera, cell, start)
                for terms in _models(open_terms[camera])
            ]
            best = min(tried[camera], key=lambda t: t.criterion)
            if best.cell is None:
                raise DegenerateError(best.trouble)
            chosen[camera], cell = best.terms, best.cell
        if chosen == before or len(cameras) == 1:
            break
    holds = _holds(search.holds, search, chosen)
    notes = [_words(search, camera, chosen[camera], tried[camera]) for camera in cameras]
    return LensChoice(holds, cell, tuple(note for note in notes if note))


def _open_terms(search: Search, camera: str) -> Terms:
    at = search.observations.cameras.index(camera) * len(CAMERA_TANGENT)
    named = _row_names(search, camera)
    return tuple(
        term
        for term in DISTORTION_NAMES
        if not search.holds.held[at + CAMERA_TANGENT.index(term)]
        and named[term] not in search.options.priors
    )


def _row_names(search: Search, camera: str) -> dict[str, str]:
    prefix = f"{camera}." if len(search.observations.cameras) > 1 else ""
    return {term: prefix + term for term in DISTORTION_NAMES}


def _models(open_terms: Terms) -> list[Terms]:
    """The models with what is no matter of choice taken out of them; each once."""
    kept = [tuple(term for term in model if term in open_terms) for model in MODELS]
    return list(dict.fromkeys(kept))


def _holds(holds: Holds, search: Search, chosen: dict[str, Terms]) -> Holds:
    left_out = {
        camera: tuple(t for t in _open_terms(search, camera) if t not in terms)
        for camera, terms in chosen.items()
    }
    return holds.leaving_out(left_out)


def _fitted(
    search: Search, chosen: dict[str, Terms], camera: str, cell: Cell, start: Cell
) -> _Tried:
    terms = chosen[camera]
    holds = _holds(search.holds, search, chosen)
    try:
        begin = _with_values(cell, start, search, chosen)
        found = search.attempt(begin, holds)
        if isinstance(found, LasercalError):
            raise found
        if found.troubles:
            return _Tried(terms, math.inf, None, found.troubles[0])
        problem = found.problem.anchored(found.cell)
        values = problem.start_values()
        refuse_if_singular(problem, values)
        dof = degrees_of_freedom(problem, values)
    except LasercalError as error:
        return _Tried(terms, math.inf, None, str(error))
    rows = 2.0 * len(problem.batch.order)
    return _Tried(terms, corrected_akaike(found.cost, rows, rows - dof), found.cell)


def corrected_akaike(cost: float, rows: float, unknowns: float) -> float:
    """AICc of a sum of squares; infinite where there are too few rows to judge.

    ``unknowns`` without the scale of the noise, which counts as one more.
    """
    left = rows - unknowns - 2.0
    if left <= 0.0:
        return math.inf
    mean = max(cost / rows, _ROUNDING**2)
    return rows * math.log(mean) + 2.0 * rows * (unknowns + 1.0) / left


def _with_values(cell: Cell, start: Cell, search: Search, chosen: dict[str, Terms]) -> Cell:
    """The cell with the terms that are left out at the start's values."""
    cameras = dict(cell.cameras)
    for name, terms in chosen.items():
        left_out = [t for t in _open_terms(search, name) if t not in terms]
        values = {t: getattr(start.cameras[name].intrinsics, t) for t in left_out}
        camera = cameras[name]
        moved = replace(camera.intrinsics, **values)
        cameras[name] = Camera(moved, camera.T_base_camera, camera.image_size)
    return Cell(cameras, cell.lasers, cell.planes)


def _words(search: Search, camera: str, chosen: Terms, tried: list[_Tried]) -> str:
    if len(tried) < 2:
        return ""
    whose = f" of camera {camera!r}" if len(search.observations.cameras) > 1 else ""
    best = next(t for t in tried if t.terms == chosen)
    others = [
        f"{_name(t.terms)} {t.criterion - best.criterion:.1f}"
        if np.isfinite(t.criterion)
        else f"{_name(t.terms)} not to be fitted"
        for t in tried
        if t is not best
    ]
    words = (
        f"distortion{whose}: {_name(chosen)} chosen, with the least AICc (above it: "
        f"{', '.join(others)})"
    )
    if set(chosen) == set(_open_terms(search, camera)):
        return words
    return (
        f"{words}. The sigmas take this choice as given: where a term that was left out is not "
        "quite zero they are too small"
    )


def _name(terms: Terms) -> str:
    return " ".join(terms) if terms else "no term"
