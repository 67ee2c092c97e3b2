"""Something moves: how soon is it noticed, is the right cause named, is the part found again?

A calibration of 300 spots runs on; then a camera, a laser or a plane is bumped, or the robot gets
worse, and spots come one by one. Those that would leave the picture are drawn again. For a plane
only the spots on it can show anything: its numbers count those ("affected").
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from findings import Finding, at_most, fraction, print_table, share
from lasercal_factors.chart import CellChart
from scipy.stats import chi2
from spots import Hands, OutOfViewError, Stream, good_stream, take

import lasercal_gtsam as lc
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import cell_from_state, state_from_cell
from lasercal_gtsam.incremental.belief import coordinates, part_offset
from lasercal_gtsam.simulate import Noise
from lasercal_gtsam.simulate.bumps import bumped

NAMES = {"camera": "camera", "laser": "laser", "plane": "2", "robot": ""}
KINDS = tuple(NAMES)
SIZES = {"0.2 deg/1 mm": (0.2, 1.0), "2 deg/10 mm": (2.0, 10.0), "20 deg/100 mm": (20.0, 100.0)}
SOON = {"0.2 deg/1 mm": 5, "2 deg/10 mm": 3, "20 deg/100 mm": 2}
WORSE = "1 mm, 0.1 deg"
WIDTH = {"camera": 6, "laser": 4, "plane": 3}
BEFORE, NAMED, MORE, ALONE = 300, 10, 10, 20
# an alarm has to come within so many affected spots
_PATIENCE = 60
_THREE_SIGMA = 0.9973
# signal that the best test (chi-square, one false alarm in 100 000 spots) notices about as often as
# not is 5.75 sigma with six degrees of freedom
NOTICEABLE = 6.0
_TRIES = 50
# the part that an event is about
_PART = re.compile(r"(camera|laser|plane) '(\w+)'")


@dataclass(frozen=True)
class Outcome:
    """What became of one bump. Numbers of spots count from the bump; inf: never.

    ``early``: an alarm before the bump. ``noticed``, ``noticed_all``: affected spots, and all,
    until the alarm. ``named``: most probable cause after ten affected spots ("none": no alarm);
    ``named_all``: after ten spots of any plane. ``sure``: the right one after ten affected, with a
    probability of 0.95.
    ``part``, ``worst``, ``cell``: squared error of the part in sigmas as a share of its 99.73 %
    quantile, its worst coordinate in sigmas, and all of the cell's coordinates like ``part``;
    inf where it was not found again. ``signal``: what ten affected spots hold, see `_signal`.
    """

    early: bool
    noticed: float
    noticed_all: float
    named: str
    named_all: str
    sure: bool
    part: float
    worst: float
    cell: float
    signal: float


FAILED = Outcome(False, np.inf, np.inf, "error", "error", False, np.inf, np.inf, np.inf, np.inf)


@dataclass(frozen=True)
class Alone:
    """The same stream with ``automatic=True``: what was freed first, and the cell at the end."""

    freed: str
    cell: float


@dataclass(frozen=True)
class Bump:
    """A stream before and after a change."""

    kind: str
    before: Stream
    after: Stream

    @property
    def name(self) -> str:
        return NAMES[self.kind]

    @property
    def label(self) -> str:
        return f"{self.kind} {self.name}".strip()

    def affected(self, plane: str) -> bool:
        return self.kind != "plane" or plane == self.name


def make_bump(kind: str, size: str, seed: int, pixel_px: float) -> Bump:
    """Draw the bump again where nothing would be in view."""
    before = good_stream(seed, BEFORE, pixel_px=pixel_px)
    noise, hands = Noise(pixel_px=pixel_px), Hands(before.truth, seed)
    on_plane = before.observations.plane == NAMES["plane"]
    seen = before.observations.T_base_hand[on_plane]
    middle = lc.spot_on_beam(before.truth, seen, plane=NAMES["plane"]).mean(axis=0)
    count = _PATIENCE * (4 if kind == "plane" else 1)
    for attempt in range(_TRIES):
        rng = np.random.default_rng((seed, KINDS.index(kind), attempt))
        cell = before.truth
        if kind == "robot":
            noise = Noise(pixel_px, hand_translation_m=1e-3, hand_rotation_rad=np.deg2rad(0.1))
        else:
            deg, mm = SIZES[size]
            cell = bumped(cell, kind, NAMES[kind], np.deg2rad(deg), mm / 1e3, rng, middle)  # type: ignore[arg-type]
        try:
            T, plane = hands.draw(cell, count, rng)
            return Bump(kind, before, take(cell, T, plane, noise, rng, first=BEFORE))
        except OutOfViewError:
            continue
    raise OutOfViewError(f"{kind} {size} seed {seed}")


def by_hand(bump: Bump, options: lc.CalibrationOptions) -> tuple[Outcome, lc.Calibration]:
    """Free the true part once ten affected spots have come and the alarm is open."""
    calibrator = _calibrated(bump, options)
    early = any(event.kind == "alarm" for event in calibrator.events)
    calibrator.dismiss()
    base = calibrator.calibration
    noticed = noticed_all = np.inf
    named = named_all = "none"
    sure = False
    errors = (np.inf, np.inf, np.inf)
    reset_at: int | None = None
    for count, affected, spot in _arriving(bump):
        update = calibrator.add(spot)
        if reset_at is not None:
            if affected >= reset_at + MORE:
                errors = _errors(update, bump)
                break
            continue
        cause = update.alarm.cause if update.alarm is not None else None
        label = "none" if cause is None else f"{cause.kind} {cause.name}".strip()
        if cause is not None and affected and not np.isfinite(noticed):
            noticed, noticed_all = affected, count
        if count == NAMED:
            named_all = label
        if affected == NAMED and bump.affected(str(spot.plane[0])):
            named = label
            sure = label == bump.label and cause is not None and cause.probability > 0.95
        if affected >= NAMED and cause is not None:
            if bump.kind == "robot":
                break
            calibrator.reset(**{bump.kind: bump.name})
            reset_at = affected
    assert base is not None
    signal = _signal(bump, base)
    found = Outcome(early, noticed, noticed_all, named, named_all, sure, *errors, signal)
    return found, base


def alone(bump: Bump, base: lc.Calibration, options: lc.CalibrationOptions) -> Alone:
    """Go on from the same 300 spots, and let the calibrator act by itself."""
    calibrator = lc.IncrementalCalibrator(base, options, automatic=True)
    for _, affected, spot in _arriving(bump):
        update = calibrator.add(spot)
        if affected == ALONE:
            break
    freed = [event.words for event in calibrator.events if event.kind == "reset"]
    named = _PART.search(freed[0]) if freed else None
    return Alone(" ".join(named.groups()) if named else "nothing", _errors(update, bump)[2])


def _calibrated(bump: Bump, options: lc.CalibrationOptions) -> lc.IncrementalCalibrator:
    calibrator = lc.IncrementalCalibrator(options=options)
    seen = bump.before.observations
    calibrator.add(seen[:90])
    calibrator.add(seen[90:])
    return calibrator


def _arriving(bump: Bump) -> Iterator[tuple[int, int, lc.Observations]]:
    """Number of the spot since the bump, of affected ones, and the spot."""
    seen, affected = bump.after.observations, 0
    for k, plane in enumerate(seen.plane.tolist()):
        affected += bump.affected(plane)
        yield k + 1, affected, seen[k : k + 1]


def _errors(update: lc.Update, bump: Bump) -> tuple[float, float, float]:
    """Part and cell against the truth, as in `Outcome`."""
    result = update.calibration
    if result is None or update.missing or not np.isfinite(result.covariance).all():
        return np.inf, np.inf, np.inf
    error = coordinates(result.cell, bump.after.truth)
    free = np.diag(result.covariance) > 0
    at = part_offset(result.cell, bump.kind, bump.name) if bump.kind in WIDTH else 0  # type: ignore[arg-type]
    part = np.zeros_like(free)
    part[at : at + WIDTH.get(bump.kind, 0)] = True
    sigmas = np.sqrt(np.diag(result.covariance))
    worst = float(np.abs(error[part] / sigmas[part]).max(initial=0.0))
    return (
        _share_of_quantile(error, result.covariance, part),
        worst,
        _share_of_quantile(error, result.covariance, free),
    )


def _signal(bump: Bump, base: lc.Calibration) -> float:
    """How far the bump moves ten affected spots, in sigmas: pixel noise and what is left open.

    By differences of `lc.project` alone: nothing of the detector or of the diagnosis is used. Where
    a turn and a shift cancel in the picture, no test can tell; inf where the old cell shows none.
    """
    seen = bump.after.observations
    seen = seen[[bump.affected(plane) for plane in seen.plane.tolist()]][:NAMED]
    chart = CellChart(state_from_cell(base.cell))

    def pixels(cell: lc.Cell) -> Array:
        return lc.project(cell, seen.T_base_hand, plane=seen.plane.tolist()).ravel()

    def at(z: Array) -> Array:
        return pixels(cell_from_state(chart.state(z), base.cell))

    shift = pixels(bump.after.truth) - pixels(bump.before.truth)
    sigmas = np.sqrt(np.diag(base.covariance))
    free = np.flatnonzero(sigmas > 0)
    steps = 0.01 * np.diag(sigmas)[free]
    J = np.stack([(at(step) - at(-step)) / 0.02 for step in steps], axis=1)
    correlation = base.covariance[np.ix_(free, free)] / np.outer(sigmas[free], sigmas[free])
    covariance = J @ correlation @ J.T + base.fit.sigma0**2 * np.eye(len(shift))
    if not (np.isfinite(shift).all() and np.isfinite(covariance).all()):
        return np.inf
    return float(np.sqrt(shift @ np.linalg.solve(covariance, shift)))


def _share_of_quantile(error: Array, covariance: Array, where: npt.NDArray[np.bool_]) -> float:
    """Squared error in sigmas, as a share of what it exceeds as rarely as a Gaussian 3 sigma."""
    if not where.any():
        return 0.0
    covariance = covariance[np.ix_(where, where)]
    scale = np.sqrt(np.diag(covariance))
    scaled = error[where] / scale
    square = scaled @ np.linalg.solve(covariance / np.outer(scale, scale), scaled)
    return float(square / chi2.ppf(_THREE_SIGMA, int(where.sum())))


def run(args: argparse.Namespace) -> list[Finding]:
    options = lc.CalibrationOptions(distortion="none")
    findings: list[Finding] = []
    rows: list[tuple[str, ...]] = [
        (
            "bump", "noticed (all spots)", "99 % by", "named by 10", "by 10 of any plane",
            "of those noticeable", "sure", "else named", "part back", "worst, median", "cell back",
            "alone: right, wrong, nothing", "alone: cell back",
        )
    ]  # fmt: skip
    for kind in args.kinds:
        for size in SIZES if kind != "robot" else [WORSE]:
            outcomes, left_alone = [], []
            for seed in range(args.seeds):
                bump = make_bump(kind, size, seed, args.pixel)
                try:
                    outcome, base = by_hand(bump, options)
                    outcomes.append(outcome)
                    left_alone.append(alone(bump, base, options))
                except Exception as error:  # a finding, not the end of the other seeds
                    print(f"{kind}, {size}, seed {seed}: {error!r}", file=sys.stderr)
                    outcomes, left_alone = outcomes[:seed], left_alone[:seed]
                    outcomes.append(FAILED)
                    left_alone.append(Alone("error", np.inf))
            label = f"{kind} {NAMES[kind]}".strip()
            rows.append(_row(f"{kind}, {size}", label, outcomes, left_alone))
            findings += _findings(kind, size, label, outcomes)
            print(f"{kind}, {size}: {len(outcomes)} seeds", file=sys.stderr, flush=True)
    print_table(rows)
    return findings


def _findings(kind: str, size: str, label: str, found: Sequence[Outcome]) -> list[Finding]:
    what = f"{kind}, {size}: "
    named = share(
        f"{what}right cause within {NAMED} spots", [o.named == label for o in found], 0.95
    )
    if kind == "robot":
        share_noticed = [o.noticed < np.inf for o in found]
        return [share(f"{what}noticed within {_PATIENCE} spots", share_noticed, 0.95), named]
    median = float(np.median([o.noticed for o in found]))
    back = [o.part <= 1 for o in found]
    return [
        at_most(f"{what}spots until noticed, median", median, SOON[size]),
        named,
        share(f"{what}part within 3 sigma with {MORE} more", back, 0.95),
    ]


def _row(
    what: str, label: str, found: Sequence[Outcome], left_alone: Sequence[Alone]
) -> tuple[str, ...]:
    def percent(good: Sequence[bool]) -> str:
        return f"{100 * fraction(good):.0f} %"

    clear = [o for o in found if o.signal >= NOTICEABLE]
    others = Counter(o.named for o in found if o.named != label)
    noticed = [o.noticed for o in found]
    right = sum(a.freed == label for a in left_alone)
    nothing = sum(a.freed == "nothing" for a in left_alone)
    whole = np.median([o.noticed_all for o in found])
    wrong = Counter(a.freed for a in left_alone if a.freed not in (label, "nothing"))
    back = [
        percent([o.part <= 1 for o in found]),
        f"{np.median([o.worst for o in found]):.2f}",
        percent([o.cell <= 1 for o in found]),
    ]
    if label == "robot":
        back = ["-"] * 3  # there is nothing to be set free
    names = f" ({', '.join(f'{n} {x}' for x, n in wrong.items())})" if wrong else ""
    return (
        what,
        f"{np.median(noticed):.3g} ({whole:.3g})",
        f"{np.sort(noticed)[int(0.99 * (len(noticed) - 1))]:.3g}",
        percent([o.named == label for o in found]),
        percent([o.named_all == label for o in found]),
        f"{percent([o.named == label for o in clear])} of {len(clear)}" if clear else "-",
        percent([o.sure for o in found]),
        ", ".join(f"{n} {x}" for x, n in others.items()) or "-",
        *back,
        f"{right}, {len(left_alone) - right - nothing}{names}, {nothing}",
        percent([a.cell <= 1 for a in left_alone]),
    )
