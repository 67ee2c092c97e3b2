"""Finding and reading the pictures of a capture."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.decoders import decoder_complaints, is_damage
from lasercal_gtsam.io.files import read_bytes
from lasercal_gtsam.io.picture_header import FORMATS, read_picture_header
from lasercal_gtsam.io.wording import at_most, did_you_mean

Picture = npt.NDArray[Any]
OptionalPaths = tuple[Path | None, ...]

PLACEHOLDERS = ("id", "plane", "camera", "laser")
# The largest sensors have 151 million; each million takes 0.1 s and 55 MB.
MAX_PIXELS = 160_000_000
_GLOB = re.compile(r"[*?\[]")


def read_picture(path: Path, size: tuple[int, int], where: str) -> Picture:
    """Read a picture as it was saved: gray or colour (BGR), 8 or 16 bit, never converted.

    Parameters
    ----------
    path : file
    size : (width, height) that the picture must have, pixels
    where : what the picture belongs to, for messages ("id 7")

    Returns
    -------
    (height, width) or (height, width, channels) array
        Pixel values in the type of the file.

    Raises
    ------
    DataError
        The picture is missing, unreadable or of another size.
    """
    if not path.is_file():
        raise DataError(f"{where}: the picture {path} is missing")
    content = read_bytes(path)
    header = read_picture_header(content)
    if header is not None and (header.width, header.height) != size:
        raise DataError(
            f"{where}: the picture {path} is {header.width} x {header.height} pixels, but its "
            f"camera has {size[0]} x {size[1]}"
        )
    picture, fault = decode_picture(content)
    if picture is None:
        raise DataError(
            f"{where}: {path} is not a picture that can be read (the file is {fault}); expected "
            f"{FORMATS}"
        )
    return picture


def decode_picture(content: bytes) -> tuple[Picture | None, str]:
    """The picture in a file's content as it was saved; or None and what is wrong with it.

    A damaged file is not taken, though a decoder may make a picture of it.
    """
    if not content:
        return None, "empty"
    header = read_picture_header(content)
    if header is None:
        return None, "damaged or unknown"
    if header.cmyk:
        return None, "in CMYK, the colours of a printer, where gray or RGB is needed"
    if header.width * header.height > MAX_PIXELS:
        return None, (
            f"of {header.width} x {header.height} pixels, more than {MAX_PIXELS / 1e6:.0f} million"
        )
    if _cut_off(content):
        return None, "cut off"
    with decoder_complaints() as complaints:
        picture = _decode(content)
    if picture is None:
        return None, "damaged or unknown"
    if picture.shape[:2] != (header.height, header.width):
        return None, "damaged: its pixels are not as many as its header says"
    damage = next(filter(is_damage, complaints), None)
    return (None, f"damaged: {damage}") if damage else (picture, "")


def write_png(path: Path, picture: Picture) -> None:
    """Write a picture as PNG, which keeps every pixel; colour is BGR."""
    import cv2

    encoded, content = cv2.imencode(".png", picture)
    if not encoded:
        raise DataError(f"{path}: the picture could not be encoded as PNG")
    path.write_bytes(content.tobytes())


def _decode(content: bytes) -> Picture | None:
    """The picture, or None; OpenCV's own complaints on the terminal are held back."""
    import cv2
    import numpy as np

    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # sizes that no memory holds
        return None
    finally:
        log.setLogLevel(level)


def _cut_off(content: bytes) -> bool:
    """Whether a PNG or JPEG lacks its end; the decoder would fill a cut JPEG with gray."""
    tail = content[-64:].rstrip(b"\0")
    if content.startswith(b"\x89PNG"):
        return b"IEND" not in content[-64:]
    return content.startswith(b"\xff\xd8\xff") and b"\xff\xd9" not in tail


def find_pictures(
    patterns: Mapping[str, str | None],
    folder: Path,
    columns: Mapping[str, Sequence[str]],
    needed: Sequence[bool],
    places: Mapping[str, str],
) -> tuple[OptionalPaths, OptionalPaths, list[str]]:
    """Pictures of each row with the laser on, and off.

    Parameters
    ----------
    patterns : ``on``, ``off`` and ``background`` as in ``capture.yaml``. A row's laser-off picture
        is its own (``off``), or where that does not exist the background
    folder : the capture's folder
    columns : placeholder name to the N words it stands for
    needed : whether a row's spot will be looked for in its picture; only then must it exist
    places : where each pattern stands in ``capture.yaml``, for messages

    Returns
    -------
    on, off : N paths, None where there is none
    warnings : sentences

    Raises
    ------
    DataError
        Patterns that do not fit (see `expand_pattern`), pictures that are missing, or one picture
        for two rows; all of them are named.
    """
    rows = [dict(zip(columns, words, strict=True)) for words in zip(*columns.values(), strict=True)]
    problems: list[str] = []
    found: dict[str, OptionalPaths] = {}
    for key, pattern in patterns.items():
        try:
            if pattern is None:
                found[key] = (None,) * len(rows)
            elif key == "background" and "{" not in pattern:
                found[key] = (folder / pattern,) * len(rows)
            else:
                found[key] = expand_pattern(pattern, folder, rows)
        except DataError as error:
            problems += [f"{places[key]}: {text}" for text in error.problems]
    if problems:
        raise DataError(*problems)
    on, off, warnings = found["on"], found["off"], []
    if patterns["background"] is not None:
        off, replaced = _or_background(off, found["background"], needed)
        if replaced and patterns["off"] is not None:
            warnings.append(
                f"{places['off']}: {replaced} rows have no laser-off picture of their own; the "
                "background is used for them"
            )
    ids = columns["id"]
    problems = _missing(ids, needed, on, "picture") + _shared(ids, needed, on)
    problems += _missing(ids, needed, off, "laser-off picture")
    if problems:
        raise DataError(*at_most(problems))
    return _existing(on), _existing(off), warnings


def _or_background(
    off: OptionalPaths, background: OptionalPaths, needed: Sequence[bool]
) -> tuple[OptionalPaths, int]:
    own = [path is not None and path.is_file() for path in off]
    chosen = tuple(a if has_own else b for a, b, has_own in zip(off, background, own, strict=True))
    return chosen, sum(wanted and not has for wanted, has in zip(needed, own, strict=True))


def _missing(
    ids: Sequence[str], needed: Sequence[bool], paths: OptionalPaths, kind: str
) -> list[str]:
    return [
        f"id {i}: the {kind} {path} is missing"
        for i, wanted, path in zip(ids, needed, paths, strict=True)
        if wanted and path is not None and not path.is_file()
    ]


def _shared(ids: Sequence[str], needed: Sequence[bool], paths: OptionalPaths) -> list[str]:
    first: dict[Path, str] = {}
    problems = []
    for i, wanted, path in zip(ids, needed, paths, strict=True):
        if wanted and path is not None:
            if path in first:
                problems.append(f"id {i}: the picture {path} is already that of id {first[path]}")
            first.setdefault(path, i)
    return problems


def _existing(paths: OptionalPaths) -> OptionalPaths:
    return tuple(path if path is not None and path.is_file() else None for path in paths)


def expand_pattern(
    pattern: str, folder: Path, rows: Sequence[Mapping[str, str]]
) -> tuple[Path, ...]:
    """One path for each row from a pattern such as ``images/{id}.png`` or ``images/*.png``.

    Parameters
    ----------
    pattern : relative to ``folder``; either with placeholders (`PLACEHOLDERS`), or a glob whose
        matches, sorted, belong to the rows in their order
    folder : the capture's folder
    rows : what the placeholders stand for in each row

    Raises
    ------
    DataError
        Unknown placeholder; a glob with more or fewer matches than rows, or whose matches cannot
        be put in one clear order; a single name for several rows. Whether the files exist is not
        looked at.
    """
    names = re.findall(r"\{([^{}]*)\}", pattern)
    unknown = [name for name in names if name not in PLACEHOLDERS]
    if unknown:
        raise DataError(
            f"unknown placeholder {{{unknown[0]}}}{did_you_mean(unknown[0], PLACEHOLDERS)}; "
            f"allowed are {', '.join('{' + name + '}' for name in PLACEHOLDERS)}"
        )
    if names:
        return tuple(folder / _fill(pattern, row) for row in rows)
    if _GLOB.search(pattern):
        return _glob(pattern, folder, len(rows))
    if len(rows) > 1:
        raise DataError(
            f"{pattern!r} names one picture for {len(rows)} rows; use a placeholder such as "
            "{id}, or a glob"
        )
    return tuple(folder / pattern for _ in rows)


def _fill(pattern: str, row: Mapping[str, str]) -> str:
    return re.sub(r"\{([^{}]*)\}", lambda match: row[match[1]], pattern)


def _glob(pattern: str, folder: Path, count: int) -> tuple[Path, ...]:
    try:
        found = sorted(folder.glob(pattern))
    except (NotImplementedError, ValueError) as error:
        raise DataError(f"{pattern!r} is not a usable glob: {error}") from None
    if len(found) != count:
        raise DataError(
            f"{pattern!r} matches {len(found)} pictures, but there are {count} rows; every row "
            "needs exactly one, or use a placeholder such as {id}"
        )
    natural = sorted(found, key=_natural_key)
    if natural != found:
        k = next(i for i, (a, b) in enumerate(zip(found, natural, strict=True)) if a != b)
        raise DataError(
            f"{pattern!r}: it is not clear whether {found[k].name} or {natural[k].name} comes "
            "first; number the pictures with leading zeros, or use a placeholder such as {id}"
        )
    return tuple(found)


def _natural_key(path: Path) -> list[tuple[int, str]]:
    """Numbers by value: img2 before img10."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts]
