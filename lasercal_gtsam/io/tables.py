"""CSV tables read as columns; every error names file, line and column, all of a file at once."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.files import read_text
from lasercal_gtsam.io.wording import at_most, cannot_be_a_name, nearest, quoted, some

Row = tuple[int, list[str]]


@dataclass
class Table:
    """A CSV file as text columns, with the problems found in it so far.

    Taking columns out adds to the problems; whoever reads asks for `problems` at the end.

    Attributes
    ----------
    name : file name for messages
    columns : column name (lower case) to the N cells of that column, stripped of blanks
    lines : line number of each row in the file
    whole : no row had to be left out because of its length
    """

    name: str
    columns: dict[str, list[str]]
    lines: list[int]
    whole: bool
    _problems: list[tuple[int, str]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.lines)

    def add_problem(self, row: int, text: str) -> None:
        """Note what is wrong in a row (index from 0)."""
        self._problems.append((self.lines[row], text))

    def add_problem_in_line(self, line: int, text: str) -> None:
        """Note what is wrong in a line of the file (from 1)."""
        self._problems.append((line, text))

    def add_file_problem(self, text: str) -> None:
        """Note what is wrong with the file as a whole."""
        self._problems.append((0, text))

    def problems_by_line(self) -> dict[int, list[str]]:
        """Problems so far by line; those of the file as a whole under 0."""
        by_line: dict[int, list[str]] = {}
        for line, text in self._problems:
            by_line.setdefault(line, []).append(text)
        return by_line

    def problems(self) -> list[str]:
        """Every problem so far with file and line, in the order of the lines."""
        ordered = sorted(self._problems, key=lambda problem: problem[0])
        return at_most([f"{self.name}{f':{line}' if line else ''}: {t}" for line, t in ordered])

    def require(self, names: Sequence[str], why: str) -> bool:
        """Check that columns are there; missing ones are a problem. True if none is missing.

        ``why`` says what asks for them ("needed by rotation kuka").
        """
        missing = [name for name in names if name not in self.columns]
        if missing:
            others = [column for column in self.columns if column not in names]
            guesses = [
                f"is {near!r} meant as {name!r}?"
                for name in missing
                if (near := nearest(name, others))
            ]
            self.add_file_problem(
                f"column{'s' if len(missing) > 1 else ''} {', '.join(missing)} missing, {why}; the "
                f"file has {some(list(self.columns), 30)}{''.join(' (' + g + ')' for g in guesses)}"
            )
        return not missing

    def text(self, name: str) -> list[str]:
        """Cells of a column that must not be empty."""
        cells = self.columns[name]
        for row, cell in enumerate(cells):
            if not cell:
                self.add_problem(row, f"{name}: empty, expected a name")
            elif (odd := cannot_be_a_name(cell)) is not None:
                self.add_problem(row, f"{name}: {odd}")
        return cells

    def unique(self, name: str) -> list[str]:
        """Cells of a column that must be neither empty nor the same twice."""
        cells = self.text(name)
        first: dict[str, int] = {}
        for row, cell in enumerate(cells):
            if cell and cell in first:
                earlier = f"already used in line {self.lines[first[cell]]}"
                self.add_problem(row, f"{name}: duplicate {quoted(cell)}, {earlier}")
            first.setdefault(cell, row)
        return cells

    def numbers(
        self, names: Sequence[str], allow_empty: bool = False, largest: float = math.inf
    ) -> Array:
        """Columns as numbers (N, k); a bad cell is a problem and NaN in the result.

        With ``allow_empty`` an empty cell is NaN without being a problem. Numbers may be as large
        as ``largest``, with either sign.
        """
        values = np.empty((len(self), len(names)))
        for k, name in enumerate(names):
            values[:, k] = self._column(name, allow_empty, largest)
        return values

    def _column(self, name: str, allow_empty: bool, largest: float) -> list[float]:
        numbers = []
        for row, cell in enumerate(self.columns[name]):
            if not cell and allow_empty:
                numbers.append(math.nan)
                continue
            number = _number(cell)
            if not math.isfinite(number):
                self.add_problem(row, f"{name}: {_why_not_a_number(cell)}")
                number = math.nan
            elif abs(number) > largest:
                self.add_problem(row, f"{name}: expected at most {largest:g}, got {quoted(cell)}")
                number = math.nan
            numbers.append(number)
        return numbers


def _number(cell: str) -> float:
    """The number, or NaN; Python's own reader also takes 1_000 and digits of other scripts."""
    try:
        return float(cell) if cell.isascii() and "_" not in cell else math.nan
    except ValueError:
        return math.nan


def _why_not_a_number(cell: str) -> str:
    if not cell:
        return "empty, expected a number"
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return f"expected a finite number, got {quoted(cell)}"
    if "," in cell and math.isfinite(_number(cell.replace(",", "."))):
        return f"expected a number with a decimal point, got {quoted(cell)} with a decimal comma"
    if cell.isascii() and "_" not in cell and _number(cell) == math.inf:
        return f"expected a finite number, got {quoted(cell)}"
    return f"expected a number, got {quoted(cell)}"


def read_table(path: Path, name: str | None = None) -> Table:
    """Read a CSV file: first line the column names (any case), then rows; blank lines are skipped.

    Parameters
    ----------
    path : file
    name : what messages call it; None: the file's name

    Raises
    ------
    DataError
        The file cannot be read, is empty, or is no table separated by commas. What is wrong inside
        the table (columns twice, rows of another length than the first line) is only noted, so
        that it can be reported together with what the caller finds.
    """
    name = path.name if name is None else name
    rows = _rows(read_text(path), name)
    if not rows:
        raise DataError(
            f"{name}: the file is empty; expected a line of column names and rows of numbers"
        )
    table = table_of(rows[0], rows[1:], name)
    if len(rows) == 1:
        table.add_file_problem("there are column names but no rows")
    return table


def table_of(header: Row, body: Sequence[Row], name: str) -> Table:
    """Table of rows that are already split into cells.

    Parameters
    ----------
    header, body : line number and cells, of the column names and of the rows
    name : what messages call the file

    Raises
    ------
    DataError
        The header is none; what else is wrong is only noted, as in `read_table`.
    """
    header_line, titles = header
    _check_separator(titles, f"{name}:{header_line}")
    whole = [(line, cells) for line, cells in body if len(cells) == len(titles)]
    names = [cell.strip().lower() for cell in titles]
    columns: dict[str, list[str]] = {}
    for k, column in enumerate(names):
        columns.setdefault(column, [cells[k].strip() for _, cells in whole])
    table = Table(
        name=name,
        columns=columns,
        lines=[line for line, _ in whole],
        whole=len(whole) == len(body),
    )
    for text in _repeated_columns(names):
        table.add_problem_in_line(header_line, text)
    for line, cells in body:
        if len(cells) != len(titles):
            hint = "; is there a decimal comma?" if len(cells) > len(titles) else ""
            table.add_problem_in_line(
                line, f"{len(cells)} cells, expected {len(titles)} as in the first line{hint}"
            )
    columns.pop("", None)
    return table


def _rows(text: str, name: str) -> list[Row]:
    """Rows that are not blank, with their line numbers."""
    reader = csv.reader(io.StringIO(text, newline=None), strict=True, skipinitialspace=True)
    try:
        rows = [(reader.line_num, cells) for cells in reader]
    except csv.Error as error:
        raise DataError(f"{name}:{reader.line_num}: not a row of CSV: {error}") from None
    return [(line, cells) for line, cells in rows if any(cell.strip() for cell in cells)]


def _check_separator(header: list[str], where: str) -> None:
    for separator, label in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
        if sum(cell.count(separator) for cell in header) >= len(header):
            raise DataError(
                f"{where}: the columns are separated by {label}; expected commas between the "
                "columns, and a point as decimal sign"
            )
    if len(header) == 1 and len(header[0].split()) > 1:
        raise DataError(f"{where}: the columns are separated by blanks; expected commas")
    if all(math.isfinite(_number(cell)) for cell in header):
        raise DataError(f"{where}: expected column names, got numbers: {some(header)}")


def _repeated_columns(names: list[str]) -> list[str]:
    return [
        f"column {quoted(column)} is there {count} times"
        for column, count in Counter(names).items()
        if column and count > 1
    ]
