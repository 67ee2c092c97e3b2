"""A skew where the target has no place for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from format_cases import CAMERA, calibrated, skewed

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Intrinsics
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.registry import FORMATS
from lasercal_gtsam.formats.skew import skew_cost_px
from lasercal_gtsam.projection import project_points, ray_in_base

WITHOUT = [f.name for f in FORMATS.values() if f.has_intrinsics and not f.has_skew]


def test_the_cost_of_dropping_it_is_the_largest_over_the_picture():
    camera = skewed().cell.cameras[CAMERA]
    w, h = camera.image_size
    u, v = np.meshgrid(np.arange(0.0, w, 13), [0.0, 1.0, h / 2, h - 2.0, h - 1.0])
    pixels = np.column_stack([u.ravel(), v.ravel()])
    points = camera.T_base_camera[:3, 3] + ray_in_base(pixels, camera)
    values = camera.intrinsics.vector
    values[2] = 0
    dropped = project_points(points, replace(camera, intrinsics=Intrinsics.from_vector(values)))
    cost = np.linalg.norm(dropped - pixels, axis=1).max()
    assert skew_cost_px(camera) == pytest.approx(cost, rel=1e-6)


@pytest.mark.parametrize("form", WITHOUT)
def test_a_skew_that_is_not_zero_is_refused_with_its_cost(form):
    calibration = skewed()
    cost = skew_cost_px(calibration.cell.cameras[CAMERA])
    with pytest.raises(DataError, match="calibrate again with the skew held at 0") as error:
        lc.export(calibration, form)
    assert f"up to {cost:.2g} px" in str(error.value)


@pytest.mark.parametrize("form", ["json", "npz", "gtsam", "urdf", "ros-pose", "ros2-tf"])
def test_formats_that_hold_it_or_have_no_lens_do_not_mind(form):
    assert lc.export(skewed(), form).content


def test_within_its_sigma_it_is_left_out_and_that_is_said():
    calibration = calibrated(skew_held=False)
    skew = calibration.cell.cameras[CAMERA].intrinsics.skew
    i = calibration.labels.index("camera.skew")
    assert 0 < abs(skew) < np.sqrt(calibration.covariance[i, i])
    done = lc.export(calibration, "ros-camera-info")
    assert "zero within its sigma" in done.notes[0]
    assert f"up to {skew_cost_px(calibration.cell.cameras[CAMERA]):.2g} px" in done.notes[0]


def test_refit_is_a_calibration_with_the_skew_held():
    """Not the old numbers without the term: focal lengths, pose and all move with it."""
    calibration = skewed(0.3)
    again = lc.calibrate(
        calibration.inputs.observations, options=lc.CalibrationOptions(known={"skew": 0.0})
    )
    done = lc.export(calibration, "json", skew="refit")
    import json

    found = json.loads(done.content)["cameras"][CAMERA]
    wanted = again.cell.cameras[CAMERA]
    np.testing.assert_allclose(
        list(found["intrinsics"].values()), wanted.intrinsics.vector, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(
        found["T_base_camera"]["matrix"], wanted.T_base_camera, rtol=0, atol=1e-8
    )
    seen = calibration.inputs.observations
    planes = seen.plane.tolist()
    shift = lc.project(again.cell, seen.T_base_hand, plane=planes) - lc.project(
        calibration.cell, seen.T_base_hand, plane=planes
    )
    assert f"move by up to {np.linalg.norm(shift, axis=1).max():.2g} px" in done.notes[0]
    moved = wanted.intrinsics.u0 - calibration.cell.cameras[CAMERA].intrinsics.u0
    assert abs(moved) > 0.01
    for form in WITHOUT:
        assert lc.export(calibration, form, skew="refit").content


def test_refit_says_what_it_puts_aside():
    calibration = skewed()
    options = replace(calibration.inputs.options, known={"skew": 4.0}, priors={"fu": (550.0, 30.0)})
    told = replace(calibration, inputs=replace(calibration.inputs, options=options))
    done = lc.export(told, "urdf", skew="refit")
    assert "in place of what was stated of skew" in done.notes[0]
    assert "the spots speak for a skew of" in done.notes[0]
    assert "speak for" not in lc.export(calibrated(skew_held=False), "urdf", skew="refit").notes[0]


def test_refit_needs_the_spots():
    calibration = skewed()
    few = replace(
        calibration,
        inputs=replace(calibration.inputs, observations=calibration.inputs.observations[:20]),
    )
    with pytest.raises(DataError, match="holds 20 of the 90 spots"):
        lc.export(few, "mrcal", skew="refit")


def test_nothing_is_fitted_where_the_skew_is_zero():
    done = lc.export(calibrated(), "mrcal", skew="refit")
    assert "not fitted again" in done.notes[0]
