"""Spots before the camera: triangulation form, beam refinement, search without groups."""

from __future__ import annotations

import numpy as np
import pytest
from closed_form_cases import (
    beam_of,
    exact,
    noisy,
    plane_before,
    spots_of,
    variant,
)

from lasercal_gtsam.cell import Beam
from lasercal_gtsam.closed_form.beam_fit import beam_residuals, refine_beam
from lasercal_gtsam.closed_form.search import (
    direction_costs,
    direction_forms,
    search_beams,
    trial_directions,
)
from lasercal_gtsam.closed_form.triangulation import (
    beam_spread,
    fit_plane,
    pixel_map,
    reduced_system,
    scaled_planes,
    solvable_planes,
    triangulate,
)
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.projection import spot_on_beam
from lasercal_gtsam.rotations import basis_of


def true_points(sim) -> np.ndarray:
    observations = sim.observations
    return spot_on_beam(sim.truth, observations.T_base_hand, plane=list(observations.plane))


def line_distance(u, q, beam) -> float:
    """Distance (m) of two nearly parallel lines near the hand, plus their angle (rad)."""
    direction, point = beam
    return float(
        np.linalg.norm(np.cross(direction, q - point)) + np.linalg.norm(np.cross(direction, u))
    )


@pytest.mark.parametrize("preset", ["paper", "paper-1", "no-groups"])
def test_true_beam_gives_the_true_spots(preset):
    sim = exact(preset)
    spots = spots_of(sim)
    u, q = beam_of(sim.truth)
    found = triangulate(scaled_planes(spots), spots, u, q)
    assert np.allclose(found.points, true_points(sim), atol=1e-10)
    for i, plane in enumerate(sim.truth.planes.values()):
        assert np.linalg.norm(np.cross(found.normals[i], plane.normal_base)) < 1e-9
        assert found.centres[i] @ plane.normal_base == pytest.approx(plane.distance, abs=1e-10)


def test_sign_of_the_direction_and_point_along_the_beam_do_not_matter():
    sim = exact("paper-2")
    spots = spots_of(sim)
    u, q = beam_of(sim.truth)
    a = triangulate(scaled_planes(spots), spots, u, q)
    b = triangulate(scaled_planes(spots), spots, -u, q + 0.7 * u)
    assert np.allclose(a.points, b.points, atol=1e-10)


def test_reduced_system_is_singular_at_the_true_beam_only():
    sim = exact("paper-1")
    plane = scaled_planes(spots_of(sim))[0]
    u, q = beam_of(sim.truth)
    E = basis_of(u)
    assert reduced_system(plane, E, E.T @ q).shape == (2 * len(plane), 12)
    right = pixel_map(plane, E, E.T @ q)
    wrong = pixel_map(plane, E, E.T @ q + 0.005)
    assert np.linalg.norm(right.residuals) < 1e-12
    assert np.linalg.norm(wrong.residuals) > 1e-4
    assert np.linalg.norm(right.c) == pytest.approx(1.0)
    assert np.all(plane.m @ right.c > 0)


def test_residual_is_distance_from_the_beam_in_units_of_rho():
    """Residual = (e_i' R'(X - t) - tau_i) c'm / rho with the fitted map, for a shifted beam."""
    sim = exact("paper-1")
    plane = scaled_planes(spots_of(sim))[0]
    u, q = beam_of(sim.truth)
    E = basis_of(u)
    tau = E.T @ q + np.array([0.004, -0.002])
    found = pixel_map(plane, E, tau)
    depth = plane.m @ found.c
    X = plane.o + plane.rho * (plane.m @ found.A.T) / depth[:, None]
    hand = plane.o + plane.rho * plane.t
    across = ((X - hand)[:, None, :] @ plane.R)[:, 0] @ E - tau
    assert np.allclose((across * depth[:, None] / plane.rho).ravel(), found.residuals, atol=1e-12)


def test_gradient_of_the_beam_cost_is_right():
    """The projected Jacobian gives the exact gradient of the cost (central differences)."""
    sim = noisy("paper-2", 3, 1.0)
    planes = scaled_planes(spots_of(sim))
    u, q = beam_of(sim.truth)
    E = basis_of(u)
    u = u + E @ np.array([0.03, -0.02])
    u /= np.linalg.norm(u)
    q = q + np.array([0.004, 0.003, -0.002])
    r, J = beam_residuals(planes, u, q)
    E = basis_of(u)
    h = 1e-6

    def cost(a, b):
        v = u + E @ a
        r = beam_residuals(planes, v / np.linalg.norm(v), q + E @ b)[0]
        return 0.5 * float(r @ r)

    for i in range(4):
        step = np.zeros(4)
        step[i] = h
        slope = (cost(step[:2], step[2:]) - cost(-step[:2], -step[2:])) / (2 * h)
        assert slope == pytest.approx(float(J[:, i] @ r), rel=1e-5)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.25)])
@pytest.mark.parametrize("groups", [2, 3])
def test_beam_point_from_zero_with_two_orientations_a_plane(groups, offset):
    """The lifted system fails with two orientations a plane; this does not, nor for long tools."""
    beam = Beam(np.array([0.3, 0.2, 0.9]), np.array(offset))
    sim = variant(beam=beam, groups=groups)
    planes = scaled_planes(spots_of(sim))
    u, q, rms = refine_beam(planes, beam.direction_hand, np.zeros(3), point_only=True)
    assert rms < 1e-12
    assert np.allclose(u, beam.direction_hand, atol=1e-15)
    assert line_distance(u, q, (beam.direction_hand, beam.point_hand)) < 1e-9


def test_refined_beam_is_better_than_its_start():
    before, after = [], []
    for seed in range(10):
        sim = noisy("paper", seed, 1.0)
        planes = scaled_planes(spots_of(sim))
        beam = beam_of(sim.truth)
        E = basis_of(beam[0])
        start = beam[0] + E @ np.array([0.02, 0.01])
        start /= np.linalg.norm(start)
        u, _, _ = refine_beam(planes, start, np.zeros(3))
        before.append(np.linalg.norm(np.cross(start, beam[0])))
        after.append(np.linalg.norm(np.cross(u, beam[0])))
    assert np.median(after) < 0.4 * np.median(before)


def test_parallel_planes_are_no_special_case():
    camera = exact().truth.cameras["camera"]
    planes = {"1": plane_before(camera, 30, 40, 0.25), "2": plane_before(camera, 30, 40, 0.35)}
    sim = variant(planes=planes)
    spots = spots_of(sim)
    u, q = beam_of(sim.truth)
    _, q, _ = refine_beam(scaled_planes(spots), u, np.zeros(3), point_only=True)
    found = triangulate(scaled_planes(spots), spots, u, q)
    assert np.allclose(found.points, true_points(sim), atol=1e-9)


def test_planes_with_parallel_beams_are_left_out():
    sim = exact(groups=1)
    spots = spots_of(sim)
    planes = scaled_planes(spots)
    u, q = beam_of(sim.truth)
    assert len(planes) == 3
    assert max(beam_spread(plane, u) for plane in planes) < 1e-12
    assert solvable_planes(planes, u) == []
    assert np.isnan(triangulate(planes, spots, u, q).points).all()


def test_planes_with_few_spots_are_left_out():
    spots = spots_of(exact())
    kept = np.concatenate([spots.on_plane(0), spots.on_plane(1)[:5], spots.on_plane(2)[:6]])
    assert [plane.index for plane in scaled_planes(spots.subset(kept))] == [0, 2]


def test_fit_plane():
    rng = np.random.default_rng(0)
    n = np.array([1.0, 2.0, 2.0]) / 3.0
    X = rng.normal(size=(20, 3))
    X = X - np.outer(X @ n - 0.7, n)
    normal, centre = fit_plane(X)
    assert np.linalg.norm(np.cross(normal, n)) < 1e-12
    assert centre @ n == pytest.approx(0.7)


# --- search without groups -----------------------------------------------------------------------


@pytest.mark.parametrize("kind", [0, 1])
def test_quadratic_forms_are_the_systems(kind):
    """Smallest eigenvalue of the form = that of the stacked rows, with d_1, d_2 eliminated."""
    sim = noisy("no-groups", 0, 1.0)
    plane = scaled_planes(spots_of(sim))[1]
    u = np.random.default_rng(1).normal(size=(5, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    found = direction_costs(direction_forms(plane)[kind], u)
    for direction, cost in zip(u, found, strict=True):
        A = reduced_system(plane, basis_of(direction), np.zeros(2)).reshape(-1, 2, 12)
        if kind == 1:
            Q, _ = np.linalg.qr(plane.m)
            A = A - np.einsum("ik,jk,jab->iab", Q, Q, A)
        s = np.linalg.svd(A.reshape(-1, 12), compute_uv=False)
        assert cost == pytest.approx(s[-1] ** 2 / len(plane), rel=1e-6)


def test_trial_directions_are_distinct_and_near_the_beam():
    sim = exact("no-groups")
    found = trial_directions(scaled_planes(spots_of(sim)))
    u, _ = beam_of(sim.truth)
    assert np.linalg.norm(np.cross(found, u), axis=1).min() < np.sin(np.radians(12.0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("preset", ["no-groups", "paper-1"])
def test_search_is_exact_without_noise(preset, seed):
    sim = exact(preset, seed)
    u, q = search_beams(scaled_planes(spots_of(sim)))[0]
    assert line_distance(u, q, beam_of(sim.truth)) < 1e-9


def test_search_with_noise_stays_near():
    errors = []
    for seed in range(8):
        sim = noisy("no-groups", seed, 1.0)
        u, _ = search_beams(scaled_planes(spots_of(sim)))[0]
        errors.append(np.linalg.norm(np.cross(u, beam_of(sim.truth)[0])))
    assert np.degrees(max(errors)) < 3.0
    assert np.degrees(np.median(errors)) < 1.2


def test_search_needs_more_equations_than_unknowns():
    spots = spots_of(exact("no-groups"))
    few = np.concatenate([spots.on_plane(0)[:6], spots.on_plane(1)[:6]])
    with pytest.raises(DegenerateError, match="8 spots or more on one plane, or 7 on each"):
        search_beams(scaled_planes(spots.subset(few)))
    one_orientation = spots_of(exact(groups=1))
    with pytest.raises(DegenerateError, match="different hand orientations"):
        search_beams(scaled_planes(one_orientation))


def test_camera_is_not_needed():
    """The beam comes out the same whatever (affine) pixels the camera delivers."""
    sim = exact("no-groups")
    spots = spots_of(sim)
    other = type(spots)(
        rows=spots.rows,
        xy=spots.xy @ np.array([[2.0, 0.1], [0.0, 0.7]]) + np.array([3.0, -1.0]),
        R=spots.R,
        t=spots.t,
        plane=spots.plane,
        plane_names=spots.plane_names,
        scaling=spots.scaling,
        image_size=spots.image_size,
    )
    u, q = search_beams(scaled_planes(other))[0]
    assert line_distance(u, q, beam_of(sim.truth)) < 1e-9
