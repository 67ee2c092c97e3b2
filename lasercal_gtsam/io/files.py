"""Reading and writing whole files: clear errors, and nothing half written."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lasercal_gtsam.errors import DataError

# JSON can name one half of a surrogate pair alone, which no file can hold
_HALF = re.compile(r"\\u[dD][89a-fA-F]")


def read_text(path: str | Path) -> str:
    """Text of a UTF-8 file; a byte-order mark at its start is dropped.

    Raises
    ------
    DataError
        The file is missing, is a folder, may not be read or is not UTF-8.
    """
    path = Path(path)
    content = read_bytes(path)
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError(f"{path}: the text is in UTF-16; save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise DataError(
            f"{path}:{line}: byte {content[error.start]:#04x} is not UTF-8 text; save the file as "
            "UTF-8"
        ) from None


def read_json(path: Path) -> Any:
    """Content of a JSON file; DataError with line and column where it is none."""
    text = read_text(path)
    if not text.strip():
        raise DataError(f"{path}: the file is empty")
    try:
        return checked_text(json.loads(text), text)
    except json.JSONDecodeError as error:
        raise DataError(f"{path}:{error.lineno}:{error.colno}: not JSON: {error.msg}") from None
    except (RecursionError, ValueError) as error:  # thousands of brackets, or of digits
        raise DataError(f"{path}: JSON that cannot be taken: {error}") from None


def checked_text(data: Any, text: str) -> Any:
    """What JSON text says; ValueError where an escape in it stands for half a character."""
    if _HALF.search(text):
        json.dumps(data, ensure_ascii=False).encode()
    return data


def read_bytes(path: str | Path) -> bytes:
    """Content of a file.

    Raises
    ------
    DataError
        The file is missing, is a folder, may not be read, or is none that has an end (a pipe that
        nobody writes to would be waited for for ever).
    """
    path = Path(path)
    try:
        check_regular(path)
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {reason_of(error)}") from None


def check_regular(path: Path) -> None:
    """Raise `OSError` where a path is no regular file; links are followed."""
    try:
        mode = path.stat().st_mode
    except ValueError:  # Python's own refusal of a name
        raise OSError(errno.EINVAL, "a file's name cannot hold a NUL character") from None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "this is a pipe or a device, expected a file")


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    return hashlib.sha256(read_bytes(path)).hexdigest()


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 file atomically: the old one stays until the new one is whole on the disk.

    Raises
    ------
    DataError
        The folder is missing or may not be written to, or the disk is full.
    """
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file atomically; see `write_text`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path in the same folder; on leaving without an error it becomes ``path``.

    The temporary file is flushed to the disk before it is renamed, and removed on any error. A
    link is followed, and the mode of an existing file is kept.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        target = _resolved(path)
        temporary = _new_file_beside(target)
        yield temporary
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o7777)
        _flush(temporary)
        temporary.replace(target)
        temporary = None
        _flush(target.parent)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {reason_of(error)}") from None
    finally:
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink()


def _resolved(path: Path) -> Path:
    """Where a file is put: what is there already is a regular file."""
    with suppress(FileNotFoundError):
        check_regular(path)
    return path.resolve()


@contextmanager
def whole_folder(folder: str | Path, last: str) -> Iterator[Path]:
    """Give an empty folder whose content, on leaving without an error, appears in ``folder``.

    Parameters
    ----------
    folder : a new or empty folder; made if it is not there
    last : name of the file that appears last, and so tells that all is there

    Raises
    ------
    DataError
        ``folder`` is not empty or cannot be written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise DataError(f"{folder}: the folder is not empty; give a new one")
        with TemporaryDirectory(prefix=".writing-", dir=folder) as staging:
            yield Path(staging)
            for path in sorted(Path(staging).iterdir(), key=lambda path: path.name == last):
                path.rename(folder / path.name)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None


def _new_file_beside(target: Path) -> Path:
    """An empty file with the mode that any new file gets (`tempfile` makes private ones)."""
    path = target.with_name(f".{target.stem}.{secrets.token_hex(8)}{target.suffix}")
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    return path


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def reason_of(error: OSError) -> str:
    """What is wrong with a file, in words."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file or folder"
    if isinstance(error, IsADirectoryError):
        return "this is a folder, expected a file"
    if isinstance(error, NotADirectoryError):
        return "a part of the path is a file, not a folder"
    if isinstance(error, PermissionError):
        return "permission denied"
    return error.strerror or type(error).__name__
