"""`lasercal calibrate`: what it prints, saves, refuses, and what each option does."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from cli_support import Cli, contents

import lasercal_gtsam as lc
import lasercal_gtsam.api
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.cli.main import main
from lasercal_gtsam.io.cell_file import load_cell


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """The paper's cell with two planes: without noise, and with 1 px."""
    folder = tmp_path_factory.mktemp("captures")
    one_pixel = ("--pixel-px", "1", "--hand-mm", "0", "--hand-deg", "0")
    for name, noise in (("exact", ("--noise", "0")), ("noisy", one_pixel)):
        assert main(["simulate", str(folder / name), "--preset", "paper-2", *noise]) == 0
    return folder


@pytest.fixture
def exact(captures, tmp_path):
    return shutil.copytree(captures / "exact", tmp_path / "exact")


@pytest.fixture
def noisy(captures, tmp_path):
    return shutil.copytree(captures / "noisy", tmp_path / "noisy")


def near(folder):
    """A start that is given: where the start does not matter it saves time."""
    return ("--initial", folder / "truth.json")


def table_of(text):
    """Rows of the printed table: name to its cells."""
    rows = [line.split("|") for line in text.splitlines() if line.count("|") == 4]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def rewrite(folder, change):
    """Apply ``change`` to the rows (dicts) of poses.csv."""
    path = folder / "poses.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def test_an_exact_capture_gives_the_truth(lasercal, exact):
    outcome = lasercal("calibrate", exact)
    assert outcome.status == 0
    assert outcome.err == ""
    truth = json.loads((exact / "truth.json").read_text())
    saved = json.loads((exact / "calibration.json").read_text())
    true, found = (d["cameras"]["camera"]["intrinsics"] for d in (truth, saved))
    for name, value in true.items():
        assert found[name] == pytest.approx(value, abs=1e-6), name
    for name, plane in truth["planes"].items():
        assert saved["planes"][name]["distance_m"] == pytest.approx(plane["distance_m"], rel=1e-8)
    assert "60 spots on 2 planes (1, 2)" in outcome.out
    assert outcome.out.rstrip().endswith(f"Saved {exact / 'calibration.json'}.")
    fu = table_of(outcome.out)["fu"]
    assert float(fu[1]) == pytest.approx(550.0)
    assert fu[3] == "px"


def test_what_is_printed_is_what_is_saved(lasercal, noisy):
    outcome = lasercal("calibrate", noisy / "capture.yaml", *near(noisy))
    result = lc.load_calibration(noisy / "calibration.json")
    assert result.table() in outcome.out
    assert list(table_of(outcome.out))[1:-1] == [p.name for p in result.parameters]
    assert "Converged (" in outcome.out
    # the capture states 1 px, so the residuals are compared with it
    assert f"{result.fit.sigma0:.3g} times what the stated noise explains" in outcome.out
    saved = json.loads((noisy / "calibration.json").read_text())
    assert set(saved["provenance"]["files"]) == {"capture.yaml", "poses.csv"}


def test_json_is_one_document_and_reads_back(lasercal, noisy):
    document = lasercal.json("calibrate", noisy, *near(noisy))
    saved = json.loads((noisy / "calibration.json").read_text())
    run = document.pop("run")
    for one in (document, saved):
        one["provenance"].pop("created")
    assert document == saved
    assert run["saved"] == str(noisy / "calibration.json")
    assert run["pictures"] == 0
    assert run["verdicts"] == {"used": 60}
    assert run["skipped"] == {}


def test_warnings_go_to_stderr_so_that_stdout_stays_a_document(lasercal, noisy):
    def repeat(rows):
        rows.append({**rows[0], "id": "again"})

    rewrite(noisy, repeat)
    outcome = lasercal("calibrate", noisy, *near(noisy), "--json")
    assert outcome.err.startswith("Warning: poses.csv: 1 rows repeat")
    assert json.loads(outcome.out)["run"]["warnings"] == [outcome.err[len("Warning: ") :].strip()]


def test_the_output_may_be_a_file_or_a_folder(lasercal, noisy, tmp_path):
    assert lasercal("calibrate", noisy, *near(noisy), "-o", tmp_path / "a.json").status == 0
    assert lasercal("calibrate", noisy, *near(noisy), "-o", tmp_path).status == 0
    assert lc.load_calibration(tmp_path / "a.json") == lc.load_calibration(
        tmp_path / "calibration.json"
    )
    assert not (noisy / "calibration.json").exists()


def test_a_calibration_is_replaced_but_nothing_else(lasercal, noisy):
    target = noisy / "calibration.json"
    lasercal("calibrate", noisy, *near(noisy), "--distortion", "none")
    first = target.read_bytes()
    assert lasercal("calibrate", noisy, *near(noisy)).status == 0
    assert target.read_bytes() != first
    for precious in (b'{"format": "something else"}', b"notes", b"[1, 2]"):
        target.write_bytes(precious)
        before = contents(noisy)
        outcome = lasercal("calibrate", noisy)
        assert outcome.status == 1
        assert outcome.out == ""
        assert "is not a lasercal calibration" in outcome.err
        assert "-o" in outcome.err
        assert contents(noisy) == before


def test_a_place_that_cannot_be_written_is_refused_before_the_work(lasercal, noisy, monkeypatch):
    monkeypatch.setattr(lasercal_gtsam.api, "calibrate", None)
    outcome = lasercal("calibrate", noisy, "-o", noisy / "not" / "there.json")
    assert outcome.status == 1
    assert "make it first" in outcome.err


def test_a_result_that_cannot_be_saved_is_printed_all_the_same(lasercal, noisy, monkeypatch):
    def full(*args, **kwargs):
        raise lc.DataError("calibration.json: cannot be written: No space left on device")

    monkeypatch.setattr("lasercal_gtsam.io.calibration_file.write_text", full)
    outcome = lasercal("calibrate", noisy, *near(noisy))
    assert outcome.status == 1
    assert "fu" in table_of(outcome.out)
    assert "Saved" not in outcome.out
    assert outcome.err == "Error: calibration.json: cannot be written: No space left on device\n"


@pytest.fixture
def unconverged(monkeypatch):
    solve = lasercal_gtsam.api.calibrate

    def doubtful(*args, **kwargs):
        result = solve(*args, **kwargs)
        fit = replace(result.fit, converged=False, status="not to be trusted: planted")
        return replace(result, fit=fit)

    monkeypatch.setattr(lasercal_gtsam.api, "calibrate", doubtful)


def test_an_answer_not_to_be_trusted_is_not_saved(lasercal, noisy, unconverged):
    outcome = lasercal("calibrate", noisy, *near(noisy))
    assert outcome.status == 1
    assert "fu" in table_of(outcome.out)
    assert outcome.err.startswith("Error: not to be trusted: planted; nothing was saved")
    assert "--keep-unconverged" in outcome.err
    assert not (noisy / "calibration.json").exists()


def test_an_answer_not_to_be_trusted_is_saved_on_request(lasercal, noisy, unconverged):
    outcome = lasercal("calibrate", noisy, *near(noisy), "--keep-unconverged", "--json")
    assert outcome.status == 1
    assert json.loads(outcome.out)["fit"]["converged"] is False
    assert lc.load_calibration(noisy / "calibration.json").fit.converged is False


def test_initial_may_be_a_cell_a_truth_or_a_calibration(lasercal, noisy, tmp_path):
    command = ("calibrate", noisy, "--distortion", "none")  # which has one minimum
    reference = lasercal.json(*command, "-o", tmp_path / "a.json")
    truth = json.loads((noisy / "truth.json").read_text())
    drawing = {key: truth[key] for key in ("cameras", "lasers", "planes")}
    drawing["cameras"]["camera"]["T_base_camera"].pop("matrix")
    drawing["cameras"]["camera"]["intrinsics"].update(fu=500.0, fv=500.0)
    (tmp_path / "cell.json").write_text(json.dumps(drawing))
    assert isinstance(load_cell(tmp_path / "cell.json"), Cell)
    for start in (tmp_path / "cell.json", noisy / "truth.json", tmp_path / "a.json"):
        again = lasercal.json(*command, "-o", tmp_path / "b.json", "--initial", start)
        for one, other in zip(reference["parameters"], again["parameters"], strict=True):
            assert other["refined"] == pytest.approx(one["refined"], abs=0.01 * one["sigma"])
    assert load_cell(tmp_path / "a.json") == lc.load_calibration(tmp_path / "a.json").cell


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("{", "cell.json:1:2: not JSON"),
        ("[]", "cameras, lasers and planes"),
        ('{"format": "lasercal-capture"}', "lasercal-cell, lasercal-calibration"),
        ('{"cameras": {}, "lasers": {}}', "planes: left out"),
    ],
)
def test_a_wrong_initial_is_one_clear_message(lasercal, noisy, tmp_path, text, words):
    (tmp_path / "cell.json").write_text(text)
    outcome = lasercal("calibrate", noisy, "--initial", tmp_path / "cell.json")
    assert outcome.status == 1
    assert str(tmp_path / "cell.json") in outcome.err
    assert words in outcome.err
    assert not (noisy / "calibration.json").exists()


def rows_of(document):
    return {row["name"]: row for row in document["parameters"]}


def test_distortion_chooses_the_terms(lasercal, noisy):
    args = ("calibrate", noisy, *near(noisy), "--distortion")
    none = rows_of(lasercal.json(*args, "none"))
    assert [none[name]["sigma"] for name in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
    some = rows_of(lasercal.json(*args, "k1,p2"))
    assert [some[name]["sigma"] > 0 for name in ("k1", "k2", "p1", "p2")] == [1, 0, 0, 1]
    outcome = lasercal(*args, "none")
    assert "Held or assumed:" in outcome.out
    assert table_of(outcome.out)["k1"][2] == "held"


def test_known_values_are_held_and_said(lasercal, noisy):
    known = ("--known", "principal_point=320,240", "--known", "skew=0", "--known", "camera.k2=0.01")
    outcome = lasercal("calibrate", noisy, *near(noisy), *known)
    assert outcome.status == 0, outcome.err
    rows = table_of(outcome.out)
    for name, value in (("u0", 320), ("v0", 240), ("alpha_c", 0), ("k2", 0.01)):
        assert (float(rows[name][1]), rows[name][2]) == (value, "held")
    assert "principal_point held at the known value (320.0, 240.0)" in outcome.out
    unknown = lasercal("calibrate", noisy, "--known", "skw=0")
    assert unknown.status == 1
    assert "'skw'" in unknown.err
    assert "skew" in unknown.err


def test_known_wins_over_the_capture(lasercal, noisy):
    head = noisy / "capture.yaml"
    head.write_text(head.read_text() + "known: {skew: 1.5, u0: 321}\n")
    rows = rows_of(lasercal.json("calibrate", noisy, *near(noisy), "--known", "skew=0"))
    assert rows["alpha_c"]["refined"] == 0
    assert (rows["u0"]["refined"], rows["u0"]["sigma"]) == (321, 0)


def test_fixed_keeps_parts_of_the_start(lasercal, noisy):
    args = ("--initial", noisy / "truth.json", "--fixed", "intrinsics", "--fixed", "plane:1")
    document = lasercal.json("calibrate", noisy, *args)
    rows = rows_of(document)
    assert all(rows[name]["sigma"] == 0 for name in ("fu", "k1", "a_1_x", "a_1_z"))
    assert all(rows[name]["sigma"] > 0 for name in ("Tx", "a_2_x", "laser_theta"))
    assert rows["fu"]["refined"] == 550


def test_an_outlier_is_named_unless_that_is_switched_off(lasercal, noisy):
    def plant(rows):
        rows[7]["u"] = repr(float(rows[7]["u"]) + 40.0)

    rewrite(noisy, plant)
    outcome = lasercal("calibrate", noisy)
    assert outcome.status == 0
    assert "Rejected: 1 spot" in outcome.out
    assert "s008 (plane 1): residual" in outcome.out
    kept = lasercal.json("calibrate", noisy, *near(noisy), "--robust", "none")
    assert kept["fit"]["n_rejected"] == 0
    assert kept["fit"]["sigma0"] > 2


def test_sigma_px_wins_over_the_capture(lasercal, noisy):
    args = ("calibrate", noisy, *near(noisy))
    stated = lasercal.json(*args)["fit"]["sigma0"]
    doubled = lasercal.json(*args, "--sigma-px", "2")["fit"]["sigma0"]
    assert doubled == pytest.approx(stated / 2, rel=1e-6)
    outcome = lasercal(*args, "--sigma-px", "0.2")
    assert "less exact than stated" in outcome.out


def test_without_stated_noise_the_pixel_sigma_is_estimated(lasercal, noisy):
    head = noisy / "capture.yaml"
    lines = [line for line in head.read_text().splitlines() if not line.startswith("noise")]
    head.write_text("\n".join(lines) + "\n")
    outcome = lasercal("calibrate", noisy, *near(noisy))
    sigma0 = lc.load_calibration(noisy / "calibration.json").fit.sigma0
    assert f"Noise of a pixel coordinate, from the residuals: {sigma0:.3g} px" in outcome.out
    assert 0.7 < sigma0 < 1.3


def test_data_that_cannot_give_an_answer_are_refused_with_the_reason(lasercal, noisy):
    def few(rows):
        del rows[5:]

    rewrite(noisy, few)
    outcome = lasercal("calibrate", noisy)
    assert outcome.status == 1
    assert outcome.out == ""
    assert outcome.err.startswith("Error: ")
    assert "Traceback" not in outcome.err
    assert not (noisy / "calibration.json").exists()


def test_the_same_capture_gives_the_same_result(lasercal, noisy):
    first, second = (lasercal.json("calibrate", noisy) for _ in range(2))
    for one in (first, second):
        one["provenance"].pop("created")
    assert first == second
    assert np.isfinite([row["sigma"] for row in first["parameters"]]).all()
