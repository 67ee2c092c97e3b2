"""The lines of a journal: how a record is sealed, and how a file is read, whole or damaged.

One record a line, each a JSON object of its own::

    {"seq":18,"batch":18,"kind":"spots","payload":{...},"crc":"1c291ca3"}

``seq`` counts the records from the header, 0, without a gap. ``batch`` is the number of the first
record that went to the disk in the same sync: everything below it was acknowledged before this
line was written. ``crc`` is the CRC-32 of the line up to the comma before it. So every kind of
damage shows, and the kind that an interrupted write leaves (bytes at the end, of which nobody was
told that they are safe) can be told from the others.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lasercal_gtsam.errors import DataError

FORMAT = "lasercal-journal"
VERSION = 1

_MAGIC = f'{{"seq":0,"batch":0,"kind":"{FORMAT}"'.encode()
_START = re.compile(rb'\{"seq":(\d+),"batch":(\d+),"kind":"')
_SEAL = b',"crc":"%08x"}\n'
_SEAL_LENGTH = len(_SEAL % 0)
_to_json = json.JSONEncoder(allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode


@dataclass(frozen=True)
class Record:
    """One record: its number (from 1), what it is, and its content."""

    seq: int
    kind: str
    payload: dict[str, Any]


@dataclass(frozen=True)
class Damage:
    """A stretch of the file that is no record, or a place where records are missing.

    Attributes
    ----------
    line, offset, length : where: line from 1, bytes from the start of the file
    problem : what was found, for a sentence
    torn : whether an interrupted write can leave this; otherwise the bytes are whole records, but
        numbers are missing or come again
    """

    line: int
    offset: int
    length: int
    problem: str
    torn: bool = True


class JournalReader:
    """The records of a journal, one after the other, also while another process writes to it.

    Iterating needs little memory however long the journal is, and may be done again.

    Parameters
    ----------
    path : str or Path

    Attributes
    ----------
    created, about : as in `journal.Journal`
    tail : str or None
        After iterating: what the end of the file holds beyond the last whole record (a record
        being written just now, or one that never was finished), as a sentence.

    Raises
    ------
    DataError
        No such file, empty, not a journal, a newer one; while iterating: damaged elsewhere than
        at the end, or numbers that are missing or come again.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.tail: str | None = None
        with _reading(self.path) as handle:
            self.created, self.about = Scan(self.path, handle).header()

    def __iter__(self) -> Iterator[Record]:
        with _reading(self.path) as handle:
            scan = Scan(self.path, handle)
            scan.header()
            for line in scan.lines:
                yield _record(self.path, line)
            self.tail = scan.tail


def salvage(path: str | Path) -> Iterator[Record | Damage]:
    """Everything that a damaged journal still gives, in the order of the file.

    The way out where `JournalReader` and `journal.Journal.open` refuse. What was lost is for a
    person to judge; what is left can go on as a new journal::

        kept = (r for r in salvage(old) if isinstance(r, Record))
        with Journal.create(new, about) as journal:
            journal.append_many((r.kind, r.payload) for r in kept)

    Raises
    ------
    DataError
        The file cannot be read.
    """
    path = Path(path)
    with _reading(path) as handle:
        for found in _walk(handle, _Place(1, 0, 0)):
            if isinstance(found, Damage):
                yield found
            elif found.seq:
                try:
                    yield _record(path, found)
                except DataError as error:
                    yield Damage(found.line, found.offset, len(found.raw), str(error), torn=False)


class Header(NamedTuple):
    """What the first record says."""

    created: str
    about: dict[str, Any]


class _Place(NamedTuple):
    """Where a line begins, and the number that its record must have."""

    line: int
    offset: int
    seq: int


class _Line(NamedTuple):
    """A line whose checksum fits."""

    raw: bytes
    seq: int
    batch: int
    line: int
    offset: int


class Scan:
    """The whole records of a file up to its end or a torn tail; raises at any other damage."""

    def __init__(self, path: Path, handle: BinaryIO) -> None:
        self._path = path
        self._handle = handle
        self.at = _Place(1, 0, 0)
        self.tail: str | None = None
        self.lines = self._lines()

    def header(self) -> Header:
        """The header; DataError if there is none."""
        header = self.find_header()
        if header is None:
            found = self.tail or f"{self._path}: the file is empty"
            raise DataError(
                f"{found}; expected a journal, whose first line is its header. If it was being "
                "created when the program ended, nothing is lost: remove it and start again"
            )
        return header

    def find_header(self) -> Header | None:
        """The header; None in a file that holds nothing, or a header that was never finished."""
        start = self._handle.read(len(_MAGIC))
        while start and not start.strip(b"\0"):  # all that a power cut may leave of a new file
            start = self._handle.read(len(_MAGIC))
        start = start.rstrip(b"\0")
        if not _MAGIC.startswith(start):
            raise DataError(
                f"{self._path}: not a journal: expected it to begin with {_MAGIC.decode()}, found "
                f"{start.decode(errors='replace')!r}"
            )
        line = next(self.lines, None)
        return None if line is None else header_of(self._path, line.raw)

    def _lines(self) -> Iterator[_Line]:
        while True:
            for found in _walk(self._handle, self.at):
                if isinstance(found, Damage):
                    break
                self.at = _Place(found.line + 1, found.offset + len(found.raw), found.seq + 1)
                yield found
            else:
                return
            if self._is_torn():
                return

    def _is_torn(self) -> bool:
        """Whether a torn tail begins here; False if a writer has mended it since it was read."""
        first: Damage | None = None
        whole, safe = 0, False
        for found in _walk(self._handle, self.at):
            if isinstance(found, Damage):
                first = first or found
                safe |= not found.torn
            elif first is None:
                return False
            else:
                whole += 1
                safe |= found.batch > self.at.seq
        if first is None:
            return False
        where = f"{self._path}:{first.line}: byte {first.offset}: {first.problem}"
        if safe:
            after = f", with {whole} whole records after it" if whole else ""
            raise DataError(
                f"{where}{after}: no interrupted write leaves this, so nothing is cut off. Put "
                "back a copy of the file, or see what is left with "
                "lasercal_gtsam.io.journal.salvage"
            )
        more = f", then {whole} whole records of the same unfinished write" if whole else ""
        self.tail = where + more
        return True


def _walk(handle: BinaryIO, at: _Place) -> Iterator[_Line | Damage]:
    """Lines and damage from a place to the end of the file."""
    handle.seek(0, os.SEEK_END)  # empties the buffer: what was read before may have changed
    handle.seek(at.offset)
    line, offset, expected = at
    sound = True
    for raw in handle:
        fields = _fields(raw)
        if isinstance(fields, str):
            yield Damage(line, offset, len(raw), fields)
            if not raw.endswith(b"\n"):
                return  # the end, even if a writer adds to it at this moment
            sound = False
        else:
            seq, batch = fields
            if seq < expected:
                yield Damage(line, offset, len(raw), _jump(expected, seq), torn=False)
            else:
                if seq > expected and sound:
                    yield Damage(line, offset, 0, _jump(expected, seq), torn=False)
                sound, expected = True, seq + 1
                yield _Line(raw, seq, batch, line, offset)
        line += 1
        offset += len(raw)


def _jump(expected: int, found: int) -> str:
    return f"expected record {expected}, found record {found}"


def _fields(raw: bytes) -> tuple[int, int] | str:
    """``seq`` and ``batch`` of a line, or what is wrong with it."""
    if raw[-_SEAL_LENGTH:] == _SEAL % zlib.crc32(raw[:-_SEAL_LENGTH]):
        start = _START.match(raw)
        return (int(start[1]), int(start[2])) if start else "the line does not begin as a record"
    if not raw.strip(b"\0"):
        return f"{len(raw)} bytes of NUL, which a power cut can leave"
    return "the checksum does not fit" if raw.endswith(b"\n") else "the line has no end"


def sealed(seq: int, batch: int, kind: str, payload: Mapping[str, Any]) -> bytes:
    """The line of a record; DataError if it cannot be said in JSON."""
    content = {"seq": seq, "batch": batch, "kind": kind, "payload": dict(payload)}
    try:
        # surrogates: names of files that are not UTF-8
        body = _to_json(content)[:-1].encode(errors="surrogatepass")
    except (TypeError, ValueError) as error:
        raise DataError(f"a {kind!r} record cannot be written as JSON: {error}") from None
    return body + _SEAL % zlib.crc32(body)


def _record(path: Path, line: _Line) -> Record:
    try:
        content = json.loads(line.raw)
        return Record(line.seq, content["kind"], _object(content["payload"]))
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}:{line.line}: not a record of this format: {error!r}") from None


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"expected an object, got {value!r:.60}")
    return value


def header_of(path: Path, raw: bytes) -> Header:
    """What the first line says; DataError if it is of another version."""
    try:
        payload = json.loads(raw)["payload"]
        version = payload["version"]
        if version == VERSION:
            return Header(payload["created"], _object(payload["about"]))
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}:1: the header cannot be understood: {error!r}") from None
    raise DataError(
        f"{path}: the journal has version {version!r}, this program knows {VERSION}; use the "
        "program that wrote it, or a newer one"
    )


@contextmanager
def _reading(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as handle:
            yield handle
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
