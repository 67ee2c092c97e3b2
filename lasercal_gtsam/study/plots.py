"""The studies as figures, in the paper's arrangement."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from lasercal_gtsam.plot.style import PARTS, new_figure
from lasercal_gtsam.study.errors import QUANTITIES
from lasercal_gtsam.study.fig6_runs import HORAUD
from lasercal_gtsam.study.outcome import ErrorCurves
from lasercal_gtsam.study.studies import Study
from lasercal_gtsam.study.table2_runs import TestColumn

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# a family of methods shares a colour, and so do the cases of one plane, nearly
_FAMILIES = dict(zip(("M1", "M2", "M3", "M4"), PARTS, strict=False))
_CASES = (PARTS[0], PARTS[5], PARTS[1], PARTS[2])
_LABELS = {"f_u": "error of $f_u$ (%)", "R": "error of $R$ (%)", "T": "error of $T$ (%)"}
_STYLES = ("-", "--", ":", "-.")
_MARKERS = "os^Dv*P"


def figure_of(study: Study) -> Figure:
    """Draw a study.

    Raises
    ------
    DataError
        Matplotlib is not installed.
    """
    if study.name == "fig6":
        figure = new_figure(13.0, 4.6)
        _draw_fig6(figure, study.curves["fig6"])
    elif study.name == "fig7":
        figure = new_figure(11.0, 4.6)
        _draw_fig7(figure, list(study.curves.values()))
    else:
        figure = new_figure(9.0, 5.5)
        _draw_table2(figure.subplots(), study.columns)
    return figure


def as_bytes(figure: Figure, kind: str) -> bytes:
    """The figure as ``"png"`` or ``"svg"``."""
    content = io.BytesIO()
    nothing = ("Creator", "Date", "Format", "Type") if kind == "svg" else ("Software",)
    figure.savefig(content, format=kind, dpi=150, metadata=dict.fromkeys(nothing))
    return content.getvalue()


def _draw_fig6(figure: Figure, curves: ErrorCurves) -> None:
    axes = figure.subplots(1, 3)
    for ax, quantity in zip(axes, QUANTITIES, strict=True):
        q = QUANTITIES.index(quantity)
        seen: dict[str, int] = {}
        for m, method in enumerate(curves.methods):
            if not curves.asked[:, m].any():
                continue
            family = method[:2]
            marker = seen.get(family, 0)
            seen[family] = marker + 1
            _line(
                ax,
                curves,
                m,
                q,
                label=method,
                color=_FAMILIES.get(family, "#555555"),
                linestyle="-" if "refined" in method or method == HORAUD else "--",
                marker=_MARKERS[marker % len(_MARKERS)],
            )
        _finish(ax, _LABELS[quantity], "noise level")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)


def _draw_fig7(figure: Figure, cases: list[ErrorCurves]) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    for ax, refined in zip(axes, (False, True), strict=True):
        for c, curves in enumerate(cases):
            chosen = [
                m
                for m, name in enumerate(curves.methods)
                if ("refined" in name) == refined and curves.asked[:, m].any()
            ]
            for i, m in enumerate(chosen):
                label = curves.name
                if not refined:
                    label += ", " + curves.methods[m].removeprefix("M1 ").removesuffix(
                        " closed form"
                    )
                _line(
                    ax,
                    curves,
                    m,
                    0,
                    label=label,
                    color=_CASES[c % len(_CASES)],
                    linestyle=_STYLES[i % len(_STYLES)],
                    marker=_MARKERS[c % len(_MARKERS)],
                )
        _finish(ax, _LABELS["f_u"] if not refined else "", "samples")
        ax.set_title("refined" if refined else "closed form", fontsize=10)
        ax.legend(fontsize=7, frameon=False)


def _line(ax: Axes, curves: ErrorCurves, m: int, q: int, **style: Any) -> None:
    """Mean with its standard error; nothing where more than half of the trials failed."""
    mean, error = 100 * curves.mean[:, m, q], 100 * curves.standard_error[:, m, q]
    shown = np.isfinite(mean) & (curves.failures[:, m] <= curves.trials / 2) & (mean > 1e-9)
    at = np.asarray(curves.at)
    ax.errorbar(
        at[shown],
        mean[shown],
        np.nan_to_num(error[shown]),
        markersize=4,
        linewidth=1.2,
        capsize=2,
        elinewidth=0.7,
        **style,
    )


def _finish(ax: Axes, ylabel: str, xlabel: str) -> None:
    _log_axis(ax)
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    ax.grid(True, which="both", linewidth=0.3, alpha=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def _log_axis(ax: Axes) -> None:
    """Logarithmic, with numbers as one writes them: 0.5, not 5 x 10^-1."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _draw_table2(ax: Axes, columns: tuple[TestColumn, ...]) -> None:
    names = max((c.names for c in columns), key=len, default=())
    for i, column in enumerate(columns):
        rows = [n for n in column.names if np.isfinite(column.ratio(n)) and column.ratio(n) > 0]
        ax.plot(
            [names.index(n) + 0.15 * (i - 1.5) for n in rows if n in names],
            [column.ratio(n) for n in rows if n in names],
            _MARKERS[i % len(_MARKERS)],
            color=_CASES[i % len(_CASES)],
            label=column.name,
            markersize=5,
        )
    ax.axhspan(0.5, 2.0, color="#000000", alpha=0.06, linewidth=0)
    ax.axhline(1.0, color="#555555", linewidth=0.8)
    _log_axis(ax)
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
    ax.set_ylabel("median sigma / printed sigma")
    ax.grid(True, axis="y", which="both", linewidth=0.3, alpha=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False, ncols=4, loc="upper left")
