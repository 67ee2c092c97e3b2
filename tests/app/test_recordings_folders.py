"""Pose files and folders of pictures, named by stamps, in order, or by pose id."""

from __future__ import annotations

import shutil
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_support import Cli
from recording_cases import MS, START, Session, picture, small_capture
from scipy.spatial.transform import Rotation

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.capture import Capture, load_capture
from lasercal_gtsam.recordings.picture_folder import open_folder
from lasercal_gtsam.recordings.pose_files import read_pose_file


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return small_capture(tmp_path_factory.mktemp("made") / "few", groups=1)


@pytest.fixture
def lasercal(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


def seconds(stamp: int) -> str:
    return str(Decimal(stamp) / 10**9)


def tum_line(stamp: int, T: np.ndarray) -> str:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return " ".join([seconds(stamp), *map(repr, map(float, [*T[:3, 3], *quaternion]))])


def kalibr_line(stamp: int, T: np.ndarray) -> str:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return ",".join([str(stamp), *map(repr, map(float, [*T[:3, 3], *quaternion]))])


def session(folder: Path, capture: Capture) -> tuple[list[int], np.ndarray]:
    """Pictures of a session, named in ns; returns the poses along it."""
    recorded = Session(poses_as="geometry_msgs/msg/TransformStamped")
    folder.mkdir()
    stamps, poses = [], []
    for _, topic, _, content in recorded.events(capture):
        if topic == "/hand_pose":
            stamps.append(content[0])
            poses.append(content[1])
        elif topic == "/camera/image_raw":
            assert cv2.imwrite(str(folder / f"{content[0]}.png"), content[1])
    return stamps, np.array(poses)


def assert_same(found: Capture, made: Capture) -> None:
    np.testing.assert_allclose(found.T_base_hand, made.T_base_hand, rtol=0, atol=1e-14)
    for k in range(len(made)):
        np.testing.assert_array_equal(picture(found.images_on[k]), picture(made.images_on[k]))
        np.testing.assert_array_equal(picture(found.images_off[k]), picture(made.images_off[k]))


@pytest.mark.parametrize("form", ["tum", "kalibr"])
def test_pose_file_and_pictures_named_by_stamp(form, capture, lasercal, tmp_path):
    stamps, poses = session(tmp_path / "pictures", capture)
    poses_file = tmp_path / "poses.txt"
    if form == "tum":
        lines = ["# timestamp tx ty tz qx qy qz qw", *map(tum_line, stamps, poses)]
        for path in list((tmp_path / "pictures").iterdir()):  # as TUM names them, in seconds
            path.rename(path.with_name(f"{seconds(int(path.stem))}.png"))
        transform = "T_base_hand"
    else:
        inverse = np.linalg.inv(poses)
        lines = ["#timestamp [ns],p x,p y,p z,q w,q x,q y,q z", *map(kalibr_line, stamps, inverse)]
        transform = "T_hand_base"
    poses_file.write_text("\n".join(lines) + "\n")
    out = tmp_path / "out"
    outcome = lasercal(
        "import", tmp_path / "pictures", "-o", out, "--plane", "1",
        "--poses", poses_file, "--pose-format", form, "--transform", transform,
    )  # fmt: skip
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(out), capture)


def test_one_pose_for_each_picture(capture, lasercal, tmp_path):
    """Stop and shoot: an on and an off picture at each pose, each with a pose of its stamp."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    lines = []
    for k in range(len(capture)):
        for j, path in enumerate((capture.images_on[k], capture.images_off[k])):
            stamp = START + (2 * k + j) * 3000 * MS
            shutil.copy(path, folder / f"{stamp}.png")
            lines.append(kalibr_line(stamp, capture.T_base_hand[k]))
    poses = tmp_path / "poses.csv"
    poses.write_text("\n".join(lines))
    args = ("import", folder, "--plane", "1", "--poses", poses, "--pose-format", "kalibr",
            "--transform", "T_base_hand")  # fmt: skip
    outcome = lasercal(*args, "-o", tmp_path / "a", "--every-picture")
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(tmp_path / "a"), capture)
    continuous = lasercal(*args, "--dry-run")
    assert continuous.status == 1
    assert "its poses come every 3 s" in continuous.err
    assert "--every-picture" in continuous.err
    for k, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"frame{k:02d}.png")
    outcome = lasercal(*args, "-o", tmp_path / "b", "--names", "order")
    assert outcome.status == 0, outcome.err
    assert_same(load_capture(tmp_path / "b"), capture)
    named = lasercal(*args, "--dry-run")
    assert named.status == 1
    assert "its name is not a stamp" in named.err


def test_pictures_named_by_pose_id_need_no_import(capture, lasercal, tmp_path):
    """A table of poses and pictures named after its ids, whatever they look like, are a capture."""
    ids = ["0007", "home-2", "p 3", "4.5"]
    folder = tmp_path / "cell"
    folder.mkdir()
    rows = ["id,plane,x,y,z,qw,qx,qy,qz"]
    for k, name in enumerate(ids):
        cv2.imwrite(str(folder / f"{name}.bmp"), picture(capture.images_on[k]))
        T = capture.T_base_hand[k]
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)]
        rows.append(",".join([name, "1", *map(repr, map(float, numbers))]))
    (folder / "poses.csv").write_text("\n".join(rows))
    (folder / "capture.yaml").write_text(
        "lasercal: 1\ncamera: {width: 160, height: 120}\nimages: '{id}.bmp'\n"
        "poses: {file: poses.csv, transform: T_base_hand, length: m, rotation: quat_wxyz}\n"
    )
    loaded = load_capture(folder)
    assert loaded.ids.tolist() == ids
    for k in range(len(ids)):
        np.testing.assert_array_equal(picture(loaded.images_on[k]), picture(capture.images_on[k]))
    assert lasercal("detect", folder).status == 0
    hint = lasercal("import", folder, "--dry-run", "--base", "a", "--hand", "b", "--plane", "1")
    assert hint.status == 1
    assert "Pictures named by pose id need no import" in hint.err


@pytest.mark.parametrize(
    ("form", "text", "words"),
    [
        ("tum", "1 2 3 4 0 0 0 1 5\n", "p.txt:1: 9 numbers with blanks between them; expected t_s"),
        ("tum", "# t\n1,0,0,0,0,0,0,1\n", "p.txt:2: 1 numbers with blanks"),
        ("tum", "now 0 0 0 0 0 0 1\n", "the stamp 'now' is not in seconds"),
        ("tum", "1.5 0 0 x 0 0 0 1\n", "0, 0, x, 0, 0, 0, 1 are not all numbers"),
        ("tum", "1.5 0 0 0 0 0 0 2\n", "quaternion of norm 2"),
        ("kalibr", "1.5,0,0,0,1,0,0,0\n", "the stamp '1.5' is not in whole ns"),
        ("kalibr", "# nothing\n", "there are no poses"),
    ],
)
def test_bad_pose_files(form, text, words, tmp_path):
    path = tmp_path / "p.txt"
    path.write_text(text)
    with pytest.raises(DataError) as error:
        read_pose_file(path, form, "T_base_hand")
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("names", "naming", "expected"),
    [
        (["1700000000.5", "1700000001.25"], "auto", [1700000000500000000, 1700000001250000000]),
        (["1700000000123"], "auto", [1700000000123000000]),
        (["1700000000123456"], "auto", [1700000000123456000]),
        (["000000200", "000001500"], "ms", [200000000, 1500000000]),
        (["7", "12"], "ns", [7, 12]),
    ],
)
def test_units_of_stamps_in_names(names, naming, expected, tmp_path):
    for name in names:
        (tmp_path / f"{name}.PNG").touch()
    (tmp_path / "notes.txt").touch()
    assert open_folder(tmp_path, naming=naming).stamps.tolist() == expected


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["000123"], "6 digits fit no stamp since 1970; say the unit"),
        (["left-1"], "its name is not a stamp"),
        ([], "there are no pictures in this folder"),
    ],
)
def test_names_that_say_no_time(names, words, tmp_path):
    for name in names:
        (tmp_path / f"{name}.png").touch()
    with pytest.raises(DataError, match=words):
        open_folder(tmp_path)


def test_pictures_in_order_must_be_as_many_as_poses_and_in_a_clear_order(tmp_path):
    for name in ("a1", "a2", "a10"):
        (tmp_path / f"{name}.png").touch()
    with pytest.raises(DataError, match="3 pictures, but 2 poses"):
        open_folder(tmp_path, naming="order", pose_stamps=np.array([1, 2]))
    with pytest.raises(DataError, match=r"whether a10\.png or a2\.png comes first"):
        open_folder(tmp_path, naming="order", pose_stamps=np.array([1, 2, 3]))


@pytest.mark.parametrize("number", ["1e300", "nan", "inf"])
def test_numbers_that_no_robot_has_are_refused(tmp_path, number):
    path = tmp_path / "poses.txt"
    path.write_text(f"1.0 {number} 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"poses\.txt:1: .*numbers that no robot has"):
        read_pose_file(path, "tum", "T_base_hand")
