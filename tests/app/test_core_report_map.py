"""Rows of the paper's Table 2 and their derivatives by the tangent coordinates of the state."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from lasercal_factors.beam import BeamFrame
from scipy.spatial.transform import Rotation

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.report_map import (
    BeamChart,
    beam_jacobian,
    beam_rows,
    camera_jacobian,
    camera_rows,
    plane_jacobian,
    row_jacobian,
    row_names,
    row_values,
    tangent_labels,
)
from lasercal_gtsam.rotations import basis_of, make_pose
from lasercal_gtsam.units import DEG_PER_RAD

BEAMS = {
    "oblique": ([0.3, -0.5, 0.8], True, 0),
    "paper": ([0.74, 0.3, 0.6], True, 0),
    "nearly tool z": ([0.01, -0.02, 1.0], False, 2),
    "tool z": ([0.0, 0.0, 1.0], False, 2),
    "against tool z": ([0.0, 0.001, -1.0], False, 2),
    "parallel to y-z": ([0.0, 0.6, 0.8], True, 2),
    "nearly parallel to y-z": ([0.05, -0.8, 0.6], True, 1),
    "tool y": ([0.0, 1.0, 0.0], True, 1),
    "tool x": ([1.0, 0.0, 0.0], True, 0),
}


def camera(zyx=(-90.0, -10.0, -170.0)):
    R = Rotation.from_euler("ZYX", zyx, degrees=True).as_matrix()
    return Camera(
        Intrinsics(550, 540, 3.0, 320, 240, -0.5, 1.1, 0.01, -0.02),
        make_pose(R, np.array([0.51, 0.151, 0.43])),
        (640, 480),
    )


def central(function, n, h=1e-6):
    """Derivative of ``function(step)`` (rows) by the steps."""
    columns = [(function(h * e) - function(-h * e)) / (2 * h) for e in np.eye(n)]
    return np.stack(columns, axis=-1)


def test_angles_are_those_of_z_y_x():
    for zyx in ((-90.0, -10.0, -170.0), (30.0, 50.0, -60.0), (179.0, 0.0, 1.0)):
        rows = camera_rows(camera(zyx))
        np.testing.assert_allclose(rows[9:12], zyx, atol=1e-12)
    np.testing.assert_allclose(rows[12:], [510, 151, 430], atol=1e-12)
    assert rows[2] == 3.0 / 550


@pytest.mark.parametrize("zyx", [(-90.0, -10.0, -170.0), (20.0, 75.0, 130.0), (0.0, 0.0, 0.0)])
def test_camera_derivatives(zyx):
    one = camera(zyx)

    def moved(step):
        # a step of gtsam.Pose3 is in the camera frame, rotation first
        pose = gtsam.Pose3(one.T_base_camera).retract(step[:6]).matrix()
        intrinsics = Intrinsics.from_vector(one.intrinsics.vector + step[6:])
        return camera_rows(Camera(intrinsics, pose, one.image_size))

    numerical = central(moved, 15)
    np.testing.assert_allclose(camera_jacobian(one), numerical, rtol=1e-7, atol=2e-6)


@pytest.mark.parametrize("name", BEAMS)
def test_beam_derivatives(name):
    direction, polar, axis = BEAMS[name]
    beam = Beam(direction, [0.004, -0.01, 0.03])
    chart = BeamChart.of(beam)
    assert (chart.polar, chart.axis) == (polar, axis)
    for off in (0.0, 0.1):
        # also about a frame that the beam has moved away from
        frame = BeamFrame.from_line(
            np.array(direction) + off * np.array([0.3, 0.2, -0.1]), [0, 0, 0]
        )
        start = frame.coordinates(beam.direction_hand, beam.point_hand)
        numerical = central(lambda s: beam_rows(Beam(*frame.line(start + s)), chart), 4)  # noqa: B023
        found = beam_jacobian(beam, chart, frame)
        np.testing.assert_allclose(found, numerical, rtol=1e-7, atol=2e-5)


@pytest.mark.parametrize("name", BEAMS)
def test_beam_rows_say_where_the_beam_is(name):
    direction, polar, axis = BEAMS[name]
    beam = Beam(direction, [0.004, -0.01, 0.03])
    rows = dict(
        zip(
            [n for n, _ in BeamChart.of(beam).rows],
            beam_rows(beam, BeamChart.of(beam)),
            strict=True,
        )
    )
    if polar:
        theta, phi = np.radians([rows["laser_theta"], rows["laser_phi"]])
        u = [np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)]  # (5)
        np.testing.assert_allclose(u, beam.direction_hand, atol=1e-15)
    else:
        tilt = np.array([rows["laser_tilt_x"], rows["laser_tilt_y"]])
        u = beam.direction_hand
        np.testing.assert_allclose(np.tan(np.radians(tilt)), u[:2] / u[2], atol=1e-15)
        assert np.abs(tilt).max() < 6.0
    crossing = np.array([rows.get(f"laser_{a}", 0.0) for a in "xyz"]) / 1000
    assert f"laser_{'xyz'[axis]}" not in rows
    off = np.cross(crossing - beam.point_hand, beam.direction_hand)
    np.testing.assert_allclose(off, 0, atol=1e-15)


@pytest.mark.parametrize("distance", [0.3, 1e-3, 0.0])
@pytest.mark.parametrize("normal", [[0.0, 0.0, 1.0], [0.4, -0.5, 0.7], [1.0, 1.0, 1.0]])
def test_plane_derivatives(normal, distance):
    """Through the base origin too, where the vector ``a`` itself says nothing of the normal."""
    plane = Plane(normal, distance)
    n = plane.normal_base

    def moved(step):
        tilted = gtsam.Unit3(n).retract(step[:2]).point3()
        # a = d n, with the sign as it comes: `Plane` would turn a negative distance round
        return 1000 * (distance + step[2]) * np.array(tilted)

    found = plane_jacobian(n, distance)
    np.testing.assert_allclose(found, central(moved, 3), rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(basis_of(n), gtsam.Unit3(n).basis(), atol=1e-15)
    if distance == 0.0:
        np.testing.assert_array_equal(found[:, :2], 0.0)


def two_of_everything():
    beams = {"blue": Beam([0.3, 0.2, 0.9], [0, 0, 0.1]), "red": Beam([0, 0, 1.0], [0.01, 0, 0])}
    planes = {"1": Plane([0, 0, 1.0], 0.2), "table": Plane([0.1, 0.2, 1.0], 0.3)}
    return Cell({"left": camera(), "right": camera((10.0, 20.0, 30.0))}, beams, planes)


def test_rows_of_several_parts_are_prefixed_and_in_order():
    cell = two_of_everything()
    charts = {name: BeamChart.of(beam) for name, beam in cell.lasers.items()}
    names = [name for name, _ in row_names(cell, charts)]
    assert names[:3] == ["left.fu", "left.fv", "left.alpha_c"]
    assert names[15] == "right.fu"
    assert names[30:38] == [
        "blue.laser_theta", "blue.laser_phi", "blue.laser_y", "blue.laser_z",
        "red.laser_tilt_x", "red.laser_tilt_y", "red.laser_x", "red.laser_y",
    ]  # fmt: skip
    assert names[38:] == ["a_1_x", "a_1_y", "a_1_z", "a_table_x", "a_table_y", "a_table_z"]
    values = dict(zip(names, row_values(cell, charts), strict=True))
    assert values["right.theta"] == pytest.approx(10.0)
    assert values["a_1_z"] == pytest.approx(200.0)
    labels = tangent_labels(cell)
    assert labels[0] == "left.rot_x"
    assert labels[30] == "blue.slope_a"
    assert labels[38] == "plane 1.normal_1"
    assert len(labels) == len(names) == 44


def test_the_whole_derivative_is_its_blocks():
    cell = two_of_everything()
    charts = {name: BeamChart.of(beam) for name, beam in cell.lasers.items()}
    frames = {
        name: BeamFrame.from_line(b.direction_hand, b.point_hand) for name, b in cell.lasers.items()
    }
    F = row_jacobian(cell, charts, frames)
    right, red = cell.cameras["right"], cell.lasers["red"]
    np.testing.assert_array_equal(F[15:30, 15:30], camera_jacobian(right))
    np.testing.assert_array_equal(F[34:38, 34:38], beam_jacobian(red, charts["red"], frames["red"]))
    blocks = [(0, 15), (15, 30), (30, 34), (34, 38), (38, 41), (41, 44)]
    inside = np.zeros(F.shape, dtype=bool)
    for a, b in blocks:
        inside[a:b, a:b] = True
    assert not F[~inside].any()


def test_near_gimbal_lock_the_sigma_of_an_angle_grows_without_a_warning():
    F = camera_jacobian(camera((10.0, 90.0, 20.0)))
    assert np.abs(F[9, :3]).max() > 1e10 * DEG_PER_RAD
    assert np.isfinite(camera_rows(camera((10.0, 90.0, 20.0)))).all()
