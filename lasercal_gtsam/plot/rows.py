"""The correlation of the rows of the table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lasercal_gtsam.figures import Correlation
from lasercal_gtsam.figures.correlation import STRONG
from lasercal_gtsam.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STRONG_TEXT = 40
"""Rows up to which the strong correlations have room for their numbers."""


def draw_correlation(ax: Axes, found: Correlation) -> None:
    """Matrix in colours from -1 to 1, strong ones with their number."""
    n = len(found.names)
    drawn = ax.imshow(found.matrix, cmap=style.DIVERGING, vmin=-1.0, vmax=1.0)
    size = min(style.SMALL, 260.0 / max(n, 1))
    ax.set_xticks(np.arange(n), found.names, rotation=90, fontsize=size)
    ax.set_yticks(np.arange(n), found.names, fontsize=size)
    ax.tick_params(length=0)
    ax.set_xticks(np.arange(n + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(n + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", linewidth=0.4)
    ax.tick_params(which="minor", length=0)
    if n <= _STRONG_TEXT:
        for i, j in np.argwhere(np.abs(found.matrix) >= STRONG):
            if i != j:
                text = f"{found.matrix[i, j]:.2f}".replace("0.", ".")
                ax.text(j, i, text, ha="center", va="center", color="white", fontsize=0.55 * size)
    bar = ax.figure.colorbar(drawn, ax=ax, shrink=0.8, pad=0.02)
    bar.set_label("correlation", fontsize=style.USUAL)
    bar.ax.tick_params(labelsize=style.SMALL)
    pairs = len(found.strong())
    ax.set_title(f"{n} rows; {pairs} pairs at {STRONG:g} or more", fontsize=style.USUAL)
