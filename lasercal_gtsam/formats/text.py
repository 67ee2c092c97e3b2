"""Numbers and comments in text files."""

from __future__ import annotations

import re
from collections.abc import Iterable

from lasercal_gtsam.frozen import Array


def number(value: float) -> str:
    """Shortest text that reads back as the same number, in YAML 1.1 too.

    YAML 1.1, which Kalibr's and ROS 1's readers speak, takes ``1e-05`` for a string: a number with
    an exponent needs a point.
    """
    text = repr(float(value) + 0.0)
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}.0e{exponent}" if e and "." not in mantissa else text


def numbers(values: Iterable[float] | Array, between: str = ", ") -> str:
    """Numbers in a row."""
    return between.join(number(value) for value in values)


def comment(lines: Iterable[str], mark: str = "# ") -> str:
    """Lines of a comment, each with its mark in front and a newline behind."""
    return "".join(f"{mark}{one_line(line)}".rstrip() + "\n" for line in lines)


def one_line(text: str) -> str:
    """Text on one line, with escapes for what cannot be printed."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))


def xml_comment(lines: Iterable[str]) -> str:
    """An XML comment, in which two hyphens must not follow each other."""
    body = re.sub("-(?=-)", "- ", comment(lines, "  "))
    return f"<!--\n{body}-->\n"
