"""Flat places and contour lines: against known shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from figure_cases import usual

import lasercal_gtsam as lc
from lasercal_gtsam.figures.contours import (
    contour_lines,
    even_levels,
    round_up,
    row_of_levels,
)
from lasercal_gtsam.figures.places import (
    PlaneAxes,
    area,
    clipped,
    hull,
    inside,
    picture_border,
    view_outline,
)
from lasercal_gtsam.projection import project_points
from lasercal_gtsam.simulate.cells import looking_at

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def camera_over(target, centre=(0.0, 0.0, 1.0), **lens):
    pose = looking_at(np.array(centre), np.array(target, dtype=float))
    return lc.Camera(lc.Intrinsics(500.0, 500.0, 0.0, 319.5, 239.5, **lens), pose, (640, 480))


def cell_with(camera, plane):
    return lc.Cell({"c": camera}, {}, {"p": plane})


def test_on_a_horizontal_table_the_axes_are_the_bases():
    table = lc.Plane.from_point(np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.2, -0.12]))
    camera = camera_over((0.5, 0.2, -0.12), (0.3, 0.1, 0.8))
    axes = PlaneAxes.of(table, camera)
    xy = axes.to_plane_mm(np.array([[0.5, 0.2, -0.12], [-0.1, 0.0, -0.12]]))
    np.testing.assert_allclose(xy, [[500.0, 200.0], [-100.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(axes.to_base(xy)[0], [0.5, 0.2, -0.12], atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_plane_is_never_seen_in_a_mirror(side):
    """A turn to the left on the drawing is one in the picture, from whichever side it is seen."""
    plane = lc.Plane.from_point(np.array([0.2, 0.9, 0.3]), np.array([0.1, 0.4, 0.1]))
    foot = np.array([0.1, 0.4, 0.1])
    camera = camera_over(foot, foot + side * 0.7 * plane.normal_base)
    axes = PlaneAxes.of(plane, camera)
    on_drawing = axes.to_plane_mm(foot[None])[0] + np.array([[0, 0], [10, 0], [0, 10.0]])
    uv = project_points(axes.to_base(on_drawing), camera)
    a, b = uv[1] - uv[0], uv[2] - uv[0]
    assert a[0] * b[1] - a[1] * b[0] < 0  # v runs down: anticlockwise is negative


def test_hull_area_and_what_is_inside():
    rng = np.random.default_rng(0)
    points = np.concatenate([SQUARE, rng.uniform(0.1, 1.9, (50, 2))])
    border = hull(points)
    assert {tuple(p) for p in border} == {tuple(p) for p in SQUARE}
    assert area(border) == pytest.approx(4.0)
    queries = np.array([[1.0, 1.0], [2.0, 1.0], [2.001, 1.0], [-1.0, 1.0]])
    assert inside(queries, border).tolist() == [True, True, False, False]
    assert inside(queries, border[::-1]).tolist() == [True, True, False, False]


@pytest.mark.parametrize("points", [np.zeros((0, 2)), SQUARE[:2], np.outer(np.arange(5.0), [1, 2])])
def test_a_line_or_less_has_no_hull(points):
    assert hull(points).shape == (0, 2)
    assert area(hull(points)) == 0.0
    assert not inside(SQUARE, hull(points)).any()


def test_clipping_leaves_what_both_cover():
    shifted = SQUARE + np.array([1.0, 0.5])
    for window in (shifted, shifted[::-1]):
        assert area(clipped(SQUARE, window)) == pytest.approx(1.5)
    assert len(clipped(SQUARE, SQUARE + 5.0)) == 0
    assert area(clipped(SQUARE, 3 * SQUARE - 2.0)) == pytest.approx(4.0)


def test_a_view_straight_down_is_the_picture_at_the_planes_depth():
    plane = lc.Plane(np.array([0.0, 0.0, -1.0]), 0.5)  # z = -0.5, camera 1.5 m above
    cell = cell_with(camera_over((0.0, 0.0, -0.5)), plane)
    axes = PlaneAxes.of(plane, cell.cameras["c"])
    outline = view_outline(cell, "p", "c", axes)
    assert area(outline) == pytest.approx(1500.0**2 * 640 * 480 / 500.0**2, rel=1e-9)


def test_the_edge_of_a_view_is_the_edge_of_the_picture():
    found = usual()
    for plane in found.cell.planes:
        camera = found.cell.cameras["camera"]
        axes = PlaneAxes.of(found.cell.planes[plane], camera)
        outline = view_outline(found.cell, plane, "camera", axes)
        at = axes.to_base(outline)
        uv = project_points(at, camera)
        known = np.isfinite(uv).all(axis=1)
        # plane 1 is seen to the horizon; what is far away is cut off
        centre = camera.T_base_camera[:3, 3]
        part = found.cell.planes[plane]
        height = abs(part.normal_base @ centre - part.distance)
        known &= np.linalg.norm(at - centre, axis=1) < 7.5 * height
        assert known.sum() > 60
        border = picture_border(camera.image_size)
        away = np.linalg.norm(uv[known, None] - border[None], axis=2).min(axis=1)
        assert away.max() < 1e-6


def test_a_view_to_the_horizon_is_cut_off():
    plane = lc.Plane(np.array([0.0, 0.0, -1.0]), 0.0)
    cell = cell_with(camera_over((1.0, 0.0, 0.9)), plane)  # looks nearly level
    outline = view_outline(cell, "p", "c", PlaneAxes.of(plane, cell.cameras["c"]))
    assert np.isfinite(outline).all()
    assert 1000.0 < np.abs(outline).max() <= 8000.0  # mm; the camera is 1 m up
    away = replace(cell.cameras["c"], T_base_camera=looking_at(np.array([0, 0, 1.0]), [1.0, 0, 3]))
    unseen = cell_with(away, plane)
    assert len(view_outline(unseen, "p", "c", PlaneAxes.of(plane, away))) == 0


def test_contours_of_a_cone_are_circles():
    x, y = np.linspace(-3, 3, 61), np.linspace(-2.5, 3.5, 61)
    X, Y = np.meshgrid(x, y)
    (ring,) = contour_lines(x, y, np.hypot(X, Y), 2.0)
    np.testing.assert_allclose(ring[0], ring[-1])
    np.testing.assert_allclose(np.linalg.norm(ring, axis=1), 2.0, atol=0.005)
    angle = np.unwrap(np.arctan2(ring[:, 1], ring[:, 0]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi)


def test_contours_of_a_plane_are_straight_and_end_at_the_edge():
    x, y = np.linspace(0, 10, 11), np.linspace(0, 5, 6)
    X, Y = np.meshgrid(x, y)
    (line,) = contour_lines(x, y, 2 * X + Y, 7.3)
    np.testing.assert_allclose(2 * line[:, 0] + line[:, 1], 7.3, atol=1e-12)
    assert {round(v, 6) for v in line[[0, -1], 1]} == {0.0, 5.0}


def test_contours_of_a_saddle_never_cross_and_pass_no_hole():
    x = y = np.linspace(-1, 1, 21)
    X, Y = np.meshgrid(x, y)
    z = X * Y
    assert len(contour_lines(x, y, z, 0.2)) == 2
    z[8:13, 8:13] = np.nan
    for level in (-0.1, 0.1):
        for line in contour_lines(x, y, z, level):
            assert (np.abs(line).max(axis=1) >= 0.25 - 1e-9).all()
            np.testing.assert_allclose(line[:, 0] * line[:, 1], level, atol=0.006)
    assert contour_lines(x, y, z, 5.0) == []


def test_levels_are_round_and_within():
    assert even_levels(0.19, 0.33, 4).tolist() == [0.2, 0.25, 0.3]
    assert even_levels(3.0, 17.0, 4).tolist() == [5.0, 10.0, 15.0]
    assert row_of_levels(0.03, 2.0).tolist() == [0.05, 0.1, 0.2, 0.5, 1.0]
    assert len(even_levels(1.0, 1.0, 4)) == len(row_of_levels(0.0, 1.0)) == 0
    assert [round_up(v) for v in (0.03, 0.05, 1.0, 1.01, 730.0)] == [0.05, 0.05, 1.0, 2.0, 1000.0]
