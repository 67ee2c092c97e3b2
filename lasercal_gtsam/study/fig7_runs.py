"""Fig. 7: error of f_u against the number of samples, for one, two and three planes.

Pixel noise of 1 px only, as in the paper. A run is one trial of one case at one number of samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.simulate import Noise
from lasercal_gtsam.study.cells import StudyCell
from lasercal_gtsam.study.fig6_runs import (
    GENERAL,
    PAPER_CLOSED,
    REFINED,
    TRIANGULATION,
    laser_errors,
    trial_seed,
)

SAMPLES = (30, 60, 120, 180, 240, 300)
TRIALS = 150
SHOTS = 10
CASES = {
    "1 plane (a_1)": StudyCell("paper-2", planes=("1",)),
    "1 plane (a_2)": StudyCell("paper-2", planes=("2",)),
    "2 planes": StudyCell("paper-2"),
    "3 planes": StudyCell("paper"),
}
METHODS = (PAPER_CLOSED, GENERAL, TRIANGULATION, REFINED)


def combinations(spec: Mapping[str, Any]) -> list[tuple[str, int]]:
    """Case and number of samples of every run of a trial; whole groups on every plane only."""
    return [
        (case, n)
        for case, said in spec["cases"].items()
        for n in spec["samples"]
        if n % (SHOTS * StudyCell.from_plain(said).plane_count) == 0
    ]


def fig7_run(spec: Mapping[str, Any], k: int) -> dict[str, list[float] | None]:
    """One trial of one case: errors of f_u, R and T by method, None where it failed.

    Parameters
    ----------
    spec : ``cases`` (name -> `StudyCell.to_plain`), ``samples``, ``pixel_px``, ``entropy``,
        ``methods``
    k : combination ``k mod C`` of trial ``k div C``
    """
    todo = combinations(spec)
    trial, (case, samples) = k // len(todo), todo[k % len(todo)]
    cell = StudyCell.from_plain(spec["cases"][case])
    planes = cell.plane_count
    groups = samples // (SHOTS * planes)
    cell = StudyCell(cell.preset, cell.cell, cell.planes, groups, SHOTS, cell.design)
    made = cell.simulated(trial_seed(spec["entropy"], trial), Noise(pixel_px=spec["pixel_px"]))
    options = CalibrationOptions(robust="none", distortion="none", known=made.known)
    wanted = [m for m in spec["methods"] if planes > 1 or m != PAPER_CLOSED]
    found = laser_errors(made, wanted, options)
    return {m: None if (e := found[m]) is None else list(e) for m in wanted}
