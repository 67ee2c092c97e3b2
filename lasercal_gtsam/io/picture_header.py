"""What a picture file says of itself before its pixels are decoded: format, size, components.

A few bytes can claim any number of pixels, and a decoder takes the memory for all of them before it
finds out. So the header is read here first, and only pictures of the expected size are decoded.
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

FORMATS = "PNG, TIFF, BMP, PGM, PPM or JPEG"

_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_COLOURS = 256, 257, 262
_TIFF_CMYK, _JPEG_CMYK = 5, 4
# start-of-frame markers of JPEG; C4, C8 and CC among them are something else
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_PNM = re.compile(rb"P[1-6]((?:\s|#[^\n]*\n)+)(\d{1,10})((?:\s|#[^\n]*\n)+)(\d{1,10})\s")


class PictureHeader(NamedTuple):
    """Format and size, pixels; ``cmyk`` where the colours are those of a printer."""

    format: str
    width: int
    height: int
    cmyk: bool = False


def read_picture_header(content: bytes) -> PictureHeader | None:
    """The header of a picture file; None where it is none of `FORMATS`, or damaged."""
    try:
        if content.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png(content)
        if content.startswith(b"\xff\xd8\xff"):
            return _jpeg(content)
        if content.startswith(b"BM"):
            return _bmp(content)
        if content[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(content)
        if _PNM.match(content):
            return _pnm(content)
    except struct.error:  # the file ends inside its header
        return None
    return None


def _png(content: bytes) -> PictureHeader | None:
    """PNG 1.2, section 4.1.1: IHDR comes first."""
    if content[12:16] != b"IHDR":
        return None
    return PictureHeader("PNG", *struct.unpack_from(">II", content, 16))


def _bmp(content: bytes) -> PictureHeader | None:
    """A negative height says that the rows come from top to bottom."""
    (length,) = struct.unpack_from("<I", content, 14)
    if length == 12:  # of OS/2
        return PictureHeader("BMP", *struct.unpack_from("<HH", content, 18))
    width, height = struct.unpack_from("<ii", content, 18)
    return PictureHeader("BMP", width, abs(height))


def _pnm(content: bytes) -> PictureHeader | None:
    match = _PNM.match(content)
    return None if match is None else PictureHeader("PNM", int(match[2]), int(match[4]))


def _jpeg(content: bytes) -> PictureHeader | None:
    """Walk over the segments to the frame header (ITU T.81, annex B)."""
    at = 2
    while True:
        at = content.find(b"\xff", at)
        if at < 0:
            return None
        while content[at : at + 1] == b"\xff":  # fill bytes
            at += 1
        if at >= len(content):
            return None
        marker = content[at]
        at += 1
        if marker in _JPEG_FRAMES:
            _, _, height, width, components = struct.unpack_from(">HBHHB", content, at)
            return PictureHeader("JPEG", width, height, components == _JPEG_CMYK)
        if marker and marker not in _JPEG_ALONE:
            (length,) = struct.unpack_from(">H", content, at)
            at += length


def _tiff(content: bytes) -> PictureHeader | None:
    """Tags of the first directory (TIFF 6.0, section 2); they hold one whole number each."""
    order = "<" if content.startswith(b"II") else ">"
    (start,) = struct.unpack_from(f"{order}I", content, 4)
    (count,) = struct.unpack_from(f"{order}H", content, start)
    tags: dict[int, int] = {}
    for k in range(count):
        at = start + 2 + 12 * k
        tag, kind = struct.unpack_from(f"{order}HH", content, at)
        if kind in (3, 4):  # SHORT, LONG
            (tags[tag],) = struct.unpack_from(
                f"{order}{'H' if kind == 3 else 'I'}", content, at + 8
            )
    if not {_TIFF_WIDTH, _TIFF_HEIGHT} <= tags.keys():
        return None
    cmyk = tags.get(_TIFF_COLOURS) == _TIFF_CMYK
    return PictureHeader("TIFF", tags[_TIFF_WIDTH], tags[_TIFF_HEIGHT], cmyk)
