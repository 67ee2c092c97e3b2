"""The page: templates filled with the document, the figures and everything the page needs."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import groupby
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from lasercal_gtsam.calibration import sigma_decimals
from lasercal_gtsam.report.html import matrices, numbers, palettes, pictures, planes, scene

SECTIONS = (
    "verdict", "parameters", "rejected", "residuals", "levels", "coverage", "error_maps",
    "correlation", "weak", "scene", "model_error", "conventions", "inputs",
)  # fmt: skip
"""Sections in the order of the page: a key of the document, a template and an anchor each."""
COMPARISON = (
    ("parts", "Parts"), ("rows", "Rows of the table"), ("planes", "Millimetres on the planes"),
    ("pixels", "Pixels in the picture"), ("inputs", "Inputs"),
)  # fmt: skip
"""Sections of a comparison's page: anchors and headings."""
FEW = 12
"""Rows of a table beyond which the rest is folded away."""
_TIGHT = "\N{NO-BREAK SPACE}"


def render(document: Mapping[str, Any]) -> str:
    """One HTML file that needs nothing else: styles, script, figures and data are in it.

    Parameters
    ----------
    document : as `lasercal_gtsam.report.document.make_document` makes it

    Returns
    -------
    str
        The page. Every name in it is escaped, and its policy lets no script run but its own and
        nothing be loaded.
    """
    script = _asset("viewer.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    template = _environment().get_template("report.html.j2")
    return template.render(
        doc=document,
        contents=[(name, document[name].get("heading") or name.capitalize()) for name in SECTIONS],
        css=Markup(_asset("report.css")),
        script=Markup(script),
        script_hash=Markup(f"sha256-{digest}"),
        data=_embedded(document),
        few=FEW,
    )


def render_comparison(document: Mapping[str, Any]) -> str:
    """One HTML file of a comparison (`lasercal_gtsam.report.comparison`); no script runs in it."""
    return (
        _environment()
        .get_template("comparison.html.j2")
        .render(doc=document, contents=COMPARISON, css=Markup(_asset("report.css")), few=FEW)
    )


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("lasercal_gtsam.report.html"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(
        residual_vectors=pictures.residual_vectors,
        residual_histogram=pictures.residual_histogram,
        image_coverage=pictures.image_coverage,
        plane_coverage=planes.plane_coverage,
        difference_map=planes.difference_map,
        error_map=planes.error_map,
        split_map=planes.split_map,
        correlation_matrix=matrices.correlation_matrix,
        level_bar=matrices.level_bar,
        longest_bar=matrices.longest_bar,
        still_scene=scene.still_scene,
    )
    environment.filters.update(
        by_meaning=_by_meaning,
        by_part=_by_part,
        by_sigma=_by_sigma,
        category=palettes.category,
        chance=numbers.chance,
        fixed=numbers.fixed,
        measure=_measure,
        minus=numbers.true_minus,
        moment=_moment,
        pad=_pad,
        pair=_pair,
        places=_places,
        sentence=_sentence,
        sentence_case=_sentence_case,
        significant=numbers.significant,
    )
    return environment


@cache
def _asset(name: str) -> str:
    return files("lasercal_gtsam.report.html").joinpath(name).read_text(encoding="utf-8")


def _embedded(document: Mapping[str, Any]) -> Markup:
    """The document as JSON that cannot end its script element; pictures are in the page already."""
    rejected = {
        key: [{**row, "thumbnail": None} for row in value] if key in ("outliers", "rows") else value
        for key, value in document["rejected"].items()
    }
    text = json.dumps(
        {**document, "rejected": rejected},
        ensure_ascii=False,
        allow_nan=False,
        separators=(",", ":"),
    )
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _by_part(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[Mapping[str, Any]]]]:
    return [(part, list(of)) for part, of in groupby(rows, key=lambda row: row["part"])]


def _by_meaning(rows: Sequence[Mapping[str, Any]]) -> list[tuple[list[str], str]]:
    """What rows mean, once for all that mean the same, in the order of the first ones."""
    names: dict[str, list[str]] = {}
    for row in rows:
        names.setdefault(row["meaning"], []).append(row["name"])
    return [(of, meaning) for meaning, of in names.items()]


def _places(rows: Sequence[Mapping[str, Any]], column: str) -> int:
    """The most decimals in a column of printed numbers."""
    return max((numbers.tail(row["text"][column])[0] for row in rows), default=0)


def _pad(text: str, places: int) -> Markup:
    """Style that moves a number left by the decimals that it lacks; words stay at the right."""
    decimals, point = numbers.tail(text)
    if not any(c.isdigit() for c in text) or decimals >= places:
        return Markup("")
    lacks = Markup(' style="--pad:{}{}"')
    return lacks.format(places - decimals, "" if point else Markup(";--point:1"))


def _pair(values: Sequence[float] | None, decimals: int) -> str:
    if values is None:
        return ""
    return "(" + ", ".join(numbers.fixed(v, decimals) for v in values) + ")"


def _by_sigma(value: float | None, sigma: float | None) -> str:
    return numbers.fixed(value, sigma_decimals(sigma if sigma is not None else 0.0))


def _measure(value: float | None, unit: str, digits: int = 2) -> str:
    """A size and its unit that stay on one line."""
    return "unknown" if value is None else f"{numbers.significant(value, digits)}{_TIGHT}{unit}"


def _sentence(words: str) -> str:
    """Words as a sentence: a capital first and a full stop last."""
    words = _sentence_case(words)
    return words if not words or words[-1] in ".!?:" else f"{words}."


def _sentence_case(words: str) -> str:
    return words[:1].upper() + words[1:]


def _moment(time: str) -> str:
    """An ISO time as people write it."""
    return time.replace("T", " ").replace("+00:00", " UTC").replace("Z", " UTC")
