"""The drawing of a history: a panel for each parameter, its sigma as a band, events as lines."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import write_bytes

if TYPE_CHECKING:
    from lasercal_gtsam.history import HistoryRow

_WIDTH_IN, _PANEL_IN, _EDGES_IN = 8.0, 1.7, 1.1
_DPI = 120
_LINE, _BAND, _EVENT = "#1f4e79", "#9dc3e6", "#c00000"
# bands wider than this many times the middle one do not count for the scale: the first few spots
# would hide all that comes later
_WIDEST, _MARGIN = 5.0, 0.06
# from this ratio of last to first spot on, only powers of ten are labelled
_CROWDED = 1000


def draw_history(rows: Sequence[HistoryRow], names: Sequence[str], path: Path) -> None:
    """Draw parameters against the number of spots.

    Raises
    ------
    DataError
        matplotlib is not there, or the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
    except ImportError:
        raise DataError(
            "drawing needs matplotlib, which is not installed: pip install 'lasercal-gtsam[report]'"
        ) from None
    figure = Figure(figsize=(_WIDTH_IN, _EDGES_IN + _PANEL_IN * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        _panel(axes, rows, name)
    panels[-1].set_xlabel("spots given so far (logarithmic); band: 1 sigma; dashed red: events")
    crowded = rows[-1].spots > _CROWDED * max(rows[0].spots, 1)
    subs = (1.0,) if crowded else (1.0, 2.0, 5.0)
    panels[-1].xaxis.set_major_locator(LogLocator(subs=subs, numticks=30))
    panels[-1].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    panels[-1].xaxis.set_minor_formatter(NullFormatter())
    figure.align_ylabels(panels)
    buffer = io.BytesIO()
    kind = path.suffix[1:].lower()
    # no time of day in the file: the same history gives the same bytes
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    figure.savefig(buffer, format=kind, dpi=_DPI, metadata=metadata)
    write_bytes(path, buffer.getvalue())


def _panel(axes: Any, rows: Sequence[HistoryRow], name: str) -> None:
    spots, values, sigmas, unit = [], [], [], ""
    for row in rows:
        p = next((p for p in row.parameters if p.name == name), None)
        spots.append(max(row.spots, 1))
        values.append(math.nan if p is None else p.refined)
        sigmas.append(math.nan if p is None else p.sigma)
        unit = unit if p is None else p.unit
    low = [v - s for v, s in zip(values, sigmas, strict=True)]
    high = [v + s for v, s in zip(values, sigmas, strict=True)]
    axes.fill_between(spots, low, high, color=_BAND, linewidth=0)
    axes.plot(spots, values, color=_LINE, linewidth=1.2)
    for row in rows:
        if row.events:
            axes.axvline(max(row.spots, 1), color=_EVENT, linewidth=0.8, linestyle="--")
    axes.set_xscale("log")
    axes.set_ylabel(name if unit in ("", "1") else f"{name}  [{unit}]")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if limits := _limits(low, high):
        axes.set_ylim(*limits)


def _limits(low: Sequence[float], high: Sequence[float]) -> tuple[float, float] | None:
    """Scale that shows all bands but the widest; None where there is nothing to show."""
    bands = [
        (a, b) for a, b in zip(low, high, strict=True) if math.isfinite(a) and math.isfinite(b)
    ]
    if not bands:
        return None
    widest = _WIDEST * median(b - a for a, b in bands)
    bands = [(a, b) for a, b in bands if b - a <= widest]
    bottom, top = min(a for a, _ in bands), max(b for _, b in bands)
    margin = _MARGIN * (top - bottom)
    return (bottom - margin, top + margin) if margin > 0 else None
