"""Shots that agree: exact maps from small samples, consensus with 40 % outliers, lost planes."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from closed_form_cases import beam_of, groups_of, spots_of
from lasercal_factors.sample_kernels import affine_through, gain, homography_through

from lasercal_gtsam.closed_form.agreement import FINE, agreements, fewest_agreeing
from lasercal_gtsam.closed_form.groups import find_groups
from lasercal_gtsam.closed_form.lost_planes import with_lost_planes
from lasercal_gtsam.closed_form.samples import SEPARATION, Samples
from lasercal_gtsam.closed_form.solution import Solution
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.simulate import Noise, simulate


def seen_through(H: np.ndarray, s: np.ndarray) -> np.ndarray:
    image = np.column_stack([s, np.ones(len(s))]) @ H.T
    return image[:, :2] / image[:, 2:]


def some_map(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A homography of a plane before the camera, and seven points it takes into the picture."""
    rng = np.random.default_rng(seed)
    H = np.array([[1.0, 0.1, 0.05], [-0.2, 0.9, 0.1], [0.3, -0.2, 1.0]])
    H += 0.05 * rng.standard_normal((3, 3))
    s = rng.uniform(-0.5, 0.5, (7, 2))
    return H, s, seen_through(H, s)


@pytest.mark.parametrize("seed", range(4))
def test_four_shots_fix_the_homography_and_three_do_with_the_vanishing_line(seed):
    H, s, xy = some_map(seed)
    line = np.cross(H[:, 0], H[:, 1])
    line /= np.linalg.norm(line)
    found, fours, threes = np.empty((3, 3)), 0, 0
    for sample in combinations(range(7), 4):
        if homography_through(s, xy, np.array(sample), found):
            np.testing.assert_allclose(seen_through(found, s), xy, atol=1e-9)
            fours += 1
        if affine_through(line, basis_of(line), s, xy, np.array(sample[:3]), found):
            np.testing.assert_allclose(seen_through(found, s), xy, atol=1e-9)
            threes += 1
    assert min(fours, threes) > 15


def test_shots_in_one_line_fix_no_map():
    _, s, xy = some_map(0)
    s[2] = 0.5 * (s[0] + s[1])
    found = np.empty((3, 3))
    assert not homography_through(s, xy, np.array([0, 1, 2, 3]), found)
    line = np.array([0.0, 0.0, 1.0])
    assert not affine_through(line, basis_of(line), s, xy, np.array([0, 1, 2]), found)


def test_the_gain_counts_those_within_the_limit_and_refuses_maps_through_the_camera():
    H, s, xy = some_map(1)
    moved = xy.copy()
    moved[5] += [0.005, 0.0]
    moved[6] += [0.0, 3.0]
    assert gain(H, s, moved, 7, 0.01**2) == pytest.approx(5 + 0.75)
    assert gain(-H, s, moved, 7, 0.01**2) == pytest.approx(5 + 0.75)  # the scale is free
    behind = H.copy()
    behind[2] = [5.0, 0.0, 0.1]
    assert gain(behind, s, seen_through(behind, s), 7, 0.01**2) == 0.0


def test_samples_have_pixels_apart_so_that_a_ghost_comes_once():
    groups = groups_of(simulate("paper", 0))
    xy = groups.xy.copy()
    xy[:, :4] = [0.3, 0.2]
    samples = Samples.draw(replace(groups, xy=xy), 4, 200, np.random.default_rng(0))
    assert samples.counts.min() > 20
    for g, count in enumerate(samples.counts):
        rows = samples.shots[g, :count]
        assert (np.sort(rows, axis=1)[:, 1:] != np.sort(rows, axis=1)[:, :-1]).all()
        assert ((rows < 4).sum(axis=1) <= 1).all()
        between = np.linalg.norm(xy[g][rows[:, 0]] - xy[g][rows[:, 1]], axis=1)
        assert between.min() > SEPARATION


def test_by_chance_so_many_hardly_ever_agree():
    """Counted on shots that are anywhere: groups of ten, affine maps through any three of them."""
    rng = np.random.default_rng(0)
    line = np.array([0.0, 0.0, 1.0])
    most, H = 0, np.empty((3, 3))
    needed = fewest_agreeing(10, FINE)
    for _ in range(60):
        s, xy = rng.uniform(-0.5, 0.5, (10, 2)), rng.uniform(-1.0, 1.0, (10, 2)) * [1.13, 0.85]
        for _ in range(60):
            if affine_through(line, basis_of(line), s, xy, rng.permutation(10)[:3], H):
                errors = np.linalg.norm(seen_through(H, s) - xy, axis=1)
                most = max(most, int((errors < FINE).sum()))
    assert needed == 5
    assert most < needed
    assert fewest_agreeing(10, 10 * FINE) > needed
    assert fewest_agreeing(30, FINE) > needed
    assert fewest_agreeing(5, FINE) == 5
    assert fewest_agreeing(5, 10 * FINE) == 6  # never


def spoiled(seed: int, share: float, kind: str):
    """Spots of the paper's cell with outliers, and which they are."""
    sim = simulate("paper", seed, Noise(pixel_px=1.0))
    spots = spots_of(sim)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(len(spots))[: round(share * len(spots))]
    xy = spots.xy.copy()
    size = np.array([0.8, 0.6]) * IMAGE_DIAGONAL
    if kind == "ghost":
        xy[wrong] = [0.4, -0.3] + 0.005 * rng.standard_normal((len(wrong), 2))
    else:
        xy[wrong] = (rng.random((len(wrong), 2)) - 0.5) * size
    bad = np.zeros(len(spots), dtype=bool)
    bad[wrong] = True
    return sim, replace(spots, xy=xy), bad


@pytest.mark.parametrize("kind", ["uniform", "ghost"])
@pytest.mark.parametrize("seed", range(3))
def test_with_40_percent_outliers_those_that_agree_are_right(seed, kind):
    sim, spots, bad = spoiled(seed, 0.4, kind)
    best = agreements(find_groups(spots))[0]
    assert (~bad[best.rows]).sum() > 0.7 * (~bad).sum()
    assert bad[best.rows].sum() <= 3
    u, _ = beam_of(sim.truth)
    assert np.degrees(np.arccos(abs(best.u @ u))) < 2.0
    everything, *others = best.parts()
    assert len(others) == len(best.members)
    assert sum(len(everything) - len(part) for part in others) == len(everything)


def test_where_all_is_wrong_nearly_nothing_agrees():
    _, spots, _ = spoiled(0, 1.0, "uniform")
    found = agreements(find_groups(spots))
    assert not found or len(found[0].rows) < 0.4 * len(spots)


def test_shots_are_left_out_and_numbered():
    sim = simulate("paper", 0)
    groups, spots = groups_of(sim), spots_of(sim)
    kept = np.random.default_rng(0).random(groups.present.shape) < 0.5
    some = groups.masked(kept)
    assert some.shots.tolist() == kept.sum(axis=1).tolist()
    for g in range(len(some)):
        rows = some.rows[g, : some.shots[g]]
        assert rows.tolist() == groups.rows[g][kept[g]].tolist()
        np.testing.assert_array_equal(some.xy[g, : len(rows)], spots.xy[rows])
        np.testing.assert_array_equal(some.t[g, : len(rows)], spots.t[rows])


def test_a_plane_without_agreeing_shots_is_found_from_camera_and_beam():
    sim, spots, bad = spoiled(2, 0.4, "uniform")
    names = ("camera", "laser")
    right = Solution.of_cell(sim.truth, spots, *names)
    normals = right.normals.copy()
    normals[1] = np.nan
    found = with_lost_planes(replace(right, normals=normals), spots, 10.0)
    assert abs(found.normals[1] @ right.normals[1]) > np.cos(np.radians(2.0))
    off = (found.points[1] - right.points[1]) @ right.normals[1]
    assert abs(off) < 2e-3
    np.testing.assert_array_equal(found.normals[[0, 2]], right.normals[[0, 2]])
    # of outliers alone no plane is made
    lost = spots.subset(np.flatnonzero(bad | (spots.plane != 1)))
    few = lost.subset(np.flatnonzero((lost.plane != 1) | (np.cumsum(lost.plane == 1) <= 4)))
    assert np.isnan(with_lost_planes(replace(right, normals=normals), few, 10.0).normals[1]).all()
