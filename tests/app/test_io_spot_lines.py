"""Spots as JSON lines: what is taken, and what is said about the rest."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from lasercal_gtsam.io.capture_head import PosesHead
from lasercal_gtsam.io.spot_lines import Dismiss, LineError, Reset, Sizes, SpotLines
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.rotations import make_pose

SIZES = {"camera": (640, 480)}
# 90 deg about z, then 0.4, 0.5, 0.6 m
T = make_pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [0.4, 0.5, 0.6])
SPOT = {"id": "s1", "plane": "table", "uv": [312.5, 208.25], "T_base_hand": T.tolist()}
KUKA = PosesHead(file="poses.csv", transform="T_base_hand", length="mm", rotation="kuka")


def without(*keys: str, **more: object) -> dict:
    return {key: value for key, value in {**SPOT, **more}.items() if key not in keys}


def read(data: object, lines: SpotLines | None = None):
    text = data if isinstance(data, bytes) else json.dumps(data).encode()
    return (lines or SpotLines(SIZES)).read(text)


def test_a_spot():
    seen = read(SPOT)
    assert isinstance(seen, Observations)
    assert len(seen) == 1
    assert (seen.id[0], seen.plane[0], seen.camera[0], seen.laser[0]) == (
        "s1", "table", "camera", "laser",
    )  # fmt: skip
    assert seen.uv.tolist() == [[312.5, 208.25]]
    assert seen.T_base_hand.tolist() == [T.tolist()]
    assert np.isnan(seen.cov_uv).all()
    assert dict(seen.image_size) == SIZES
    assert read(without(id=17, plane=2)).id[0] == "17"
    assert read({**SPOT, "id": "Größe"}).id[0] == "Größe"


def test_noise():
    assert read({**SPOT, "sigma_px": 0.5}).cov_uv.tolist() == [[[0.25, 0], [0, 0.25]]]
    cov = [[1.0, 0.2], [0.2, 2.0]]
    assert read({**SPOT, "cov_uv": cov}).cov_uv.tolist() == [cov]
    lines = SpotLines(SIZES, sigma_px=2.0)
    assert read(SPOT, lines).cov_uv.tolist() == [[[4, 0], [0, 4]]]
    assert read({**SPOT, "sigma_px": 1}, lines).cov_uv.tolist() == [[[1, 0], [0, 1]]]


@pytest.mark.parametrize("transform", ["T_base_hand", "T_hand_base"])
@pytest.mark.parametrize("length", ["mm", "m"])
def test_poses_as_columns_mean_the_same(transform, length):
    poses = PosesHead(file="p.csv", transform=transform, length=length, rotation="kuka")
    scale = 1000.0 if length == "mm" else 1.0
    # the inverse of a turn by 90 deg about z and a shift t turns back, and shifts by -R^T t
    x, y, z, a = (0.4, 0.5, 0.6, 90.0) if transform == "T_base_hand" else (-0.5, 0.4, -0.6, -90.0)
    said = without("T_base_hand", x=x * scale, y=y * scale, z=z * scale, a=a, b=0, c=0)
    seen = read(said, SpotLines(SIZES, poses=poses))
    np.testing.assert_allclose(seen.T_base_hand[0], T, atol=1e-12)
    # the matrix may be sent all the same
    assert read(SPOT, SpotLines(SIZES, poses=poses)).T_base_hand.tolist() == [T.tolist()]


def test_names_may_be_left_out_only_where_there_is_one():
    two = SpotLines({"left": (640, 480), "right": (640, 480)}, lasers=["red"])
    with pytest.raises(LineError, match="camera: left out, but there are left, right: say which"):
        read(SPOT, two)
    seen = read({**SPOT, "camera": "left"}, two)
    assert (seen.camera[0], seen.laser[0]) == ("left", "red")
    assert read({**SPOT, "camera": "left", "laser": "green"}, two).laser[0] == "green"
    with pytest.raises(LineError, match="laser: left out, but there are red, green"):
        read({**SPOT, "camera": "left"}, two)
    with pytest.raises(LineError, match=r"unknown camera 'rihgt' \(did you mean 'right'\?\)"):
        read({**SPOT, "camera": "rihgt"}, two)


def test_other_lines():
    assert read({"reset": {"camera": "left"}}) == Reset("camera", "left")
    assert read({"dismiss": True}) == Dismiss()
    assert read({"image_size": [640, 480]}) == Sizes({"": (640, 480)})
    assert read({"image_size": {"a": [1, 2]}}) == Sizes({"a": (1, 2)})


ROUNDED = np.round(T + 1e-2, 2).tolist()


@pytest.mark.parametrize(
    ("line", "name", "words"),
    [
        (b'{"id": "s1", "uv": [1 2]}', None, "column 23: not JSON"),
        (b'{"id": "s1"', None, "column 12: not JSON"),
        (b'{"id": "\xff"}', None, "column 9: not UTF-8"),
        (b"[1, 2]", None, r"expected an object \{...\}, got \[1, 2\]"),
        (b"[" * 100_000, None, "nested too deeply"),
        (b'{"id": "s1", "id": "s2"}', "s2", "the key 'id' is there twice"),
        (b'{"id": "s1", "uv": [NaN, 1]}', None, "expected finite numbers, got NaN"),
        (json.dumps(SPOT).replace("312.5", "1e999").encode(), "s1", r"uv: expected \[u, v\]"),
        (without("id"), None, "id: expected a name, got nothing"),
        (without(id=""), None, 'id: expected a name, got ""'),
        (without(id=1.5), None, "id: expected a name, got 1.5"),
        (without("plane"), "s1", "plane: expected a name, got nothing"),
        (without("uv"), "s1", "uv: left out"),
        (without(uv=[1, "a"]), "s1", r'uv: expected \[u, v\] in pixels, got \[1, "a"\]'),
        (without(uv=[1, True]), "s1", "uv: expected"),
        (without(uv=[1, 2, 3]), "s1", "uv: expected"),
        (without(uv=[700, 2]), "s1", "uv: u = 700 lies outside the picture.* 0 to 639"),
        (without(sigma_px=0), "s1", "sigma_px: expected a number above 0"),
        (without(sigma_px=1, cov_uv=[[1, 0], [0, 1]]), "s1", "give one of them"),
        (without(cov_uv=[[1, 2], [2, 1]]), "s1", "positive definite"),
        (without(cov_uv=[[1, 0.5], [0.4, 1]]), "s1", "symmetric"),
        (without(T_base_hand=[[1, 0], [0, 1]]), "s1", "expected a 4x4 matrix, metres"),
        (without(T_base_hand=ROUNDED), "s1", "not a rotation matrix"),
        (without(T_base_hand=(T * [[1], [1], [-1], [1]]).tolist()), "s1", "a reflection"),
        (without(T_base_hand=[*T[:3].tolist(), [0, 0, 1, 1]]), "s1", "last row 0, 0, 0, 1"),
        (without(T_base_hand=make_pose(T[:3, :3], 1000 * T[:3, 3]).tolist()), "s1", "unit mm"),
        (without("T_base_hand"), "s1", "T_base_hand: left out"),
        (without(colour="red"), "s1", "unknown key 'colour'; allowed are id, plane, uv"),
        (without(sigma=1), "s1", r"unknown key 'sigma' \(did you mean 'sigma_px'\?\)"),
        ({"reset": "camera"}, None, "reset: expected"),
        ({"reset": {"robot": "x"}}, None, "reset: expected"),
        ({"reset": {"camera": "a", "laser": "b"}}, None, "reset: expected"),
        ({"dismiss": False}, None, "dismiss: expected"),
        ({"image_size": [640]}, None, "image_size: expected"),
        ({"image_size": [640.5, 480]}, None, "image_size: expected"),
    ],
)
def test_what_cannot_be_taken(line, name, words):
    with pytest.raises(LineError, match=words) as caught:
        read(line)
    assert caught.value.id == name
    assert "\n" not in str(caught.value)


def test_columns_that_are_wrong():
    lines = SpotLines(SIZES, poses=KUKA, planes=["1", "2"])
    columns = {"x": 400, "y": 500, "z": 600, "a": 90, "b": 0, "c": 0}
    good = without("T_base_hand", plane="1", **columns)
    assert isinstance(read(good, lines), Observations)
    for change, words in (
        ({"b": None}, "b: expected a number, got null"),
        ({"T_base_hand": T.tolist()}, "T_base_hand, x: the pose is given twice"),
        ({"plane": "3"}, "unknown plane '3'; capture.yaml has 1, 2"),
        ({"x": math.inf}, "Infinity"),
    ):
        with pytest.raises(LineError, match=words):
            read({**good, **change}, lines)
    quaternion = PosesHead(file="p", transform="T_base_hand", length="m", rotation="quat_wxyz")
    said = without("T_base_hand", x=0, y=0, z=1, qw=2, qx=0, qy=0, qz=0)
    with pytest.raises(LineError, match="qw, qx, qy, qz: quaternion of norm 2"):
        read(said, SpotLines(SIZES, poses=quaternion))


def test_the_image_size_must_be_known_first():
    lines = SpotLines({})
    with pytest.raises(LineError, match="the image size is not known yet"):
        read(SPOT, lines)
    lines.image_size["camera"] = (640, 480)
    assert len(read(SPOT, lines)) == 1


def test_sigmas_that_no_detector_has_are_refused():
    reader = SpotLines(SIZES)
    line = {"id": "a", "plane": "1", "uv": [1.0, 2.0], "T_base_hand": np.eye(4).tolist()}
    for given in ({"sigma_px": 1e9}, {"cov_uv": [[1e13, 0.0], [0.0, 1.0]]}):
        with pytest.raises(LineError, match=next(iter(given))):
            reader.read(json.dumps({**line, **given}).encode())
