"""From the errors of the trials to a verdict in plain words.

What is blamed is no chance and large enough to matter. First the whole vector is judged, by its
mean normalised squared error; then every row. Unless the whole vector has failed already, the rows
share one false alarm in a hundred checks of a good calibration (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtr

from lasercal_gtsam.errors import SolveError
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.sigma_check.result import Coverage, NeesCheck, RowCheck, SigmaCheck
from lasercal_gtsam.sigma_check.statistics import (
    P95,
    Z95,
    Trials,
    chi2_quantile,
    nees_check,
    row_check,
)

# probability that any row of a good calibration is blamed, shared by the tests and the rows; and
# that of a single test where the whole vector has failed, so that something must be wrong
FALSE_ALARM = 0.01
_KINDS = 5
_SUSPECT = 0.002
# what does not matter, even where enough trials can tell it: ratio of scatter and sigma, bias in
# sigmas, shares of the 68 % and the 95 % intervals, normalised squared error per coordinate
TOLERATED_RATIO = 1.1
TOLERATED_BIAS = 0.25
TOLERATED_68, TOLERATED_95 = (0.64, 0.725), (0.93, 0.97)
TOLERATED_NEES = 0.1
# share of solves that may fail
_TOLERATED_FAILURES = 0.01
_FEWEST_SOLVED = 10
# below this many degrees of freedom the noise level itself is poorly known
_FEW_DOF = 30.0
_MOST_NAMES, _MOST_TOGETHER = 6, 3


def judged(run: Trials) -> SigmaCheck:
    """Statistics of the trials, and what they mean.

    Raises
    ------
    SolveError
        Too few trials have a solution to say anything.
    """
    solved = len(run.errors)
    if solved < _FEWEST_SOLVED:
        first, why = next(iter(run.failures.items()))
        raise SolveError(
            f"check-sigma: {len(run.failures)} of {run.trials} trials have no solution, too many "
            f"to say anything about sigmas; trial {first}: {why}"
        )
    rows = tuple(row_check(run, i) for i in range(len(run.names)))
    nees = nees_check((run.whitened**2).sum(axis=1), run.whitened.shape[1])
    strict = FALSE_ALARM / (_KINDS * len(rows))
    limit = _SUSPECT if _fails(nees) else strict
    problems = [
        *_file_problems(rows),
        *_spread_problems(run, rows, limit),
        *_bias_problems(run, rows, limit),
        *_coverage_problems(run, rows, limit),
    ]
    problems += [*_nees_problems(run, nees, bool(problems)), *_failure_problems(run)]
    resolution = math.sqrt(chi2_quantile(1.0 - strict / 2.0, solved - 1) / (solved - 1))
    check = SigmaCheck(
        holds=not problems,
        problems=tuple(problems),
        verdict="",
        rows=rows,
        nees=nees,
        trials=run.trials,
        solved=solved,
        failures=run.failures,
        seed=run.seed,
        from_data=run.from_data,
        spots=run.spots,
        left_out=run.left_out,
        rejected=run.rejected,
        redrawn=run.redrawn,
        noise_px=run.noise_px,
        resolution=resolution,
        notes=tuple(_notes(run, nees)),
    )
    return replace(check, verdict=_verdict(check))


# --- words ------------------------------------------------------------------------------------


def _file_problems(rows: Sequence[RowCheck]) -> list[str]:
    """Stated sigmas that the same spots and options do not give: no question of chance."""
    wrong = [r for r in rows if _wrong(r)]
    if not wrong:
        return []
    return [
        f"{_names(wrong, rows)}: the stated sigma is not what the calibration's spots give with "
        f"its options when they are solved at once; that is "
        f"{_factors([r.expected_sigma / r.sigma for r in wrong])} times as large. Calibrate anew"
    ]


def _wrong(row: RowCheck) -> bool:
    return not _near(row.expected_sigma / row.sigma)


def _spread_problems(run: Trials, rows: Sequence[RowCheck], limit: float) -> list[str]:
    bad = [r for r in rows if _spread_is_off(r, limit) and not _wrong(r)]
    problems = []
    if wide := [r for r in bad if r.ratio > 1.0]:
        problems.append(_bent(run, wide, rows))
    if narrow := [r for r in bad if r.ratio < 1.0]:
        problems.append(
            f"{_names(narrow, rows)}: spread only {_factors([r.ratio for r in narrow])} times the "
            "sigma: the sigmas are larger than the errors, on the safe side"
        )
    return problems


def _spread_is_off(row: RowCheck, limit: float) -> bool:
    return row.ratio_p < limit and not _near(row.ratio)


def _bias_is_off(row: RowCheck, limit: float) -> bool:
    return row.bias_p < limit and abs(row.bias) > TOLERATED_BIAS


def _bent(run: Trials, wide: Sequence[RowCheck], rows: Sequence[RowCheck]) -> str:
    """Second-order terms grow with sigma; their share of the variance falls with the spots."""
    excess = max(r.ratio**2 for r in wide) - 1.0
    enough = run.spots * excess / (TOLERATED_RATIO**2 - 1.0)
    return (
        f"{_names(wide, rows)}: spread {_factors([r.ratio for r in wide])} times the sigma: with "
        f"{run.spots} spots like these the problem bends within one sigma. {_from(enough)}; until "
        "then multiply the sigmas by these factors"
    )


def _bias_problems(run: Trials, rows: Sequence[RowCheck], limit: float) -> list[str]:
    bad = [r for r in rows if _bias_is_off(r, limit) and not _wrong(r)]
    if not bad:
        return []
    enough = run.spots * (max(abs(r.bias) for r in bad) / TOLERATED_BIAS) ** 2
    values = ", ".join(f"{r.name} by {r.bias:+.2f}" for r in bad[:_MOST_NAMES])
    more = f" and {len(bad) - _MOST_NAMES} more" if len(bad) > _MOST_NAMES else ""
    return [
        f"biased, in sigmas: {values}{more}: on the average of many calibrations like this one "
        f"the estimate is off by as much. {_from(enough)}"
    ]


def _coverage_problems(run: Trials, rows: Sequence[RowCheck], limit: float) -> list[str]:
    """Intervals that fail where neither spread nor bias says why."""
    blamed = [_spread_is_off(r, limit) or _bias_is_off(r, limit) or _wrong(r) for r in rows]
    rest = [r for r, known in zip(rows, blamed, strict=True) if not known]
    low, _ = TOLERATED_95
    problems = []
    for promise, found, tolerated in (
        ("68", [r.coverage_68 for r in rest], TOLERATED_68),
        ("95", [r.coverage_95 for r in rest], TOLERATED_95),
    ):
        bad = [(r, c) for r, c in zip(rest, found, strict=True) if _off(c, tolerated, limit)]
        if bad:
            problems.append(
                f"{_names([r for r, _ in bad], rows)}: the {promise} % interval holds the truth in "
                f"{_percent([c.share for _, c in bad])} of the trials although the spread is "
                "right: the errors are not Gaussian"
            )
    own = [r for r in rest if _off(r.own_coverage_95, TOLERATED_95, limit)]
    if own:
        shares = [r.own_coverage_95.share for r in own]
        expected = float(2.0 * stdtr(run.dof, Z95) - 1.0) if run.dof < _FEW_DOF else P95
        why = (
            f"the noise itself is estimated from {run.dof:.0f} degrees of freedom only; take "
            f"{_t_quantile(run.dof):.2f} sigmas for 95 %, or add spots"
            if expected < low
            else "how large the sigma comes out depends on the noise; add spots"
        )
        problems.append(
            f"{_names(own, rows)}: the 95 % interval that each trial states of itself holds the "
            f"truth in {_percent(shares)}: {why}"
        )
    return problems


def _fails(nees: NeesCheck) -> bool:
    """Whether the mean is farther out than its chance and what is tolerated, both together."""
    low, high = nees.low * (1.0 - TOLERATED_NEES), nees.high * (1.0 + TOLERATED_NEES)
    return not low <= nees.mean <= high


def _nees_problems(run: Trials, nees: NeesCheck, rows_fail: bool) -> list[str]:
    if not _fails(nees):
        return []
    found = nees.mean / nees.dimension
    begin = "all rows together" if rows_fail else "no row alone, but all together"
    begin += (
        f": the normalised squared error is {nees.mean:.1f} on the average, expected "
        f"{nees.dimension} (99 % band {nees.low:.1f} to {nees.high:.1f})"
    )
    if not _near(math.sqrt(run.volume)):
        return [
            f"{begin}: the stated covariance is not what the calibration's spots give with its "
            f"options when they are solved at once; that is {run.volume:.2f} times as large. "
            "Calibrate anew"
        ]
    if found < 1.0:
        return [f"{begin}: the joint covariance is larger than the errors, on the safe side"]
    enough = run.spots * (found - 1.0) / TOLERATED_NEES
    return [f"{begin}{_farthest(run)}. {_from(enough, 'joint covariance holds')}"]


def _farthest(run: Trials) -> str:
    """The combination that is spread most, if that is more than the largest of many by chance."""
    solved, dimension = run.whitened.shape
    values, vectors = np.linalg.eigh(run.whitened.T @ run.whitened / solved)
    spread = math.sqrt(values[-1])
    if spread < TOLERATED_RATIO * (1.0 + math.sqrt(dimension / solved)):
        return ""
    together = np.abs(vectors[:, -1] @ run.combinations)
    parts = [run.labels[i] for i in np.argsort(-together, kind="stable")[:_MOST_TOGETHER]]
    return (
        f"; farthest off is a combination of {', '.join(parts)}, spread {spread:.2f} times what "
        "the joint covariance says: do not trust it for differences of these"
    )


def _failure_problems(run: Trials) -> list[str]:
    failed = len(run.failures)
    if failed <= _TOLERATED_FAILURES * run.trials:
        return []
    first, why = next(iter(run.failures.items()))
    return [f"{failed} of {run.trials} solves failed, which no sigma tells (trial {first}: {why})"]


def _verdict(check: SigmaCheck) -> str:
    if check.problems:
        return "The sigmas do not all hold. " + ". ".join(check.problems) + "."
    widest = max(check.rows, key=lambda r: abs(math.log(max(r.ratio, 1e-9))))
    return (
        f"The sigmas hold: no row's spread differs from its sigma by more than chance allows (the "
        f"farthest is {widest.name}, {widest.ratio:.2f} times; up to {check.resolution:.2f} "
        f"{check.solved} trials cannot tell)."
    )


def _notes(run: Trials, nees: NeesCheck) -> list[str]:
    notes = []
    if not (nees.low <= nees.mean <= nees.high or _fails(nees)):
        notes.append(
            f"the normalised squared error is outside its band, but within {TOLERATED_NEES:.0%} "
            "of it: the joint covariance is off by no more than matters"
        )
    if run.priors:
        notes.append(
            f"there are priors ({some(run.priors)}): their sigmas promise to hold on the average "
            "over the truths that the priors allow, so each trial draws anew what the priors say, "
            "about the estimate; at one fixed truth such an estimate scatters less, and is biased "
            "towards the priors"
        )
    if run.outliers:
        notes.append(
            f"{run.outliers} spots lie farther off than noise explains; they stay as far off in "
            "the trials, each time in another direction"
        )
    if run.failures:
        first, why = next(iter(run.failures.items()))
        notes.append(
            f"{len(run.failures)} of {run.trials} trials have no solution and are left out of the "
            f"numbers (trial {first}: {why})"
        )
    if run.redrawn:
        notes.append(f"{run.redrawn} simulated spots were drawn again: no spot could be there")
    return notes


def _near(ratio: float) -> bool:
    return 1 / TOLERATED_RATIO <= ratio <= TOLERATED_RATIO


def _off(found: Coverage, margin: tuple[float, float], limit: float) -> bool:
    return found.p_value < limit and not margin[0] <= found.share <= margin[1]


def _t_quantile(dof: float) -> float:
    """97.5 % quantile of Student's t, by bisection on its distribution function."""
    low, high = 1.0, 1e3
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stdtr(dof, middle) < 0.975 else (low, middle)
    return high


def _names(rows: Sequence[RowCheck], everyone: Sequence[RowCheck]) -> str:
    if len(rows) == len(everyone):
        return f"all {len(rows)} rows"
    if 2 * len(rows) > len(everyone) > _MOST_NAMES:
        return f"{len(rows)} of {len(everyone)} rows ({some([r.name for r in rows], _MOST_NAMES)})"
    return some([r.name for r in rows], _MOST_NAMES)


def _factors(values: Sequence[float]) -> str:
    low, high = f"{min(values):.2f}", f"{max(values):.2f}"
    return low if low == high else f"{low} to {high}"


def _percent(shares: Sequence[float]) -> str:
    low, high = f"{100 * min(shares):.1f}", f"{100 * max(shares):.1f}"
    return f"{low} %" if low == high else f"{low} to {high} %"


def _from(spots: float, what: str = "sigmas hold") -> str:
    """A number of spots with two digits, rounded up."""
    step = 10.0 ** max(math.floor(math.log10(max(spots, 1.0))) - 1, 0)
    return f"The {what} from about {math.ceil(spots / step) * step:.0f} spots on"
