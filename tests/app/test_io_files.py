"""Whole files: written whole or not at all, read with clear errors."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.files import read_text, replacing, sha256_of, write_bytes, write_text


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_write_and_read(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "Größe\n")
    assert read_text(path) == "Größe\n"
    assert path.read_bytes() == "Größe\n".encode()
    write_text(path, "again")
    assert read_text(str(path)) == "again"
    assert names(tmp_path) == ["a.txt"]


def test_an_error_while_writing_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(ZeroDivisionError), replacing(path) as temporary:
        assert temporary.parent == tmp_path
        temporary.write_text("half")
        assert path.read_text() == "old"
        _ = 1 / 0
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_a_full_disk_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(DataError, match=r"a\.txt: cannot be written: No space"), replacing(path):
        raise OSError(28, "No space left on device")
    assert names(tmp_path) == []


def test_modes(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    old = os.umask(0o027)
    try:
        write_text(path, "new")
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o640
    path.chmod(0o604)
    write_text(path, "newer")
    assert path.stat().st_mode & 0o777 == 0o604


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    write_text(tmp_path / "real" / "a.txt", "old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real" / "a.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for path, words in (
        (tmp_path / "none" / "a.txt", "there is no such file or folder"),
        (tmp_path / "file" / "a.txt", "not a folder"),
        (tmp_path / "folder", "this is a folder, expected a file"),
    ):
        with pytest.raises(DataError, match=f"cannot be written: .*{words}"):
            write_text(path, "x")
    assert names(tmp_path) == ["file", "folder"]


def test_what_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no such file"):
        read_text(tmp_path / "none.txt")
    with pytest.raises(DataError, match="this is a folder, expected a file"):
        read_text(tmp_path)
    write_bytes(tmp_path / "latin.txt", "a\nGröße".encode("latin-1"))
    with pytest.raises(DataError, match=r"latin\.txt:2: byte 0xf6 is not UTF-8"):
        read_text(tmp_path / "latin.txt")


def test_sha256(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a", b"abc")
    # FIPS 180-2, appendix B.1
    assert sha256_of(tmp_path / "a") == (
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
    assert sha256_of(tmp_path / "a") == hashlib.sha256(b"abc").hexdigest()
