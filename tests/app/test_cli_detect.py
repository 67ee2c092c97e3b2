"""`lasercal detect`: spots against the truth, the table that is read back, the contact sheet."""

from __future__ import annotations

import csv
import json
import shutil

import cv2
import numpy as np
import pytest
from cli_support import Cli, contents

import lasercal_gtsam as lc
from lasercal_gtsam.cli.main import main


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A capture with pictures: two planes, two hand rotations on each, 16 poses."""
    folder = tmp_path_factory.mktemp("pictures") / "capture"
    size = ("--preset", "paper-2", "--groups", "2", "--shots", "4")
    assert main(["simulate", str(folder), *size, "--noise", "0", "--pictures"]) == 0
    return folder


@pytest.fixture
def capture(original, tmp_path):
    return shutil.copytree(original, tmp_path / "capture")


def spots_in(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def refer_to_spots(folder):
    head = folder / "capture.yaml"
    head.write_text(head.read_text() + "spots: {file: spots.csv}\n")


def test_every_picture_has_a_line_and_the_spots_are_where_the_truth_is(lasercal, capture):
    outcome = lasercal("detect", capture)
    assert outcome.status == 0
    assert outcome.err == ""
    truth = {s["id"]: s["uv_px"] for s in json.loads((capture / "truth.json").read_text())["spots"]}
    rows = spots_in(capture / "spots.csv")
    assert [row["id"] for row in rows] == list(truth)
    used = [row for row in rows if row["verdict"] == "used"]
    assert len(used) >= 12
    for row in used:
        error = np.array([float(row["u"]), float(row["v"])]) - truth[row["id"]]
        assert np.hypot(*error) < 1.0
        assert 0.01 < float(row["sigma_u"]) < 0.5
    assert f"  used ({len(used)})\n" in outcome.out
    for row in rows:
        if row["verdict"] != "used":
            assert f"{row['id']}: {row['reason']}" in outcome.out
    assert "16 pictures looked at" in outcome.out


def test_the_contact_sheet_has_a_tile_for_each_picture(lasercal, capture):
    lasercal("detect", capture)
    sheet = cv2.imread(str(capture / "contact-sheet.png"))
    assert sheet is not None
    green = np.all(np.abs(sheet.astype(int) - (90, 220, 90)) < 40, axis=2)
    used = sum(row["verdict"] == "used" for row in spots_in(capture / "spots.csv"))
    # every used spot has a green line of text below its tile
    assert used * 20 < green.sum() < used * 5000


def test_spots_and_pictures_give_the_same_calibration(lasercal, capture):
    from_pictures = lasercal.json("calibrate", capture, "--distortion", "none")
    assert from_pictures["run"]["pictures"] == 16
    lasercal("detect", capture)
    refer_to_spots(capture)
    from_spots = lasercal.json("calibrate", capture, "--distortion", "none")
    assert from_spots["run"]["pictures"] == 0
    assert from_spots["run"]["skipped"] == from_pictures["run"]["skipped"]
    for one, other in zip(from_pictures["parameters"], from_spots["parameters"], strict=True):
        assert other["refined"] == pytest.approx(one["refined"], rel=1e-9, abs=1e-9)


def test_calibrate_accounts_for_pictures_without_a_spot(lasercal, capture):
    shutil.copy(capture / "images" / "s002_off.png", capture / "images" / "s002.png")
    outcome = lasercal("calibrate", capture, "--distortion", "none")
    assert outcome.status == 0, outcome.err
    assert "16 pictures looked at" in outcome.out
    assert "  none (1)\n    s002: " in outcome.out
    assert "lasercal detect" in outcome.out


def test_the_hint_is_the_line_that_works(lasercal, capture):
    hint = lasercal("detect", capture).out.splitlines()[-1]
    head = capture / "capture.yaml"
    head.write_text(head.read_text() + hint.strip() + "\n")
    read = lc.load_capture(capture)
    usable = [row["id"] for row in spots_in(capture / "spots.csv") if row["verdict"] == "used"]
    assert read.observations().id.tolist() == usable
    assert "is next" in lasercal("detect", capture).out


def test_a_hint_for_a_table_elsewhere_names_the_way(lasercal, capture, tmp_path):
    outcome = lasercal("detect", capture, "-o", tmp_path / "mine.csv")
    assert outcome.out.splitlines()[-1] == "  spots: {file: ../mine.csv}"
    assert (tmp_path / "contact-sheet.png").is_file()
    head = capture / "capture.yaml"
    head.write_text(head.read_text() + outcome.out.splitlines()[-1].strip() + "\n")
    assert len(lc.load_capture(capture).observations()) >= 12


def test_detecting_again_is_the_same_to_the_last_byte(lasercal, capture):
    assert lasercal("detect", capture).status == 0
    before = contents(capture)
    assert lasercal("detect", capture).status == 0
    assert contents(capture) == before


def test_a_corrected_table_is_not_lost(lasercal, capture):
    lasercal("detect", capture)
    refer_to_spots(capture)
    table = capture / "spots.csv"
    found = table.read_text()
    table.write_text(found.replace(",used,", ",skip,", 1))
    before = contents(capture)
    outcome = lasercal("detect", capture)
    assert outcome.status == 1
    assert outcome.out == ""
    assert "--force" in outcome.err
    assert contents(capture) == before
    # the pictures are looked at again although capture.yaml names the corrected table
    assert lasercal("detect", capture, "--force").status == 0
    assert table.read_text() == found


def test_settings_reach_the_detector(lasercal, capture):
    counts = lasercal.json("detect", capture)["verdicts"]
    assert counts["used"] >= 12
    strict = lasercal.json("detect", capture, "--force", "--set", "max_sigma_px=0.001")
    assert strict["verdicts"].get("used", 0) == 0
    corner = ("--set", "region=0,0 4,0 4,4 0,4")
    outside = lasercal.json("detect", capture, "--force", *corner)
    assert outside["verdicts"].get("used", 0) == 0
    assert outside["verdicts"]["outside"] >= 12


def test_json_lists_every_row(lasercal, capture):
    document = lasercal.json("detect", capture)
    rows = spots_in(capture / "spots.csv")
    assert [row["id"] for row in document["spots"]] == [row["id"] for row in rows]
    assert document["pictures"] == 16
    assert sum(document["verdicts"].values()) == 16
    for one, other in zip(document["spots"], rows, strict=True):
        assert one["verdict"] == other["verdict"]
        assert [str(x) if x is not None else "" for x in one["uv_px"]] == [other["u"], other["v"]]
        assert one["source"].endswith(f"{one['id']}.png")


def without_off_pictures(capture):
    head = capture / "capture.yaml"
    text = head.read_text()
    assert ', off: "images/{id}_off.png"' in text
    head.write_text(text.replace(', off: "images/{id}_off.png"', ""))


def test_without_a_laser_off_picture_it_says_what_to_do(lasercal, capture):
    without_off_pictures(capture)
    table = capture / "poses.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:5]))  # too few for a median
    outcome = lasercal("detect", capture)
    assert outcome.status == 0
    assert "4 pictures without a laser-off picture" in outcome.out


def test_the_median_stands_in_for_laser_off_pictures_and_it_says_so(lasercal, capture):
    without_off_pictures(capture)
    outcome = lasercal("detect", capture)
    assert outcome.status == 0
    assert outcome.err.count("8 rows have no laser-off picture; the median of 7") == 2
    assert "without a laser-off picture" not in outcome.out
    rows = spots_in(capture / "spots.csv")
    assert all(row["reason"].endswith("off frame: median of 7 laser-on pictures") for row in rows)


def test_a_capture_with_all_its_spots_has_nothing_to_look_at(lasercal, tmp_path):
    lasercal("simulate", tmp_path / "given", "--preset", "paper-1", "--groups", "1")
    before = contents(tmp_path)
    outcome = lasercal("detect", tmp_path / "given")
    assert outcome.status == 1
    assert "no pictures to look at" in outcome.err
    assert contents(tmp_path) == before
