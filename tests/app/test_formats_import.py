"""Intrinsics from other programs' files, and what a calibration makes of them."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from format_cases import CAMERA, calibrated, random_covariance, two_cameras, with_pose

import lasercal_gtsam as lc
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.given_intrinsics import (
    prior_sigmas,
    start_with_intrinsics,
    with_intrinsics,
)

LENS = [612.5, 611.25, 0.0, 322.75, 238.5, -0.31, 0.11, 0.0007, -0.0002]

ROS = """\
image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [612.5, 0, 322.75, 0, 611.25, 238.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.31, 0.11, 7e-4, -0.0002, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0]}
"""

KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.31, 0.11, 0.0007, -0.0002]
  distortion_model: radtan
  intrinsics: [612.5, 611.25, 322.75, 238.5]
  resolution: [640, 480]
  rostopic: /head/image_raw
"""

OPENCV = """\
%YAML:1.0
---
calibration_time: "Thu 02 Jul 2026 10:22:05"
image_width: 640
image_height: 480
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.125e+02, 0., 3.2275e+02, 0., 6.1125e+02, 2.385e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -3.1e-01, 1.1e-01, 7.0e-04, -2.0e-04, 0. ]
avg_reprojection_error: 2.1e-01
"""

OPENCV_XML = """\
<?xml version="1.0"?>
<opencv_storage>
<image_Width>640</image_Width>
<image_Height>480</image_Height>
<Camera_Matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>612.5 0. 322.75 0. 611.25 238.5 0. 0. 1.</data></Camera_Matrix>
<Distortion_Coefficients type_id="opencv-matrix">
  <rows>4</rows><cols>1</cols><dt>d</dt><data>-0.31 0.11 0.0007 -0.0002</data>
</Distortion_Coefficients>
</opencv_storage>
"""

MRCAL = """\
# generated on 2026-07-01 with   mrcal-calibrate-cameras --lensmodel LENSMODEL_OPENCV4
{
    'lensmodel':  'LENSMODEL_OPENCV4',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 612.5, 611.25, 322.75, 238.5, -0.31, 0.11, 0.0007, -0.0002,],
    'rt_cam_ref': [ 0,  0,  0,  0,  0,  0,],
    'imagersize': [ 640, 480,],
}
"""

FILES = {
    "ros.yaml": (ROS, "head"),
    "kalibr.yaml": (KALIBR, "cam0"),
    "opencv.yml": (OPENCV, ""),
    "opencv.xml": (OPENCV_XML, ""),
    "x.cameramodel": (MRCAL, ""),
    "old.cameramodel": (
        MRCAL.replace("lensmodel'", "lens_model'").replace("rt_cam_ref", "extrinsics"),
        "",
    ),
}


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("data: [ 6.125e+02", "data: [ !!binary x", "opencv.yml:11: !!binary: expected no tag but"),
        ("%YAML:1.0\n---\n", "%YAML:1.0\n---\n- 1\n", "OpenCV cannot read it"),
        ("image_width: 640", "image_width: .inf", "image_width: expected a whole number of pixels"),
    ],
)
def test_what_opencv_would_not_come_back_from(old, new, words, tmp_path):
    assert old in OPENCV
    with pytest.raises(lc.DataError, match=re.escape(words)):
        lc.load_intrinsics(written(tmp_path, "opencv.yml", OPENCV.replace(old, new)))


@pytest.mark.parametrize("name", FILES)
def test_files_of_other_programs_give_the_lens(name, tmp_path):
    text, camera = FILES[name]
    found = lc.load_intrinsics(written(tmp_path, name, text))
    np.testing.assert_array_equal(found.intrinsics.vector, LENS)
    assert found.image_size == (640, 480)
    assert found.covariance is None
    assert found.sigmas == {}
    assert found.name == camera


def test_all_of_them_see_the_same_pixels(tmp_path):
    """OpenCV's own projection with the numbers of its file, against ours."""
    from lasercal_gtsam.projection import project_points

    path = written(tmp_path, "opencv.yml", OPENCV)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K, D = (storage.getNode(k).mat() for k in ("camera_matrix", "distortion_coefficients"))
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.5], size=(30, 3))
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)
    camera = lc.Camera(lc.load_intrinsics(path).intrinsics, np.eye(4), (640, 480))
    np.testing.assert_allclose(project_points(points, camera), wanted[:, 0], atol=1e-9)


@pytest.mark.parametrize("form", ["ros-camera-info", "kalibr", "opencv", "mrcal", "json", "npz"])
def test_our_own_exports_come_back(form, tmp_path):
    covariance = random_covariance(3)
    calibration = with_pose(np.eye(4), covariance)
    path = tmp_path / "x"
    lc.export(calibration, form, path)
    found = lc.load_intrinsics(path)
    lens = calibration.cell.cameras[CAMERA].intrinsics
    np.testing.assert_array_equal(found.intrinsics.vector, lens.vector)
    assert found.image_size == (640, 480)
    if form in ("opencv", "json", "npz"):
        np.testing.assert_array_equal(found.covariance, covariance[6:, 6:])
        assert found.sigmas["fu"] == pytest.approx(covariance[6, 6] ** 0.5)
    else:
        assert found.covariance is None


def test_a_calibration_is_a_file_of_intrinsics_too(tmp_path):
    calibration = calibrated()
    calibration.save(tmp_path / "calibration.json")
    found = lc.load_intrinsics(tmp_path / "calibration.json")
    lens = calibration.cell.cameras[CAMERA].intrinsics
    np.testing.assert_array_equal(found.intrinsics.vector, lens.vector)
    np.testing.assert_array_equal(found.covariance, calibration.covariance[6:15, 6:15])


def test_one_of_several_must_be_named(tmp_path):
    path = tmp_path / "chain.yaml"
    lc.export(two_cameras(), "kalibr", path)
    with pytest.raises(DataError, match="the file has cam0, cam1; none was named"):
        lc.load_intrinsics(path)
    assert lc.load_intrinsics(path, "cam1").name == "cam1"
    with pytest.raises(DataError, match="'cam7' is not among them"):
        lc.load_intrinsics(path, "cam7")


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("kalibr.yaml", "pinhole", "omni", r":3: cam0\.camera_model: 'omni' is another model"),
        ("kalibr.yaml", "radtan", "equidistant", r":5: .*'equidistant' is another model"),
        ("kalibr.yaml", "611.25, 322.75", "611.25", r":6: .*expected 4 numbers .*got 3"),
        ("kalibr.yaml", ", -0.0002]", "]", r":4: .*expected 4 numbers \(k1 k2 p1 p2\), got 3"),
        ("kalibr.yaml", "[640, 480]", "[640]", ":7: .*expected 2 numbers"),
        ("kalibr.yaml", "[640, 480]", "[640, -1]", ":7: .*whole numbers above 0"),
        ("kalibr.yaml", "[612.5,", "[-612.5,", "focal lengths must be above 0"),
        ("kalibr.yaml", "  resolution: [640, 480]\n", "", r":1: cam0\.resolution: left out"),
        ("kalibr.yaml", "cam0:", "cam0: {}\ncam0:", "already in line 1"),
        ("ros.yaml", "plumb_bob", "rational_polynomial", ":8: .*another lens model"),
        ("ros.yaml", "plumb_bob", "equidistant", ":8: .*another lens model"),
        ("ros.yaml", "plumb_bob", "plumb", ":8: .*expected plumb_bob"),
        ("ros.yaml", "distortion_model: plumb_bob\n", "", "distortion_model: left out"),
        ("ros.yaml", "cols: 5\n  data: [-0.31, 0.11, 7e-4, -0.0002, 0]",
         "cols: 4\n  data: [-0.31, 0.11, 7e-4, -0.0002]", r":9: .*expected 5 .*got 4"),
        ("ros.yaml", "-0.0002, 0]", "-0.0002, 0.5]", "k3 = 0.5: our model has none"),
        ("ros.yaml", "-0.0002, 0]", "-0.0002]", ":12: .*expected 1 x 5 numbers, got 4"),
        ("ros.yaml", "data: [612.5", "data: [a", ":7: .*expected a list of numbers"),
        ("ros.yaml", "cols: 3\n  data: [612.5", "cols: 2\n  data: [612.5", "expected 3 x 2"),
        ("ros.yaml", "0, 0, 1]\ndist", "0, 1, 1]\ndist", r"expected \[\[fu, skew, u0\]"),
        ("ros.yaml", "image_width: 640", "image_width: 640.5", ":1: .*whole number of pixels"),
        ("ros.yaml", "camera_name: head", "binning_x: 2", ":3: .*binned picture"),
        ("opencv.yml", "camera_matrix", "matrix", "there is no camera_matrix"),
        ("opencv.yml", "-2.0e-04, 0. ]", "-2.0e-04, 0.1 ]", "the rest must be 0"),
        ("opencv.yml", "rows: 5", "rows: 3", "OpenCV matrix of rows x cols"),
        ("opencv.yml", "-2.0e-04, 0. ]", "-2.0e-04, .Nan ]", "must be 0"),
        ("opencv.yml", "6.1125e+02", "-1.", "focal lengths above 0"),
        ("opencv.yml", "image_width: 640", "image_width: 0", "whole number of pixels"),
        ("x.cameramodel", "OPENCV4", "CAHVOR", ":3: lensmodel: .*another lens model"),
        ("x.cameramodel", "OPENCV4", "OPENCV5", ":5: .*expected 9 numbers"),
        ("x.cameramodel", "-0.0002,]", "]", ":5: .*expected 8 numbers"),
        ("x.cameramodel", "'imagersize': [ 640, 480,]", "'imagersize': [ 640 ]", "expected 2"),
        ("x.cameramodel", "}", "", "not a cameramodel"),
        ("x.cameramodel", "'imagersize'", "['imagersize']", "not a cameramodel"),
        ("kalibr.yaml", "[640, 480]", f"[{'9' * 400}, 480]", ":7: .*expected a list of numbers"),
        ("opencv.yml", "image_width: 640", "image_width: wide", "whole number of pixels"),
        ("opencv.yml", "flags: 0", "covariance_labels: [ 1, 2 ]\ncovariance: 3",
         "expected 15 x 15"),
        ("x.cameramodel", "612.5", "__import__('os')", "not a cameramodel"),
    ],
)  # fmt: skip
def test_what_is_not_our_lens_is_named_with_its_line(name, old, new, words, tmp_path):
    text = FILES[name][0]
    changed = text.replace(old, new)
    if name == "x.cameramodel" and old == "OPENCV4":
        changed = text.replace("'LENSMODEL_OPENCV4'", f"'LENSMODEL_{new}'")
    assert changed != text
    path = written(tmp_path, name, changed)
    with pytest.raises(DataError, match=words) as error:
        lc.load_intrinsics(path)
    assert str(path) in str(error.value)


def test_all_problems_come_at_once(tmp_path):
    text = KALIBR.replace("radtan", "fov").replace("[640, 480]", "x")
    with pytest.raises(DataError) as error:
        lc.load_intrinsics(written(tmp_path, "k.yaml", text))
    assert len(error.value.problems) == 2


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty"),
        (b"\xff\xfe\x00", "UTF-8"),
        (b"a: 1\n", "no file of intrinsics"),
        (b"- 1\n", "expected a mapping"),
        (b"a: [1\n", "not valid YAML"),
        (b"PK\x03\x04", "not an export of the format npz"),
        (b'{"format": "lasercal-calibration", ', "not JSON"),
        (b'{"format": "lasercal-calibration", "version": 1}', "cameras"),
        (
            b'{"format": "lasercal-cell", "cameras": {}, "lasers": {}, "planes": {}, '
            b'"covariance": [1]}',
            "expected labels and a square matrix",
        ),
        (b"%YAML:1.0\n---\ncamera_matrix: 3\n", "expected an OpenCV matrix"),
        (b"<?xml version='1.0'?><a/>", "OpenCV|there is no camera_matrix"),
    ],
)
def test_files_that_are_something_else_are_refused(content, words, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words):
        lc.load_intrinsics(path)
    with pytest.raises(DataError, match="no such file"):
        lc.load_intrinsics(tmp_path / "missing.yaml")


# --- in a calibration ---------------------------------------------------------------------------


@pytest.fixture
def lens(tmp_path):
    """The lens of a calibration, without and with its covariance."""
    for form in ("ros-camera-info", "json"):
        lc.export(calibrated(), form, tmp_path / form)
    return {form: lc.load_intrinsics(tmp_path / form) for form in ("ros-camera-info", "json")}


def test_known_intrinsics_are_held_to_the_last_digit(lens):
    seen = calibrated().inputs.observations
    given = {CAMERA: lens["ros-camera-info"]}
    options = lc.CalibrationOptions(known={"principal_point": (1, 2), "aspect": 3.0})
    options, words = with_intrinsics(options, seen, given, "known")
    assert words == ()
    found = lc.calibrate(seen, options=options)
    wanted = lens["ros-camera-info"].intrinsics
    np.testing.assert_array_equal(found.cell.cameras[CAMERA].intrinsics.vector, wanted.vector)
    assert not np.diag(found.covariance)[6:15].any()
    assert found["Tz"].sigma < calibrated()["Tz"].sigma


def test_priors_add_what_the_file_knows(lens):
    seen = calibrated().inputs.observations
    options, words = with_intrinsics(lc.CalibrationOptions(), seen, {CAMERA: lens["json"]}, "prior")
    assert "widened" in words[0]
    assert "claim no more" in words[0]
    assert options.known == {"skew": 0.0}  # held where it came from
    base = calibrated()
    factor = options.priors["fu"][1] / base["fu"].sigma
    assert 1 < factor < 3
    for row in ("fu", "v0", "k1", "p2"):
        wanted = (base[row].refined, factor * base[row].sigma)
        assert options.priors[row] == pytest.approx(wanted, rel=1e-9)
    found = lc.calibrate(seen, options=options)
    for row in ("fu", "v0", "k1", "p2"):
        assert 0 < found[row].sigma < base[row].sigma


def test_the_sigma_of_alpha_is_carried_over_from_the_skew(tmp_path):
    calibration = calibrated(skew_held=False)
    lc.export(calibration, "json", tmp_path / "x.json")
    found = lc.load_intrinsics(tmp_path / "x.json")
    seen = calibration.inputs.observations
    options, _ = with_intrinsics(lc.CalibrationOptions(), seen, {CAMERA: found}, "prior")
    row = calibration["alpha_c"]
    factor = options.priors["fu"][1] / calibration["fu"].sigma
    assert options.priors["alpha_c"] == pytest.approx((row.refined, factor * row.sigma), rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_independent_priors_claim_no_more_than_the_files_covariance(seed, lens):
    covariance = random_covariance(seed)[6:, 6:]
    sigmas, _ = prior_sigmas(replace(lens["json"], covariance=covariance))
    fu = lens["json"].intrinsics.fu
    scale = np.ones(9)
    scale[2] = 1 / fu  # alpha_c, at a skew of 0
    variances = np.array(list(sigmas.values())) ** 2
    rows = covariance * np.outer(scale, scale)
    unit = np.sqrt(np.diag(rows))
    excess = np.linalg.eigvalsh((np.diag(variances) - rows) / np.outer(unit, unit))
    assert excess[0] == pytest.approx(0, abs=1e-9)  # nowhere tighter, and no wider than needed
    assert excess[-1] > 0.1


def test_a_prior_needs_sigmas(lens):
    seen = calibrated().inputs.observations
    given = {CAMERA: lens["ros-camera-info"]}
    with pytest.raises(DataError, match=r"without a covariance: .*sigma for fu, fv, alpha_c"):
        with_intrinsics(lc.CalibrationOptions(), seen, given, "prior")
    sigmas = dict.fromkeys(("fu", "fv", "u0", "v0"), 2.0)
    sigmas |= dict.fromkeys(("alpha_c", "k1", "k2", "p1", "p2"), 0.01)
    options, _ = with_intrinsics(lc.CalibrationOptions(), seen, given, "prior", sigmas)
    assert options.priors["fu"] == (given[CAMERA].intrinsics.fu, 2.0)
    assert options.priors["alpha_c"] == (0.0, 0.01)


def test_a_start_is_only_a_start(lens):
    seen = calibrated().inputs.observations
    shifted = replace(
        lens["json"], intrinsics=replace(lens["json"].intrinsics, fu=560.0, fv=561.0, skew=0.0)
    )
    options = lc.CalibrationOptions(known={"skew": 0.0})
    cell = start_with_intrinsics(seen, options, {CAMERA: shifted})
    assert cell.cameras[CAMERA].intrinsics.fu == 560.0
    found = lc.calibrate(seen, initial=cell, options=options)
    for row in calibrated().parameters:
        sigma = row.sigma or 1e-9
        assert found[row.name].refined == pytest.approx(row.refined, abs=0.01 * sigma)
    drawn = calibrated().cell
    changed = start_with_intrinsics(seen, options, {CAMERA: shifted}, drawn)
    assert changed.cameras[CAMERA].intrinsics.fu == 560.0
    assert changed.planes == drawn.planes


def test_a_lens_of_another_camera_is_refused(lens):
    seen = calibrated().inputs.observations
    other = replace(lens["json"], image_size=(1280, 960))
    with pytest.raises(DataError, match="pictures of 1280 x 960 px, but camera 'camera' has 640"):
        with_intrinsics(lc.CalibrationOptions(), seen, {CAMERA: other}, "known")
    with pytest.raises(DataError, match="given for camera 'left'; observed: camera"):
        with_intrinsics(lc.CalibrationOptions(), seen, {"left": lens["json"]}, "known")
    with pytest.raises(DataError, match="expected one of known, prior, start"):
        with_intrinsics(lc.CalibrationOptions(), seen, {CAMERA: lens["json"]}, "guess")
    without = replace(lens["json"], image_size=None)
    assert with_intrinsics(lc.CalibrationOptions(), seen, {CAMERA: without}, "known")
