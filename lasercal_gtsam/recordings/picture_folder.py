"""A folder of pictures named by their stamps, or in the order of a pose file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_bytes
from lasercal_gtsam.io.pictures import Picture, decode_picture
from lasercal_gtsam.io.wording import at_most, some
from lasercal_gtsam.recordings.stamps import LATEST, NS_PER_S, Stamps, as_stamps, ns_from_seconds

Naming = Literal["auto", "s", "ms", "us", "ns", "order"]
_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm", ".webp"}
)
_PER_S = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": NS_PER_S}
# Digits of a stamp since 1970 in whole seconds, milliseconds, ...: from 2001 to 2286 without doubt.
_DIGITS = {10: "s", 13: "ms", 16: "us", 19: "ns"}


def picture_files(folder: Path) -> list[Path]:
    """The pictures that lie in a folder, sorted by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES and p.is_file())


class PictureFolder:
    """Pictures in a folder as a `PictureSource`."""

    def __init__(self, folder: Path, camera: str, files: Sequence[Path], stamps: Stamps) -> None:
        self.camera = camera
        self.name = str(folder)
        self.stamps = as_stamps(stamps)
        self.files = tuple(files)

    def read(self, which: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Read some pictures; see `PictureSource`."""
        for k in which:
            picture, fault = decode_picture(read_bytes(self.files[k]))
            if picture is None:
                raise DataError(
                    f"{self.files[k]}: not a picture that can be read (the file is {fault}); "
                    "expected PNG, TIFF, BMP, PGM or JPEG"
                )
            yield k, picture


def open_folder(
    folder: str | Path,
    camera: str = "camera",
    naming: Naming = "auto",
    *,
    pose_stamps: Stamps | None = None,
    offset: int = 0,
) -> PictureFolder:
    """Find the pictures of a folder and their stamps.

    Parameters
    ----------
    folder : pictures in it, not below it
    camera : name of the camera in the capture
    naming : unit of the stamps in the file names. ``auto``: names with a point are in seconds,
        whole numbers of 10, 13, 16 or 19 digits are s, ms, us or ns since 1970; any other length
        must be said. ``order``: as many pictures as poses, which belong together in their order
    pose_stamps : needed by ``order``
    offset : added to the stamps, nanoseconds

    Raises
    ------
    DataError
        No pictures, names that are no stamps, two with one stamp, or another number than poses.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder")
    files = picture_files(folder)
    if not files:
        raise DataError(f"{folder}: there are no pictures in this folder (PNG, TIFF, JPEG, ...)")
    if naming == "order":
        return PictureFolder(folder, camera, *_in_order(folder, files, pose_stamps))
    stamps, problems = [], []
    for file in files:
        stamp = _stamp_of(file.stem, naming)
        if isinstance(stamp, str):
            problems.append(f"{file}: {stamp}")
        else:
            stamps.append(stamp + offset)
    if problems:
        raise DataError(*at_most(problems, 5))
    order = np.argsort(np.array(stamps, dtype=np.int64), kind="stable")
    for a, b in pairwise(order):
        if stamps[a] == stamps[b]:
            raise DataError(f"{folder}: {files[a].name} and {files[b].name} have the same stamp")
    ordered = np.array(stamps, dtype=np.int64)[order]
    return PictureFolder(folder, camera, [files[k] for k in order], ordered)


def _stamp_of(stem: str, naming: Naming) -> int | str:
    """Nanoseconds that a file name means, or why it means none."""
    if not re.fullmatch(r"[0-9]+(\.[0-9]+)?", stem):
        return (
            "its name is not a stamp; for pictures named by pose id write a capture.yaml with "
            "images: {id}, or give --names order"
        )
    whole = stem.partition(".")[0]
    unit = naming
    if naming == "auto":
        if "." in stem:
            unit = "s"
        elif len(whole) in _DIGITS:
            unit = _DIGITS[len(whole)]  # type: ignore[assignment]
        else:
            return f"{len(whole)} digits fit no stamp since 1970; say the unit (--names s|ms|us|ns)"
    if "." in stem:
        scaled = ns_from_seconds(stem)
        stamp = None if scaled is None else scaled // _PER_S[unit]
    else:
        stamp = int(whole) * (NS_PER_S // _PER_S[unit])
    if stamp is None or stamp > LATEST:
        return "its name is no time that a clock shows"
    return stamp


def _in_order(
    folder: Path, files: list[Path], pose_stamps: Stamps | None
) -> tuple[list[Path], Stamps]:
    count = 0 if pose_stamps is None else len(pose_stamps)
    if pose_stamps is None or count != len(files):
        raise DataError(
            f"{folder}: {len(files)} pictures, but {count} poses; in order every pose has one "
            f"picture ({some([file.name for file in files], 3)})"
        )
    numbers = [[int(n) for n in re.findall(r"\d+", file.stem)] for file in files]
    if numbers != sorted(numbers):
        k = next(k for k in range(1, len(files)) if numbers[k] < numbers[k - 1])
        raise DataError(
            f"{folder}: it is not clear whether {files[k - 1].name} or {files[k].name} comes "
            "first; number the pictures with leading zeros"
        )
    return files, pose_stamps
