"""The README is a promise: its example runs, its capture file is accepted, its commands exist."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import lasercal_gtsam as lc
from lasercal_gtsam.io.conventions import columns_from_rotations, rotation_columns

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language: str, number: int = 0) -> str:
    found = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert len(found) > number, f"the README has lost its {language} block {number}"
    return found[number]


def run_example(number: int, folder: Path) -> str:
    (folder / "examples").mkdir()
    shutil.copytree(ROOT / "examples" / "capture", folder / "examples" / "capture")
    code = block("python", number)
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_python_example_runs_and_gives_what_it_says(tmp_path: Path) -> None:
    printed = run_example(0, tmp_path)
    assert "RMS" in printed
    assert "converged" in printed
    calibration = lc.load_calibration(tmp_path / "calibration.json")
    assert calibration.fit.converged
    assert calibration.fit.rms_px < 0.5


def test_incremental_example_takes_every_spot(tmp_path: Path) -> None:
    lines = run_example(1, tmp_path).splitlines()
    calibration = lc.load_calibration(tmp_path / "calibration.json")
    assert lines and lines[-1].startswith(f"{calibration.fit.n_spots} spots, ")
    assert calibration.fit.converged and calibration.fit.rms_px < 0.5


def test_capture_file_is_accepted(tmp_path: Path) -> None:
    text = block("yaml")
    fmt = re.search(r"rotation: (\S+)", text)
    assert fmt
    rotation = columns_from_rotations(fmt.group(1), np.eye(3)[None])[0]
    columns = ["id", "plane", "x", "y", "z", *rotation_columns(fmt.group(1))]
    row = ["s1", "table", "0", "0", "0", *(repr(float(x)) for x in rotation)]
    (tmp_path / "capture.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "poses.csv").write_text(
        ",".join(columns) + "\n" + ",".join(row) + "\n", encoding="utf-8"
    )
    (tmp_path / "images").mkdir()
    for name in ("s1.png", "s1_off.png"):
        cv2.imwrite(str(tmp_path / "images" / name), np.zeros((480, 640), dtype=np.uint8))
    capture = lc.load_capture(tmp_path)
    assert capture.image_size == {"camera": (640, 480)}
    assert capture.images_on[0] is not None


@pytest.mark.parametrize("words", ["lasercal demo", "pytest", "lasercal detect", "lasercal watch"])
def test_commands_are_named(words: str) -> None:
    assert words in README


def test_every_file_the_readme_points_to_exists() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).exists(), target
