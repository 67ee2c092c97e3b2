"""Figures on the camera's picture: residual vectors, their histogram, coverage."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.html.numbers import fixed, significant
from lasercal_gtsam.report.html.palettes import category
from lasercal_gtsam.report.html.svg import (
    FOOT,
    Frame,
    drawing,
    element,
    group,
    label,
    number,
    path_through,
    tooltip,
    window,
)

WIDTH = 520.0
_TALLEST, _HISTOGRAM_HEIGHT = 430.0, 340.0
# beyond so many arrows or dots none can be pointed at: they share one path, without names
_MOST_NAMED = 500
# of more fields than this the counts are not written into them
_MOST_COUNTED = 48
# fields with less than this share of the usual number of spots: their mean is mostly noise
_FEW_SHARE = 0.2
_HEAD, _HEAD_SHARE, _HEAD_ANGLE = 6.0, 0.4, math.radians(24)
_DOT = 2.4


def residual_vectors(image: Mapping[str, Any]) -> Markup:
    """Arrows from each spot seen towards the spot predicted, with the scale that they are in.

    With a ``title`` of its own the picture may show other arrows.
    """
    frame = picture_frame(image["image_size"], top=44.0)
    spots, planes = image["spots"], image["planes"]
    scale = image["magnification"] * frame.scale
    parts = [frame.axes("u (px)", "v (px)")]
    rejected = image["rejected"]
    tails, steps = _columns(frame, rejected, scale)
    names = _arrow_names(rejected, ["rejected"] * len(tails))
    inside = [
        group(
            [
                element("path", d=_shaft(tail, step), class_="arrow rejected faint"),
                element("path", tooltip(name), d=_cross(tail), class_="arrow rejected"),
            ]
        )
        for name, tail, step in zip(names, tails, steps, strict=True)
    ]
    tails, steps = _columns(frame, spots, scale)
    belongs = np.asarray(spots["plane"], dtype=int)
    classes = [f"arrow {category(k)}{' faint' if image['bins'] else ''}" for k in belongs]
    if len(tails) > _MOST_NAMED:
        inside += [
            element("path", d=arrows(tails[rows], steps[rows]), class_=classes[rows[0]])
            for rows in (np.flatnonzero(belongs == k) for k in range(len(planes)))
            if len(rows)
        ]
    else:
        names = _arrow_names(spots, [f"plane {planes[k]}" for k in belongs])
        inside += [
            element("path", tooltip(name), d=arrow(tail, step), class_=class_)
            for name, tail, step, class_ in zip(names, tails, steps, classes, strict=True)
        ]
    if image["bins"]:
        tails, steps = _columns(frame, image["bins"], image["bins_magnification"] * frame.scale)
        few = _FEW_SHARE * np.median(image["bins"]["count"])
        inside += [
            element(
                "path",
                tooltip(f"mean of {count} spots: {_vector(du, dv)} px"),
                d=arrow(tail, step),
                class_="arrow mean pale" if count < few else "arrow mean",
            )
            for tail, step, count, du, dv in zip(
                tails, steps, image["bins"]["count"], image["bins"]["du"], image["bins"]["dv"],
                strict=True,
            )
        ]  # fmt: skip
    parts.append(window(frame, inside))
    parts += _scale_arrows(frame, image, scale)
    return drawing(
        WIDTH,
        frame.bottom + FOOT,
        parts,
        title=image.get("title", f"Residual vectors, camera {image['camera']}"),
        description=image["alt"],
    )


def residual_histogram(histogram: Mapping[str, Any]) -> Markup:
    """Coordinates of the residuals counted, and what their noise makes one expect."""
    edges, counts = np.array(histogram["edges_px"]), np.array(histogram["counts"], dtype=float)
    curve, expected = histogram["curve"], histogram["expected"]
    top = max(
        counts.max(initial=1.0), max(expected or [0.0]), max(curve["count"] if curve else [0])
    )
    frame = Frame.filling(
        (WIDTH, _HISTOGRAM_HEIGHT), (float(edges[0]), float(edges[-1])), (0.0, 1.06 * float(top)),
        margins=(14.0, 14.0, 58.0 if top < 1e4 else 78.0),
    )  # fmt: skip
    bars = []
    for k, (low, high, count) in enumerate(zip(edges[:-1], edges[1:], counts, strict=True)):
        said = f"{significant(low, 2)} to {significant(high, 2)} px: {count:.0f}"
        if expected:
            said += f", expected {significant(expected[k], 3)}"
        x, y = frame.at_x(low), frame.at_y(count)
        bars.append(
            element(
                "rect", tooltip(said), x=x + 0.5, y=y, height=frame.bottom - y,
                width=max(frame.at_x(high) - x - 1.0, 0.5), class_="bar",
            )
        )  # fmt: skip
    parts = [frame.axes("residual, u and v (px)", "coordinates"), *bars]
    if curve:
        line = frame.at(np.column_stack([curve["x_px"], curve["count"]]))
        parts.append(window(frame, [element("path", d=path_through(line), class_="expected")]))
    elif expected:
        steps = np.column_stack([np.repeat(edges, 2)[1:-1], np.repeat(expected, 2)])
        parts.append(element("path", d=path_through(frame.at(steps)), class_="expected"))
    return drawing(
        WIDTH,
        _HISTOGRAM_HEIGHT,
        parts,
        title=f"Histogram of residuals, camera {histogram['camera']}",
        description=histogram["alt"],
    )


def image_coverage(image: Mapping[str, Any]) -> Markup:
    """Where on the picture spots were seen: counts by field, the spots, their hull."""
    frame = picture_frame(image["image_size"])
    counts = np.asarray(image["counts"], dtype=float)
    rows, columns = counts.shape
    wide, high = frame.width / columns, frame.height / rows
    most = max(counts.max(), 1.0)
    fields = []
    for r, c in np.ndindex(rows, columns):
        x, y = frame.left + c * wide, frame.top + r * high
        empty = counts[r, c] == 0
        fields.append(
            element(
                "rect", x=x, y=y, width=wide, height=high,
                class_="field empty" if empty else "field",
                fill_opacity=None if empty else float(0.06 + 0.34 * counts[r, c] / most),
            )
        )  # fmt: skip
        if rows * columns <= _MOST_COUNTED:
            fields.append(label(x + 5, y + 15, f"{counts[r, c]:.0f}", class_="count"))
    parts = [*fields, frame.axes("u (px)", "v (px)")]
    parts += dots(frame, image["spots"], image["planes"], ("u", "v"))
    if len(image["hull_uv"]) > 2:
        hull = path_through(frame.at(np.array(image["hull_uv"])), closed=True)
        parts.append(element("path", d=hull, class_="hull"))
    return drawing(
        WIDTH,
        frame.bottom + FOOT,
        parts,
        title=f"Coverage of the picture, camera {image['camera']}",
        description=image["alt"],
    )


def picture_frame(size: Sequence[int], top: float = 12.0) -> Frame:
    """The frame of a picture: pixel (0, 0) is the centre of the top-left one, v points down."""
    return Frame.isometric(
        WIDTH,
        (-0.5, size[0] - 0.5),
        (size[1] - 0.5, -0.5),
        margins=(top, 14.0, 58.0),
        tallest=_TALLEST,
    )


def dots(
    frame: Frame,
    spots: Mapping[str, Any],
    planes: Sequence[str],
    axes: tuple[str, str],
    first: int = 0,
) -> list[Markup]:
    """Spots as round dots, a path for each plane; ``first`` is the index of the first one."""
    points = frame.at(np.column_stack([spots[axes[0]], spots[axes[1]]]))
    belongs = np.asarray(spots.get("plane", np.zeros(len(points))), dtype=int)
    size = _DOT if len(points) <= 1000 else 1.4
    return [
        element(
            "path",
            d="".join(f"M{number(x)} {number(y)}h0" for x, y in points[belongs == k]),
            stroke_width=2 * size,
            class_=f"dot {category(first + k)}",
        )
        for k in range(max(len(planes), 1))
        if (belongs == k).any()
    ]


def crosses(frame: Frame, points: Array) -> Markup:
    """Crosses at points (n, 2): spots left out."""
    if not len(points):
        return Markup("")
    return element("path", d="".join(map(_cross, frame.at(points))), class_="arrow rejected")


def arrow(tail: Array, step: Array) -> str:
    """Path data of an arrow; its head shrinks with it and stays visible."""
    length = math.hypot(*step)
    if length < 0.3:
        return f"M{number(tail[0])} {number(tail[1])}h.4"
    head = min(_HEAD, max(_HEAD_SHARE * length, 1.6))
    tip, back = tail + step, math.atan2(-step[1], -step[0])
    barbs = [
        tip + head * np.array([math.cos(back + turn), math.sin(back + turn)])
        for turn in (_HEAD_ANGLE, -_HEAD_ANGLE)
    ]
    return _shaft(tail, step) + path_through(np.array([barbs[0], tip, barbs[1]]))


def arrows(tails: Array, steps: Array) -> str:
    """Path data of many arrows."""
    return "".join(arrow(tail, step) for tail, step in zip(tails, steps, strict=True))


def _scale_arrows(frame: Frame, image: Mapping[str, Any], scale: float) -> Iterator[Markup]:
    """What an arrow's length means, above the picture."""
    length = image["reference_px"] * scale
    if not length > 0:
        return
    x = frame.left
    words = f"{_px(image['reference_px'])} ({_times(image['magnification'])})"
    yield from _scale_arrow(x, 18.0, length, words, "arrow key")
    if image["bins"]:
        factor = image["bins_magnification"]
        reference = _round_below(length / (factor * frame.scale))
        words = f"mean of a field: {_px(reference)} ({_times(factor)})"
        yield from _scale_arrow(x, 36.0, reference * factor * frame.scale, words, "arrow mean")


def _scale_arrow(x: float, y: float, length: float, words: str, class_: str) -> Iterator[Markup]:
    yield element("path", d=arrow(np.array([x, y]), np.array([length, 0.0])), class_=class_)
    yield label(x + length + 8, y + 4, words, class_="name")


def _columns(frame: Frame, columns: Mapping[str, Any], scale: float) -> tuple[Array, Array]:
    tails = frame.at(np.column_stack([columns["u"], columns["v"]]))
    return tails, np.column_stack([columns["du"], columns["dv"]]).reshape(-1, 2) * scale


def _arrow_names(columns: Mapping[str, Any], where: Sequence[str]) -> list[str]:
    rows = zip(columns["id"], where, columns["du"], columns["dv"], strict=True)
    return [
        f"{name}, {place}: {_vector(du, dv)} px, length {significant(math.hypot(du, dv), 2)} px"
        for name, place, du, dv in rows
    ]


def _vector(du: float, dv: float) -> str:
    return f"({fixed(du, 3, sign=True)}, {fixed(dv, 3, sign=True)})"


def _shaft(tail: Array, step: Array) -> str:
    return path_through(np.array([tail, tail + step]))


def _cross(at: Array, arm: float = 3.5) -> str:
    x, y = number(at[0] - arm), number(at[1] - arm)
    side = number(2 * arm)
    return f"M{x} {y}l{side} {side}m0-{side}l-{side} {side}"


def _px(value: float) -> str:
    return f"{value:g} px"


def _times(factor: float) -> str:
    return f"{factor:g} times as long" if factor < 1e6 else f"{significant(factor)} times as long"


def _round_below(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(r * power for r in (1.0, 2.0, 5.0) if r * power <= value * (1 + 1e-9))
