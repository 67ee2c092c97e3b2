"""Table 2: Initial | Refined | sigma of the paper's four tests, on simulated cells.

The cells are of the kind of the paper's (`simulate.cells.table2_cell`), the spots as many as its
tests had, the noise such that the RMS is its 2.5 px. A run is one capture of one test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.calibration import text_table
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.simulate import Noise
from lasercal_gtsam.study.cells import StudyCell
from lasercal_gtsam.study.fig6_runs import trial_seed
from lasercal_gtsam.study.outcome import finite_or_none
from lasercal_gtsam.study.printed import PRINTED_SIGMAS

TRIALS = 60
TESTS = {
    "Test 1": "table2-1",
    "Test 2": "table2-2",
    "Test 3": "table2-3",
    "Test 4": "table2-4",
}


def table2_run(spec: Mapping[str, Any], k: int) -> dict[str, Any]:
    """One capture of one test: its rows, or why there is no answer.

    Parameters
    ----------
    spec : ``tests`` (name -> {``cell``: `StudyCell.to_plain`, ``pixel_px``}), ``entropy``
    k : test ``k mod T`` of trial ``k div T``

    Returns
    -------
    dict
        ``rows``: name -> [truth, initial, refined, sigma] in the table's units, sigma 0 where held;
        ``rms_px``; or ``failed``: why.
    """
    tests: Mapping[str, Any] = spec["tests"]
    trial, name = k // len(tests), list(tests)[k % len(tests)]
    cell = StudyCell.from_plain(tests[name]["cell"])
    noise = Noise(pixel_px=tests[name]["pixel_px"])
    made = cell.simulated(trial_seed(spec["entropy"], trial), noise)
    try:
        found = calibrate(
            made.observations, options=CalibrationOptions(robust="none", known=made.known)
        )
    except LasercalError as error:
        return {"failed": str(error)}
    if not found.fit.converged:
        return {"failed": found.fit.status}
    charts = {name: BeamChart.of(beam) for name, beam in found.cell.lasers.items()}
    names = [name for name, _ in row_names(found.cell, charts)]
    truth = dict(zip(names, row_values(made.truth, charts).tolist(), strict=True))
    rows = {
        p.name: [truth[p.name], finite_or_none(p.initial), p.refined, p.sigma]
        for p in found.parameters
    }
    return {"rows": rows, "rms_px": found.fit.rms_px}


@dataclass(frozen=True)
class TestColumn:
    """One test.

    Attributes
    ----------
    name : of the test
    names, units : rows, as in Table 2
    truth, initial, refined, sigma : of the first capture with an answer, NaN where not defined
    median_sigma : over all captures
    spread : standard deviation of refined - truth over all captures
    printed : the paper's sigma, NaN where not known
    rms_px : of the first capture; ``median_rms_px`` over all
    captures, failed : how many, and why some gave no answer
    """

    name: str
    names: tuple[str, ...]
    truth: tuple[float, ...]
    initial: tuple[float, ...]
    refined: tuple[float, ...]
    sigma: tuple[float, ...]
    median_sigma: tuple[float, ...]
    spread: tuple[float, ...]
    printed: tuple[float, ...]
    rms_px: float
    median_rms_px: float
    captures: int
    failed: tuple[str, ...]

    def ratio(self, row: str) -> float:
        """Median sigma over the printed one; NaN where that is not known."""
        i = self.names.index(row)
        return self.median_sigma[i] / self.printed[i]

    def table(self) -> str:
        """Text, with the RMS as the last row."""
        head = ("", "Truth", "Initial", "Refined", "sigma", "median", "spread", "printed")
        lines: list[tuple[str, ...]] = [head]
        for i, name in enumerate(self.names):
            values = (
                self.truth[i],
                self.initial[i],
                self.refined[i],
                self.sigma[i],
                self.median_sigma[i],
                self.spread[i],
                self.printed[i],
            )
            lines.append((name, *(_number(v, j > 2) for j, v in enumerate(values))))
        rms = (f"{self.rms_px:.2f}", "", f"{self.median_rms_px:.2f}", "", "2.5")
        lines.append(("RMS", "", "", *rms))
        title = f"{self.name}: {self.captures} captures, {len(self.failed)} without an answer"
        return title + "\n" + text_table(lines)


def test_columns(spec: Mapping[str, Any], values: Sequence[Mapping[str, Any]]) -> list[TestColumn]:
    """Put the runs of `table2_run` together, a column for each test."""
    tests = list(spec["tests"])
    return [
        _column(name, [v for k, v in enumerate(values) if k % len(tests) == i])
        for i, name in enumerate(tests)
    ]


def _column(name: str, runs: Sequence[Mapping[str, Any]]) -> TestColumn:
    good = [run for run in runs if "rows" in run]
    failed = tuple(str(run["failed"]) for run in runs if "failed" in run)
    if not good:
        none: tuple[float, ...] = ()
        return TestColumn(
            name, (), none, none, none, none, none, none, none, np.nan, np.nan, len(runs), failed
        )
    names = tuple(n for n in good[0]["rows"] if all(n in run["rows"] for run in good))
    data = np.array(
        [[[np.nan if v is None else v for v in run["rows"][n]] for n in names] for run in good]
    )
    truth, _, refined, sigma = (data[..., i] for i in range(4))
    printed = PRINTED_SIGMAS.get(name, {})
    error = _wrapped(refined - truth, names)
    spread = error.std(axis=0, ddof=1) if len(good) > 1 else np.full(len(names), np.nan)
    true, initial, best, own = (_floats(column) for column in data[0].T)
    return TestColumn(
        name=name,
        names=names,
        truth=true,
        initial=initial,
        refined=best,
        sigma=own,
        median_sigma=_floats(np.median(sigma, axis=0)),
        spread=_floats(spread),
        printed=tuple(printed.get(n, float("nan")) for n in names),
        rms_px=float(good[0]["rms_px"]),
        median_rms_px=float(np.median([run["rms_px"] for run in good])),
        captures=len(runs),
        failed=failed,
    )


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(map(float, values))


def _wrapped(difference: Array, names: Sequence[str]) -> Array:
    """Differences of angles in degrees within +-180."""
    angles = [n.split(".")[-1] in ("theta", "phi", "psi") or n.startswith("laser_t") for n in names]
    out = difference.copy()
    out[:, angles] = (out[:, angles] + 180.0) % 360.0 - 180.0
    return out


def _number(value: float, short: bool) -> str:
    if not np.isfinite(value):
        return ""
    return f"{value:.3g}" if short else f"{value:.5g}"
