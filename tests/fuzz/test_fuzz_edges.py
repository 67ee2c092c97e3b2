"""Captures that can be read but make no sense: one clear error, no warning, nothing written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz_oracle import run, snapshot

HEAD = """\
lasercal: 1
camera: {{name: camera, width: {width}, height: {height}}}
poses: {{file: poses.csv, transform: T_base_hand, length: mm, rotation: kuka}}
{more}
"""


def capture(
    folder: Path, rows: list[str], size: tuple[int, int] = (640, 480), more: str = ""
) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "capture.yaml").write_text(HEAD.format(width=size[0], height=size[1], more=more))
    text = "\n".join(["id,plane,x,y,z,a,b,c,u,v", *rows, ""])
    (folder / "poses.csv").write_text(text)
    return folder


def rows(count: int = 24, **same: Any) -> list[str]:
    """Shots at random over two planes; ``same`` holds columns at one value."""
    rng = np.random.default_rng(1)
    lines = []
    for k in range(count):
        row = {"id": f"s{k}", "plane": str(k % 2)}
        row |= dict(zip("xyz", 500 + 100 * rng.normal(size=3), strict=True))
        row |= dict(zip("abc", 30 * rng.normal(size=3), strict=True))
        row |= {"u": rng.uniform(0, 639), "v": rng.uniform(0, 479), **same}
        lines.append(",".join(str(value) for value in row.values()))
    return lines


STILL = {"x": 500, "y": 0, "z": 300, "a": 0, "b": 0, "c": 180}
CASES = {
    "one pixel": (rows(u=320, v=240), {}),
    "one pose": (rows(**STILL), {}),
    "one pose and one pixel": (rows(u=1, v=1, **STILL), {}),
    "one spot": (rows(1), {}),
    "two spots": (rows(2), {}),
    "pixels without sense": (rows(12), {}),
    "far away": (rows(x=1e9, y=-1e9, z=1e9), {}),
    "no movement but one axis": (rows(y=0, z=300, a=0, b=0, c=180), {}),
    "a picture of one pixel": (rows(u=0, v=0), {"size": (1, 1)}),
    "noise of nothing": (rows(12, u=320), {"more": "noise: {pixel: 1.0e-9}"}),
    "noise of a mile": (rows(12, u=320), {"more": "noise: {pixel: 1.0e+6}"}),
    "known to be absurd": (rows(12), {"more": "known: {fu: 1.0e-9, fv: 1.0e+9}"}),
}


@pytest.mark.parametrize("case", CASES)
def test_what_makes_no_sense_is_said(tmp_path: Path, case: str) -> None:
    lines, other = CASES[case]
    folder = capture(tmp_path / "c", lines, **other)
    before = snapshot(tmp_path)
    outcome = run(["calibrate", str(folder), "--robust", "none", "--distortion", "none"])
    assert outcome.faults == [], outcome
    assert outcome.status == 1 and "Error: " in outcome.err
    assert snapshot(tmp_path) == before


def test_no_row_and_no_spot(tmp_path: Path) -> None:
    outcome = run(["calibrate", str(capture(tmp_path / "a", []))])
    assert outcome.status == 1 and "there are column names but no rows" in outcome.err
    outcome = run(["calibrate", str(capture(tmp_path / "b", rows(3, u="", v="")))])
    assert outcome.status == 1 and "none of the 3 rows gives a spot" in outcome.err


def test_an_empty_table_of_spots_is_said(tmp_path: Path) -> None:
    """It was taken for none at all."""
    folder = capture(tmp_path / "a", rows(3), more="spots: {file: spots.csv}")
    poses = folder / "poses.csv"
    poses.write_text("\n".join(x.rsplit(",", 2)[0] for x in poses.read_text().splitlines()) + "\n")
    (folder / "spots.csv").write_text("id,u,v\n")
    outcome = run(["calibrate", str(folder)])
    assert outcome.status == 1 and "spots.csv: there are column names but no rows" in outcome.err


def test_pixels_outside_the_picture_are_named(tmp_path: Path) -> None:
    outcome = run(["calibrate", str(capture(tmp_path / "a", rows(3, u=5000)))])
    assert outcome.status == 1
    assert "poses.csv:2: u: 5000 lies outside the picture" in outcome.err


@pytest.mark.parametrize("value", ["1e300", "-1e10", "1e-400000"])
def test_numbers_on_the_command_line(tmp_path: Path, value: str) -> None:
    folder = capture(tmp_path / "a", rows(3))
    outcome = run(["calibrate", str(folder), "--sigma-px", value])
    assert (outcome.status, outcome.faults) == (2, [])


def test_a_name_that_a_terminal_would_obey(tmp_path: Path) -> None:
    outcome = run(["calibrate", str(capture(tmp_path / "a", rows(3, plane="\x1b[31mred")))])
    assert outcome.status == 1 and "\x1b" not in outcome.err
    assert r"plane: '\x1b[31mred' holds U+001B" in outcome.err


def test_a_spot_that_cannot_be_leaves_no_nan_in_an_update(tmp_path: Path) -> None:
    """It was rejected when it came, and counted when the result was put together."""
    small = ("--preset", "paper-1", "--groups", "3", "--shots", "4")
    assert run(["simulate", str(tmp_path / "a"), *small]).status == 0
    fast = ("--initial", str(tmp_path / "a/truth.json"), "--robust", "none", "--distortion", "none")
    assert run(["calibrate", str(tmp_path / "a"), *fast], limit_s=100).status == 0
    path = tmp_path / "a/poses.csv"
    lines = path.read_text().splitlines()
    titles = lines[0].split(",")
    cells = lines[4].split(",")
    cells[0], at = "new", titles.index("qx")
    cells[at] = str(-float(cells[at]))  # the beam goes away from the plane
    path.write_text("\n".join([lines[0], ",".join(cells), ""]))
    outcome = run(
        ["update", str(tmp_path / "a/calibration.json"), str(tmp_path / "a")], limit_s=100
    )
    assert outcome.faults == [] and "nan" not in outcome.out, outcome
    assert "new: no spot can be there" in outcome.out


# --- results that contradict themselves -----------------------------------------------------------


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("result")
    small = ("--preset", "paper-1", "--groups", "3", "--shots", "4")
    assert run(["simulate", str(folder / "a"), *small]).status == 0
    fast = ("--initial", str(folder / "a/truth.json"), "--robust", "none", "--distortion", "none")
    assert run(["calibrate", str(folder / "a"), *fast], limit_s=100).status == 0
    return json.loads((folder / "a/calibration.json").read_text())


def _set(data: dict[str, Any], path: str, value: Any) -> None:
    *way, last = path.split("/")
    for key in way:
        data = data[int(key) if key.isdigit() and isinstance(data, list) else key]
    if value is None:
        del data[last]
    else:
        data[int(last) if isinstance(data, list) else last] = value


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (
            "initial/cameras/camera",
            None,
            "cameras, initial.cameras: 'camera' is in one of them only",
        ),
        (
            "covariance/labels/3",
            "camera.rot_x",
            "expected those of the cell's parts, got a label twice",
        ),
        ("covariance/labels/3", "x", "expected those of the cell's parts, got 'x'"),
        ("spots/1/weight", -1.0, "spots.1.weight: expected a weight from 0 to 1, got -1"),
        ("spots/2/id", "other", "expected the same ids in the same order"),
        ("parameters/0/sigma", -1.0, "parameters.0.sigma: expected a sigma, 0 or more, got -1"),
        ("fit/sigma0", 1e300, "fit.sigma0: expected a number up to 1e+12"),
        ("fit/rms_px", "inf", "fit.rms_px: expected a number up to 1e+12"),
        ("cameras/camera/intrinsics/fu", 1e-300, "focal lengths must be positive, got fu=0"),
        ("planes/1/normal_base/0", 1e300, "planes.1.normal_base: expected numbers up to 1e+12"),
        ("cameras/camera/image_size/0", 10**9, "cameras.camera.image_size"),
    ],
)
def test_a_spoilt_result_is_refused(
    tmp_path: Path, result: dict[str, Any], path: str, value: Any, words: str
) -> None:
    data = json.loads(json.dumps(result))
    _set(data, path, value)
    (tmp_path / "calibration.json").write_text(json.dumps(data))
    outcome = run(["judge", str(tmp_path / "calibration.json")])
    assert (outcome.status, outcome.faults) == (1, [])
    assert words in outcome.err, outcome.err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"a": "\\ud800"}', "JSON that cannot be taken"),
        ("[" * 100_000, "JSON that cannot be taken"),
        ("[" + "1" * 5000 + "]", "JSON that cannot be taken"),
    ],
)
def test_json_that_no_program_writes(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "calibration.json").write_text(content)
    outcome = run(["judge", str(tmp_path / "calibration.json")])
    assert (outcome.status, outcome.faults) == (1, [])
    assert words in outcome.err
