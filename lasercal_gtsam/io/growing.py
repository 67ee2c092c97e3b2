"""A CSV file that grows while it is read: whole lines as they come, whatever happens to the file.

Only what is new is read, so that the cost does not grow with the file. A file that was replaced,
cut or changed before its end is read again from the start.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lasercal_gtsam.io.files import reason_of
from lasercal_gtsam.io.tables import Row

Clock = Callable[[], float]

# Bytes before the place where reading goes on that must still be the same.
_OVERLAP = 4096
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class Grown:
    """What one look at the file gave.

    Attributes
    ----------
    rows : line number and cells of whole lines that are new (or read again)
    problems : line number and what is wrong, for lines that are no text or no CSV; line 0: the file
    again : the file was read from its start, as at the first time
    """

    rows: tuple[Row, ...] = ()
    problems: tuple[tuple[int, str], ...] = ()
    again: bool = False


class GrowingTable:
    """Reads a CSV file again and again, each line once.

    A line without its line end is not complete yet and waits. A quoted cell must not hold a line
    end: every line stands for itself, so that one bad line costs only itself.

    Attributes
    ----------
    header : line number and cells of the first line that is not blank; None until it is there
    unfinished : line number of a last line without line end, or 0
    exists : whether the file was there at the last look
    """

    def __init__(self, path: Path, clock: Clock = time.monotonic) -> None:
        self.path, self._clock = path, clock
        self.header: Row | None = None
        self.unfinished = 0
        self.exists = False
        self._seen: tuple[int, ...] | None = None
        self._changed = clock()
        self._start_over()

    def read(self) -> Grown:
        """Look at the file once."""
        try:
            status = self.path.stat()
            seen = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
            self.exists = True
            if seen == self._seen:
                return Grown()
            content, again = self._new_bytes(seen)
        except FileNotFoundError:
            # some programs remove a file before they write it anew: what is known stays known
            self.exists, self._seen = False, None
            return Grown()
        except OSError as error:
            self._seen = None
            return Grown(problems=((0, reason_of(error)),))
        self._seen, self._changed = seen, self._clock()
        return self._take(content, again)

    @property
    def quiet(self) -> float:
        """Seconds since the file was seen to change."""
        return self._clock() - self._changed

    def read_again(self) -> None:
        """Let the next look begin at the file's start."""
        self._seen = None

    def _start_over(self) -> None:
        self.header = None
        self._offset = self._line = 0
        self._overlap = b""

    def _new_bytes(self, seen: tuple[int, ...]) -> tuple[bytes, bool]:
        """Everything behind the last whole line; or the whole file, where it is another one."""
        before = self._seen
        grown = before is not None and seen[:2] == before[:2] and seen[2] > before[2]
        with self.path.open("rb") as file:
            if grown:
                file.seek(self._offset - len(self._overlap))
                if file.read(len(self._overlap)) == self._overlap:
                    return file.read(), False
            self._start_over()
            file.seek(0)
            return file.read(), True

    def _take(self, content: bytes, again: bool) -> Grown:
        end = content.rfind(b"\n") + 1
        whole = content[:end]
        rows: list[Row] = []
        problems: list[tuple[int, str]] = []
        for number, line in enumerate(whole.split(b"\n")[:-1], start=self._line + 1):
            try:
                cells = _cells(line.removeprefix(_BOM) if number == 1 else line)
            except (UnicodeDecodeError, csv.Error) as error:
                problems.append((number, _why_no_row(error)))
                continue
            if not any(cell.strip() for cell in cells):
                continue
            if self.header is None:
                self.header = (number, cells)
            else:
                rows.append((number, cells))
        self._line += whole.count(b"\n")
        self._offset += end
        self._overlap = (self._overlap + whole)[-_OVERLAP:]
        self.unfinished = self._line + 1 if content[end:].strip() else 0
        return Grown(tuple(rows), tuple(problems), again)


def _cells(line: bytes) -> list[str]:
    text = line.decode("utf-8").rstrip("\r")
    return next(csv.reader([text], strict=True, skipinitialspace=True), [])


def _why_no_row(error: UnicodeDecodeError | csv.Error) -> str:
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.object[error.start]:#04x} is not UTF-8 text; save the file as UTF-8"
    return f"not a row of CSV: {error}"
