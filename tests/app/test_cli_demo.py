"""`lasercal demo`: the README's command, whole."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cli_support import Cli, contents, in_fresh_process

import lasercal_gtsam as lc
import lasercal_gtsam.simulate
from lasercal_gtsam.cli.demo import compare
from lasercal_gtsam.simulate import load_truth


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    return folder, in_fresh_process("demo", cwd=folder)


def test_it_saves_everything_and_says_where(demo):
    folder, outcome = demo
    assert outcome.status == 0, outcome.err
    assert outcome.err == ""
    saved = set(contents(folder / "lasercal-demo"))
    expected = {"capture.yaml", "poses.csv", "truth.json", "spots.csv", "contact-sheet.png"}
    assert expected | {"calibration.json"} <= saved
    for name in expected:
        assert name in outcome.out
    assert max(map(len, outcome.out.partition("Everything is in")[2].splitlines()[:8])) <= 80


def test_the_table_beside_the_truth_is_right(demo):
    folder, outcome = demo
    truth = json.loads((folder / "lasercal-demo" / "truth.json").read_text())
    result = lc.load_calibration(folder / "lasercal-demo" / "calibration.json")
    rows = {
        cells[0].strip(): [cell.strip() for cell in cells[1:]]
        for line in outcome.out.splitlines()
        if line.count("|") == 6 and (cells := line.split("|"))
    }
    assert rows[""] == ["Initial", "Refined", "sigma", "Truth", "Error/sigma", "Unit"]
    intrinsics = truth["cameras"]["camera"]["intrinsics"]
    assert intrinsics["k1"] != 0  # a lens that is worth calibrating
    plane = truth["planes"]["1"]
    true = {name: intrinsics[name] for name in ("fu", "fv", "u0", "v0", "k1", "k2", "p1", "p2")}
    true["a_1_x"] = 1000 * plane["normal_base"][0] * plane["distance_m"]
    position = truth["cameras"]["camera"]["T_base_camera"]["translation_m"]
    true["Ty"] = 1000 * position[1]
    for name, value in true.items():
        row = result[name]
        assert float(rows[name][3]) == pytest.approx(value, abs=0.5 * row.sigma)
        error = (row.refined - value) / row.sigma
        assert float(rows[name][4]) == pytest.approx(error, abs=0.051)
        assert abs(error) < 4
    assert set(rows) - {"", "RMS"} == {p.name for p in result.parameters}


def test_it_summarises_honestly(demo):
    folder, outcome = demo
    text = " ".join(outcome.out.split())
    found = re.search(r"Of (\d+) estimated values (\d+) lie within 1 sigma", text)
    result = lc.load_calibration(folder / "lasercal-demo" / "calibration.json")
    errors = [row.sigmas for row in compare(result, load_truth(folder / "lasercal-demo"))]
    assert int(found[1]) == len(errors) == 28
    assert int(found[2]) == int((np.abs(errors) <= 1).sum())
    farthest = re.search(r"the farthest is (\S+), ([\d.]+) sigma away", text)
    assert float(farthest[2]) == pytest.approx(np.abs(errors).max(), abs=0.051)


@pytest.fixture
def small(monkeypatch):
    """Fewer pictures, where it does not matter how many."""
    fewer = partial(lasercal_gtsam.simulate.simulate, groups=2, shots=4)
    monkeypatch.setattr(lasercal_gtsam.simulate, "simulate", fewer)


def test_calibrate_on_its_folder_gives_the_same(small, capsys, tmp_path):
    lasercal = Cli(capsys)
    first = lasercal.json("demo", "--out", tmp_path / "demo")["parameters"]
    again = lasercal.json("calibrate", tmp_path / "demo")["parameters"]
    for one, other in zip(first, again, strict=True):
        assert other["refined"] == pytest.approx(one["refined"], abs=1e-6 * one["sigma"])


def test_an_earlier_demo_is_replaced(small, capsys, tmp_path):
    lasercal = Cli(capsys)
    for seed in (0, 3):
        assert lasercal.json("demo", "--out", tmp_path, "--seed", seed)["seed"] == seed
        assert json.loads((tmp_path / "truth.json").read_text())["seed"] == seed


def test_other_files_are_not_mixed_with_a_demo(small, capsys, tmp_path):
    lasercal = Cli(capsys)
    (tmp_path / "pictures.txt").write_text("mine")
    outcome = lasercal("demo", "--out", tmp_path)
    assert outcome.status == 1
    assert "--force" in outcome.err
    assert contents(tmp_path) == {"pictures.txt": b"mine"}


def test_angles_are_compared_on_the_circle(demo):
    folder, _ = demo
    result = lc.load_calibration(folder / "lasercal-demo" / "calibration.json")
    truth = load_truth(folder / "lasercal-demo")

    def sigmas_of_psi(turn):
        parameters = tuple(
            replace(p, refined=p.refined + turn) if p.name == "psi" else p
            for p in result.parameters
        )
        rows = compare(replace(result, parameters=parameters), truth)
        return next(row.sigmas for row in rows if row.parameter.name == "psi")

    assert sigmas_of_psi(360.0) == pytest.approx(sigmas_of_psi(0.0), rel=1e-6)
    assert sigmas_of_psi(result["psi"].sigma) == pytest.approx(sigmas_of_psi(0.0) + 1.0)
