"""What the data cannot give is refused, with what is missing and what would supply it."""

from __future__ import annotations

import numpy as np
import pytest
from closed_form_cases import (
    beam_of,
    camera_of,
    exact,
    largest_error,
    noisy,
    plane_before,
    shots_at,
    spots_of,
    variant,
)

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.closed_form import closed_form_candidates
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.information import free_intrinsics, pixel_derivatives
from lasercal_gtsam.closed_form.requirements import (
    check_orientations,
    check_translations,
    spots_needed,
)
from lasercal_gtsam.closed_form.solution import Solution
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import project
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise

RNG = np.random.default_rng(7)
TURNS = [rotation_exp(w) for w in RNG.uniform(-0.3, 0.3, (60, 3))]
AXIS = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])


def near(sim, count=60, spread=0.05):
    """A hand pose that lights the scene and positions about it."""
    pose = sim.observations.T_base_hand[0]
    rng = np.random.default_rng(3)
    return pose[:3, :3], pose[:3, 3] + rng.uniform(-spread, spread, (count, 3))


def refused(observations, match, **known):
    with pytest.raises(DegenerateError, match=match) as caught:
        closed_form_candidates(observations, **known)
    return str(caught.value)


def test_least_numbers_of_spots():
    # one plane: 2 + 6 + 4 + 3 unknowns; else 5 + 6 + 4 + 3P
    assert [spots_needed(p) for p in (1, 2, 3, 4)] == [8, 11, 12, 14]


def test_too_few_spots():
    sim = exact()
    refused(sim.observations[:7], r"7 spots on 1 plane are too few: at least 8")
    refused(sim.observations[[0, 30, 60]], r"3 spots on 3 planes are too few: at least 12")


def test_pixels_in_one_line():
    observations = exact("paper-2").observations
    for uv in (observations.uv * [1.0, 0.0] + [0.0, 99.0], np.full_like(observations.uv, 50.0)):
        flat = Observations.from_arrays(
            uv, observations.T_base_hand, plane=list(observations.plane), image_size=(640, 480)
        )
        refused(flat, "pixels of every plane lie on one line")


def test_one_orientation():
    message = refused(exact().observations[:10], "all 10 shots have the same hand orientation")
    assert "three or more hand orientations" in message
    refused(exact("paper-2", groups=1).observations[:10], "same hand orientation")


@pytest.mark.parametrize("preset", ["paper-1", "paper-2"])
def test_two_orientations(preset):
    sim = exact(preset)
    chosen = np.isin(sim.group, [0, 1])
    refused(sim.observations[chosen], "only two hand orientations, one turned about")


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("planes", ["1", "123"])
def test_all_orientations_about_one_axis(level, planes):
    sim = exact()
    R0, positions = near(sim)
    cell = Cell(sim.truth.cameras, sim.truth.lasers, {p: sim.truth.planes[p] for p in planes})
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, 60)
    observations = shots_at(cell, [R0 @ rotation_exp(AXIS * a) for a in angles], positions)
    message = refused(observations, "turn about one axis")
    named = np.array([float(x) for x in message.split("axis (")[1].split(" in")[0].split(",")])
    assert abs(named @ AXIS) == pytest.approx(1.0, abs=1e-3)
    # rolls about the beam are the commonest case of it
    u, _ = beam_of(sim.truth)
    refused(
        shots_at(cell, [R0 @ rotation_exp(u * a) for a in angles], positions), "turn about one axis"
    )
    # the same about a fixed axis of the base
    refused(
        shots_at(cell, [rotation_exp(AXIS * a) @ R0 for a in angles], positions),
        "turn about one axis",
    )


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.05, 0.02, 0.1)])
def test_rotations_about_one_point_give_no_scale(arm):
    sim = exact()
    R0, positions = near(sim)
    rotations = [R0 @ R for R in TURNS]
    fixed = np.array([positions[0] - R @ np.array(arm) for R in rotations])
    message = refused(shots_at(sim.truth, rotations, fixed), "only turns about one point")
    assert "translate it by several centimetres" in message


def test_turns_and_motions_that_are_enough_pass():
    R = np.array(TURNS)
    check_orientations(R)
    check_orientations(R[:3])
    check_translations(R, np.random.default_rng(0).uniform(-0.01, 0.01, (60, 3)))
    with pytest.raises(DegenerateError, match="same hand orientation"):
        check_orientations(rotation_exp(2e-3 * np.random.default_rng(0).normal(size=(20, 3))))


@pytest.mark.parametrize("chosen", [(0, 3, 4), (0, 1, 2, 3)])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_two_planes_need_two_orientations_each(chosen, level):
    """1 + 2 and 3 + 1 groups leave one combination of the intrinsics free (ranks of 3.6)."""
    sim = noisy("paper-2", 0, level)
    observations = sim.observations[np.isin(sim.group, chosen)]
    message = refused(observations, "can change together without moving any spot")
    assert "two or more on each of two planes" in message
    assert "principal point" in message
    # and what is said there is true
    K, _, _ = camera_of(sim.truth)
    known = {"principal_point": {"camera": (K[0, 2], K[1, 2])}, "skew": {"camera": 0.0}}
    best = closed_form_candidates(observations, **known)[0]
    if level == 0.0 and chosen == (0, 1, 2, 3):
        assert largest_error(best.cell, sim.truth) < 1e-8


def test_groups_that_are_just_enough():
    sim = exact()
    for chosen in ((0, 1, 3, 4), (0, 3, 6)):
        best = closed_form_candidates(sim.observations[np.isin(sim.group, chosen)])[0]
        planes = {p: plane for p, plane in sim.truth.planes.items() if p in best.cell.planes}
        assert largest_error(best.cell, sim.truth.with_planes(planes)) < 1e-8


@pytest.mark.parametrize("tilt", [0.0, 1.0, 2.0])
def test_one_plane_parallel_to_the_image(tilt):
    camera = exact().truth.cameras["camera"]
    planes = {"1": plane_before(camera, tilt, 40, 0.3)}
    known = {"principal_point": {"camera": (320.0, 240.0)}}
    message = refused(
        variant(planes=planes, noise=Noise.table1()).observations, "focal length", **known
    )
    assert "tilt it by 20 deg or more" in message
    sim = variant(planes=planes)
    if tilt == 0.0:
        refused(sim.observations, "parallel to the image .* tilt it by 20 deg", **known)
    else:
        best = closed_form_candidates(sim.observations, **known)[0]
        assert largest_error(best.cell, sim.truth) < 1e-6
    given = closed_form_candidates(
        sim.observations, focal_lengths={"camera": (550.0, 550.0)}, **known
    )
    assert largest_error(given[0].cell, sim.truth) < 1e-9


def test_one_parallel_plane_beside_a_tilted_one_is_no_problem():
    camera = exact().truth.cameras["camera"]
    planes = {"1": plane_before(camera, 0, 0, 0.3), "2": plane_before(camera, 35, 30, 0.3)}
    sim = variant(planes=planes)
    assert largest_error(closed_form_candidates(sim.observations)[0].cell, sim.truth) < 1e-9


def test_a_plane_with_two_spots_is_named():
    sim = exact()
    message = refused(sim.observations[:62], "plane '3' could not be found")
    assert "at least 3 spots that are not in one line; it has 2 spots" in message


def test_a_plane_with_spots_in_one_line_is_named():
    sim = exact()
    u, q = beam_of(sim.truth)
    plane, camera = sim.truth.planes["3"], sim.truth.cameras["camera"]
    T, R = camera.T_base_camera[:3, 3], camera.T_base_camera[:3, :3]
    centre = T + (plane.distance - plane.normal_base @ T) / (plane.normal_base @ R[:, 2]) * R[:, 2]
    line = basis_of(plane.normal_base)[:, 0]
    pose = sim.observations.T_base_hand[60]
    beam = pose[:3, :3] @ u
    poses = np.array(
        [
            make_pose(pose[:3, :3], centre + a * line - 0.1 * beam - pose[:3, :3] @ q)
            for a in (-0.04, -0.02, 0.01, 0.03)
        ]
    )
    extra = type(sim.observations).from_arrays(
        project(sim.truth, poses, plane="3"), poses, plane="3", image_size=(640, 480)
    )
    refused(sim.observations[:60] + extra, "plane '3' .* not in one line; it has 4 spots")


def test_search_with_too_few_spots_says_so():
    sim = exact("no-groups")
    rows = np.r_[0:6, 30:36]
    refused(sim.observations[rows], "8 spots or more on one plane, or 7 on each of two")


def test_nothing_is_refused_that_can_be_solved():
    """Unusual but sound captures: motions along one line, hand turns of two degrees."""
    sim = exact()
    R0, positions = near(sim)
    rng = np.random.default_rng(1)
    along = positions[0] + rng.uniform(-0.05, 0.05, (60, 1)) * np.array([1.0, 0.2, 0.1])
    for rotations, t in (
        ([R0 @ R for R in TURNS], along),
        ([R0 @ rotation_exp(w) for w in rng.uniform(-0.03, 0.03, (60, 3))], positions),
    ):
        best = closed_form_candidates(shots_at(sim.truth, rotations, t))[0]
        assert best.rms_px < 1e-6


# --- the Jacobian behind it --------------------------------------------------------------------


def test_pixel_derivatives_against_differences():
    sim = variant(camera=None)
    truth = sim.truth
    intrinsics = Intrinsics(560.0, 530.0, 4.0, 310.0, 236.0)
    truth = Cell(
        {"camera": Camera(intrinsics, truth.cameras["camera"].T_base_camera, (640, 480))},
        truth.lasers,
        truth.planes,
    )
    spots = spots_of(sim)
    solution = Solution.of_cell(truth, spots, "camera", "laser")
    free = ("focal length", "fu", "fv", "skew", "u0", "v0")
    found = pixel_derivatives(solution, spots, free)
    plane = list(sim.observations.plane)
    poses = sim.observations.T_base_hand

    def pixels(K=solution.K, R=solution.R, T=solution.T, u=solution.u, q=solution.q, planes=None):
        camera = Camera(
            Intrinsics(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2]), make_pose(R, T), (640, 480)
        )
        cell = Cell({"camera": camera}, {"laser": Beam(u, q)}, planes or truth.planes)
        return project(cell, poses, plane=plane)

    def slope(function, h):
        return (function(h) - function(-h)) / (2 * h)

    unit = np.eye(3)
    places = {"fu": (0, 0), "fv": (1, 1), "skew": (0, 1), "u0": (0, 2), "v0": (1, 2)}
    E = basis_of(solution.u)
    expected = {}
    for name, (i, j) in places.items():
        step = np.zeros((3, 3))
        step[i, j] = 1.0
        expected[name, 0] = slope(lambda h, step=step: pixels(K=solution.K + h * step), 1e-2)
    both = np.diag([560.0 / 530.0, 1.0, 0.0])
    expected["focal length", 0] = slope(lambda h: pixels(K=solution.K + h * both), 1e-2)
    for i in range(3):
        expected["camera rotation", i] = slope(
            lambda h, i=i: pixels(R=solution.R @ rotation_exp(h * unit[i])), 1e-6
        )
        expected["camera position", i] = slope(
            lambda h, i=i: pixels(T=solution.T + h * unit[i]), 1e-6
        )
    for i in range(2):
        expected["beam direction", i] = slope(
            lambda h, i=i: pixels(u=solution.u + h * E[:, i]), 1e-6
        )
        expected["beam point", i] = slope(lambda h, i=i: pixels(q=solution.q + h * E[:, i]), 1e-6)
    for k, name in enumerate(spots.plane_names):
        n, c = solution.normals[k], solution.points[k]
        F = basis_of(n)
        for i in range(2):
            expected[f"plane {name}", i] = slope(
                lambda h, name=name, n=n, c=c, f=F[:, i]: pixels(
                    planes={**truth.planes, name: Plane.from_point(n + h * f, c)}
                ),
                1e-6,
            )
        expected[f"plane {name}", 2] = slope(
            lambda h, name=name, n=n, c=c: pixels(
                planes={**truth.planes, name: Plane.from_point(n, c + h * n)}
            ),
            1e-6,
        )
    assert set(found) == set(expected)
    for key, values in expected.items():
        assert np.allclose(found[key], values, rtol=1e-5, atol=1e-5 * np.abs(values).max()), key


def test_free_intrinsics():
    assert free_intrinsics(KnownIntrinsics(), 1) == ("focal length",)
    assert free_intrinsics(KnownIntrinsics(), 2) == ("fu", "fv", "skew", "u0", "v0")
    known = KnownIntrinsics(principal_point=(0.0, 0.0), skew=0.0, aspect=1.0)
    assert free_intrinsics(known, 3) == ("focal length",)
    assert free_intrinsics(KnownIntrinsics(focal_lengths=(1.0, 1.0), skew=0.0), 2) == ("u0", "v0")


# --- garbage in, no traceback out ----------------------------------------------------------------


def spoiled(kind: str, rng: np.random.Generator) -> Observations:
    sim = exact(("paper", "paper-2", "paper-1", "no-groups")[rng.integers(4)], int(rng.integers(3)))
    observations = sim.observations
    uv, poses = observations.uv.copy(), observations.T_base_hand.copy()
    plane, n = observations.plane.copy(), len(observations)
    if kind == "random pixels":
        uv = rng.uniform(0.0, 480.0, uv.shape)
    elif kind == "far poses":
        poses[:, :3, 3] = rng.normal(scale=10.0, size=(n, 3))
    elif kind == "random rotations":
        poses[:, :3, :3] = rotation_exp(rng.normal(scale=2.0, size=(n, 3)))
    elif kind == "shuffled planes":
        plane = rng.permutation(plane)
    elif kind == "one pose":
        first = plane == plane[0]
        poses[first], uv[first] = poses[0], uv[0]
    else:
        chosen = rng.choice(n, rng.integers(8, 20), replace=False)
        uv, poses, plane = uv[chosen], poses[chosen], plane[chosen]
    return Observations.from_arrays(uv, poses, plane=list(plane), image_size=(640, 480))


@pytest.mark.parametrize(
    "kind",
    ["random pixels", "far poses", "random rotations", "shuffled planes", "one pose", "few spots"],
)
def test_garbage_is_refused_or_ranked_badly_but_never_crashes(kind):
    rng = np.random.default_rng(11)
    for _ in range(2):
        try:
            found = closed_form_candidates(spoiled(kind, rng))
        except DegenerateError as refusal:
            assert len(str(refusal)) > 40
            continue
        assert all(np.isfinite(candidate.rms_px) for candidate in found)
        if kind != "few spots":
            assert found[0].rank > 10.0
