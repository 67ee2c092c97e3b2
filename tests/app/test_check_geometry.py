"""Geometry before the solve, and weak directions with advice that works when it is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lasercal_gtsam as lc
from lasercal_gtsam.check.causes import causes_of, grazing_shots
from lasercal_gtsam.check.picture import coverage, lines_of_spots
from lasercal_gtsam.check.poses import Turns, pose_facts
from lasercal_gtsam.check.remedies import NEW_PLANE, remedies
from lasercal_gtsam.check.weakness import weaknesses
from lasercal_gtsam.simulate import PRESETS, Noise, simulate, simulate_cell
from lasercal_gtsam.simulate.cells import paper_cell
from lasercal_gtsam.simulate.motions import DESIGNS

NOISE = Noise(pixel_px=1.0)


# --- poses alone --------------------------------------------------------------------------------


def facts_of(observations):
    return pose_facts(
        observations.T_base_hand,
        observations.plane,
        observations.camera,
        observations.laser,
        observations.id.tolist(),
    )


def test_turns_are_the_principal_rms_rotation_vectors():
    rng = np.random.default_rng(0)
    spread = np.deg2rad([20.0, 10.0, 2.0])
    vectors = spread * np.clip(rng.standard_normal((4000, 3)), -2, 2)
    frame = Rotation.from_euler("xyz", [0.3, -0.5, 1.0])
    R = (frame * Rotation.from_rotvec(vectors)).as_matrix()
    turns = Turns.of(R)
    expected = np.rad2deg(np.sqrt((vectors**2).mean(axis=0)))
    np.testing.assert_allclose(turns.rms_deg, expected, rtol=0.03)
    assert turns.axes == 2
    assert turns.largest_deg == pytest.approx(
        np.rad2deg(np.linalg.norm(vectors, axis=1).max()), rel=0.05
    )


def test_groups_and_translations_of_a_plan_are_found():
    simulation = simulate("paper-2", 0)
    facts = facts_of(simulation.observations)
    assert facts.counts["plane"] == {"1": 30, "2": 30}
    assert [(p.rows, p.groups, p.orientations, p.in_groups) for p in facts.planes] == [
        (30, 3, 3, 30),
        (30, 3, 3, 30),
    ]
    assert facts.turns.distinct == 6
    t = 1000 * simulation.observations.T_base_hand[:, :3, 3]
    np.testing.assert_allclose(facts.extent_mm, t.max(axis=0) - t.min(axis=0))
    longest = [
        np.linalg.norm(t[simulation.group == g] - t[simulation.group == g].mean(axis=0), axis=1)
        for g in range(3)
    ]
    assert facts.planes[0].longest_mm == pytest.approx(np.median([d.max() for d in longest]))
    assert facts.missing == facts.advice == facts.odd == ()


def turned(observations, vectors):
    """The same positions with hand orientations turned by rotation vectors, one a group of ten."""
    T = observations.T_base_hand.copy()
    first = T[0, :3, :3]
    T[:, :3, :3] = np.repeat(Rotation.from_rotvec(vectors).as_matrix(), 10, axis=0) @ first
    return replace(observations, T_base_hand=T)


@pytest.mark.parametrize(
    ("vectors", "words"),
    [
        (np.zeros((6, 3)), "same hand orientation"),
        (np.linspace(-0.5, 0.5, 6)[:, None] * [0, 0, 1.0], "turn about one axis"),
    ],
)
def test_poses_that_cannot_suffice_are_named_without_spots(vectors, words):
    facts = facts_of(turned(simulate("paper-2", 0).observations, vectors))
    assert len(facts.missing) == 1
    assert words in facts.missing[0]


def test_a_narrow_second_axis_is_advised_against():
    vectors = np.linspace(-0.5, 0.5, 6)[:, None] * [0, 0, 1.0]
    vectors[::2, 0] = np.deg2rad(2.0)
    facts = facts_of(turned(simulate("paper-2", 0).observations, vectors))
    assert facts.missing == ()
    assert "about a second one: turn it by 20 deg" in facts.advice[0]


def test_two_planes_with_one_orientation_on_one_of_them():
    seen = simulate("paper-2", 0).observations
    facts = facts_of(seen[np.r_[0:30, 30:40]])
    assert any("each needs two hand orientations" in text for text in facts.advice)


def test_few_shots_and_short_moves_are_said():
    seen = simulate("paper-2", 0).observations
    T = seen.T_base_hand.copy()
    for g in range(6):
        rows = slice(10 * g, 10 * g + 10)
        T[rows, :3, 3] = T[10 * g, :3, 3] + 0.1 * (T[rows, :3, 3] - T[10 * g, :3, 3])
    facts = facts_of(replace(seen, T_base_hand=T))
    assert any("moves by only" in text for text in facts.advice)
    few = facts_of(seen[::3])
    assert any("20 shots are few" in text for text in few.advice)
    too_few = facts_of(seen[::10])
    assert "too few" in too_few.missing[0]


def test_a_repeated_pose_looks_odd_unless_it_is_another_plane():
    seen = simulate("paper-2", 0).observations
    T = seen.T_base_hand.copy()
    T[5] = T[4]
    T[40] = T[4]  # the other plane
    odd = facts_of(replace(seen, T_base_hand=T)).odd
    assert len(odd) == 1
    assert f"{seen.id[4]} = {seen.id[5]}" in odd[0]
    assert "1 shot repeats" in odd[0]


# --- where the spots lie ------------------------------------------------------------------------


def spots_at(uv, plane="1"):
    T = np.tile(np.eye(4), (len(uv), 1, 1))
    return lc.Observations.from_arrays(uv, T, plane=plane, image_size=(640, 480))


def test_coverage_of_a_picture():
    corners = [[0, 0], [639, 0], [0, 479], [639, 479], [319.5, 239.5]]
    (found,) = coverage(spots_at(np.array(corners, dtype=float)))
    assert found.fields == 5
    assert found.reach == pytest.approx(1.0, abs=0.005)
    np.testing.assert_allclose(found.span, (639 / 640, 479 / 480))
    (one,) = coverage(spots_at(np.full((4, 2), 100.0)))
    assert (one.fields, one.span) == (1, (0.0, 0.0))


@pytest.mark.parametrize(
    ("across", "words"), [(0.0, "lie on one line"), (3.0, "nearly on one line"), (60.0, None)]
)
def test_spots_in_a_line_are_noticed(across, words):
    along = np.linspace(50, 500, 20)
    uv = np.column_stack([along, 200 + 0.1 * along + across * (-1.0) ** np.arange(20)])
    found = lines_of_spots(spots_at(uv))
    assert (not found) if words is None else (len(found) == 1 and words in found[0])


# --- weak directions ----------------------------------------------------------------------------


def plane_before(cell, tilt_deg, azimuth_deg, depth_m):
    """Plane that the optical axis meets at a depth, tilted in the camera."""
    T = cell.cameras["camera"].T_base_camera
    tilt, azimuth = np.deg2rad([tilt_deg, azimuth_deg])
    n = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
    return lc.Plane.from_point(T[:3, :3] @ n, T[:3, 3] + depth_m * T[:3, 2])


BASE = paper_cell(2)
FACING = BASE.with_planes({"1": plane_before(BASE, 5, 45, 0.3)})
TWO = BASE.with_planes(
    {"1": plane_before(BASE, 30, 40, 0.3), "2": plane_before(BASE, 25, 200, 0.3)}
)
TILTED = BASE.with_planes({"1": plane_before(BASE, 30, 40, 0.3)})
NARROW = replace(DESIGNS["paper"], cone=np.deg2rad(1.0), roll=np.deg2rad(1.0))
CLUSTERED = replace(DESIGNS["paper"], centre=0.15, longest=0.02, shortest=0.005)


def calibrated(observations, known):
    return lc.calibrate(observations, options=lc.CalibrationOptions(known=known))


def weak_design(name):
    if name == "facing":
        return simulate_cell(FACING, groups=4, noise=NOISE, seed=1)
    if name == "narrow":
        return simulate_cell(TWO, groups=4, noise=NOISE, seed=1, design=NARROW)
    return simulate_cell(TILTED, groups=4, noise=NOISE, seed=1, design=CLUSTERED)


def more_shots(name):
    """New data as the advice asks for, planned without the code that gave it."""
    if name == "facing":
        cell = FACING.with_planes({"wedge": plane_before(FACING, 20, 160, 0.3)})
        return simulate_cell(cell, groups=4, shots=5, noise=NOISE, seed=2, prefix="n")
    if name == "narrow":
        wide = replace(DESIGNS["paper"], cone=np.deg2rad(25.0))
        return simulate_cell(TWO, groups=1, noise=NOISE, seed=2, design=wide, prefix="n")
    wide = replace(DESIGNS["paper"], centre=0.9, longest=0.15)
    return simulate_cell(TILTED, groups=2, noise=NOISE, seed=2, design=wide, prefix="n")


@pytest.mark.parametrize(
    ("name", "kind", "what", "cause", "action"),
    [
        ("facing", "plane", "focal length against camera depth", "of parallel to the picture",
         "add a plane tilted by 20 deg or more"),
        ("narrow", "turn", "focal length", "about one axis only", "turned by 20 deg or more"),
        ("clustered", "spread", "focal length against camera depth", "the spots span",
         "reach the corners and edges"),
    ],
)  # fmt: skip
def test_weak_geometry_is_explained_and_the_advice_cures_it(name, kind, what, cause, action):
    simulation = weak_design(name)
    result = calibrated(simulation.observations, simulation.known)
    found = [w for w in weaknesses(result) if not w.distortion]
    assert found
    assert found[0].strength < 1
    first = found[0].cures[0]
    assert first.kind == kind
    assert first.strength > 1
    for text in (what, cause, action):
        assert text in found[0].words

    together = simulation.observations + more_shots(name).observations
    after = calibrated(together, {} if name == "facing" else simulation.known)
    assert after.fit.converged
    assert [w.words for w in weaknesses(after) if not w.distortion] == []


@pytest.mark.parametrize("preset", ["paper", "table2-1", "table2-3", "tool-z", "no-groups"])
def test_presets_have_no_weak_geometry(preset):
    simulation = simulate(preset, 0, PRESETS[preset].noise)
    result = calibrated(simulation.observations, simulation.known)
    assert [w.words for w in weaknesses(result) if not w.distortion] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_no_preset_has_weak_geometry(preset, seed):
    simulation = simulate(preset, seed, PRESETS[preset].noise)
    result = calibrated(simulation.observations, simulation.known)
    if result.fit.converged:
        assert [w.words for w in weaknesses(result) if not w.distortion] == []


def test_the_strength_of_a_direction_is_that_of_the_calibration():
    simulation = simulate("paper", 0, PRESETS["paper"].noise)
    result = calibrated(simulation.observations, simulation.known)
    found = [w.strength for w in weaknesses(result) if w.distortion]
    expected = [w.strength for w in result.observability.weak]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_what_a_remedy_promises_is_what_its_shots_give():
    """The predicted strength against a calibration with the virtual shots really taken."""
    simulation = weak_design("facing")
    result = calibrated(simulation.observations, simulation.known)
    promised = next(w for w in weaknesses(result) if not w.distortion).cures[0]
    remedy = next(r for r in remedies(result.cell, simulation.observations) if r.kind == "plane")
    true_cell = FACING.with_planes({**FACING.planes, NEW_PLANE: remedy.cell.planes[NEW_PLANE]})
    uv = lc.project(true_cell, remedy.shots.T_base_hand, plane=NEW_PLANE)
    shots, uv = remedy.shots[np.isfinite(uv[:, 0])], uv[np.isfinite(uv[:, 0])]
    rng = np.random.default_rng(0)
    taken = replace(shots, uv=uv + rng.standard_normal(uv.shape),
                    id=np.array([f"n{k}" for k in range(len(uv))]))  # fmt: skip
    after = calibrated(simulation.observations + taken, {})
    i = after.labels.index("camera.fu")
    sigma_after = np.sqrt(after.covariance[i, i])
    sigma_before = np.sqrt(result.covariance[i, i])
    # the direction is mostly that of the focal length: its sigma falls as its strength rises
    before = next(w for w in weaknesses(result) if not w.distortion).strength
    assert sigma_after < sigma_before * before / promised.strength * 2.5


def test_remedies_are_seen_by_the_camera():
    simulation = simulate("paper-2", 0)
    for remedy in remedies(simulation.truth, simulation.observations):
        shots = remedy.shots
        uv = lc.project(remedy.cell, shots.T_base_hand, plane=shots.plane.tolist())
        assert ((uv > 0) & (uv < [639, 479])).all()
        assert len(shots) >= 12
        if remedy.kind == "plane":
            new = remedy.cell.planes[NEW_PLANE].normal_base
            assert set(shots.plane) == {NEW_PLANE}
            assert all(abs(new @ p.normal_base) < 1 for p in simulation.truth.planes.values())


@pytest.mark.parametrize(
    ("cell", "words", "poor"),
    [
        (FACING, "within 5 deg of parallel to the picture", True),
        (BASE.with_planes({"1": plane_before(BASE, 35, 1, 0.3)}), "camera's x-z plane", True),
        (TILTED, "only one plane, tilted by 30 deg", True),
        (BASE.with_planes({"1": plane_before(BASE, 30, 40, 0.25),
                           "2": plane_before(BASE, 34, 40, 0.35)}),
         "within 4 deg of parallel", True),
        (TWO, "differ by up to 54 deg", False),
    ],
)  # fmt: skip
def test_causes_in_the_planes(cell, words, poor):
    cause = causes_of(cell, simulate("paper-2", 0).observations)["plane"]
    assert words in cause.words
    assert cause.poor == poor


def test_turns_about_the_beam_are_told_from_turns_of_it():
    seen = simulate("paper-2", 0).observations
    beam = BASE.lasers["laser"].direction_hand
    rolls = np.linspace(-0.8, 0.8, len(seen))[:, None] * beam
    wobble = 0.12 * np.random.default_rng(0).standard_normal((len(seen), 3))
    T = seen.T_base_hand.copy()
    for size, words in ((0.25, "mostly about the beam"), (1.0, None)):
        R = Rotation.from_matrix(T[0, :3, :3]) * Rotation.from_rotvec(size * wobble)
        T[:, :3, :3] = (R * Rotation.from_rotvec(rolls)).as_matrix()
        cause = causes_of(BASE, replace(seen, T_base_hand=T))["turn"]
        assert cause.poor == (words is not None)
        if words is not None:
            assert words in cause.words or "one axis only" in cause.words


def test_grazing_beams_and_views_are_said():
    simulation = simulate("tool-z", 0)
    seen, truth = simulation.observations, simulation.truth
    assert grazing_shots(truth, seen) == []
    beams = seen.T_base_hand[:, :3, :3] @ truth.lasers["laser"].direction_hand
    # a plane through the spots that holds the beam of the first shot
    normal = np.cross(beams[0], [0.0, 1.0, 0.0])
    steep = lc.Plane.from_point(normal, [0.45, 0.0, -0.12])
    angles = np.rad2deg(np.arcsin(np.abs(beams @ steep.normal_base)))
    found = grazing_shots(truth.with_planes({"1": steep}), seen)
    expected = f"the beam meets plane '1' at less than 15 deg in {(angles < 15).sum()} of 60 shots"
    assert any(expected in text for text in found)
