"""What long runs need: a clean end, a line that rewrites itself, and words about an update."""

from __future__ import annotations

import math
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

import click

from lasercal_gtsam.cli.texts import count

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Parameter
    from lasercal_gtsam.incremental.update import Alarm, Update

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_REDRAW_S = 0.1
# probability from which on a cause is acted on
_CERTAIN = 0.95


class Stopper:
    """Turns Ctrl-C and SIGTERM into a wish that is obeyed between two spots.

    A second Ctrl-C interrupts at once. As a context manager: the signals are given back at the end.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        for number in _SIGNALS:
            self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        os.close(self._read)
        os.close(self._write)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True

    def wait(self, seconds: float, files: Sequence[int] = ()) -> bool:
        """Wait until a file can be read (True), a signal comes, or the time is over."""
        if self.asked:
            return False
        ready, _, _ = select.select([self._read, *files], [], [], seconds)
        return any(file in ready for file in files)


class Screen:
    """Lines on a stream, and below them one line on stderr that rewrites itself on a terminal."""

    def __init__(self, err: bool = False) -> None:
        self.live = sys.stderr.isatty()
        self._err = err
        self._status: Callable[[], str] = str
        self._shown = ""
        self._drawn = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def line(self, text: str) -> None:
        """A line that stays."""
        self._wipe()
        click.echo(text, err=self._err)

    def warn(self, text: str) -> None:
        """A line that stays, on stderr."""
        self._wipe()
        click.echo(text, err=True)

    def status(self, text: Callable[[], str]) -> None:
        """Let the live line say this; it is asked and drawn at most every tenth of a second."""
        self._status = text
        if time.monotonic() - self._drawn > _REDRAW_S:
            self.refresh()

    def refresh(self) -> None:
        """Draw the live line as it should be."""
        text = self._status() if self.live else ""
        if text == self._shown:
            return
        self._wipe()
        width = shutil.get_terminal_size().columns - 1
        plain = click.unstyle(text)
        click.echo(text if len(plain) <= width else plain[:width], nl=False, err=True)
        sys.stderr.flush()
        self._shown, self._drawn = text, time.monotonic()

    def close(self) -> None:
        """Remove the live line."""
        self._wipe()
        self._status = str

    def _wipe(self) -> None:
        if self._shown:
            click.echo("\r\x1b[K", nl=False, err=True)
            sys.stderr.flush()
            self._shown = ""


# --- words --------------------------------------------------------------------------------------


def position_sigma(parameters: Iterable[Parameter]) -> tuple[str, float]:
    """The least certain coordinate of a camera's position, and its sigma in mm.

    NaN where it is not known; ``("", 0.0)`` where positions are held.
    """
    found = [p for p in parameters if p.name.rpartition(".")[2] in ("Tx", "Ty", "Tz")]
    free = [p for p in found if p.sigma != 0]
    if not free:
        return "", 0.0
    worst = max(free, key=lambda p: math.inf if math.isnan(p.sigma) else p.sigma)
    return worst.name, worst.sigma


def sigma_words(parameters: Iterable[Parameter]) -> str:
    """The largest sigma in a unit that can be judged: where the camera is."""
    name, sigma = position_sigma(parameters)
    if not name:
        return "camera position held"
    if not math.isfinite(sigma):
        return f"camera position not determined ({name})"
    return f"camera position +-{sigma:.2g} mm ({name})"


def state_words(update: Update) -> str:
    """Spots, RMS and largest sigma in one line; what is missing, where something is."""
    parts = [count(update.n_spots, "spot")]
    if update.phase == "collecting":
        parts.append("no estimate yet")
    else:
        parts += [f"{update.n_used} used", f"RMS {update.rms_px:.3g} px"]
        parts.append(sigma_words(update.parameters))
    return ", ".join([*parts, *(missing.words for missing in update.missing)])


def moved_part(alarm: Alarm) -> tuple[str, str] | None:
    """What has moved, kind and name, where that is as good as certain."""
    cause = alarm.causes[0] if alarm.causes else None
    if cause is None or cause.kind not in ("camera", "laser", "plane"):
        return None
    return (cause.kind, cause.name) if cause.probability > _CERTAIN else None


def alarm_words(alarm: Alarm, how: str) -> str:
    """An alarm, and what to do about it; ``how`` has places {part}, {name} for what has moved."""
    part = moved_part(alarm)
    words = alarm.words or "something has changed; more spots will tell what"
    return f"{words}. {how.format(part=part[0], name=part[1])}" if part else words


def update_document(update: Update) -> dict[str, Any]:
    """The state after an update, for programs."""
    return {
        "phase": update.phase,
        "n_spots": update.n_spots,
        "n_used": update.n_used,
        "rms_px": update.rms_px,
        "sigma0": update.sigma0,
        "largest_sigma": sigma_words(update.parameters) if update.parameters else None,
        "alarm": alarm_document(update.alarm),
        "missing": [missing.words for missing in update.missing],
        "events": [{"kind": event.kind, "words": event.words} for event in update.events],
    }


def alarm_document(alarm: Alarm | None) -> dict[str, Any] | None:
    """An alarm with the probability of each cause, for programs."""
    if alarm is None:
        return None
    return {
        "words": alarm.words,
        "since": alarm.since,
        "spots": alarm.spots,
        "causes": [
            {
                "kind": cause.kind,
                "name": cause.name,
                "probability": cause.probability,
                "shift_mm": cause.shift_mm,
                "turn_deg": cause.turn_deg,
                "words": cause.words,
            }
            for cause in alarm.causes
        ],
    }


def spot_document(name: str, update: Update) -> dict[str, Any]:
    """What became of one spot, and the state after it."""
    reasons = {rejection.id: rejection.reason for rejection in update.rejected}
    if name in reasons:
        status = "rejected"
    else:
        status = "held back" if name in update.held_back else "accepted"
    chi2 = [float(c) for c, i in zip(update.innovation.chi2, update.innovation.id, strict=True)
            if i == name]  # fmt: skip
    return {
        "id": name,
        "status": status,
        "accepted": status == "accepted",
        "reason": reasons.get(name),
        "chi2": chi2[0] if chi2 else None,
        **update_document(update),
    }
