"""`lasercal update`: the spots of a capture added to a calibration, and what they have changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import bullets, json_option, print_json, progress, warn
from lasercal_gtsam.cli.outputs import check_calibration_target
from lasercal_gtsam.cli.running import (
    automatic_option,
    disagreements,
    named_parts,
    prefix_option,
    reset_option,
    stated_sigma,
)
from lasercal_gtsam.cli.texts import account_lines, count, result_lines
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Calibration
    from lasercal_gtsam.history import HistoryRow
    from lasercal_gtsam.incremental.update import Alarm, Event
    from lasercal_gtsam.io.capture import Capture
    from lasercal_gtsam.io.spot_account import SpotAccount
    from lasercal_gtsam.observations import Observations

_MOST_LINES = 20


@dataclass(frozen=True, eq=False)
class _Outcome:
    """What an update gave."""

    before: Calibration
    after: Calibration
    new: tuple[str, ...]
    known: int
    events: tuple[Event, ...]
    alarm: Alarm | None
    missing: tuple[str, ...]
    history: list[HistoryRow]

    @property
    def rejected(self) -> dict[str, str]:
        """New spots that the result does not use, and why."""
        new = set(self.new)
        return {s.id: s.rejected for s in self.after.spots if s.rejected and s.id in new}

    @property
    def trusted(self) -> bool:
        return self.alarm is None and not self.missing and self.after.fit.converged


@click.command(
    short_help="Add the spots of a capture to a calibration.",
    epilog="Exit status: 0 written, or nothing was new; 1 wrong data, or an answer that cannot be "
    "trusted.",
)
@click.argument("calibration", type=click.Path(path_type=Path))
@click.argument("capture", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    metavar="OUT",
    type=click.Path(path_type=Path),
    help="Where the result goes, with its history beside it.  [default: over CALIBRATION]",
)
@reset_option
@automatic_option
@prefix_option
@click.option(
    "--force",
    is_flag=True,
    help="Write also an answer that cannot be trusted (the exit status stays 1).",
)
@json_option
def update(
    calibration: Path,
    capture: Path,
    output: Path | None,
    resets: tuple[tuple[str, str], ...],
    automatic: bool,
    prefix: str,
    force: bool,
    as_json: bool,
) -> int:
    """Add to CALIBRATION the spots of CAPTURE that are not in it yet.

    Prints what was accepted and rejected, and how far each parameter moved. When something in the
    cell has moved, it says what, and writes nothing.
    """
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.io.capture import load_capture

    target = calibration if output is None else output
    if target.is_dir():
        target = target / calibration.name
    check_calibration_target(target)
    before = load_calibration(calibration)
    loaded = load_capture(capture)
    warn(loaded.warnings)
    warn(disagreements(before.inputs.options, loaded.noise, loaded.known, loaded.path))
    parts = named_parts(resets, before.cell)
    with progress("Looking at pictures") as show:
        account = loaded.detections(progress=show)
    warn(account.notes)
    seen = _named(loaded.observations(account=account), prefix, stated_sigma(before, loaded.noise))
    new, known = _split(before, seen, calibration, loaded.path)
    if not len(new) and not parts:
        if as_json:
            print_json({"run": _run(loaded, account, None, known, None)})
        else:
            all_of_it = "its only spot is" if known == 1 else f"all its {known} spots are"
            click.echo(f"{loaded.path}: nothing new: {all_of_it} in {calibration} already.")
        return 0
    outcome = _update(before, new, known, parts, automatic)
    saved = None
    if outcome.trusted or force:
        _save(outcome, target, calibration, loaded)
        saved = target
    if as_json:
        print_json(_document(outcome, loaded, account, saved))
    else:
        click.echo("\n".join(_report(outcome, loaded, account)))
        if saved is not None:
            click.echo(f"Saved {saved}.")
    if outcome.trusted:
        return 0
    written = "written all the same" if saved else "nothing was written (see --force)"
    for line in _complaints(outcome, calibration, capture, written):
        click.echo(f"Error: {line}", err=True)
    return 1


def _named(seen: Observations, prefix: str, sigma_px: float | None) -> Observations:
    """The spots under the names and with the noise that they have in the calibration."""
    import numpy as np

    cov = np.array(seen.cov_uv)
    if sigma_px is not None:
        cov[np.isnan(cov).any(axis=(1, 2))] = sigma_px**2 * np.eye(2)
    names = np.array([prefix + name for name in seen.id.tolist()], dtype=np.str_)
    return replace(seen, cov_uv=cov, id=names)


def _split(
    before: Calibration, seen: Observations, calibration: Path, capture: Path
) -> tuple[Observations, int]:
    """Spots that are new, and how many are in the calibration already.

    Raises
    ------
    DataError
        An id is in the calibration with other values.
    """
    import numpy as np

    from lasercal_gtsam.io.known_spots import KnownSpots
    from lasercal_gtsam.io.wording import some

    known = KnownSpots()
    known.add(before.inputs.observations, str(calibration))
    there = np.array([name in known for name in seen.id.tolist()], dtype=bool)
    old = seen[there]
    others = [n for n, same in zip(old.id.tolist(), known.same(old), strict=True) if not same]
    if others:
        raise DataError(
            f"{capture}: {count(len(others), 'id')} of it ({some(others)}) "
            f"{'is' if len(others) == 1 else 'are'} in {calibration} already with other values; "
            "where these are other spots, give all of them new ids with --prefix; where rows were "
            "corrected, calibrate anew"
        )
    kept = len(before.inputs.observations)
    if kept < before.fit.n_spots + before.fit.n_rejected:
        warn(
            [
                f"{calibration}: holds {kept} of its spots one by one; whether the others are in "
                f"{capture} cannot be told: give only spots that are new"
            ]
        )
    return seen[~there], len(old)


def _update(
    before: Calibration,
    new: Observations,
    known: int,
    parts: list[tuple[str, str]],
    automatic: bool,
) -> _Outcome:
    """Take the spots one by one, as they would have come."""
    from lasercal_gtsam.incremental import IncrementalCalibrator
    from lasercal_gtsam.io.history_file import up_to_now

    calibrator = IncrementalCalibrator(before, automatic=automatic)
    begun = len(calibrator.events)
    for part, name in parts:
        calibrator.reset(**{part: name})
    for k in range(len(new)):
        calibrator.add(new[k : k + 1])
    after = calibrator.calibration
    assert after is not None
    return _Outcome(
        before=before,
        after=after,
        new=tuple(new.id.tolist()),
        known=known,
        events=calibrator.events[begun:],
        alarm=calibrator.alarm,
        missing=tuple(missing.words for missing in calibrator.missing),
        history=up_to_now(calibrator.history, calibrator.n_spots, after),
    )


def _save(outcome: _Outcome, target: Path, calibration: Path, capture: Capture) -> None:
    from lasercal_gtsam.io.calibration_file import save_calibration
    from lasercal_gtsam.io.files import sha256_of
    from lasercal_gtsam.io.history_file import earlier_rows, history_path, write_history

    rows = outcome.history
    earlier = earlier_rows(history_path(calibration), rows[0].spots)
    sources = {calibration.name: sha256_of(calibration), **capture.provenance}
    save_calibration(outcome.after, target, sources=sources)
    write_history(history_path(target), [*earlier, *rows])


# --- words --------------------------------------------------------------------------------------


def _report(outcome: _Outcome, capture: Capture, account: SpotAccount) -> list[str]:
    after, rejected = outcome.after, outcome.rejected
    lines = [f"{capture.path}: {count(len(outcome.new), 'new spot')}"]
    if outcome.known:
        lines[0] += f", {outcome.known} in the calibration already"
    if skipped := account_lines(account, f"'lasercal detect {capture.path.parent}' draws them"):
        lines += [f"{count(len(account.skipped), 'row')} without a usable spot:", *skipped]
    lines.append(f"{len(outcome.new) - len(rejected)} accepted, {len(rejected)} rejected")
    shown = [f"{name}: {why}" for name, why in rejected.items()]
    lines += bullets(shown[:_MOST_LINES])
    if len(shown) > _MOST_LINES:
        lines.append(f"  ... and {len(shown) - _MOST_LINES} more: all are in the result file")
    lines += bullets([f"{event.kind}: {event.words}" for event in outcome.events])
    table = change_table(outcome.before, after)
    return [*lines, "", *result_lines(after, table)]


def change_table(before: Calibration, after: Calibration) -> str:
    """Text table: before, after and the change in sigmas of before."""
    from lasercal_gtsam.calibration import plain_number, table_decimals, table_row, text_table

    old = {(p.name, p.unit): p for p in before.parameters}
    lines: list[tuple[str, ...]] = [("", "Before", "After", "sigma", "Change/sigma", "Unit")]
    for p in after.parameters:
        name, _, now, sigma, unit = table_row(p)
        was = old.get((p.name, p.unit))
        value, change = "", ""
        if was is not None:
            value = plain_number(was.refined, table_decimals(p))
            moved = p.refined - was.refined
            if p.unit == "deg":
                moved = (moved + 180.0) % 360.0 - 180.0
            if was.sigma > 0:
                change = plain_number(moved / was.sigma, 2)
        lines.append((name, value, now, sigma, change, unit))
    rms = [f"{fit.rms_px:.4g}" for fit in (before.fit, after.fit)]
    return text_table([*lines, ("RMS", *rms, "", "", "px")])


def _complaints(outcome: _Outcome, calibration: Path, capture: Path, written: str) -> list[str]:
    """Why the answer cannot be trusted, and what to type next."""
    from lasercal_gtsam.cli.live import moved_part

    lines = []
    if outcome.alarm is not None:
        lines.append(f"{outcome.alarm.words or 'something has changed'}; {written}")
        if part := moved_part(outcome.alarm):
            lines.append(
                f"if the {part[0]} was moved: lasercal update {calibration} {capture} "
                f"--reset {part[0]}:{part[1]}"
            )
        else:
            lines.append(
                f"look at the spots since {outcome.alarm.since}; with more of them, over all "
                "planes, the cause can be told"
            )
    if outcome.missing:
        lines += [f"{words}; {written}" for words in outcome.missing]
        lines.append("add such spots to the capture, and give all of them in one update")
    return lines or [f"{outcome.after.fit.status}; {written}"]


def _run(
    capture: Capture,
    account: SpotAccount,
    outcome: _Outcome | None,
    known: int,
    saved: Path | None,
) -> dict[str, Any]:
    from lasercal_gtsam.cli.live import alarm_document

    rejected = outcome.rejected if outcome else {}
    new = outcome.new if outcome else ()
    return {
        "capture": str(capture.path),
        "saved": None if saved is None else str(saved),
        "new": len(new),
        "known": known,
        "accepted": [name for name in new if name not in rejected],
        "rejected": rejected,
        "skipped": account.skipped,
        "events": [{"kind": e.kind, "words": e.words} for e in outcome.events] if outcome else [],
        "alarm": alarm_document(outcome.alarm) if outcome else None,
        "missing": outcome.missing if outcome else [],
        "warnings": [*capture.warnings, *account.notes],
    }


def _document(
    outcome: _Outcome, capture: Capture, account: SpotAccount, saved: Path | None
) -> dict[str, Any]:
    from lasercal_gtsam.io.calibration_file import to_dict

    return {
        **to_dict(outcome.after, sources=capture.provenance),
        "before": [
            {"name": p.name, "refined": p.refined, "sigma": p.sigma, "unit": p.unit}
            for p in outcome.before.parameters
        ],
        "run": _run(capture, account, outcome, outcome.known, saved),
    }
