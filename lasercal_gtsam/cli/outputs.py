"""Where results may be written: checked before any work, never over what is not ours."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import check_regular, reason_of


def check_writable(path: Path) -> None:
    """Raise `DataError` where a file cannot be put at ``path``; before the work, not after it."""
    folder = path.parent
    if not folder.is_dir():
        raise DataError(f"{path}: cannot be written: there is no folder {folder}; make it first")
    try:
        if path.exists():
            check_regular(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {reason_of(error)}") from None
    if not os.access(folder, os.W_OK):
        raise DataError(f"{path}: cannot be written: no permission to write in {folder}; use -o")


def check_calibration_target(path: Path) -> None:
    """Raise `DataError` where ``path`` cannot be written or holds something that is not ours."""
    from lasercal_gtsam.io.calibration_file import FORMAT

    check_target(path, FORMAT, "a lasercal calibration")


def check_target(path: Path, form: str, what: str) -> None:
    """Raise `DataError` where ``path`` cannot be written or holds anything but that ``format``."""
    check_writable(path)
    if path.exists() and not is_of(path, form):
        raise DataError(
            f"{path}: there is a file that is not {what}, and it is left as it is; "
            "give another name with -o, or remove it"
        )


def is_of(path: Path, form: str) -> bool:
    """Whether a file states to be of that ``format``, or is empty."""
    try:
        content = path.read_bytes()
        data = json.loads(content) if content else {"format": form}  # an empty file loses nothing
    except (OSError, ValueError):
        return False
    return isinstance(data, dict) and data.get("format") == form


@contextmanager
def capture_folder(out: Path, force: bool) -> Iterator[Path]:
    """Give an empty folder for a capture, which on leaving without an error has become ``out``.

    With ``force`` the capture takes the place of one that is there; other files stay.

    Raises
    ------
    DataError
        ``out`` is not empty and ``force`` is not given, or it cannot be written to.
    """
    from lasercal_gtsam.io.capture import CAPTURE_FILE

    try:
        if not out.is_dir() or not any(out.iterdir()):
            yield out
            return
        if not force:
            raise DataError(
                f"{out}: the folder is not empty; give a new one, or --force to replace the "
                "capture in it"
            )
        with TemporaryDirectory(prefix=".writing-", dir=out) as staging:
            yield Path(staging)
            # half old, half new must not look like a capture
            (out / CAPTURE_FILE).unlink(missing_ok=True)
            files = [path for path in Path(staging).rglob("*") if path.is_file()]
            for path in sorted(files, key=lambda path: path.name == CAPTURE_FILE):
                target = out / path.relative_to(staging)
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
    except OSError as error:
        raise DataError(f"{out}: cannot be written: {error.strerror or error}") from None
