"""The tables of a growing capture: new rows under their ids, and what is wrong with the files."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture_head import CaptureHead
from lasercal_gtsam.io.capture_rows import rows_of
from lasercal_gtsam.io.growing import Clock, GrowingTable
from lasercal_gtsam.io.tables import Row, Table, table_of

# Seconds without a change after which a last line without line end is worth a word.
PATIENCE_S = 5.0


class NewRow(NamedTuple):
    """A row as it stands in a file, under its id."""

    file: str
    label: str
    row: Row


@dataclass
class News:
    """What one look at the tables gave.

    Attributes
    ----------
    rows : new rows, those of the poses first
    again : files that were read from their start: what they do not say again is gone
    new_header : whether the meaning of rows has changed
    wrong : what is wrong with single lines
    broken : why a file is of no use as it is
    missing : files that are not there
    """

    rows: list[NewRow] = field(default_factory=list)
    again: list[str] = field(default_factory=list)
    new_header: bool = False
    wrong: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


class CaptureTables:
    """Poses and spots of a capture, read again and again.

    Attributes
    ----------
    poses_file, spots_file : names as in ``capture.yaml``; the second may be None
    usable : whether the headers say all that is needed
    """

    def __init__(self, head: CaptureHead, path: Path, clock: Clock = time.monotonic) -> None:
        self.poses_file = head.poses.file
        self.spots_file = None if head.spots is None else head.spots.file
        self.usable = False
        self._head, self._name = head, path.name
        names = [self.poses_file, *([self.spots_file] if self.spots_file else [])]
        self._files = {name: GrowingTable(path.parent / name, clock) for name in names}
        self._headers: list[Row | None] = [None] * len(names)

    def read(self) -> News:
        """Look at the files once."""
        news = News()
        found: list[tuple[str, Row]] = []
        for name, file in self._files.items():
            grown = file.read()
            if grown.again:
                news.again.append(name)
            found += [(name, row) for row in grown.rows]
            for line, text in grown.problems:
                (news.wrong if line else news.broken).append(at_line(name, line, text))
            if not file.exists:
                news.missing.append(name)
        headers = [file.header for file in self._files.values()]
        if headers != self._headers:
            self._headers, news.new_header = headers, True
            for name, file in self._files.items():
                # its rows were read beside another header, or not used at all
                if name not in news.again:
                    file.read_again()
            news.broken += self._header_problems()
            self.usable = not news.broken and headers[0] is not None
        if self.usable:
            for name, row in found:
                label, problem = self._label(name, row)
                if problem:
                    news.wrong.append(at_line(name, row[0], problem))
                else:
                    news.rows.append(NewRow(name, label, row))
        return news

    def poses(self, rows: Sequence[Row]) -> Table:
        """Rows of the poses as a table."""
        header = self._files[self.poses_file].header
        assert header is not None
        return table_of(header, rows, self.poses_file)

    def spots(self, rows: Sequence[Row]) -> Table | None:
        """Rows of the spots as a table, where there is one."""
        header = None if self.spots_file is None else self._files[self.spots_file].header
        if header is None or self.spots_file is None:
            return None
        return table_of(header, rows, self.spots_file)

    def unfinished(self) -> list[tuple[str, bool]]:
        """Files and lines that have no line end yet, and whether it is so for long."""
        return [
            (f"{name}:{file.unfinished}", file.quiet >= PATIENCE_S)
            for name, file in self._files.items()
            if file.exists and file.unfinished
        ]

    def _header_problems(self) -> list[str]:
        """What is wrong with the column names, as far as they are there."""
        if self._files[self.poses_file].header is None:
            return []
        try:
            poses, spots = self.poses([]), self.spots([])
            rows_of(self._head, poses, spots)
        except DataError as error:
            return list(error.problems)
        problems = [*poses.problems(), *(spots.problems() if spots else [])]
        with_spots = "u" in poses.columns or self.spots_file or self._head.images
        if not problems and not with_spots:
            problems.append(
                f"{self._name}: there are no spots: give columns u, v in {self.poses_file}, "
                "spots: {file: spots.csv}, or images: images/{id}.png"
            )
        return problems

    def _label(self, name: str, row: Row) -> tuple[str, str]:
        """Id of a row, or "" and why it has none."""
        header = self._files[name].header
        assert header is not None
        titles, cells = [title.strip().lower() for title in header[1]], row[1]
        if len(cells) != len(titles):
            return "", f"{len(cells)} cells, expected {len(titles)} as in the first line"
        label = cells[titles.index("id")].strip()
        return label, "" if label else "id: empty, expected a name"


def at_line(name: str, line: int, text: str) -> str:
    """A message with its place; line 0 is the file as a whole."""
    return f"{name}:{line}: {text}" if line else f"{name}: {text}"


def without_repeats(rows: Sequence[tuple[str, Row]]) -> Iterator[list[tuple[str, Row]]]:
    """The rows in parts, in each of which no id comes twice."""
    rest = list(rows)
    while rest:
        part: dict[str, tuple[str, Row]] = {}
        later = []
        for item in rest:
            if item[0] in part:
                later.append(item)
            else:
                part[item[0]] = item
        yield list(part.values())
        rest = later
