"""The camera from known points: RQ, resection, focal lengths from planes, known intrinsics."""

from __future__ import annotations

import numpy as np
import pytest

from lasercal_gtsam.cell import Camera, Intrinsics, Plane
from lasercal_gtsam.closed_form.camera import (
    FOCAL_GRID,
    KnownIntrinsics,
    PlaneViews,
    camera_position,
    cameras_from_points,
    focal_lengths,
    impose,
    plane_frames,
    plane_homographies,
    resection,
    rotation_from_planes,
    upper_triangular_times_rotation,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.projection import project_points
from lasercal_gtsam.rotations import make_pose, rotation_exp

IMAGE = (800, 600)


def scene(fu=700.0, fv=650.0, skew=0.0, tilts=((30, 40), (-25, 10), (15, -60)), seed=0):
    """Camera, and points on planes in front of it with their exact pixels."""
    rng = np.random.default_rng(seed)
    pose = make_pose(rotation_exp(np.array([0.4, -1.1, 0.7])), np.array([0.3, -0.2, 0.9]))
    camera = Camera(Intrinsics(fu, fv, skew, 410.0, 290.0), pose, IMAGE)
    R, T = pose[:3, :3], pose[:3, 3]
    points, normals, xy = [], [], []
    for tilt, azimuth in np.radians(tilts):
        n = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
        plane = Plane.from_point(R @ np.array(n), T + rng.uniform(0.3, 0.6) * R[:, 2])
        rays = np.column_stack([rng.uniform(-0.3, 0.3, (12, 2)), np.ones(12)]) @ R.T
        depth = (plane.distance - plane.normal_base @ T) / (rays @ plane.normal_base)
        points.append(T + depth[:, None] * rays)
        normals.append(plane.normal_base)
        xy.append(project_points(points[-1], camera))
    return camera, points, np.array(normals), xy


def check(found, camera, tolerance=1e-9):
    pose = camera.T_base_camera
    assert np.allclose(found.K, camera.intrinsics.K, rtol=0, atol=tolerance * 1000)
    assert np.allclose(found.R, pose[:3, :3], atol=tolerance)
    assert np.allclose(found.T, pose[:3, 3], atol=tolerance)


def test_rq_of_random_cameras():
    rng = np.random.default_rng(0)
    for _ in range(50):
        K = np.triu(rng.normal(size=(3, 3)))
        K[np.diag_indices(3)] = rng.uniform(0.2, 3.0, 3)
        R = rotation_exp(rng.normal(size=3))
        K2, R2 = upper_triangular_times_rotation(K @ R)
        assert np.allclose(K2, K / K[2, 2])
        assert np.allclose(R2, R)
    with pytest.raises(DegenerateError, match="mirrored"):
        upper_triangular_times_rotation(np.diag([1.0, 1.0, -1.0]))


def test_resection_is_exact_with_all_intrinsics():
    camera, points, _, xy = scene(skew=3.0)
    check(resection(np.concatenate(points), np.concatenate(xy)), camera)


def test_resection_needs_six_points():
    with pytest.raises(DegenerateError, match="6 spots or more, got 5"):
        resection(np.zeros((5, 3)), np.zeros((5, 2)))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_focal_lengths_and_pose_from_planes(count):
    camera, points, normals, xy = scene()
    views = PlaneViews.of(points[:count], plane_frames(normals[:count]), xy[:count])
    known = KnownIntrinsics(principal_point=(410.0, 290.0), skew=0.0)
    check(views.camera_by_focal_lengths(known, None), camera)
    check(views.camera_by_focal_lengths(known, 700.0 / 650.0), camera)


def test_known_skew_enters_the_focal_lengths():
    camera, points, normals, xy = scene(skew=12.0)
    views = PlaneViews.of(points[:1], plane_frames(normals[:1]), xy[:1])
    known = KnownIntrinsics(principal_point=(410.0, 290.0), skew=12.0)
    check(views.camera_by_focal_lengths(known, None), camera)


def test_plane_parallel_to_the_image_gives_no_focal_length():
    _, points, normals, xy = scene(tilts=((0, 0),))
    views = PlaneViews.of(points, plane_frames(normals), xy)
    for aspect in (None, 1.0):
        with pytest.raises(DegenerateError, match="20 deg or more"):
            views.camera_by_focal_lengths(KnownIntrinsics((410.0, 290.0), 0.0), aspect)


def test_normal_in_a_coordinate_plane_leaves_one_focal_length_free():
    camera, points, normals, xy = scene(fu=700.0, fv=700.0, tilts=((30, 0),))
    views = PlaneViews.of(points, plane_frames(normals), xy)
    known = KnownIntrinsics((410.0, 290.0), 0.0)
    with pytest.raises(DegenerateError):
        views.camera_by_focal_lengths(known, None)
    check(views.camera_by_focal_lengths(known, 1.0), camera)


def test_pose_with_given_intrinsics():
    camera, points, normals, xy = scene(skew=3.0)
    K, pose = camera.intrinsics.K, camera.T_base_camera
    frames = plane_frames(normals)
    flat = [(X - X.mean(0)) @ B[:, :2] for X, B in zip(points, frames, strict=True)]
    R = rotation_from_planes(K, plane_homographies(flat, xy), frames, np.full(3, 12.0))
    assert np.allclose(R, pose[:3, :3], atol=1e-10)
    T = camera_position(K, R, np.concatenate(points), np.concatenate(xy))
    assert np.allclose(T, pose[:3, 3], atol=1e-10)


def test_homographies_are_scaled_alike():
    G = np.array([np.diag([2.0, 3.0, 4.0]), np.eye(3)])
    square = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.3, 0.6]], dtype=float)
    images = [square @ (g[:2, :2] / g[2, 2]) for g in G]
    found = plane_homographies([square, square], images)
    assert np.allclose(np.linalg.norm(found[:, :, :2], axis=(1, 2)), 1.0)


def test_focal_lengths_weight_the_planes_by_their_spots():
    rng = np.random.default_rng(1)
    G = np.stack([rotation_exp(rng.normal(size=3)) for _ in range(2)])
    G = np.diag([2.0, 2.0, 1.0]) @ G
    bad = G.copy()
    bad[1] = np.diag([1.2, 0.9, 1.0]) @ bad[1]
    heavy = focal_lengths(bad, np.array([1e9, 1.0]), 1.0)
    assert np.allclose(heavy, 2.0, rtol=1e-6)
    assert not np.allclose(focal_lengths(bad, np.array([1.0, 1e9]), 1.0), 2.0, rtol=1e-2)


def test_known_values_are_put_in_and_the_pose_is_fitted_again():
    camera, points, _, xy = scene(fu=700.0, fv=700.0)
    X, m = np.concatenate(points), np.concatenate(xy)
    noisy = m + np.random.default_rng(3).normal(scale=1.0, size=m.shape)
    free = resection(X, noisy)
    known = KnownIntrinsics((410.0, 290.0), 0.0, 1.0)
    found = impose(free, known, X, noisy)
    assert found.K[0, 1] == 0.0
    assert found.K[:2, 2].tolist() == [410.0, 290.0]
    assert found.K[0, 0] == pytest.approx(found.K[1, 1])
    assert found.K[0, 0] == pytest.approx(np.sqrt(free.K[0, 0] * free.K[1, 1]))
    pose = camera.T_base_camera
    assert np.linalg.norm(found.T - pose[:3, 3]) < 0.05
    exact = impose(resection(X, m), known, X, m)
    check(exact, camera, 1e-8)
    given = impose(free, KnownIntrinsics(focal_lengths=(700.0, 690.0)), X, noisy)
    assert np.diag(given.K).tolist() == [700.0, 690.0, 1.0]


def test_every_way_is_tried():
    camera, points, normals, xy = scene(fu=700.0, fv=700.0)
    known = KnownIntrinsics(centre=(400.0, 300.0))
    names = [name for name, _ in cameras_from_points(points, normals, xy, known, 1000.0)]
    assert names[:3] == ["DLT", "zhang", "zhang_f"]
    assert len(names) == 3 + len(FOCAL_GRID)
    one = [n for n, _ in cameras_from_points(points[:1], normals[:1], xy[:1], known, 1000.0)]
    assert one[:2] == ["zhang", "zhang_f"]
    grid = dict(cameras_from_points(points, normals, xy, known, 1000.0))
    assert grid["f = 0.7 diagonals"].K[0, 0] == pytest.approx(700.0)
    given = KnownIntrinsics(principal_point=(410.0, 290.0), focal_lengths=(700.0, 700.0))
    found = dict(cameras_from_points(points[:1], normals[:1], xy[:1], given, 1000.0))
    check(found.pop("known focal lengths"), camera)
    assert not found
    assert list(cameras_from_points([], np.empty((0, 3)), [], known, 1000.0)) == []
