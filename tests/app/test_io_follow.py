"""A capture that grows while it is followed: every row once, whatever happens to the files."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from detect_cases import ellipse

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import load_capture
from lasercal_gtsam.io.follow import BATCH, CaptureFollower, Notice
from lasercal_gtsam.io.follow_pictures import PATIENCE_S
from lasercal_gtsam.io.known_spots import KnownSpots
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.simulate.render import RenderOptions, make_scene, render_pair

HEAD = """\
lasercal: 1
camera: {name: camera, width: 160, height: 120}
poses: {file: poses.csv, transform: T_base_hand, length: mm, rotation: kuka}
"""
PATIENCE = int(PATIENCE_S / 0.5)  # looks
COLUMNS = "id,plane,x,y,z,a,b,c,u,v\n"
SHAPE = ellipse(2.2, 1.4, 0.4)
CLEAN = RenderOptions(highlights=0, ghost_probability=0.0)


def row(k: int, name: str | None = None) -> str:
    return f"{name or f's{k}'},table,{100 + 10 * k},2,3,4,5,6,{20 + k},{30 + k}\n"


class Watched:
    """A capture in a folder, and the one who follows it."""

    def __init__(self, folder: Path, head: str = "", known: KnownSpots | None = None) -> None:
        self.folder, self.poses = folder, folder / "poses.csv"
        (folder / "capture.yaml").write_text(HEAD + head)
        self.known = KnownSpots() if known is None else known
        self.start()

    def start(self, **options) -> None:
        self.now = 1000.0
        self.follower = CaptureFollower(self.folder, self.known, clock=lambda: self.now, **options)

    def append(self, text: str | bytes, name: str = "poses.csv") -> None:
        with (self.folder / name).open("ab") as file:
            file.write(text if isinstance(text, bytes) else text.encode())

    def poll(self) -> tuple[list[str], list[Notice]]:
        """Ids of new spots, and what was said, half a second later."""
        self.now += 0.5
        items = list(self.follower.poll())
        self.spots = [item for item in items if isinstance(item, Observations)]
        ids = [name for spots in self.spots for name in spots.id.tolist()]
        return ids, [item for item in items if isinstance(item, Notice)]

    def ids(self) -> list[str]:
        ids, notices = self.poll()
        assert notices == []
        return ids


@pytest.fixture
def watched(tmp_path: Path) -> Watched:
    return Watched(tmp_path)


def test_every_cut_of_the_file_gives_every_row_once(tmp_path: Path) -> None:
    text = (COLUMNS + "".join(row(k) for k in range(4)) + row(4).replace("\n", "\r\n")).encode()
    text = b"\xef\xbb\xbf" + text.replace(b"table", "Tür".encode())
    watched = Watched(tmp_path)
    (tmp_path / "all").mkdir()
    whole = Watched(tmp_path / "all")
    whole.append(text)
    expected = load_capture(tmp_path / "all").observations()
    for step in (1, 7, 50, 123):
        watched.poses.unlink(missing_ok=True)
        watched.known = KnownSpots()
        watched.start()
        found = []
        for at in range(0, len(text), step):
            watched.append(text[at : at + step])
            ids = watched.ids()
            found += watched.spots
            # a row is given as soon as its line has ended
            ended = text[: at + step].count(b"\n") - 1
            assert len(watched.known) == max(ended, 0), ids
        together = found[0]
        for spots in found[1:]:
            together = together + spots
        assert together == expected


def test_a_file_that_is_not_there_yet(watched: Watched) -> None:
    assert watched.ids() == []
    assert watched.follower.waiting == {"poses.csv": "the file is not there yet"}
    watched.append(COLUMNS)
    assert watched.ids() == []
    assert watched.follower.waiting == {}
    watched.append(row(1) + "s2,ta")
    assert watched.ids() == ["s1"]
    assert list(watched.follower.waiting) == ["poses.csv:3"]


def test_a_last_line_without_end_is_named_when_nothing_more_comes(watched: Watched) -> None:
    watched.append(COLUMNS + row(1) + row(2)[:-1])
    assert watched.ids() == ["s1"]
    said = [notice for _ in range(2 * PATIENCE) for notice in watched.poll()[1]]
    assert [(n.kind, n.words) for n in said] == [
        ("note", "poses.csv:3: the last line has no line end yet, and waits for it")
    ]
    watched.append("\n")
    assert watched.ids() == ["s2"]


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ("b,table,x1,2,3,4,5,6,20,30\n", r"poses\.csv:3: x: expected a number, got 'x1'"),
        ("b,table,100,2,3,4,5,6,20\n", r"poses\.csv:3: 9 cells, expected 10"),
        ("b,table,100,2,3,4,5,6,200,30\n", r"poses\.csv:3: u: 200 lies outside the picture"),
        (",table,1,2,3,4,5,6,20,30\n", r"poses\.csv:3: id: empty"),
        ('b,"ta"ble,1,2,3,4,5,6,20,30\n', r"poses\.csv:3: not a row of CSV"),
        (b"b,\xff,1,2,3,4,5,6,20,30\n", r"poses\.csv:3: byte 0xff is not UTF-8"),
    ],
)
def test_a_bad_row_is_named_once_and_does_not_stop_the_others(watched, bad, words) -> None:
    watched.append(COLUMNS + row(1))
    assert watched.ids() == ["s1"]
    watched.append(bad)
    watched.append(row(2))
    ids, (notice,) = watched.poll()
    assert ids == ["s2"]
    assert notice.kind == "wrong"
    assert re.match(words, notice.words)
    watched.append(row(3))
    assert watched.ids() == ["s3"]
    # looked at again when it is put right in its place
    lines = watched.poses.read_bytes().split(b"\n")
    lines[2] = row(4, "b").strip().encode()
    watched.poses.write_bytes(b"\n".join(lines))
    assert watched.ids() == ["b"]


def test_a_bad_row_put_right_by_a_later_line(watched: Watched) -> None:
    watched.append(COLUMNS + row(1).replace("110", "ten"))
    ids, notices = watched.poll()
    assert (ids, len(notices)) == ([], 1)
    watched.append(row(1))
    assert watched.ids() == ["s1"]
    # the same in one look, as after a restart before it was taken
    watched.known = KnownSpots()
    watched.start()
    ids, notices = watched.poll()
    assert (ids, len(notices)) == (["s1"], 1)


def test_a_changed_row_is_reported_and_not_used_twice(watched: Watched) -> None:
    watched.append(COLUMNS + row(1) + row(2))
    assert watched.ids() == ["s1", "s2"]
    watched.poses.write_text(COLUMNS + row(1) + row(2).replace("22,32", "23,32") + row(3))
    ids, (notice,) = watched.poll()
    assert ids == ["s3"]
    assert (notice.kind, notice.id) == ("changed", "s2")
    assert notice.words.startswith("poses.csv:3: id 's2': other values, but this spot is in use")
    assert watched.poll() == ([], [])
    # written another way, but the same numbers
    watched.poses.write_text(
        COLUMNS + row(1).replace("110,", "110.00, ") + row(2).replace("22", "2.2e1") + row(3)
    )
    assert watched.ids() == []


def test_the_same_id_in_a_later_line(watched: Watched) -> None:
    watched.append(COLUMNS + row(1) + row(2) + row(5, "s1") + row(2))
    ids, (notice,) = watched.poll()
    assert ids == ["s1", "s2"]
    assert notice.words.startswith("poses.csv:4: id 's1': other values")


@pytest.mark.parametrize("way", ["renamed over", "cut and written anew", "rotated", "reordered"])
def test_a_file_that_is_replaced(watched: Watched, way: str) -> None:
    watched.append(COLUMNS + "".join(row(k) for k in range(1, 6)))
    assert len(watched.ids()) == 5
    if way == "renamed over":
        other = watched.folder / "other"
        other.write_text(COLUMNS + "".join(row(k) for k in range(1, 7)))
        other.replace(watched.poses)
        expected = ["s6"]
    elif way == "cut and written anew":
        watched.poses.write_text(COLUMNS + row(7) + row(2))
        expected = ["s7"]
    elif way == "rotated":
        watched.poses.rename(watched.folder / "poses.csv.1")
        assert watched.ids() == []
        watched.append(COLUMNS + row(8))
        expected = ["s8"]
    else:
        header = "v,u,c,b,a,z,y,x,plane,id\n"
        lines = [",".join(reversed(row(k).strip().split(","))) for k in (3, 1, 9)]
        watched.poses.write_text(header + "\n".join(lines) + "\n")
        expected = ["s9"]
    assert watched.ids() == expected
    assert watched.ids() == []


def test_growth_costs_the_same_however_long_the_file(watched: Watched, monkeypatch) -> None:
    watched.append(COLUMNS + "".join(row(k % 90, f"n{k}") for k in range(3000)))
    spots = [s for s in watched.follower.poll() if isinstance(s, Observations)]
    assert [len(s) for s in spots] == [BATCH] * 11 + [3000 - 11 * BATCH]
    size = watched.poses.stat().st_size
    read = []
    really = Path.open

    def counted(self, *args, **kwargs):
        file = really(self, *args, **kwargs)
        inner = file.read
        if self == watched.poses and args == ("rb",):
            file = _Counted(file, lambda n=-1: read.append(len(got := inner(n))) or got)
        return file

    monkeypatch.setattr(Path, "open", counted)
    watched.append(row(1))
    assert watched.ids() == ["s1"]
    assert 0 < sum(read) < 5000 < size


class _Counted:
    def __init__(self, file, read) -> None:
        self.file, self.read, self.seek = file, read, file.seek

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()


def test_a_restart_takes_only_what_is_new(watched: Watched) -> None:
    watched.append(COLUMNS + row(1) + row(2))
    watched.ids()
    watched.append(row(3))
    watched.start()
    assert watched.ids() == ["s3"]
    watched.start()
    watched.poses.write_text(COLUMNS + row(1).replace("21,31", "21,32") + row(2) + row(3))
    ids, (notice,) = watched.poll()
    assert (ids, notice.kind, notice.id) == ([], "changed", "s1")


def test_prefix_and_stated_noise(watched: Watched) -> None:
    watched.append(COLUMNS + row(1))
    watched.start(prefix="monday-", sigma_px=0.5)
    assert watched.ids() == ["monday-s1"]
    np.testing.assert_array_equal(watched.spots[0].cov_uv, [0.25 * np.eye(2)])
    watched.start(prefix="monday-", sigma_px=0.5)
    assert watched.ids() == []
    watched.start(prefix="tuesday-")
    assert watched.ids() == ["tuesday-s1"]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("id,plane,x,y,z,a,b,u,v\n", "poses.csv: column c missing, needed by rotation kuka"),
        ("id;plane;x;y;z;a;b;c;u;v\n", "poses.csv:1: the columns are separated by semicolons"),
        ("id,plane,x,y,z,a,b,c\n", "capture.yaml: there are no spots"),
        ("plane,x,y,z,a,b,c,u,v\n", "poses.csv: column id missing"),
    ],
)
def test_wrong_columns_are_said_and_a_better_file_is_taken(watched, columns, words) -> None:
    watched.append(columns + row(1))
    ids, (notice,) = watched.poll()
    assert (ids, notice.kind) == ([], "file")
    assert notice.words.startswith(words)
    assert watched.ids() == []
    watched.poses.write_text(COLUMNS + row(1))
    assert watched.ids() == ["s1"]


def test_a_changed_head_is_said(watched: Watched) -> None:
    watched.append(COLUMNS)
    watched.ids()
    head = watched.folder / "capture.yaml"
    os.utime(head, ns=(1, 1))
    assert watched.ids() == []  # only touched
    head.write_text(HEAD + "noise: {pixel: 1}\n")
    assert [n.words for n in watched.poll()[1]] == [
        "capture.yaml has changed, which counts from the next start on"
    ]
    assert watched.ids() == []


# --- spots in a table of their own --------------------------------------------------------------


def test_spots_and_poses_may_come_in_any_order(tmp_path: Path) -> None:
    watched = Watched(tmp_path, "spots: {file: spots.csv}\n")
    watched.append("id,plane,x,y,z,a,b,c\ns1,t,100,2,3,4,5,6\ns2,t,100,2,3,4,5,6\n")
    assert watched.ids() == []
    assert watched.follower.waiting["s1"] == "there is no pixel u, v for it yet"
    watched.append("id,u,v,verdict\ns3,7,8,\n", "spots.csv")
    watched.ids()
    watched.append("s2,9,9,used\n", "spots.csv")
    assert watched.ids() == ["s2"]
    assert watched.follower.waiting["s3"] == "it has no row in poses.csv yet"
    watched.append("s3,t,100,2,3,4,5,7\n")
    assert watched.ids() == ["s3"]
    watched.append("s1,,,no-spot\n", "spots.csv")
    ids, (notice,) = watched.poll()
    assert (ids, notice.kind) == ([], "skipped")
    assert notice.words == "id s1: no-spot: verdict in spots.csv"
    # corrected by hand: the table is written anew
    text = (tmp_path / "spots.csv").read_text().replace("s1,,,no-spot", "s1,5,5,used")
    (tmp_path / "spots.csv").write_text(text)
    assert watched.ids() == ["s1"]
    (tmp_path / "spots.csv").write_text(text.replace("s2,9,9", "s2,9,10"))
    ids, (notice,) = watched.poll()
    assert (ids, notice.kind, notice.id) == ([], "changed", "s2")
    # a spot that was used cannot be taken back by its verdict alone
    (tmp_path / "spots.csv").write_text(text.replace("s2,9,9,used", "s2,9,9,reflection"))
    ids, (notice,) = watched.poll()
    assert (ids, notice.kind, notice.id) == ([], "changed", "s2")


# --- pictures -----------------------------------------------------------------------------------


def pictures(count: int, options: RenderOptions = CLEAN) -> Iterator[tuple[bytes, bytes, tuple]]:
    """PNG files with laser on and off, and where the spot is."""
    rng = np.random.default_rng(3)
    scene = make_scene((160, 120), options, rng)
    for _ in range(count):
        uv = rng.uniform((20, 20), (140, 100))
        on, off = render_pair(uv, SHAPE, scene, options, rng)[:2]
        yield cv2.imencode(".png", on)[1].tobytes(), cv2.imencode(".png", off)[1].tobytes(), uv


def pose(k: int) -> str:
    return f"s{k},table,{100 + 10 * k},2,3,4,5,6\n"


POSES = "id,plane,x,y,z,a,b,c\n"


def test_a_picture_is_taken_when_it_is_whole(tmp_path: Path) -> None:
    watched = Watched(tmp_path, 'images: {on: "{id}.png", off: "{id}-off.png"}\n')
    (on, off, uv), (on2, off2, uv2) = pictures(2)
    watched.append(POSES + pose(1) + pose(2))
    assert watched.ids() == []
    assert watched.follower.waiting["s1"].endswith("s1.png is not there yet")
    (tmp_path / "s2.png").write_bytes(on2)
    (tmp_path / "s2-off.png").write_bytes(off2)
    (tmp_path / "s1.png").write_bytes(on[:500])
    assert watched.ids() == []
    assert "still being written" in watched.follower.waiting["s2"]
    assert watched.ids() == ["s2"]  # the others go on
    assert np.hypot(*(watched.spots[0].uv[0] - uv2)) < 0.5
    for cut in (1000, len(on) // 2):  # grows, and pauses
        (tmp_path / "s1.png").write_bytes(on[:cut])
        assert watched.ids() == []
        assert watched.ids() == []
    (tmp_path / "s1.png").write_bytes(on)
    assert watched.ids() == []
    watched.ids()
    assert watched.follower.waiting["s1"].endswith("s1-off.png is not there yet")
    (tmp_path / "s1-off.png").write_bytes(off)
    watched.ids()
    assert watched.ids() == ["s1"]
    assert np.hypot(*(watched.spots[0].uv[0] - uv)) < 0.5
    assert watched.follower.waiting == {}


def test_the_background_is_taken_where_no_laser_off_picture_comes(tmp_path: Path) -> None:
    head = 'images: {on: "{id}.png", off: "{id}-off.png", background: dark.png}\n'
    watched = Watched(tmp_path, head)
    ((on, off, _),) = pictures(1)
    watched.append(POSES + pose(1))
    (tmp_path / "dark.png").write_bytes(off)
    for _ in range(3 * PATIENCE):  # the laser-on picture takes its time
        assert watched.ids() == []
    (tmp_path / "s1.png").write_bytes(on)
    assert [watched.ids() for _ in range(PATIENCE)] == [[]] * PATIENCE
    assert "s1-off.png is not there yet" in watched.follower.waiting["s1"]
    assert [name for _ in range(4) for name in watched.ids()] == ["s1"]


def test_a_picture_that_stays_bad_is_named_and_looked_at_again(tmp_path: Path) -> None:
    watched = Watched(tmp_path, 'images: {on: "{id}.png", background: dark.png}\n')
    ((on, off, _),) = pictures(1)
    watched.append(POSES + pose(1))
    (tmp_path / "dark.png").write_bytes(off)
    (tmp_path / "s1.png").write_bytes(on[:-30])
    said = [notice for _ in range(PATIENCE) for notice in watched.poll()[1]]
    assert said == []
    said = [notice for _ in range(5) for notice in watched.poll()[1]]
    assert [n.kind for n in said] == ["wrong"]
    assert "cut off" in said[0].words
    assert said[0].words.startswith("id s1: ")
    # the dark picture itself: no spot in it
    (tmp_path / "s1.png").write_bytes(off)
    said = [notice for _ in range(3) for notice in watched.poll()[1]]
    assert [n.kind for n in said] == ["skipped"]
    (tmp_path / "s1.png").write_bytes(on)
    assert [watched.ids() for _ in range(2)] == [[], ["s1"]]


def test_an_old_picture_needs_no_second_look(tmp_path: Path) -> None:
    watched = Watched(tmp_path, 'images: {on: "{id}.png", off: "{id}-off.png"}\n')
    ((on, off, _),) = pictures(1)
    watched.append(POSES + pose(1) + pose(2))
    for name, content in (("s1", on), ("s1-off", off), ("s2", on[:900]), ("s2-off", off)):
        (tmp_path / f"{name}.png").write_bytes(content)
        os.utime(tmp_path / f"{name}.png", times=(time.time() - 60,) * 2)
    ids, (notice,) = watched.poll()
    assert ids == ["s1"]
    assert "cut off" in notice.words


def test_without_laser_off_pictures_five_are_needed(tmp_path: Path) -> None:
    options = RenderOptions(highlights=3, ghost_probability=0.0)
    shots = list(pictures(8, options))
    watched = Watched(tmp_path, 'images: "{id}.png"\n')
    watched.append(POSES + "".join(pose(k) for k in range(8)))
    for k in range(4):
        (tmp_path / f"s{k}.png").write_bytes(shots[k][0])
    watched.ids()
    assert watched.ids() == []
    assert watched.follower.waiting["s0"] == (
        "there is no laser-off picture; 5 laser-on pictures of camera 'camera', plane 'table' can "
        "make one, and there are fewer yet"
    )
    (tmp_path / "s4.png").write_bytes(shots[4][0])
    watched.ids()
    notices = watched.poll()[1]
    assert watched.follower.soon
    found = watched.spots
    notices += watched.poll()[1]
    found += watched.spots
    assert {str(spots.id[0]) for spots in found} <= {"s0", "s1", "s2", "s3", "s4"}
    assert len(found) >= 4
    assert notices[0].kind == "note"
    assert "the median of 5 laser-on pictures stands in" in notices[0].words
    for spots in found:
        k = int(spots.id[0][1:])
        assert np.hypot(*(spots.uv[0] - shots[k][2])) < 0.6
    # after a restart the pictures of the spots taken before are still part of it
    watched.start()
    (tmp_path / "s5.png").write_bytes(shots[5][0])
    found = [watched.poll()[0] for _ in range(3)]
    assert ["s5"] in found


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ('"*.png"', "by their order"),
        ('"{name}.png"', "unknown placeholder {name}"),
        ('{on: "{id}.png", off: dark.png}', "images.off: 'dark.png' gives pictures to rows"),
    ],
)
def test_patterns_that_cannot_be_followed(tmp_path: Path, pattern: str, words: str) -> None:
    with pytest.raises(DataError, match=re.escape(words)):
        Watched(tmp_path, f"images: {pattern}\n")


def test_known_spots_tell_the_same_from_another() -> None:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.1, 0.2, 0.3]
    cov = np.array([[[1.0, 0.2], [0.2, 2.0]]] * 2 + [[[np.nan] * 2] * 2])
    spots = Observations.from_arrays(
        np.arange(6.0).reshape(3, 2), T, plane="1", image_size=(160, 120), cov_uv=cov
    )
    known = KnownSpots()
    known.add(spots, "here")
    assert known.same(spots) == [True] * 3
    changes = {
        "uv": spots.uv + 1e-3,
        "cov_uv": cov * 1.01,
        "T_base_hand": T + np.pad(np.full((3, 3, 1), 1e-6), ((0, 0), (0, 1), (3, 0))),
        "plane": ["2"] * 3,
    }
    for name, value in changes.items():
        fields = {n: getattr(spots, n) for n in spots.__dataclass_fields__} | {name: value}
        same = known.same(Observations(**fields))
        assert same == ([False, False, True] if name == "cov_uv" else [False] * 3), name
    # the last digits may differ after another way through a file
    fields = {n: getattr(spots, n) for n in spots.__dataclass_fields__}
    fields |= {"uv": spots.uv * (1 + 1e-15), "cov_uv": cov * (1 - 1e-15)}
    assert known.same(Observations(**fields)) == [True] * 3
