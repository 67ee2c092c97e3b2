"""Run a command in this process and judge it: status, words, time, and what it left behind."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

# of processor time, as other work may share the machine; of the clock six times that
LIMIT_S, PATIENCE = 10.0, 6.0
_LONGEST_LINE, _MOST_TEXT = 2000, 20_000
# of several captures each line names its own
_ERROR = re.compile(r"(.*: )?Error: ")
_LINE = re.compile(
    r"((.*: )?Error|Warning|Usage|Try|Traceback|Interrupted|Going on|Ended|Saved|Alarm)"
)
# what `judge` and `watch` say in other words
_VERDICT = re.compile(r"Verdict: bad|ALARM open")
# of a history: words out of its file
_EVENT = re.compile(r"  \d+: ")
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f]")
_NOT_A_NUMBER = re.compile(r"(?<![\w/.'-])(?<!plane )[-+]?(nan|inf)(?![\w/.'-])", re.IGNORECASE)


class Hang(BaseException):
    """Raised by the alarm; nothing catches it on its way."""


@dataclass
class Outcome:
    """What a run came to; ``faults`` says what is wrong with it."""

    status: int | None
    out: str
    err: str
    seconds: float
    cpu_s: float
    faults: list[str] = field(default_factory=list)
    trace: str = ""


class Streams:
    """Standard streams of this process as files, native code included."""

    def __init__(self) -> None:
        self._files = [tempfile.TemporaryFile(dir=_memory()) for _ in range(3)]  # noqa: SIM115
        self._before = [os.dup(k) for k in range(3)]
        self._python: tuple[TextIO, TextIO] = sys.stdout, sys.stderr
        self._in = os.open(os.devnull, os.O_RDONLY)

    @contextmanager
    def replaced(self, stdin: bytes) -> Iterator[None]:
        """Standard input holds ``stdin``; what is written can be had with `written`."""
        self._python[0].flush(), self._python[1].flush()
        for k, file in enumerate(self._files):
            os.ftruncate(file.fileno(), 0)
            os.lseek(file.fileno(), 0, os.SEEK_SET)
            os.dup2(file.fileno(), k)
        os.write(0, stdin)
        os.lseek(0, 0, os.SEEK_SET)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        try:
            yield
        finally:
            for stream in (sys.stdout, sys.stderr):
                with suppress(ValueError, OSError):
                    stream.flush()
            sys.stdout, sys.stderr = self._python
            for k, before in enumerate(self._before):
                os.dup2(before, k)

    def written(self, k: int) -> str:
        handle = self._files[k].fileno()
        return os.pread(handle, 1 << 22, 0).decode("utf-8", "backslashreplace")


def _memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


_streams: Streams | None = None


def run(args: Sequence[str], stdin: bytes = b"", limit_s: float = LIMIT_S) -> Outcome:
    """`lasercal` with these arguments; never raises, whatever it does."""
    from lasercal_gtsam.cli.main import main

    global _streams
    _streams = _streams or Streams()
    status: Any = None
    trace, faults = "", []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begun, cpu = time.perf_counter(), time.process_time()
        with _streams.replaced(stdin):
            try:
                with _alarm(limit_s):
                    status = main([str(arg) for arg in args])
            except Hang:
                faults.append(f"hang: no end after {limit_s:g} s")
                trace = traceback.format_exc()
            except BaseException as error:
                faults.append(f"traceback: {type(error).__name__}: {error}"[:300])
                trace = traceback.format_exc()
        seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
    outcome = Outcome(status, _streams.written(1), _streams.written(2), seconds, cpu, faults, trace)
    for w in caught:
        where = f"{Path(w.filename).name}:{w.lineno}"
        fault = f"warning: {w.category.__name__}: {w.message} ({where})"[:300]
        if fault not in faults:
            faults.append(fault)
    if not trace:
        faults += _words(outcome, args)
    return outcome


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    def ring(number: int, frame: object) -> None:
        raise Hang

    clocks = (
        (signal.ITIMER_PROF, signal.SIGPROF, 1.0),
        (signal.ITIMER_REAL, signal.SIGALRM, PATIENCE),
    )
    before = [signal.signal(number, ring) for _, number, _ in clocks]
    for timer, _, factor in clocks:
        signal.setitimer(timer, factor * seconds)
    try:
        yield
    finally:
        for timer, _, _ in clocks:
            signal.setitimer(timer, 0)
        for (_, number, _), handler in zip(clocks, before, strict=True):
            signal.signal(number, handler)


def _words(outcome: Outcome, args: Sequence[str]) -> Iterator[str]:
    """What is wrong with status and words."""
    if outcome.status not in (0, 1, 2):
        yield f"status {outcome.status}"
    lines = [line for line in outcome.err.split("\n") if line]
    told = any(_ERROR.match(line) for line in lines)
    if outcome.status == 1 and not (told or _VERDICT.search(outcome.out + outcome.err)):
        yield "status 1 without a line 'Error: ...'"
    if outcome.status in (0, 1):
        odd = [line for line in lines if not _LINE.match(line) and not re.match(r"\d+ spot", line)]
        if odd:
            yield f"stderr: {odd[0]!r}"[:300]
    if "Traceback" in outcome.err:
        yield "stderr: a traceback"
    if _CONTROL.search(outcome.err.replace("\x1b[31m", "").replace("\x1b[0m", "")):
        yield "stderr: control characters"
    if len(outcome.err) > _MOST_TEXT or any(len(line) > _LONGEST_LINE for line in lines):
        yield "stderr: too long to read"
    if not {"nan", "inf", "infinity"} & {
        str(arg).lower().lstrip("+-") for arg in args
    }:  # as names of files
        yield from _not_numbers(outcome.out)


def _not_numbers(out: str) -> Iterator[str]:
    """NaN and infinity have no place in an answer, neither in a table nor (but as words) in JSON.

    "inf" as the name of a plane is none.
    """
    try:
        json.loads(out, parse_constant=_refuse)
        return
    except json.JSONDecodeError:  # a table, or several documents
        pass
    except ValueError as error:
        yield f"stdout: {error}"[:200]
        return
    for line in out.splitlines():
        if line.startswith("{") and line.endswith("}"):
            try:
                json.loads(line, parse_constant=_refuse)
            except ValueError as error:
                yield f"stdout: {error}"[:200]
        elif (match := _NOT_A_NUMBER.search(line)) and not _EVENT.match(line):
            yield f"stdout: {match[0]} in {line.strip()!r}"[:200]


def _refuse(word: str) -> None:
    raise ValueError(f"{word} in JSON")


# --- files --------------------------------------------------------------------------------------


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every regular file below a folder."""
    found = {}
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            if path.is_file() and not path.is_symlink():
                found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def left_behind(
    folder: Path, before: Mapping[str, bytes], status: int | None, results: Sequence[str]
) -> Iterator[str]:
    """What a run did to files beyond its results, or results that cannot be read again.

    ``results`` are names that may be written. With another status than 0 they must be as before,
    but for what is a record of the run and not an answer (journal, history, start).
    """
    after = snapshot(folder)
    for name in sorted(after.keys() | before.keys()):
        if after.get(name) == before.get(name):
            continue
        if name not in after:
            if name.endswith(".writer"):
                continue
            yield f"files: {name} was removed"
        elif name not in results and not _beside(name, results):
            yield f"files: {name} was left behind"
        elif status and name.endswith("calibration.json") and "watch" not in results:
            yield f"files: {name} was written though the status is {status}"
        else:
            yield from _readable(folder / name)


def _beside(name: str, results: Sequence[str]) -> bool:
    stem = Path(name).name
    return any(stem.startswith(f"{result}.") for result in results)


def _readable(path: Path) -> Iterator[str]:
    from lasercal_gtsam.errors import LasercalError
    from lasercal_gtsam.io.calibration_file import load_calibration
    from lasercal_gtsam.io.history_file import read_history
    from lasercal_gtsam.io.journal import JournalReader
    from lasercal_gtsam.io.tables import read_table

    try:
        if path.name.endswith(".journal.jsonl"):
            for _ in JournalReader(path):
                pass
        elif path.name.endswith(".history.csv"):
            read_history(path)
        elif path.name.endswith(".csv"):
            read_table(path)
        elif path.name.endswith(".json"):
            load_calibration(path)
        elif path.name.endswith(".png"):
            import cv2

            if cv2.imread(str(path)) is None:
                yield f"files: {path.name} is no picture"
    except (LasercalError, ValueError) as error:
        yield f"files: {path.name} cannot be read again: {error}"[:300]
