"""Keeps what a running calibration gives: result and history on the disk, words on the screen."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.live import (
    Screen,
    alarm_words,
    moved_part,
    spot_document,
    state_words,
)
from lasercal_gtsam.cli.texts import count
from lasercal_gtsam.errors import DataError, LasercalError
from lasercal_gtsam.io.calibration_file import save_calibration
from lasercal_gtsam.io.history_file import history_path, up_to_now, write_history
from lasercal_gtsam.io.plain import plain

if TYPE_CHECKING:
    from lasercal_gtsam.history import HistoryRow
    from lasercal_gtsam.incremental.journaled import JournaledCalibrator
    from lasercal_gtsam.incremental.update import Alarm, Update
    from lasercal_gtsam.io.follow import Notice
    from lasercal_gtsam.observations import Observations

# The result holds every spot: it is written no more often than this, and takes no more than a
# twentieth of the time.
_SAVE_S, _SAVE_SHARE = 5.0, 20.0
_HEARTBEATS, _HEARTBEAT = (1, 10, 100), 1000
_RED = "red"

_HOW = {
    False: "To free it, end this and start it again with --reset {part}:{name}; if nothing has "
    "moved, with --dismiss.",
    True: 'To free it, send {{"reset": {{"{part}": "{name}"}}}}; if nothing has moved, '
    '{{"dismiss": true}}.',
}


class Keeper:
    """Takes spots into a session, says what happens, and saves.

    Parameters
    ----------
    session : the running calibration with its journal
    target : where the result goes
    screen : where words go
    sources : file name to SHA-256, kept in the result
    earlier : the history before this session's
    conversation : whether the user sends lines, which get the answers, and can send a reset
    as_json : whether every spot gets a line of JSON otherwise
    """

    def __init__(
        self,
        session: JournaledCalibrator,
        target: Path,
        screen: Screen,
        *,
        sources: Mapping[str, str],
        earlier: Sequence[HistoryRow] = (),
        conversation: bool = False,
        as_json: bool = False,
    ) -> None:
        self.session, self.screen = session, screen
        self._target, self._sources = target, dict(sources)
        self._earlier = tuple(earlier)
        self._conversation, self._as_json = conversation, as_json
        self._began = session.calibrator.n_spots
        self._alarm: tuple[Any, ...] | None = None
        self._dirty = session.replayed > 0
        self._saved = time.monotonic()
        self._cost = 0.0
        self._said_unsaved = False

    def greet(self) -> None:
        """Say what the journal gave, where it gave something."""
        session = self.session
        if session.repaired:
            self.screen.warn(f"Warning: {session.repaired}")
        so_far = f"{count(session.calibrator.n_spots, 'spot')} so far"
        if session.replayed:
            self.screen.line(f"Going on from {session.path}: {so_far}.")
        elif session.start is not None:
            self.screen.line(f"Going on from a calibration: {so_far}.")
        self._say_alarm(session.calibrator.alarm)

    def take(self, spots: Sequence[Observations]) -> None:
        """Journal spots, then take one after the other, saying what happens.

        Raises
        ------
        DataError
            They could not be written, and do not count.
        """
        for spot, answer in zip(spots, self.session.add(spots), strict=True):
            name = str(spot.id[0])
            if isinstance(answer, LasercalError):
                if self._conversation or self._as_json:
                    self.print({"id": name, "error": str(answer)})
                self.screen.warn(f"Warning: id {name}: {answer}")
                continue
            if self._conversation or self._as_json:
                self.print(spot_document(name, answer))
            self.said(answer)
            self.save(now=False)

    def said(self, update: Update) -> None:
        """Say what happened in an update, and remember to save it."""
        self._dirty = True
        for event in update.events:
            if event.kind != "alarm":
                self.screen.line(f"{count(event.spots, 'spot')}: {event.kind}: {event.words}")
        self._say_alarm(update.alarm)
        if self.screen.live:
            for rejection in update.rejected:
                self.screen.line(f"id {rejection.id} rejected: {rejection.reason}")
        elif not (self._as_json or self._conversation):
            n = update.n_spots
            if n in _HEARTBEATS or n % _HEARTBEAT == 0:
                self.screen.line(state_words(update))
        self.screen.status(lambda: _status(update))
        if update.events:
            self.save(now=True)

    def _say_alarm(self, alarm: Alarm | None) -> None:
        if alarm is None:
            self._alarm = None
            return
        likely = alarm.causes[0].kind if alarm.causes else ""
        what = (alarm.since, likely, moved_part(alarm))
        if self._alarm == what:
            return
        self._alarm = what
        words = alarm_words(alarm, _HOW[self._conversation])
        self.screen.line(click.style(f"Alarm: {words}", fg=_RED))

    def notice(self, notice: Notice) -> None:
        """Say what the follower has to say."""
        if self._as_json:
            self.print({"notice": notice.kind, "id": notice.id, "words": notice.words})
        elif notice.kind == "note":
            self.screen.line(notice.words)
        else:
            self.screen.warn(f"Warning: {notice.words}")

    def idle(self, waiting: Mapping[str, str]) -> None:
        """Nothing to do: save if that is due, and bring the live line up to date."""
        self.save(now=False)
        if waiting and self.session.calibrator.n_spots == self._began:
            name, why = next(iter(waiting.items()))
            self.screen.status(lambda: f"waiting: {name}: {why}")
        self.screen.refresh()

    def print(self, document: Mapping[str, Any]) -> None:
        """One line of JSON on stdout, at once."""
        click.echo(json.dumps(plain(document), ensure_ascii=False, allow_nan=False))
        sys.stdout.flush()

    def save(self, now: bool) -> None:
        """Write result and history, unless that was done a moment ago (or ``now``).

        A full disk is said once, and tried again.
        """
        since = time.monotonic() - self._saved
        if not self._dirty or not (now or since > max(_SAVE_S, _SAVE_SHARE * self._cost)):
            return
        if now and since < self._cost:
            return  # soon enough
        try:
            self._write()
        except DataError as error:
            if not self._said_unsaved:
                self.screen.warn(f"Warning: {error}; the journal has everything")
            self._said_unsaved = True
            self._saved = time.monotonic()

    def _write(self) -> None:
        began = time.monotonic()
        calibrator = self.session.calibrator
        result = calibrator.calibration
        if result is not None:
            save_calibration(result, self._target, sources=self._sources)
            rows = up_to_now(calibrator.history, calibrator.n_spots, result)
            write_history(history_path(self._target), [*self._earlier, *rows])
        self._dirty, self._said_unsaved = False, False
        self._saved = time.monotonic()
        self._cost = self._saved - began

    def finish(self, waiting: Mapping[str, str]) -> None:
        """Save, and say what was done.

        Raises
        ------
        DataError
            The result cannot be written.
        """
        self.screen.close()
        calibrator = self.session.calibrator
        if self._dirty:
            self._write()
        taken = calibrator.n_spots - self._began
        words = [f"{count(taken, 'spot')} taken, {calibrator.n_spots} in all"]
        if calibrator.calibration is None:
            words += [missing.words for missing in calibrator.missing] or ["no estimate yet"]
        elif calibrator.alarm is not None:
            words.append(f"ALARM open: {calibrator.alarm.words}")
        if waiting:
            name, why = next(iter(waiting.items()))
            more = f" (and {len(waiting) - 1} more)" if len(waiting) > 1 else ""
            words.append(f"waiting: {name}: {why}{more}")
        self.screen.line(f"Ended: {'; '.join(words)}.")
        if calibrator.calibration is not None:
            self.screen.line(f"Saved {self._target}.")


def _status(update: Update) -> str:
    """The live line: an alarm where it is seen, before what is missing."""
    if update.alarm is None:
        return state_words(update)
    return click.style("ALARM ", fg=_RED, bold=True) + state_words(update)
