"""What all figures share: colours, sizes, axes of their own where none are given."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

# Okabe and Ito's colours: told apart by colour-blind eyes
PARTS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
INK, SOFT, GRID, REJECTED = "#1b1f24", "#57606a", "#d5dae0", "#b01e28"
MARKERS = "os^Dv*"
SEQUENTIAL, DIVERGING = "cividis_r", "RdBu_r"
SMALL, USUAL = 7.0, 8.0
"""Sizes of letters, points: of ticks and remarks, and of names."""
WIDTH_IN = 4.6
_EDGES_IN = (0.9, 1.5)  # what ticks, names and title take beside and above a panel
_TALLEST, _FLATTEST = 1.6, 0.3
_LEGEND_IN = 0.42


def new_figure(width: float = WIDTH_IN, height: float = WIDTH_IN) -> Figure:
    """An empty figure, inches.

    Raises
    ------
    DataError
        Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise DataError(
            "figures need Matplotlib, which is not installed: pip install 'lasercal-gtsam[report]'"
        ) from None
    return Figure(figsize=(width, height), layout="constrained")


def panel_height(across: float, down: float, width: float = WIDTH_IN) -> float:
    """Height (inches) of a figure that one panel of this shape fills."""
    shape = float(np.clip(down / across, _FLATTEST, _TALLEST))
    return (width - _EDGES_IN[0]) * shape + _EDGES_IN[1]


def flat_axes(ax: Axes | None, across: float = 1.0, down: float = 1.0) -> Axes:
    """The axes that were given, or those of a new figure for a panel of this shape."""
    if ax is not None:
        return ax
    axes: Axes = new_figure(height=panel_height(across, down)).subplots()
    return axes


def space_axes(ax: Axes3D | None) -> Axes3D:
    """The axes in space that were given, or those of a new figure; DataError for flat ones."""
    if ax is None:
        made: Axes3D = new_figure(5.6, 5.0).add_subplot(projection="3d")
        return made
    if getattr(ax, "name", "") != "3d":
        raise DataError("the cell needs axes in space: make them with projection='3d'")
    return ax


def dress(ax: Axes, title: str, x_label: str, y_label: str) -> None:
    """Names and ticks."""
    ax.set_title(title, fontsize=USUAL)
    ax.set_xlabel(x_label, fontsize=USUAL)
    ax.set_ylabel(y_label, fontsize=USUAL)
    ax.tick_params(labelsize=SMALL)


def over_picture(ax: Axes, size: tuple[int, int]) -> None:
    """Make the axes those of a picture: v down, whole pixels, equal scales."""
    ax.set_xlim(-0.5, size[0] - 0.5)
    ax.set_ylim(size[1] - 0.5, -0.5)
    ax.set_aspect("equal")


def on_plane(ax: Axes, points: Array, margin: float = 0.05) -> None:
    """Equal scales about points (N, 2) of a plane."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) / 2, 0.1 * float((high - low).max()) + 1e-9) * (1 + 2 * margin)
    middle = (low + high) / 2
    ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
    ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
    ax.set_aspect("equal")


def closed(outline: Array) -> tuple[Array, Array]:
    """Coordinates x and y of an outline (K, 2) that ends where it begins."""
    x, y = np.vstack([outline, outline[:1]]).T
    return x, y


def legend_below(ax: Axes, columns: int) -> None:
    """Legend under the name of the axis, where it hides nothing."""
    from matplotlib.transforms import ScaledTranslation

    down = ScaledTranslation(0.0, -_LEGEND_IN, ax.figure.dpi_scale_trans)
    ax.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        bbox_transform=ax.transAxes + down,
        ncols=columns,
        fontsize=SMALL,
        frameon=False,
        handletextpad=0.4,
        columnspacing=1.2,
    )
