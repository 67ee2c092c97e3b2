"""Groups of non-rotating motions are found from the poses alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from closed_form_cases import exact, groups_of, spots_of

from lasercal_gtsam.closed_form.groups import (
    GROUP_TOLERANCE_RAD,
    find_groups,
    group_labels,
    thinned,
)
from lasercal_gtsam.rotations import rotation_exp


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.array_equal(a[:, None] == a, b[:, None] == b))


def test_labels_are_those_of_the_simulated_motions():
    sim = exact()
    spots = spots_of(sim)
    assert same_partition(group_labels(spots.R, spots.plane), sim.group)


def test_same_rotation_on_two_planes_makes_two_groups():
    R = np.repeat(np.eye(3)[None], 8, axis=0)
    labels = group_labels(R, np.array([0, 0, 0, 0, 1, 1, 1, 1]))
    assert len(set(labels)) == 2
    assert len(set(labels[:4])) == 1


def test_order_of_the_shots_does_not_matter():
    sim = exact()
    spots = spots_of(sim)
    order = np.random.default_rng(5).permutation(len(spots))
    shuffled = group_labels(spots.R[order], spots.plane[order])
    assert same_partition(shuffled, sim.group[order])


def test_a_slowly_turning_hand_is_not_one_group():
    steps = np.arange(60)[:, None] * np.array([[0.4 * GROUP_TOLERANCE_RAD, 0.0, 0.0]])
    labels = group_labels(rotation_exp(steps), np.zeros(60, dtype=np.int64))
    assert np.bincount(labels).max() <= 5


def test_poses_read_back_with_noise_need_a_wider_tolerance():
    sim = exact()
    spots = spots_of(sim)
    noise = 2e-3
    rng = np.random.default_rng(1)
    R = spots.R @ rotation_exp(noise * rng.standard_normal((len(spots), 3)))
    assert not same_partition(group_labels(R, spots.plane), sim.group)
    assert same_partition(group_labels(R, spots.plane, 8 * noise), sim.group)


def test_groups_hold_their_shots_and_only_those():
    sim = exact()
    spots, groups = spots_of(sim), groups_of(sim)
    assert len(groups) == 9
    assert groups.shots.tolist() == [10] * 9
    assert groups.plane.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert groups.translation_ranks().tolist() == [3] * 9
    pixels = groups.xy[groups.present > 0]
    assert np.array_equal(np.sort(pixels, axis=0), np.sort(spots.xy, axis=0))


def test_groups_of_different_size_are_padded():
    sim = exact()
    rows = np.flatnonzero(~((sim.group == 1) & (np.arange(90) % 10 > 5)))
    spots = spots_of(sim).subset(rows)
    groups = find_groups(spots)
    assert sorted(groups.shots.tolist()) == [6] + [10] * 8
    small = groups.subset(np.flatnonzero(groups.shots == 6))
    assert small.xy.shape == (1, 6, 2)
    assert np.all(small.present == 1)


def test_motions_in_a_plane_have_rank_two():
    sim = exact()
    groups = groups_of(sim)
    flat = groups.t.copy()
    flat[..., 2] = 0.1
    assert replace(groups, t=flat).translation_ranks().tolist() == [2] * 9


def test_thinning_keeps_whole_groups_evenly():
    sim = exact(groups=30)
    spots = spots_of(sim)
    assert len(spots) == 900
    few = thinned(spots, most=300)
    assert 270 <= len(few) <= 600
    groups = find_groups(few)
    assert groups.shots.tolist() == [10] * len(groups)
    counts = np.bincount(groups.plane)
    assert counts.min() == counts.max()
    assert thinned(spots, most=900) is spots
