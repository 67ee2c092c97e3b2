"""Figures over a camera's picture: residuals and coverage."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lasercal_gtsam.figures import ImageCoverage, ResidualField
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_U, _V = "u (px)", "v (px)"


def draw_residuals(ax: Axes, field: ResidualField, seen: Observations) -> None:
    """Arrows from where a spot was seen towards where it is predicted, scale stated.

    Of very many spots the means over fields of the picture are drawn, at a scale of their own.
    """
    style.over_picture(ax, field.image_size)
    if field.means is None:
        uv, residual, magnification = field.uv, field.residual_px, field.magnification
        plane = seen.plane_index[field.shown]
        for k, name in enumerate(seen.planes):
            mine = plane == k
            colour = style.PARTS[k % len(style.PARTS)]
            if mine.any():
                _arrows(ax, uv[mine], residual[mine], magnification, colour, f"plane {name}")
    else:
        residual, magnification = field.means.residual_px, field.means.magnification
        _arrows(ax, field.means.uv, residual, magnification, style.INK, "mean over a field")
    if len(field.rejected):
        known = np.isfinite(field.rejected_px).all(axis=1)
        ax.plot(
            *field.rejected_uv[known].T, "x", color=style.REJECTED, markersize=4, zorder=3,
            label=f"left out ({len(field.rejected)} shown)",
        )  # fmt: skip
    what = "means of" if field.means is not None else ""
    style.dress(
        ax,
        f"camera {field.camera}: {what} {field.total} residuals, RMS {field.rms_px:.2g} px".replace(
            "  ", " "
        ),
        _U,
        _V,
    )
    style.legend_below(ax, 4)
    _key(ax, field, magnification)


def _arrows(
    ax: Axes, uv: Array, residual: Array, magnification: float, colour: str, label: str
) -> None:
    ax.quiver(
        *uv.T,
        *(magnification * residual).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        units="inches",
        width=0.011,
        headwidth=4.0,
        headlength=5.0,
        headaxislength=4.5,
        color=colour,
        label=label,
        zorder=2,
    )


def _key(ax: Axes, field: ResidualField, magnification: float) -> None:
    """How long an arrow of a round residual is, above the picture's right corner."""
    length = field.reference_px
    if field.means is not None:  # the means are smaller, and drawn larger
        length *= field.magnification / magnification
    w, h = field.image_size
    y = -0.5 - 0.025 * h
    end = w - 0.5
    begin = end - magnification * length
    ax.annotate(
        "", (end, y), (begin, y), annotation_clip=False,
        arrowprops={"arrowstyle": "-|>", "color": style.INK, "linewidth": 1.0,
                    "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7},
    )  # fmt: skip
    ax.annotate(
        f"{length:.3g} px (arrows {magnification:g} times as long)  ", (begin, y),
        annotation_clip=False, ha="right", va="center", fontsize=style.SMALL,
    )  # fmt: skip
    ax.title.set_position((0.5, 1.0))
    ax.set_title(ax.get_title(), fontsize=style.USUAL, pad=14.0)


def draw_image_coverage(ax: Axes, found: ImageCoverage, seen: Observations) -> None:
    """Spots in the picture by plane, their hull, and how many each field has."""
    style.over_picture(ax, found.image_size)
    w, h = found.image_size
    shown = np.where(found.counts > 0, found.counts, np.nan)
    drawn = ax.imshow(
        shown, extent=(-0.5, w - 0.5, h - 0.5, -0.5), cmap="Greys", vmin=0,
        vmax=1.8 * max(1, int(found.counts.max(initial=1))), aspect="equal", zorder=0,
    )  # fmt: skip
    drawn.set_alpha(0.6)
    plane = seen.plane_index[found.shown]
    for k, name in enumerate(seen.planes):
        mine = plane == k
        if mine.any():
            ax.plot(
                *found.uv[mine].T, style.MARKERS[k % len(style.MARKERS)], markersize=3.2,
                markeredgewidth=0.0, color=style.PARTS[k % len(style.PARTS)],
                label=f"plane {name}",
            )  # fmt: skip
    if len(found.hull_uv):
        ax.plot(*style.closed(found.hull_uv), "--", color=style.INK, linewidth=0.9, label="hull")
    style.dress(
        ax,
        f"camera {found.camera}: {found.total} spots surround {100 * found.hull_share:.0f} % of "
        "the picture",
        _U,
        _V,
    )
    style.legend_below(ax, 5)
