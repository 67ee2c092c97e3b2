"""Planned hand motions: every spot in view, groups that are groups, orientations that inform."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lasercal_gtsam.cell import Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.simulate import DESIGNS, PRESETS, MotionDesign, simulate, simulate_cell
from lasercal_gtsam.simulate.cells import paper_cell, table2_cell
from lasercal_gtsam.simulate.motions import radial_slope

SEEDS = range(4)
GROUPED = [name for name in PRESETS if PRESETS[name].shots > 1]


def beams(simulation):
    """Direction, point, unit normal and distance per spot, straight from the definitions."""
    truth, seen = simulation.truth, simulation.observations
    beam = truth.lasers["laser"]
    R, t = seen.T_base_hand[:, :3, :3], seen.T_base_hand[:, :3, 3]
    u = np.einsum("kij,j->ki", R, beam.direction_hand)
    q = np.einsum("kij,j->ki", R, beam.point_hand) + t
    n = np.array([truth.planes[name].normal_base for name in seen.plane])
    d = np.array([truth.planes[name].distance for name in seen.plane])
    return u, q, n, d


def spots(simulation):
    """Spots (N, 3) in the base from 3x3 linear systems: on the plane, and on the beam twice."""
    u, q, n, d = beams(simulation)
    points = []
    for uk, qk, nk, dk in zip(u, q, n, d, strict=True):
        _, _, across = np.linalg.svd(uk[None])
        system = np.vstack([nk, across[1:]])
        points.append(np.linalg.solve(system, [dk, across[1] @ qk, across[2] @ qk]))
    return np.array(points)


def opencv_pixels(points, camera):
    """Distorted normalised coordinates by OpenCV, then the camera matrix (which holds the skew)."""
    R, centre = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    rvec, _ = cv2.Rodrigues(np.ascontiguousarray(R.T))
    distorted, _ = cv2.projectPoints(
        points, rvec, -R.T @ centre, np.eye(3), camera.intrinsics.dist_coeffs
    )
    return cv2.convertPointsToHomogeneous(distorted)[:, 0] @ camera.intrinsics.K[:2].T


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("preset", PRESETS)
def test_exact_pixels_agree_with_an_independent_chain(preset, seed):
    simulation = simulate(preset, seed)
    expected = opencv_pixels(spots(simulation), simulation.truth.cameras["camera"])
    np.testing.assert_allclose(simulation.observations.uv, expected, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_spot_is_well_in_view(preset, seed):
    simulation = simulate(preset, seed)
    design = DESIGNS[PRESETS[preset].design]
    camera = simulation.truth.cameras["camera"]
    u, q, _, _ = beams(simulation)
    points = spots(simulation)
    in_camera = (points - camera.T_base_camera[:3, 3]) @ camera.T_base_camera[:3, :3]
    uv, (width, height) = simulation.observations.uv, camera.image_size

    assert np.einsum("ki,ki->k", points - q, u).min() >= 0.015
    assert in_camera[:, 2].min() >= design.depth[0]
    assert in_camera[:, 2].max() <= design.depth[1]
    assert uv.min() >= 12
    assert np.all(uv.max(axis=0) <= (width - 13, height - 13))
    farthest = np.linalg.norm(in_camera[:, :2] / in_camera[:, 2:], axis=1).max()
    r = np.linspace(0, farthest, 400)
    k1, k2 = camera.intrinsics.k1, camera.intrinsics.k2
    assert np.gradient(r + k1 * r**3 + k2 * r**5, r).min() > 0.19


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("preset", PRESETS)
def test_the_beam_comes_from_the_camera_s_side_within_the_cone(preset, seed):
    simulation = simulate(preset, seed)
    design = DESIGNS[PRESETS[preset].design]
    u, q, n, d = beams(simulation)
    centre = simulation.truth.cameras["camera"].T_base_camera[:3, 3]
    camera_side = np.sign(n @ centre - d)
    np.testing.assert_array_equal(np.sign(np.einsum("ki,ki->k", n, q) - d), camera_side)
    towards = -camera_side * np.einsum("ki,ki->k", n, u)
    assert towards.min() >= np.cos(design.cone) - 1e-12


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("preset", GROUPED)
def test_groups_are_pure_translations_along_three_axes(preset, seed):
    simulation = simulate(preset, seed)
    design, poses = DESIGNS[PRESETS[preset].design], simulation.observations.T_base_hand
    for label in np.unique(simulation.group):
        rows = np.flatnonzero(simulation.group == label)
        assert len(rows) == 10
        assert len(set(simulation.observations.plane[rows])) == 1
        assert len(np.unique(poses[rows, :3, :3].reshape(10, 9), axis=0)) == 1  # to the last bit
        moves = poses[rows[1:], :3, 3] - poses[rows[0], :3, 3]
        ends = moves[2::3]
        lengths = np.linalg.norm(ends, axis=1)
        assert lengths.min() >= design.shortest * (1 - 1e-12)
        assert lengths.max() <= design.longest * (1 + 1e-12)
        np.testing.assert_allclose(ends @ ends.T, np.diag(lengths**2), atol=1e-15)
        np.testing.assert_allclose(moves[0::3], ends / 3, atol=1e-15)
        np.testing.assert_allclose(moves[1::3], ends * 2 / 3, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("preset", GROUPED)
def test_every_plane_has_three_orientations_that_are_not_about_one_axis(preset, seed):
    simulation = simulate(preset, seed)
    for name in simulation.observations.planes:
        on_plane = simulation.observations.plane == name
        _, first = np.unique(simulation.group[on_plane], return_index=True)
        R = simulation.observations.T_base_hand[on_plane][first, :3, :3]
        assert len(R) == PRESETS[preset].groups >= 3
        turns = np.array([cv2.Rodrigues(np.ascontiguousarray(Rk @ R[0].T))[0][:, 0] for Rk in R])
        angles = [np.linalg.norm(a) for a in turns[1:]]
        assert min(angles) > np.radians(0.5)
        assert np.linalg.svd(turns)[1][1] > np.radians(1.0)


def test_arbitrary_poses_share_no_rotation():
    simulation = simulate("no-groups")
    R = simulation.observations.T_base_hand[:, :3, :3].reshape(-1, 9)
    assert len(np.unique(R.round(6), axis=0)) == len(R) == 60
    assert len(np.unique(simulation.group)) == 60


def test_starts_lie_in_the_central_part_of_the_image():
    for design, fraction in (("paper", 0.5), ("mid", 0.75)):
        cell = paper_cell(1) if design == "paper" else table2_cell(1)
        starts = simulate_cell(cell, groups=40, design=design).observations.uv[::10]
        reach = np.abs(starts - (319.5, 239.5)).max(axis=0)
        assert np.all(reach <= fraction / 2 * np.array([640, 480]) + 1e-6)
        assert np.all(reach > 0.6 * fraction / 2 * np.array([640, 480]))


@pytest.mark.parametrize(("shots", "counts"), [(2, (1, 0, 0)), (4, (1, 1, 1)), (6, (2, 2, 1))])
def test_shots_are_dealt_to_the_axes_in_turn(shots, counts):
    poses = simulate("paper-1", shots=shots).observations.T_base_hand[:shots]
    moves = poses[1:, :3, 3] - poses[0, :3, 3]
    directions = moves / np.linalg.norm(moves, axis=1, keepdims=True)
    same = np.isclose(directions @ directions.T, 1.0)
    assert tuple(same.sum(axis=1)[np.cumsum((0, *counts[:-1]))[np.array(counts) > 0]]) == tuple(
        c for c in counts if c
    )


def test_translations_are_as_long_as_the_view_allows():
    """No axis of a group could have been one step longer, either way."""
    simulation = simulate("table2-1", groups=20, design="mid")
    design = DESIGNS["mid"]
    cell = simulation.truth
    camera, plane = cell.cameras["camera"], cell.planes["1"]
    poses = simulation.observations.T_base_hand
    checked = 0
    for label in range(20):
        start, ends = poses[10 * label], poses[10 * label + 3 : 10 * label + 10 : 3, :3, 3]
        for move in ends - start[:3, 3]:
            length = np.linalg.norm(move)
            if length > 0.99 * design.longest:
                continue
            checked += 1
            for sign in (1, -1):
                longer = np.repeat(start[None], 3, axis=0)
                steps = np.array([1, 2, 3])[:, None] / 3
                longer[:, :3, 3] += sign * steps * move / 0.9
                u = longer[:, :3, :3] @ cell.lasers["laser"].direction_hand
                q = longer[:, :3, :3] @ cell.lasers["laser"].point_hand + longer[:, :3, 3]
                ahead = (plane.distance - q @ plane.normal_base) / (u @ plane.normal_base)
                points = q + ahead[:, None] * u
                uv = opencv_pixels(points, camera)
                inside = np.all((uv >= 12) & (uv <= (627, 467)), axis=1) & (ahead >= 0.015)
                assert not inside.all()
    assert checked >= 10


def test_radial_slope_is_the_least_on_the_way():
    intrinsics = Intrinsics(500, 500, k1=-0.9, k2=0.9)
    r = np.linspace(0, 1.2, 2001)
    slope = 1 + 3 * intrinsics.k1 * r**2 + 5 * intrinsics.k2 * r**4
    np.testing.assert_allclose(
        radial_slope(intrinsics, r**2), np.minimum.accumulate(slope), atol=1e-5
    )
    barrel = Intrinsics(500, 500, k1=0.2, k2=-0.5)
    slope = 1 + 3 * barrel.k1 * r**2 + 5 * barrel.k2 * r**4
    np.testing.assert_allclose(radial_slope(barrel, r**2), np.minimum.accumulate(slope), atol=1e-5)


def test_impossible_views_are_refused_with_what_to_do():
    cell = paper_cell(1)
    camera = cell.cameras["camera"]
    behind = camera.T_base_camera[:3, 3] - 0.2 * camera.T_base_camera[:3, 2]
    hidden = {"1": Plane.from_point(camera.T_base_camera[:3, 2], behind)}
    with pytest.raises(DataError, match=r"only 0 of 3 groups .* move plane and camera"):
        simulate_cell(cell.with_planes(hidden))


def test_the_folding_part_of_the_image_is_avoided():
    cell = paper_cell(1)
    camera = cell.cameras["camera"]
    folding = Intrinsics(550, 550, u0=320, v0=240, k1=-1.6)  # the slope is 0.2 at r = 0.41
    cell = Cell(
        {"camera": Camera(folding, camera.T_base_camera, (640, 480))}, cell.lasers, cell.planes
    )
    simulation = simulate_cell(cell)
    points = spots(simulation)
    in_camera = (points - camera.T_base_camera[:3, 3]) @ camera.T_base_camera[:3, :3]
    r = np.linalg.norm(in_camera[:, :2] / in_camera[:, 2:], axis=1)
    assert r.max() < np.sqrt(0.8 / 4.8)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"beam_length": (0.2, 0.1)}, "beam_length"),
        ({"depth": (0.0, 1.0)}, "depth"),
        ({"shortest": 0.2}, "shortest, longest"),
        ({"cone": 2.0}, "cone"),
        ({"centre": 1.5}, "centre"),
    ],
)
def test_a_design_that_makes_no_sense_is_refused(change, match):
    with pytest.raises(DataError, match=match):
        MotionDesign(**change)
