"""``history.csv``: the trace of every parameter and its sigma, for tables, plots and other tools.

Columns: ``spots, rms_px, sigma0``, then for every parameter ``<name> [<unit>]`` and
``sigma_<name> [<unit>]``, then ``event``. Cells are empty where a parameter was not there yet (a
plane that came later); a sigma alone is empty where it was not known, and 0 where the value is
held. Numbers are exact. Several events of a row are separated by `` | ``.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from lasercal_gtsam.calibration import Calibration, Parameter
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.history import HistoryRow
from lasercal_gtsam.io.files import read_text, write_text
from lasercal_gtsam.io.wording import at_most, quoted

_FIRST, _LAST = ("spots", "rms_px", "sigma0"), "event"
_SIGMA = "sigma_"
_BETWEEN = " | "
_TITLE = re.compile(r"(?P<name>.+) \[(?P<unit>.*)\]")

Name = tuple[str, str]


def history_path(result: str | Path) -> Path:
    """Where the history of a result lies: ``calibration.history.csv`` of ``calibration.json``."""
    result = Path(result)
    return result.with_name(f"{result.stem}.history.csv")


def write_history(path: str | Path, rows: Sequence[HistoryRow]) -> None:
    """Write a history atomically.

    Raises
    ------
    DataError
        The file cannot be written.
    """
    names = parameter_names(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    titles = [f"{prefix}{name} [{unit}]" for name, unit in names for prefix in ("", _SIGMA)]
    writer.writerow([*_FIRST, *titles, _LAST])
    for row in rows:
        cells = [str(row.spots), _cell(row.rms_px), _cell(row.sigma0)]
        there = {(p.name, p.unit): p for p in row.parameters}
        for name in names:
            p = there.get(name)
            cells += ["", ""] if p is None else [_cell(p.refined), _cell(p.sigma)]
        events = (event.replace("|", "/").replace("\n", " ") for event in row.events)
        writer.writerow([*cells, _BETWEEN.join(events)])
    write_text(path, text.getvalue())


def parameter_names(rows: Iterable[HistoryRow]) -> list[Name]:
    """Names and units of all parameters; each stands where it stood in the rows that had it."""
    order: list[Name] = []
    before: list[Name] = []
    for row in rows:
        names = [(p.name, p.unit) for p in row.parameters]
        if names == before:
            continue
        before, place = names, 0
        for name in names:
            if name in order:
                place = order.index(name) + 1
            else:
                order.insert(place, name)
                place += 1
    return order


def earlier_rows(path: Path, spots: int) -> tuple[HistoryRow, ...]:
    """Rows of a history file before a number of spots; none where there is no file.

    Raises
    ------
    DataError
        As in `read_history`.
    """
    rows = read_history(path) if path.exists() else ()
    return tuple(row for row in rows if row.spots < spots)


def up_to_now(rows: Sequence[HistoryRow], spots: int, calibration: Calibration) -> list[HistoryRow]:
    """The rows, and one more for the state now where the last one is older: rows are thinned."""
    if rows and rows[-1].spots >= spots:
        return list(rows)
    fit = calibration.fit
    return [*rows, HistoryRow(spots, fit.rms_px, fit.sigma0, calibration.parameters)]


def read_history(path: str | Path) -> tuple[HistoryRow, ...]:
    """Read a history; ``initial`` of its parameters, which is not in the file, is NaN.

    Raises
    ------
    DataError
        The file cannot be read or is no history; with line and column.
    """
    path = Path(path)
    lines = _lines(path)
    titles = [title.strip() for title in lines[0][1]]
    if tuple(titles[: len(_FIRST)]) != _FIRST or titles[-1] != _LAST:
        raise DataError(
            f"{path}: not a history: expected the columns {', '.join(_FIRST)}, then parameters, "
            f"then {_LAST}"
        )
    names = _names(titles[len(_FIRST) : -1], str(path))
    problems: list[str] = []
    rows = [_row(f"{path}:{line}", titles, cells, names, problems) for line, cells in lines[1:]]
    if problems:
        raise DataError(*at_most(problems))
    return tuple(rows)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, with their line numbers."""
    reader = csv.reader(io.StringIO(read_text(path), newline=None), strict=True)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(cells)]
    except csv.Error as error:
        raise DataError(f"{path}:{reader.line_num}: not a row of CSV: {error}") from None
    if not lines:
        raise DataError(f"{path}: the file is empty")
    return lines


def _names(titles: Sequence[str], path: str) -> list[Name]:
    """Parameters out of pairs of columns."""
    names = []
    for k in range(0, len(titles), 2):
        match = _TITLE.fullmatch(titles[k])
        if match is None or list(titles[k + 1 : k + 2]) != [f"{_SIGMA}{titles[k]}"]:
            raise DataError(
                f"{path}:1: {titles[k]}: expected a column <name> [<unit>], and then its sigma in "
                "sigma_<name> [<unit>]"
            )
        names.append((match["name"], match["unit"]))
    return names


def _row(
    where: str,
    titles: Sequence[str],
    cells: Sequence[str],
    names: Sequence[Name],
    problems: list[str],
) -> HistoryRow:
    if len(cells) != len(titles):
        problems.append(f"{where}: {len(cells)} cells, expected {len(titles)}")
        return HistoryRow(0, math.nan, math.nan, ())
    numbers = []
    for title, cell in zip(titles[:-1], cells, strict=False):
        try:
            numbers.append(_number(cell, title.startswith(_SIGMA)))
        except ValueError as error:
            problems.append(f"{where}: {title}: {error}, got {quoted(cell)}")
            numbers.append(math.nan)
    if not (math.isfinite(numbers[0]) and numbers[0] == int(numbers[0]) >= 0):
        problems.append(f"{where}: spots: expected a whole number, got {quoted(cells[0])}")
        numbers[0] = 0.0
    values, sigmas = numbers[len(_FIRST) :: 2], numbers[len(_FIRST) + 1 :: 2]
    return HistoryRow(
        spots=int(numbers[0]),
        rms_px=numbers[1],
        sigma0=numbers[2],
        parameters=tuple(
            Parameter(name, math.nan, value, sigma, unit)
            for (name, unit), value, sigma in zip(names, values, sigmas, strict=True)
            if not math.isnan(value)
        ),
        events=tuple(cells[-1].split(_BETWEEN)) if cells[-1] else (),
    )


def _number(cell: str, is_sigma: bool) -> float:
    """The number of a cell, NaN where it is empty; a sigma may be infinite, but not negative."""
    if not cell.strip():
        return math.nan
    try:
        number = float(cell)
    except ValueError:
        raise ValueError("expected a number") from None
    if is_sigma and not number >= 0:
        raise ValueError("expected a sigma, 0 or more")
    if not (is_sigma or math.isfinite(number)):
        raise ValueError("expected a finite number")
    return number


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))
