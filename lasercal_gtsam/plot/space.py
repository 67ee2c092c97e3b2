"""The cell in space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lasercal_gtsam.figures import Scene
from lasercal_gtsam.figures.scene import Primitive
from lasercal_gtsam.plot import style

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

_AXES = {"x": "#c1272d", "y": "#1a7f37", "z": "#2257c4"}
_COLOURS = {
    "base": style.SOFT, "hand": style.SOFT, "camera": "#0072b2", "laser": "#d55e00",
    "plane": "#009e73", "spot": style.INK, "rejected": style.REJECTED, "ellipsoid": "#cc79a7",
}  # fmt: skip
_LAYERS = {"plane-uncertainty": "#e69f00"}
_WIDTHS = {"laser": 0.35, "ellipsoid": 0.8}


def draw_scene(ax: Axes3D, found: Scene) -> None:
    """Every primitive of the layers that are shown at first; equal scales on all axes, metres."""
    shown = {layer.name for layer in found.layers if layer.visible}
    named: set[str] = set()
    labels = {layer.name: _label(layer.label, layer.magnification) for layer in found.layers}
    for part in found.primitives:
        if part.layer in shown:
            _draw(ax, part, "" if part.layer in named else labels[part.layer])
            if part.kind != "label" and not part.axis:
                named.add(part.layer)
    points = np.concatenate([part.points for part in found.primitives if part.layer in shown])
    low, high = points.min(axis=0), points.max(axis=0)
    low = np.maximum(low, found.centre - found.radius)
    high = np.minimum(high, found.centre + found.radius)
    margin = 0.04 * found.radius
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(tuple(high - low), zoom=1.1)
    ax.view_init(elev=found.elevation_deg, azim=found.azimuth_deg)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_alpha(0.15)
        axis.set_major_locator(_locator())
    ax.tick_params(labelsize=style.SMALL, pad=0)
    ax.set_xlabel("x base (m)", fontsize=style.USUAL, labelpad=0)
    ax.set_ylabel("y base (m)", fontsize=style.USUAL, labelpad=0)
    ax.set_zlabel("z base (m)", fontsize=style.USUAL, labelpad=0)
    ax.grid(False)
    legend = ax.legend(
        loc="upper left", bbox_to_anchor=(-0.02, 1.04), fontsize=style.SMALL, frameon=False
    )
    for handle in legend.legend_handles:
        handle.set_alpha(1.0)
        if hasattr(handle, "set_linewidth"):
            handle.set_linewidth(1.2)


def _locator() -> object:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(5)


def _label(words: str, magnification: float | None) -> str:
    return words if magnification is None else f"{words} (x {magnification:g})"


def _draw(ax: Axes3D, part: Primitive, label: str) -> None:
    colour = _AXES.get(part.axis) or _LAYERS.get(part.layer) or _COLOURS[part.role]
    name = label if label and not part.axis else "_"
    x, y, z = part.points.T
    if part.kind == "points":
        marker = "x" if part.role == "rejected" else "."
        ax.plot(x, y, z, marker, color=colour, markersize=3.0, label=name)
    elif part.kind == "polygon":
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        ax.add_collection3d(
            Poly3DCollection(
                [part.points],
                facecolor=colour,
                edgecolor=colour,
                alpha=0.18,
                linewidth=0.8,
                label=name,
            )
        )
    elif part.kind == "line":
        if part.closed:
            x, y, z = np.vstack([part.points, part.points[:1]]).T
        width = 1.3 if part.axis else _WIDTHS.get(part.role, 0.9)
        ax.plot(
            x, y, z, color=colour, linewidth=width, label=name,
            alpha=0.6 if part.role == "laser" else 1.0,
        )  # fmt: skip
    else:
        ax.text(x[0], y[0], z[0], f" {part.text}", fontsize=style.SMALL, color=style.INK)
