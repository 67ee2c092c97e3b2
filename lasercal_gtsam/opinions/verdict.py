"""Good, weak or bad: one verdict on a calibration, with its reasons and what to do next.

``bad``: do not use it. ``weak``: usable with care; the reasons say where. ``good``: nothing speaks
against it. Every threshold below is a named constant with its reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lasercal_gtsam.calibration import Calibration, SpotResults
from lasercal_gtsam.check.picture import coverage, lines_of_spots
from lasercal_gtsam.check.weakness import POOR, parts_in_words
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.observability import RangeSvd
from lasercal_gtsam.opinions.bench import Bench, lay_out, orientation_groups
from lasercal_gtsam.opinions.chances import chi2_above
from lasercal_gtsam.opinions.groups import LeftOut, leave_groups_out
from lasercal_gtsam.opinions.levels import Level, levels
from lasercal_gtsam.opinions.residual_tests import ResidualTest, question_residuals
from lasercal_gtsam.opinions.split import Split, split
from lasercal_gtsam.opinions.suspects import FAULT_CHANCE, Finding, accuse, culprit, rivals
from lasercal_gtsam.options import DISTORTION_NAMES
from lasercal_gtsam.solve import fold_warnings

Grade = Literal["good", "weak", "bad"]
Severity = Literal["bad", "weak", "note"]

MANY_REJECTED, MOST_REJECTED = 0.1, 0.3
"""Share of spots left out. Ghosts and reflections spoil a few in a hundred; from one in ten on the
pictures deserve a look. Beyond 30 % robust estimation is measured to lose its way."""
NOISY, TOO_NOISY = 1.5, 3.0
"""Residuals over stated noise. Sigmas are widened by the factor, which is right for noise that was
stated too small; from 1.5 on something else is likelier, at 3 nine tenths of the variance have
another cause."""
QUIET = 0.5
"""Residuals over stated noise below which the statement is worth correcting."""
TOO_FAR = 0.01
"""RMS over the picture's diagonal where no noise is stated: no detector is as bad as that."""
BIG_FAULT = 1.5
"""Noise with a fault over noise without it: from here on more than half of the variance is the
fault, and the sigmas, which take it for noise, mean nothing."""
FEW_DOF = 20
"""Degrees of freedom below which the noise is known to worse than 16 %, and so all sigmas."""
FEW_FIELDS = 4
"""Fields of the picture (of 12) with spots: fewer lie in a corner, and the lens is extrapolated."""
ASTRAY = 1.5
"""Error of the prediction of a group over what is expected: robot noise that nobody stated makes
groups differ by a third (measured at 1 mm and 0.05 deg), and that is no fault."""
GROUP_SIZE = 4
"""Spots of a group from which on it is told that most of them were left out."""
UNCHECKED = 1.9
"""Leverage (of 2) of a spot that the fit follows wherever it is."""
MOST_SPOTS = 2000
"""Spots of which the residuals are questioned: the noise of so many is known to 1 %, and the time
that the questions take grows faster than their number."""
WORTH_A_LOOK = 0.01
"""Chance of a fault from which on it is mentioned, without lowering the grade."""
UNLIKELY = FAULT_CHANCE
"""Chance below which a test speaks against a calibration."""

_LOOK = "Let 'lasercal check' look for the cause in the capture."
_ORDER: dict[str, int] = {"bad": 0, "weak": 1, "note": 2}


@dataclass(frozen=True)
class Reason:
    """One reason: its kind (`code`), how much it weighs, in words, and what to do about it."""

    code: str
    severity: Severity
    words: str
    action: str


@dataclass(frozen=True)
class Opinions:
    """What the verdict rests on; empty where there is no noise to judge by.

    Attributes
    ----------
    findings : faults looked for, the likeliest first
    levels : residuals at levels
    left_out : groups as the others predict them
    tests : of the residuals
    split : the halves; None if not asked for
    spots : how many spots they were asked of: of very many, an even sample
    """

    findings: tuple[Finding, ...] = ()
    levels: tuple[Level, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    tests: tuple[ResidualTest, ...] = ()
    split: Split | None = None
    spots: int = 0


@dataclass(frozen=True)
class Verdict:
    """The verdict.

    Attributes
    ----------
    grade : ``good``, ``weak`` or ``bad``
    reasons : the weightiest first; notes, which do not lower the grade, last
    next_action : what to do, in one sentence
    opinions : what it rests on
    """

    grade: Grade
    reasons: tuple[Reason, ...]
    next_action: str
    opinions: Opinions


def judge(
    calibration: Calibration,
    *,
    halves: bool = False,
    parts: tuple[Calibration, Calibration] | None = None,
) -> Verdict:
    """Judge a calibration.

    Of more than `MOST_SPOTS` spots the residuals are questioned on an even sample; the geometry,
    the noise and the halves are those of all.

    Parameters
    ----------
    calibration : as `calibrate` returns it or `load_calibration` reads it
    halves : also calibrate two halves of the spots and compare them (two more fits)
    parts : these halves, where they are at hand (`split.fit_halves`)

    Returns
    -------
    Verdict
    """
    if not len(calibration.inputs.observations):
        return _unheld(calibration)
    reasons = list(_of_fit(calibration))
    opinions = Opinions()
    try:
        bench = lay_out(calibration)
    except DataError as error:
        reasons.append(Reason("unchecked", "bad", str(error), "Take more spots."))
    else:
        if bench.exact:
            words = "the residuals are rounding: there is no noise to judge by (simulated data?)"
            reasons.append(Reason("exact", "note", words, "Judge a real capture."))
        else:
            opinions = _opinions(calibration, bench, halves or parts is not None, parts)
            reasons += _of_opinions(opinions)  # a named cause before its effect
            if opinions.spots < len(bench):
                words = (
                    f"the residuals were questioned on an even sample of {opinions.spots} of the "
                    f"{len(bench)} spots"
                )
                reasons.append(Reason("sample", "note", words, "Nothing is to be done."))
            reasons += _of_noise(calibration, bench)
        reasons += _of_geometry(bench)
    reasons += _of_coverage(calibration)
    reasons.sort(key=lambda reason: _ORDER[reason.severity])
    worst = reasons[0].severity if reasons else "note"
    grade: Grade = "good" if worst == "note" else worst
    action = reasons[0].action if grade != "good" else "Use it."
    return Verdict(grade, tuple(reasons), action, opinions)


def _unheld(calibration: Calibration) -> Verdict:
    """Of a calibration that does not hold its spots: there is nothing to check it by."""
    action = "Judge the calibration that holds the spots, or take some to check it by."
    reason = Reason(
        "no-spots",
        "weak",
        "the calibration does not hold its spots: nothing can be checked but what it says itself",
        action,
    )
    if calibration.fit.converged:
        return Verdict("weak", (reason,), action, Opinions())
    failed = Reason("not-converged", "bad", calibration.fit.status, _LOOK)
    return Verdict("bad", (failed, reason), _LOOK, Opinions())


def _opinions(
    calibration: Calibration,
    bench: Bench,
    halves: bool,
    parts: tuple[Calibration, Calibration] | None,
) -> Opinions:
    compared = split(calibration, parts) if halves else None
    if len(bench) > MOST_SPOTS:
        bench = lay_out(_sample(calibration))
    return Opinions(
        accuse(bench),
        levels(bench),
        leave_groups_out(bench),
        question_residuals(bench),
        compared,
        len(bench),
    )


def _sample(calibration: Calibration) -> Calibration:
    """The same estimate with an even sample of its spots."""
    used = np.flatnonzero(calibration.spots.weight > 0)
    rows = used[np.linspace(0, len(used) - 1, MOST_SPOTS).round().astype(np.int64)]
    spots, inputs = calibration.spots, calibration.inputs
    leverage = spots.leverage
    return replace(
        calibration,
        spots=SpotResults(
            id=spots.id[rows],
            plane=spots.plane[rows],
            camera=spots.camera[rows],
            laser=spots.laser[rows],
            residual_px=spots.residual_px[rows],
            weight=spots.weight[rows],
            rejected=tuple(spots.rejected[k] for k in rows),
            leverage=None if leverage is None else leverage[rows],
        ),
        inputs=replace(inputs, observations=inputs.observations[rows]),
    )


def _of_fit(calibration: Calibration) -> Iterator[Reason]:
    fit = calibration.fit
    if not fit.converged:
        yield Reason(
            "not-converged",
            "bad",
            fit.status,
            _LOOK,
        )
    yield from _of_rejected_groups(calibration)
    total = fit.n_spots + fit.n_rejected
    share = fit.n_rejected / max(total, 1)
    if share > MANY_REJECTED:
        yield Reason(
            "rejected",
            "bad" if share > MOST_REJECTED else "weak",
            f"{fit.n_rejected} of {total} spots ({100 * share:.0f} %) were left out as outliers",
            "Look at the pictures of the spots that were left out: reflections, or pictures and "
            "poses mixed up.",
        )
    if np.isfinite(fit.sigma0) and fit.dof < FEW_DOF:
        yield Reason(
            "few-spots",
            "weak",
            f"only {fit.dof:.0f} degrees of freedom check the fit, so that all sigmas are "
            f"uncertain by {100 / np.sqrt(2 * max(fit.dof, 1)):.0f} %",
            "Take more spots.",
        )
    leverage = calibration.spots.leverage
    alone = np.zeros(0) if leverage is None else np.flatnonzero(leverage > UNCHECKED)
    if len(alone):
        first = calibration.spots.id[alone[0]]
        yield Reason(
            "leverage",
            "note",
            f"nothing checks {len(alone)} spot(s), which the fit follows wherever they are; first: "
            f"{str(first)!r}",
            "Take more spots like it.",
        )


def _of_rejected_groups(calibration: Calibration) -> Iterator[Reason]:
    """Groups of which most spots were left out: something moved rather than many bad pictures."""
    seen = calibration.inputs.observations
    out = np.array([why is not None for why in calibration.spots.rejected])
    group = orientation_groups(seen, calibration.inputs.options)
    for g in np.unique(group[out]):
        rows = np.flatnonzero(group == g)
        left = int(out[rows].sum())
        if len(rows) >= GROUP_SIZE and 2 * left > len(rows):
            yield Reason(
                "group-rejected",
                "weak",
                f"{left} of the {len(rows)} shots of the group of {str(seen.id[rows[0]])!r} on "
                f"plane {str(seen.plane[rows[0]])!r} were left out as outliers: the plane, or "
                "something else, was elsewhere then",
                "Find out what moved for that group, and take it again.",
            )


def _of_noise(calibration: Calibration, bench: Bench) -> Iterator[Reason]:
    fit = calibration.fit
    if bench.stated:
        far = chi2_above(fit.dof * fit.sigma0**2, fit.dof) < UNLIKELY
        if fit.sigma0 > NOISY and far:
            yield Reason(
                "noise",
                "bad" if fit.sigma0 > TOO_NOISY else "weak",
                f"the residuals are {fit.sigma0:.1f} times what the stated noise explains",
                "See which fault or level the tables of 'lasercal judge' blame; else state the "
                "true noise.",
            )
        elif fit.sigma0 < QUIET and chi2_above(fit.dof * fit.sigma0**2, fit.dof) > 1 - UNLIKELY:
            yield Reason(
                "quiet",
                "note",
                f"the residuals are only {fit.sigma0:.2f} times what the stated noise explains",
                "State the true noise.",
            )
    seen = calibration.inputs.observations
    diagonal = max(float(np.hypot(*size)) for size in seen.image_size.values())
    if fit.rms_px > TOO_FAR * diagonal:
        yield Reason(
            "far",
            "bad",
            f"the spots are {fit.rms_px:.3g} px (rms) from where they should be, more than "
            f"{100 * TOO_FAR:.0f} % of the picture's diagonal",
            "Let 'lasercal check' look for a wrong convention in the capture.",
        )


_ACTIONS = {
    ("camera", "lens"): "Estimate all distortion terms (distortion 'all'), or use a lens that the "
    "model describes.",
    ("camera", "moved"): "Fix the camera, and leave out the spots from before or after it moved.",
    ("laser", "moved"): "Fix the laser, and leave out the spots from before or after it moved.",
    ("plane", "moved"): "Fix the plane, or give its spots from before and after two names.",
    ("plane", "bent"): "Use a flat plate, or a smaller part of this one.",
    ("robot", "scale"): "Have the robot's kinematics calibrated.",
    ("robot", "orientation"): "Check the robot's zero positions and the poses of these shots.",
}


def _of_opinions(opinions: Opinions) -> Iterator[Reason]:
    found = culprit(opinions.findings)
    if found is not None:
        times = 1.0 / max(found.shrink, 1e-9)
        others = [_with_amount(other) for other in rivals(opinions.findings)]
        nearly = f"; nearly as likely: {'; or '.join(others)}" if others else ""
        yield Reason(
            f"{found.part}-{found.fault}",
            "bad" if times > BIG_FAULT else "weak",
            f"{_with_amount(found)}: without it the noise would be {times:.2g} times less (chance "
            f"{_chance(found.chance)}){nearly}",
            _ACTIONS[found.part, found.fault],
        )
    elif opinions.findings:
        first = min(opinions.findings, key=lambda finding: finding.chance)
        if first.chance < WORTH_A_LOOK:
            yield Reason(
                f"{first.part}-{first.fault}",
                "note",
                f"worth a look: perhaps {_with_amount(first)} (chance {_chance(first.chance)})",
                _ACTIONS[first.part, first.fault],
            )
    for test in opinions.tests:
        if test.corrected < UNLIKELY:
            yield Reason(
                f"residuals-{test.name}",
                "note" if test.name == "normal" else "weak",
                f"it is not so that {test.asks} (chance {_chance(test.corrected)})",
                "See which fault or level the tables of 'lasercal judge' blame.",
            )
    known = [group for group in opinions.left_out if np.isfinite(group.chance)]
    for group in known:
        astray = group.rms_px > ASTRAY * group.expected_px
        if astray and group.chance * len(known) < UNLIKELY:
            yield Reason(
                "left-out",
                "weak",
                f"the {group.spots} shots of the group of {group.first!r} on plane "
                f"{group.plane!r} lie {group.rms_px:.2g} px ({group.rms_mm:.2g} mm) from where the "
                f"others predict them, where {group.expected_px:.2g} px are expected",
                "Take that group again, or leave it out.",
            )
    halves = opinions.split
    if halves is not None and halves.failure is None and halves.chance < UNLIKELY:
        worst = max(halves.rows, key=lambda row: abs(row.sigmas))
        yield Reason(
            "halves",
            "weak",
            f"two halves of the spots disagree (chance {_chance(halves.chance)}); most in "
            f"{worst.name}, by {abs(worst.sigmas):.1f} sigma",
            "See which fault or level the tables of 'lasercal judge' blame.",
        )


def _with_amount(finding: Finding) -> str:
    if finding.shift_mm is None:
        return finding.words
    amount = f" moved by {abs(finding.shift_mm):.2g} mm "
    return finding.words.replace(" moved ", amount, 1)


def _of_geometry(bench: Bench) -> Iterator[Reason]:
    every = np.ones(len(bench.labels), dtype=np.bool_)
    rigid = np.array([x.rpartition(".")[2] not in DISTORTION_NAMES for x in bench.labels])
    rank: list[int] = []
    R = np.asarray(np.linalg.qr(bench.A)[1])
    for free in (rigid, every):
        if len(rank) and free.sum() == rigid.sum():
            break
        svd = RangeSvd.of(R, bench.labels, free)
        weak = svd.weak_directions(POOR)
        rank.append(len(weak))
        for k, direction in enumerate(weak[rank[0] if len(rank) > 1 else 0 :]):
            at = len(svd.labels) - 1 - k - (rank[0] if len(rank) > 1 else 0)
            what = parts_in_words(svd.labels, svd.directions[at])
            yield Reason(
                "weak-geometry" if len(rank) == 1 else "weak-distortion",
                "weak" if len(rank) == 1 else "note",
                f"hardly determined: {what} ({direction.words}, together, hardly show)",
                "Ask 'lasercal check' for the motion that would determine it."
                if len(rank) == 1
                else "Take spots near the picture's corners, or hold distortion terms.",
            )


def _of_coverage(calibration: Calibration) -> Iterator[Reason]:
    seen = calibration.inputs.observations
    used = seen[calibration.spots.weight > 0]
    for words in fold_warnings(calibration.cell):
        yield Reason("fold", "weak", words, "Take spots near the picture's corners, or hold k2.")
    for picture in coverage(used):
        if picture.fields < FEW_FIELDS:
            yield Reason(
                "coverage",
                "weak",
                f"the spots of camera {picture.camera!r} lie in {picture.fields} of 12 fields of "
                "the picture: elsewhere the lens is a guess",
                "Take spots all over the picture.",
            )
    for words in lines_of_spots(used):
        yield Reason("line", "weak", words, "Move the spots on that plane in two directions.")


def _chance(value: float) -> str:
    return f"{value:.1g}" if value > 1e-15 else "< 1e-15"
