"""Nothing moves: how often does the calibrator say that something did?"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from findings import Finding, at_most, print_table
from spots import good_stream

import lasercal_gtsam as lc

CELLS = 10
# spots that each cell begins with, at once
START = 90
# spots in one call after that: each is looked at as if alone, an alarm is examined at the end
BLOCK = 25
STAINED = (0.01, 0.1)
PER_MILLION = 10
# an alarm that is open for so many spots is dismissed, so that the next can be counted
_PATIENCE = 40


class Stretch(NamedTuple):
    """A part of the work: spots of one cell."""

    seed: int
    spots: int
    outliers: float


class Count(NamedTuple):
    """Alarms in a stretch; ``kept``: of them those that were not withdrawn before `_PATIENCE`.

    ``end``: how it ended before its last spot, "" if it did not.
    """

    alarms: int
    kept: int
    words: tuple[str, ...]
    end: str


def run(args: argparse.Namespace) -> list[Finding]:
    findings = []
    rows = [("spots", "outliers", "alarms", "not withdrawn", "what was said")]
    for outliers, spots in ((0.0, args.good), *((share, args.stained) for share in STAINED)):
        work = [Stretch(seed, spots // CELLS, outliers) for seed in range(CELLS)]
        if args.processes > 1:
            with ProcessPoolExecutor(args.processes) as pool:
                counts = list(pool.map(count_alarms, work))
        else:
            counts = [count_alarms(stretch) for stretch in work]
        alarms, total = sum(c.alarms for c in counts), spots // CELLS * CELLS
        words = "; ".join(w for c in counts for w in (*c.words[:2], c.end) if w) or "-"
        rows.append(
            (f"{total}", f"{outliers:.0%}", f"{alarms}", f"{sum(c.kept for c in counts)}", words)
        )
        allowed = max(1, PER_MILLION * total // 1_000_000)
        what = f"alarms in {total} spots with {outliers:.0%} outliers"
        findings.append(at_most(what, alarms, allowed))
        if ended := [c.end for c in counts if c.end]:
            findings.append(Finding("streams that came to an end", "none", f"{len(ended)}", False))
    print_table(rows)
    return findings


def count_alarms(stretch: Stretch) -> Count:
    """Run one cell's spots through the whole calibrator."""
    made = good_stream(stretch.seed, stretch.spots, outliers=stretch.outliers, grouped=START)
    calibrator = lc.IncrementalCalibrator(options=lc.CalibrationOptions(distortion="none"))
    kept, end = 0, ""
    try:
        calibrator.add(made.observations[:START])
        for begin in range(START, stretch.spots, BLOCK):
            update = calibrator.add(made.observations[begin : begin + BLOCK])
            if update.alarm is not None and update.alarm.spots >= _PATIENCE:
                kept += 1
                calibrator.dismiss()
    except Exception as error:  # a fault of the calibrator is a finding, not the end of the others
        end = f"cell {stretch.seed}, spot {calibrator.n_spots}: {type(error).__name__}: {error}"
    alarms = [event for event in calibrator.events if event.kind == "alarm"]
    words = tuple(f"cell {stretch.seed}, spot {event.spots}: {event.words}" for event in alarms)
    return Count(len(alarms), kept, words, end)
