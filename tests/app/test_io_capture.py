"""Captures that are right: units, directions, names, spots, pictures, and writing them back."""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lasercal_gtsam as lc
from lasercal_gtsam.errors import DataError, DetectionError
from lasercal_gtsam.io.capture import load_capture
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.io.conventions import ROTATION_FORMATS
from lasercal_gtsam.io.spot_account import write_spots
from lasercal_gtsam.observations import Observations

HEAD = """\
lasercal: 1
camera: {name: camera, width: 640, height: 480}
poses:
  file: poses.csv
  transform: T_base_hand
  length: mm
  rotation: kuka
"""
POSES = """\
id,plane,x,y,z,a,b,c,u,v
1,table,1000,-200,300.5,90,0,90,100.25,200.5
2,table,1100,-200,300.5,90,0,90,639,0
3,wall,0,0,0,0,0,0,0,479
"""


def folder_with(tmp_path: Path, head: str = HEAD, **files: str) -> Path:
    (tmp_path / "capture.yaml").write_text(head)
    for name, text in {"poses": POSES, **files}.items():
        (tmp_path / f"{name}.csv").write_text(text)
    return tmp_path


def picture(path: Path, value: int = 0, size: tuple[int, int] = (640, 480)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((size[1], size[0]), value, dtype=np.uint8))


@dataclass
class FakeSpot:
    """What a detector says; the verdict follows the picture's gray value."""

    uv: np.ndarray
    cov_uv: np.ndarray
    verdict: str
    reason: str

    @property
    def usable(self) -> bool:
        return self.verdict == "used"


def fake_detector(on: np.ndarray, off: np.ndarray | None) -> FakeSpot:
    value = float(on[0, 0])
    if value == 0:
        return FakeSpot(np.full(2, np.nan), np.full((2, 2), np.nan), "none", "it is dark")
    if value == 255:
        return FakeSpot(np.array([9.0, 9.0]), np.eye(2), "saturated", "too bright")
    second = -1.0 if off is None else float(off[0, 0])
    return FakeSpot(np.array([value, second]), 0.01 * np.eye(2), "used", "")


# --- tables -------------------------------------------------------------------------------------


def test_a_small_capture(tmp_path: Path) -> None:
    capture = lc.load_capture(folder_with(tmp_path) / "capture.yaml")
    assert capture == load_capture(tmp_path)
    assert capture.path == tmp_path / "capture.yaml"
    assert capture.image_size == {"camera": (640, 480)}
    assert capture.ids.tolist() == ["1", "2", "3"]
    assert capture.planes.tolist() == ["table", "table", "wall"]
    assert capture.cameras.tolist() == ["camera"] * 3
    assert capture.lasers.tolist() == ["laser"] * 3
    # KUKA 90, 0, 90 by hand (see test_io_conventions); millimetres become metres
    np.testing.assert_allclose(
        capture.T_base_hand[0],
        [[0, 0, 1, 1.0], [1, 0, 0, -0.2], [0, 1, 0, 0.3005], [0, 0, 0, 1]],
        atol=1e-15,
    )
    observations = capture.observations()
    np.testing.assert_array_equal(observations.uv, [[100.25, 200.5], [639, 0], [0, 479]])
    assert np.isnan(observations.cov_uv).all()
    assert observations.id.tolist() == ["1", "2", "3"]
    assert capture.warnings == ()
    assert capture.options() == lc.CalibrationOptions()


def test_the_inverse_direction_and_metres(tmp_path: Path) -> None:
    head = HEAD.replace("T_base_hand", "T_hand_base").replace("length: mm", "length: m")
    poses = "id,plane,x,y,z,a,b,c,u,v\n1,t,1,2,3,90,0,0,5,5\n"
    T = load_capture(folder_with(tmp_path, head, poses=poses)).T_base_hand[0]
    # base in hand: R = Rz(90), t = (1, 2, 3); so hand in base: R' = Rz(-90), -R' t = (-2, 1, -3)
    np.testing.assert_allclose(
        T, [[0, 1, 0, -2], [-1, 0, 0, 1], [0, 0, 1, -3], [0, 0, 0, 1]], atol=1e-15
    )


def test_header_case_blanks_extra_columns_and_line_ends(tmp_path: Path) -> None:
    plain = load_capture(folder_with(tmp_path))
    text = POSES.replace("id,plane,x", " ID , Plane,X").replace("a,b,c,u,v", "A,B,C,U,V,comment,")
    text = text.replace("\n1,table,", "\n\n 1 , table ,").replace("200.5\n", "200.5,hi,\n")
    text = text.replace("639,0\n", '639,0,"a, b",\n').replace("0,479\n", "0,479,,\n,,,\n")
    (tmp_path / "poses.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    again = load_capture(tmp_path)
    assert again.observations() == plain.observations()


def test_an_index_without_a_name_is_an_extra_column(tmp_path: Path) -> None:
    plain = load_capture(folder_with(tmp_path)).observations()
    header, *rows = POSES.splitlines()
    text = "\n".join([f",{header}", *(f"{k},{row}" for k, row in enumerate(rows))])
    assert load_capture(folder_with(tmp_path, poses=text)).observations() == plain


def test_sigmas_and_correlation(tmp_path: Path) -> None:
    poses = (
        "id,plane,x,y,z,a,b,c,u,v,sigma_u,sigma_v,rho_uv\n"
        "1,t,1,2,300,0,0,0,5,5,0.5,2,0.25\n2,t,1,2,300,0,0,0,6,6,0.1,0.1,\n3,t,1,2,300,0,0,0,7,7,,,\n"
    )
    cov = load_capture(folder_with(tmp_path, poses=poses)).observations().cov_uv
    np.testing.assert_allclose(cov[0], [[0.25, 0.25], [0.25, 4]], rtol=1e-15)
    np.testing.assert_allclose(cov[1], [[0.01, 0], [0, 0.01]], rtol=1e-15)
    assert np.isnan(cov[2]).all()


def test_several_cameras_and_lasers(tmp_path: Path) -> None:
    head = HEAD.replace(
        "camera: {name: camera, width: 640, height: 480}",
        "camera:\n  - {name: left, width: 640, height: 480}\n"
        "  - {name: right, width: 1920, height: 1200}",
    )
    poses = (
        "id,plane,camera,laser,x,y,z,a,b,c,u,v\n"
        "1,t,left,red,1,2,300,0,0,0,639,479\n2,t,right,green,1,2,300,0,0,0,1900,1100\n"
    )
    observations = load_capture(folder_with(tmp_path, head, poses=poses)).observations()
    assert observations.cameras == ("left", "right")
    assert observations.lasers == ("green", "red")
    assert observations.image_size == {"left": (640, 480), "right": (1920, 1200)}


def test_noise_and_known_become_options(tmp_path: Path) -> None:
    head = HEAD + (
        "noise: {pixel: 0.7, hand_translation_mm: 0.2, hand_rotation_deg: 0.09}\n"
        "known: {principal_point: [320, 240.5], skew: 0, aspect: 1, camera.k2: -0.5}\n"
    )
    capture = load_capture(folder_with(tmp_path, head))
    options = capture.options()
    assert options.sigma_px == 0.7
    assert options.hand_sigma_m == pytest.approx(2e-4, rel=1e-15)
    assert options.hand_sigma_rad == pytest.approx(math.pi / 2000, rel=1e-15)
    known = {"principal_point": (320, 240.5), "skew": 0, "aspect": 1, "camera.k2": -0.5}
    assert options.known == known
    changed = capture.options(sigma_px=None, known={"skew": 1.5}, robust="none")
    assert changed.sigma_px is None
    assert changed.robust == "none"
    assert changed.known == {**known, "skew": 1.5}
    assert changed.hand_sigma_m == options.hand_sigma_m


def test_rows_without_a_pixel_are_accounted_for(tmp_path: Path) -> None:
    poses = POSES.replace("639,0", ",")
    capture = load_capture(folder_with(tmp_path, poses=poses))
    assert capture.observations().id.tolist() == ["1", "3"]
    account = capture.detections()
    assert account.skipped == {"2": "missing: the row has neither a pixel nor a picture"}
    assert account.counts == {"used": 2, "missing": 1}
    assert [row.verdict for row in account] == ["used", "missing", "used"]


def test_the_account_of_another_capture_is_refused(tmp_path: Path) -> None:
    capture = load_capture(folder_with(tmp_path))
    account = capture.detections()
    other = load_capture(folder_with(tmp_path, poses=POSES.replace("\n3,", "\n4,")))
    with pytest.raises(DataError, match="that of another capture"):
        other.observations(account=account)


def test_nothing_heavy_is_imported_before_it_is_needed() -> None:
    code = (
        "import sys, lasercal_gtsam.io.capture, lasercal_gtsam.io.calibration_file;"
        "print(*{'gtsam', 'scipy', 'numba', 'cv2', 'pydantic', 'ruamel.yaml'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_provenance_is_the_hash_of_the_files(tmp_path: Path) -> None:
    capture = load_capture(folder_with(tmp_path))
    assert capture.provenance == {
        "capture.yaml": hashlib.sha256(HEAD.encode()).hexdigest(),
        "poses.csv": hashlib.sha256(POSES.encode()).hexdigest(),
    }


def test_names_that_yaml_reads_as_numbers(tmp_path: Path) -> None:
    head = HEAD.replace("name: camera", "name: 7") + "planes: [1, 2]\n"
    poses = "id,plane,camera,x,y,z,a,b,c,u,v\n1,2,7,1,2,300,0,0,0,5,5\n"
    capture = load_capture(folder_with(tmp_path, head, poses=poses))
    assert capture.cameras.tolist() == ["7"]


# --- warnings: odd, but not wrong -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "poses", "words"),
    [
        (HEAD.replace("length: mm", "length: m"), POSES, "is the unit mm"),
        (HEAD, "id,plane,x,y,z,a,b,c,u,v\n1,t,0.1,1.2,0.3,0,0,0,5,5\n", "is the unit m?"),
        (
            HEAD.replace("kuka", "rotvec_rad"),
            "id,plane,x,y,z,rx,ry,rz,u,v\n1,t,1,2,300,0,90,0,5,5\n",
            "values reach 90; degrees?",
        ),
        (
            HEAD.replace("kuka", "quat_wxyz"),
            "id,plane,x,y,z,qw,qx,qy,qz,u,v\n1,t,1,2,300,0.707,0.707,0,0,5,5\n",
            "rotations are rounded; elements had to be changed by up to 0.0002",
        ),
        (HEAD, POSES + "4,wall,0,0,0,0,0,0,0,479\n", "(3 = 4); they are kept and count twice"),
        (HEAD + "noise: {pixel: 0}\n", POSES, "noise.pixel is 0"),
    ],
)
def test_warnings(tmp_path: Path, head: str, poses: str, words: str) -> None:
    (warning,) = load_capture(folder_with(tmp_path, head, poses=poses)).warnings
    assert words in warning


# --- spots in a table of their own ----------------------------------------------------------------

NO_PIXELS = "\n".join(line.rsplit(",", 2)[0] for line in POSES.splitlines()) + "\n"
WITH_SPOTS = HEAD + "spots: {file: spots.csv}\n"


def test_spot_table(tmp_path: Path) -> None:
    spots = (
        "id,u,v,sigma_u,sigma_v,rho_uv,verdict,reason\n"
        "3,30,31,0.1,0.2,0.5,used,\n1,10,11,,,,ambiguous,two spots\n2,20,21,,,,,\n"
    )
    capture = load_capture(folder_with(tmp_path, WITH_SPOTS, poses=NO_PIXELS, spots=spots))
    observations = capture.observations()
    assert observations.id.tolist() == ["2", "3"]
    np.testing.assert_array_equal(observations.uv, [[20, 21], [30, 31]])
    assert np.isnan(observations.cov_uv[0]).all()
    np.testing.assert_allclose(observations.cov_uv[1], [[0.01, 0.01], [0.01, 0.04]], rtol=1e-14)
    assert capture.detections().skipped == {"1": "ambiguous: two spots"}
    assert set(capture.provenance) == {"capture.yaml", "poses.csv", "spots.csv"}


def test_what_detection_found_is_written_and_read_again(tmp_path: Path) -> None:
    head = HEAD + "images: images/{id}.png\n"
    folder_with(tmp_path, head, poses=NO_PIXELS)
    for name, value in (("1", 10), ("2", 0), ("3", 30)):
        picture(tmp_path / "images" / f"{name}.png", value)
    account = load_capture(tmp_path).detections(fake_detector)
    write_spots(tmp_path / "spots.csv", account)
    lines = (tmp_path / "spots.csv").read_text().splitlines()
    assert lines[0] == "id,u,v,sigma_u,sigma_v,rho_uv,verdict,reason"
    assert lines[2] == "2,,,,,,none,it is dark"
    (tmp_path / "capture.yaml").write_text(head + "spots: {file: spots.csv}\n")
    again = load_capture(tmp_path)
    # a row that the spot table gave up on is not looked at again
    assert again.detections().skipped == {"2": "none: it is dark"}
    direct, read = again.observations(account=account), again.observations()
    np.testing.assert_array_equal(read.uv, direct.uv)
    np.testing.assert_allclose(read.cov_uv, direct.cov_uv, rtol=1e-14)
    assert read.id.tolist() == ["1", "3"]


# --- pictures -----------------------------------------------------------------------------------


def test_pictures_for_rows_without_pixels(tmp_path: Path) -> None:
    poses = POSES.replace("100.25,200.5", ",").replace("639,0", ",")
    head = HEAD + 'images: {on: "images/{id}.png", off: "images/{id}_off.png", saturation: 4095}\n'
    folder_with(tmp_path, head, poses=poses)
    for name, value in (("1", 50), ("1_off", 7), ("2", 255), ("2_off", 0)):
        picture(tmp_path / "images" / f"{name}.png", value)
    capture = load_capture(tmp_path)
    assert capture.saturation == 4095
    assert capture.images_on[0] == tmp_path / "images" / "1.png"
    assert capture.images_on[2] is None
    calls: list[tuple[int, int]] = []
    account = capture.detections(fake_detector, lambda done, total: calls.append((done, total)))
    assert calls == [(1, 2), (2, 2)]
    np.testing.assert_array_equal(account.uv, [[50, 7], [9, 9], [0, 479]])
    assert account.usable == (True, False, True)
    assert account.skipped == {"2": "saturated: too bright"}
    assert account.detections[2] is None
    assert account.detections[1].verdict == "saturated"
    observations = capture.observations(fake_detector)
    assert observations == capture.observations(account=account)
    np.testing.assert_allclose(observations.cov_uv[0], 0.01 * np.eye(2))
    assert np.isnan(observations.cov_uv[1]).all()


def test_short_form_has_no_off_pictures(tmp_path: Path) -> None:
    folder_with(tmp_path, HEAD + "images: images/{id}.png\n", poses=NO_PIXELS)
    for name in ("1", "2", "3", "1_off"):
        picture(tmp_path / "images" / f"{name}.png", 40)
    uv = load_capture(tmp_path).detections(fake_detector).uv
    np.testing.assert_array_equal(uv[0], [40, -1])


def test_glob_in_order_and_placeholders(tmp_path: Path) -> None:
    folder_with(tmp_path, HEAD + "images: shots/*.png\n", poses=NO_PIXELS)
    for name, value in (("a08", 8), ("a09", 9), ("a10", 10)):
        picture(tmp_path / "shots" / f"{name}.png", value)
    uv = load_capture(tmp_path).detections(fake_detector).uv
    np.testing.assert_array_equal(uv[:, 0], [8, 9, 10])
    head = HEAD + "images: '{camera}-{laser}/{plane}/{id}.png'\n"
    folder_with(tmp_path, head, poses=NO_PIXELS)
    for plane, name in (("table", "1"), ("table", "2"), ("wall", "3")):
        picture(tmp_path / "camera-laser" / plane / f"{name}.png", int(name))
    np.testing.assert_array_equal(
        load_capture(tmp_path).detections(fake_detector).uv[:, 0], [1, 2, 3]
    )


def test_background_stands_in_for_missing_off_pictures(tmp_path: Path) -> None:
    head = HEAD + 'images:\n  on: "{id}.png"\n  off: "{id}_off.png"\n  background: dark.png\n'
    folder_with(tmp_path, head, poses=NO_PIXELS)
    for name, value in (("1", 1), ("2", 2), ("3", 3), ("1_off", 99), ("dark", 5)):
        picture(tmp_path / f"{name}.png", value)
    capture = load_capture(tmp_path)
    assert "2 rows have no laser-off picture of their own" in capture.warnings[0]
    np.testing.assert_array_equal(capture.detections(fake_detector).uv[:, 1], [99, 5, 5])


def test_depth_and_colour_are_kept(tmp_path: Path) -> None:
    folder_with(tmp_path, HEAD + "images: '{id}.png'\n", poses=NO_PIXELS)
    gray16 = np.full((480, 640), 40_000, dtype=np.uint16)
    colour = np.zeros((480, 640, 3), dtype=np.uint8)
    colour[:, :, 2] = 200
    for name, image in (("1", gray16), ("2", colour), ("3", colour)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    seen: list[np.ndarray] = []

    def look(on: np.ndarray, off: np.ndarray | None) -> FakeSpot:
        seen.append(on)
        return fake_detector(np.full((1, 1), 3), None)

    load_capture(tmp_path).detections(look)
    np.testing.assert_array_equal(seen[0], gray16)
    assert seen[0].dtype == np.uint16
    np.testing.assert_array_equal(seen[1], colour)


def test_pictures_that_cannot_be_used_are_all_named(tmp_path: Path) -> None:
    folder_with(tmp_path, HEAD + "images: '{id}.png'\n", poses=NO_PIXELS + "4,t,1,2,3,4,5,6\n")
    picture(tmp_path / "1.png", 3)
    content = (tmp_path / "1.png").read_bytes()
    (tmp_path / "2.png").write_text("no picture")
    (tmp_path / "3.png").write_bytes(content[: len(content) // 2])
    picture(tmp_path / "4.png", 3, size=(320, 240))
    with pytest.raises(DataError) as caught:
        load_capture(tmp_path).observations(fake_detector)
    problems = caught.value.problems
    assert len(problems) == 3
    assert problems[0].startswith("id 2: ") and "2.png" in problems[0]
    assert "damaged or unknown" in problems[0]
    assert problems[1].startswith("id 3: ") and "cut off" in problems[1]
    assert "4.png is 320 x 240 pixels, but its camera has 640 x 480" in problems[2]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_picture_without_its_end_is_refused(tmp_path: Path, suffix: str) -> None:
    folder_with(
        tmp_path, HEAD + f"images: 'a*{suffix}'\n", poses="\n".join(NO_PIXELS.split("\n")[:2])
    )
    picture(tmp_path / f"a{suffix}", 9)
    assert len(load_capture(tmp_path).observations(fake_detector)) == 1
    content = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"a{suffix}").write_bytes(content[:-20])
    with pytest.raises(DataError, match="cut off"):
        load_capture(tmp_path).observations(fake_detector)
    (tmp_path / f"a{suffix}").write_bytes(b"")
    with pytest.raises(DataError, match="empty"):
        load_capture(tmp_path).observations(fake_detector)


def test_no_row_gives_a_spot(tmp_path: Path) -> None:
    folder_with(tmp_path, HEAD + "images: '{id}.png'\n", poses=NO_PIXELS)
    for name in "123":
        picture(tmp_path / f"{name}.png", 0)
    with pytest.raises(DataError) as caught:
        load_capture(tmp_path).observations(fake_detector)
    assert "none of the 3 rows gives a spot" in caught.value.problems[0]
    assert caught.value.problems[1] == "id 1: none: it is dark"


@pytest.mark.parametrize("error", [DataError, DetectionError])
def test_what_the_detector_refuses_is_named(tmp_path: Path, error: type[Exception]) -> None:
    folder_with(tmp_path, HEAD + "images: '{id}.png'\n", poses=NO_PIXELS)
    for name in "123":
        picture(tmp_path / f"{name}.png", int(name))

    def refuse(on: np.ndarray, off: np.ndarray | None) -> FakeSpot:
        if on[0, 0] == 2:
            raise error("what is this")
        return fake_detector(on, off)

    with pytest.raises(DataError, match=r"id 2: .*2\.png: what is this"):
        load_capture(tmp_path).detections(refuse)


def test_the_default_detector_finds_a_spot(tmp_path: Path) -> None:
    folder_with(
        tmp_path,
        HEAD + 'images: {on: "{id}.png", off: "{id}_off.png"}\n',
        poses="\n".join(NO_PIXELS.split("\n")[:2]),
    )
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:480, :640]
    spot = 150 * np.exp(-((u - 301.3) ** 2 + (v - 122.7) ** 2) / (2 * 2.5**2))
    for name, light in (("1", spot), ("1_off", 0 * spot)):
        noisy = 20 + light + rng.normal(0, 1.0, light.shape)
        cv2.imwrite(
            str(tmp_path / f"{name}.png"), np.clip(np.round(noisy), 0, 255).astype(np.uint8)
        )
    observations = load_capture(tmp_path).observations()
    np.testing.assert_allclose(observations.uv, [[301.3, 122.7]], atol=0.1)
    assert (np.sqrt(np.linalg.eigvalsh(observations.cov_uv[0])) < 0.2).all()


# --- writing and reading back -------------------------------------------------------------------


def observations_of(seed: int, count: int = 4, **changes: Any) -> Observations:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    q = rng.standard_normal((count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    for k, (w, x, y, z) in enumerate(q):
        S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        T[k, :3, :3] = np.eye(3) + 2 * w * S + 2 * S @ S
    T[:, :3, 3] = rng.uniform(-2, 2, (count, 3))
    return Observations.from_arrays(
        rng.uniform(0, 479, (count, 2)),
        T,
        **{
            "plane": "1",
            "image_size": (640, 480),
            "id": [f"s{k}" for k in range(count)],
            **changes,
        },
    )


@pytest.mark.parametrize("transform", ["T_base_hand", "T_hand_base"])
@pytest.mark.parametrize("length", ["mm", "m"])
@pytest.mark.parametrize("rotation", [*ROTATION_FORMATS, "euler:zyz:rad", "euler:YXZ:deg"])
@settings(
    deadline=None,
    derandomize=True,
    max_examples=3,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32))
def test_every_convention_comes_back(
    tmp_path: Path, transform: Any, length: Any, rotation: str, seed: int
) -> None:
    written = observations_of(seed)
    path = write_capture(
        tmp_path, written, transform=transform, length=length, rotation=rotation, with_spots=True
    )
    capture = load_capture(path)
    read = capture.observations()
    np.testing.assert_array_equal(read.uv, written.uv)
    np.testing.assert_allclose(read.T_base_hand, written.T_base_hand, rtol=0, atol=4e-15)
    assert (read.id == written.id).all() and (read.plane == written.plane).all()
    assert capture.warnings == ()


def test_everything_else_comes_back(tmp_path: Path) -> None:
    cov = np.array([[[0.5, 0.1], [0.1, 0.2]], [[0.01, 0], [0, 0.01]], [[1, -0.9], [-0.9, 1]]])
    written = observations_of(
        1,
        3,
        plane=["1", "2", 'odd, "name"'],
        camera=["left", "right", "left"],
        laser=["laser", "other", "laser"],
        image_size={"left": (640, 480), "right": (1920, 1200)},
        id=["1", "0x", "no"],
        cov_uv=cov,
    )
    noise = {"pixel": 0.3, "hand_translation_mm": 0.1, "hand_rotation_deg": 0.02}
    known = {"principal_point": (320.25, 240.0), "left.skew": 0, "aspect": np.float64(1.01)}
    path = write_capture(
        tmp_path / "new" / "folder",
        written,
        transform="T_base_hand",
        length="m",
        rotation="matrix",
        with_spots=True,
        images={"on": "images/{id}.png", "off": "images/{id}_off.png", "saturation": 255},
        noise=noise,
        known=known,
    )
    capture = load_capture(path)
    read = capture.observations()
    np.testing.assert_array_equal(read.T_base_hand, written.T_base_hand)
    np.testing.assert_allclose(read.cov_uv, cov, rtol=1e-14)
    for name in ("camera", "laser", "plane", "id"):
        assert getattr(read, name).tolist() == getattr(written, name).tolist()
    assert read.image_size == written.image_size
    assert capture.options().sigma_px == 0.3
    assert capture.options().known == known
    assert capture.saturation == 255


def test_written_without_spots_for_pictures(tmp_path: Path) -> None:
    written = observations_of(2, 2)
    path = write_capture(
        tmp_path,
        written,
        transform="T_base_hand",
        length="mm",
        rotation="ur",
        with_spots=False,
        images="images/{id}.png",
    )
    for name in written.id:
        picture(tmp_path / "images" / f"{name}.png", 8)
    assert (tmp_path / "poses.csv").read_text().splitlines()[0] == "id,plane,x,y,z,rx,ry,rz"
    assert load_capture(path).observations(fake_detector).uv[:, 0].tolist() == [8, 8]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"transform": "base"}, "transform: expected T_base_hand or T_hand_base"),
        ({"length": "cm"}, "length: expected mm or m, got 'cm'"),
        ({"rotation": "quat"}, "is not a known format"),
        ({"with_spots": False}, "needs spots or images"),
    ],
)
def test_what_cannot_be_written(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    how = {"transform": "T_base_hand", "length": "m", "rotation": "ur", "with_spots": True}
    with pytest.raises(DataError, match=words):
        write_capture(tmp_path / "x", observations_of(0), **{**how, **changes})
    assert not (tmp_path / "x").exists()


def test_ids_must_be_unique_to_be_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="ids must be unique"):
        write_capture(
            tmp_path,
            observations_of(0, 2, id=["a", "a"]),
            transform="T_base_hand",
            length="m",
            rotation="ur",
            with_spots=True,
        )
