"""`lasercal report` and `calibrate --report`: files, refusals, pictures of what was left out."""

from __future__ import annotations

import json
import shutil

import pytest
from cli_support import Cli
from figure_cases import usual

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate, write_simulation


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A capture with given pixels, one of them wrong, and nothing else."""
    folder = tmp_path_factory.mktemp("cell")
    made = simulate("paper", 1, Noise(pixel_px=0.3))
    write_simulation(folder, made)
    poses = folder / "poses.csv"
    lines = poses.read_text().splitlines()
    u = lines[0].split(",").index("u")
    row = lines[8].split(",")
    row[u] = str(float(row[u]) + 80.0)
    lines[8] = ",".join(row)
    poses.write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def folder(cell, tmp_path):
    shutil.copytree(cell, tmp_path / "cell")
    return tmp_path / "cell"


def document_of(lasercal, calibration, *more):
    path = calibration.parent / "document.json"
    outcome = lasercal("report", calibration, "--document", path, *more)
    assert outcome.status == 0, outcome.err
    return json.loads(path.read_text()), outcome


def test_json_prints_what_the_page_shows(lasercal, folder):
    assert lasercal("calibrate", folder).status == 0
    calibration = folder / "calibration.json"
    document, _ = document_of(lasercal, calibration)
    printed = lasercal.json("report", calibration)
    assert printed.keys() == document.keys()
    assert printed["parameters"] == document["parameters"]


def test_calibrate_writes_the_report_beside_its_result(lasercal, folder):
    page = folder / "page.html"
    outcome = lasercal("calibrate", folder, "--report", page)
    assert outcome.status == 0, outcome.err
    assert outcome.out.splitlines()[-2:] == [
        f"Saved {folder / 'calibration.json'}.",
        f"Saved {page}.",
    ]
    text = page.read_text()
    assert text.lower().startswith("<!doctype html")
    assert len(text) < 3_000_000
    document, outcome = document_of(lasercal, folder / "calibration.json")
    assert outcome.out == f"Saved {folder / 'report.html'} and {folder / 'document.json'}.\n"
    assert outcome.err == ""
    assert document["format"] == "lasercal-report"
    assert {f["name"] for f in document["inputs"]["files"]} >= {"capture.yaml", "poses.csv"}
    (outlier,) = document["rejected"]["outliers"]
    assert outlier["residual_px"][0] == pytest.approx(-80.0, abs=3.0)
    assert document["rejected"]["pictures"] == (
        "The spots were given as pixels: there are no pictures."
    )
    command = document["inputs"]["commands"][0]["command"]
    assert command.startswith("lasercal calibrate capture.yaml")


def test_the_method_writes_page_and_document(tmp_path):
    usual().report(tmp_path / "page.html", document=tmp_path / "page.json")
    document = json.loads((tmp_path / "page.json").read_text())
    assert document["summary"]["n_spots"] == 90
    assert (tmp_path / "page.html").read_text().lower().startswith("<!doctype html")
    assert {path.name for path in tmp_path.iterdir()} == {"page.html", "page.json"}


def test_a_capture_that_has_changed_is_not_taken_for_the_one(lasercal, folder):
    calibration = folder / "calibration.json"
    assert lasercal("calibrate", folder).status == 0
    capture = folder / "capture.yaml"
    capture.write_text(capture.read_text() + "# looked at\n")
    document, outcome = document_of(lasercal, calibration)
    assert "capture.yaml has changed" in outcome.err
    assert "--capture" in outcome.err
    assert document["rejected"]["pictures"].startswith("The capture is not at hand")
    document, outcome = document_of(lasercal, calibration, "--capture", folder)
    assert "capture.yaml has changed" in outcome.err
    assert document["rejected"]["pictures"].startswith("The spots were given as pixels")


def test_a_broken_capture_beside_it_does_not_stop_the_report(lasercal, folder):
    assert lasercal("calibrate", folder).status == 0
    (folder / "capture.yaml").write_text("camera: 5\n")
    document, outcome = document_of(lasercal, folder / "calibration.json")
    assert "no pictures in the report" in outcome.err
    assert document["rejected"]["outliers_total"] == 1
    outcome = lasercal("report", folder / "calibration.json", "--capture", folder)
    assert outcome.status == 1
    assert outcome.err.startswith("Error: ")


def test_nothing_that_is_not_ours_is_overwritten(lasercal, folder):
    calibration = folder / "calibration.json"
    assert lasercal("calibrate", folder).status == 0
    before = calibration.read_bytes()
    outcome = lasercal("report", calibration, "-o", calibration)
    assert outcome.status == 1
    assert "not a page" in outcome.err
    outcome = lasercal("report", calibration, "--document", calibration)
    assert outcome.status == 1
    assert "not a lasercal report" in outcome.err
    outcome = lasercal("calibrate", folder, "--report", folder / "poses.csv")
    assert outcome.status == 1
    assert "not a page" in outcome.err
    assert calibration.read_bytes() == before
    assert not (folder / "report.html").exists()
    # an earlier page and document are replaced
    for _ in range(2):
        document_of(lasercal, calibration)


def test_intervals_by_the_likelihood_are_asked_for_every_row(lasercal, folder, monkeypatch):
    asked = []

    def ends(calibration, names):
        asked.extend(names)
        return dict.fromkeys(names, (1.0, 2.0))

    assert lasercal("calibrate", folder).status == 0
    monkeypatch.setattr("lasercal_gtsam.confidence.intervals", ends)
    calibration = folder / "calibration.json"
    document, _ = document_of(lasercal, calibration, "--intervals", "likelihood")
    rows = document["parameters"]["rows"]
    assert asked == [row["name"] for row in rows if not row["held"]]
    assert {(row["low"], row["high"]) for row in rows} == {(1.0, 2.0)}
    assert "likelihood" in document["parameters"]["interval"]["words"]


def test_mistakes_are_one_line(lasercal, tmp_path):
    outcome = lasercal("report", tmp_path / "none.json")
    assert outcome.status == 1
    assert outcome.err.splitlines() == [
        f"Error: {tmp_path / 'none.json'}: there is no such file or folder"
    ]
    outcome = lasercal("report", tmp_path / "none.json", "-o", tmp_path / "no" / "page.html")
    assert outcome.status == 1
    assert "no folder" in outcome.err


def test_an_answer_that_is_not_saved_gets_its_report(lasercal, folder, monkeypatch):
    """What went wrong is in the report all the same; the exit status says that it did."""
    from dataclasses import replace

    import lasercal_gtsam.api as api

    found = usual()
    failed = replace(found, fit=replace(found.fit, converged=False, status="not to be trusted: x"))
    monkeypatch.setattr(api, "calibrate", lambda *args, **given: failed)
    monkeypatch.setattr("lasercal_gtsam.opinions.split.calibrate", lambda *args, **given: failed)
    outcome = lasercal("calibrate", folder, "--report", folder / "page.html")
    assert outcome.status == 1
    assert not (folder / "calibration.json").exists()
    text = (folder / "page.html").read_text()
    assert "not to be trusted" in text


def test_the_calibration_in_the_file_and_in_memory_give_one_report(tmp_path):
    found = usual()
    found.save(tmp_path / "c.json")
    from lasercal_gtsam.report.document import make_document

    one = make_document(found)
    two = make_document(lc.load_calibration(tmp_path / "c.json"))
    assert {**one, "created": ""} == {**two, "created": ""}
