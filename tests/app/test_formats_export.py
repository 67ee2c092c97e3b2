"""Every export, read by readers of the test's own: the pose to 1e-12, the covariance to 1e-9.

The readers here share nothing with the package: other libraries (PyYAML, OpenCV, rosbags, GTSAM) or
the definition of the format written out.
"""

from __future__ import annotations

import ast
import io
import json
import shlex
from xml.etree import ElementTree

import cv2
import gtsam
import numpy as np
import pytest
import yaml
from format_cases import (
    CAMERA,
    calibrated,
    exp,
    pose,
    poses,
    random_covariance,
    rotation_of_quaternion,
    rotation_zyx,
    two_cameras,
    with_pose,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

import lasercal_gtsam as lc
from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats import pose_covariance, ros_transform
from lasercal_gtsam.formats.registry import FORMATS
from lasercal_gtsam.report_map import CAMERA_TANGENT

TRANSFORMS = ("ros1-tf", "ros1-launch", "ros2-tf", "ros2-launch", "urdf", "xacro")
properties = settings(max_examples=60, deadline=None, derandomize=True)


def text_of(calibration: lc.Calibration, form: str, **choices: object) -> str:
    return lc.export(calibration, form, **choices).content.decode()


def same_pose(found: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(found[:3, :3], wanted[:3, :3], rtol=0, atol=1e-12)
    scale = max(1.0, np.linalg.norm(wanted[:3, 3]))
    np.testing.assert_allclose(found[:3, 3], wanted[:3, 3], rtol=0, atol=1e-12 * scale)


def same_covariance(found: np.ndarray, wanted: np.ndarray) -> None:
    sigma = np.sqrt(np.diag(wanted))
    assert np.all(np.abs(found - wanted) <= 1e-9 * np.outer(sigma, sigma))


def by_place(words: list[str]) -> tuple[np.ndarray, str, str]:
    """ROS 1: x y z qx qy qz qw parent child."""
    x, y, z, qx, qy, qz, qw = map(float, words[:7])
    parent, child = words[7:]
    return pose(rotation_of_quaternion(qw, qx, qy, qz), [x, y, z]), parent, child


def by_name(words: list[str]) -> tuple[np.ndarray, str, str]:
    """ROS 2: named options."""
    said = {words[i].removeprefix("--"): words[i + 1] for i in range(0, len(words), 2)}
    assert set(said) == {"x", "y", "z", "qx", "qy", "qz", "qw", "frame-id", "child-frame-id"}
    q = [float(said[k]) for k in ("qw", "qx", "qy", "qz")]
    t = [float(said[k]) for k in ("x", "y", "z")]
    return pose(rotation_of_quaternion(*q), t), said["frame-id"], said["child-frame-id"]


def read_transform(form: str, text: str) -> tuple[np.ndarray, str, str]:
    if form in ("urdf", "xacro"):
        joint = ElementTree.fromstring(text).find("joint")
        assert joint.get("type") == "fixed"
        origin = joint.find("origin")
        roll, pitch, yaw = map(float, origin.get("rpy").split())
        T = pose(rotation_zyx(yaw, pitch, roll), [float(x) for x in origin.get("xyz").split()])
        return T, joint.find("parent").get("link"), joint.find("child").get("link")
    if form.endswith("launch"):
        node = ElementTree.fromstring(text).find("node")
        assert node.get("pkg") == "tf2_ros"
        program = node.get("type" if form.startswith("ros1") else "exec")
        words = node.get("args").split()
    else:
        (line,) = [x for x in text.splitlines() if x and not x.startswith("#")]
        words = shlex.split(line)
        start = ["exec", *(["rosrun"] if form == "ros1-tf" else ["ros2", "run"]), "tf2_ros"]
        assert words[: len(start)] == start
        program, words = words[len(start)], words[len(start) + 1 :]
    assert program == "static_transform_publisher"
    return (by_place if form.startswith("ros1") else by_name)(words)


@pytest.mark.parametrize("form", TRANSFORMS)
@properties
@given(T=poses)
@example(T=pose(rotation_zyx(0.3, np.pi / 2, -1.1), [0.1, 0.2, 0.3]))
@example(T=pose(rotation_zyx(0.3, -np.pi / 2, -1.1), [1e-9, -1e-7, 1e9]))
@example(T=pose(np.diag([-1.0, -1.0, 1.0]), [0, 0, 0]))
@example(T=np.eye(4))
def test_a_transform_is_the_pose_that_was_calibrated(form, T):
    text = text_of(with_pose(T), form, parent="base", child="eye")
    found, parent, child = read_transform(form, text)
    same_pose(found, T)
    assert (parent, child) == ("base", "eye")


@properties
@given(T=poses, seed=st.integers(0, 10**6))
def test_the_message_has_pose_and_covariance_about_the_axes_of_the_base(T, seed):
    covariance = random_covariance(seed)
    message = yaml.safe_load(text_of(with_pose(T, covariance), "ros-pose", parent="world"))
    assert message["header"] == {"frame_id": "world"}
    p, q = message["pose"]["pose"]["position"], message["pose"]["pose"]["orientation"]
    R = rotation_of_quaternion(q["w"], q["x"], q["y"], q["z"])
    same_pose(pose(R, [p["x"], p["y"], p["z"]]), T)
    found = np.array(message["pose"]["covariance"]).reshape(6, 6)
    # position and rotation each turned into the base, position first
    R = T[:3, :3]
    w, v = slice(0, 3), slice(3, 6)
    wanted = np.block(
        [
            [R @ covariance[v, v] @ R.T, R @ covariance[v, w] @ R.T],
            [R @ covariance[w, v] @ R.T, R @ covariance[w, w] @ R.T],
        ]
    )
    same_covariance(found, wanted)


def test_the_change_of_coordinates_is_the_derivative_of_the_pose():
    rng = np.random.default_rng(0)
    for _ in range(5):
        R = rotation_of_quaternion(*rng.normal(size=4))
        t = rng.normal(size=3)

        def moved(step, R=R, t=t):
            """Position, and rotation about fixed axes: log of R' R^T, first order."""
            turned = R @ exp(step[:3]) @ R.T
            vee = [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0]]
            vee = np.array([*vee, turned[1, 0] - turned[0, 1]]) / 2
            return np.concatenate([t + R @ step[3:], vee])

        h = 1e-5
        J = np.column_stack([(moved(h * e) - moved(-h * e)) / (2 * h) for e in np.eye(6)])
        C = random_covariance(1)[:6, :6]
        found = pose_covariance.fixed_axes_covariance(C, R)
        np.testing.assert_allclose(found, J @ C @ J.T, rtol=0, atol=1e-8 * np.abs(found).max())
        same_covariance(pose_covariance.tangent_covariance(found, R), C)


def test_the_tangent_is_gtsams_and_the_message_agrees_with_monte_carlo():
    """Poses drawn in GTSAM's own chart scatter as the message says."""
    T = pose(rotation_zyx(0.7, -0.4, 2.0), [0.5, -0.3, 0.8])
    C = random_covariance(4)
    message = yaml.safe_load(text_of(with_pose(T, C), "ros-pose"))
    stated = np.array(message["pose"]["covariance"]).reshape(6, 6)
    rng = np.random.default_rng(1)
    mean, rows = gtsam.Pose3(T), []
    for step in rng.multivariate_normal(np.zeros(6), C[:6, :6], size=20_000):
        drawn = mean.retract(step)
        turn = gtsam.Rot3.Logmap(drawn.rotation().compose(mean.rotation().inverse()))
        rows.append(np.concatenate([drawn.translation() - T[:3, 3], turn]))
    found = np.cov(np.array(rows).T)
    sigma = np.sqrt(np.diag(stated))
    # sampling error of a covariance of 20 000 draws: 1 % of the two sigmas at most
    assert np.abs((found - stated) / np.outer(sigma, sigma)).max() < 0.05


def test_ros_own_messages_take_both_yaml_files():
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    calibration = calibrated()
    message = yaml.safe_load(text_of(calibration, "ros-pose"))

    def built(name, data):
        """A message of that type; every key must be a field of it, the rest gets nothing."""
        fields = dict(store.fielddefs[name][1])
        assert set(data) <= set(fields)
        return store.types[name], fields

    with_covariance, _ = built("geometry_msgs/msg/PoseWithCovariance", message["pose"])
    p = store.types["geometry_msgs/msg/Point"](**message["pose"]["pose"]["position"])
    q = store.types["geometry_msgs/msg/Quaternion"](**message["pose"]["pose"]["orientation"])
    sent = with_covariance(
        store.types["geometry_msgs/msg/Pose"](p, q),
        np.array(message["pose"]["covariance"], dtype=np.float64),
    )
    raw = store.serialize_cdr(sent, "geometry_msgs/msg/PoseWithCovariance")
    back = store.deserialize_cdr(raw, "geometry_msgs/msg/PoseWithCovariance")
    o = back.pose.orientation
    R = rotation_of_quaternion(o.w, o.x, o.y, o.z)
    at = back.pose.position
    same_pose(pose(R, [at.x, at.y, at.z]), calibration.cell.cameras[CAMERA].T_base_camera)
    assert back.covariance.shape == (36,)


def test_camera_info_is_the_lens_in_opencvs_order():
    calibration = calibrated()
    data = yaml.safe_load(text_of(calibration, "ros-camera-info"))
    camera = calibration.cell.cameras[CAMERA]
    assert (data["image_width"], data["image_height"]) == camera.image_size
    assert data["camera_name"] == CAMERA
    assert data["distortion_model"] == "plumb_bob"

    def matrix(key):
        node = data[key]
        return np.array(node["data"]).reshape(node["rows"], node["cols"])

    lens = camera.intrinsics
    np.testing.assert_array_equal(matrix("camera_matrix"), lens.K)
    wanted = [[lens.k1, lens.k2, lens.p1, lens.p2, 0]]
    np.testing.assert_array_equal(matrix("distortion_coefficients"), wanted)
    np.testing.assert_array_equal(matrix("rectification_matrix"), np.eye(3))
    np.testing.assert_array_equal(matrix("projection_matrix")[:, :3], lens.K)
    assert not matrix("projection_matrix")[:, 3].any()
    # what OpenCV, and so image_proc, makes of it is what the calibration says
    uv = pixels_of_opencv(matrix("camera_matrix"), matrix("distortion_coefficients"), camera)
    np.testing.assert_allclose(uv, pixels_of_cell(calibration.cell), atol=1e-9)


def points_in_view(camera: lc.Camera) -> np.ndarray:
    """Base points all over the image, half a metre to a metre before the camera."""
    rng = np.random.default_rng(8)
    xyz = rng.uniform([-0.35, -0.3, 1], [0.35, 0.3, 1], size=(50, 3))
    xyz *= rng.uniform(0.5, 1, size=(50, 1))
    return xyz @ camera.T_base_camera[:3, :3].T + camera.T_base_camera[:3, 3]


def pixels_of_cell(cell: lc.Cell) -> np.ndarray:
    """Through the package's own projection."""
    from lasercal_gtsam.projection import project_points

    camera = cell.cameras[CAMERA]
    return project_points(points_in_view(camera), camera)


def pixels_of_opencv(K: np.ndarray, D: np.ndarray, camera: lc.Camera) -> np.ndarray:
    T = np.linalg.inv(camera.T_base_camera)
    points = points_in_view(camera)
    uv, _ = cv2.projectPoints(points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, D)
    return uv[:, 0]


@properties
@given(T=poses, seed=st.integers(0, 10**6))
def test_opencv_reads_back_lens_pose_and_covariance(T, seed):
    covariance = random_covariance(seed)
    calibration = with_pose(T, covariance)
    text = text_of(calibration, "opencv", parent="cell", child="eye")
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    camera = calibration.cell.cameras[CAMERA]
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), camera.intrinsics.K)
    D = storage.getNode("distortion_coefficients").mat()
    np.testing.assert_array_equal(D.ravel(), camera.intrinsics.dist_coeffs)
    size = storage.getNode("image_width").real(), storage.getNode("image_height").real()
    assert size == camera.image_size
    same_pose(storage.getNode("T_parent_child").mat(), T)
    assert storage.getNode("parent_frame").string() == "cell"
    assert storage.getNode("child_frame").string() == "eye"
    labels = storage.getNode("covariance_labels")
    assert [labels.at(i).string() for i in range(labels.size())] == list(CAMERA_TANGENT)
    same_covariance(storage.getNode("covariance").mat(), covariance)


def mrcal_project(model: dict, points: np.ndarray) -> np.ndarray:
    """mrcal's definition: x_cam = R(r) x_ref + t, then OpenCV's lens."""
    fx, fy, cx, cy, *terms = model["intrinsics"]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rt = np.array(model["rt_cam_ref"])
    return cv2.projectPoints(points, rt[:3], rt[3:], K, np.array(terms))[0][:, 0]


@properties
@given(T=poses)
def test_mrcals_model_sees_the_same_pixels(T):
    calibration = with_pose(T)
    model = ast.literal_eval(text_of(calibration, "mrcal"))
    camera = calibration.cell.cameras[CAMERA]
    assert model["lensmodel"] == model["lens_model"] == "LENSMODEL_OPENCV4"
    assert model["rt_cam_ref"] == model["extrinsics"]
    assert tuple(model["imagersize"]) == camera.image_size
    R, _ = cv2.Rodrigues(np.array(model["rt_cam_ref"][:3]))
    same_pose(np.linalg.inv(pose(R, model["rt_cam_ref"][3:])), T)
    if np.linalg.norm(T[:3, 3]) < 100:
        uv = mrcal_project(model, points_in_view(camera))
        np.testing.assert_allclose(uv, pixels_of_cell(calibration.cell), atol=1e-7)


def read_camchain(text: str) -> list[dict]:
    """As Kalibr's ConfigReader checks and takes it."""
    chain = yaml.safe_load(text)
    cameras = [chain[f"cam{i}"] for i in range(len(chain))]
    for i, camera in enumerate(cameras):
        assert camera["camera_model"] == "pinhole"
        assert camera["distortion_model"] == "radtan"
        assert len(camera["intrinsics"]) == len(camera["distortion_coeffs"]) == 4
        assert all(isinstance(x, float) for x in camera["intrinsics"])
        assert all(isinstance(x, float) for x in camera["distortion_coeffs"])
        assert all(isinstance(x, int) for x in camera["resolution"])
        assert isinstance(camera["rostopic"], str)
        assert ("T_cn_cnm1" in camera) == (i > 0)
    return cameras


def test_kalibrs_chain_goes_from_each_camera_to_the_next():
    calibration = two_cameras()
    first, second = read_camchain(text_of(calibration, "kalibr"))
    left, right = calibration.cell.cameras.values()
    lens = left.intrinsics
    assert first["intrinsics"] == [lens.fu, lens.fv, lens.u0, lens.v0]
    assert first["distortion_coeffs"] == [lens.k1, lens.k2, lens.p1, lens.p2]
    assert first["cam_overlaps"] == [1]
    T = np.array(second["T_cn_cnm1"])
    # a base point seen from both
    x = np.array([0.2, 0.1, -0.1, 1.0])
    in_left, in_right = (np.linalg.solve(c.T_base_camera, x) for c in (left, right))
    np.testing.assert_allclose(T @ in_left, in_right, atol=1e-12)
    same_pose(T, np.linalg.solve(right.T_base_camera, left.T_base_camera))
    (alone,) = read_camchain(text_of(calibration, "kalibr", camera="right"))
    assert alone["rostopic"] == "/right/image_raw"


def test_kalibr_refuses_what_it_cannot_read():
    from dataclasses import replace

    base = calibrated()
    camera = base.cell.cameras[CAMERA]
    outside = replace(camera, intrinsics=replace(camera.intrinsics, u0=-3.0))
    bad = replace(base, cell=replace(base.cell, cameras={CAMERA: outside}))
    with pytest.raises(DataError, match="no negative principal point"):
        lc.export(bad, "kalibr")


@pytest.mark.parametrize("value", [1e-05, -1.5e-300, 1e22, 0.0, -0.0, 5e-324, 0.1, 1e16, 123.0])
def test_numbers_stay_numbers_to_readers_of_yaml_1_1(value):
    from lasercal_gtsam.formats.text import number

    back = yaml.safe_load(number(value))
    assert isinstance(back, float)
    assert back == value


@properties
@given(T=poses, seed=st.integers(0, 10**6))
def test_plain_data_holds_everything_to_the_last_digit(T, seed):
    calibration = with_pose(T, random_covariance(seed))
    camera = calibration.cell.cameras[CAMERA]
    data = json.loads(text_of(calibration, "json"))
    np.testing.assert_array_equal(data["cameras"][CAMERA]["T_base_camera"]["matrix"], T)
    np.testing.assert_array_equal(data["cameras"][CAMERA]["K"], camera.intrinsics.K)
    np.testing.assert_array_equal(data["covariance"]["matrix"], calibration.covariance)
    assert tuple(data["covariance"]["labels"]) == calibration.labels
    with np.load(io.BytesIO(lc.export(calibration, "npz").content)) as arrays:
        np.testing.assert_array_equal(arrays["T_base_camera"], T[None])
        np.testing.assert_array_equal(arrays["intrinsics"], camera.intrinsics.vector[None])
        assert tuple(arrays["intrinsic_names"]) == INTRINSIC_NAMES
        np.testing.assert_array_equal(arrays["covariance"], calibration.covariance)
        assert tuple(arrays["labels"]) == calibration.labels
        n = arrays["plane_normal_base"][0]
        np.testing.assert_allclose(arrays["plane_tangent_base"][0].T @ n, 0, atol=1e-15)


def test_a_camera_alone_leaves_the_others_out_of_the_covariance():
    calibration = two_cameras()
    data = json.loads(text_of(calibration, "json", camera="right"))
    assert list(data["cameras"]) == ["right"]
    kept = [i for i, label in enumerate(calibration.labels) if not label.startswith("left.")]
    np.testing.assert_array_equal(
        data["covariance"]["matrix"], calibration.covariance[np.ix_(kept, kept)]
    )


@pytest.mark.parametrize("form", FORMATS)
def test_the_same_calibration_gives_the_same_bytes(form):
    assert lc.export(calibrated(), form).content == lc.export(calibrated(), form).content


@pytest.mark.parametrize("form", ["ros1-tf", "ros2-launch", "urdf", "ros-pose"])
def test_a_wrong_quaternion_order_is_caught_before_anything_is_written(form, tmp_path, monkeypatch):
    def wrong(fmt, R):
        from lasercal_gtsam.io.conventions import columns_from_rotations

        found = columns_from_rotations(fmt, R)
        return np.roll(found, 1, axis=1)

    for module in (ros_transform, __import__("lasercal_gtsam.formats.urdf", fromlist=["urdf"])):
        monkeypatch.setattr(module, "columns_from_rotations", wrong)
    target = tmp_path / "out"
    target.write_text("old")
    with pytest.raises(DataError, match="nothing was written"):
        lc.export(calibrated(), form, target)
    assert target.read_text() == "old"


def test_a_covariance_in_the_wrong_axes_is_caught(monkeypatch):
    from lasercal_gtsam.formats import ros_pose

    monkeypatch.setattr(ros_pose, "fixed_axes_covariance", lambda C, R: C)
    with pytest.raises(DataError, match="covariance differs"):
        lc.export(calibrated(), "ros-pose")


def test_frames_and_units_are_in_the_files():
    for form in ("ros-pose", "ros1-tf", "ros2-launch", "urdf", "xacro", "mrcal", "opencv", "json"):
        text = text_of(calibrated(), form, parent="robot", child="eye")
        for word in ("'eye'", "'robot'", "metres, radians"):
            assert word in text, (form, word)
    assert "centre of the top-left pixel" in text_of(calibrated(), "ros-camera-info")


def test_rotations_off_by_rounding_are_written_as_the_nearest_rotation():
    T = pose(rotation_zyx(0.2, 0.3, 0.4), [0, 0, 1])
    T[:3, :3] += 1e-8 * np.array([[1, 2, -1], [0, 1, 1], [-2, 0, 1]])
    U, _, Vt = np.linalg.svd(T[:3, :3])
    found, _, _ = read_transform("urdf", text_of(with_pose(T), "urdf"))
    same_pose(found, pose(U @ Vt, [0, 0, 1]))


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"parent": "/base"}, "not beginning with a slash"),
        ({"parent": "a b"}, "expected letters, digits"),
        ({"child": 'x"; rm -rf'}, "expected letters, digits"),
        ({"child": "base"}, "given for the parent and for the camera"),
        ({"camera": "other"}, "'other' is not among them"),
        ({"skew": "drop"}, "expected 'refuse' or 'refit'"),
    ],
)
def test_wrong_choices_are_refused(choices, words):
    with pytest.raises(DataError, match=words):
        lc.export(calibrated(), "ros2-tf", **choices)


def test_several_cameras_need_a_name():
    with pytest.raises(DataError, match="left, right; none was named"):
        lc.export(two_cameras(), "urdf")
    with pytest.raises(DataError, match="did you mean 'kalibr'"):
        lc.export(two_cameras(), "kalib")


def test_what_has_no_sigmas_or_did_not_converge_is_refused():
    from dataclasses import replace

    base = calibrated()
    unknown = replace(base, covariance=np.full_like(base.covariance, np.nan))
    with pytest.raises(DataError, match="no degrees of freedom"):
        lc.export(unknown, "ros-pose")
    with pytest.raises(DataError, match="no sigmas"):
        lc.export(unknown, "gtsam")
    assert "no covariance was written" in lc.export(unknown, "opencv").notes[0]
    assert json.loads(text_of(unknown, "json"))["covariance"]["matrix"][0][0] is None
    unseen = replace(base, labels=tuple(f"x{label}" for label in base.labels))
    with pytest.raises(DataError, match="no spot of it"):
        lc.export(unseen, "ros-pose")
    bad = replace(base, fit=replace(base.fit, converged=False, status="not to be trusted: x"))
    with pytest.raises(DataError, match="not to be trusted"):
        lc.export(bad, "urdf")
    assert lc.export(bad, "urdf", keep_unconverged=True).content


def test_a_held_pose_has_a_zero_covariance_and_says_so():
    done = lc.export(with_pose(np.eye(4), np.zeros((15, 15))), "ros-pose")
    assert "held" in done.notes[0]
    assert not any(yaml.safe_load(done.content)["pose"]["covariance"])


@pytest.mark.parametrize("reader", ["yourdfpy", "urdf_parser_py"])
def test_urdf_libraries_read_the_joint(reader, tmp_path):
    """Where they are installed; near a pitch of 90 deg."""
    T = pose(rotation_zyx(0.3, np.pi / 2 - 1e-9, -1.1), [0.5, -0.2, 0.7])
    path = tmp_path / "cell.urdf"
    lc.export(with_pose(T), "urdf", path)
    if reader == "yourdfpy":
        yourdfpy = pytest.importorskip("yourdfpy")
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
        (joint,) = robot.robot.joints
        same_pose(joint.origin, T)
    else:
        parser = pytest.importorskip("urdf_parser_py.urdf")
        (joint,) = parser.URDF.from_xml_string(path.read_bytes()).joints
        roll, pitch, yaw = joint.origin.rpy
        same_pose(pose(rotation_zyx(yaw, pitch, roll), joint.origin.xyz), T)
    assert (joint.parent, joint.child) == ("base", "camera_optical_frame")
