"""The cell in three dimensions as a still drawing; ``viewer.js`` turns the same scene.

Both project alike: a mild perspective about the centre of the scene, up is the base's z, and what
is visible at first fills the figure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.html.svg import drawing, element, label, number, path_through

WIDTH, HEIGHT = 900.0, 560.0
EYE_DISTANCE = 4.5
"""Of the eye from the centre, in radii of the scene; ``viewer.js`` has the same number."""
FILLING = 0.9
"""Share of the figure's width or height that the scene takes, likewise."""
NEAR = 0.9
"""Nearer to the eye than this share of the way nothing is drawn, likewise."""
_LETTER, _LINE = 6.6, 14.0


def still_scene(scene: Mapping[str, Any]) -> Markup:
    """The scene from the suggested side, with the layers that are visible at first."""
    visible = {layer["name"] for layer in scene["layers"] if layer["visible"]}
    drawn: list[tuple[bool, float, Markup]] = []
    labels: list[tuple[float, Array, Mapping[str, Any]]] = []
    projected = []
    for primitive in scene["primitives"]:
        if primitive["layer"] in visible and primitive["points"]:
            points, depth = project(np.array(primitive["points"], dtype=float), scene)
            if (depth < NEAR * EYE_DISTANCE * scene["radius"]).all():
                projected.append((primitive, points, depth))
    scale, shift = _fit([points for _, points, _ in projected])
    for primitive, at, depth in projected:
        points = at * scale + shift
        if primitive["kind"] == "label":
            labels.append((float(depth.mean()), points[0], primitive))
            continue
        faces = primitive["kind"] == "polygon" and primitive["role"] == "plane"
        drawn.append((not faces, float(depth.mean()), _shape(primitive, points)))
    shapes = [shape for _, _, shape in sorted(drawn, key=lambda d: d[:2])]
    return drawing(
        WIDTH,
        HEIGHT,
        [element("g", *shapes), element("g", *_labels(labels))],
        title="The cell",
        description=scene["alt"],
        class_="scene",
    )


def project(points: Array, scene: Mapping[str, Any]) -> tuple[Array, Array]:
    """Base points (n, 3) seen from the suggested side.

    Returns
    -------
    (n, 2) and (n,) arrays
        Right and down, in metres at the scene's centre; and how near to the eye (metres).
    """
    azimuth = math.radians(scene["view"]["azimuth_deg"])
    elevation = math.radians(scene["view"]["elevation_deg"])
    sa, ca, se, ce = (
        math.sin(azimuth), math.cos(azimuth), math.sin(elevation), math.cos(elevation)
    )  # fmt: skip
    axes = np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]])
    right, up, depth = ((points - np.array(scene["centre"])) @ axes.T).T
    distance = EYE_DISTANCE * scene["radius"]
    scale = distance / np.maximum(distance - depth, (1 - NEAR) * distance)
    return np.column_stack([right * scale, -up * scale]), depth


def _fit(parts: list[Array]) -> tuple[float, Array]:
    """Scale and shift with which all points lie in the middle of the figure and fill it."""
    points = np.concatenate([*parts, np.zeros((0, 2))]) if parts else np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 1e-9)
    scale = FILLING * float(np.min(np.array([WIDTH, HEIGHT]) / size))
    return scale, np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2


def _shape(primitive: Mapping[str, Any], points: Array) -> Markup:
    class_ = f"{primitive['kind']} {primitive['role']}"
    if primitive["axis"]:
        class_ += f" axis-{primitive['axis']}"
    if primitive["kind"] == "points":
        d = "".join(f"M{number(x)} {number(y)}h0" for x, y in points)
    else:
        d = path_through(points, closed=primitive["closed"] or primitive["kind"] == "polygon")
    return element("path", d=d, class_=class_)


def _labels(labels: list[tuple[float, Array, Mapping[str, Any]]]) -> list[Markup]:
    """Labels nearest to the eye first; one that would cover another is left out."""
    taken: list[tuple[float, float, float, float]] = []
    shown = []
    for _, (x, y), primitive in sorted(labels, key=lambda item: -item[0]):
        text = primitive["text"]
        width = _LETTER * len(text)
        x = min(x + 4, WIDTH - width - 2)
        box = (x - 4, y - _LINE, x + width + 2, y + 4)
        if any(_overlap(box, other) for other in taken):
            continue
        taken.append(box)
        shown.append(label(float(x), float(y) - 4, text, class_=f"label {primitive['role']}"))
    return shown


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
