"""The general form on homographies of groups: exact, ranks, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from closed_form_cases import (
    beam_of,
    camera_of,
    exact,
    groups_of,
    largest_error,
    noisy,
    plane_before,
    spots_of,
    variant,
)

from lasercal_gtsam.cell import Beam
from lasercal_gtsam.closed_form.direction import robust_directions
from lasercal_gtsam.closed_form.general import (
    affine_homography,
    inverse_projection,
    plane_groups,
    solve_general,
    solve_translations,
    translations,
)
from lasercal_gtsam.closed_form.linear import homogeneous
from lasercal_gtsam.closed_form.solution import beam_towards_spots, reprojection
from lasercal_gtsam.errors import DegenerateError


def solved(sim):
    spots = spots_of(sim)
    u, _ = beam_of(sim.truth)
    solution = beam_towards_spots(solve_general(groups_of(sim), spots, -u), spots)
    return solution.to_cell(spots, "camera", "laser")


def at(sim, chosen=None):
    groups = groups_of(sim)
    if chosen is not None:
        groups = groups.subset(np.array(chosen))
    return plane_groups(groups, beam_of(sim.truth)[0], 3)


@pytest.mark.parametrize("preset", ["paper", "paper-2"])
@pytest.mark.parametrize("seed", range(3))
def test_exact_without_noise(preset, seed):
    sim = exact(preset, seed)
    assert largest_error(solved(sim), sim.truth) < 1e-9


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0.6, 0.8)])
def test_exact_for_any_beam(direction):
    sim = variant(beam=Beam(np.array(direction, dtype=float), np.array([0.02, -0.01, 0.03])))
    assert largest_error(solved(sim), sim.truth) < 1e-9


def test_one_orientation_on_each_of_three_planes_is_enough():
    sim = exact(groups=1)
    assert largest_error(solved(sim), sim.truth) < 1e-8


def test_homographies_are_the_true_ones_on_one_scale():
    """m H = G P B s + G (X - T), with one free factor a plane."""
    sim = exact()
    found = at(sim)
    K, R, T = camera_of(sim.truth)
    G = spots_of(sim).scaling @ K @ R.T
    u, q = beam_of(sim.truth)
    groups = groups_of(sim)
    factor: dict[int, float] = {}
    for g, p in enumerate(found.plane):
        plane = sim.truth.planes[str(p + 1)]
        n, beam = plane.normal_base, groups.R[g] @ u
        start = groups.R[g] @ q + found.o[g]
        X = start + (plane.distance - n @ start) / (n @ beam) * beam
        P = np.eye(3) - np.outer(beam, n) / (n @ beam)
        expected = G @ np.column_stack([P @ found.B[g], X - T])
        ratio = factor.setdefault(int(p), found.H[g][2, 2] / expected[2, 2])
        assert ratio > 0
        assert np.allclose(found.H[g], ratio * expected, rtol=1e-9, atol=1e-10)
        assert np.abs(found.lines[p] @ found.H[g][:, :2]).max() < 1e-10


def test_affine_refit_reproduces_any_homography_with_that_line():
    rng = np.random.default_rng(3)
    line = np.array([0.1, -0.2, 1.0])
    line /= np.linalg.norm(line)
    H = rng.normal(size=(3, 3)) + 3 * np.eye(3)
    H[2] = (np.array([0.0, 0.0, 1.0]) - line[:2] @ H[:2]) / line[2]
    s = rng.uniform(-0.3, 0.3, (8, 2))
    m = homogeneous(s) @ H.T
    assert np.allclose(affine_homography(line, s, m[:, :2] / m[:, 2:]), H, atol=1e-12)


@pytest.mark.parametrize(
    ("chosen", "planes", "rank"),
    [
        ((0, 1, 2), 1, 6),
        ((0, 3), 2, 8),
        ((0, 3, 4), 2, 9),
        ((0, 1, 3, 4), 2, 10),
        ((0, 3, 6), 3, 11),
    ],
)
def test_ranks_of_the_system_for_the_camera(chosen, planes, rank):
    """8 + P is needed for the 9 + P unknowns; written out independently of the code."""
    sim = exact()
    found = at(sim, chosen)
    used = list(np.unique(found.plane))
    rows = []
    for g, p in enumerate(found.plane):
        for i in range(2):
            for j in range(2):
                nu = np.zeros(len(used))
                nu[used.index(p)] = -1.0 if i == j else 0.0
                rows.append(np.append(np.kron(found.B[g][:, i], found.H[g][:, j]), nu))
    A = np.array(rows)
    A /= np.linalg.norm(A, axis=0)
    s = np.linalg.svd(A, compute_uv=False)
    assert int((s > 1e-9 * s[0]).sum()) == rank
    assert len(used) == planes
    if rank == 8 + planes:
        G_inv, gap = inverse_projection(found)
        K, R, _ = camera_of(sim.truth)
        expected = np.linalg.inv(spots_of(sim).scaling @ K @ R.T)
        assert gap > 1e-6
        assert np.allclose(G_inv / np.linalg.norm(G_inv), expected / np.linalg.norm(expected))
    else:
        with pytest.raises(DegenerateError, match="three groups on three planes"):
            inverse_projection(found)


@pytest.mark.parametrize(("chosen", "enough"), [((0, 1), False), ((0, 1, 2), True), ((0,), False)])
def test_translations_need_three_orientations(chosen, enough):
    sim = exact()
    found = at(sim, chosen)
    K, R, T = camera_of(sim.truth)
    G_inv = np.linalg.inv(spots_of(sim).scaling @ K @ R.T)
    if not enough:
        with pytest.raises(DegenerateError, match="three hand orientations"):
            translations(found, G_inv)
        return
    tau, position, scales = translations(found, G_inv)
    assert np.allclose(position, T, atol=1e-10)
    _, q = beam_of(sim.truth)
    assert np.allclose(tau, found.B[0].T @ groups_of(sim).R[0] @ q, atol=1e-10)
    assert scales[0] > 0
    assert np.isnan(scales[1:]).all()


def test_solve_translations_recovers_what_made_its_right_side():
    rng = np.random.default_rng(2)
    found = at(exact())
    columns = rng.normal(size=(*found.s.shape[:2], 2, 2))
    group = np.array([0, 0, 0, 1, 1, 1, 2, 2, 2])
    tau, T, x = rng.normal(size=2), rng.normal(size=3), rng.normal(size=(3, 2))
    s = (
        np.einsum("gkij,gj->gki", columns, x[group])
        + (np.swapaxes(found.B, 1, 2) @ T)[:, None]
        - tau
        - (np.swapaxes(found.B, 1, 2) @ found.o[..., None])[..., 0][:, None]
    )
    made = type(found)(
        found.H, found.B, found.o, s, found.present, found.plane, found.lines, found.u
    )
    tau2, T2, x2 = solve_translations(made, columns, group, 3)
    assert np.allclose(tau2, tau)
    assert np.allclose(T2, T)
    assert np.allclose(x2, x)


def test_parallel_planes_are_refused_here():
    camera = exact().truth.cameras["camera"]
    planes = {"1": plane_before(camera, 30, 40, 0.25), "2": plane_before(camera, 30, 40, 0.35)}
    with pytest.raises(DegenerateError, match="not parallel"):
        solved(variant(planes=planes))


def test_motions_along_one_line_are_refused():
    sim = exact()
    groups = groups_of(sim)
    line = groups.t.copy()
    line[..., 1:] = 0.0
    flat = replace(groups, t=line)
    with pytest.raises(DegenerateError, match="two directions across the beam"):
        plane_groups(flat, beam_of(sim.truth)[0], 3)


def test_noise_at_table_1_never_fails():
    errors = []
    for seed in range(20):
        sim = noisy("paper", seed, 1.0)
        spots = spots_of(sim)
        u = robust_directions(groups_of(sim))[0][0]
        solution = beam_towards_spots(solve_general(groups_of(sim), spots, u), spots)
        assert reprojection(solution, spots)[1] == 0.0
        errors.append(abs(solution.K[0, 0] / 550.0 - 1.0))
    assert max(errors) < 0.5
    assert np.median(errors) < 0.12
