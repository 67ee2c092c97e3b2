"""Whole figures for files: one panel for every camera or plane that there is."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures import error_maps, image_coverages, plane_coverages, residual_fields
from lasercal_gtsam.io.files import write_bytes
from lasercal_gtsam.plot import KINDS, SUFFIXES, style
from lasercal_gtsam.plot.picture import draw_image_coverage, draw_residuals
from lasercal_gtsam.plot.plane import draw_error_map, draw_plane_coverage
from lasercal_gtsam.plot.plots import Plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 300
_MOST_COLUMNS = 3
# letters as letters in PDF, which publishers ask for; the same figure gives the same bytes
_SETTINGS: dict[Any, Any] = {"pdf.fonttype": 42, "svg.hashsalt": "lasercal"}

_Panel = Callable[[Any], None]


def figure_of(calibration: Calibration, kind: str) -> Figure:
    """A figure with all panels of a kind in `KINDS`.

    Raises
    ------
    DataError
        Matplotlib is not installed, the kind is unknown, or there is nothing to draw.
    """
    if kind == "correlation":
        return _whole(Plots(calibration).correlation())
    if kind == "cell":
        return _whole(Plots(calibration).cell())
    if kind not in KINDS:
        raise DataError(f"figure {kind!r}: there are {', '.join(KINDS)}")
    panels, shape = _panels(calibration, kind)
    if not panels:
        raise DataError(f"{kind}: there is nothing to draw: no spots that were used, or no sigmas")
    columns = min(len(panels), _MOST_COLUMNS)
    rows = -(-len(panels) // columns)
    figure = style.new_figure(
        columns * style.WIDTH_IN, rows * style.panel_height(*shape) if shape else style.WIDTH_IN
    )
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, draw in zip(axes, panels, strict=False):
        draw(ax)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    return figure


def _panels(calibration: Calibration, kind: str) -> tuple[list[_Panel], tuple[float, float]]:
    """What draws each panel, and the tallest panel's shape."""
    seen = calibration.inputs.observations
    panels: list[_Panel] = []
    shapes: list[tuple[float, float]] = []
    if kind == "residuals":
        for field in (one for one in residual_fields(calibration) if one.total):
            panels.append(partial(draw_residuals, field=field, seen=seen))
            shapes.append(field.image_size)
    elif kind == "coverage":
        for image in image_coverages(calibration):
            panels.append(partial(draw_image_coverage, found=image, seen=seen))
            shapes.append(image.image_size)
        panels += [
            partial(draw_plane_coverage, found=plane)
            for plane in plane_coverages(calibration)
            if plane.total
        ]
    else:
        for found in error_maps(calibration):
            panels.append(partial(draw_error_map, found=found))
            shapes.append((1.25 * float(np.ptp(found.x_mm)), float(np.ptp(found.y_mm))))
    return panels, max(shapes, key=lambda shape: shape[1] / shape[0], default=(1.0, 1.0))


def _whole(ax: Any) -> Figure:
    figure: Figure = ax.figure
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as the suffix says (`SUFFIXES`), atomically, without time or user in it.

    Raises
    ------
    DataError
        The suffix is not one of them, or the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix[1:].lower()
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    from matplotlib import rc_context

    nothing = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    buffer = io.BytesIO()
    with rc_context(_SETTINGS):
        figure.savefig(buffer, format=kind, dpi=_DPI, metadata=nothing)
    write_bytes(path, buffer.getvalue())
