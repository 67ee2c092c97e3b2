"""Several captures in one call: each calibrated as if it were the only one."""

from __future__ import annotations

import json

import pytest
from cli_support import Cli

from lasercal_gtsam.simulate import Noise, simulate, write_simulation


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Three good captures and one with a pose column missing."""
    root = tmp_path_factory.mktemp("fleet")
    for seed in range(3):
        made = simulate("paper-2", seed, Noise(pixel_px=0.5))
        write_simulation(root / f"cell{seed}", made)
    (root / "bad").mkdir()
    for name in ("capture.yaml", "poses.csv"):
        text = (root / "cell0" / name).read_text()
        (root / "bad" / name).write_text(text.replace("qw", "angle"))
    return root


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_each_result_is_that_of_its_own_call(fleet, cli, jobs, tmp_path):
    paths = [fleet / f"cell{k}" for k in range(3)]
    done = cli("calibrate", *paths, "-j", jobs, "--distortion", "none")
    assert done.status == 0, done.err
    assert "3 of 3 calibrated" in done.out
    for path in paths:
        together = json.loads((path / "calibration.json").read_text())
        alone = tmp_path / f"{path.name}.json"
        assert cli("calibrate", path, "--distortion", "none", "-o", alone).status == 0
        for a, b in zip(
            json.loads(alone.read_text())["parameters"], together["parameters"], strict=True
        ):
            assert a["refined"] == pytest.approx(b["refined"], rel=1e-9, abs=1e-9)


def test_one_bad_capture_does_not_cost_the_others(fleet, cli):
    (fleet / "cell1" / "calibration.json").unlink(missing_ok=True)
    done = cli("calibrate", fleet / "bad", fleet / "cell1", "-j", "1")
    assert done.status == 1
    assert "1 of 2 calibrated" in done.out
    assert "Error:" in done.err
    assert str(fleet / "bad") in done.err
    assert (fleet / "cell1" / "calibration.json").exists()


def test_json_and_pages(fleet, cli):
    found = cli.json("calibrate", fleet / "cell0", fleet / "cell2", "-j", "1", "--report", "r.html")
    assert [one["status"] for one in found["captures"]] == [0, 0]
    assert found["captures"][0]["fit"]["n_spots"] == 60
    assert found["captures"][1]["saved"].endswith("cell2/calibration.json")
    assert (fleet / "cell0" / "r.html").exists()
    assert (fleet / "cell2" / "r.html").exists()


def test_what_cannot_be_said_of_several(fleet, cli, tmp_path):
    two = (fleet / "cell0", fleet / "cell1")
    assert cli("calibrate").status == 2
    assert cli("calibrate", *two, "-o", tmp_path / "c.json").status == 2
    assert cli("calibrate", *two, "--report", tmp_path / "r.html").status == 2
    assert cli("calibrate", two[0], "-j", "2").status == 2
    twice = cli("calibrate", two[0], two[0] / "capture.yaml")
    assert twice.status == 1
    assert "both would write the same calibration.json" in twice.err
