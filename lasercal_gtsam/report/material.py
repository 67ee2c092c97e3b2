"""What a report is made of, gathered once: the calibration, its judgement, where it came from."""

from __future__ import annotations

from dataclasses import dataclass

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError, SolveError
from lasercal_gtsam.io.capture import Capture
from lasercal_gtsam.io.origin import Origin as Origin
from lasercal_gtsam.io.spot_account import SpotAccount
from lasercal_gtsam.opinions.bench import Bench, lay_out
from lasercal_gtsam.opinions.split import fit_halves
from lasercal_gtsam.opinions.verdict import Verdict, judge


@dataclass(frozen=True, eq=False)
class Material:
    """What the sections of a report draw from.

    Attributes
    ----------
    calibration : the result
    verdict : the judgement on it, halves included
    bench : it laid out; None where there is nothing to judge by, and ``bench_trouble`` says why
    halves : calibrations of two halves; None where there are none, and ``halves_trouble`` says why
    origin : where it came from
    capture, account : the capture and what became of its rows, where they are at hand
    """

    calibration: Calibration
    verdict: Verdict
    bench: Bench | None
    bench_trouble: str
    halves: tuple[Calibration, Calibration] | None
    halves_trouble: str
    origin: Origin
    capture: Capture | None
    account: SpotAccount | None


def gather(
    calibration: Calibration,
    origin: Origin | None = None,
    capture: Capture | None = None,
    account: SpotAccount | None = None,
) -> Material:
    """Judge the calibration and lay it out."""
    bench, bench_trouble, halves, halves_trouble = None, "", None, ""
    try:
        bench = lay_out(calibration)
    except DataError as error:
        bench_trouble = str(error)
    try:
        halves = fit_halves(calibration)
    except SolveError as error:
        halves_trouble = str(error)
    return Material(
        calibration,
        judge(calibration, halves=True, parts=halves),
        bench,
        bench_trouble,
        halves,
        halves_trouble,
        origin or Origin(),
        capture,
        account,
    )
