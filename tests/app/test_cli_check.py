"""`lasercal check`: plain words, exit status, poses alone, and never a change on disk."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from cli_support import Cli, contents

from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.simulate import Noise, simulate, write_simulation

LIGHT = Noise(pixel_px=0.5)


@pytest.fixture
def cli(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good") / "capture"
    write_simulation(folder, simulate("tool-z-2", 1, LIGHT))
    return folder


def rewritten(folder, target, *changes, file="capture.yaml"):
    """A copy of a capture with words of a file replaced; the changes must apply."""
    target.mkdir()
    for path in folder.iterdir():
        text = path.read_text()
        if path.name == file:
            for old, new in changes:
                assert old in text
                text = text.replace(old, new, 1)
        (target / path.name).write_text(text)
    return target


def without_columns(folder, target, *names):
    """A copy of a capture whose pose table lacks some columns."""
    rewritten(folder, target)
    table = target / "poses.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    kept = [k for k, name in enumerate(rows[0]) if name not in names]
    assert len(kept) == len(rows[0]) - len(names)
    table.write_text("\n".join(",".join(row[k] for k in kept) for row in rows) + "\n")
    return target


def test_a_good_capture_passes_and_is_left_alone(cli, good):
    before = contents(good)
    outcome = cli("check", good)
    assert outcome.status == 0, outcome.err
    for words in (
        "60 shots; 2 planes (1: 30, 2: 30)",
        "6 hand orientations",
        "3 groups of pure translations",
        "of the picture's width",
        "The declared reading agrees with the spots: T_base_hand, quat_wxyz",
        "The unit of the positions cannot be seen",
        "converged",
        "The geometry determines the cell.",
    ):
        assert words in outcome.out
    assert contents(good) == before


def test_the_document_says_what_the_text_says(cli, good):
    document = cli.json("check", good)
    assert document["diagnosis"]["verdict"] == "consistent"
    assert document["diagnosis"]["best"]["residual_px"] == pytest.approx(0.5, rel=0.25)
    assert document["spots"] == 60
    assert document["poses"]["turns"]["distinct"] == 6
    assert document["problems"] == []
    assert document["verdict"] == "The geometry determines the cell."


def test_readings_can_be_left_out(cli, good):
    document = cli.json("check", good, "--no-readings")
    assert document["diagnosis"] is None
    assert document["fit"].startswith("converged")


def test_the_same_capture_gives_the_same_words(cli, good):
    assert cli("check", good, "--no-readings").out == cli("check", good, "--no-readings").out


def test_poses_alone_are_judged_before_any_picture(cli, good, tmp_path):
    outcome = cli("check", without_columns(good, tmp_path / "c", "u", "v"))
    assert outcome.status == 0, outcome.err
    assert "There are no spots yet" in outcome.out
    assert "hand poses are enough" in outcome.out
    assert "Readings" not in outcome.out


def test_pictures_that_are_not_taken_yet_are_no_error(cli, good, tmp_path):
    bare = without_columns(good, tmp_path / "c", "u", "v")
    yaml = bare / "capture.yaml"
    yaml.write_text(yaml.read_text() + 'images: "images/{id}.png"\n')
    outcome = cli("check", bare)
    assert outcome.status == 0, outcome.err
    assert "the pictures cannot be read yet" in outcome.out
    wanted = cli("check", bare, "--pictures")
    assert wanted.status == 1
    assert "Traceback" not in wanted.err


def test_pictures_are_looked_at_when_asked(cli, tmp_path):
    assert cli("simulate", tmp_path / "c", "--preset", "tool-z-2", "--pictures", "--groups", 2,
               "--shots", 6).status == 0  # fmt: skip
    skipped = cli("check", tmp_path / "c")
    assert skipped.status == 0
    assert "24 pictures not looked at" in skipped.out
    document = cli.json("check", tmp_path / "c", "--pictures", "--no-readings")
    assert document["spots"] >= 20
    assert document["not_looked_at"] == 0


def one_orientation(tmp_path, seen):
    T = seen.T_base_hand.copy()
    T[:, :3, :3] = T[0, :3, :3]
    write_capture(
        tmp_path / "c", replace(seen, T_base_hand=T), transform="T_base_hand", length="mm",
        rotation="quat_wxyz", with_spots=True,
    )  # fmt: skip
    return tmp_path / "c"


def test_singular_poses_are_refused_in_the_words_of_the_calibration(cli, tmp_path):
    folder = one_orientation(tmp_path, simulate("paper-2", 0).observations)
    outcome = cli("check", folder)
    assert outcome.status == 1
    assert "all 60 shots have the same hand orientation" in outcome.err
    assert "1 hand orientation," in outcome.out
    assert "would not give an answer to trust" in outcome.out
    document = json.loads(cli("check", folder, "--json").out)
    assert "same hand orientation" in document["problems"][0]

    calibrated = cli("calibrate", folder)
    assert calibrated.status == 1
    assert "all 60 shots have the same hand orientation" in calibrated.err
    assert f"'lasercal check {folder}' looks for the cause" in calibrated.err


def test_a_wrong_transform_is_named_with_the_line_to_write(cli, good, tmp_path):
    wrong = rewritten(good, tmp_path / "c", ("T_base_hand", "T_hand_base"))
    before = contents(wrong)
    outcome = cli("check", wrong)
    assert outcome.status == 1
    assert "T_base_hand, quat_wxyz leaves" in outcome.err
    assert "probably the right one" in outcome.err
    assert "in capture.yaml, under poses, write 'transform: T_base_hand'" in outcome.out
    assert contents(wrong) == before


def test_misnamed_quaternion_columns_are_named(cli, good, tmp_path):
    wrong = rewritten(good, tmp_path / "c", ("qw,qx,qy,qz", "qx,qy,qz,qw"), file="poses.csv")
    document = json.loads(cli("check", wrong, "--json").out)
    assert document["diagnosis"]["best"]["words"] == "T_base_hand, quaternion in the order wxyz"
    assert "name the columns qw, qx, qy, qz (they are named qx, qy, qz, qw)" in " ".join(
        document["reading"]
    )


def test_exchanged_pixel_columns_outside_the_picture_are_named(cli, tmp_path):
    simulation = simulate("table2-3", 1, LIGHT)
    assert simulation.observations.uv[:, 0].max() > 480
    write_simulation(tmp_path / "g", simulation)
    wrong = rewritten(tmp_path / "g", tmp_path / "c", ("u,v", "v,u"), file="poses.csv")
    outcome = cli("check", wrong)
    assert outcome.status == 1
    assert "with u and v exchanged all spots lie inside the picture" in outcome.err


def test_a_wrong_unit_is_a_matter_of_plausibility(cli, good, tmp_path):
    wrong = rewritten(good, tmp_path / "c", ("length: mm", "length: m"))
    outcome = cli("check", wrong)
    assert outcome.status == 0
    assert "is the unit mm?" in outcome.out
    assert "cannot be seen from spots" in outcome.out


def test_weak_geometry_is_said_with_what_would_help(cli, tmp_path):
    seen = simulate("paper-2", 0, Noise(pixel_px=4.0)).observations
    write_capture(
        tmp_path / "c", seen[::2], transform="T_base_hand", length="mm",
        rotation="quat_wxyz", with_spots=True,
    )  # fmt: skip
    outcome = cli("check", tmp_path / "c", "--no-readings")
    assert outcome.status == 0
    assert "The geometry is weak" in outcome.out
    assert "add 20 shots" in outcome.out
    assert "hardly move a spot" in outcome.out


def test_a_calibration_that_fits_badly_points_to_the_check(cli, tmp_path):
    simulation = simulate("tool-z-2", 1, Noise(pixel_px=12.0))
    write_simulation(tmp_path / "c", simulation)
    outcome = cli("calibrate", tmp_path / "c", "--robust", "none")
    assert f"'lasercal check {tmp_path / 'c'}' looks for the cause" in outcome.err


@pytest.mark.parametrize("content", ["", "lasercal: 2\n", "poses: [1, 2"])
def test_a_capture_that_cannot_be_read_is_one_line(cli, tmp_path, content):
    (tmp_path / "capture.yaml").write_text(content)
    outcome = cli("check", tmp_path)
    assert outcome.status == 1
    assert "Error:" in outcome.err
    assert outcome.out == ""


def test_a_single_shot_and_one_spot_are_refused(cli, good, tmp_path):
    small = rewritten(good, tmp_path / "c")
    table = small / "poses.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:2]) + "\n")
    outcome = cli("check", small)
    assert outcome.status == 1
    assert "too few" in outcome.err
    assert np.isfinite(json.loads(cli("check", small, "--json").out)["poses"]["reach_mm"])
