"""The examples do what they say, and the kept capture is what its README says."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_support import Cli, environment

import lasercal_gtsam as lc
from lasercal_gtsam.io.cell_file import load_cell

EXAMPLES = Path(__file__).parents[2] / "examples"
NUMBER = r"-?\d+(?:\.\d+)?"


def run(script, out):
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / script), str(out)],
        capture_output=True,
        text=True,
        env=environment(),
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


@pytest.fixture(scope="module")
def calibrated(out):
    return run("1_calibrate.py", out)


def test_every_script_is_listed_and_tested():
    scripts = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert scripts == [
        "0_simulate.py",
        "1_calibrate.py",
        "2_use_result.py",
        "3_own_graph.py",
        "4_keep_calibrated.py",
        "5_plan.py",
        "6_hand_over.py",
    ]
    readme = (EXAMPLES / "README.md").read_text()
    assert all(f"`{script}`" in readme for script in scripts)


def test_0_simulate_shows_that_orientations_help(out):
    text = run("0_simulate.py", out)
    rows = [[float(x) for x in re.findall(NUMBER, line)] for line in text.splitlines()[1:-1]]
    assert [row[0] for row in rows] == [2, 3, 4, 6]
    assert [row[1] for row in rows] == [32, 48, 64, 96]
    sigma_fu, sigma_tz = [row[2] for row in rows], [row[5] for row in rows]
    assert sigma_fu[-1] < 0.5 * sigma_fu[0]
    assert sigma_tz[-1] < 0.5 * sigma_tz[0]
    assert len(lc.load_capture(out / "planned-capture").observations()) == 96


def test_1_calibrate_finds_the_truth(out, calibrated):
    result = lc.load_calibration(out / "calibration.json")
    truth = load_cell(EXAMPLES / "capture" / "truth.json")
    assert result.table() in calibrated
    true = truth.cameras["camera"]
    for name in ("fu", "fv", "u0", "v0", "k1", "k2", "p1", "p2"):
        row = result[name]
        assert abs(row.refined - getattr(true.intrinsics, name)) < 4 * row.sigma, name
    for name, value in zip(("Tx", "Ty", "Tz"), 1000 * true.T_base_camera[:3, 3], strict=True):
        assert abs(result[name].refined - value) < 4 * result[name].sigma
        assert result[name].sigma < 2.0
    assert result["alpha_c"].sigma == 0
    one, other = re.findall(NUMBER, calibrated.splitlines()[-1])
    assert float(one) == pytest.approx(float(other), abs=0.02)


def test_2_use_result_goes_round(out, calibrated):
    text = run("2_use_result.py", out)
    for line in (r"back by OpenCV: ", r"back by GTSAM: +", r"then it is seen at "):
        found = re.search(line + r"\[(.*)\]", text)
        np.testing.assert_allclose([float(x) for x in found[1].split(",")], (350, 200), atol=1e-5)
    x, y, z = (float(v) / 1000 for v in re.search(r"is at (.*) mm", text)[1].split(","))
    plane = load_cell(EXAMPLES / "capture" / "truth.json").planes["1"]
    assert plane.normal_base @ [x, y, z] == pytest.approx(plane.distance, abs=1e-3)


def test_3_own_graph_agrees_with_the_whole_calibration(out):
    text = run("3_own_graph.py", out)
    found, sigma = re.search(rf"distance ({NUMBER}) \+- ({NUMBER}) mm", text).groups()
    whole, angle = re.search(rf"at once: ({NUMBER}) mm, ({NUMBER}) deg", text).groups()
    tilt = re.search(rf"good to ({NUMBER}) deg", text)[1]
    assert 0.05 < float(sigma) < 3
    assert abs(float(found) - float(whole)) < 3 * float(sigma)
    assert float(angle) < 3 * float(tilt) < 3
    plane = load_cell(EXAMPLES / "capture" / "truth.json").planes["3"]
    assert abs(float(found) - 1000 * plane.distance) < 4 * float(sigma)


def test_4_keep_calibrated_names_the_bump_and_mends_it(out):
    text = run("4_keep_calibrated.py", out)
    events = re.findall(r"^spot (\d+) \(s\d+\): (\w+): ", text, re.MULTILINE)
    assert [kind for _, kind in events] == ["alarm", "reset", "recovered"]
    assert 180 < int(events[0][0]) <= 185
    moved = re.search(
        rf"moved by ({NUMBER}) \+- ({NUMBER}) mm and ({NUMBER}) \+- ({NUMBER}) deg;", text
    )
    shift, sigma_shift, turn, sigma_turn = map(float, moved.groups())
    assert abs(shift - 2.0) < 3 * sigma_shift
    assert abs(turn - 0.5) < 3 * sigma_turn
    last = text.splitlines()[-1].split()
    assert last[0] == "300" and "300 used" in text


def test_5_plan_beats_the_procedure_and_is_a_capture(out):
    text = run("5_plan.py", out)
    pairs = re.findall(rf"plane \d: ({NUMBER}) mm from 36 .*, ({NUMBER}) mm from 30", text)
    assert len(pairs) == 3
    assert all(float(ours) < 0.6 * float(papers) for ours, papers in pairs)
    assert (out / "plan" / "capture.yaml").exists()
    assert "36 of 36 spots were in view: converged" in text
    steps = re.findall(rf"would take ({NUMBER}) mm to ({NUMBER}) mm", text)
    assert len(steps) == 3
    assert all(float(after) < float(before) for before, after in steps)


def test_6_hand_over_writes_what_it_says(out):
    text = run("6_hand_over.py", out)
    for name in ("cell.urdf", "cell.launch.xml", "camera_pose.yaml", "camera.yml", "cell.json"):
        assert name in text
        assert (out / name).stat().st_size > 100
    assert float(re.search(r"error (\S+) at the estimate", text)[1]) < 1e-6
    assert (out / "report.html").read_text().startswith("<!DOCTYPE html>")


def test_the_start_from_drawings_leads_to_the_same_answer(capsys, tmp_path):
    lasercal = Cli(capsys)
    capture = EXAMPLES / "capture"
    from_data = lasercal.json("calibrate", capture, "-o", tmp_path)
    drawn = ("--initial", EXAMPLES / "drawings.json")
    from_drawings = lasercal.json("calibrate", capture, "-o", tmp_path, *drawn)
    for one, other in zip(from_data["parameters"], from_drawings["parameters"], strict=True):
        assert other["refined"] == pytest.approx(one["refined"], abs=0.01 * one["sigma"])
    rows = {row["name"]: row for row in from_drawings["parameters"]}
    assert rows["fu"]["initial"] == 500


def test_the_kept_capture_is_what_the_readme_says(capsys, tmp_path):
    capture = EXAMPLES / "capture"
    assert sum(path.stat().st_size for path in capture.rglob("*")) < 5e6
    text = (EXAMPLES / "README.md").read_text().replace("\\\n", " ")
    command = shlex.split(re.search(r"^ +(lasercal simulate .*)$", text, re.MULTILINE)[1])
    assert command[:3] == ["lasercal", "simulate", "examples/capture"]
    assert Cli(capsys)("simulate", tmp_path / "again", *command[3:]).status == 0
    kept, again = lc.load_capture(capture), lc.load_capture(tmp_path / "again")
    np.testing.assert_allclose(kept.T_base_hand, again.T_base_hand, atol=1e-9)
    assert kept.ids.tolist() == again.ids.tolist()
    assert kept.planes.tolist() == again.planes.tolist()
    assert kept.noise == again.noise
    true, other = (
        json.loads((folder / "truth.json").read_text()) for folder in (capture, tmp_path / "again")
    )
    spots = [np.array([spot["uv_px"] for spot in truth["spots"]]) for truth in (true, other)]
    np.testing.assert_allclose(*spots, atol=1e-6)
    names = [
        sorted(p.name for p in (c / "images").iterdir()) for c in (capture, tmp_path / "again")
    ]
    assert names[0] == names[1]
