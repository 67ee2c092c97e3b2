"""A contact sheet: every picture's spot on one image, to judge a detection at a glance."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np

from lasercal_gtsam.detect.crop import OUTSIDE, View, as_bgr8, cut, stretched
from lasercal_gtsam.detect.detection import Detection
from lasercal_gtsam.errors import DetectionError

Sheet = View

_TEXT_ROWS = 30  # px under each tile
_GAP = 4
_MAX_SHEET = 6000  # px: tiles shrink so that hundreds of pictures still fit
_MIN_TILE = 64
_CROP_SIGMAS = 8.0
_MIN_CROP = 32  # px of the picture that a tile shows at least
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_WHITE = (235, 235, 235)
# BGR by what the verdict means: taken, found but not taken, nothing there
_COLOURS = {"used": (90, 220, 90), "none": (150, 150, 150), "ambiguous": (60, 190, 255)}
_REFUSED = (80, 80, 255)


def contact_sheet(
    pictures: Iterable[Any],
    detections: Sequence[Detection],
    ids: Sequence[str] | None = None,
    columns: int | None = None,
    tile: int = 160,
) -> Sheet:
    """Draw a tile for each picture: the spot's surroundings, its centre, its size, the verdict.

    An ellipse marks the spot at 2 sigma and four ticks point at its centre, which stays free to be
    looked at; brightness is stretched to what the tile shows. The small inset is the whole picture
    with the crop framed and the second candidate, if any, ringed. Pictures are taken one
    at a time from the iterable, so that hundreds need the memory of one.

    Parameters
    ----------
    pictures : iterable of (height, width[, 3]) arrays
        The laser-on pictures in the order of ``detections``, for example a generator that reads
        files.
    detections : N detections
    ids : N labels; "0", "1", ... if left out
    columns : tiles in a row; about a square if left out
    tile : size of a tile, px; smaller where the sheet would exceed 6000 px

    Returns
    -------
    (height, width, 3) uint8 array
        BGR, for `cv2.imwrite`.

    Raises
    ------
    DetectionError
        The numbers of pictures, detections and ids differ.
    """
    count = len(detections)
    names = [str(i) for i in (range(count) if ids is None else ids)]
    if len(names) != count:
        raise DetectionError(f"contact sheet: {count} detections but {len(names)} ids")
    columns = max(1, min(columns or int(np.ceil(np.sqrt(count * 1.4))), max(count, 1)))
    rows = max(1, -(-count // columns))
    room = min(_MAX_SHEET // columns - _GAP, _MAX_SHEET // rows - _GAP - _TEXT_ROWS)
    tile = int(max(min(tile, room), _MIN_TILE))
    pitch = (tile + _TEXT_ROWS + _GAP, tile + _GAP)
    sheet = np.full((rows * pitch[0] + _GAP, columns * pitch[1] + _GAP, 3), OUTSIDE, np.uint8)
    drawn = 0
    for picture, detection, name in zip(pictures, detections, names, strict=False):
        row, column = divmod(drawn, columns)
        y, x = row * pitch[0] + _GAP, column * pitch[1] + _GAP
        sheet[y : y + tile + _TEXT_ROWS, x : x + tile] = _tile(picture, detection, name, tile)
        drawn += 1
    if drawn != count:
        raise DetectionError(f"contact sheet: {count} detections but {drawn} pictures")
    return sheet


def _tile(picture: Any, detection: Detection, name: str, size: int) -> Sheet:
    colour = _COLOURS.get(detection.verdict, _REFUSED)
    view = as_bgr8(picture)
    box = _crop_box(detection, view.shape)
    crop = stretched(cut(view, box))
    scale = size / box[2]
    image = cv2.resize(crop, (size, size), interpolation=cv2.INTER_NEAREST)
    if np.isfinite(detection.uv).all():
        _draw_spot(image, detection, box, scale, colour)
    _draw_inset(image, view, detection, box, colour)
    strip = np.full((_TEXT_ROWS, size, 3), OUTSIDE, np.uint8)
    scale_text = 0.4 if size >= 120 else 0.3
    cv2.putText(strip, _ascii(name), (2, 11), _FONT, scale_text, _WHITE, 1, cv2.LINE_AA)
    line = detection.verdict + ("" if not detection.single_frame else " (single)")
    if detection.usable:
        sigma = np.sqrt(np.linalg.eigvalsh(detection.cov_uv)[1])
        line += f" {sigma:.2f}px"
    cv2.putText(strip, line, (2, 25), _FONT, scale_text, colour, 1, cv2.LINE_AA)
    return np.vstack([np.asarray(image, dtype=np.uint8), strip])


def _crop_box(detection: Detection, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Corner and size (u0, v0, side) of what the tile shows; the whole picture for ``none``."""
    height, width = shape[:2]
    if not np.isfinite(detection.uv).all():
        side = max(width, height)
        return (width - side) // 2, (height - side) // 2, side
    side = int(np.clip(2 * _CROP_SIGMAS * detection.sigma_major, _MIN_CROP, max(width, height)))
    u, v = (round(float(x)) for x in detection.uv)
    return u - side // 2, v - side // 2, side


def _draw_spot(
    image: Any,
    detection: Detection,
    box: tuple[int, int, int],
    scale: float,
    colour: tuple[int, int, int],
) -> None:
    # drawing calls take fixed-point coordinates with 4 binary digits; pixel centres lie at +0.5
    u, v = (detection.uv - box[:2] + 0.5) * scale - 0.5
    centre = (round(u * 16), round(v * 16))
    axes = tuple(
        max(round(2 * s * scale * 16), 16) for s in (detection.sigma_major, detection.sigma_minor)
    )
    angle = float(np.degrees(detection.angle_rad))
    cv2.ellipse(image, centre, axes, angle, 0.0, 360.0, colour, 1, cv2.LINE_AA, 4)
    near, far = axes[0] + 16 * 3, axes[0] + 16 * 11
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        start = (centre[0] + du * near, centre[1] + dv * near)
        end = (centre[0] + du * far, centre[1] + dv * far)
        cv2.line(image, start, end, colour, 1, cv2.LINE_AA, 4)


def _draw_inset(
    image: Any,
    view: Sheet,
    detection: Detection,
    box: tuple[int, int, int],
    colour: tuple[int, int, int],
) -> None:
    """Whole picture in the lower right corner, the crop framed, the runner-up ringed."""
    if not np.isfinite(detection.uv).all():
        return
    size = image.shape[0]
    scale = 0.35 * size / max(view.shape[:2])
    width, height = (max(1, round(x * scale)) for x in view.shape[1::-1])
    inset = cv2.resize(view, (width, height), interpolation=cv2.INTER_AREA)
    u0, v0, side = (round(x * scale) for x in box)
    cv2.rectangle(inset, (u0, v0), (u0 + side, v0 + side), colour, 1)
    if detection.runner_up is not None and not detection.usable:
        at = tuple(round(float(x) * scale) for x in detection.runner_up.uv)
        cv2.circle(inset, at, 4, _COLOURS["ambiguous"], 1)
    image[size - height :, size - width :] = inset
    cv2.rectangle(image, (size - width - 1, size - height - 1), (size, size), _WHITE, 1)


def _ascii(text: str) -> str:
    """The built-in font knows ASCII only."""
    return text.encode("ascii", "replace").decode("ascii")
