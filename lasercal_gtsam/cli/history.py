"""`lasercal history`: how parameters and their sigmas came about, printed or drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lasercal_gtsam.cli.console import json_option, print_json
from lasercal_gtsam.cli.outputs import check_writable
from lasercal_gtsam.errors import DataError

if TYPE_CHECKING:
    from lasercal_gtsam.calibration import Parameter
    from lasercal_gtsam.history import HistoryRow

# rows of the printed table: at these multiples of powers of ten
_STEPS = (1, 2, 5)
_PLOT_KINDS = (".png", ".svg", ".pdf")
_TABLE_COLUMNS = 4


@click.command(
    short_help="Print or draw how parameters and their sigmas came about.",
    epilog="Names may end in *: 'a_*' is every plane. Without names: where the cameras are.",
)
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("names", nargs=-1)
@click.option(
    "--plot",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Draw into this file instead: .png, .svg or .pdf. Needs the extra 'report'.",
)
@json_option
def history(result: Path, names: tuple[str, ...], plot: Path | None, as_json: bool) -> None:
    """Show the history of RESULT (calibration.json, or the history's CSV file itself).

    NAMES are parameters of the table, such as fu or Tz.
    """
    from lasercal_gtsam.io.history_file import parameter_names, read_history

    path = _history_of(result)
    rows = read_history(path)
    if not rows:
        raise DataError(f"{path}: there is no row in it yet")
    wanted = _chosen(names, [name for name, _ in parameter_names(rows)], path)
    if plot is not None:
        if plot.suffix.lower() not in _PLOT_KINDS:
            kinds = ", ".join(_PLOT_KINDS)
            raise click.UsageError(f"--plot {plot}: expected a file name ending in one of {kinds}")
        check_writable(plot)
        from lasercal_gtsam.cli.history_plot import draw_history

        draw_history(rows, wanted, plot)
    if as_json:
        print_json(_document(rows, wanted, path))
    elif plot is None:
        click.echo("\n\n".join(_tables(rows, wanted)))
    if plot is not None and not as_json:
        click.echo(f"Saved {plot}.")


def _history_of(result: Path) -> Path:
    """The history's file, which may be named by its result."""
    from lasercal_gtsam.io.history_file import history_path

    if result.suffix.lower() == ".csv":
        return result
    path = history_path(result / "calibration.json" if result.is_dir() else result)
    if not path.exists() and result.exists():
        raise DataError(f"{path}: there is no history beside {result}; 'lasercal watch' writes one")
    return path


def _chosen(names: Sequence[str], there: Sequence[str], path: Path) -> list[str]:
    """Parameters by name or by the beginning of their name."""
    from lasercal_gtsam.io.wording import did_you_mean, some

    if not names:
        found = [n for n in there if n.rpartition(".")[2] in ("Tx", "Ty", "Tz")]
        return found or list(there[:_TABLE_COLUMNS])
    chosen: dict[str, None] = {}
    for name in names:
        if name.endswith("*"):
            found = [n for n in there if n.startswith(name[:-1])]
        else:
            found = [n for n in there if n == name]
        if not found:
            raise DataError(
                f"{path}: there is no parameter {name!r}{did_you_mean(name, there)}; there are "
                f"{some(list(there), 40)}"
            )
        chosen |= dict.fromkeys(found)
    return list(chosen)


def _tables(rows: Sequence[HistoryRow], names: Sequence[str]) -> list[str]:
    """Text tables of a few rows, a few parameters each; events as lines below the first."""
    shown = _shown(rows)
    tables = [
        _table(shown, names[start : start + _TABLE_COLUMNS])
        for start in range(0, len(names), _TABLE_COLUMNS)
    ]
    events = [f"  {row.spots}: {words}" for row in rows for words in row.events]
    if events:
        tables.append("\n".join(["Events, by the number of spots:", *events]))
    return tables


def _shown(rows: Sequence[HistoryRow]) -> list[HistoryRow]:
    """The first row, the last one, those with events, and some in between."""
    marks = {step * 10**k for k in range(9) for step in _STEPS}
    shown, before = [], 0
    for k, row in enumerate(rows):
        passed = any(before < mark <= row.spots for mark in marks)
        if k in (0, len(rows) - 1) or row.events or passed:
            shown.append(row)
        before = row.spots
    return shown


def _table(rows: Sequence[HistoryRow], names: Sequence[str]) -> str:
    from lasercal_gtsam.calibration import plain_number, table_decimals

    units = {p.name: p.unit for row in rows for p in row.parameters}
    header = ["spots", "RMS px", "sigma0"]
    for name in names:
        unit = units.get(name, "")
        header += [f"{name}{'' if unit in ('', '1') else ' ' + unit}", "sigma"]
    lines = [header]
    for row in rows:
        there = {p.name: p for p in row.parameters}
        scales = (row.rms_px, row.sigma0)
        cells = [str(row.spots), *("" if math.isnan(x) else f"{x:.4g}" for x in scales)]
        for name in names:
            p = there.get(name)
            if p is None:
                cells += ["", ""]
            else:
                cells += [plain_number(p.refined, table_decimals(p)), _sigma(p)]
        lines.append(cells)
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    text = [
        "  ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)) for line in lines
    ]
    return "\n".join([text[0], "  ".join("-" * w for w in widths), *text[1:]])


def _sigma(p: Parameter) -> str:
    from lasercal_gtsam.calibration import plain_number, table_decimals

    if p.sigma == 0:
        return "held"
    return plain_number(p.sigma, table_decimals(p)) or "unknown"


def _document(rows: Sequence[HistoryRow], names: Sequence[str], path: Path) -> dict[str, Any]:
    """Columns of all rows; null where a parameter was not there."""
    return {
        "history": str(path),
        "spots": [row.spots for row in rows],
        "rms_px": [row.rms_px for row in rows],
        "sigma0": [row.sigma0 for row in rows],
        "parameters": [
            {
                "name": name,
                "unit": next(p.unit for row in rows for p in row.parameters if p.name == name),
                **{
                    key: [
                        next((getattr(p, field) for p in row.parameters if p.name == name), None)
                        for row in rows
                    ]
                    for key, field in (("value", "refined"), ("sigma", "sigma"))
                },
            }
            for name in names
        ],
        "events": [{"spots": row.spots, "words": w} for row in rows for w in row.events],
    }
