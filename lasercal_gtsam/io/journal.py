"""An append-only journal: what it acknowledged is on the disk, whatever happens afterwards.

The lines are described in `journal_lines`.

One process writes at a time, held by `fcntl.flock` on the file itself: the lock ends with the
process, however it dies (and with its forked children, which share it). Keep the journal on a
local disk: whether a lock or a sync on a network drive means anything depends on the server.
``<name>.writer`` beside it says which process that is, or last was. Reading needs no lock.
"""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import write_bytes
from lasercal_gtsam.io.journal_lines import (
    FORMAT,
    VERSION,
    Damage,
    JournalReader,
    Record,
    Scan,
    header_of,
    salvage,
    sealed,
)
from lasercal_gtsam.io.plain import observations_to_dict
from lasercal_gtsam.observations import Observations

__all__ = [
    "Damage",
    "Journal",
    "JournalReader",
    "Record",
    "observations_from",
    "salvage",
    "spots_payload",
]


class Journal:
    """A journal open for writing, by one thread. Use `create` or `open`, best as a context manager.

    Attributes
    ----------
    path : Path
    about : dict
        What the header keeps for the caller.
    created : str
        When the journal was created, ISO 8601, UTC.
    repaired : str or None
        What opening had to cut off from the end of the file and where that is kept, as a sentence.
    count : int
        Records in the journal, which is also the number of the last one.
    """

    def __init__(self, path: str | Path, about: Mapping[str, Any] | None, *, new: bool) -> None:
        self.path = Path(path)
        self.repaired: str | None = None
        self.count = -1
        self._end = 0  # bytes that are known to be whole records on the disk
        self._settled = True  # nothing of an append that failed is left after them
        self._locked = False
        self._note = _beside(self.path, "writer")
        try:
            create = 0 if about is None else os.O_CREAT
            self._file = os.open(self.path, os.O_RDWR | os.O_CLOEXEC | create, 0o666)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be opened: {error.strerror}") from None
        try:
            self._lock()
            try:
                self._begin(about, new)
            except OSError as error:
                raise DataError(f"{self.path}: {error.strerror}") from None
        except BaseException:
            self.close()
            raise

    @classmethod
    def create(cls, path: str | Path, about: Mapping[str, Any]) -> Journal:
        """Start a journal; when this returns, its header is on the disk.

        A file that is empty, or holds only a header that was never finished, is taken over.

        Parameters
        ----------
        path : str or Path
        about : dict
            Kept in the header: plain dicts, lists, strings, finite numbers.

        Raises
        ------
        DataError
            There is a journal (or another file) already, or it cannot be written.
        """
        return cls(path, about, new=True)

    @classmethod
    def open(cls, path: str | Path, about: Mapping[str, Any] | None = None) -> Journal:
        """Go on with a journal; with ``about``, start it if there is none.

        A damaged end, which no acknowledged record follows, is cut off, kept in
        ``<name>.damaged-<offset>`` and reported in `repaired`. The whole records before it stay,
        also those whose writer died before it was told that they are safe: ask the journal, not
        the memory of what was sent, what it holds.

        Raises
        ------
        DataError
            No such file, not a journal, a newer one, damaged elsewhere than at its end, or open
            for writing already.
        """
        return cls(path, about, new=False)

    def append(self, kind: str, payload: Mapping[str, Any]) -> int:
        """Write one record; returns its number once it is on the disk.

        Parameters
        ----------
        kind : str
            What it is; any word but the name of the format.
        payload : dict
            Plain dicts with text keys, lists, strings, finite numbers, booleans, None.

        Raises
        ------
        DataError
            The record cannot be said in JSON, or not be written. Then it does not count, the
            journal is as it was, and the next call tries again from there.
        """
        return self.append_many([(kind, payload)])[0]

    def append_many(self, records: Iterable[tuple[str, Mapping[str, Any]]]) -> range:
        """Write several records in one sync; returns their numbers. See `append`.

        A crash meanwhile can leave the first few of them, each whole.
        """
        first = self.count + 1
        lines = []
        for seq, (kind, payload) in enumerate(records, first):
            if kind == FORMAT:
                raise DataError(f"{self.path}: the kind {FORMAT!r} is for the header alone")
            lines.append(sealed(seq, first, kind, payload))
        if lines:
            self._write(b"".join(lines), len(lines))
        return range(first, first + len(lines))

    def close(self) -> None:
        """Let the next writer in. Nothing is left to be written; closing twice does no harm."""
        if self._file >= 0:
            if self._locked:
                with suppress(OSError):
                    self._note.unlink()
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = "another writer"
            with suppress(OSError, UnicodeDecodeError):
                who = self._note.read_text("utf-8").strip() or who
            raise DataError(
                f"{self.path}: {who} has this journal open for writing; end that one first, or "
                "give this run a journal of its own"
            ) from None
        except OSError as error:
            raise DataError(
                f"{self.path}: cannot be locked ({error.strerror}), so a second writer could not "
                "be kept out; put the journal on a local disk"
            ) from None
        self._locked = True
        who = f"process {os.getpid()} on {socket.gethostname()} (since {_now()})"
        with suppress(OSError):  # only for the message above; a full disk is reported by the write
            self._note.write_text(who + "\n", "utf-8")

    def _begin(self, about: Mapping[str, Any] | None, new: bool) -> None:
        with os.fdopen(self._file, "rb", closefd=False) as handle:
            scan = Scan(self.path, handle)
            header = scan.header() if about is None else scan.find_header()
            if header is not None and new:
                raise DataError(
                    f"{self.path}: there is a journal already; open it to go on with it, or choose "
                    "another name"
                )
            for _ in scan.lines:
                pass
            self._end = scan.at.offset
            if scan.tail is not None:
                handle.seek(self._end)
                rest, kept = handle.read(), self._free_name(self._end)
                write_bytes(kept, rest)
                self.repaired = f"{scan.tail}; these {len(rest)} bytes were cut off, kept in {kept}"
        # What a killed writer left may still be in memory only, and counts from now on.
        self._cut_back()
        if header is None:
            payload = {"version": VERSION, "created": _now(), "about": dict(about or {})}
            line = sealed(0, 0, FORMAT, payload)
            self._write(line, 1)
            header = header_of(self.path, line)
        else:
            self.count = scan.at.seq - 1
        self.created, self.about = header
        folder = os.open(self.path.resolve().parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _free_name(self, offset: int) -> Path:
        name = path = _beside(self.path, f"damaged-{offset}")
        again = 2
        while path.exists():
            path = name.with_name(f"{name.name}-{again}")
            again += 1
        return path

    def _write(self, lines: bytes, count: int) -> None:
        if self._file < 0:
            raise DataError(f"{self.path}: the journal is closed")
        try:
            status = os.fstat(self._file)
            surplus = status.st_size - self._end
            if surplus < 0 or (surplus and self._settled) or not status.st_nlink:
                raise DataError(
                    f"{self.path}: was changed or deleted by another program while it was open "
                    f"({self._end} bytes expected, {status.st_size} found, in "
                    f"{status.st_nlink} folders); nothing more is written to it: close it, look "
                    "what happened, open it again"
                )
            if not self._settled:
                self._cut_back()
            self._settled = False
            done = 0
            while done < len(lines):
                done += os.pwrite(self._file, lines[done:], self._end + done)
            _sync(self._file)
        except OSError as error:
            with suppress(OSError):  # tried again by the next call, which then says so
                self._cut_back()
            raise DataError(
                f"{self.path}: the record could not be written: {error.strerror}; it does not "
                f"count, {max(self.count, 0)} records before it are safe"
            ) from None
        self._end += len(lines)
        self.count += count
        self._settled = True

    def _cut_back(self) -> None:
        """Leave only what is known to be good, on the disk too.

        After a sync that failed, the system may hold pages for clean that never arrived. Cutting
        the file, and the next append, touch each page again in which such bytes could be.
        """
        os.ftruncate(self._file, self._end)
        _sync(self._file)
        self._settled = True


def spots_payload(observations: Observations) -> dict[str, Any]:
    """Observations as the payload of a record, exact to the last bit; `observations_from` reads it.

    Columns: ``id, plane, camera, laser``, ``image_size`` (px) by camera, ``uv`` (px), ``cov_uv``
    (px^2, null: not known) and ``T_base_hand`` (metres), the last two row-major.
    """
    return observations_to_dict(observations)


def observations_from(payload: Mapping[str, Any]) -> Observations:
    """The observations that `spots_payload` was given; other keys of the payload do not matter.

    Raises
    ------
    DataError
        The payload is not one of spots, or says something that cannot be.
    """
    try:
        count = len(payload["id"])
        cov = np.full((count, 4), np.nan) if payload["cov_uv"] is None else payload["cov_uv"]
        return Observations(
            uv=np.array(payload["uv"], dtype=np.float64).reshape(count, 2),
            cov_uv=np.array(cov, dtype=np.float64).reshape(count, 2, 2),
            T_base_hand=np.array(payload["T_base_hand"], dtype=np.float64).reshape(count, 4, 4),
            image_size=payload["image_size"],
            stop=payload.get("stop"),
            **{name: payload[name] for name in ("camera", "laser", "plane", "id")},
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"these are no spots: {type(error).__name__}: {error}") from None


def _sync(handle: int) -> None:
    """Wait until the content is on the disk; macOS leaves it in the drive's cache unless asked."""
    full = getattr(fcntl, "F_FULLFSYNC", None)
    if full is None:
        os.fdatasync(handle)
    else:
        fcntl.fcntl(handle, full)


def _beside(path: Path, suffix: str) -> Path:
    path = path.resolve()
    return path.with_name(f"{path.name}.{suffix}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
