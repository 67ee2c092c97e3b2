"""What a study says about the paper's claims, as sentences with their evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.study.errors import QUANTITIES
from lasercal_gtsam.study.fig6_runs import (
    HAND_NOISE,
    HORAUD,
    MA,
    MA_REFINED,
    MALM,
    MALM_REFINED,
    PAPER_CLOSED,
    REFINED,
    TRIANGULATION,
)
from lasercal_gtsam.study.outcome import ErrorCurves
from lasercal_gtsam.study.printed import EXPLAINED, ONE_PLANE
from lasercal_gtsam.study.reference import (
    FIG6_LEVELS,
    FIG6_MEANS,
    FIG7_REFINED_MEANS,
    FIG7_SAMPLES,
)
from lasercal_gtsam.study.table2_runs import TestColumn

EXACT = 1e-8
WITHIN = 0.15
_FACTOR = 2.0


@dataclass(frozen=True)
class Finding:
    """One claim: whether it holds here, and the numbers behind it.

    ``holds`` is None where the trials are too few to say: off, but within two standard errors.
    """

    claim: str
    holds: bool | None
    evidence: str


def fig6_findings(curves: ErrorCurves, as_paper: bool = True) -> list[Finding]:
    """The orderings of the paper's Fig. 6; in its cell also the distance to the reference."""
    found = [*_exact(curves), *_orderings(curves)]
    return [*found, *_against_reference(curves)] if as_paper else found


def _exact(curves: ErrorCurves) -> list[Finding]:
    if 0.0 not in curves.at:
        return []
    x = curves.at.index(0.0)
    worst = [
        (float(np.nan_to_num(curves.errors[x, m], nan=np.inf).max()), method)
        for m, method in enumerate(curves.methods)
        if curves.asked[x, m]
    ]
    largest, method = max(worst)
    return [
        Finding(
            f"without noise every method returns the truth to {EXACT:g}",
            largest < EXACT,
            f"largest relative error {largest:.1e} ({method})",
        )
    ]


def _orderings(curves: ErrorCurves) -> list[Finding]:
    claims = (
        ("the refined laser method is ahead of Ma's closed form", REFINED, MA, QUANTITIES),
        ("the refined laser method is ahead of Malm and Heyden's", REFINED, MALM, QUANTITIES),
        (
            "the refined laser method is best in T, against refined competitors too",
            REFINED,
            (MA, MA_REFINED, MALM, MALM_REFINED),
            ("T",),
        ),
        (
            "refining Ma's method brings its R below the laser method's",
            MA_REFINED,
            REFINED,
            ("R",),
        ),
        (
            "the laser method is ahead of refined Ma and of Horaud and Dornaika in f_u",
            REFINED,
            (MA_REFINED, HORAUD),
            ("f_u",),
        ),
        (
            "the laser method's triangulation form is a better start than the paper's closed form",
            TRIANGULATION,
            PAPER_CLOSED,
            QUANTITIES,
        ),
        (
            "modelling the robot's noise improves the laser method",
            HAND_NOISE,
            REFINED,
            QUANTITIES,
        ),
        (
            "with robot noise modelled the laser method is best in T",
            HAND_NOISE,
            (REFINED, MA, MA_REFINED, MALM, MALM_REFINED),
            ("T",),
        ),
        (
            "with robot noise modelled it is best in f_u from level 0.6 on",
            HAND_NOISE,
            (REFINED, MA, MA_REFINED, MALM, MALM_REFINED, HORAUD),
            ("f_u",),
        ),
    )
    found = []
    for claim, better, others, quantities in claims:
        rivals = (others,) if isinstance(others, str) else others
        lowest = 0.6 if "from level 0.6" in claim else 0.0
        finding = _is_ahead(curves, claim, better, rivals, quantities, lowest)
        if finding is not None:
            found.append(finding)
    return found


def _is_ahead(
    curves: ErrorCurves,
    claim: str,
    better: str,
    rivals: Sequence[str],
    quantities: Sequence[str],
    lowest: float,
) -> Finding | None:
    """Compare means level by level; None where one of the methods was not run."""
    places = [x for x, at in enumerate(curves.at) if at > 0 and at >= lowest]

    def was_run(method: str) -> bool:
        return method in curves.methods and bool(curves.asked[places, curves.row(method)].all())

    if not places or not all(map(was_run, (better, *rivals))):
        return None
    mean, error, b = curves.mean, curves.standard_error, curves.row(better)
    won, ratios, clearly_behind = 0, [], False
    for x in places:
        for quantity in quantities:
            q = QUANTITIES.index(quantity)
            best = min((curves.row(r) for r in rivals), key=lambda m: _or_inf(mean[x, m, q]))
            ours, theirs = _or_inf(mean[x, b, q]), _or_inf(mean[x, best, q])
            ratios.append(ours / theirs if np.isfinite(theirs) else 0.0)
            won += ours < theirs
            doubt = 2.0 * float(np.hypot(error[x, b, q], error[x, best, q]))
            clearly_behind |= ours - theirs > doubt or not np.isfinite(ours)
    return Finding(
        claim,
        True if won == len(ratios) else False if clearly_behind else None,
        f"ahead at {won} of {len(ratios)} points (levels x {', '.join(quantities)}); error "
        f"{min(ratios):.2f} to {max(ratios):.2f} times the best of {', '.join(rivals)}",
    )


def _or_inf(value: float) -> float:
    """An error of a method that failed in every trial is larger than any."""
    return float(value) if np.isfinite(value) else float("inf")


def _against_reference(curves: ErrorCurves) -> list[Finding]:
    found = []
    mean, error = curves.mean, curves.standard_error
    for method, by_quantity in FIG6_MEANS.items():
        if method not in curves.methods:
            continue
        m = curves.row(method)
        gaps = [
            _gap(mean[curves.at.index(level), m, q], error[curves.at.index(level), m, q], expected)
            for quantity, means in by_quantity.items()
            for q in (QUANTITIES.index(quantity),)
            for level, expected in zip(FIG6_LEVELS, means, strict=True)
            if level in curves.at
        ]
        if gaps:
            found.append(_reference_finding(f"{method}: means", gaps))
    return found


def _gap(mean: float, error: float, expected_percent: float) -> tuple[float, float]:
    """Relative difference to the reference, and its standard error (of both, equal trials)."""
    value = 100.0 * mean
    return value / expected_percent - 1.0, np.sqrt(2.0) * 100.0 * error / expected_percent


def _reference_finding(what: str, gaps: Sequence[tuple[float, float]]) -> Finding:
    near = sum(abs(gap) <= WITHIN for gap, _ in gaps)
    beyond = any(abs(gap) > WITHIN + 2.0 * doubt for gap, doubt in gaps)
    worst, doubt = max(gaps, key=lambda pair: abs(pair[0]))
    return Finding(
        f"{what} within {100 * WITHIN:.0f} % of the reference",
        True if near == len(gaps) else False if beyond else None,
        f"{near} of {len(gaps)}; median difference "
        f"{100 * float(np.median([gap for gap, _ in gaps])):+.0f} %, farthest "
        f"{100 * worst:+.0f} % with a standard error of {100 * doubt:.0f} %",
    )


def fig7_findings(cases: Mapping[str, ErrorCurves], as_paper: bool = True) -> list[Finding]:
    """More samples, more planes; in the paper's cell also the distance to the reference."""
    found = []
    for name, curves in cases.items():
        if REFINED not in curves.methods or len(curves.at) < 2:
            continue
        line = _refined_fu(curves)
        error = curves.standard_error[:, curves.row(REFINED), 0]
        step, doubt = np.diff(line), 2.0 * np.hypot(error[1:], error[:-1])
        found.append(
            Finding(
                f"{name}: the refined error of f_u falls with the samples",
                True if (step < 0).all() else False if (step > doubt).any() else None,
                ", ".join(
                    f"{100 * v:.3g} % at {at:g}" for at, v in zip(curves.at, line, strict=True)
                ),
            )
        )
    known = {name for name, curves in cases.items() if REFINED in curves.methods}
    several = [n for n in ("2 planes", "3 planes") if n in known]
    alone = [n for n in ("1 plane (a_1)", "1 plane (a_2)") if n in known and several]
    found += [_one_above_several(one, several, cases) for one in alone]
    if not as_paper:
        return found
    for name, expected in FIG7_REFINED_MEANS.items():
        if name in known:
            curves = cases[name]
            m, errors = curves.row(REFINED), curves.standard_error
            gaps = [
                _gap(curves.mean[x, m, 0], errors[x, m, 0], reference)
                for n, reference in zip(FIG7_SAMPLES, expected, strict=True)
                if n in curves.at and np.isfinite(reference)
                for x in (curves.at.index(n),)
            ]
            if gaps:
                found.append(_reference_finding(f"{name}, refined: means", gaps))
    return found


def _refined_fu(curves: ErrorCurves) -> np.ndarray:
    return np.asarray(curves.mean[:, curves.row(REFINED), 0])


def _one_above_several(
    one: str, several: Sequence[str], cases: Mapping[str, ErrorCurves]
) -> Finding:
    alone = cases[one]
    pairs, clearly_below = [], False
    for curves in map(cases.__getitem__, several):
        for x, at in enumerate(curves.at):
            if at in alone.at:
                y, m, n = alone.at.index(at), alone.row(REFINED), curves.row(REFINED)
                ours, theirs = _or_inf(alone.mean[y, m, 0]), _or_inf(curves.mean[x, n, 0])
                doubt = np.hypot(alone.standard_error[y, m, 0], curves.standard_error[x, n, 0])
                clearly_below |= bool(theirs - ours > 2.0 * doubt) or not np.isfinite(theirs)
                exact = theirs == 0.0  # without noise there is nothing to compare
                pairs.append((1.0 if exact else ours / theirs if np.isfinite(theirs) else 0.0, at))
    above = sum(ratio > 1.0 for ratio, _ in pairs)
    low, at = min(pairs)
    return Finding(
        f"{one} is less exact than several planes",
        True if above == len(pairs) else False if clearly_below else None,
        f"at {above} of {len(pairs)} points; smallest ratio {low:.2f} at {at:g} samples",
    )


def table2_findings(columns: Sequence[TestColumn]) -> list[Finding]:
    """Median sigmas against the printed ones, row by row and by blocks."""
    found = []
    for column in columns:
        rows = [n for n in column.names if np.isfinite(column.ratio(n)) and column.ratio(n) > 0]
        if not rows:
            continue
        ratios = {n: column.ratio(n) for n in rows}
        off = [n for n, r in ratios.items() if not 1 / _FACTOR <= r <= _FACTOR]
        known = EXPLAINED if any(n.startswith("a_2") for n in column.names) else {}
        explained = [n for n in off if n in known and known[n].covers(ratios[n])]
        text = ", ".join(f"{n} {ratios[n]:.2f}" for n in off) or "none"
        why = _reasons(explained) if known else ONE_PLANE
        found.append(
            Finding(
                f"{column.name}: median sigmas within a factor of two of the printed ones"
                + (", but for rows with a reason" if known else ""),
                set(off) == set(explained),
                f"{len(rows) - len(off)} of {len(rows)} rows within; others (ratio): {text}"
                + (f". {why}" if off else ""),
            )
        )
        found += _blocks(column)
    return found


def _reasons(rows: Sequence[str]) -> str:
    """Each reason once, behind the rows that it covers."""
    by_reason: dict[str, list[str]] = {}
    for name in rows:
        by_reason.setdefault(EXPLAINED[name].why, []).append(name)
    return "; ".join(f"{', '.join(names)}: {why}" for why, names in by_reason.items())


def _blocks(column: TestColumn) -> list[Finding]:
    """Sigmas of a vector together: what does not depend on the direction of axes."""
    blocks = {
        "planes": [n for n in column.names if n.startswith("a_")],
        "camera rotation": ["theta", "phi", "psi"],
        "beam point": [n for n in column.names if n.startswith("laser_") and n[-1] in "xyz"],
    }
    found = []
    for what, rows in blocks.items():
        index = [column.names.index(n) for n in rows if n in column.names]
        printed = np.array([column.printed[i] for i in index])
        if len(index) and np.isfinite(printed).all():
            ours = np.array([column.median_sigma[i] for i in index])
            ratio = float(np.linalg.norm(ours) / np.linalg.norm(printed))
            found.append(
                Finding(
                    f"{column.name}: sigmas of the {what} together within a factor of two",
                    1 / _FACTOR <= ratio <= _FACTOR,
                    f"ratio {ratio:.2f}",
                )
            )
    return found
