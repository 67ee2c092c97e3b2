"""`lasercal update`: what is added, what is refused, what is written and what not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from cli_support import Cli, contents
from stream_cases import START, bumped, capture_of, differences, named, start, stream

import lasercal_gtsam as lc
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.io.history_file import history_path, read_history


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture
def calibration(tmp_path):
    start().save(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


def change(seen: lc.Observations, **fields) -> lc.Observations:
    return lc.Observations(**{n: getattr(seen, n) for n in seen.__dataclass_fields__} | fields)


def table_of(text: str) -> dict[str, list[str]]:
    rows = [line.split("|") for line in text.splitlines() if line.count("|") == 5]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def test_new_spots_are_added_and_old_ones_not_again(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "more", stream()[START - 10 : START + 30])
    outcome = lasercal("update", calibration, capture)
    assert (outcome.status, outcome.err) == (0, "")
    lines = outcome.out.splitlines()
    assert lines[0] == f"{capture / 'capture.yaml'}: 30 new spots, 10 in the calibration already"
    assert lines[1] in ("30 accepted, 0 rejected", "29 accepted, 1 rejected")
    assert lines[-1] == f"Saved {calibration}."
    result = lc.load_calibration(calibration)
    assert result.inputs.observations.id.tolist() == stream().id[: START + 30].tolist()
    # the same as all at once by the batch solution
    batch = lc.calibrate(
        result.inputs.observations, initial=result.cell, options=start().inputs.options
    )
    assert differences(batch, result) < 0.05
    # what is printed is what has changed
    table = table_of(outcome.out)
    for p, q in zip(start().parameters, result.parameters, strict=True):
        before, after, sigma, moved, unit = table[p.name]
        decimals = len(after.partition(".")[2])
        assert float(before) == pytest.approx(p.refined, abs=0.6 * 10.0**-decimals)
        assert float(after) == pytest.approx(q.refined, abs=0.6 * 10.0**-decimals)
        assert unit == q.unit
        if q.sigma > 0:
            assert float(sigma) == pytest.approx(q.sigma, rel=0.06)
            assert float(moved) == pytest.approx((q.refined - p.refined) / p.sigma, abs=0.006)
    rows = read_history(history_path(calibration))
    assert [rows[0].spots, rows[-1].spots] == [START, START + 30]
    # once more: nothing is new, nothing is written
    before = contents(tmp_path)
    outcome = lasercal("update", calibration, capture)
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.out == (
        f"{capture / 'capture.yaml'}: nothing new: all its 40 spots are in {calibration} already.\n"
    )
    assert contents(tmp_path) == before
    # the history goes on
    more = capture_of(tmp_path / "even-more", stream()[START + 30 : START + 40])
    assert lasercal("update", calibration, more, "-o", tmp_path / "new.json").status == 0
    assert contents(tmp_path)["calibration.json"] == before["calibration.json"]
    longer = read_history(tmp_path / "new.history.csv")
    assert [row.spots for row in longer][: len(rows)] == [row.spots for row in rows]
    assert longer[-1].spots == START + 40


def test_another_spot_under_the_same_id_is_an_error(lasercal, calibration, tmp_path):
    seen = named(stream()[START : START + 8], "s")  # ids that the calibration has
    capture = capture_of(tmp_path / "other", seen)
    before = contents(tmp_path)
    outcome = lasercal("update", calibration, capture)
    assert (outcome.status, outcome.out) == (1, "")
    assert outcome.err.count("\n") == 1
    assert "8 ids of it (s000, s001, s002, s003, s004 and 3 more) are in" in outcome.err
    assert "--prefix" in outcome.err
    assert contents(tmp_path) == before
    assert lasercal("update", calibration, capture, "--prefix", "b-").status == 0
    ids = lc.load_calibration(calibration).inputs.observations.id.tolist()
    assert ids[-8:] == [f"b-s{k:03d}" for k in range(8)]
    assert "nothing new" in lasercal("update", calibration, capture, "--prefix", "b-").out


@pytest.mark.parametrize("what", ["uv", "T_base_hand", "plane"])
def test_a_spot_is_the_same_only_if_all_of_it_is(lasercal, calibration, tmp_path, what):
    seen = stream()[:5]
    T = seen.T_base_hand.copy()
    T[2, 0, 3] += 1e-5
    changes = {
        "uv": seen.uv + np.where(np.arange(5)[:, None] == 2, 0.01, 0.0),
        "T_base_hand": T,
        "plane": np.where(np.arange(5) == 2, np.where(seen.plane == "1", "2", "1"), seen.plane),
    }
    capture = capture_of(tmp_path / "edited", change(seen, **{what: changes[what]}))
    outcome = lasercal("update", calibration, capture)
    assert outcome.status == 1
    assert "1 id of it (s002) is in" in outcome.err
    # written under another convention it is the same
    plain = capture_of(tmp_path / "plain", seen, rotation="kuka", transform="T_hand_base")
    assert "nothing new" in lasercal("update", calibration, plain).out


def test_a_bumped_camera_is_not_written_but_with_reset_it_is(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "after", named(bumped(stream()[START:]), "b")[:24])
    before = contents(tmp_path)
    outcome = lasercal("update", calibration, capture)
    assert outcome.status == 1
    assert contents(tmp_path) == before
    first, second = outcome.err.splitlines()
    assert "camera 'camera' moved by" in first
    assert first.endswith("nothing was written (see --force)")
    assert second == (
        f"Error: if the camera was moved: lasercal update {calibration} {capture} "
        "--reset camera:camera"
    )
    # what it says to type works
    outcome = lasercal("update", calibration, capture, "--reset", "camera:camera")
    assert (outcome.status, outcome.err) == (0, "")
    assert "reset: camera 'camera' freed" in outcome.out
    assert "recovered: camera 'camera' found again" in outcome.out
    result = lc.load_calibration(calibration)
    shift = result["Tx"].refined, start()["Tx"].refined
    moved = np.linalg.norm(
        result.cell.cameras["camera"].T_base_camera[:3, 3]
        - start().cell.cameras["camera"].T_base_camera[:3, 3]
    )
    assert moved == pytest.approx(0.010, abs=0.006), shift


def test_automatic_does_it_alone_and_json_says_so(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "after", named(bumped(stream()[START:]), "b")[:24])
    document = lasercal.json("update", calibration, capture, "--automatic")
    run = document["run"]
    assert [e["kind"] for e in run["events"]] == ["alarm", "reset", "recovered"]
    assert run["alarm"] is None
    assert run["saved"] == str(calibration)
    assert run["new"] == 24
    assert len(run["accepted"]) + len(run["rejected"]) == 24
    saved = json.loads(calibration.read_text())
    assert saved["parameters"] == document["parameters"]
    assert [p["refined"] for p in document["before"]] == [p.refined for p in start().parameters]


def test_force_writes_it_all_the_same(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "after", named(bumped(stream()[START:]), "b")[:12])
    outcome = lasercal("update", calibration, capture, "--force")
    assert outcome.status == 1
    assert "written all the same" in outcome.err
    assert "12 rejected" in outcome.out
    result = lc.load_calibration(calibration)
    assert not result.fit.converged
    assert len(result.spots) == START + 12


def test_a_reset_part_without_spots_is_not_written(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "few", stream()[START : START + 1])
    before = contents(tmp_path)
    outcome = lasercal("update", calibration, capture, "--reset", "camera")
    assert outcome.status == 1
    assert "nothing was written" in outcome.err
    assert "give all of them in one update" in outcome.err
    assert contents(tmp_path) == before
    outcome = lasercal("update", calibration, capture, "--reset", "plane")
    assert outcome.status == 1
    assert "--reset plane: say which; there are plane:1, plane:2" in outcome.err


def test_outliers_are_named(lasercal, calibration, tmp_path):
    seen = stream()[START : START + 12]
    uv = seen.uv.copy()
    uv[4] = [600.0, 20.0]
    capture = capture_of(tmp_path / "bad", change(seen, uv=uv))
    outcome = lasercal("update", calibration, capture)
    assert "11 accepted, 1 rejected" in outcome.out
    assert f"  {seen.id[4]}: " in outcome.out
    alone = IncrementalCalibrator(start())
    for k in range(12):
        alone.add(lc.load_capture(capture).observations()[k : k + 1])
    if alone.alarm is None:
        assert outcome.status == 0
        assert differences(lc.load_calibration(calibration), alone.calibration) < 1e-9


def test_a_capture_with_other_noise_and_holds(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "more", stream()[START : START + 5])
    head = capture / "capture.yaml"
    text = head.read_text().replace("pixel: 1.0", "pixel: 2.0, hand_translation_mm: 0.1")
    head.write_text(text.replace("skew: 0", "skew: 0, k1: 0.1"))
    outcome = lasercal("update", calibration, capture)
    assert outcome.status == 0
    assert outcome.err.splitlines() == [
        "Warning: capture.yaml: noise.hand_translation_mm is not what the calibration was made "
        "with, and does not count here",
        "Warning: capture.yaml: known.k1 is not what the calibration was made with, and does not "
        "count here",
    ]
    cov = lc.load_calibration(calibration).inputs.observations.cov_uv
    assert np.isnan(cov[:START]).all()
    np.testing.assert_array_equal(cov[START:], np.tile(4 * np.eye(2), (5, 1, 1)))
    assert "nothing new" in lasercal("update", calibration, capture).out


def test_wrong_files_are_one_line(lasercal, calibration, tmp_path):
    capture = capture_of(tmp_path / "more", stream()[:5])
    for args, words in (
        ((tmp_path / "none.json", capture), "there is no such file"),
        ((capture / "capture.yaml", capture), "there is a file that is not a lasercal calibration"),
        ((calibration, tmp_path / "none"), "there is no such file"),
        ((calibration, capture, "-o", tmp_path / "no" / "x.json"), "there is no folder"),
    ):
        outcome = lasercal("update", *args)
        assert (outcome.status, outcome.out) == (1, "")
        assert outcome.err.startswith("Error: ")
        assert outcome.err.count("\n") == 1
        assert words in outcome.err
