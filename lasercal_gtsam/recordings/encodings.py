"""Image messages as pictures: gray, or colour in OpenCV's order (BGR), 8 or 16 bit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.pictures import Picture, decode_picture
from lasercal_gtsam.io.wording import did_you_mean

Order = Literal["gray", "bgr", "rgb", "bgra", "rgba", "RGGB", "BGGR", "GBRG", "GRBG"]


@dataclass(frozen=True)
class Encoding:
    """How an image message stores a pixel; ``order`` in capitals is a Bayer pattern."""

    order: Order
    bits: Literal[8, 16]

    @property
    def channels(self) -> int:
        """Numbers for a pixel."""
        return 1 if self.order == "gray" or self.order.isupper() else len(self.order)


ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding("gray", 8),
    "mono16": Encoding("gray", 16),
    "8UC1": Encoding("gray", 8),
    "16UC1": Encoding("gray", 16),
    "bgr8": Encoding("bgr", 8),
    "rgb8": Encoding("rgb", 8),
    "bgra8": Encoding("bgra", 8),
    "rgba8": Encoding("rgba", 8),
    "bgr16": Encoding("bgr", 16),
    "rgb16": Encoding("rgb", 16),
    "bayer_rggb8": Encoding("RGGB", 8),
    "bayer_bggr8": Encoding("BGGR", 8),
    "bayer_gbrg8": Encoding("GBRG", 8),
    "bayer_grbg8": Encoding("GRBG", 8),
    "bayer_rggb16": Encoding("RGGB", 16),
    "bayer_bggr16": Encoding("BGGR", 16),
    "bayer_gbrg16": Encoding("GBRG", 16),
    "bayer_grbg16": Encoding("GRBG", 16),
}
"""Encodings of ``sensor_msgs/Image`` that can be read."""


def picture_from_raw(
    data: Any, *, height: int, width: int, step: int, encoding: str, big_endian: bool
) -> Picture:
    """A picture out of the fields of a ``sensor_msgs/Image``.

    Bayer mosaics are demosaiced, since the detector looks at one colour; transparency is dropped;
    everything else keeps its pixel values.

    Parameters
    ----------
    data : the message's bytes
    height, width : pixels
    step : bytes from one row to the next, padding included
    encoding : one of `ENCODINGS`
    big_endian : order of the bytes of 16-bit numbers

    Returns
    -------
    (height, width) or (height, width, 3) array
        uint8 or uint16, C-contiguous.

    Raises
    ------
    DataError
        Unknown encoding, or fewer bytes than rows of that length need.
    """
    if encoding not in ENCODINGS:
        raise DataError(
            f"the encoding {encoding!r} cannot be read{did_you_mean(encoding, ENCODINGS)}; known "
            f"are {', '.join(ENCODINGS)}"
        )
    form = ENCODINGS[encoding]
    row = width * form.channels * form.bits // 8
    content = np.frombuffer(data, dtype=np.uint8)
    if step < row or content.size < step * (height - 1) + row or not (height and width):
        raise DataError(
            f"{content.size} bytes in rows of {step} are no {width} x {height} picture of encoding "
            f"{encoding}, which needs {row} bytes a row"
        )
    padded = np.zeros((height, step), dtype=np.uint8)
    padded.ravel()[: min(content.size, padded.size)] = content[: padded.size]
    rows = np.ascontiguousarray(padded[:, :row])
    if form.bits == 16:
        order = ">u2" if big_endian else "<u2"
        rows = rows.view(np.dtype(order)).astype(np.uint16)
    if form.channels == 1:
        return _demosaiced(rows, form.order) if form.order.isupper() else rows
    colours = rows.reshape(height, width, form.channels)[..., :3]
    return np.ascontiguousarray(colours[..., ::-1] if form.order.startswith("rgb") else colours)


def _demosaiced(mosaic: Picture, pattern: str) -> Picture:
    import cv2

    # OpenCV's old names are those of the second row and column; these are of the first
    code = int(getattr(cv2, f"COLOR_Bayer{pattern}2BGR"))
    return np.asarray(cv2.cvtColor(mosaic, code))


def picture_from_compressed(data: Any, form: str) -> Picture:
    """A picture out of the fields of a ``sensor_msgs/CompressedImage``: JPEG, PNG, TIFF.

    Raises
    ------
    DataError
        The bytes are no picture, or only a part of one; ``form`` is named.
    """
    picture, fault = decode_picture(bytes(data))
    if picture is None:
        raise DataError(f"the compressed picture (format {form!r}) cannot be read: it is {fault}")
    return picture[..., :3] if picture.ndim == 3 else picture
