"""The three studies: settings in, results out; where they run is the engine's business."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from lasercal_gtsam.engine import Progress, Results, Work, Workers, apart, run_all
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.simulate.presets import preset_named
from lasercal_gtsam.study import fig6_runs as _fig6
from lasercal_gtsam.study import fig7_runs as _fig7
from lasercal_gtsam.study import table2_runs as _table2
from lasercal_gtsam.study.cells import StudyCell
from lasercal_gtsam.study.findings import (
    Finding,
    fig6_findings,
    fig7_findings,
    table2_findings,
)
from lasercal_gtsam.study.outcome import ErrorCurves
from lasercal_gtsam.study.table2_runs import TestColumn, test_columns

Show = Callable[[Progress], None]


@dataclass(frozen=True)
class Study:
    """What a study found.

    Attributes
    ----------
    name : ``"fig6"``, ``"fig7"`` or ``"table2"``
    spec : settings, plain
    results : values of all runs, and their digest
    curves : name -> errors along an axis; Fig. 6 has one, Fig. 7 one for each case
    columns : the tests of Table 2
    findings : what agrees with the paper, and what does not
    as_paper : whether cell, motions and noise are the paper's, so that its numbers compare
    """

    name: str
    spec: Mapping[str, Any]
    results: Results
    curves: Mapping[str, ErrorCurves]
    columns: tuple[TestColumn, ...]
    findings: tuple[Finding, ...]
    as_paper: bool = True

    def table(self) -> str:
        """Text of all numbers."""
        quantities = ("f_u",) if self.name == "fig7" else ("f_u", "R", "T")
        parts = [c.table(q) for q in quantities for c in self.curves.values()]
        parts += [column.table() for column in self.columns]
        return "\n\n".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values: settings, digest, statistics, findings, each run."""
        from lasercal_gtsam.io.plain import plain

        return {
            "format": "lasercal-study",
            "version": 1,
            "study": self.name,
            "settings": dict(self.spec),
            "digest": self.results.digest,
            "statistics": [r for c in self.curves.values() for r in c.records()],
            "tests": [plain(column) for column in self.columns],
            "findings": [plain(finding) for finding in self.findings],
            "runs": list(self.results.values),
        }


def fig6(
    *,
    trials: int = _fig6.TRIALS,
    levels: Sequence[float] = _fig6.LEVELS,
    cell: StudyCell | None = None,
    methods: Sequence[str] = _fig6.METHODS,
    seed: int = 0,
    workers: Workers | None = None,
    journal: str | Path | None = None,
    progress: Show | None = None,
) -> Study:
    """Errors of four calibration methods against the noise (Fig. 6).

    Parameters
    ----------
    trials : at each level
    levels : multiples of Table 1's noise (1 px, 1 mm, 0.05 deg)
    cell : where the laser method works, and whose camera all use; the paper's by default
    methods : names out of `fig6_runs.METHODS`
    seed : integer >= 0; the same numbers come out for the same seed, whatever runs them
    workers, journal, progress : see `lasercal_gtsam.engine.run_all`

    Raises
    ------
    DataError
        A setting is not what it may be; the journal belongs to another study.
    """
    _check(trials, seed)
    _check_numbers("levels", levels, 0.0)
    if unknown := [m for m in methods if m not in _fig6.METHODS]:
        raise DataError(
            f"study: method {unknown[0]!r} is unknown; choose out of {', '.join(_fig6.METHODS)}"
        )
    if not methods:
        raise DataError("study: no method is left")
    at = [float(x) for x in levels]
    cell = cell or StudyCell()
    spec = {
        "cell": cell.to_plain(),
        "levels": at,
        "entropy": seed,
        "methods": list(methods),
    }
    results = _run("fig6", _fig6.fig6_run, spec, trials * len(levels), workers, journal, progress)
    runs = {(k % len(levels), k // len(levels)): value for k, value in enumerate(results.values)}
    curves = ErrorCurves.of("Fig. 6", "noise level", at, methods, runs, trials)
    as_paper = cell == StudyCell()
    found = tuple(fig6_findings(curves, as_paper))
    return Study("fig6", spec, results, {"fig6": curves}, (), found, as_paper)


def fig7(
    *,
    trials: int = _fig7.TRIALS,
    samples: Sequence[int] = _fig7.SAMPLES,
    cases: Mapping[str, StudyCell] | None = None,
    pixel_px: float = 1.0,
    methods: Sequence[str] = _fig7.METHODS,
    seed: int = 0,
    workers: Workers | None = None,
    journal: str | Path | None = None,
    progress: Show | None = None,
) -> Study:
    """Error of f_u against the number of samples, for one, two and three planes (Fig. 7).

    Parameters
    ----------
    trials : of each case at each number of samples
    samples : spots on all planes together, ten for each hand rotation
    cases : name -> cell; the paper's by default
    pixel_px : noise of the pixels; the hand has none
    methods : names out of `fig7_runs.METHODS`
    seed, workers, journal, progress : as in `fig6`

    Raises
    ------
    DataError
        As in `fig6`; or no case has whole groups at any of the numbers of samples.
    """
    _check(trials, seed)
    _check_numbers("samples", samples, 1.0)
    if unknown := [m for m in methods if m not in _fig7.METHODS]:
        raise DataError(
            f"study: method {unknown[0]!r} is unknown; choose out of {', '.join(_fig7.METHODS)}"
        )
    chosen = _fig7.CASES if cases is None else cases
    spec = {
        "cases": {name: cell.to_plain() for name, cell in chosen.items()},
        "samples": [int(n) for n in samples],
        "pixel_px": float(pixel_px),
        "entropy": seed,
        "methods": list(methods),
    }
    todo = _fig7.combinations(spec)
    if not todo:
        raise DataError(
            f"study: samples {list(samples)}: expected multiples of {_fig7.SHOTS} times the number "
            "of planes"
        )
    results = _run("fig7", _fig7.fig7_run, spec, trials * len(todo), workers, journal, progress)
    curves = {}
    for case in chosen:
        at = [n for name, n in todo if name == case]
        if at:
            runs = {
                (at.index(todo[k % len(todo)][1]), k // len(todo)): value
                for k, value in enumerate(results.values)
                if todo[k % len(todo)][0] == case
            }
            curves[case] = ErrorCurves.of(case, "samples", at, methods, runs, trials)
    as_paper = pixel_px == 1.0 and all(_fig7.CASES.get(n) == c for n, c in chosen.items())
    found = tuple(fig7_findings(curves, as_paper))
    return Study("fig7", spec, results, curves, (), found, as_paper)


def table2(
    *,
    trials: int = _table2.TRIALS,
    tests: Sequence[str] = tuple(_table2.TESTS),
    design: str | None = None,
    seed: int = 0,
    workers: Workers | None = None,
    journal: str | Path | None = None,
    progress: Show | None = None,
) -> Study:
    """Initial | Refined | sigma of the paper's four tests on simulated cells (Table 2).

    Parameters
    ----------
    trials : captures of each test
    tests : names out of ``Test 1`` to ``Test 4``
    design : how the hand moves (`simulate.DESIGNS`), instead of the presets' "far"
    seed, workers, journal, progress : as in `fig6`

    Raises
    ------
    DataError
        As in `fig6`.
    """
    _check(trials, seed)
    if unknown := [t for t in tests if t not in _table2.TESTS]:
        raise DataError(
            f"study: test {unknown[0]!r} is unknown; choose out of {', '.join(_table2.TESTS)}"
        )
    if not tests:
        raise DataError("study: no test is left")
    if not tests:
        raise DataError("study: no test is left")
    spec = {
        "tests": {
            name: {
                "cell": StudyCell(_table2.TESTS[name], design=design).to_plain(),
                "pixel_px": preset_named(_table2.TESTS[name]).noise.pixel_px,
            }
            for name in tests
        },
        "entropy": seed,
    }
    work = ("table2", _table2.table2_run, spec, trials * len(tests))
    results = _run(*work, workers, journal, progress)
    columns = tuple(test_columns(spec, results.values))
    as_paper = design in (None, preset_named(_table2.TESTS[tests[0]]).design)
    found = tuple(table2_findings(columns))
    return Study("table2", spec, results, {}, columns, found, as_paper)


def _run(
    name: str,
    function: Callable[[Mapping[str, Any], int], Any],
    spec: Mapping[str, Any],
    runs: int,
    workers: Workers | None,
    journal: str | Path | None,
    progress: Show | None,
) -> Results:
    work = Work(name, function, spec, runs)
    return run_all(work, workers, journal=journal, progress=progress, prepare=_compile_kernels)


@cache
def _compile_kernels() -> None:
    """Let another process compile the kernels, if nobody has: this one and all workers load them.

    The process that compiles may get another last digit than those that load, and with it another
    digest.
    """
    spec = {"cell": StudyCell().to_plain(), "levels": [0.5], "entropy": 0}
    apart(_fig6.fig6_run, {**spec, "methods": list(_fig6.METHODS[:6])}, 0)


def _check(trials: int, seed: int) -> None:
    for what, value, least in (("trials", trials, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise DataError(f"study: {what}: expected an integer >= {least}, got {value!r}")


def _check_numbers(what: str, values: Sequence[float], least: float) -> None:
    if not values or any(not least <= v < 1e6 for v in values):
        raise DataError(f"study: {what}: expected numbers >= {least:g}, got {list(values)}")
    if len(set(values)) < len(values):
        raise DataError(f"study: {what}: the same number twice in {list(values)}")
