"""Figures on a working plane, in millimetres: coverage and the expected error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lasercal_gtsam.figures import ErrorMap, PlaneCoverage
from lasercal_gtsam.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_X, _Y = "x on the plane (mm)", "y on the plane (mm)"
# colours end at so many times the largest error among the spots
_WIDEST_SCALE = 3.0


def draw_error_map(ax: Axes, found: ErrorMap) -> None:
    """Colours and labelled lines of the expected error, hull of the spots, edge of the view."""
    known = found.error_mm[found.seen]
    low, high = float(known.min()), min(float(known.max()), _WIDEST_SCALE * found.largest_mm)
    values = np.ma.masked_invalid(found.error_mm)
    half_x, half_y = (found.x_mm[1] - found.x_mm[0]) / 2, (found.y_mm[1] - found.y_mm[0]) / 2
    drawn = ax.imshow(
        values, origin="lower", interpolation="bilinear", cmap=style.SEQUENTIAL, vmin=low,
        vmax=max(high, low + 1e-9), aspect="equal",
        extent=(found.x_mm[0] - half_x, found.x_mm[-1] + half_x,
                found.y_mm[0] - half_y, found.y_mm[-1] + half_y),
    )  # fmt: skip
    if len(found.view_mm) > 2:
        from matplotlib.patches import Polygon

        window = Polygon(found.view_mm, closed=True, transform=ax.transData)
        drawn.set_clip_path(window)
        ax.plot(*style.closed(found.view_mm), color=style.SOFT, linewidth=0.8, label="view")
    levels = [contour.level_mm for contour in found.contours]
    if levels:
        # white on the dark half of the scale, dark on the pale one
        on_dark = [level > low + 0.5 * (high - low) for level in levels]
        lines = ax.contour(
            found.x_mm, found.y_mm, values, levels=levels, linewidths=0.7,
            colors=["white" if dark else style.INK for dark in on_dark],
        )  # fmt: skip
        ax.clabel(lines, fmt=lambda level: f"{level:g} mm", fontsize=style.SMALL)
    ax.plot(*found.spots_mm.T, ".", color=style.INK, markersize=2.0, label="spots")
    if len(found.hull_mm):
        ax.plot(*style.closed(found.hull_mm), "--", color=style.INK, linewidth=0.9, label="hull")
    ax.set_xlim(found.x_mm[0], found.x_mm[-1])
    ax.set_ylim(found.y_mm[0], found.y_mm[-1])
    ax.set_aspect("equal")
    bar = ax.figure.colorbar(
        drawn, ax=ax, shrink=0.85, pad=0.02, extend="max" if known.max() > high else "neither"
    )
    bar.set_label("expected error (mm)", fontsize=style.USUAL)
    bar.ax.tick_params(labelsize=style.SMALL)
    style.dress(
        ax,
        f"plane {found.plane}, camera {found.camera}: median {found.median_mm:.2g} mm, largest "
        f"{found.largest_mm:.2g} mm",
        _X,
        _Y,
    )
    style.legend_below(ax, 3)


def draw_plane_coverage(ax: Axes, found: PlaneCoverage) -> None:
    """What each camera sees of a plane, the spots and their hull, what was left out."""
    corners = [found.xy_mm]
    for k, view in enumerate(found.views):
        if len(view.outline_mm) < 3:
            continue
        colour = style.PARTS[k % len(style.PARTS)]
        ax.fill(*style.closed(view.outline_mm), color=colour, alpha=0.08, linewidth=0)
        ax.plot(
            *style.closed(view.outline_mm), color=colour, linewidth=0.9,
            label=f"view of camera {view.camera}",
        )  # fmt: skip
        corners.append(view.outline_mm)
    ax.plot(*found.xy_mm.T, ".", color=style.INK, markersize=3.0, label="spots")
    if len(found.hull_mm):
        ax.plot(*style.closed(found.hull_mm), "--", color=style.INK, linewidth=0.9, label="hull")
    if len(found.rejected_mm):
        ax.plot(*found.rejected_mm.T, "x", color=style.REJECTED, markersize=4, label="left out")
    style.on_plane(ax, np.concatenate(corners))
    shares = ", ".join(
        f"{100 * view.share:.0f} % of the view of {view.camera}"
        for view in found.views
        if view.share is not None
    )
    style.dress(
        ax,
        f"plane {found.plane}: {found.total} spots" + (f" surround {shares}" if shares else ""),
        _X,
        _Y,
    )
    style.legend_below(ax, 3)
