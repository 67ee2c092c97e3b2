"""Photographs of real spots; skipped where they are not there."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from lasercal_gtsam.detect import DetectionOptions, detect_spot

DATA = Path(
    os.environ.get("LASERCAL_SHARED_DATA")
    or Path(__file__).resolve().parents[2].parent / "shared" / "data"
)
INDEX = DATA / "spots.json"
pytestmark = pytest.mark.skipif(not INDEX.is_file(), reason=f"no real pictures at {DATA}")

SPOTS = {e["name"]: e for e in json.loads(INDEX.read_text())} if INDEX.is_file() else {}
CHANNELS = ["auto", "red", "green", "gray"]


def load(name):
    entry = SPOTS[name]
    frames = [cv2.imread(str(DATA / entry[k]), -1) if k in entry else None for k in ("file", "off")]
    return frames[0], frames[1], np.array([entry["x"], entry["y"]], dtype=float)


@pytest.mark.parametrize("channel", CHANNELS)
def test_spot_of_the_on_off_pair_is_found(channel):
    on, off, by_eye = load("pair_A")
    found = detect_spot(on, off, DetectionOptions(channel=channel))
    assert found.usable
    assert np.hypot(*(found.uv - by_eye)) < 2.0
    assert found.runner_up is None or found.runner_up.ratio < 0.2
    if channel == "auto":
        assert found.channel == "green"  # the red channel clips
        assert found.n_saturated == 0


def test_sigma_of_the_pair_covers_the_difference_between_channels():
    on, off, _ = load("pair_A")
    red, green = (detect_spot(on, off, DetectionOptions(channel=c)) for c in ("red", "green"))
    apart = red.uv - green.uv
    assert apart @ np.linalg.solve(red.cov_uv + green.cov_uv, apart) < 9.2


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize(
    "name", [n for n, e in SPOTS.items() if e["file"].startswith("spots_surface/")]
)
def test_nothing_wrong_is_used_in_a_single_photograph(name, channel):
    on, _, by_eye = load(name)
    found = detect_spot(on, None, DetectionOptions(channel=channel))
    assert found.single_frame
    assert not found.usable or np.hypot(*(found.uv - by_eye)) < 4.0
    assert found.reason


def test_off_frames_of_other_scenes_do_not_make_a_wrong_spot():
    # the off frame of another scene is a user's mistake that only the verdict can catch
    on, _, by_eye = load("dark_monitor")
    _, off, _ = load("pair_A")
    found = detect_spot(on, off)
    assert not found.usable or np.hypot(*(found.uv - by_eye)) < 4.0


@pytest.mark.parametrize(
    ("name", "within"), [("TEM00_150mm", 3.0), ("TEM00_200mm", 2.0), ("FBWR_151", 40.0)]
)
def test_beams_on_a_bare_sensor_are_too_large_unless_asked_for(name, within):
    on, _, by_eye = load(name)
    found = detect_spot(on)
    assert found.verdict == "too_large"
    assert np.hypot(*(found.uv - by_eye)) < within
    asked = detect_spot(on, None, DetectionOptions(max_area_px=10**6))
    if name == "FBWR_151":
        assert asked.n_saturated > 5000
        assert not asked.usable
    else:
        assert np.hypot(*(asked.uv - by_eye)) < within
