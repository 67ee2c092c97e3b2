"""Laser direction from groups: kernel, pooling, polish, hemisphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from closed_form_cases import beam_of, camera_of, exact, groups_of, noisy, spots_of, variant

from lasercal_gtsam.cell import Beam
from lasercal_gtsam.closed_form.direction import (
    best_distinct,
    group_kernels,
    hemisphere,
    homography_costs,
    informative_groups,
    polish_directions,
    pooled_direction,
    robust_directions,
    tangent_bases,
    translation_map,
)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between directions without sign, radians."""
    return float(np.linalg.norm(np.cross(a, b)))


def test_map_of_translations_is_the_projected_oblique_projector():
    """Corrected (16), (17): the map is K R_cb [P, X - T] with P = I - u n'/(n.u)."""
    sim = exact()
    groups = groups_of(sim)
    K, R, _ = camera_of(sim.truth)
    u, _ = beam_of(sim.truth)
    found = translation_map(groups)
    K = spots_of(sim).scaling @ K
    for g, plane in enumerate(groups.plane):
        n = sim.truth.planes[str(plane + 1)].normal_base
        beam = groups.R[g] @ u
        P = np.eye(3) - np.outer(beam, n) / (n @ beam)
        expected = K @ R.T @ P
        a, b = found[g][:, :3].ravel(), expected.ravel()
        assert abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) == pytest.approx(1, abs=1e-10)


def test_kernels_of_all_groups_are_the_beam():
    sim = exact()
    u, _ = beam_of(sim.truth)
    kernels = group_kernels(groups_of(sim))
    assert max(angle(v, u) for v in kernels) < 1e-10


def test_pooling_does_not_care_for_signs():
    u = np.array([0.6, 0.0, 0.8])
    v = np.array([u, -u, u, -u, -u])
    assert angle(pooled_direction(v), u) < 1e-14


@pytest.mark.parametrize(
    "direction", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0.6, -0.8), (1, 1, 1), (0.3, -0.9, 0.1)]
)
def test_exact_for_any_beam_without_special_cases(direction):
    beam = Beam(np.array(direction, dtype=float), np.array([0.02, -0.01, 0.03]))
    sim = variant(beam=beam)
    u, cost = robust_directions(groups_of(sim))
    assert angle(u[0], beam.direction_hand) < 1e-9
    assert cost[0] < 1e-20


def test_polish_reaches_the_minimum_from_far_away():
    sim = noisy("paper", 4, 0.5)
    groups = groups_of(sim)
    u, _ = beam_of(sim.truth)
    E = tangent_bases(u[None])[0]
    starts = np.array([v / np.linalg.norm(v) for v in (u, u + 0.3 * E[:, 0], u - 0.25 * E[:, 1])])
    found, cost = polish_directions(groups, starts)
    best = found[np.argmin(cost)]
    assert angle(best, u) < np.radians(1.0)
    # no neighbour is better
    F = tangent_bases(best[None])[0]
    around = [best + 1e-3 * (np.cos(a) * F[:, 0] + np.sin(a) * F[:, 1]) for a in np.arange(8)]
    around = np.array([v / np.linalg.norm(v) for v in around])
    assert homography_costs(groups, around).min() > cost.min()


def test_polish_is_worth_several_times_the_pooled_kernel():
    pooled, polished = [], []
    for seed in range(12):
        sim = noisy("paper", seed, 1.0)
        groups = groups_of(sim)
        u, _ = beam_of(sim.truth)
        pooled.append(angle(pooled_direction(group_kernels(groups)), u))
        polished.append(angle(robust_directions(groups)[0][0], u))
    assert np.degrees(np.median(polished)) < 0.7
    assert np.median(pooled) > 3 * np.median(polished)


def test_groups_without_information_are_left_out():
    sim = exact()
    groups = groups_of(sim)
    flat = groups.t.copy()
    flat[:3] -= flat[:3].mean(axis=1, keepdims=True)
    u0 = groups.R[0] @ beam_of(sim.truth)[0]
    flat[0] -= np.outer(flat[0] @ u0, u0)
    planar = replace(groups, t=flat)
    assert 0 not in informative_groups(planar)
    assert len(informative_groups(groups, shots=11)) == 0
    u, cost = robust_directions(groups.subset(np.array([], dtype=np.int64)))
    assert u.shape == (0, 3)
    assert cost.shape == (0,)


def test_five_shots_a_group_are_enough_without_any_kernel():
    """Below six shots there is no kernel (16); hemisphere and polish still find the beam."""
    sim = variant(shots=7)
    groups = groups_of(sim)
    rows = np.array([0, 1, 2, 3, 6])  # the start and the ends span three directions
    parts = ("xy", "t", "present", "rows")
    groups = replace(groups, **{name: getattr(groups, name)[:, rows] for name in parts})
    u, _ = robust_directions(groups)
    assert angle(u[0], beam_of(sim.truth)[0]) < 1e-7


def test_hemisphere_is_even_and_bases_are_right_handed():
    u = hemisphere(300)
    assert np.allclose(np.linalg.norm(u, axis=1), 1.0)
    assert np.all(u[:, 2] > 0)
    nearest = np.sort(np.abs(u @ u.T), axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).max() < 12.0
    E = tangent_bases(u)
    assert np.allclose(np.cross(E[..., 0], E[..., 1]), u)


def test_best_distinct_keeps_the_best_and_its_distance():
    u = np.array([[0, 0, 1.0], [0, 0.01, 1], [0, 0, -1], [1, 0, 0]])
    u /= np.linalg.norm(u, axis=1)[:, None]
    kept = best_distinct(u, np.array([3.0, 1.0, 2.0, 4.0]), 3, np.radians(5.0))
    assert np.array_equal(kept, u[[1, 3]])
