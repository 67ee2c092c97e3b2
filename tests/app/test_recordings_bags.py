"""Bags in all three storages become the capture that they were made of."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_support import Cli
from recording_cases import IMAGES, START, STORAGES, Session, picture, small_capture, write_bag

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import Capture, load_capture
from lasercal_gtsam.recordings import OnePlane, open_bag, plan_capture, write_recording

FRAMES = ("--base", "base_link", "--hand", "tool0")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return small_capture(tmp_path_factory.mktemp("made") / "capture")


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Four rows, two on each plane."""
    return small_capture(tmp_path_factory.mktemp("made") / "few", groups=1)


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


@pytest.mark.slow
def test_calibration_of_the_bag_is_that_of_the_capture(lasercal, tmp_path):
    made = small_capture(tmp_path / "capture", groups=3, shots=4)
    bag = recorded(tmp_path, made, Session())
    out = tmp_path / "out"
    assert lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane").status == 0
    tables = []
    for capture in (made, load_capture(out)):
        result = calibrate(capture.observations(), options=capture.options(distortion="none"))
        assert result.fit.converged
        tables.append([(p.refined, p.sigma) for p in result.parameters])
    np.testing.assert_allclose(tables[1], tables[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "kind", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"]
)
@pytest.mark.parametrize("storage", ["ros1", "mcap"])
def test_pose_topic_instead_of_tf(kind, storage, few, lasercal, tmp_path):
    bag = recorded(tmp_path, few, Session(poses_as=kind), storage)
    out = tmp_path / "out"
    topic = ("--pose-topic", "/hand_pose", "--plane-topic", "/plane")
    outcome = lasercal("import", bag, "-o", out, *topic)
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(out), few)
    wrong = lasercal("import", bag, "--dry-run", "--base", "world", *topic)
    assert wrong.status == 1
    assert "its base is 'base_link', not 'world'" in wrong.err


def test_jitter_of_the_encoders_is_no_motion(few, lasercal, tmp_path):
    jitter_m = 20e-6
    bag = recorded(tmp_path, few, Session(jitter_m=jitter_m))
    out = tmp_path / "out"
    assert lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane").status == 0
    assert_same(load_capture(out), few, digits=jitter_m)
    noisy = lasercal("import", bag, "--dry-run", *FRAMES, "--plane", "1", "--still-mm", "0.02")
    assert noisy.status == 1
    assert "the hand never stands still: the least that it moves within 0.3 s is 0.0" in noisy.err
    assert "--still-mm" in noisy.err


def test_compressed_pictures(few, lasercal, tmp_path):
    out = tmp_path / "out"
    bag = recorded(tmp_path, few, Session(compressed="png"), "sqlite3")
    assert lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane").status == 0
    assert_same(load_capture(out), few)


def test_sixteen_bits_in_either_byte_order(lasercal, tmp_path):
    deep = small_capture(tmp_path / "capture", 1, 2, bits=16)
    session = Session(encoding="mono16", big_endian=True, padding=6)
    out = tmp_path / "out"
    bag = recorded(tmp_path, deep, session, "ros1")
    assert lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane").status == 0
    assert_same(load_capture(out), deep)


def test_jpeg_is_taken_with_a_warning(few, lasercal, tmp_path):
    bag = recorded(tmp_path, few, Session(compressed="jpg"))
    outcome = lasercal("import", bag, "--dry-run", *FRAMES, "--plane", "1")
    assert outcome.status == 0
    assert "/camera/image_raw was compressed as JPEG" in outcome.err


def test_odd_image_topics_are_noted(few, lasercal, tmp_path):
    events = list(Session().events(few))
    images = [event for event in events if event[1] == IMAGES]
    halved = [
        (at, topic, kind, (stamp, np.ascontiguousarray(array[::2, ::2]), session))
        for at, topic, kind, (stamp, array, session) in images
    ]
    others = [event for event in events if event[1] != IMAGES]
    again = [(at + 1, *rest) for at, *rest in halved[:3]]
    bag = write_bag(tmp_path / "bag", "mcap", [*others, *halved, *again])
    outcome = lasercal("import", bag, "--dry-run", *FRAMES, "--plane", "1", "--laser-on")
    assert outcome.status == 0, outcome.err
    assert f"{IMAGES}: 3 pictures have the stamp of another one" in outcome.err
    assert "speaks of 160 x 120 pixels, the pictures of" in outcome.err
    assert "have 80 x 60: are they binned or cut?" in outcome.err
    changing = write_bag(tmp_path / "changing", "mcap", [*others, *images[:20], *halved[20:]])
    refused = lasercal("import", changing, "-o", tmp_path / "o", *FRAMES, "--plane", "1")
    assert refused.status == 1
    assert "is 80 x 60 pixels, those before have 160 x 120" in refused.err
    assert not any((tmp_path / "o").iterdir())


def test_two_cameras(few, lasercal, tmp_path):
    events = list(Session().events(few))
    events += [
        (at + 1, "/right/image_raw", kind, content)
        for at, topic, kind, content in events
        if topic == IMAGES and not START + 1_400_000_000 < content[0] < START + 2_800_000_000
    ]
    bag = write_bag(tmp_path / "bag", "mcap", events)
    out = tmp_path / "out"
    topics = ("--images", f"left={IMAGES}", "--images", "right=/right/image_raw")
    outcome = lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane", *topics)
    assert outcome.status == 0, outcome.err
    assert "1 stops have no picture of right: 2 (1.55 to 2.25 s)" in outcome.err
    found = load_capture(out)
    rows = ["001_left", "001_right", "002_left", "003_left", "003_right", "004_left", "004_right"]
    assert found.ids.tolist() == rows
    assert found.cameras.tolist() == [name.partition("_")[2] for name in rows]
    assert found.image_size == {"left": (160, 120), "right": (160, 120)}
    np.testing.assert_array_equal(found.T_base_hand[0], found.T_base_hand[1])
    unsaid = lasercal("import", bag, "--dry-run", *FRAMES, "--plane", "1")
    assert unsaid.status == 1
    assert "--images: give the image topic" in unsaid.err
    assert f"{IMAGES}, /right/image_raw" in unsaid.err


def test_in_python(few, tmp_path):
    bag_path = recorded(tmp_path, few, Session())
    with open_bag(bag_path) as bag:
        motion = bag.hand_motion("base_link", "tool0")
        cameras = [bag.pictures("/camera/image_raw")]
        plan = plan_capture(motion, cameras, OnePlane("table"))
        write_recording(tmp_path / "cell", plan, cameras)
    np.testing.assert_allclose(
        load_capture(tmp_path / "cell").T_base_hand, few.T_base_hand, rtol=0, atol=1e-14
    )
    with pytest.raises(DataError, match="the folder is not empty"):
        write_recording(tmp_path / "cell", plan, cameras)


# --- the laser ----------------------------------------------------------------------------------


def test_stops_without_an_off_picture_get_the_nearest_of_their_plane(few, lasercal, tmp_path):
    session = Session(always_on_at=(1,), always_off_at=(2,))
    bag = recorded(tmp_path, few, session)
    out = tmp_path / "out"
    outcome = lasercal("import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane")
    assert outcome.status == 0, outcome.err
    assert "1 stops have no laser-off picture of their own (stop 2)" in outcome.err
    assert "stop 3 (2.95 to 3.6" in outcome.out
    assert "no spot: its pictures are all alike" in outcome.out
    found = load_capture(out)
    assert found.ids.tolist() == ["001", "002", "004"]
    np.testing.assert_array_equal(picture(found.images_off[1]), picture(found.images_off[0]))
    story = json.loads((out / "recording.json").read_text())
    assert [row["off_of_same_stop"] for row in story["rows"]] == [True, False, True]


def test_laser_that_is_always_on(few, lasercal, tmp_path):
    bag = recorded(tmp_path, few, Session(off=False))
    seen = lasercal("import", bag, "-o", tmp_path / "a", *FRAMES, "--plane", "1")
    assert seen.status == 0
    assert "no picture without a spot was found: the laser is taken to be on" in seen.err
    told = lasercal("import", bag, "-o", tmp_path / "b", *FRAMES, "--plane", "1", "--laser-on")
    assert told.status == 0
    found = load_capture(tmp_path / "a")
    assert found.images_off == (None,) * len(few)
    for k in range(len(few)):
        np.testing.assert_array_equal(
            picture(found.images_on[k]), picture(load_capture(tmp_path / "b").images_on[k])
        )


# --- clocks, planes -----------------------------------------------------------------------------


def test_clocks_that_differ_are_noticed_and_can_be_set_right(few, lasercal, tmp_path):
    hour, minute = 3_600_000_000_000, 60_000_000_000
    bag = recorded(tmp_path, few, Session(image_shift_ns=hour))
    apart = lasercal("import", bag, "--dry-run", *FRAMES, "--plane", "1")
    assert apart.status == 1
    assert "do not overlap" in apart.err
    assert "59.9 min apart" in apart.err
    out = tmp_path / "out"
    right = lasercal(
        "import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane", "--image-offset", "-3600"
    )
    assert right.status == 0, right.err
    assert_same(load_capture(out), few)
    (tmp_path / "near").mkdir()
    near = recorded(tmp_path / "near", few, Session(image_shift_ns=-minute // 30))
    noted = lasercal("import", near, "--dry-run", *FRAMES, "--plane", "1")
    assert noted.status == 0
    assert "/camera/image_raw is received 2.03 s after its stamps, /tf 2 ms" in noted.err


def test_received_time_serves_where_stamps_are_wrong(few, lasercal, tmp_path):
    bag = recorded(tmp_path, few, Session(image_shift_ns=-10_000_000_000))
    out = tmp_path / "out"
    outcome = lasercal(
        "import", bag, "-o", out, *FRAMES, "--plane-topic", "/plane", "--stamps", "received"
    )
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(out), few)


def test_planes_by_intervals(bags, capture, lasercal, tmp_path):
    table = tmp_path / "planes.csv"
    table.write_text("start_s,end_s,plane\n0,5.5,table\n8.5,20,wedge\n")
    out = tmp_path / "out"
    outcome = lasercal("import", bags["mcap"], "-o", out, *FRAMES, "--planes", table)
    assert outcome.status == 0, outcome.err
    assert load_capture(out).planes.tolist() == ["table"] * 4 + ["wedge"] * 2
    assert outcome.out.count("no plane is said for it") == 2
    stamps = tmp_path / "stamps.csv"
    stamps.write_text("start_stamp,end_stamp,plane\n1699999999,1700000005.6,a\n,1700000100,b\n")
    wrong = lasercal("import", bags["mcap"], "--dry-run", *FRAMES, "--planes", stamps)
    assert wrong.status == 1
    assert "stamps.csv:3: start_stamp: expected seconds, got ''" in wrong.err


# --- what can be wrong --------------------------------------------------------------------------


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_cut_bag_says_how_to_mend_it(storage, share, bags, lasercal, tmp_path):
    whole = bags[storage]
    file = whole if whole.is_file() else next(p for p in whole.iterdir() if p.suffix != ".yaml")
    cut = tmp_path / file.name
    content = file.read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    outcome = lasercal("import", cut, "--dry-run", *FRAMES, "--plane", "1")
    assert outcome.status == 1
    assert f"{cut}: the bag cannot be read" in outcome.err
    mend = {"ros1": "rosbag reindex", "mcap": "mcap recover", "sqlite3": "ros2 bag reindex"}
    assert mend[storage] in outcome.err
    assert "Traceback" not in outcome.err


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_bag_without_metadata_is_read_all_the_same(storage, bags, capture, lasercal, tmp_path):
    file = next(p for p in bags[storage].iterdir() if p.suffix != ".yaml")
    (tmp_path / "bare").mkdir()
    copy = tmp_path / "bare" / file.name
    copy.write_bytes(file.read_bytes())
    for path in (copy, copy.parent):
        rows = lasercal.json("import", path, "--dry-run", *FRAMES, "--plane", "1")["rows"]
        np.testing.assert_allclose(
            [r["T_base_hand"] for r in rows], capture.T_base_hand, atol=1e-14
        )


def test_bag_in_two_parts(few, lasercal, tmp_path):
    events = list(Session().events(few))
    half = START + 2_500_000_000
    parts = [
        write_bag(tmp_path / name, "ros1", [e for e in events if (e[0] < half) == early])
        for name, early in (("one", True), ("two", False))
    ]
    out = tmp_path / "out"
    outcome = lasercal("import", *parts, "-o", out, *FRAMES, "--plane-topic", "/plane")
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(out), few)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--base", "base_lnk", "--hand", "tool0"], "did you mean 'base_link'?); the recording"),
        (["--base", "base_link", "--hand", "world"], "does not move in base_link"),
        ([*FRAMES, "--images", "/camera/image"], "did you mean '/camera/image_raw'"),
        ([*FRAMES, "--images", "/tf"], "topics that would do: /camera/image_raw"),
        ([*FRAMES, "--laser-topic", "/plane"], "expected std_msgs/msg/Bool"),
        (["--pose-topic", "/tf"], "none would do"),
        ([*FRAMES, "--still-s", "3"], "the hand never stands still"),
        ([*FRAMES, "--max-gap", "0.01"], "its poses come every 40 ms"),
        ([*FRAMES, "--images", "a/b=/camera/image_raw"], "may hold letters"),
    ],
)
def test_mistakes_are_named(args, words, bags, lasercal):
    outcome = lasercal("import", bags["mcap"], "--dry-run", "--plane", "1", *args)
    assert outcome.status == 1
    assert words in outcome.err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ([], "give -o/--output"),
        (["--dry-run", "--plane", "1"], "give --base and --hand"),
        (["--dry-run", *FRAMES], "give one of --plane, --planes"),
        (["--dry-run", "--poses", "p", "--plane", "1"], "none is assumed"),
        (["--dry-run", *FRAMES, "--plane", "1", "--laser-on", "--laser-topic", "/l"], "not both"),
    ],
)
def test_usage(args, words, bags, lasercal):
    outcome = lasercal("import", bags["mcap"], *args)
    assert outcome.status == 2
    assert words in outcome.err


def test_a_capture_is_not_overwritten_and_an_error_leaves_nothing(bags, lasercal, tmp_path):
    out = tmp_path / "out"
    args = ("import", bags["mcap"], "-o", out, *FRAMES, "--plane", "1", "--laser-on")
    assert lasercal(*args, "--images", "/nothing").status == 1
    assert not out.exists() or not any(out.iterdir())
    assert lasercal(*args).status == 0
    (out / "mine.txt").write_text("kept")
    again = lasercal(*args)
    assert again.status == 1
    assert "the folder is not empty" in again.err
    assert lasercal(*args, "--force").status == 0
    assert (out / "mine.txt").read_text() == "kept"
    load_capture(out)


def test_list_shows_topics_cameras_and_frames(bags, lasercal, tmp_path):
    outcome = lasercal("import", bags["sqlite3"], "--list")
    assert outcome.status == 0
    assert "  /camera/image_raw  sensor_msgs/msg/Image  108 messages" in outcome.out
    assert "K [137.5, 0.0, 79.5" in outcome.out
    assert "        flange (every 40 ms)\n          tool0 (static)" in outcome.out
    assert lasercal.json("import", bags["ros1"], "--list")["frames"][0] == "arm"
    nothing = lasercal("import", tmp_path, "--list")
    assert nothing.status == 1
    assert "this is no bag" in nothing.err


def test_without_rosbags_the_extra_is_named(bags, lasercal, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    outcome = lasercal("import", bags["mcap"], "--list")
    assert outcome.status == 1
    assert "pip install 'lasercal-gtsam[ros]'" in outcome.err
