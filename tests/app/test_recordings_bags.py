"""Bags in all three storages become the capture that they were made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli_support import Cli
from recording_cases import START, STORAGES, Session, picture, small_capture, write_bag

from lasercal_gtsam.io.capture import Capture, load_capture

FRAMES = ("--base", "base_link", "--hand", "tool0")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return small_capture(tmp_path_factory.mktemp("made") / "capture")


@pytest.fixture(scope="module")
def bags(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same session in every storage, with padded rows."""
    folder = tmp_path_factory.mktemp("bags")
    events = list(Session(padding=16).events(capture))
    return {storage: write_bag(folder / storage, storage, events) for storage in STORAGES}


@pytest.fixture
def lasercal(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


def recorded(folder: Path, capture: Capture, session: Session, storage: str = "mcap") -> Path:
    return write_bag(folder / "bag", storage, list(session.events(capture)))


def assert_same(found: Capture, made: Capture, *, off: bool = True, digits: float = 1e-14) -> None:
    """The same rows: planes, poses to rounding, pictures to the bit."""
    assert found.planes.tolist() == made.planes.tolist()
    assert found.image_size == made.image_size
    np.testing.assert_allclose(found.T_base_hand, made.T_base_hand, rtol=0, atol=digits)
    for k in range(len(made)):
        np.testing.assert_array_equal(picture(found.images_on[k]), picture(made.images_on[k]))
        if off:
            np.testing.assert_array_equal(picture(found.images_off[k]), picture(made.images_off[k]))


@pytest.mark.parametrize("storage", STORAGES)
def test_bag_gives_the_capture_it_was_made_of(storage, bags, capture, lasercal, tmp_path):
    out = tmp_path / "out"
    outcome = lasercal("import", bags[storage], "-o", out, *FRAMES, "--plane-topic", "/plane")
    assert outcome.status == 0, outcome.err
    assert outcome.err == ""
    assert_same(load_capture(out), capture)
    story = json.loads((out / "recording.json").read_text())
    assert story["stops"] == len(capture)
    assert story["base"] == "base_link"
    assert story["camera_info"]["camera"]["K"][0] == 137.5
    assert story["rows"][0]["stamp_ns"] == START + 307_000_000


@pytest.mark.parametrize("laser", ["--laser-topic", "seen"])
def test_laser_topic_says_what_the_pictures_show(laser, bags, capture, lasercal, tmp_path):
    extra = () if laser == "seen" else (laser, "/laser")
    out = tmp_path / "out"
    outcome = lasercal("import", bags["mcap"], "-o", out, *FRAMES, "--plane", "p", *extra)
    assert outcome.status == 0, outcome.err
    found = load_capture(out)
    for k in range(len(capture)):
        for seen, state in ((found.images_on[k], "on"), (found.images_off[k], "off")):
            distance = {
                name: np.abs(picture(seen).astype(float) - picture(own)).max()
                for name, own in (("on", capture.images_on[k]), ("off", capture.images_off[k]))
            }
            assert distance[state] < 0.2 * max(distance.values())
