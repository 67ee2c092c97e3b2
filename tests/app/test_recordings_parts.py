"""Motion, stops, frames, laser states and image encodings, each against an independent answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import pytest
from recording_cases import MS, START
from scipy.spatial.transform import Rotation, Slerp

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.recordings.encodings import (
    ENCODINGS,
    picture_from_compressed,
    picture_from_raw,
)
from lasercal_gtsam.recordings.laser import OFF, ON, UNKNOWN, most_central, spot_appears, states_of
from lasercal_gtsam.recordings.motion import Motion, PoseSeries, chain, pose_series
from lasercal_gtsam.recordings.plan import plan_capture
from lasercal_gtsam.recordings.planes import OnePlane
from lasercal_gtsam.recordings.stamps import (
    as_stamps,
    duration_text,
    ns_from_integer,
    ns_from_seconds,
    seconds_text,
)
from lasercal_gtsam.recordings.stops import StillLimits, find_stops, stops_of_pictures
from lasercal_gtsam.recordings.tree import TransformTree

GAP = 100 * MS


def random_series(rng: np.random.Generator, count: int = 20, every: int = 50 * MS) -> PoseSeries:
    stamps = START + every * np.arange(count)
    return pose_series(
        "hand",
        stamps,
        rng.uniform(-1, 1, (count, 3)),
        Rotation.random(count, rng=rng).as_quat(),
        "quat_xyzw",
    )


def test_poses_between_stamps_are_those_of_scipy():
    rng = np.random.default_rng(1)
    series = random_series(rng)
    asked = np.sort(rng.integers(series.stamps[0], series.stamps[-1], 50))
    T, known = series.at(asked, GAP)
    seconds = (series.stamps - START) / 1e9
    rotations = Rotation.from_matrix(series.T[:, :3, :3])
    expected = Slerp(seconds, rotations)((asked - START) / 1e9).as_matrix()
    assert known.all()
    np.testing.assert_allclose(T[:, :3, :3], expected, atol=1e-12)
    for axis in range(3):
        line = np.interp((asked - START) / 1e9, seconds, series.T[:, axis, 3])
        np.testing.assert_allclose(T[:, axis, 3], line, atol=1e-12)


def test_poses_at_stamps_are_exact_and_nothing_is_extrapolated():
    series = random_series(np.random.default_rng(2))
    T, known = series.at(series.stamps, 1)  # a gap of any length does not matter at a pose
    assert known.all()
    np.testing.assert_array_equal(T, series.T)
    ends = np.array([series.stamps[0] - 1, series.stamps[-1] + 1])
    assert not series.at(ends, 10**18)[1].any()
    assert not series.at(series.stamps[:-1] + 1, 49 * MS)[1].any()
    assert series.at(series.stamps[:-1] + 1, 50 * MS)[1].all()


def test_runs_are_cut_at_gaps_of_any_link():
    a = PoseSeries("a", [0, 10, 20, 100, 110], np.tile(np.eye(4), (5, 1, 1)))
    b = PoseSeries("b", [5, 15, 25, 95, 105, 108], np.tile(np.eye(4), (6, 1, 1)))
    motion = Motion("base", "hand", ((a, False), (b, True)))
    assert motion.span == (5, 108)
    assert motion.runs(20) == [(5, 20), (100, 108)]
    assert motion.runs(1000) == [(5, 108)]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stamps": [0, 2_000_000_000, 0]}, "the clock jumps back by 2 s"),
        ({"quaternion": [[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 1]]}, "quaternion of norm 0"),
        ({"position_m": [[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]}, "is not finite"),
    ],
)
def test_bad_poses_are_refused(change, words):
    good = {
        "stamps": [0, 1, 2],
        "position_m": np.zeros((3, 3)),
        "quaternion": [[0, 0, 0, 1]] * 3,
        **change,
    }
    arrays = {name: np.asarray(value) for name, value in good.items()}
    with pytest.raises(DataError, match=words):
        pose_series("hand", order="quat_xyzw", **arrays)


def test_repeated_and_overtaking_poses():
    position = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 0, 0], [9, 0, 0]], float)
    quaternion = np.tile([1.0, 0, 0, 0], (5, 1))
    series = pose_series("p", np.array([0, 2, 1, 1, 2]), position, quaternion, "quat_wxyz")
    assert series.stamps.tolist() == [0, 1, 2]
    assert series.T[:, 0, 3].tolist() == [0, 1, 2]
    assert len(series.notes) == 1
    assert "1 poses have the stamp of another one" in series.notes[0]


# --- stops --------------------------------------------------------------------------------------


def moving_along_x(x_m: np.ndarray, every: int = 10 * MS) -> Motion:
    T = np.tile(np.eye(4), (len(x_m), 1, 1))
    T[:, 0, 3] = x_m
    series = PoseSeries("hand", START + every * np.arange(len(x_m)), T)
    return chain("base", "hand", [(series, False)])


def test_stops_end_half_a_window_before_motion():
    t = np.arange(300) * 0.01
    x = np.where(t < 1.0, 0.0, np.where(t < 2.0, 0.1 * (t - 1.0), 0.1))
    stops = find_stops(moving_along_x(x), StillLimits())
    times = [((s.first - START) / 1e9, (s.last - START) / 1e9) for s in stops]
    # 0.1 m/s, limit 0.2 mm: still until 2 ms after motion began, with half a window of 0.15 s
    np.testing.assert_allclose(times, [(0.15, 0.85), (2.15, 2.84)], atol=0.011)


def test_hours_are_sampled_piece_by_piece(monkeypatch):
    rng = np.random.default_rng(8)
    steps = np.repeat(rng.uniform(-0.1, 0.1, 40), 60)
    motion = moving_along_x(steps + 2e-5 * rng.uniform(-1, 1, len(steps)))
    whole = find_stops(motion, StillLimits())
    assert len(whole) == 40
    monkeypatch.setattr("lasercal_gtsam.recordings.stops._CHUNK", 37)
    assert find_stops(motion, StillLimits()) == whole


def test_turning_is_motion_too():
    angle = np.where(np.arange(200) < 100, 0.0, 1e-4 * (np.arange(200) - 100))  # 0.01 rad/s
    T = np.tile(np.eye(4), (200, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0.6, 0, 0.8])).as_matrix()
    motion = chain("b", "h", [(PoseSeries("h", START + 10 * MS * np.arange(200), T), False)])
    (stop,) = find_stops(motion, StillLimits())
    # 0.05 deg = 0.87 mrad are turned after 0.087 s
    assert (stop.last - START) / 1e9 == pytest.approx(1.0 - 0.15 + 0.087, abs=0.02)
    # a window within which it turns by 0.3 * 0.01 rad = 0.172 deg is still with a wider limit
    (all_of_it,) = find_stops(motion, StillLimits(turn_rad=np.deg2rad(0.175)))
    assert all_of_it.last - all_of_it.first > 1.6e9
    turning = PoseSeries("h", START + 10 * MS * np.arange(99), T[101:])
    with pytest.raises(DataError, match=r"0\.172 deg"):
        find_stops(chain("b", "h", [(turning, False)]), StillLimits())


def test_a_stale_stamp_does_not_cost_memory():
    rest = moving_along_x(np.r_[np.zeros(100), 0.01 * np.arange(50)])
    series = rest.links[0][0]
    old = PoseSeries("hand", np.r_[0, series.stamps], np.r_[series.T[:1], series.T])
    assert find_stops(chain("b", "h", [(old, False)]), StillLimits()) == find_stops(
        rest, StillLimits()
    )


def test_every_picture_mode_joins_pictures_of_one_pose():
    motion = moving_along_x(np.array([0.0, 0.0, 0.1, 0.1, 0.1, 0.0]), every=10**9)
    stamps = motion.links[0][0].stamps
    stops = stops_of_pictures(motion, stamps, StillLimits())
    assert [(s.first - START, s.last - START) for s in stops] == [
        (0, 10**9),
        (2 * 10**9, 4 * 10**9),
        (5 * 10**9, 5 * 10**9),
    ]


class CountedSource:
    """A camera whose pictures are made when asked for: on in the first half of each second."""

    camera, name = "camera", "counted"

    def __init__(self, count: int, every: int) -> None:
        self.stamps = as_stamps(START + every * np.arange(count))
        self.reads: list[int] = []

    def read(self, which: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        self.reads.append(len(which))
        for k in which:
            lit = (self.stamps[k] - START) % 1_000_000_000 < 500_000_000
            yield k, scene(80 if lit else 0, seed=k)


def test_long_stops_are_sampled_not_loaded():
    t = np.arange(400) * 0.01
    motion = moving_along_x(np.where(t < 2.0, 0.0, 0.1 * (t - 2.0)))
    source = CountedSource(800, 5 * MS)
    progress: list[tuple[int, int]] = []
    plan = plan_capture(
        motion, [source], OnePlane("table"), progress=lambda *done: progress.append(done)
    )
    assert source.reads == [9]
    assert progress == [(1, 1)]
    (shot,) = plan.shots
    assert shot.n_pictures == pytest.approx(340, abs=4)  # 0.15 to 1.85 s at 200 Hz
    assert (shot.stamp - START) % 1_000_000_000 < 500_000_000
    assert (shot.off_stamp - START) % 1_000_000_000 >= 500_000_000


def test_pictures_without_a_pose_are_counted():
    motion = moving_along_x(np.array([0.0, 0.1, 0.2]), every=10**9)
    source = CountedSource(5, 10**9)
    plan = plan_capture(motion, [source], OnePlane("a"), every_picture=True, laser="on")
    assert [shot.stamp for shot in plan.shots] == source.stamps[:3].tolist()
    assert plan.notes[-1].startswith("2 pictures are left out: the hand's pose is not known")
    assert source.reads == []


# --- frames -------------------------------------------------------------------------------------


def random_pose(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.uniform(-1, 1, 3)
    return T


def add(tree: TransformTree, parent: str, child: str, poses: list, static: bool = False) -> None:
    for k, T in enumerate(poses):
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
        tree.add(parent, child, START + 20 * MS * k, T[:3, 3], quaternion, static=static)


def test_motion_through_a_branch_of_the_tree():
    rng = np.random.default_rng(5)
    up, side, first, second = (random_pose(rng) for _ in range(4))
    tree = TransformTree()
    add(tree, "/world", "/base_link", [up], static=True)
    add(tree, "world", "cart", [first, second])
    add(tree, "cart", "tool0", [side], static=True)
    motion = tree.motion("base_link", "/tool0")
    T, known = motion.at(np.array([START, START + 20 * MS]), GAP)
    assert known.all()
    for found, cart in zip(T, (first, second), strict=True):
        np.testing.assert_allclose(found, np.linalg.inv(up) @ cart @ side, atol=1e-14)


def test_a_joint_that_never_moves_needs_no_more_than_one_message():
    rng = np.random.default_rng(6)
    still, first, second = (random_pose(rng) for _ in range(3))
    tree = TransformTree()
    add(tree, "base", "arm", [still])
    add(tree, "arm", "hand", [first, second])
    T, _ = tree.motion("base", "hand").at(np.array([START + 20 * MS]), GAP)
    np.testing.assert_allclose(T[0], still @ second, atol=1e-14)


@pytest.mark.parametrize(
    ("edges", "words"),
    [
        ([("base", "a", 1), ("b", "hand", 2)], "no chain of transforms leads from 'base'"),
        ([("base", "hand", 2), ("other", "hand", 2)], "'hand' has 2 parents, base, other"),
        ([("base", "hand", 1)], "hand does not move in base"),
        ([("base", "hand", -2)], "this static transform changes"),
        ([("base", "hand", 2), ("hand", "base", 2)], "in a circle"),
    ],
)
def test_trees_that_cannot_be_followed(edges, words):
    rng = np.random.default_rng(7)
    tree = TransformTree()
    for parent, child, count in edges:
        poses = [random_pose(rng) for _ in range(abs(count))]
        add(tree, parent, child, poses, static=count < 0)
    with pytest.raises(DataError, match=words):
        tree.motion("base", "hand")


# --- the laser ----------------------------------------------------------------------------------


def scene(light: float, *, seed: int, blob: tuple[float, float] = (60, 40)) -> np.ndarray:
    """A textured picture with a spot of that height."""
    v, u = np.mgrid[:90, :120]
    ground = 60 + 20 * np.sin(u / 7) * np.cos(v / 9)
    spot = light * np.exp(-((u - blob[0]) ** 2 + (v - blob[1]) ** 2) / 8.0)
    noise = np.random.default_rng(seed).standard_normal(ground.shape)
    return np.clip(np.rint(ground + spot + 0.8 * noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("lights", "expected"),
    [
        ([80, 80, 80, 0, 0], [ON, ON, ON, OFF, OFF]),
        ([0, 0, 40, 80, 80], [OFF, OFF, UNKNOWN, ON, ON]),
        ([40, 80, 80, 0, 0], [UNKNOWN, ON, ON, OFF, OFF]),
        ([15, 15, 7, 0, 0], [ON, ON, UNKNOWN, OFF, OFF]),  # half lit, hardly above the noise
    ],
)
@pytest.mark.parametrize("colour", [False, True])
def test_on_and_off_are_told_apart(lights, expected, colour):
    pictures = [scene(light, seed=k) for k, light in enumerate(lights)]
    if colour:  # a red laser
        dark = [scene(0, seed=10 + k) for k in range(len(lights))]
        pictures = [np.dstack([d, d, p]) for d, p in zip(dark, pictures, strict=True)]
    seen = states_of(pictures)
    assert not seen.uniform
    assert seen.state.tolist() == expected


def test_pictures_that_are_all_alike_and_pictures_with_a_passer_by():
    assert states_of([scene(80, seed=k) for k in range(4)]).uniform
    assert states_of([scene(0, seed=0)]).uniform
    walker = scene(0, seed=3).copy()
    walker[20:80, 10:30] += 60
    walker[20:80, 80:100] -= 35
    seen = states_of([scene(0, seed=0), scene(80, seed=1), walker])
    assert seen.state.tolist() == [OFF, ON, UNKNOWN]
    first = states_of([walker, scene(0, seed=0), scene(80, seed=1), scene(80, seed=2)])
    assert first.state.tolist() == [UNKNOWN, OFF, ON, ON]
    alike = states_of([walker, scene(80, seed=0), scene(80, seed=1), scene(80, seed=2)])
    assert alike.uniform
    assert alike.state.tolist() == [UNKNOWN, ON, ON, ON]
    assert spot_appears(scene(80, seed=1), scene(0, seed=2)) is True
    assert spot_appears(scene(0, seed=1), scene(80, seed=2)) is False
    assert spot_appears(scene(0, seed=1), scene(0, seed=2)) is False
    assert spot_appears(walker, scene(0, seed=2)) is None


def test_most_central_picture():
    stamps = np.array([10, 20, 30, 40, 50])
    on = np.array([True, True, True, False, True])
    assert most_central(stamps, on, 0, 60) == 1  # as far from 40 as from the beginning
    assert most_central(stamps, on, 9, 60) == 1
    assert most_central(stamps, ~on, 0, 60) == 3
    assert most_central(stamps, on & ~on, 0, 60) is None


# --- encodings ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mono8", "mono16", "bgr8", "rgb8", "rgba8", "bgra8", "rgb16"])
@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("big_endian", [False, True])
def test_raw_encodings(name, padding, big_endian):
    rng = np.random.default_rng(0)
    form = ENCODINGS[name]
    shape = (7, 11) if form.channels == 1 else (7, 11, form.channels)
    pixels = rng.integers(0, 2**form.bits, shape, dtype=np.uint16)
    stored = pixels.astype({8: "u1", 16: ">u2" if big_endian else "<u2"}[form.bits])
    rows = [row.tobytes() + b"\xaa" * padding for row in stored]
    data = b"".join(rows)
    for cut in (0, padding):  # some drivers leave out the padding of the last row
        found = picture_from_raw(
            data[: len(data) - cut],
            height=7,
            width=11,
            step=len(rows[0]),
            encoding=name,
            big_endian=big_endian,
        )
        expected = pixels if form.channels == 1 else pixels[..., :3]
        if name.startswith("rgb"):
            expected = expected[..., ::-1]
        assert found.dtype == (np.uint8 if form.bits == 8 else np.uint16)
        assert found.flags.c_contiguous
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_patterns_give_the_colour_they_were_made_of(pattern, bits):
    colour = {"r": 200, "g": 120, "b": 40}
    kind = np.uint8 if bits == 8 else np.dtype("<u2")
    tile = np.array(
        [[colour[pattern[0]], colour[pattern[1]]], [colour[pattern[2]], colour[pattern[3]]]]
    )
    mosaic = np.tile(tile, (6, 8)).astype(kind)
    found = picture_from_raw(
        mosaic.tobytes(),
        height=12,
        width=16,
        step=16 * bits // 8,
        encoding=f"bayer_{pattern}{bits}",
        big_endian=False,
    )
    assert (found == [40, 120, 200]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"encoding": "mono9"}, "did you mean 'mono8'"),
        ({"encoding": "32FC1"}, "cannot be read"),
        ({"step": 3}, "in rows of 3 are no 4 x 2 picture"),
        ({"height": 3}, "8 bytes in rows of 4 are no 4 x 3 picture"),
        ({"height": 0}, "are no 4 x 0 picture"),
    ],
)
def test_images_that_cannot_be(change, words):
    fields = {"height": 2, "width": 4, "step": 4, "encoding": "mono8", "big_endian": False}
    with pytest.raises(DataError, match=words):
        picture_from_raw(bytes(8), **{**fields, **change})


def test_compressed_pictures_are_decoded_or_refused():
    picture = scene(50, seed=1)
    content = cv2.imencode(".png", picture)[1].tobytes()
    np.testing.assert_array_equal(picture_from_compressed(content, "png"), picture)
    with pytest.raises(DataError, match="cut off"):
        picture_from_compressed(content[:-40], "mono8; png compressed")
    jpeg = cv2.imencode(".jpg", np.dstack([picture] * 3))[1].tobytes()
    assert picture_from_compressed(jpeg, "jpeg").shape == (90, 120, 3)


# --- stamps -------------------------------------------------------------------------------------


def test_stamps_keep_every_digit():
    assert ns_from_seconds("1403636579.763555584") == 1403636579763555584
    assert ns_from_seconds("1e3") == 10**12
    assert ns_from_seconds("nan") is None
    assert ns_from_seconds("1_0") is None
    assert seconds_text(1403636579003555584) == "1403636579.003555584"
    assert seconds_text(-1_500_000_000) == "-1.500000000"
    assert [duration_text(x * 1e9) for x in (0.0305, 1.5, 600, 9000)] == [
        "30.5 ms",
        "1.5 s",
        "10 min",
        "2.5 h",
    ]


def test_stamps_that_no_clock_shows_are_none():
    assert ns_from_integer(str(2**63 - 1)) == 2**63 - 1
    assert ns_from_integer(str(2**63)) is None
    assert ns_from_integer("9" * 5000) is None
    assert ns_from_seconds("1e30") is None
    assert ns_from_seconds("-1e400") is None
    assert ns_from_seconds("9223372036.5") == 9223372036500000000
