"""Pictures of every kind, good and spoilt, as the bytes of a file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from random import Random

import cv2
import numpy as np
from fuzz_mutate import spoil_bytes

WIDTH, HEIGHT = 64, 48


def spot(seed: int = 0, lit: bool = True, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A dim scene in colour with, if lit, a red spot; 8 bit."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    picture = 40.0 + 20.0 * np.stack([u / width, v / height, u / width], axis=2)
    if lit:
        centre = rng.uniform(0.3, 0.7, 2) * (width, height)
        bright = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / 8.0)
        picture[..., 2] += 160.0 * bright
        picture[..., :2] += 30.0 * bright[..., None]
    return np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8)


def encoded(extension: str, picture: np.ndarray, *settings: int) -> bytes:
    good, content = cv2.imencode(extension, picture, list(settings))
    assert good
    return content.tobytes()


def png(width: int, height: int, depth: int, colour: int, rows: bytes, *more: bytes) -> bytes:
    """A PNG with this header and these (filtered) rows, whatever they are."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = [
        chunk(b"IHDR", header),
        *more,
        chunk(b"IDAT", zlib.compress(rows)),
        chunk(b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def chunk(kind: bytes, content: bytes) -> bytes:
    return (
        struct.pack(">I", len(content))
        + kind
        + content
        + struct.pack(">I", zlib.crc32(kind + content))
    )


def tiff(picture: np.ndarray, photometric: int, big: bool = False, **other: int) -> bytes:
    """An uncompressed TIFF, little or big endian; ``other`` replaces tags by number (``t256``)."""
    order = ">" if big else "<"
    height, width = picture.shape[:2]
    samples = 1 if picture.ndim == 2 else picture.shape[2]
    bits = picture.dtype.itemsize * 8
    data = picture.astype(picture.dtype.newbyteorder(order)).tobytes()
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: photometric, 273: 8, 277: samples}
    tags |= {278: height, 279: len(data), 284: 1}
    tags |= {int(name[1:]): value for name, value in other.items()}
    if samples > 1:  # libtiff takes one value for all samples
        tags[258] = bits
    entries = b"".join(
        struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in sorted(tags.items())
    )
    directory = struct.pack(f"{order}H", len(tags)) + entries + bytes(4)
    start = (b"MM\0*" if big else b"II*\0") + struct.pack(f"{order}I", 8 + len(data))
    return start + data + directory


def cmyk_jpeg() -> bytes:
    """An 8 x 8 JPEG of four components, all of them in the middle (hand-made, with flat tables)."""
    quant = b"\xff\xdb" + struct.pack(">HB", 67, 0) + bytes([1] * 64)
    frame = b"\xff\xc0" + struct.pack(">HBHHB", 8 + 3 * 4, 8, HEIGHT, WIDTH, 4)
    frame += b"".join(bytes([c, 0x11, 0]) for c in (1, 2, 3, 4))
    # one code each: category 0 (no difference), end of block
    codes = bytes([1] + [0] * 15)
    huff = b"".join(
        b"\xff\xc4" + struct.pack(">HB", 20, kind) + codes + b"\0" for kind in (0x00, 0x10)
    )
    scan = (
        b"\xff\xda" + struct.pack(">HB", 6 + 2 * 4, 4) + bytes([1, 0, 2, 0, 3, 0, 4, 0, 0, 63, 0])
    )
    blocks = (HEIGHT // 8) * (WIDTH // 8) * 4 * 2  # bits, all zero
    return b"\xff\xd8" + quant + frame + huff + scan + bytes(blocks // 8) + b"\xff\xd9"


def lie(content: bytes, width: int, height: int) -> bytes:
    """A file whose header says another size than its pixels have."""
    data = bytearray(content)
    if content.startswith(b"\x89PNG"):
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    elif content.startswith(b"BM"):
        struct.pack_into("<ii", data, 18, width, height)
    elif content.startswith(b"\xff\xd8"):
        for marker in (b"\xff\xc0", b"\xff\xc2"):
            if (at := content.find(marker)) > 0:
                struct.pack_into(">HH", data, at + 5, height & 0xFFFF, width & 0xFFFF)
    elif content.startswith((b"P5", b"P6")):
        end = content.index(b"255")
        data[2:end] = f"\n{width} {height}\n".encode()
    return bytes(data)


def good(rng: Random) -> bytes:
    """A picture of the right size in one of the formats."""
    picture = spot(rng.randrange(100))
    match rng.randrange(13):
        case 0:
            return encoded(".jpg", picture)
        case 1:
            return encoded(".jpg", picture, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
        case 2:
            return encoded(".bmp", picture)
        case 3:
            return encoded(
                ".tif", picture, cv2.IMWRITE_TIFF_COMPRESSION, rng.choice((1, 5, 8, 32773))
            )
        case 4:
            return encoded(".tif", picture.astype(np.uint16) * 256)
        case 5:
            return encoded(".png", picture.astype(np.uint16) * 256)
        case 6:
            return encoded(".png", cv2.cvtColor(picture, cv2.COLOR_BGR2BGRA))
        case 7:
            return encoded(".png", cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        case 8:
            return encoded(".pgm", cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        case 9:
            return encoded(".ppm", picture)
        case 10:
            return tiff(picture, 2, big=rng.random() < 0.5)
        case 11:
            return tiff(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), 1)
        case _:
            return encoded(".png", picture)


def odd(rng: Random) -> bytes:
    """A whole file, but none that a camera of 64 x 48 pixels gives."""
    return rng.choice(ODD)()


def _flat(value: int, dtype: type = np.uint8) -> Callable[[], bytes]:
    return lambda: encoded(".png", np.full((HEIGHT, WIDTH), value, dtype))


def _gray_alpha() -> bytes:
    rows = b"".join(b"\0" + bytes([90, 255] * WIDTH) for _ in range(HEIGHT))
    return png(WIDTH, HEIGHT, 8, 4, rows)


def _palette() -> bytes:
    rows = b"".join(b"\0" + bytes(k % 4 for k in range(WIDTH)) for _ in range(HEIGHT))
    colours = chunk(b"PLTE", bytes([0, 0, 0, 255, 0, 0, 0, 255, 0, 9, 9, 9]))
    return png(WIDTH, HEIGHT, 8, 3, rows, colours)


def _bits(depth: int) -> Callable[[], bytes]:
    rows = (b"\0" + bytes([0xA5] * (WIDTH * depth // 8))) * HEIGHT
    return lambda: png(WIDTH, HEIGHT, depth, 0, rows)


ODD: Sequence[Callable[[], bytes]] = (
    lambda: b"",
    lambda: b"\0" * 100,
    lambda: b"not a picture",
    lambda: b"GIF89a" + bytes(20),
    _flat(0),
    _flat(255),
    _flat(65535, np.uint16),
    _flat(128),
    lambda: encoded(".png", np.full((1, 1), 9, np.uint8)),
    lambda: encoded(".jpg", np.full((1, 1, 3), 9, np.uint8)),
    lambda: encoded(".png", np.zeros((1, 1_000_00), np.uint8)),
    lambda: encoded(".png", spot(1, True, WIDTH + 1, HEIGHT)),
    lambda: encoded(".jpg", spot(1, True, HEIGHT, WIDTH)),
    lambda: encoded(".webp", spot(1)),
    lambda: encoded(".jp2", spot(1)),
    lambda: encoded(".hdr", spot(1).astype(np.float32)),
    lambda: encoded(".tif", spot(1).astype(np.float32)),
    lambda: encoded(".tif", np.full((HEIGHT, WIDTH), np.nan, np.float32)),
    lambda: encoded(".tif", np.full((HEIGHT, WIDTH), np.inf, np.float64)),
    lambda: tiff(np.full((HEIGHT, WIDTH, 4), 50, np.uint8), 5, t332=1),
    lambda: tiff(np.full((HEIGHT, WIDTH, 4), 50, np.uint8), 2),
    lambda: tiff(np.full((HEIGHT, WIDTH, 2), 50, np.uint8), 1),
    lambda: tiff(np.full((HEIGHT, WIDTH, 5), 50, np.uint8), 1),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint32), 1),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 0),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 1, t256=1 << 30, t257=1 << 30),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 1, t273=0xFFFFFFF0),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 1, t279=0xFFFFFFF0),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 1, t258=64),
    lambda: tiff(np.full((HEIGHT, WIDTH), 50, np.uint8), 1, t278=1),
    cmyk_jpeg,
    _gray_alpha,
    _palette,
    _bits(1),
    _bits(2),
    _bits(4),
    lambda: png(0, 0, 8, 0, b""),
    lambda: png(WIDTH, HEIGHT, 8, 0, b"\0"),
    lambda: png(1 << 30, 1 << 30, 8, 0, b"\0" * 1000),
    lambda: png((1 << 32) - 1, 1, 16, 6, b"\0" * 1000),
    lambda: png(40_000, 40_000, 8, 2, b"\0" * 1_000_000),
    lambda: png(10_000, 10_000, 8, 0, b"\0" * 10_001 * 1000),
    lambda: lie(encoded(".bmp", spot()), 1 << 30, 1 << 30),
    lambda: lie(encoded(".bmp", spot()), WIDTH, -HEIGHT),
    lambda: lie(encoded(".bmp", spot()), -WIDTH, HEIGHT),
    lambda: lie(encoded(".jpg", spot()), 65500, 65500),
    lambda: lie(encoded(".jpg", spot()), WIDTH * 2, HEIGHT),
    lambda: lie(encoded(".ppm", spot()), 1 << 31, 1 << 31),
    lambda: b"P5\n64 48\n65535\n" + bytes(64 * 48 * 2),
    lambda: b"P5\n64 48\n9999999999\n" + bytes(64 * 48 * 2),
    lambda: b"P2\n64 48\n255\n" + b"7 " * (64 * 48),
    lambda: b"P2\n64 48\n255\n" + b"999999999999999999 " * (64 * 48),
    lambda: b"P4\n64 48\n" + bytes(64 * 48 // 8),
    lambda: b"P7\nWIDTH 64\nHEIGHT 48\nDEPTH 1\nMAXVAL 255\nENDHDR\n" + bytes(3072),
    lambda: b"Pf\n64 48\n-1.0\n" + bytes(64 * 48 * 4),
)  # fmt: skip


def spoilt(rng: Random) -> bytes:
    """A picture file, most of them damaged."""
    kind = rng.random()
    if kind < 0.15:
        return odd(rng)
    content = good(rng)
    if kind < 0.25:
        return content
    if kind < 0.4:
        return content[: rng.randrange(len(content))]
    if kind < 0.45:
        sides = (0, 1, 7, 8, WIDTH, 100, 5000, 100_000, 1 << 20, (1 << 31) - 1)
        return lie(content, rng.choice(sides), rng.choice(sides))
    if kind < 0.5:
        return content + rng.choice((b"\0", b"x" * 100, content))
    if kind < 0.65:  # the beginning, where the headers are
        head = spoil_bytes(rng, content[:120])
        return head + content[120:]
    return spoil_bytes(rng, content)
