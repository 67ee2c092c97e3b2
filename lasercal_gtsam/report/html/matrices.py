"""The correlation matrix as a figure, and the bars in the table of levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.html.numbers import fixed
from lasercal_gtsam.report.html.svg import drawing, element, group, label, number, tooltip

_CELL = 21.0
_LETTER, _LONGEST = 6.4, 28
# below this a cell is left empty; from the other on the number is in it
_FAINT, _NUMBERED = 0.05, 0.5
# from here on white is easier to read on the cell than black; in dark mode the other way round
_STRONG = 0.88
# with more names than this cells are no longer named one by one: the figure would be megabytes
_MOST_NAMED = 50
_BAR_WIDTH, _BAR_HEIGHT = 112.0, 10.0


def correlation_matrix(correlation: Mapping[str, Any]) -> Markup:
    """The lower half of the matrix: hue for the sign, strength and numbers for the size."""
    names = correlation["names"]
    shown = [name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…" for name in names]
    matrix = np.array(correlation["matrix"], dtype=float)
    n = len(names)
    left = 14 + _LETTER * max((len(name) for name in shown), default=1)
    # the name of a column stands on the diagonal: the later ones need no room above
    top = max((10 + _LETTER * len(name) - i * _CELL for i, name in enumerate(shown)), default=0.0)
    parts: list[Markup] = []
    for i, name in enumerate(shown):
        x, y = left + (i + 0.5) * _CELL + 4, top + i * _CELL
        parts.append(label(left - 6, y + _CELL / 2 + 4, name, "end"))
        parts.append(
            element(
                "text", name, x=0.0, y=0.0,
                transform=f"translate({number(x)} {number(y - 5)}) rotate(-90)",
            )
        )  # fmt: skip
    parts.append(element("path", d=_staircase(n, left, top), class_="grid"))
    if n <= _MOST_NAMED:
        parts += _named_cells(names, matrix, left, top)
    else:
        parts += _plain_cells(matrix, left, top)
    parts += [
        label(
            left + (j + 0.5) * _CELL, top + (i + 0.5) * _CELL + 3.5,
            fixed(100 * matrix[i, j], 0), "middle",
            "value strong" if abs(matrix[i, j]) > _STRONG else "value",
        )
        for i, j in np.argwhere(np.tril(np.abs(matrix), -1) >= _NUMBERED)
    ]  # fmt: skip
    return drawing(
        left + n * _CELL + 14,
        top + n * _CELL + 8,
        parts,
        title="Correlation of the estimated values",
        description=correlation["alt"],
        class_="correlation",
        smallest=0.8,
    )


def level_bar(cell: Mapping[str, Any], longest: float) -> Markup:
    """A bar for the residual with a mark where it is expected; what is above it has another colour.

    Hidden from screen readers: the numbers stand beside it.
    """
    rms, expected = cell["rms_px"], cell["expected_px"]
    if rms is None or not longest > 0:
        return Markup("")
    scale = (_BAR_WIDTH - 2) / longest
    usual = rms if expected is None else min(rms, expected)
    parts = [element("rect", x=0.0, y=2.5, width=usual * scale, height=5.0, class_="usual")]
    if rms > usual:
        parts.append(
            element(
                "rect", x=usual * scale, y=2.5, width=(rms - usual) * scale, height=5.0,
                class_="above",
            )
        )  # fmt: skip
    if expected is not None:
        parts.append(
            element("rect", x=expected * scale - 0.75, y=0.0, width=1.5, height=10.0, class_="mark")
        )
    return element(
        "svg", *parts, viewBox=f"0 0 {number(_BAR_WIDTH)} {number(_BAR_HEIGHT)}",
        width=_BAR_WIDTH, height=_BAR_HEIGHT, class_="bar-in-cell", aria_hidden="true",
    )  # fmt: skip


def longest_bar(rows: Sequence[Mapping[str, Any]]) -> float:
    """The largest residual, seen or expected, of rows with ``cells``."""
    sizes = [c[key] for row in rows for c in row["cells"] for key in ("rms_px", "expected_px")]
    return max((size for size in sizes if size is not None), default=0.0)


def _named_cells(names: Sequence[str], matrix: Array, left: float, top: float) -> list[Markup]:
    cells = []
    for i, j in np.argwhere(np.tril(np.abs(matrix)) >= _FAINT):
        value = float(matrix[i, j])
        said = names[i] if i == j else f"{names[i]} and {names[j]}: {fixed(value, 3, sign=True)}"
        cells.append(
            element(
                "rect", tooltip(said), x=left + j * _CELL, y=top + i * _CELL,
                width=_CELL - 0.5, height=_CELL - 0.5, class_=_hue(i, j, value),
                fill_opacity=_strength(value),
            )
        )  # fmt: skip
    return [group(cells)]


def _plain_cells(matrix: Array, left: float, top: float) -> list[Markup]:
    """The cells as a path for each of 2 x 10 strengths."""
    paths: dict[tuple[str, float], list[str]] = {}
    side = number(_CELL - 0.5)
    for i, j in np.argwhere(np.tril(np.abs(matrix)) >= _FAINT):
        value = float(matrix[i, j])
        key = (_hue(i, j, value), round(_strength(value), 1))
        paths.setdefault(key, []).append(
            f"M{number(left + j * _CELL)} {number(top + i * _CELL)}h{side}v{side}h-{side}z"
        )
    return [
        element("path", d="".join(d), class_=hue, fill_opacity=strength)
        for (hue, strength), d in sorted(paths.items())
    ]


def _hue(i: int, j: int, value: float) -> str:
    return "diagonal" if i == j else "minus" if value < 0 else "plus"


def _strength(value: float) -> float:
    return min(abs(value), 1.0)


def _staircase(n: int, left: float, top: float) -> str:
    """Light lines between the cells of the lower half."""
    lines = []
    for k in range(n + 1):
        at = k * _CELL - 0.25
        right, high = left + min(k + 1, n) * _CELL, top + max(k - 1, 0) * _CELL
        lines.append(f"M{number(left)} {number(top + at)}H{number(right)}")
        lines.append(f"M{number(left + at)} {number(top + n * _CELL)}V{number(high)}")
    return "".join(lines)
