"""Captures with laser-on pictures only: when their median may stand in for the off frame."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from detect_cases import ellipse

from lasercal_gtsam.detect import detect_spot, median_frame, spots_in_median
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.capture import Capture, load_capture
from lasercal_gtsam.io.stand_in import evenly
from lasercal_gtsam.simulate.render import RenderOptions, make_scene, render_pair

SIZE = (160, 120)
MIDDLE = np.array([80.0, 60.0])
SHAPE = ellipse(2.2, 1.4, 0.4)
HEAD = """\
lasercal: 1
camera: {name: camera, width: 160, height: 120}
poses: {file: poses.csv, transform: T_base_hand, length: mm, rotation: kuka}
images: {on: "{id}.png"}
"""
CLEAN = RenderOptions(highlights=0, ghost_probability=0.0)
BRIGHT = RenderOptions(highlights=3, ghost_probability=0.0)


def shots(places: Array, options: RenderOptions, seed: int = 3) -> list[np.ndarray]:
    """Laser-on pictures of one scene."""
    rng = np.random.default_rng(seed)
    scene = make_scene(SIZE, options, rng)
    return [render_pair(uv, SHAPE, scene, options, rng)[0] for uv in places]


def capture_of(
    folder: Path, pictures: list[np.ndarray], planes: list[str] | None = None
) -> Capture:
    """A capture on disk with laser-on pictures only."""
    planes = planes or ["table"] * len(pictures)
    rows = [f"{k},{plane},{10 * k},0,0,0,0,0" for k, plane in enumerate(planes, start=1)]
    (folder / "poses.csv").write_text("\n".join(["id,plane,x,y,z,a,b,c", *rows]) + "\n")
    (folder / "capture.yaml").write_text(HEAD)
    for k, picture in enumerate(pictures, start=1):
        assert cv2.imwrite(str(folder / f"{k}.png"), picture)
    return load_capture(folder)


def spread(count: int, seed: int = 5) -> Array:
    """Places all over the picture."""
    return np.random.default_rng(seed).uniform((20, 20), (140, 100), (count, 2))


def distance(account, places: Array) -> Array:
    """Distance of every used spot from the truth, px."""
    return np.hypot(*(account.uv - places).T)[list(account.usable)]


@dataclass
class Seen:
    uv: np.ndarray
    cov_uv: np.ndarray
    verdict: str = "used"
    reason: str = ""
    usable: bool = True


def test_median_stands_in_where_a_single_picture_cannot_tell(tmp_path: Path) -> None:
    places = spread(15)
    pictures = shots(places, BRIGHT)
    capture = capture_of(tmp_path, pictures)
    account = capture.detections()
    assert sum(account.usable) >= 14
    assert np.max(distance(account, places)) < 0.6
    assert len(account.notes) == 1
    assert "plane 'table': 15 rows have no laser-off picture; the median of 15" in account.notes[0]
    assert all(
        text.endswith("off frame: median of 15 laser-on pictures") for text in account.reason
    )
    # one by one the highlights look like spots
    assert not any(detect_spot(picture).usable for picture in pictures)
    again = capture.detections()
    np.testing.assert_array_equal(again.uv, account.uv)
    assert again.reason == account.reason


def test_fewer_than_five_pictures_are_looked_at_one_by_one(tmp_path: Path) -> None:
    pictures = shots(spread(4), BRIGHT)
    account = capture_of(tmp_path, pictures).detections()
    assert account.notes == ()
    assert account.reason == tuple(detect_spot(picture).reason for picture in pictures)


def still() -> Array:
    return np.tile(MIDDLE, (15, 1))


def within_ten_px() -> Array:
    angle = np.linspace(0, 2 * np.pi, 15, endpoint=False)
    return MIDDLE + 5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def slow_line() -> Array:
    return MIDDLE + np.linspace(-9, 9, 15)[:, None] * np.array([[1.0, 0.3]])


def every_other_at_home() -> Array:
    places = spread(15)
    places[::2] = MIDDLE
    return places


@pytest.mark.parametrize("motion", [still, within_ten_px, slow_line, every_other_at_home])
@pytest.mark.parametrize("speckle", [0.0, 0.3])
def test_spots_that_lie_on_each_other_are_looked_at_one_by_one(
    tmp_path: Path, motion, speckle: float
) -> None:
    places = motion()
    options = RenderOptions(
        highlights=0, ghost_probability=0.0, texture=0.0, patches=0, speckle_contrast=speckle
    )
    pictures = shots(places, options)
    account = capture_of(tmp_path, pictures).detections()
    assert "cannot stand in" in account.notes[0]
    assert all("looked at without an off frame" in reason for reason in account.reason)
    assert sum(account.usable) >= 12
    assert np.max(distance(account, places)) < 0.5
    # the median would have hidden or shifted spots
    off = median_frame(pictures)
    spoilt = [detect_spot(picture, off) for picture in pictures]
    errors = [np.hypot(*(d.uv - uv)) for d, uv in zip(spoilt, places, strict=True) if d.usable]
    assert len(errors) < 12 or max(errors) > 0.6


def test_spots_may_touch_as_long_as_every_place_is_mostly_free() -> None:
    steps = np.linspace(-40, 40, 15)[:, None] * np.array([[1.0, 0.0]])
    places = MIDDLE + steps  # 5.7 px apart, 2 sigma
    pictures = shots(places, CLEAN)
    assert spots_in_median(median_frame(pictures), pictures) is None


def test_a_lamp_that_flickers_and_a_mount_that_shakes_are_no_fault() -> None:
    rng = np.random.default_rng(8)
    scene = make_scene(SIZE, BRIGHT, rng)
    pictures = []
    for uv in spread(15):
        lamp, (du, dv) = rng.normal(1.0, 0.02), rng.normal(0.0, 0.1, 2)
        moved = cv2.warpAffine(
            scene.ambient, np.array([[1, 0, du], [0, 1, dv]]), SIZE, borderMode=cv2.BORDER_REPLICATE
        )
        now = replace(scene, ambient=np.asarray(lamp * moved, dtype=np.float32))
        pictures.append(render_pair(uv, SHAPE, now, BRIGHT, rng)[0])
    assert spots_in_median(median_frame(pictures), pictures) is None


def test_pictures_of_two_kinds_are_looked_at_one_by_one(tmp_path: Path) -> None:
    pictures = shots(spread(7), CLEAN)
    mixed = [*pictures[:6], pictures[6].astype(np.uint16) * 257]
    account = capture_of(tmp_path, mixed).detections()
    assert "uint16" in account.notes[0] and "cannot stand in" in account.notes[0]
    assert [d.uv.tolist() for d in account.detections] == [
        detect_spot(p).uv.tolist() for p in mixed
    ]


def test_one_picture_of_another_kind_among_many_is_looked_at_by_itself(tmp_path: Path) -> None:
    pictures = shots(spread(31), CLEAN)
    odd = evenly(list(range(31)))[3] + 1  # not in the median
    pictures[odd] = cv2.cvtColor(pictures[odd], cv2.COLOR_GRAY2BGR)
    account = capture_of(tmp_path, pictures).detections()
    assert "stands in" in account.notes[0]
    assert "the picture is uint8 (120, 160, 3)" in account.reason[odd]
    assert sum("median of 15" in reason for reason in account.reason) == 30


def test_every_scene_has_one_off_frame_and_drops_it_after_use(tmp_path: Path) -> None:
    planes = ["a", "b"] * 5 + ["b"] * 2
    values = [10 if plane == "a" else 200 for plane in planes]
    pictures = [np.full(SIZE[::-1], value, dtype=np.uint8) for value in values]
    for picture, (u, v) in zip(pictures, spread(12).astype(int), strict=True):
        cv2.circle(picture, (int(u), int(v)), 3, 255 if picture[0, 0] == 200 else 60, -1)
    capture = capture_of(tmp_path, pictures, planes)
    assert cv2.imwrite(str(tmp_path / "own.png"), np.full(SIZE[::-1], 77, dtype=np.uint8))
    capture = replace(capture, images_off=(*(None,) * 11, tmp_path / "own.png"))
    frames: dict[int, weakref.ref[np.ndarray]] = {}
    level, alive = [], []

    def look(on: np.ndarray, off: np.ndarray | None) -> Seen:
        assert off is not None
        frames.setdefault(id(off) if off[0, 0] != 77 else 0, weakref.ref(off))
        level.append(int(off[0, 0]))
        alive.append(sum(f() is not None and f()[0, 0] == 10 for f in frames.values()))
        return Seen(np.ones(2), np.eye(2))

    account = capture.detections(look)
    assert level == [*values[:11], 77]
    assert len(frames) == 3  # two scenes, and the row with its own picture
    assert alive[8] == 1 and alive[-1] == 0  # the last row of plane a is the ninth
    assert [note.split(":")[0] for note in account.notes] == [
        "camera 'camera', plane 'a'",
        "camera 'camera', plane 'b'",
    ]
    assert "median" not in account.reason[11]


def test_a_damaged_picture_is_named_once(tmp_path: Path) -> None:
    capture = capture_of(tmp_path, shots(spread(6), CLEAN))
    (tmp_path / "4.png").write_bytes(b"no picture")
    with pytest.raises(DataError) as caught:
        capture.detections()
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].startswith("id 4: ")


@pytest.mark.parametrize(
    ("count", "taken"), [(5, 5), (6, 5), (7, 7), (15, 15), (16, 15), (90, 15), (1000, 15)]
)
def test_the_median_is_taken_of_an_odd_number_from_first_to_last(count: int, taken: int) -> None:
    rows = evenly(list(range(count)))
    assert len(set(rows)) == taken
    assert (rows[0], rows[-1]) == (0, count - 1)
    gaps = np.diff(rows)
    assert gaps.min() >= 1 and gaps.max() - gaps.min() <= 1
