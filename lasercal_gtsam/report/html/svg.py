"""SVG text from Python: elements with escaped content, and a figure frame with axes.

Colours are classes, not values, wherever a figure must follow light, dark and print; the classes
are in ``report.css``. Lengths are in the user units of the figure's ``viewBox``, one of which is a
CSS pixel where the figure is shown at its natural width.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.html.numbers import axis_ticks, significant, tick_text

FOOT = 44.0
"""Height below a frame that its axis takes."""
_TICK = 5.0
_TICKS = (6, 5)


def element(tag: str, *children: object, **attributes: object) -> Markup:
    """One element; strings are escaped, `Markup` is not.

    ``class_`` gives ``class``, other underscores become hyphens; attributes that are None are left
    out, floats are written to a hundredth.
    """
    words = [tag]
    for name, value in attributes.items():
        if value is not None:
            key = "viewBox" if name == "viewBox" else name.rstrip("_").replace("_", "-")
            words.append(f'{key}="{_value(value)}"')
    head = " ".join(words)
    if not children:
        return Markup(f"<{head}/>")
    return Markup(f"<{head}>") + Markup("").join(map(escape, children)) + Markup(f"</{tag}>")


def group(children: Iterable[object], **attributes: object) -> Markup:
    """A ``<g>`` of many children; nothing where there are none."""
    items = tuple(children)
    return element("g", *items, **attributes) if items else Markup("")


def number(value: float) -> str:
    """A coordinate to a hundredth, as short as it goes."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def path_through(points: Array, closed: bool = False) -> str:
    """Path data of a polyline (n, 2)."""
    steps = "L".join(f"{number(x)} {number(y)}" for x, y in points)
    return f"M{steps}{'Z' if closed else ''}"


def drawing(
    width: float,
    height: float,
    children: Iterable[object],
    *,
    title: str,
    description: str,
    class_: str = "",
    smallest: float = 0.0,
) -> Markup:
    """A whole figure, named and described for those who cannot see it.

    It scales down to its column, but not below the share ``smallest`` of its natural width.
    """
    return element(
        "svg",
        *children,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {number(width)} {number(height)}",
        width=width,
        height=height,
        role="img",
        aria_label=f"{title}. {description}",
        class_=f"drawing {class_}".rstrip(),
        style=f"min-width:{smallest * width:.0f}px" if smallest else None,
    )


@dataclass(frozen=True)
class Frame:
    """A rectangle of the figure in which data coordinates are drawn.

    Attributes
    ----------
    left, top, width, height : the rectangle
    x, y : data at its left and right, at its bottom and top (y down for pictures: swap them); where
        both are the same, that value is drawn at the left or the bottom
    """

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    @classmethod
    def filling(
        cls,
        size: tuple[float, float],
        x: tuple[float, float],
        y: tuple[float, float],
        margins: tuple[float, float, float],
    ) -> Frame:
        """The frame that fills a figure of that size but for margins (top, right, left)."""
        top, right, left = margins
        return cls(left, top, size[0] - left - right, size[1] - top - FOOT, x, y)

    @classmethod
    def isometric(
        cls,
        width: float,
        x: tuple[float, float],
        y: tuple[float, float],
        margins: tuple[float, float, float],
        tallest: float,
    ) -> Frame:
        """The frame of a figure of that width with equal scales; margins are top, right, left."""
        top, right, left = margins
        inner = width - left - right
        wide, high = abs(x[1] - x[0]), abs(y[1] - y[0])
        height = inner * high / wide
        if height > tallest:
            inner, height = tallest * wide / high, tallest
        return cls(left, top, inner, height, x, y)

    @property
    def right(self) -> float:
        """Its right edge."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """Its lower edge."""
        return self.top + self.height

    @property
    def scale(self) -> float:
        """Figure units per unit of x."""
        return self.width / abs(self.x[1] - self.x[0])

    def at_x(self, value: float) -> float:
        """Where a value of x is drawn."""
        return float(self.at(np.array([value, self.y[0]]))[0, 0])

    def at_y(self, value: float) -> float:
        """Where a value of y is drawn."""
        return float(self.at(np.array([self.x[0], value]))[0, 1])

    def at(self, points: Array) -> Array:
        """Where points (n, 2) are drawn."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        (x0, x1), (y0, y1) = self.x, self.y
        share = (points - [x0, y0]) / [(x1 - x0) or 1.0, (y1 - y0) or 1.0]
        return np.asarray([self.left, self.bottom] + share * [self.width, -self.height])

    def axes(self, x_label: str, y_label: str) -> Markup:
        """Outline, ticks, numbers and names of both axes."""
        parts = [
            element(
                "rect", x=self.left, y=self.top, width=self.width, height=self.height,
                class_="frame",
            )
        ]  # fmt: skip
        for value, text in _labelled(self.x, _TICKS[0]):
            x = self.at_x(value)
            parts.append(_line(x, self.bottom, x, self.bottom + _TICK, "tick"))
            parts.append(label(x, self.bottom + 17, text, "middle"))
        for value, text in _labelled(self.y, _TICKS[1]):
            y = self.at_y(value)
            parts.append(_line(self.left - _TICK, y, self.left, y, "tick"))
            parts.append(label(self.left - 8, y + 4, text, "end"))
        parts.append(label(self.left + self.width / 2, self.bottom + 34, x_label, "middle", "name"))
        middle = self.top + self.height / 2
        parts.append(
            element(
                "text", y_label, x=14, y=middle, text_anchor="middle", class_="name",
                transform=f"rotate(-90 14 {number(middle)})",
            )
        )  # fmt: skip
        return group(parts, class_="axes")


def window(frame: Frame, children: Iterable[object]) -> Markup:
    """What is cut off at the edges of a frame; coordinates stay those of the figure."""
    return element(
        "svg",
        *children,
        x=frame.left,
        y=frame.top,
        width=frame.width,
        height=frame.height,
        viewBox=" ".join(map(number, (frame.left, frame.top, frame.width, frame.height))),
    )


def label(
    x: float, y: float, text: str, anchor: str = "start", class_: str | None = None
) -> Markup:
    """Text at a point of its baseline."""
    at = None if anchor == "start" else anchor
    return element("text", text, x=float(x), y=float(y), text_anchor=at, class_=class_)


def tooltip(text: str) -> Markup:
    """What a browser shows when the pointer rests on the element that this is put into."""
    return element("title", text)


def colour_bar(
    x: float,
    y: float,
    width: float,
    colours: Sequence[str],
    span: tuple[float, float],
    name: str,
    *,
    more: bool,
) -> Markup:
    """A horizontal legend of a colour scale, 44 units high, its name above it.

    ``more``: there are values beyond its end, drawn in the last colour.
    """
    step = width / len(colours)
    parts = [label(x, y + 10, name, class_="name")]
    parts += [
        element("rect", x=x + k * step, y=y + 16, width=step + 0.5, height=10, fill=colour)
        for k, colour in enumerate(colours)
    ]
    parts.append(element("rect", x=x, y=y + 16, width=width, height=10, class_="frame"))
    if more:
        parts.append(label(x + width + 8, y + 25, f"{significant(span[1], 2)} and more"))
    for value, text in _labelled(span, 5):
        at = x + (value - span[0]) / ((span[1] - span[0]) or 1.0) * width
        parts.append(_line(at, y + 26, at, y + 30, "tick"))
        parts.append(label(at, y + 42, text, "middle"))
    return group(parts, class_="axes")


def _labelled(span: tuple[float, float], count: int) -> list[tuple[float, str]]:
    values = axis_ticks(min(span), max(span), count)
    return [(value, tick_text(value, values)) for value in values]


def _line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Markup:
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def _value(value: object) -> str:
    if isinstance(value, float):
        return number(value)
    return str(escape(str(value)))
