"""The figures as plain numbers with captions and text alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.figures.correlation import Correlation
from lasercal_gtsam.figures.coverage import ImageCoverage, PlaneCoverage
from lasercal_gtsam.figures.error_map import Contour, ErrorMap
from lasercal_gtsam.figures.places import PlaneAxes
from lasercal_gtsam.figures.residuals import MeanArrows, ResidualField, ResidualHistogram
from lasercal_gtsam.figures.scene import Scene
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.report.plainly import MM, PX, SHARE, M, number, numbers
from lasercal_gtsam.report.words import count, sentence, size_words

_MOST_PAIRS = 15
_WIDEST_SCALE = 3.0
"""Colours of an error map end at so many times the largest error among the spots."""


def residuals_section(
    calibration: Calibration,
    fields: Sequence[ResidualField],
    histograms: Sequence[ResidualHistogram],
) -> dict[str, Any]:
    """Residual vectors over each picture, and their histogram against the expected one."""
    fields = [one for one in fields if one.total]
    return {
        "heading": "Residuals in the picture",
        "words": [
            "A residual is the predicted minus the seen pixel. Noise points anywhere; arrows of "
            "neighbouring spots that agree are a model that does not fit."
        ]
        if fields
        else [],
        "missing": None if fields else _no_spots(calibration),
        "images": [_field(calibration, one) for one in fields],
        "histograms": [_histogram(one) for one in histograms],
    }


def _no_spots(calibration: Calibration) -> str:
    kept = len(calibration.inputs.observations)
    if not kept:
        return "The calibration does not hold its spots, only what they said."
    return "No spot was used."


def _columns(uv: Array, residual: Array) -> dict[str, Any]:
    return {
        "u": numbers(uv[:, 0], PX),
        "v": numbers(uv[:, 1], PX),
        "du": numbers(residual[:, 0], PX + 1),
        "dv": numbers(residual[:, 1], PX + 1),
    }


def _field(calibration: Calibration, one: ResidualField) -> dict[str, Any]:
    seen = calibration.inputs.observations
    sample = "" if len(one.shown) == one.total else f" {len(one.shown)} of {one.total} are drawn."
    means = one.means
    return {
        "camera": one.camera,
        "image_size": list(one.image_size),
        "total": one.total,
        "shown": len(one.shown),
        "magnification": one.magnification,
        "reference_px": one.reference_px,
        "rms_px": number(one.rms_px),
        "mean_px": numbers(one.mean_px, PX + 1),
        "largest_px": number(one.largest_px),
        "planes": list(seen.planes),
        "spots": {
            "id": seen.id[one.shown].tolist(),
            **_columns(one.uv, one.residual_px),
            "plane": seen.plane_index[one.shown].tolist(),
        },
        "bins": None if means is None else _bins(means),
        "bins_magnification": None if means is None else means.magnification,
        "rejected": {
            "id": seen.id[one.rejected].tolist(),
            **_columns(one.rejected_uv, one.rejected_px),
        },
        "alt": f"Arrows from {count(len(one.shown), 'spot')} in the picture of camera "
        f"'{one.camera}' towards where they are predicted. Root mean square "
        f"{size_words(one.rms_px)} px, longest {size_words(one.largest_px)} px, mean "
        f"({size_words(one.mean_px[0])}, {size_words(one.mean_px[1])}) px.",
        "caption": f"Camera '{one.camera}': arrows {one.magnification:g} times as long as the "
        f"residuals; the one in the legend is {one.reference_px:g} px.{sample}",
    }


def _bins(means: MeanArrows) -> dict[str, Any]:
    return {
        "columns": means.columns,
        "rows": means.rows,
        **_columns(means.uv, means.residual_px),
        "count": means.count.tolist(),
    }


def _histogram(one: ResidualHistogram) -> dict[str, Any]:
    expected = (
        ""
        if one.expected_rms_px is None
        else f"; expected from the noise {size_words(one.expected_rms_px)} px"
    )
    return {
        "camera": one.camera,
        "edges_px": numbers(one.edges_px, PX + 2),
        "counts": one.counts.tolist(),
        "expected": None if one.expected is None else numbers(one.expected, 3),
        "curve": None
        if one.curve is None
        else {"x_px": numbers(one.curve_px, PX + 1), "count": numbers(one.curve, 3)},
        "beyond": one.beyond,
        "coordinates": one.coordinates,
        "rms_px": number(one.rms_px),
        "expected_rms_px": number(one.expected_rms_px),
        "alt": f"Histogram of {one.coordinates} residual coordinates of camera '{one.camera}': "
        f"root mean square {size_words(one.rms_px)} px{expected}; {one.beyond} lie outside the "
        "bins.",
        "caption": f"Camera '{one.camera}': coordinates of the residuals (columns) and how many "
        "the noise gives (line), each spot with its own covariance and what the fit takes of it.",
    }


def coverage_section(
    calibration: Calibration,
    images: Sequence[ImageCoverage],
    planes: Sequence[PlaneCoverage],
) -> dict[str, Any]:
    """Spots in each picture and on each plane."""
    return {
        "heading": "Coverage",
        "words": [
            "Where there are no spots, the answer is an extrapolation: the lens outside the spots "
            "in the picture, flatness outside them on a plane."
        ],
        "missing": None if images else _no_spots(calibration),
        "images": [_image(calibration, one) for one in images],
        "planes": [_plane(one) for one in planes] if images else [],
    }


def _image(calibration: Calibration, one: ImageCoverage) -> dict[str, Any]:
    seen = calibration.inputs.observations
    rows, columns = one.counts.shape
    return {
        "camera": one.camera,
        "image_size": list(one.image_size),
        "columns": columns,
        "rows": rows,
        "counts": one.counts.tolist(),
        "total": one.total,
        "shown": len(one.shown),
        "spots": {
            "u": numbers(one.uv[:, 0], PX),
            "v": numbers(one.uv[:, 1], PX),
            "plane": seen.plane_index[one.shown].tolist(),
        },
        "planes": list(seen.planes),
        "hull_uv": numbers(one.hull_uv, PX),
        "hull_share": number(one.hull_share, 4),
        "fields": one.fields,
        "fields_total": one.fields_total,
        "reach": number(one.reach, 4),
        "alt": f"{count(one.total, 'spot')} in the picture of camera '{one.camera}', in "
        f"{one.fields} of {one.fields_total} fields; they surround {100 * one.hull_share:.0f} % of "
        f"it and reach {100 * one.reach:.0f} % of the way to the corners.",
        "caption": f"Camera '{one.camera}': spots surround {100 * one.hull_share:.0f} % of the "
        "picture.",
    }


def _axes(axes: PlaneAxes) -> dict[str, Any]:
    return {
        "origin_base_m": numbers(axes.origin_base, M),
        "x_base": numbers(axes.x_base, M),
        "y_base": numbers(axes.y_base, M),
        "words": axes.words,
    }


def _xy(points: Array) -> dict[str, Any]:
    return {"x_mm": numbers(points[:, 0], 2), "y_mm": numbers(points[:, 1], 2)}


def _plane(one: PlaneCoverage) -> dict[str, Any]:
    shares = "; ".join(
        f"{100 * view.share:.0f} % of what camera '{view.camera}' sees of it"
        for view in one.views
        if view.share is not None
    )
    return {
        "plane": one.plane,
        "axes": _axes(one.axes),
        "total": one.total,
        "shown": len(one.shown),
        "spots": _xy(one.xy_mm),
        "hull_mm": numbers(one.hull_mm, 2),
        "hull_cm2": number(one.hull_cm2, 4),
        "views": [
            {
                "camera": view.camera,
                "outline_mm": numbers(view.outline_mm, 2),
                "share": number(view.share, 4),
            }
            for view in one.views
        ],
        "rejected": _xy(one.rejected_mm),
        "alt": f"{count(one.total, 'spot')} on plane '{one.plane}' surround {one.hull_cm2:.3g} cm2"
        + (f", {shares}." if shares else "."),
        "caption": f"Plane '{one.plane}'" + (f": spots surround {shares}." if shares else "."),
    }


def error_section(
    maps: Sequence[ErrorMap], missing: str | None, halves_trouble: str
) -> dict[str, Any]:
    """Maps of expected error in millimetres, and beside each the same from split data."""
    return {
        "heading": "Expected error on the working planes",
        "words": [
            "How far a point is off, root mean square, that is located on the plane from an exact "
            "pixel (calibration.locate). Add the noise of the pixel itself where it has any. "
            "Beside it the same from data: half the distance between the answers of two "
            "calibrations from half the spots each. It is one draw of what the first map expects, "
            "so that the pattern may differ, but not the size."
        ]
        if maps
        else [],
        "missing": missing,
        "maps": [_map(one, halves_trouble) for one in maps],
    }


def _map(one: ErrorMap, halves_trouble: str) -> dict[str, Any]:
    who = f"plane '{one.plane}' seen by camera '{one.camera}'"
    among = "among the spots" if len(one.hull_mm) else "in view"
    finite = one.error_mm[one.seen]
    outside = (
        ""
        if one.outside_mm is None
        else f"; up to {size_words(one.outside_mm)} mm outside them on this map"
    )
    split = one.split
    return {
        "plane": one.plane,
        "camera": one.camera,
        "axes": _axes(one.axes),
        "x_mm": numbers(one.x_mm, 2),
        "y_mm": numbers(one.y_mm, 2),
        "error_mm": numbers(one.error_mm, MM),
        "inside": one.near.astype(int).tolist(),
        "levels_mm": [contour.level_mm for contour in one.contours],
        "contours": [_contour(contour) for contour in one.contours],
        "hull_mm": numbers(one.hull_mm, 2),
        "view_mm": numbers(one.view_mm, 2),
        "spots": _xy(one.spots_mm),
        "shown": len(one.spots_mm),
        "total": one.total,
        "median_mm": number(one.median_mm),
        "largest_mm": number(one.largest_mm),
        "largest_at_mm": numbers(one.largest_at_mm, 1),
        "outside_largest_mm": number(one.outside_mm),
        "across_mm": number(one.across_mm),
        "mm_per_px": number(one.mm_per_px),
        "scale_mm": [
            number(min(float(finite.min()), float(np.median(finite)))),
            number(min(float(finite.max()), _WIDEST_SCALE * one.largest_mm)),
        ],
        "split": None
        if split is None
        else {
            "error_mm": numbers(split.error_mm, MM),
            "contours": [_contour(contour) for contour in split.contours],
            "rms_mm": number(split.rms_mm),
            "expected_rms_mm": number(split.expected_rms_mm),
            "words": f"Root mean square {size_words(split.rms_mm)} mm {among}; the covariances of "
            f"the halves expect {size_words(split.expected_rms_mm)} mm.",
        },
        "split_missing": None if split is not None else sentence(halves_trouble or "no halves"),
        "alt": f"Map of expected error on {who}: median {size_words(one.median_mm)} mm and at most "
        f"{size_words(one.largest_mm)} mm {among}{outside}.",
        "split_alt": ""
        if split is None
        else f"Map of half the distance between two halves' answers on {who}: root mean square "
        f"{size_words(split.rms_mm)} mm {among}, expected {size_words(split.expected_rms_mm)} mm.",
        "caption": f"Expected error, {who}: median {size_words(one.median_mm)} mm, largest "
        f"{size_words(one.largest_mm)} mm {among}{outside}. One pixel is "
        f"{size_words(one.mm_per_px)} mm there.",
        "split_caption": ""
        if split is None
        else f"From split data: root mean square {size_words(split.rms_mm)} mm {among}, expected "
        f"{size_words(split.expected_rms_mm)} mm.",
    }


def _contour(contour: Contour) -> dict[str, Any]:
    return {
        "level_mm": contour.level_mm,
        "text": f"{contour.level_mm:g}",
        "lines": [numbers(line, 2) for line in contour.lines],
    }


def correlation_section(found: Correlation) -> dict[str, Any]:
    """Correlation matrix and its strongest pairs."""
    pairs = found.strong()
    strong = [
        {
            "a": a,
            "b": b,
            "value": number(value, 4),
            "words": f"{a} and {b} go {'together' if value > 0 else 'against each other'} "
            f"({value:+.3f})",
        }
        for a, b, value in pairs[:_MOST_PAIRS]
    ]
    more = f", and {len(pairs) - len(strong)} more" if len(pairs) > len(strong) else ""
    known = bool(found.names)
    return {
        "heading": "Correlation",
        "words": [
            f"{count(len(pairs), 'pair')} of rows {'has' if len(pairs) == 1 else 'have'} a "
            f"correlation of 0.9 or more{': the strongest are named' + more if more else ''}. Such "
            "rows make up for each other: their own sigmas are large where what is located with "
            "both is well known."
        ]
        if known and pairs
        else [],
        "missing": None if known else "There are no sigmas, and so no correlations.",
        "names": list(found.names),
        "units": list(found.units),
        "matrix": numbers(found.matrix, SHARE),
        "strong": strong,
        "held": list(found.held),
        "alt": f"Correlation matrix of {len(found.names)} rows; {len(pairs)} pairs at 0.9 or more"
        + (
            f", the strongest {pairs[0][0]} and {pairs[0][1]} at {pairs[0][2]:+.3f}."
            if pairs
            else "."
        ),
        "caption": "Rows in the order of the table; held rows are left out.",
    }


def scene_section(found: Scene) -> dict[str, Any]:
    """The cell in space."""
    enlarged = [layer.words for layer in found.layers if layer.magnification is not None]
    names = ", ".join(layer.label for layer in found.layers)
    return {
        "heading": "The cell",
        "words": [f"{words[:1].upper()}{words[1:]}." for words in enlarged],
        "missing": None,
        "unit": "m",
        "layers": [
            {
                "name": layer.name,
                "label": layer.label,
                "visible": layer.visible,
                "magnification": layer.magnification,
                "words": layer.words,
            }
            for layer in found.layers
        ],
        "primitives": [
            {
                "layer": part.layer,
                "kind": part.kind,
                "role": part.role,
                "axis": part.axis or None,
                "points": numbers(part.points, M - 1),
                "closed": part.closed,
                "name": part.name,
                "text": part.text,
            }
            for part in found.primitives
        ],
        "centre": numbers(found.centre, M),
        "radius": number(found.radius),
        "view": {
            "azimuth_deg": number(found.azimuth_deg, 4),
            "elevation_deg": number(found.elevation_deg, 4),
        },
        "alt": f"The cell in space, in base coordinates: {names}. It is "
        f"{size_words(2 * found.radius)} m across.",
        "caption": "Base coordinates, metres.",
    }
