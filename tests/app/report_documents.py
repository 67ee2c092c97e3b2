"""Report dictionaries made from formulas: any number of cameras, planes and spots, or nothing."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np

Document = dict[str, Any]
LEVELS = (("picture", "free point"), ("ray", "ray"), ("hand", "free hand"), ("full", "full chain"))


def section(heading: str, missing: str | None = None, **parts: Any) -> Document:
    words = (
        [] if missing else [f"{heading}: what it says and how to read it, in a sentence or two."]
    )
    return {"heading": heading, "words": words, "missing": missing, **parts}


def document(
    cameras: tuple[str, ...] = ("camera",),
    planes: tuple[str, ...] = ("1", "2", "3"),
    spots: int = 90,
    grade: str = "good",
    binned: bool = False,
) -> Document:
    """A whole document; the numbers are plausible and mean nothing."""
    rng = np.random.default_rng(3)
    names = [f"{c}.{p}" if len(cameras) > 1 else p for c in cameras for p in ("fu", "u0", "k1")]
    names += ["laser_theta", *(f"a_{p}_z" for p in planes)]
    return {
        "format": "lasercal-report",
        "version": 1,
        "title": "Calibration of a cell",
        "created": "2026-11-22T13:30:00Z",
        "language": "en",
        "summary": {
            "cameras": list(cameras), "lasers": ["laser"], "planes": list(planes),
            "n_spots": spots, "n_rejected": 2, "rms_px": 0.1639, "sigma0": 1.05, "dof": 144,
            "iterations": 13, "converged": True, "status": "converged (13 iterations)",
            "noise": "the residuals are 1.05 times what the stated noise explains",
            "image_sizes": {c: [640, 480] for c in cameras},
            "expected_error_mm": [
                {"plane": p, "camera": c, "median": 0.12, "largest": 0.4}
                for p in planes for c in cameras
            ],
        },
        "verdict": section(
            "Verdict", grade=grade, next_action="Use it; calibrate again when something moves.",
            reasons=[
                {"code": "a", "severity": "weak", "words": "few at the edge", "action": "Add."},
                {"code": "b", "severity": "note", "words": "noise is stated", "action": ""},
            ],
        ),
        "parameters": section(
            "Parameters", rows=[_parameter(n, cameras) for n in names],
            interval={"level": 0.95, "distribution": "t", "dof": 144.0, "factor": 1.98,
                      "words": "Interval: 1.98 sigma on either side."},
            rms_px=0.1639,
        ),
        "rejected": section(
            "Rejected", outliers=[_outlier(k, cameras[0], planes[0]) for k in range(2)],
            outliers_total=2, outliers_left_out=0,
            rows=[{"id": "s004", "plane": planes[0], "camera": cameras[0], "verdict": "ambiguous",
                   "why": "a second spot has 53% of the peak", "uv": [376.0, 85.0],
                   "thumbnail": None}],
            rows_total=1, rows_left_out=0, pictures=None,
        ),
        "residuals": section(
            "Residuals", images=[_vectors(rng, c, planes, spots, binned) for c in cameras],
            histograms=[_histogram(c, spots) for c in cameras],
        ),
        "levels": _levels(cameras, planes, spots),
        "coverage": section(
            "Coverage", images=[_image_coverage(rng, c, planes, spots) for c in cameras],
            planes=[_plane_coverage(rng, p, cameras, spots) for p in planes],
        ),
        "error_maps": section("Error maps", maps=[_map(p, c) for p in planes for c in cameras]),
        "correlation": _correlation(rng, names),
        "weak": section(
            "Weak directions",
            directions=[{"strength": 0.4, "what": "u0 and Tx together", "amounts": "1 px, 2 mm",
                         "cause": "one depth", "cure": "tilt a plane", "enough": False,
                         "distortion": False}],
            held=["k2 held at 0"], notes=[],
        ),
        "scene": _scene(cameras, planes),
        "model_error": section(
            "Model error",
            items=[{"name": "flat planes", "words": "A plane is a plane.", "sign": "Bows.",
                    "sought": {"found": False, "chance": 0.4, "words": ""}},
                   {"name": "lens", "words": "Two terms.", "sign": "Rings.", "sought": None}],
        ),
        "conventions": section(
            "Conventions",
            groups=[{"heading": "Pixels", "items": [{"term": "(0, 0)", "words": "top left"}]}],
        ),
        "inputs": section(
            "Inputs", files=[{"name": "capture.yaml", "sha256": "0f" * 32}],
            calibration={"name": "calibration.json", "sha256": "1e" * 32},
            inputs_sha256="2d" * 32, calibrated="2026-11-22T12:00:00Z", made_with="0.1.0",
            versions={"numpy": "2.4.6"}, options=[{"name": "seed", "value": "0", "words": ""}],
            commands=[{"words": "To repeat it", "command": "lasercal calibrate 'cell' && true"}],
            n_spots=spots,
        ),
    }  # fmt: skip


def empty_document() -> Document:
    """Nothing but sections that say why they are empty."""
    full = document()

    def emptied(part: Document) -> Document:
        kept = {
            k: [] if isinstance(v, list) else 0 if isinstance(v, int) else None
            for k, v in part.items()
        }
        return {**kept, "heading": part["heading"], "words": [], "missing": "There were no spots."}

    out = {k: emptied(v) if isinstance(v, dict) and "heading" in v else v for k, v in full.items()}
    out["verdict"] |= {"grade": "bad", "next_action": "Take spots."}
    out["parameters"]["interval"] = {
        "level": 0.95, "distribution": None, "dof": None, "factor": None, "words": "",
    }  # fmt: skip
    out["summary"] |= {
        "n_spots": 0, "n_rejected": 0, "rms_px": None, "sigma0": None, "dof": None,
        "expected_error_mm": [], "converged": False, "status": "not solved",
    }  # fmt: skip
    return out


def _parameter(name: str, cameras: tuple[str, ...]) -> Document:
    value, sigma = 549.6934, 0.7021
    return {
        "name": name, "label": f"label of {name}", "part": f"camera '{cameras[0]}'", "unit": "px",
        "frame": "", "initial": 532.62, "refined": value, "sigma": sigma,
        "low": value - 1.39, "high": value + 1.39, "held": False, "meaning": f"Meaning of {name}.",
        "text": {"initial": "532.62", "refined": "549.69", "sigma": "0.70", "low": "548.30",
                 "high": "551.08"},
    }  # fmt: skip


def _outlier(k: int, camera: str, plane: str) -> Document:
    _, png = cv2.imencode(".png", np.full((48, 48), 40 + 90 * k, np.uint8))
    data = "data:image/png;base64," + base64.b64encode(png.tobytes()).decode()
    thumb = {
        "data": data, "width": 48, "height": 48, "scale": 2.0, "corner_uv": [90.0, 40.0],
        "seen": [24.0, 20.0], "predicted": [70.0, 20.0], "alt": f"Picture of spot {k}",
    }  # fmt: skip
    return {
        "id": f"s10{k}", "plane": plane, "camera": camera, "laser": "laser", "uv": [102.5, 50.25],
        "residual_px": [4.5, -3.25], "length_px": 5.55, "why": "far from where the others put it",
        "thumbnail": thumb,
    }  # fmt: skip


def _spots(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.column_stack([rng.uniform(20, 620, n), rng.uniform(20, 460, n)])


def _vectors(
    rng: np.random.Generator, camera: str, planes: tuple[str, ...], n: int, binned: bool
) -> Document:
    uv, d = _spots(rng, min(n, 1500)), rng.normal(0, 0.12, (min(n, 1500), 2))
    field = np.stack(np.meshgrid(np.arange(40.0, 640, 80), np.arange(40.0, 480, 80)), -1)
    uv_bin = field.reshape(-1, 2)
    bins = {
        "columns": 8, "rows": 6, "u": uv_bin[:, 0].tolist(), "v": uv_bin[:, 1].tolist(),
        "du": (0.01 * np.sin(uv_bin[:, 0] / 99)).tolist(), "count": [n // 48] * 48,
        "dv": (0.01 * np.cos(uv_bin[:, 1] / 99)).tolist(),
    }  # fmt: skip
    return {
        "camera": camera, "image_size": [640, 480], "total": n, "shown": len(uv),
        "magnification": 150.0, "reference_px": 0.2, "rms_px": 0.17, "mean_px": [0.0, 0.0],
        "largest_px": 0.5, "planes": list(planes),
        "spots": {
            "id": [f"s{k:03d}" for k in range(len(uv))], "u": uv[:, 0].tolist(),
            "v": uv[:, 1].tolist(), "du": d[:, 0].tolist(), "dv": d[:, 1].tolist(),
            "plane": [k % len(planes) for k in range(len(uv))],
        },
        "bins": bins if binned else None, "bins_magnification": 2000.0 if binned else None,
        "rejected": {"id": ["s100"], "u": [102.5], "v": [50.25], "du": [4.5], "dv": [-3.25]},
        "alt": f"Residual vectors on the picture of camera {camera}.", "caption": "No pattern.",
    }  # fmt: skip


def _histogram(camera: str, n: int) -> Document:
    edges = np.linspace(-0.5, 0.5, 21)
    middle = (edges[1:] + edges[:-1]) / 2
    expected = 2 * n * np.exp(-0.5 * (middle / 0.12) ** 2) * 0.05 / (0.12 * np.sqrt(2 * np.pi))
    x = np.linspace(-0.5, 0.5, 101)
    curve = 2 * n * np.exp(-0.5 * (x / 0.12) ** 2) * 0.05 / (0.12 * np.sqrt(2 * np.pi))
    return {
        "camera": camera, "edges_px": edges.tolist(),
        "counts": np.rint(expected).astype(int).tolist(),
        "expected": expected.tolist(), "curve": {"x_px": x.tolist(), "count": curve.tolist()},
        "beyond": 1, "coordinates": 2 * n, "rms_px": 0.12, "expected_rms_px": 0.12,
        "alt": f"Histogram of the residuals of camera {camera}.", "caption": "Bell-shaped.",
    }  # fmt: skip


def _levels(cameras: tuple[str, ...], planes: tuple[str, ...], spots: int) -> Document:
    def row(scale: float) -> list[Document]:
        return [
            {"level": name, "rms_px": scale * 0.1 * k, "expected_px": 0.1 * k}
            for k, (name, _) in enumerate(LEVELS, 1)
        ]

    group = {"first": "s001", "plane": planes[0], "spots": 10}
    return section(
        "Levels",
        levels=[
            {"name": name, "label": label, "frees": "a part", "tests": "the rest", "rms_px": 0.1,
             "expected_px": 0.11, "dof": 90, "chance": 0.3} for name, label in LEVELS
        ],
        by_camera=[{"name": c, "spots": spots, "cells": row(1.0)} for c in cameras],
        by_plane=[
            {"name": p, "spots": spots, "cells": row(0.9 + 0.3 * k)} for k, p in enumerate(planes)
        ],
        by_orientation=[{**group, "cells": row(1.1)} for _ in range(15)],
        orientations_left_out=3,
        left_out=[
            {**group, "rms_px": 0.2, "expected_px": 0.19, "rms_mm": 0.1, "expected_mm": 0.11,
             "chance": 0.2},
            {**group, "rms_px": None, "expected_px": None, "rms_mm": None, "expected_mm": None,
             "chance": None},
        ],
        left_out_more=4,
        faults=[{"words": "the camera moved", "chance": 1e-7, "noise_ratio": 0.8, "unknowns": 6,
                 "significant": True}],
        faults_more=9,
        tests=[{"name": "tails", "asks": "are large residuals too many", "value": 0.1,
                "chance": 0.4}],
        halves={"rows": [{"name": "fu", "unit": "px", "difference": -1.2, "sigma": 1.4,
                          "sigmas": -0.857}], "more": 3, "chance": 0.5, "words": "they agree"},
    )  # fmt: skip


def _image_coverage(
    rng: np.random.Generator, camera: str, planes: tuple[str, ...], n: int
) -> Document:
    uv = _spots(rng, min(n, 1500))
    return {
        "camera": camera, "image_size": [640, 480], "columns": 4, "rows": 3,
        "counts": [[8, 7, 9, 0], [7, 8, 8, 7], [8, 7, 7, 7]], "total": n, "shown": len(uv),
        "spots": {"u": uv[:, 0].tolist(), "v": uv[:, 1].tolist(),
                  "plane": [k % len(planes) for k in range(len(uv))]},
        "planes": list(planes), "hull_uv": [[20, 20], [620, 20], [620, 460], [20, 460]],
        "hull_share": 0.86, "fields": 11, "fields_total": 12, "reach": 0.95,
        "alt": f"Coverage of the picture of camera {camera}.", "caption": "11 of 12 fields.",
    }  # fmt: skip


def _axes() -> Document:
    return {
        "origin_base_m": [0.5, 0.0, 0.1], "x_base": [1, 0, 0], "y_base": [0, 1, 0],
        "words": "x along base x, y along base y",
    }  # fmt: skip


def _plane_coverage(
    rng: np.random.Generator, plane: str, cameras: tuple[str, ...], n: int
) -> Document:
    xy = rng.uniform(-150, 150, (min(n, 800), 2))
    return {
        "plane": plane, "axes": _axes(), "total": n, "shown": len(xy),
        "spots": {"x_mm": xy[:, 0].tolist(), "y_mm": xy[:, 1].tolist()},
        "hull_mm": [[-150, -150], [150, -150], [150, 150], [-150, 150]], "hull_cm2": 900.0,
        "views": [
            {"camera": c, "outline_mm": [[-250, -180], [240, -200], [260, 210], [-230, 190]],
             "share": 0.5} for c in cameras
        ],
        "rejected": {"x_mm": [10.0], "y_mm": [20.0]},
        "alt": f"Coverage of plane {plane}.", "caption": "",
    }  # fmt: skip


def _map(plane: str, camera: str) -> Document:
    x, y = np.linspace(-250, 250, 31), np.linspace(-200, 200, 25)
    field = 0.1 + 4e-6 * (x[None, :] ** 2 + 1.5 * y[:, None] ** 2)
    error = [
        [float(e) if abs(a) < 230 else None for e, a in zip(row, x, strict=True)] for row in field
    ]
    turn = np.linspace(0, 2 * np.pi, 60)
    circle = np.column_stack([np.cos(turn), np.sin(turn) / np.sqrt(1.5)])
    contours = [
        {"level_mm": level, "text": f"{level:g}",
         "lines": [(np.sqrt((level - 0.1) / 4e-6) * circle).tolist()]} for level in (0.15, 0.2)
    ]  # fmt: skip
    return {
        "plane": plane, "camera": camera, "axes": _axes(), "x_mm": x.tolist(), "y_mm": y.tolist(),
        "error_mm": error, "inside": (field < 0.2).astype(int).tolist(),
        "levels_mm": [0.15, 0.2], "contours": contours,
        "hull_mm": [[-150, -150], [150, -150], [150, 150], [-150, 150]],
        "view_mm": [[-230, -190], [230, -190], [230, 190], [-230, 190]],
        "spots": {"x_mm": [0.0], "y_mm": [0.0]}, "shown": 1, "total": 1,
        "median_mm": 0.13, "largest_mm": 0.32, "largest_at_mm": [-149.0, 150.0],
        "outside_largest_mm": 0.5, "across_mm": 0.05, "mm_per_px": 0.8, "scale_mm": [0.0, 0.6],
        "split": {"error_mm": error, "contours": contours, "rms_mm": 0.2, "expected_rms_mm": 0.21,
                  "words": "the halves agree"},
        "split_missing": None, "alt": f"Expected error on plane {plane}.",
        "split_alt": f"Split data on plane {plane}.", "caption": "One sigma.", "split_caption": "",
    }  # fmt: skip


def _correlation(rng: np.random.Generator, names: list[str]) -> Document:
    root = rng.normal(size=(len(names), len(names)))
    cov = root @ root.T
    scale = np.sqrt(np.diag(cov))
    matrix = cov / np.outer(scale, scale)
    return section(
        "Correlation", names=names, units=["px"] * len(names), matrix=matrix.tolist(),
        strong=[{"a": names[0], "b": names[1], "value": 0.93, "words": "rise together"}],
        held=[], alt="Correlation matrix.", caption="",
    )  # fmt: skip


def _scene(cameras: tuple[str, ...], planes: tuple[str, ...]) -> Document:
    def part(layer: str, kind: str, role: str, points: Any, **more: Any) -> Document:
        return {"layer": layer, "kind": kind, "role": role, "axis": None, "closed": False,
                "name": f"{role} of {layer}", "text": "",
                "points": np.asarray(points, float).tolist(), **more}  # fmt: skip

    parts = [
        part("base", "line", "base", [[0, 0, 0], np.eye(3)[k] * 0.1], axis="xyz"[k])
        for k in range(3)
    ]
    parts.append(part("base", "label", "base", [[0, 0, 0]], text="base"))
    square = np.array([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]])
    for k, name in enumerate(planes):
        at = [0.5, 0.0, 0.05 * k]
        parts.append(part("planes", "polygon", "plane", square + at, name=f"plane {name}"))
        parts.append(part("planes", "label", "plane", [at], text=f"plane {name}"))
        parts.append(part("spots", "points", "spot", square[:, :] * 0.5 + at))
    for k, name in enumerate(cameras):
        eye = np.array([0.4, 0.3 * k, 0.6])
        parts.append(part("cameras", "line", "camera", [eye, eye - [0.1, 0, 0.1]], name=name))
        parts.append(part("beams", "line", "laser", [eye, [0.5, 0, 0]], name=f"beam {k}"))
    layers = [
        {"name": n, "label": n.capitalize(), "visible": n != "beams", "magnification": None,
         "words": f"The {n}."} for n in ("base", "planes", "spots", "cameras", "beams")
    ]  # fmt: skip
    return section(
        "The cell", unit="m", layers=layers, primitives=parts, centre=[0.4, 0.0, 0.2], radius=0.6,
        view={"azimuth_deg": -60.0, "elevation_deg": 25.0}, alt="The cell from the side.",
        caption="Base axes 0.1 m long.",
    )  # fmt: skip
