"""`lasercal watch`: a capture that grows, or spots on standard input, calibrated as they come."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lasercal_gtsam.cli.calibrate import CALIBRATION_FILE
from lasercal_gtsam.cli.console import progress, warn
from lasercal_gtsam.cli.live import Screen, Stopper
from lasercal_gtsam.cli.outputs import check_calibration_target, check_writable
from lasercal_gtsam.cli.running import (
    automatic_option,
    disagreements,
    named_parts,
    prefix_option,
    reset_option,
    stated_sigma,
)
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.cli.keeper import Keeper
    from lasercal_gtsam.history import HistoryRow
    from lasercal_gtsam.incremental.journaled import JournaledCalibrator
    from lasercal_gtsam.io.capture import CaptureNoise
    from lasercal_gtsam.io.capture_head import CaptureHead
    from lasercal_gtsam.options import CalibrationOptions

_STDIN, _LONGEST_LINE = 0, 1 << 20


class _Head(NamedTuple):
    """What ``capture.yaml`` says."""

    path: Path
    head: CaptureHead
    noise: CaptureNoise
    known: dict[str, Any]

    def options(self) -> CalibrationOptions:
        from lasercal_gtsam.io.capture import stated_options

        return stated_options(self.noise, self.known)


@click.command(
    short_help="Keep a calibration up to date while spots arrive.",
    epilog="Exit status: 0 ended by Ctrl-C or SIGTERM, or by itself; 1 wrong data, or ended by "
    "itself with an alarm open.",
)
@click.argument("capture", required=False, type=click.Path(path_type=Path))
@click.option(
    "--calibration",
    "start",
    metavar="START.json",
    type=click.Path(path_type=Path),
    help="Go on from this calibration.  [default: the result, if it is there; else the first spots "
    "give one]",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help=f"Where the result goes, with its history beside it.  [default: {CALIBRATION_FILE} beside "
    "the capture]",
)
@click.option(
    "--journal",
    type=click.Path(path_type=Path),
    help="Where every spot is kept before it is used.  [default: beside the result]",
)
@click.option(
    "--stdin",
    "from_stdin",
    is_flag=True,
    help="Take spots as JSON lines from standard input, and answer each; CAPTURE then only says "
    "how they are written, and may be left out.",
)
@automatic_option
@click.option(
    "--max-spots",
    metavar="N",
    type=click.IntRange(min=50),
    help="Keep this many spots one by one; what older ones say is kept as a whole.",
)
@click.option(
    "--half-life",
    metavar="N",
    type=click.FloatRange(min=10),
    help="Let spots fade: after N more, a spot counts half.",
)
@reset_option
@click.option(
    "--dismiss", is_flag=True, help="First close an open alarm, because nothing has moved."
)
@prefix_option
@click.option(
    "--interval",
    metavar="S",
    type=click.FloatRange(min=0.01),
    default=0.5,
    show_default=True,
    help="Seconds between two looks at the capture.",
)
@click.option("--once", is_flag=True, help="Take what is there, and end.")
@click.option(
    "--until-idle",
    metavar="S",
    type=click.FloatRange(min=0),
    help="End when nothing new has come for S seconds.",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print a JSON line on stdout for every spot, and for what there is to say.",
)
def watch(
    capture: Path | None,
    start: Path | None,
    output: Path | None,
    journal: Path | None,
    from_stdin: bool,
    automatic: bool,
    max_spots: int | None,
    half_life: float | None,
    resets: tuple[tuple[str, str], ...],
    dismiss: bool,
    prefix: str,
    interval: float,
    once: bool,
    until_idle: float | None,
    as_json: bool,
) -> int:
    """Follow CAPTURE (capture.yaml, or its folder) while rows and pictures are added to it.

    Each spot updates the result at once; when something moved, an alarm says what. Every spot is in
    the journal before it is used: after a crash, the same command goes on where it was. End it with
    Ctrl-C.

    A spot for --stdin (in one line), the pose in metres or as the columns of poses.csv:

    \b
      {"id": "s17", "plane": "table", "uv": [312.4, 208.9],
       "T_base_hand": [[...], [...], [...], [0, 0, 0, 1]]}

    or {"reset": {"camera": "NAME"}}, {"dismiss": true}, {"image_size": [640, 480]}.
    """  # noqa: D301
    if capture is None and not from_stdin:
        raise click.UsageError("CAPTURE is needed, except with --stdin")
    if prefix and from_stdin:
        raise click.UsageError("--prefix is for the rows of a CAPTURE, not for --stdin")

    said = None if capture is None else _read_head(capture)
    target = _target(output, said)
    journal = journal or target.with_name(f"{target.stem}.journal.jsonl")
    settings = {"automatic": automatic, "max_spots": max_spots, "half_life": half_life}
    with _open(journal, target, start, said, settings) as session:
        from lasercal_gtsam.cli.keeper import Keeper

        screen = Screen(err=as_json or from_stdin)
        keeper = Keeper(
            session,
            target,
            screen,
            sources={**_digest(said), **session.sources},
            earlier=_earlier(session, target, start),
            conversation=from_stdin,
            as_json=as_json,
        )
        keeper.greet()
        for part, name in named_parts(resets, session.calibrator.cell):
            keeper.said(session.reset(part, name))
        if dismiss:
            keeper.said(session.dismiss())
        limit = 0.0 if once else until_idle
        waiting: dict[str, str] = {}
        with Stopper() as stop, screen:
            try:
                if said is None or from_stdin:
                    ended = _listen(keeper, said, stop, limit)
                else:
                    ended, waiting = _follow(keeper, said, prefix, stop, interval, limit)
            except BrokenPipeError:  # nobody reads the answers any more
                keeper.save(now=True)
                raise
            keeper.finish(waiting)
    return 1 if ended and session.calibrator.alarm is not None else 0


def _read_head(capture: Path) -> _Head:
    from lasercal_gtsam.io.capture import capture_file, known_values, stated_noise
    from lasercal_gtsam.io.capture_head import read_head

    path = capture_file(capture)
    head, _ = read_head(path)
    noise, warnings = stated_noise(head, path.name)
    warn(warnings)
    return _Head(path, head, noise, known_values(head))


def _target(output: Path | None, said: _Head | None) -> Path:
    target = output
    if target is None:
        target = (said.path.parent if said else Path()) / CALIBRATION_FILE
    elif target.is_dir():
        target = target / CALIBRATION_FILE
    check_calibration_target(target)
    return target


def _open(
    journal: Path, target: Path, start: Path | None, said: _Head | None, settings: dict[str, Any]
) -> JournaledCalibrator:
    from lasercal_gtsam.incremental.journaled import JournaledCalibrator

    check_writable(journal)
    if _is_begun(journal):
        if start is not None and start.resolve() == target.resolve():
            start = None  # it has become the result; the journal keeps a copy
    elif start is None and target.exists() and target.stat().st_size:
        start = target  # what is there is not thrown away
    options = None if said is None else said.options()
    with progress("Going through the journal") as show:
        session = JournaledCalibrator(
            journal, start=start, options=options, settings=settings, progress=show
        )
    try:
        if said is not None:
            session.check_sizes({c.name: (c.width, c.height) for c in said.head.camera})
            if session.start is not None:
                used = session.start.inputs.options
                warn(disagreements(used, said.noise, said.known, said.path))
    except BaseException:
        session.close()
        raise
    return session


def _is_begun(journal: Path) -> bool:
    """Whether there is a journal; its first line may never have been finished."""
    try:
        with journal.open("rb") as file:
            return b"\n" in file.read(1 << 16)
    except OSError:
        return False


def _digest(said: _Head | None) -> dict[str, str]:
    from lasercal_gtsam.io.files import sha256_of

    return {} if said is None else {said.path.name: sha256_of(said.path)}


def _earlier(
    session: JournaledCalibrator, target: Path, start: Path | None
) -> tuple[HistoryRow, ...]:
    """The history before this session's own, where the start has one."""
    from lasercal_gtsam.io.history_file import earlier_rows, history_path

    own = session.calibrator.history
    if session.start is None or not own:
        return ()
    place = target if session.replayed and history_path(target).exists() else start or target
    return earlier_rows(history_path(place), own[0].spots)


def _sigma(session: JournaledCalibrator, said: _Head | None) -> float | None:
    if session.start is None or said is None:
        return None
    return stated_sigma(session.start, said.noise)


def _follow(
    keeper: Keeper, said: _Head, prefix: str, stop: Stopper, interval: float, limit: float | None
) -> tuple[bool, dict[str, str]]:
    """Take what comes until asked to stop (False) or nothing comes any more (True)."""
    from lasercal_gtsam.incremental.journaled import THE_START, THIS_JOURNAL
    from lasercal_gtsam.io.follow import CaptureFollower, Notice

    session = keeper.session
    sigma_px = _sigma(session, said)
    follower = CaptureFollower(
        said.path, session.known, where=THIS_JOURNAL, prefix=prefix, sigma_px=sigma_px
    )
    first, last = True, time.monotonic()
    while not stop.asked:
        for item in follower.poll():
            last = time.monotonic()
            if isinstance(item, Notice):
                if first and item.kind == "file":
                    raise DataError(item.words)
                if item.kind == "changed" and session.known.where(item.id) == THE_START:
                    raise DataError(item.words, "... --prefix gives all rows new ids")
                keeper.notice(item)
            else:
                keeper.take([item[k : k + 1] for k in range(len(item))])
            if stop.asked:
                return False, {}
        first = False
        keeper.idle(follower.waiting)
        if limit is not None and not follower.soon and time.monotonic() - last >= limit:
            return True, follower.waiting
        stop.wait(interval)
    return False, follower.waiting


def _listen(keeper: Keeper, said: _Head | None, stop: Stopper, limit: float | None) -> bool:
    """Answer lines until asked to stop (False) or there are no more (True)."""
    from lasercal_gtsam.cli.answers import Answers
    from lasercal_gtsam.io.spot_lines import SpotLines

    session = keeper.session
    lines = SpotLines(
        {c.name: (c.width, c.height) for c in said.head.camera} if said else session.image_size,
        poses=said.head.poses if said else None,
        planes=said.head.planes if said else None,
        lasers=session.lasers,
        sigma_px=_sigma(session, said),
    )
    answers = Answers(keeper, lines)
    last = time.monotonic()
    for got in _lines(stop):
        if got:
            answers.take(got)
            last = time.monotonic()
        keeper.idle({})
        if limit is not None and time.monotonic() - last > limit:
            return True
    return not stop.asked


def _lines(stop: Stopper) -> Iterator[list[bytes]]:
    """Lines of standard input, as many as have come; nothing at times when none comes."""
    rest = b""
    while not stop.asked:
        if not stop.wait(0.5, [_STDIN]):
            yield []
            continue
        got = os.read(_STDIN, 1 << 16)
        *lines, rest = (rest + got).split(b"\n")
        if not got:
            if rest.strip():
                yield [rest]
            return
        if len(rest) > _LONGEST_LINE:
            lines, rest = [*lines, rest], b""
        yield lines
