"""Figures on a working plane, in millimetres: coverage and the expected error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.html.palettes import sequential
from lasercal_gtsam.report.html.pictures import WIDTH, crosses, dots
from lasercal_gtsam.report.html.svg import (
    FOOT,
    Frame,
    colour_bar,
    drawing,
    element,
    group,
    label,
    number,
    path_through,
    window,
)

Mask = npt.NDArray[np.bool_]

_TALLEST = 420.0
_SHADES, _LEGEND = 32, 300.0
_MARGIN = 0.04
# a contour shorter than this many figure units has no room for its label
_ROOM = 60.0


def plane_coverage(plane: Mapping[str, Any], index: int) -> Markup:
    """What of a plane the cameras see, and where the spots were, in the colour of its index."""
    outlines = [np.array(view["outline_mm"], dtype=float) for view in plane["views"]]
    spots = np.column_stack([plane["spots"]["x_mm"], plane["spots"]["y_mm"]])
    frame = plane_frame([*outlines, spots, np.array(plane["hull_mm"], dtype=float)])
    inside = [
        element("path", d=path_through(frame.at(outline), closed=True), class_="view")
        for outline in outlines
        if len(outline) > 2
    ]
    if len(plane["hull_mm"]) > 2:
        hull = path_through(frame.at(np.array(plane["hull_mm"])), closed=True)
        inside.append(element("path", d=hull, class_="hull filled"))
    inside += dots(frame, plane["spots"], [plane["plane"]], ("x_mm", "y_mm"), index)
    out = plane["rejected"]
    inside.append(crosses(frame, np.column_stack([out["x_mm"], out["y_mm"]])))
    return drawing(
        WIDTH,
        frame.bottom + FOOT,
        [frame.axes("x on the plane (mm)", "y (mm)"), window(frame, inside)],
        title=f"Coverage of plane {plane['plane']}",
        description=plane["alt"],
    )


def error_map(chart: Mapping[str, Any], index: int) -> Markup:
    """The expected error of `locate` on a plane, mm; ``index`` of the map on its page."""
    return _map(
        chart, chart["error_mm"], chart["contours"], "Expected error (mm)",
        f"Expected error on plane {chart['plane']}, camera {chart['camera']}", chart["alt"],
        f"view-{index}",
    )  # fmt: skip


def split_map(chart: Mapping[str, Any], index: int) -> Markup:
    """How far two halves of the data put the same pixel apart, in the colours of `error_map`."""
    return _map(
        chart, chart["split"]["error_mm"], chart["split"]["contours"],
        "From split data (mm)",
        f"Error from split data on plane {chart['plane']}, camera {chart['camera']}",
        chart["split_alt"], f"split-view-{index}",
    )  # fmt: skip


def difference_map(chart: Mapping[str, Any], index: int) -> Markup:
    """How far apart two calibrations locate the same pixel on a plane, mm."""
    return _map(
        chart, chart["difference_mm"], chart["contours"], "Distance (mm)",
        f"Distance on plane {chart['plane']}, camera {chart['camera']}", chart["alt"],
        f"difference-view-{index}",
    )  # fmt: skip


def plane_frame(outlines: Sequence[Array], top: float = 12.0, margin: float = _MARGIN) -> Frame:
    """A frame with equal scales that holds these points (n, 2) in mm, with a margin around."""
    points = np.concatenate([np.asarray(o, dtype=float).reshape(-1, 2) for o in outlines])
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (-50.0, 50.0)
    low, high = np.broadcast_to(low, 2), np.broadcast_to(high, 2)
    middle, half = (low + high) / 2, (high - low) / 2
    # never thinner than a fifth of its length: spots in a row still get a figure
    half = np.maximum(half, max(0.2 * half.max(), 1e-3)) * (1 + 2 * margin)
    return Frame.isometric(
        WIDTH,
        (middle[0] - half[0], middle[0] + half[0]),
        (middle[1] - half[1], middle[1] + half[1]),
        margins=(top, 14.0, 62.0),
        tallest=_TALLEST,
    )


def _map(
    chart: Mapping[str, Any],
    field: Sequence[Sequence[float | None]],
    contours: Sequence[Mapping[str, Any]],
    name: str,
    title: str,
    description: str,
    view: str,
) -> Markup:
    x, y = np.array(chart["x_mm"], dtype=float), np.array(chart["y_mm"], dtype=float)
    values = np.array(field, dtype=float)
    low, high = chart["scale_mm"]
    corners = np.column_stack([_borders(x)[[0, -1]], _borders(y)[[0, -1]]])
    frame = plane_frame([corners], top=62.0, margin=0.0)
    view_mm = np.array(chart["view_mm"], dtype=float).reshape(-1, 2)
    lines, labels = _contours(frame, contours, (low, high), frame.at(view_mm))
    inside = [*_cells(frame, x, y, values, (low, high)), lines]
    if len(view_mm) > 2:
        outline = path_through(frame.at(view_mm), closed=True)
        clip = element("clipPath", element("path", d=outline), id=view)
        inside = [clip, group(inside, clip_path=f"url(#{view})")]
    for points, classes in (("view_mm", ("seen",)), ("hull_mm", ("under", "hull"))):
        if len(chart[points]) > 2:
            line = path_through(frame.at(np.array(chart[points])), closed=True)
            inside += [element("path", d=line, class_=f"outline {c}") for c in classes]
    inside.append(labels)
    legend = colour_bar(
        frame.left, 2.0, min(_LEGEND, frame.width), sequential(np.linspace(0, 1, _SHADES)),
        (low, high), name, more=bool(np.nanmax(values, initial=low) > high),
    )  # fmt: skip
    return drawing(
        WIDTH,
        frame.bottom + FOOT,
        [legend, frame.axes("x on the plane (mm)", "y (mm)"), window(frame, inside)],
        title=title,
        description=description,
        class_="map",
    )


def _cells(
    frame: Frame, x: Array, y: Array, values: Array, span: tuple[float, float]
) -> list[Markup]:
    """Coloured cells around the nodes of a grid, NaN left out.

    Each shade is laid over all that are at least as dark, so that no gap opens between neighbours
    however a screen or printer rounds their edges.
    """
    shade = np.full(values.shape, -1)
    known = np.isfinite(values)
    share = (values[known] - span[0]) / max(span[1] - span[0], 1e-12)
    shade[known] = np.clip(share * _SHADES, 0, _SHADES - 1).astype(int)
    across = [number(frame.at_x(v)) for v in _borders(x)]
    down = [number(frame.at_y(v)) for v in _borders(y)]
    colours = sequential((np.arange(_SHADES) + 0.5) / _SHADES)
    return [
        element(
            "path",
            d="".join(
                f"M{across[left]} {down[top]}H{across[right]}V{down[bottom]}H{across[left]}Z"
                for left, top, right, bottom in _rectangles(shade >= k)
            ),
            fill=colours[k],
            shape_rendering="crispEdges",
        )
        for k in np.unique(shade[known]).tolist()
    ]


def _rectangles(mask: Mask) -> list[tuple[int, int, int, int]]:
    """Few rectangles (left, top, right, bottom; ends excluded) that cover just a mask (r, c)."""
    done: list[tuple[int, int, int, int]] = []
    begun: dict[tuple[int, int], int] = {}
    for r, row in enumerate(np.vstack([mask, np.zeros_like(mask[:1])])):
        changes = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]])))
        runs = {(int(a), int(b)) for a, b in changes.reshape(-1, 2)}
        done += [(run[0], begun.pop(run), run[1], r) for run in begun.keys() - runs]
        begun |= dict.fromkeys(runs - begun.keys(), r)
    return sorted(done)


def _contours(
    frame: Frame, contours: Sequence[Mapping[str, Any]], span: tuple[float, float], view: Array
) -> tuple[Markup, Markup]:
    """Lines and, apart so that nothing covers them, labels."""
    lines, labels = [], []
    placed: list[Array] = []
    for contour in contours:
        drawn = [frame.at(np.array(line, dtype=float)) for line in contour["lines"]]
        # white on the dark half of the scale, black on the pale one
        share = (contour["level_mm"] - span[0]) / max(span[1] - span[0], 1e-12)
        class_ = "contour on-dark" if share > 0.5 else "contour"
        lines += [element("path", d=path_through(line), class_=class_) for line in drawn]
        seen = [line[_within(line, view)] for line in drawn]
        longest = max(seen, key=_length, default=None)
        if longest is not None and _length(longest) > _ROOM:
            place = _quiet_place(frame, longest, placed)
            placed.append(place)
            x, y = float(place[0]), float(place[1])
            labels.append(label(x, y + 4, contour["text"], "middle", class_))
    return group(lines), group(labels)


def _quiet_place(frame: Frame, line: Array, placed: Sequence[Array]) -> Array:
    """The point of a line, near its middle, that is away from the edges and from other labels."""
    room = np.minimum.reduce(
        [
            line[:, 0] - frame.left, frame.right - line[:, 0],
            line[:, 1] - frame.top, frame.bottom - line[:, 1],
        ]
    )  # fmt: skip
    steps = np.abs(np.arange(len(line)) - len(line) / 2) / max(len(line), 1)
    score = np.minimum(room, 24.0) - 12.0 * steps
    for other in placed:
        score += np.minimum(np.linalg.norm(line - other, axis=1), 44.0)
    return np.asarray(line[np.argmax(score)])


def _within(points: Array, outline: Array) -> Mask:
    """Which points (n, 2) a closed outline surrounds, by the parity of crossings; all if none."""
    if len(outline) < 3:
        return np.ones(len(points), dtype=bool)
    a, b = outline[None], np.roll(outline, -1, axis=0)[None]
    x, y = points[:, :1], points[:, 1:]
    spans = (a[..., 1] > y) != (b[..., 1] > y)
    height = np.where(a[..., 1] == b[..., 1], 1.0, b[..., 1] - a[..., 1])
    crossing = a[..., 0] + (y - a[..., 1]) / height * (b[..., 0] - a[..., 0])
    return np.asarray((spans & (x < crossing)).sum(axis=1) % 2 == 1)


def _length(line: Array) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _borders(nodes: Array) -> Array:
    """Borders of the cells around nodes (n,), n + 1 of them."""
    if len(nodes) < 2:
        return np.array([nodes[0] - 0.5, nodes[0] + 0.5])
    middle = (nodes[1:] + nodes[:-1]) / 2
    return np.concatenate([[2 * nodes[0] - middle[0]], middle, [2 * nodes[-1] - middle[-1]]])
