"""Noise, determinism and the requests that `simulate` and `simulate_cell` take."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.projection import project
from lasercal_gtsam.simulate import PRESETS, Noise, simulate, simulate_cell
from lasercal_gtsam.simulate.cells import looking_at, paper_cell, table2_cell, tool_z_cell


def rotation_vectors(R):
    return np.array([cv2.Rodrigues(np.ascontiguousarray(r))[0][:, 0] for r in R])


def assert_gaussian(sample, sigma):
    """Mean 0, standard deviation sigma and no correlation, each within 4 of its own sigmas."""
    count, axes = sample.shape
    assert np.abs(sample.mean(axis=0)).max() < 4 * sigma / np.sqrt(count)
    assert np.abs(sample.std(axis=0) / sigma - 1).max() < 4 / np.sqrt(2 * count)
    assert np.abs(np.corrcoef(sample.T) - np.eye(axes)).max() < 4 / np.sqrt(count)
    beyond = np.mean(np.abs(sample) > 1.959964 * sigma)
    assert abs(beyond - 0.05) < 4 * np.sqrt(0.05 * 0.95 / sample.size)


def test_noise_is_that_of_table_1():
    noise = Noise.table1(0.6)
    assert noise == Noise(0.6, 0.6e-3, np.radians(0.03))
    runs = [simulate("paper", seed, noise) for seed in range(60)]
    commanded = np.concatenate([run.observations.T_base_hand for run in runs])
    actual = np.concatenate([run.T_base_hand_actual for run in runs])
    turn = actual[:, :3, :3] @ np.swapaxes(commanded[:, :3, :3], 1, 2)  # on the left: base axes
    assert_gaussian(rotation_vectors(turn), np.radians(0.03))
    assert_gaussian(actual[:, :3, 3] - commanded[:, :3, 3], 0.6e-3)
    pixel = [
        run.observations.uv
        - project(run.truth, run.T_base_hand_actual, plane=run.observations.plane)
        for run in runs
    ]
    assert_gaussian(np.concatenate(pixel), 0.6)


def test_shots_of_one_run_are_independent():
    runs = [simulate("paper-1", seed, Noise.table1()) for seed in range(200)]
    shift = np.array([r.T_base_hand_actual - r.observations.T_base_hand for r in runs])[..., :3, 3]
    neighbours = np.corrcoef(shift[:, :-1].ravel(), shift[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 4 / np.sqrt(shift[:, 1:].size)


def test_the_commanded_pose_is_the_data():
    exact, noisy = simulate("paper", 3), simulate("paper", 3, Noise.table1())
    np.testing.assert_array_equal(exact.observations.T_base_hand, noisy.observations.T_base_hand)
    np.testing.assert_array_equal(exact.T_base_hand_actual, exact.observations.T_base_hand)
    assert exact.truth == noisy.truth
    assert np.abs(noisy.observations.uv - exact.observations.uv).max() > 1


def test_levels_of_noise_scale_the_same_draws():
    exact, half, full = (
        simulate("paper", 5, None if level == 0 else Noise(pixel_px=level)) for level in (0, 0.5, 1)
    )
    np.testing.assert_allclose(
        full.observations.uv - exact.observations.uv,
        2 * (half.observations.uv - exact.observations.uv),
        atol=1e-10,
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_same_seed_same_numbers_whatever_came_before(preset):
    noise = PRESETS[preset].noise
    once = simulate(preset, 7, noise)
    simulate(preset, 6, noise)
    np.random.default_rng(0).random(10)
    again = simulate(preset, 7, noise)
    assert once == again
    other = simulate(preset, 8, noise)
    assert not np.array_equal(once.observations.T_base_hand, other.observations.T_base_hand)
    assert not np.array_equal(once.observations.uv, other.observations.uv)


def test_presets_are_what_they_say():
    counts = {name: len(simulate(name).observations) for name in PRESETS}
    assert counts == {
        "paper": 90,
        "paper-2": 60,
        "paper-1": 30,
        "paper-distorted": 90,
        "table2-1": 30,
        "table2-2": 60,
        "table2-3": 60,
        "table2-4": 80,
        "tool-z": 60,
        "tool-z-2": 60,
        "no-groups": 60,
    }
    for name, count in counts.items():
        assert f"{count} " in PRESETS[name].description
        planes = len(simulate(name).observations.planes)
        assert count == planes * PRESETS[name].spots_per_plane
    assert simulate("table2").preset == "table2-4"


@pytest.mark.parametrize("preset", PRESETS)
def test_known_is_what_one_plane_cannot_give(preset):
    simulation = simulate(preset)
    intrinsics = simulation.truth.cameras["camera"].intrinsics
    if len(simulation.observations.planes) == 1:
        assert simulation.known == {"principal_point": (320.0, 240.0), "skew": 0.0}
        assert (intrinsics.u0, intrinsics.v0, intrinsics.skew) == (320.0, 240.0, 0.0)
    else:
        assert simulation.known == {}


def test_paper_cell_has_the_paper_s_numbers():
    cell = paper_cell(2)
    camera, beam = cell.cameras["camera"], cell.lasers["laser"]
    assert np.linalg.norm(camera.T_base_camera[:3, 3]) == pytest.approx(0.684, abs=5e-4)
    theta, phi, psi = np.radians([-90, -10, -170])
    turn = [np.array([0, 0, theta]), np.array([0, phi, 0]), np.array([psi, 0, 0])]
    R = np.linalg.multi_dot([cv2.Rodrigues(w)[0] for w in turn])
    np.testing.assert_allclose(camera.T_base_camera[:3, :3], R, atol=1e-15)
    u = beam.direction_hand
    assert np.degrees(np.arctan2(u[1], u[0])) == pytest.approx(21.80)
    assert np.degrees(np.arccos(u[2])) == pytest.approx(53.39)
    np.testing.assert_allclose(cell.planes["1"].vector * 1e3, [152.41, 138.34, -163.92])
    np.testing.assert_allclose(cell.planes["2"].vector * 1e3, [48.68, 31.47, -153.81])


def test_the_third_plane_is_random_within_its_limits():
    tilts, depths = [], []
    for seed in range(60):
        cell = simulate("paper", seed, groups=1, shots=1).truth
        camera, plane = cell.cameras["camera"].T_base_camera, cell.planes["3"]
        cosine = abs(plane.normal_base @ camera[:3, 2])
        tilts.append(np.degrees(np.arccos(cosine)))
        depths.append(
            (plane.distance - plane.normal_base @ camera[:3, 3])
            / (plane.normal_base @ camera[:3, 2])
        )
        for name in ("1", "2"):
            between = abs(plane.normal_base @ cell.planes[name].normal_base)
            assert np.degrees(np.arccos(between)) >= 15
        assert plane.distance > 0.02
    assert 15 <= min(tilts) < 20 and 40 < max(tilts) <= 45
    assert 0.2 <= min(depths) < 0.22 and 0.38 < max(depths) <= 0.4


def test_table2_cell_agrees_with_what_is_known_of_the_tests():
    cell = table2_cell(1)
    camera, plane, beam = cell.cameras["camera"], cell.planes["1"], cell.lasers["laser"]
    n = camera.T_base_camera[:3, :3].T @ plane.normal_base
    assert np.degrees(np.arccos(abs(n[2]))) == pytest.approx(34, abs=1e-6)
    assert np.degrees(np.arcsin(abs(n[0]))) <= 0.4
    assert np.degrees(np.arccos(beam.direction_hand[2])) == pytest.approx(88.9)
    assert beam.point_hand[0] == 0
    assert table2_cell(2).planes["1"] == plane


def test_tool_z_cell_is_the_common_mount():
    cell = tool_z_cell(2)
    np.testing.assert_array_equal(cell.lasers["laser"].direction_hand, [0, 0, 1])
    np.testing.assert_array_equal(np.abs(cell.planes["1"].normal_base), [0, 0, 1])
    between = abs(cell.planes["1"].normal_base @ cell.planes["2"].normal_base)
    assert np.degrees(np.arccos(between)) == pytest.approx(25)


def test_a_camera_looks_at_its_target():
    centre, target = np.array([0.1, -0.4, 0.9]), np.array([0.3, 0.2, 0.0])
    T = looking_at(centre, target, roll=0.3)
    in_camera = np.linalg.inv(T) @ np.append(target, 1)
    np.testing.assert_allclose(in_camera[:2], 0, atol=1e-15)
    assert in_camera[2] == pytest.approx(np.linalg.norm(target - centre))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    level = looking_at(centre, target)
    assert level[2, 0] == pytest.approx(0)  # u is horizontal
    assert level[2, 1] < 0  # v points down
    turn = level[:3, :3].T @ T[:3, :3]
    np.testing.assert_allclose(rotation_vectors([turn])[0], [0, 0, 0.3], atol=1e-12)
    down = looking_at(centre, centre - [0, 0, 1.0])
    np.testing.assert_allclose(down[:3, 2], [0, 0, -1])


def test_any_cell_any_part():
    base = paper_cell(3)
    camera = base.cameras["camera"]
    moved = camera.T_base_camera.copy()
    moved[:3, 3] += 0.02
    cell = replace(
        base,
        cameras={"left": camera, "right": replace(camera, T_base_camera=moved)},
        lasers={"red": base.lasers["laser"], "green": tool_z_cell().lasers["laser"]},
    )
    one = simulate_cell(cell, ["3", "1"], {"3": 2, "1": 4}, 4, camera="right", laser="green")
    seen = one.observations
    assert (seen.cameras, seen.lasers, seen.planes) == (("right",), ("green",), ("1", "3"))
    assert list(seen.plane) == ["3"] * 8 + ["1"] * 16
    assert list(one.group) == [g for g in range(6) for _ in range(4)]
    expected = project(cell, seen.T_base_hand, plane=seen.plane, camera="right", laser="green")
    np.testing.assert_array_equal(seen.uv, expected)
    other = simulate_cell(cell, ["1"], 3, camera="left", laser="red").observations
    assert (seen + other).cameras == ("left", "right")
    with pytest.raises(DataError, match=r"camera None; the cell has \['left', 'right'\]"):
        simulate_cell(cell)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: simulate("papr"), r"'papr' is unknown; choose one of paper, paper-2"),
        (lambda: simulate(seed=-1), "seed"),
        (lambda: simulate(seed=1.5), "seed"),
        (lambda: simulate(design="close"), "'close' is unknown; choose one of paper, near, mid"),
        (lambda: simulate(groups=0), "groups on plane '1'"),
        (lambda: simulate(shots=0), "shots"),
        (lambda: simulate(groups=2.5), "groups on plane '1'.*2.5"),
        (lambda: simulate_cell(paper_cell(1), ["2"]), r"plane '2' .* which has \['1'\]"),
        (lambda: simulate_cell(paper_cell(1), ["1", "1"]), "named twice"),
        (lambda: simulate_cell(paper_cell(1), []), "no plane"),
        (lambda: simulate_cell(paper_cell(2), groups={"1": 2}), "no number of groups.*'2'"),
        (lambda: Noise(pixel_px=-1), "pixel_px"),
        (lambda: Noise(hand_rotation_rad=float("nan")), "hand_rotation_rad"),
        (lambda: Noise(hand_rotation_rad=1e306), "hand_rotation_rad: expected a number from 0"),
        (lambda: simulate(noise=Noise(hand_translation_m=10.0)), "give less noise"),
        (lambda: paper_cell(4), "planes"),
    ],
)
def test_wrong_requests_are_refused_in_words(call, match):
    with pytest.raises(DataError, match=match):
        call()


def test_spots_that_leave_the_picture_are_taken_again_and_counted():
    calm, rough = simulate("paper", 0, Noise.table1()), simulate("paper", 0, Noise(pixel_px=80.0))
    assert calm.repeated == 0
    assert rough.repeated > 0
    uv = rough.observations.uv
    assert uv.min() >= -0.5
    assert np.all(uv <= (639.5, 479.5))


def test_labels_sort_in_order_and_are_unique():
    ids = list(simulate("paper").observations.id)
    assert ids == sorted(ids)
    assert len(set(ids)) == 90
    many = list(simulate_cell(paper_cell(1), groups=110).observations.id)
    assert many == sorted(many)


def test_simulating_imports_nothing_heavy():
    code = (
        "import sys, lasercal_gtsam.simulate as s; s.simulate('paper');"
        "print([m for m in ('cv2', 'gtsam', 'numba', 'scipy', 'pydantic') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
