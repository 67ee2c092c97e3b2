"""A comparison as one plain dictionary, and as a page made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lasercal_gtsam.calibration import plain_number, sigma_decimals
from lasercal_gtsam.comparison.result import (
    Change,
    Comparison,
    InputsChange,
    PartChange,
    PixelMap,
    PlaneMap,
    RowChange,
)
from lasercal_gtsam.figures.contours import round_up
from lasercal_gtsam.io.files import write_text
from lasercal_gtsam.report.html.page import render_comparison
from lasercal_gtsam.report.plainly import MM, PX, number, numbers
from lasercal_gtsam.report.words import size_words

FORMAT = "lasercal-comparison"
VERSION = 1
_GRADES = {"same": "good", "identical": "good", "different": "weak", "unknown": "note"}
_HEADINGS = {
    "same": "Same within noise", "identical": "Identical", "different": "Different",
    "unknown": "Cannot be said",
}  # fmt: skip
# an arrow of the 90 % quantile is this many grid steps long
_ARROW_STEPS = 1.2
_WIDEST_SCALE = 3.0


def write_page(comparison: Comparison, path: str | Path, names: tuple[str, str]) -> None:
    """Write the page, one HTML file that needs no network; DataError where it cannot be."""
    write_text(path, render_comparison(comparison_document(comparison, names)))


def comparison_document(
    found: Comparison, names: tuple[str, str] = ("A", "B"), created: datetime | None = None
) -> dict[str, Any]:
    """Everything that the page and ``--json`` show; no NaN, None stands for what is not known.

    Parameters
    ----------
    found : the comparison
    names : what A and B are called, such as their files
    created : time to note; None: now (UTC)
    """
    created = datetime.now(UTC) if created is None else created.astimezone(UTC)
    return {
        "format": FORMAT,
        "version": VERSION,
        "title": "Comparison of two calibrations",
        "created": created.isoformat(timespec="seconds"),
        "language": "en",
        "a": names[0],
        "b": names[1],
        "verdict": found.verdict,
        "grade": _GRADES[found.verdict],
        "heading": _HEADINGS[found.verdict],
        "words": found.words,
        "next_action": found.next_action,
        "basis": found.basis,
        "notes": list(found.notes),
        "together": {
            "distance": number(found.distance),
            "unknowns": found.unknowns,
            "chance": number(found.chance),
        },
        "only_a": list(found.only_a),
        "only_b": list(found.only_b),
        "parts": [_part(part) for part in found.parts],
        "rows": [_row(row) for row in found.rows],
        "pixel_maps": [_pixels(one) for one in found.pixel_maps],
        "plane_maps": [_plane(one) for one in found.plane_maps],
        "inputs": _inputs(found.inputs),
    }


def _part(part: PartChange) -> dict[str, Any]:
    return {
        "kind": part.kind,
        "name": part.name,
        "label": part.label,
        "distance": number(part.distance),
        "unknowns": part.unknowns,
        "chance": number(part.chance),
        "corrected": number(part.corrected),
        "turn_deg": number(part.turn_deg),
        "turn_sigma_deg": number(part.turn_sigma_deg),
        "shift_mm": number(part.shift_mm),
        "shift_sigma_mm": number(part.shift_sigma_mm),
        "held": list(part.held),
        "alone": None
        if part.alone is None
        else {f.name: number(getattr(part.alone, f.name)) for f in fields(part.alone)},
    }


def _row(row: RowChange) -> dict[str, Any]:
    decimals = sigma_decimals(row.sigma)
    return {
        "name": row.name,
        "unit": row.unit,
        "a": number(row.a, 12),
        "b": number(row.b, 12),
        "difference": number(row.difference),
        "sigma": number(row.sigma),
        "sigmas": number(row.sigmas),
        "text": {
            "a": plain_number(row.a, decimals),
            "b": plain_number(row.b, decimals),
            "difference": plain_number(row.difference, decimals),
            "sigma": sigma_text(row, decimals),
            "sigmas": plain_number(row.sigmas, 1),
        },
    }


def sigma_text(row: RowChange, decimals: int) -> str:
    """The sigma of a difference as it is printed."""
    if not np.isfinite(row.sigma):
        return "unknown"
    return plain_number(row.sigma, decimals) if row.sigma > 0 else "held"


def _pixels(one: PixelMap) -> dict[str, Any]:
    both = np.isfinite(one.difference_px).all(axis=1)
    uv, change = one.uv[both], one.difference_px[both]
    typical = float(np.quantile(np.linalg.norm(change, axis=1), 0.9))
    step = float(np.diff(np.unique(one.uv[:, 0])).min(initial=one.image_size[0]))
    who = f"camera '{one.camera}', points of plane '{one.plane}'"
    outside = (
        "" if one.outside_px is None else f"; up to {size_words(one.outside_px)} px outside them"
    )
    expected = _expected(one.expected_median_px, "px")
    return {
        "camera": one.camera,
        "plane": one.plane,
        "title": f"Pixel difference, {who}",
        "image_size": list(one.image_size),
        "planes": [one.plane],
        "spots": {
            "id": [f"point {k + 1}" for k in range(len(uv))],
            "u": numbers(uv[:, 0], PX),
            "v": numbers(uv[:, 1], PX),
            "du": numbers(change[:, 0], PX + 1),
            "dv": numbers(change[:, 1], PX + 1),
            "plane": [0] * len(uv),
        },
        "rejected": {"id": [], "u": [], "v": [], "du": [], "dv": []},
        "bins": None,
        "bins_magnification": None,
        "magnification": round_up(_ARROW_STEPS * step / typical) if typical > 0 else 1.0,
        "reference_px": round_up(typical) if typical > 0 else 1.0,
        "not_seen_by_b": int((~both).sum()),
        "expected_px": numbers(one.expected_px[both], PX + 1),
        "near": one.near[both].astype(int).tolist(),
        "median_px": number(one.median_px),
        "largest_px": number(one.largest_px),
        "expected_median_px": number(one.expected_median_px),
        "outside_px": number(one.outside_px),
        "alt": f"Arrows on {who}, from where A sees a point to where B does: median "
        f"{size_words(one.median_px)} px, largest {size_words(one.largest_px)} px among the "
        f"spots{expected}{outside}.",
        "caption": f"{_capital(who)}: arrows from where A sees a point to where B does. Median "
        f"{size_words(one.median_px)} px, largest {size_words(one.largest_px)} px among the "
        f"spots{expected}{outside}.",
    }


def _plane(one: PlaneMap) -> dict[str, Any]:
    known = one.difference_mm[np.isfinite(one.difference_mm)]
    who = f"plane '{one.plane}' seen by camera '{one.camera}'"
    outside = (
        "" if one.outside_mm is None else f"; up to {size_words(one.outside_mm)} mm outside them"
    )
    expected = _expected(one.expected_median_mm, "mm")
    low = float(known.min())
    return {
        "plane": one.plane,
        "camera": one.camera,
        "axes": one.axes.words,
        "x_mm": numbers(one.x_mm, 2),
        "y_mm": numbers(one.y_mm, 2),
        "difference_mm": numbers(one.difference_mm, MM),
        "expected_mm": numbers(one.expected_mm, MM),
        "inside": one.near.astype(int).tolist(),
        "contours": [
            {
                "level_mm": contour.level_mm,
                "text": f"{contour.level_mm:g}",
                "lines": [numbers(line, 2) for line in contour.lines],
            }
            for contour in one.contours
        ],
        "hull_mm": numbers(one.hull_mm, 2),
        "view_mm": numbers(one.view_mm, 2),
        "spots": {"x_mm": numbers(one.spots_mm[:, 0], 2), "y_mm": numbers(one.spots_mm[:, 1], 2)},
        "scale_mm": [
            number(low),
            number(max(min(float(known.max()), _WIDEST_SCALE * one.largest_mm), low + 1e-6)),
        ],
        "median_mm": number(one.median_mm),
        "largest_mm": number(one.largest_mm),
        "largest_at_mm": numbers(one.largest_at_mm, 1),
        "expected_median_mm": number(one.expected_median_mm),
        "outside_mm": number(one.outside_mm),
        "alt": f"Map of the distance between where A and B locate the same pixel on {who}: median "
        f"{size_words(one.median_mm)} mm, largest {size_words(one.largest_mm)} mm among the "
        f"spots{expected}{outside}.",
        "caption": f"{_capital(who)}: median {size_words(one.median_mm)} mm, largest "
        f"{size_words(one.largest_mm)} mm among the spots{expected}{outside}.",
    }


def _expected(value: float, unit: str) -> str:
    return f", where noise gives {size_words(value)} {unit}" if np.isfinite(value) else ""


def _inputs(found: InputsChange) -> dict[str, Any]:
    return {
        "spots_a": found.spots_a,
        "spots_b": found.spots_b,
        "shared": found.shared,
        "only_a": list(found.only_a),
        "only_b": list(found.only_b),
        "altered": list(found.altered),
        "same_pose": found.same_pose,
        "rejected": list(found.rejected),
        "options": _changes(found.options),
        "files": _changes(found.files),
        "made": _changes(found.made),
    }


def _changes(found: Sequence[Change]) -> list[Mapping[str, str]]:
    return [{"name": one.name, "a": one.a, "b": one.b} for one in found]


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]
