"""What was left out and why: outliers of the fit, and rows that gave no spot, with thumbnails."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.figures.spots import Index
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture import Capture
from lasercal_gtsam.io.spot_account import RowSpot
from lasercal_gtsam.report.material import Material
from lasercal_gtsam.report.plainly import PX, number, numbers
from lasercal_gtsam.report.words import count, size_words

MOST_ROWS = 60
MOST_THUMBNAILS = 24
CROP_PX = 64
"""Side of a thumbnail, in pixels of the picture."""
_WHOLE_PX = 160


def rejected_section(material: Material) -> dict[str, Any]:
    """Outliers, the longest residual first, and rows of the capture without a spot."""
    spots = material.calibration.spots
    out = np.array([k for k, why in enumerate(spots.rejected) if why is not None], dtype=np.int64)
    length = np.linalg.norm(spots.residual_px[out], axis=1)
    out = out[np.argsort(-np.nan_to_num(length, nan=np.inf), kind="stable")]
    thumbnails = _Thumbnails(material)
    outliers = [_outlier(material, int(k), thumbnails) for k in out[:MOST_ROWS]]
    rows, total = _rows(material, thumbnails)
    found = len(out) + (total or 0)
    return {
        "heading": "What was left out",
        "words": _words(len(out), total, material.calibration.fit.n_rejected),
        "missing": None if found or material.calibration.fit.n_rejected else "Nothing.",
        "outliers": outliers,
        "outliers_total": len(out),
        "outliers_left_out": len(out) - len(outliers),
        "rows": rows,
        "rows_total": total,
        "rows_left_out": 0 if total is None else total - len(rows),
        "pictures": thumbnails.trouble(bool(found)),
    }


def _words(outliers: int, rows: int | None, counted: int) -> list[str]:
    words = []
    if counted:
        words.append(f"{count(counted, 'spot')} cannot be explained by noise and did not count.")
    if counted > outliers:
        words.append(
            f"Of {counted - outliers} of them the calibration no longer holds the account."
        )
    if rows:
        words.append(f"{count(rows, 'row')} of the capture gave no usable spot.")
    return words


def _outlier(material: Material, k: int, thumbnails: _Thumbnails) -> dict[str, Any]:
    seen, spot = material.calibration.inputs.observations, material.calibration.spots[k]
    residual = np.array(spot.residual_px)
    return {
        "id": spot.id,
        "plane": spot.plane,
        "camera": spot.camera,
        "laser": spot.laser,
        "uv": numbers(seen.uv[k], PX),
        "residual_px": numbers(residual, PX),
        "length_px": number(float(np.linalg.norm(residual))),
        "why": spot.rejected or "",
        "thumbnail": thumbnails.make(spot.id, seen.uv[k], seen.uv[k] + residual),
    }


def _rows(material: Material, thumbnails: _Thumbnails) -> tuple[list[dict[str, Any]], int | None]:
    """Rows of the capture that gave no usable spot, and their number; None without a capture."""
    if material.capture is None:
        return [], None
    skipped = _skipped(material.capture, material)
    rows = []
    for k, row in skipped[:MOST_ROWS]:
        uv = np.array(row.uv)
        known = bool(np.isfinite(uv).all())
        rows.append(
            {
                "id": row.id,
                "plane": str(material.capture.planes[k]),
                "camera": str(material.capture.cameras[k]),
                "verdict": row.verdict,
                "why": row.reason,
                "uv": numbers(uv, PX) if known else None,
                "thumbnail": thumbnails.make(row.id, uv if known else None, None),
            }
        )
    return rows, len(skipped)


def _skipped(capture: Capture, material: Material) -> list[tuple[int, RowSpot]]:
    """Numbers and accounts of the rows without a usable spot."""
    if material.account is not None:
        return [(k, row) for k, row in enumerate(material.account) if row.verdict != "used"]
    known = set(material.calibration.inputs.observations.id.tolist())
    nowhere = (float("nan"), float("nan"))
    why = "it is not among the spots of the calibration; 'lasercal detect' says what is wrong"
    return [
        (k, RowSpot(name, "no spot", why, "", nowhere))
        for k, name in enumerate(capture.ids.tolist())
        if name not in known
    ]


class _Thumbnails:
    """Makes thumbnails until there are enough; remembers why it could not."""

    def __init__(self, material: Material) -> None:
        capture = material.capture
        self._capture = capture
        self._rows: dict[str, int] = (
            {} if capture is None else {str(name): k for k, name in enumerate(capture.ids)}
        )
        self._made = self._wanted = 0
        self._unreadable = ""

    def make(self, name: str, uv: Array | None, predicted: Array | None) -> dict[str, Any] | None:
        """The spot's surroundings, or the whole picture where there is no spot; None without."""
        capture, k = self._capture, self._rows.get(name)
        path = None if capture is None or k is None else capture.images_on[k]
        if capture is None or k is None or path is None:
            return None
        self._wanted += 1
        if self._made >= MOST_THUMBNAILS:
            return None
        from lasercal_gtsam.io.pictures import read_picture

        try:
            picture = read_picture(path, capture.image_size[str(capture.cameras[k])], f"id {name}")
        except DataError as error:
            self._unreadable = str(error)
            return None
        self._made += 1
        return _whole(picture, name) if uv is None else _crop(picture, name, uv, predicted)

    def trouble(self, needed: bool) -> str | None:
        """Why thumbnails are missing, in a sentence; None where none is."""
        if not needed:
            return None
        if self._capture is None:
            return "The capture is not at hand, so there are no pictures."
        if self._unreadable:
            return f"Some pictures could not be read: {self._unreadable}."
        if not self._wanted:
            return "The spots were given as pixels: there are no pictures."
        if self._wanted > self._made:
            return f"{self._made} of {self._wanted} thumbnails are shown."
        return None


def _crop(picture: Any, name: str, uv: Array, predicted: Array | None) -> dict[str, Any]:
    from lasercal_gtsam.detect.crop import as_bgr8, cut, stretched

    corner = np.round(uv).astype(int) - CROP_PX // 2
    crop = stretched(cut(as_bgr8(picture), (int(corner[0]), int(corner[1]), CROP_PX)))
    words = f"Picture of {name} about ({uv[0]:.0f}, {uv[1]:.0f}), {CROP_PX} pixels wide"
    if predicted is not None and np.isfinite(predicted).all():
        away = float(np.linalg.norm(predicted - uv))
        words += f"; the spot is predicted {size_words(away)} px away"
    else:
        predicted = None
    return _encoded(crop, 1.0, corner, uv, predicted, f"{words}.")


def _whole(picture: Any, name: str) -> dict[str, Any]:
    import cv2

    from lasercal_gtsam.detect.crop import as_bgr8, stretched

    view = as_bgr8(picture)
    height, width = view.shape[:2]
    scale = min(1.0, _WHOLE_PX / max(width, height))
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    small = cv2.resize(view, size, interpolation=cv2.INTER_AREA)
    words = f"The whole picture of {name}, in which no spot was found."
    return _encoded(
        stretched(np.asarray(small, dtype=np.uint8)),
        scale,
        np.zeros(2, np.int64),
        None,
        None,
        words,
    )


def _encoded(
    image: Any, scale: float, corner: Index, seen: Array | None, predicted: Array | None, alt: str
) -> dict[str, Any]:
    import cv2

    gray = bool((image == image[..., :1]).all())
    done, content = cv2.imencode(".png", image[..., 0] if gray else image)
    if not done:
        raise DataError("a thumbnail could not be written as PNG")

    def place(uv: Array | None) -> Any:
        return None if uv is None else numbers((uv - corner) * scale, 2)

    return {
        "data": "data:image/png;base64," + base64.b64encode(content.tobytes()).decode("ascii"),
        "width": int(image.shape[1]),
        "height": int(image.shape[0]),
        "scale": number(scale),
        "corner_uv": [int(corner[0]), int(corner[1])],
        "seen": place(seen),
        "predicted": place(predicted),
        "alt": alt,
    }
