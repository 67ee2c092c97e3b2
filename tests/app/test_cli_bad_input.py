"""Bad input through the real command line: one clear message, status 1, nothing half written."""

from __future__ import annotations

import re
import shutil

import pytest
from cli_support import contents, in_fresh_process

from lasercal_gtsam.cli.main import main


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A capture with spots (quaternions), one with matrices, one with pictures."""
    folder = tmp_path_factory.mktemp("good")
    small = ("--preset", "paper-1", "--groups", "1", "--shots", "4")
    for name, extra in (
        ("spots", ()),
        ("matrix", ("--rotation", "matrix")),
        ("pictures", ("--pictures",)),
    ):
        assert main(["simulate", str(folder / name), *small, *extra]) == 0
    return folder


def edit(name, change):
    """A change of one file's lines."""

    def apply(folder):
        path = folder / name
        lines = path.read_text().splitlines()
        change(lines)
        path.write_text("\n".join(lines) + "\n" if lines else "")

    return apply


def cell(line, column, text):
    """Put ``text`` into a cell of poses.csv, line and column from 0."""

    def change(lines):
        cells = lines[line].split(",")
        cells[column] = text(cells[column]) if callable(text) else text
        lines[line] = ",".join(cells)

    return edit("poses.csv", change)


def line_of_head(pattern, text):
    """Replace in capture.yaml; the pattern must be there."""

    def apply(folder):
        path = folder / "capture.yaml"
        changed, count = re.subn(pattern, text, path.read_text(), flags=re.MULTILINE)
        assert count == 1
        path.write_text(changed)

    return apply


def doubled(folder):
    """Quaternions of norm 2 in the third row."""
    for column in (5, 6, 7, 8):
        cell(3, column, lambda number: repr(2 * float(number)))(folder)


def mirrored(folder):
    """A matrix of determinant -1 in the second row."""
    for column in (5, 6, 7):
        cell(2, column, lambda number: repr(-float(number)))(folder)


def damaged(folder):
    path = folder / "images" / "s002.png"
    path.write_bytes(path.read_bytes()[:5000])


def unknown_plane(folder):
    """A letter l for the number 1, in a capture that says which planes there are."""
    line_of_head("^noise", "planes: [1]\nnoise")(folder)
    cell(2, 1, "l")(folder)


def two_at_once(folder):
    cell(1, 2, "here")(folder)
    cell(4, 3, "nan")(folder)


CASES = {
    "empty table": ("spots", edit("poses.csv", list.clear), ["poses.csv", "empty"]),
    "empty head": ("spots", edit("capture.yaml", list.clear), ["capture.yaml", "empty"]),
    "wrong columns": (
        "spots",
        cell(0, 6, "quat_x"),
        ["poses.csv", "qx", "quat_wxyz", "quat_x"],
    ),
    "non-numeric": ("spots", cell(2, 2, "abc"), ["poses.csv:3", "x: ", "'abc'", "number"]),
    "NaN": ("spots", cell(2, 4, "NaN"), ["poses.csv:3", "z: ", "NaN", "finite"]),
    "quaternion of norm 2": ("spots", doubled, ["poses.csv:4", "qw, qx, qy, qz", "2"]),
    "no rotation": ("matrix", mirrored, ["poses.csv:3", "r11", "rotation"]),
    "missing picture": (
        "pictures",
        lambda folder: (folder / "images" / "s003.png").unlink(),
        ["s003.png", "missing"],
    ),
    "unreadable picture": ("pictures", damaged, ["s002.png", "cannot be read|can be read"]),
    "duplicate id": ("spots", cell(3, 0, "s001"), ["poses.csv:4", "duplicate", "'s001'", "line 2"]),
    "unknown plane": (
        "spots",
        unknown_plane,
        ["poses.csv:3", "plane: unknown plane 'l'", "capture.yaml has 1"],
    ),
    "unit left out": (
        "spots",
        line_of_head("  length: mm\n", ""),
        ["capture.yaml:3", "length", "mm or m"],
    ),
    "unknown rotation": (
        "spots",
        line_of_head("quat_wxyz", "quat_wxzy"),
        ["capture.yaml:7", "rotation", "quat_wxzy", "did you mean"],
    ),
    "all problems at once": ("spots", two_at_once, ["poses.csv:2: x", "poses.csv:5: y"]),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_refused_in_one_clear_message(case, captures, tmp_path):
    which, spoil, words = CASES[case]
    shutil.copytree(captures / which, tmp_path / "capture")
    spoil(tmp_path / "capture")
    before = contents(tmp_path)
    outcome = in_fresh_process("calibrate", "capture", cwd=tmp_path)
    assert outcome.status == 1
    assert outcome.out == ""
    lines = outcome.err.splitlines()
    assert len(lines) == (2 if case == "all problems at once" else 1), outcome.err
    assert all(line.startswith("Error: ") for line in lines)
    for word in words:
        assert re.search(word, outcome.err), f"{word!r} is not in {outcome.err!r}"
    assert contents(tmp_path) == before


@pytest.mark.parametrize("case", ["missing picture", "unreadable picture", "empty table"])
def test_detect_refuses_it_too(case, captures, tmp_path):
    _, spoil, words = CASES[case]
    shutil.copytree(captures / "pictures", tmp_path / "capture")
    spoil(tmp_path / "capture")
    before = contents(tmp_path)
    outcome = in_fresh_process("detect", "capture", cwd=tmp_path)
    assert (outcome.status, outcome.out) == (1, "")
    assert re.search(words[0], outcome.err)
    assert "Traceback" not in outcome.err
    assert contents(tmp_path) == before
