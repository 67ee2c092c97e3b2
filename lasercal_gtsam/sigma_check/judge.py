"""From the errors of the trials to a verdict in plain words.

A row is blamed if its deviation is no chance (all tests together are wrong about a good calibration
in one check of a hundred; Bonferroni) and large enough to matter. The interval of a standard
deviation is that of Gaussian errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, bdtrc, gammainc, gammaincc, gammaincinv, ndtr, stdtr

from lasercal_gtsam.errors import SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.wording import some
from lasercal_gtsam.sigma_check.result import Coverage, NeesCheck, RowCheck, SigmaCheck

# probability that a good calibration is blamed, shared by the kinds of tests and then by the rows
FALSE_ALARM = 0.01
_KINDS = 5
# what does not matter, even where enough trials can tell it: ratio of scatter and sigma, bias in
# sigmas, share of the 95 % interval, normalised squared error per coordinate
TOLERATED_RATIO = 1.1
TOLERATED_BIAS = 0.25
TOLERATED_95 = (0.93, 0.97)
TOLERATED_NEES = 0.1
# share of solves that may fail
_TOLERATED_FAILURES = 0.01
_Z68, _Z95 = 1.0, 1.959963984540054
_P68, _P95 = 0.6826894921370859, 0.95
_FEWEST_SOLVED = 10
# below this many degrees of freedom the noise level itself is poorly known
_FEW_DOF = 30.0
_MOST_NAMES, _MOST_TOGETHER = 6, 3


@dataclass(frozen=True, eq=False)
class Trials:
    """Raw outcome.

    ``sigma`` (rows,) is stated; ``errors`` and ``own_sigma`` are (solved, rows); ``whitened``
    (solved, d) are errors of the whole vector with unit covariance if the stated one is right.
    ``combinations`` (d, n): what each whitened coordinate is made of, in sigmas of the tangent
    coordinates ``labels`` (n,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    sigma: Array
    errors: Array
    own_sigma: Array
    whitened: Array
    combinations: Array
    labels: tuple[str, ...]
    failures: dict[int, str]
    trials: int
    seed: int
    from_data: bool
    spots: int
    dof: float
    left_out: int
    rejected: int
    redrawn: int
    noise_px: float
    priors: tuple[str, ...]
    outliers: int


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
    rows = tuple(_row(run, i) for i in range(len(run.names)))
    nees = nees_check((run.whitened**2).sum(axis=1), run.whitened.shape[1])
    limit = FALSE_ALARM / (_KINDS * len(rows))
    problems = [
        *_spread_problems(run, rows, limit),
        *_bias_problems(run, rows, limit),
        *_coverage_problems(run, rows, limit),
    ]
    problems += [*_nees_problems(run, nees, bool(problems)), *_failure_problems(run)]
    resolution = math.sqrt(_chi2_quantile(1.0 - limit / 2.0, solved - 1) / (solved - 1))
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
        notes=tuple(_notes(run)),
    )
    object.__setattr__(check, "verdict", _verdict(check))
    return check


# --- statistics -------------------------------------------------------------------------------


def coverage(inside: int, trials: int, nominal: float) -> Coverage:
    """Share of intervals that held the truth, against what they promise."""
    share = inside / trials
    middle = (share + 0.5 / trials) / (1.0 + 1.0 / trials)
    half = math.sqrt(share * (1.0 - share) / trials + 0.25 / trials**2) / (1.0 + 1.0 / trials)
    at_most = float(bdtr(inside, trials, nominal))
    at_least = float(bdtrc(inside - 1, trials, nominal)) if inside else 1.0
    p = min(1.0, 2.0 * min(at_most, at_least))
    return Coverage(nominal, share, max(middle - half, 0.0), min(middle + half, 1.0), p)


def nees_check(nees: Array, dimension: int) -> NeesCheck:
    """Mean of the normalised squared errors with the 99 % band of chi-square."""
    n = len(nees)
    low, high = (_chi2_quantile(p, n * dimension) / n for p in (0.005, 0.995))
    return NeesCheck(float(nees.mean()), dimension, low, high, float(nees.max()))


def _chi2_quantile(p: float, dof: float) -> float:
    return float(2.0 * gammaincinv(dof / 2.0, p))


def _row(run: Trials, i: int) -> RowCheck:
    e, sigma, own = run.errors[:, i], float(run.sigma[i]), run.own_sigma[:, i]
    n = len(e)
    scatter = float(e.std(ddof=1))
    ratio, freedom = scatter / sigma, n - 1
    below = float(gammainc(freedom / 2.0, freedom * ratio**2 / 2.0))
    above = float(gammaincc(freedom / 2.0, freedom * ratio**2 / 2.0))
    low, high = (ratio / math.sqrt(_chi2_quantile(p, freedom) / freedom) for p in (0.975, 0.025))
    bias = float(e.mean()) / sigma
    error_of_bias = ratio / math.sqrt(n)
    return RowCheck(
        name=run.names[i],
        unit=run.units[i],
        sigma=sigma,
        scatter=scatter,
        ratio=ratio,
        ratio_low=low,
        ratio_high=high,
        ratio_p=min(1.0, 2.0 * min(below, above)),
        bias=bias,
        bias_p=float(2.0 * ndtr(-abs(bias) / error_of_bias)) if error_of_bias > 0 else 1.0,
        coverage_68=coverage(int((np.abs(e) <= _Z68 * sigma).sum()), n, _P68),
        coverage_95=coverage(int((np.abs(e) <= _Z95 * sigma).sum()), n, _P95),
        own_sigma=float(np.median(own)),
        own_coverage_95=coverage(int((np.abs(e) <= _Z95 * own).sum()), n, _P95),
    )


# --- words ------------------------------------------------------------------------------------


def _spread_problems(run: Trials, rows: Sequence[RowCheck], limit: float) -> list[str]:
    bad = [
        r
        for r in rows
        if r.ratio_p < limit and not 1 / TOLERATED_RATIO <= r.ratio <= TOLERATED_RATIO
    ]
    # the trials' own sigmas tell a wrong sigma in the file from a problem that bends
    wrong = [r for r in bad if not _near(r.own_sigma / r.sigma) and _near(r.scatter / r.own_sigma)]
    problems = []
    for few in (True, False):
        rest = [r for r in bad if r not in wrong and (r.ratio > 1.0) == few]
        if rest:
            problems.append(_bent(run, rest) if few else _pessimistic(rest))
    if wrong:
        problems.append(
            f"{_names(wrong, rows)}: spread {_factors(r.ratio for r in wrong)} times the sigma, "
            f"but what the trials state of themselves is right ({_factors(_own(wrong))} times "
            "the sigma): the stated sigmas are not those of these spots with these options; "
            "calibrate anew"
        )
    return problems


def _bent(run: Trials, rows: Sequence[RowCheck]) -> str:
    """Second-order terms grow with sigma; their share of the variance falls with the spots."""
    excess = max(r.ratio**2 for r in rows) - 1.0
    enough = run.spots * excess / (TOLERATED_RATIO**2 - 1.0)
    return (
        f"{_names(rows)}: spread {_factors(r.ratio for r in rows)} times the sigma: with "
        f"{run.spots} spots like these the problem bends within one sigma. {_from(enough)}; until "
        "then multiply the sigmas by these factors"
    )


def _pessimistic(rows: Sequence[RowCheck]) -> str:
    return (
        f"{_names(rows)}: spread only {_factors(r.ratio for r in rows)} times the sigma: the "
        "sigmas are larger than the errors, on the safe side"
    )


def _bias_problems(run: Trials, rows: Sequence[RowCheck], limit: float) -> list[str]:
    bad = [r for r in rows if r.bias_p < limit and abs(r.bias) > TOLERATED_BIAS]
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
    blamed = {
        r.name
        for r in rows
        if (r.ratio_p < limit and not _near(r.ratio))
        or (r.bias_p < limit and abs(r.bias) > TOLERATED_BIAS)
    }
    rest = [r for r in rows if r.name not in blamed]
    low, high = TOLERATED_95
    problems = []
    for which, words in (
        ("coverage_95", "the 95 % interval holds the truth in {} of the trials although the "
         "spread is right: the errors are not Gaussian"),
        ("coverage_68", "the 68 % interval holds the truth in {} of the trials although the "
         "spread is right: the errors are not Gaussian"),
    ):  # fmt: skip
        margin = (low, high) if which == "coverage_95" else (_P68 - 0.04, _P68 + 0.04)
        bad = [r for r in rest if _off(getattr(r, which), margin, limit)]
        if bad:
            shares = [getattr(r, which).share for r in bad]
            problems.append(f"{_names(bad)}: " + words.format(_percent(shares)))
    own = [r for r in rest if _off(r.own_coverage_95, TOLERATED_95, limit)]
    if own:
        shares = [r.own_coverage_95.share for r in own]
        expected = float(2.0 * stdtr(run.dof, _Z95) - 1.0) if run.dof < _FEW_DOF else _P95
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


def _nees_problems(run: Trials, nees: NeesCheck, rows_fail: bool) -> list[str]:
    per_coordinate = nees.mean / nees.dimension
    if nees.low <= nees.mean <= nees.high or abs(per_coordinate - 1.0) <= TOLERATED_NEES:
        return []
    moments = run.whitened.T @ run.whitened / len(run.whitened)
    values, vectors = np.linalg.eigh(moments)
    at = -1 if per_coordinate > 1.0 else 0
    together = np.abs(vectors[:, at] @ run.combinations)
    parts = [run.labels[i] for i in np.argsort(-together, kind="stable")[:_MOST_TOGETHER]]
    begin = "all together" if rows_fail else "each row holds by itself, but not all together"
    return [
        f"{begin}: the normalised squared error is {nees.mean:.1f} on the average, expected "
        f"{nees.dimension} (99 % band {nees.low:.1f} to {nees.high:.1f}); farthest off is a "
        f"combination of {', '.join(parts)}, spread {math.sqrt(values[at]):.2f} times what the "
        "joint covariance says: do not trust it for differences and ratios of these"
    ]


def _failure_problems(run: Trials) -> list[str]:
    failed = len(run.failures)
    if failed <= _TOLERATED_FAILURES * run.trials:
        return []
    first, why = next(iter(run.failures.items()))
    return [f"{failed} of {run.trials} solves failed, which no sigma tells (trial {first}: {why})"]


def _verdict(check: SigmaCheck) -> str:
    if check.problems:
        return "The sigmas do not all hold: " + "; ".join(check.problems) + "."
    widest = max(check.rows, key=lambda r: abs(math.log(max(r.ratio, 1e-9))))
    return (
        f"The sigmas hold: no row's spread differs from its sigma by more than chance allows (the "
        f"farthest is {widest.name}, {widest.ratio:.2f} times; up to {check.resolution:.2f} "
        f"{check.solved} trials cannot tell)."
    )


def _notes(run: Trials) -> list[str]:
    notes = []
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


def _own(rows: Sequence[RowCheck]) -> list[float]:
    return [r.own_sigma / r.sigma for r in rows]


def _t_quantile(dof: float) -> float:
    """97.5 % quantile of Student's t, by bisection on its distribution function."""
    low, high = 1.0, 1e3
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stdtr(dof, middle) < 0.975 else (low, middle)
    return high


def _names(rows: Sequence[RowCheck], everyone: Sequence[RowCheck] = ()) -> str:
    if len(rows) == len(everyone):
        return f"all {len(rows)} rows"
    return some([r.name for r in rows], _MOST_NAMES)


def _factors(values: object) -> str:
    numbers = sorted(values)  # type: ignore[call-overload]
    low, high = f"{numbers[0]:.2f}", f"{numbers[-1]:.2f}"
    return low if low == high else f"{low} to {high}"


def _percent(shares: Sequence[float]) -> str:
    low, high = f"{100 * min(shares):.1f}", f"{100 * max(shares):.1f}"
    return f"{low} %" if low == high else f"{low} to {high} %"


def _from(spots: float) -> str:
    """A number of spots with two digits, rounded up."""
    step = 10.0 ** max(math.floor(math.log10(max(spots, 1.0))) - 1, 0)
    return f"The sigmas hold from about {math.ceil(spots / step) * step:.0f} spots on"
