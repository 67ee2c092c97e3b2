"""`lasercal simulate`: captures in every convention, the noise asked for, nothing overwritten."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from cli_support import Cli, contents

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import PRESETS


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


SMALL = ("--preset", "paper-1", "--groups", "1", "--shots", "4")


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_written_and_read_back(lasercal, tmp_path, preset):
    document = lasercal.json("simulate", tmp_path / "c", "--preset", preset)
    capture = lc.load_capture(tmp_path / "c")
    assert len(capture) == document["n_spots"]
    assert document["preset"] == preset
    truth = json.loads((tmp_path / "c" / "truth.json").read_text())
    assert sorted(truth["planes"]) == sorted(set(capture.planes.tolist()))


def test_presets_are_listed_in_the_help(lasercal):
    page = lasercal("simulate", "-h").out
    for name, preset in PRESETS.items():
        assert f"\n  {name} " in page
        assert preset.description.split()[-1] in page


def test_conventions_change_the_file_but_not_the_poses(lasercal, tmp_path):
    lasercal("simulate", tmp_path / "a", *SMALL)
    other = ("--rotation", "euler:ZYZ:rad", "--transform", "T_hand_base", "--length", "m")
    lasercal("simulate", tmp_path / "b", *SMALL, *other)
    head = (tmp_path / "b" / "capture.yaml").read_text()
    for words in ("transform: T_hand_base", "length: m\n", 'rotation: "euler:ZYZ:rad"'):
        assert words in head
    one, two = (lc.load_capture(tmp_path / name) for name in "ab")
    np.testing.assert_allclose(one.T_base_hand, two.T_base_hand, atol=1e-12)
    np.testing.assert_array_equal(one.uv, two.uv)


def test_the_seed_decides_every_byte(lasercal, tmp_path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        lasercal("simulate", tmp_path / name, *SMALL, "--seed", seed, "--pictures")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    one, other = contents(tmp_path / "a"), contents(tmp_path / "c")
    assert one.keys() == other.keys()
    assert all(one[name] != other[name] for name in one if name != "capture.yaml")


@pytest.mark.parametrize(
    ("args", "pixel_px", "hand_mm", "hand_deg"),
    [
        ((), 1, 1, 0.05),
        (("--noise", "0.5"), 0.5, 0.5, 0.025),
        (("--noise", "0"), 0, 0, 0),
        (("--noise", "0", "--pixel-px", "0.3"), 0.3, 0, 0),
        (("--hand-mm", "0.1", "--hand-deg", "0.02"), 1, 0.1, 0.02),
    ],
)
def test_the_noise_is_what_was_asked_for(lasercal, tmp_path, args, pixel_px, hand_mm, hand_deg):
    document = lasercal.json("simulate", tmp_path / "c", *SMALL, *args)
    noise = document["noise"]
    assert noise["pixel_px"] == pytest.approx(pixel_px)
    assert noise["hand_translation_m"] == pytest.approx(hand_mm / 1000)
    assert noise["hand_rotation_rad"] == pytest.approx(hand_deg * np.pi / 180)
    stated = lc.load_capture(tmp_path / "c").noise
    assert stated.sigma_px == (pytest.approx(pixel_px) if pixel_px else None)
    assert stated.hand_sigma_m == pytest.approx(hand_mm / 1000)


def test_pictures_take_the_place_of_pixels(lasercal, tmp_path):
    dark = ("--bits", "16", "--ambient", "0.02")
    outcome = lasercal("simulate", tmp_path / "c", *SMALL, "--pictures", *dark)
    assert "4 pictures with laser on and off on 1 plane (1)" in outcome.out
    header = (tmp_path / "c" / "poses.csv").read_text().splitlines()[0]
    assert header == "id,plane,x,y,z,qw,qx,qy,qz"
    names = sorted(path.name for path in (tmp_path / "c" / "images").iterdir())
    assert names == [f"s{k:03d}{end}.png" for k in range(1, 5) for end in ("", "_off")]
    picture = cv2.imread(str(tmp_path / "c" / "images" / "s001_off.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16
    assert picture.shape == (480, 640)
    assert np.median(picture) == pytest.approx(0.02 * 65535, rel=0.5)


def test_what_is_there_stays_unless_forced(lasercal, tmp_path):
    out = tmp_path / "c"
    lasercal("simulate", out, *SMALL, "--pictures")
    (out / "notes.txt").write_text("mine")
    before = contents(out)
    refused = lasercal("simulate", out, *SMALL, "--seed", "1")
    assert refused.status == 1
    assert refused.out == ""
    assert "--force" in refused.err
    assert contents(out) == before
    forced = lasercal("simulate", out, *SMALL, "--seed", "1", "--pictures", "--force")
    assert forced.status == 0
    assert (
        forced.err == f"Warning: notes.txt in {out} are not of this capture and were left as "
        "they are\n"
    )
    after = contents(out)
    assert after.keys() == before.keys()
    assert after["notes.txt"] == b"mine"
    assert after["poses.csv"] != before["poses.csv"]
    assert after["images/s001.png"] != before["images/s001.png"]


def test_a_failure_with_force_leaves_the_old_capture(lasercal, tmp_path, monkeypatch):
    out = tmp_path / "c"
    lasercal("simulate", out, *SMALL)
    before = contents(out)

    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lasercal_gtsam.io.capture_writer.write_capture", fail)
    outcome = lasercal("simulate", out, *SMALL, "--seed", "1", "--force")
    assert outcome.status == 1
    assert outcome.err.startswith("Error: ")
    assert "No space left on device" in outcome.err
    assert contents(out) == before


def test_a_file_in_the_way_is_one_line(lasercal, tmp_path):
    (tmp_path / "c").write_text("mine")
    outcome = lasercal("simulate", tmp_path / "c", *SMALL)
    assert outcome.status == 1
    assert outcome.err.startswith(f"Error: {tmp_path / 'c'}: ")
    assert (tmp_path / "c").read_text() == "mine"
