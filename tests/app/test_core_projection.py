"""The forward chain against OpenCV and against the ways back; what cannot be is NaN."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lasercal_gtsam as lc
from lasercal_gtsam.projection import (
    distort,
    normalized_from_pixel,
    point_jacobian,
    project_points,
    undistort,
)
from lasercal_gtsam.simulate import simulate

SIZE = (640, 480)
INTRINSICS = [
    lc.Intrinsics(550, 540, 0, 320, 240),
    lc.Intrinsics(550, 540, 0, 311, 250, k1=-0.3, k2=0.12),
    lc.Intrinsics(550, 540, 0, 311, 250, k1=0.2, k2=-0.05, p1=0.004, p2=-0.006),
]


def pose(rotvec, t) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    T[:3, 3] = t
    return T


def camera(intrinsics: lc.Intrinsics) -> lc.Camera:
    return lc.Camera(intrinsics, pose([0.4, -1.1, 2.0], [0.3, -0.2, 0.5]), SIZE)


def points_before(seen: lc.Camera, n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.2, 0.9, n)
    xy = rng.uniform([-0.5, -0.4], [0.5, 0.4], (n, 2))
    local = np.column_stack([xy * depth[:, None], depth])
    return local @ seen.T_base_camera[:3, :3].T + seen.T_base_camera[:3, 3]


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_pixels_are_those_of_opencv(intrinsics):
    seen = camera(intrinsics)
    points = points_before(seen)
    inverse = np.linalg.inv(seen.T_base_camera)
    rvec = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
    expected, _ = cv2.projectPoints(
        points, rvec, inverse[:3, 3], intrinsics.K, intrinsics.dist_coeffs
    )
    np.testing.assert_allclose(project_points(points, seen), expected[:, 0], rtol=0, atol=1e-9)


def test_skew_shears_the_image():
    plain = lc.Intrinsics(550, 540, 0, 311, 250, k1=-0.3)
    skewed = lc.Intrinsics(550, 540, 5.0, 311, 250, k1=-0.3)
    points = points_before(camera(plain))
    uv, moved = project_points(points, camera(plain)), project_points(points, camera(skewed))
    np.testing.assert_array_equal(moved[:, 1], uv[:, 1])
    np.testing.assert_allclose(moved[:, 0] - uv[:, 0], 5.0 * (uv[:, 1] - 250) / 540, atol=1e-9)


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_undistort_is_the_inverse_of_distort(intrinsics):
    xy = np.random.default_rng(2).uniform(-0.5, 0.5, (300, 2))
    np.testing.assert_allclose(
        undistort(distort(xy, intrinsics), intrinsics), xy, rtol=0, atol=1e-13
    )
    skewed = lc.Intrinsics(*intrinsics.vector[:2], 3.0, *intrinsics.vector[3:])
    seen = lc.Camera(skewed, np.eye(4), SIZE)
    uv = project_points(np.column_stack([xy, np.ones(len(xy))]), seen)
    np.testing.assert_allclose(normalized_from_pixel(uv, skewed), xy, rtol=0, atol=1e-13)


def test_beyond_the_fold_there_is_no_way_back():
    intrinsics = lc.Intrinsics(500, 500, 0, 320, 240, k1=-0.5)
    radius = np.sqrt(1 / 1.5)  # 1 - 1.5 r^2 = 0
    largest = radius * (1 - 0.5 * radius**2)
    inside, outside = undistort(np.array([[0.999 * largest, 0], [1.001 * largest, 0]]), intrinsics)
    assert 0 < inside[0] < radius
    assert np.isnan(outside).all()
    # the mirrored image of a point outside the fold is not shown either
    seen = lc.Camera(intrinsics, np.eye(4), SIZE)
    uv = project_points(np.array([[0.99 * radius, 0, 1], [1.01 * radius, 0, 1]]), seen)
    assert np.isfinite(uv[0]).all()
    assert np.isnan(uv[1]).all()


@pytest.mark.parametrize("preset", ["paper", "paper-distorted", "table2-4", "tool-z"])
def test_three_ways_to_the_spot_agree(preset):
    made = simulate(preset, seed=5)
    cell, seen = made.truth, made.observations
    plane = seen.plane.tolist()
    by_beam = lc.spot_on_beam(cell, seen.T_base_hand, plane=plane)
    by_ray = lc.spot_on_ray(cell, seen.uv, plane=plane)
    by_both = lc.spot_triangulated(cell, seen.uv, seen.T_base_hand)
    np.testing.assert_allclose(by_ray, by_beam, rtol=0, atol=1e-12)
    np.testing.assert_allclose(by_both, by_beam, rtol=0, atol=1e-12)
    for k, name in enumerate(plane):  # on the plane and on the beam, by their definitions
        n, d = cell.planes[name].normal_base, cell.planes[name].distance
        assert abs(n @ by_beam[k] - d) < 1e-13
        local = np.linalg.solve(seen.T_base_hand[k], np.r_[by_beam[k], 1.0])[:3]
        beam = cell.lasers["laser"]
        off = np.cross(beam.direction_hand, local - beam.point_hand)
        assert np.linalg.norm(off) < 1e-13


def test_the_triangulated_point_is_halfway_between_skew_lines():
    seen = lc.Camera(lc.Intrinsics(500, 500, 0, 320, 240), np.eye(4), SIZE)
    beam = lc.Beam([1.0, 0, 0], [0, 0.02, 0.5])  # 20 mm below the optical axis
    cell = lc.Cell({"camera": seen}, {"laser": beam})
    found = lc.spot_triangulated(cell, np.array([320.0, 240.0]), np.eye(4))
    np.testing.assert_allclose(found, [[0, 0.01, 0.5]], rtol=0, atol=1e-15)


@pytest.mark.parametrize("intrinsics", INTRINSICS)
def test_point_jacobian_is_the_derivative(intrinsics):
    seen = camera(lc.Intrinsics(*intrinsics.vector[:2], 2.5, *intrinsics.vector[3:]))
    points, h = points_before(seen, 20), 1e-6
    J = point_jacobian(points, seen)
    for k in range(3):
        step = h * np.eye(3)[k]
        slope = (project_points(points + step, seen) - project_points(points - step, seen)) / (
            2 * h
        )
        np.testing.assert_allclose(J[:, :, k], slope, rtol=1e-6, atol=1e-4)


# --- what cannot be, and names ------------------------------------------------------------------


def tabletop() -> lc.Cell:
    """Camera looking straight down on z = 0 from 1 m; beam along the hand's z."""
    down = lc.Camera(lc.Intrinsics(500, 500, 0, 320, 240), pose([np.pi, 0, 0], [0, 0, 1.0]), SIZE)
    planes = {"table": lc.Plane([0, 0, 1], 0.0), "above": lc.Plane([0, 0, 1], 2.0)}
    return lc.Cell({"camera": down}, {"laser": lc.Beam([0, 0, 1], [0, 0, 0])}, planes)


def test_impossible_spots_are_nan():
    cell, at = tabletop(), [0.0, 0.0, 0.5]
    down, up, level = pose([np.pi, 0, 0], at), pose([0, 0, 0], at), pose([0, np.pi / 2, 0], at)
    level[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # exactly parallel
    poses = np.stack([down, up, level])
    table = lc.project(cell, poses, plane="table")
    np.testing.assert_allclose(table[0], [320, 240], rtol=0, atol=1e-9)
    assert np.isnan(table[1:]).all()  # pointing away, parallel
    assert np.isnan(lc.spot_on_beam(cell, poses, plane="table")[1:]).all()
    # upwards the spot on the upper plane exists but lies behind the camera
    assert np.isfinite(lc.spot_on_beam(cell, up, plane="above")).all()
    assert np.isnan(lc.project(cell, up, plane="above")).all()
    assert np.isnan(lc.spot_on_ray(cell, [320.0, 240.0], plane="above")).all()
    # the ray through the image centre is the very line of the beam
    assert np.isnan(lc.spot_triangulated(cell, [320.0, 240.0], down)).all()


def test_wrong_names_and_shapes_are_told():
    cell, T = tabletop(), np.eye(4)
    with pytest.raises(lc.DataError, match=r"plane: the cell has \['above', 'table'\]; say which"):
        lc.project(cell, T)
    with pytest.raises(lc.DataError, match=r"plane: 'tabel' is not in the cell, .*'table'"):
        lc.project(cell, T, plane="tabel")
    with pytest.raises(lc.DataError, match=r"camera: 'left' is not in the cell, .*'camera'"):
        lc.project(cell, T, plane="table", camera="left")
    with pytest.raises(lc.DataError, match=r"laser: 'red' is not in the cell, .*'laser'"):
        lc.spot_on_beam(cell, T, plane="table", laser="red")
    with pytest.raises(lc.DataError, match="plane: expected one name or 1 names"):
        lc.project(cell, T, plane=["table", "above"])
    with pytest.raises(lc.DataError, match=r"T_base_hand: expected shape \(4, 4\) or \(N, 4, 4\)"):
        lc.project(cell, np.eye(3), plane="table")
    with pytest.raises(lc.DataError, match=r"uv: expected shape \(2\) or \(N, 2\)"):
        lc.spot_on_ray(cell, np.zeros((2, 3)), plane="table")
    with pytest.raises(lc.DataError, match="2 pixels but 1 hand poses"):
        lc.spot_triangulated(cell, np.zeros((2, 2)), T)


def test_names_choose_the_parts_row_by_row():
    cell = tabletop()
    left = lc.Camera(lc.Intrinsics(700, 700, 0, 100, 100), pose([np.pi, 0, 0], [0.1, 0, 1]), SIZE)
    slanted = lc.Beam([0, 0.6, 0.8], [0, 0, 0])
    cell = lc.Cell({**cell.cameras, "left": left}, {**cell.lasers, "slanted": slanted}, cell.planes)
    T = pose([np.pi, 0, 0], [0.0, 0.0, 0.4])
    cameras, lasers = ["camera", "left", "camera"], ["laser", "slanted", "slanted"]
    together = lc.project(cell, np.stack([T] * 3), plane="table", camera=cameras, laser=lasers)
    for k in range(3):
        alone = lc.project(cell, T, plane="table", camera=cameras[k], laser=lasers[k])
        np.testing.assert_array_equal(together[k], alone[0])
    # by hand: the slanted beam hits (0, -0.3, 0); seen from (0.1, 0, 1) downwards
    np.testing.assert_allclose(together[1], [100 - 70, 100 + 210], rtol=0, atol=1e-9)
