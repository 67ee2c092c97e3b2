"""What the data cannot give is refused in words, or returned with a word; never a silent number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core_cases import moved_intrinsics, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.simulate import Noise, simulate_cell


def seen_from(truth, T_base_hand, plane, pixel_px=0.0):
    """Spots of a cell where they can be seen, from any hand poses."""
    uv = lc.project(truth, T_base_hand, plane=plane)
    inside = ((uv > 0) & (uv < [639, 479])).all(axis=1)
    uv = uv + pixel_px * np.random.default_rng(0).standard_normal(uv.shape)
    return lc.Observations.from_arrays(
        uv[inside], T_base_hand[inside], plane=plane[inside], image_size=(640, 480)
    )


def with_rotations(simulation, rotations, pixel_px):
    T = simulation.observations.T_base_hand.copy()
    T[:, :3, :3] = rotations
    return seen_from(simulation.truth, T, simulation.observations.plane, pixel_px)


def one_orientation(simulation, pixel_px):
    return with_rotations(simulation, simulation.observations.T_base_hand[0, :3, :3], pixel_px)


def one_axis(simulation, pixel_px):
    """Three orientations, all turned about one axis of the hand."""
    first = simulation.observations.T_base_hand[0, :3, :3]
    turns = np.array([-0.25, 0.0, 0.3])[simulation.group % 3]
    turned = rotation_exp(turns[:, None] * np.array([0.0, 0.0, 1.0]))
    return with_rotations(simulation, turned @ first, pixel_px)


@pytest.mark.parametrize("pixel_px", [0.0, 1.0])
@pytest.mark.parametrize("preset", ["paper", "paper-1"])
@pytest.mark.parametrize(
    ("make", "words", "combinations"),
    [
        (one_orientation, ["same hand orientation", "three or more hand orientations"], 3),
        (one_axis, ["turn about one axis", "three or more hand orientations"], 1),
    ],
)
def test_too_few_orientations_are_refused(make, words, combinations, preset, pixel_px):
    simulation = simulated(preset, 0)
    seen = make(simulation, pixel_px)
    assert len(seen) > 20
    with pytest.raises(lc.DegenerateError) as caught:
        lc.calibrate(seen, options=lc.CalibrationOptions(known=simulation.known))
    for word in words:
        assert word in str(caught.value)
    # the solver itself finds it too, and names what moves together
    with pytest.raises(lc.DegenerateError, match="undetermined") as caught:
        lc.calibrate(seen, initial=simulation.truth)
    text = str(caught.value)
    assert int(text.split("leave ")[1].split()[0]) >= combinations
    assert "laser.offset" in text
    assert "mm" in text
    assert "hand orientations" in text


def test_orientations_about_one_axis_leave_the_scene_free_to_slide():
    """Camera, planes and beam moved along the axis: no pixel moves, so nothing tells the place."""
    simulation = simulated("paper", 0)
    seen, truth = one_axis(simulation, 0.0), simulation.truth
    shift = np.array([0.0, 0.0, 0.02])
    slid = np.eye(4)
    slid[:3, 3] = shift
    camera, beam = truth.cameras["camera"], truth.lasers["laser"]
    point = beam.point_hand + seen.T_base_hand[0, :3, :3].T @ shift
    moved = lc.Cell(
        {"camera": replace(camera, T_base_camera=slid @ camera.T_base_camera)},
        {"laser": lc.Beam(beam.direction_hand, point)},
        {
            name: lc.Plane(p.normal_base, p.distance + p.normal_base @ shift)
            for name, p in truth.planes.items()
        },
    )
    again = lc.project(moved, seen.T_base_hand, plane=seen.plane)
    np.testing.assert_allclose(again, seen.uv, atol=1e-9)


def plane_before(cell, tilt_deg, depth=0.3):
    camera = cell.cameras["camera"].T_base_camera
    R, tilt = camera[:3, :3], np.radians(tilt_deg)
    normal = R @ np.array([np.sin(tilt) * 0.6, np.sin(tilt) * 0.8, np.cos(tilt)])
    return lc.Plane.from_point(normal, camera[:3, 3] + depth * R[:, 2])


@pytest.mark.parametrize("started", [True, False], ids=["start", "no start"])
@pytest.mark.parametrize(("tilt", "pixel_px"), [(0.0, 0.0), (0.0, 0.5), (0.3, 0.5)])
def test_a_plane_parallel_to_the_image_gives_no_focal_length(tilt, pixel_px, started):
    base = simulated("paper-1", 0)
    cell = base.truth.with_planes({"1": plane_before(base.truth, tilt)})
    made = simulate_cell(cell, groups=4, shots=10, seed=1, noise=Noise(pixel_px=pixel_px))
    options = lc.CalibrationOptions(known=base.known, distortion="none")
    try:
        result = lc.calibrate(made.observations, initial=cell if started else None, options=options)
    except lc.DegenerateError as error:
        assert "parallel to the image" in str(error) or "camera.fu" in str(error)
    except lc.SolveError as error:
        assert "start" in str(error)
    else:
        # an answer is allowed if it says that it is none
        assert not result.fit.converged or result["fu"].sigma > 0.5 * result["fu"].refined
        assert result.observability.weak
        assert "camera.fu" in result.observability.weak[0].words


@pytest.mark.parametrize("started", [True, False], ids=["start", "no start"])
@pytest.mark.parametrize("count", [1, 4, 9, 11])
def test_too_few_spots_are_refused(count, started):
    simulation = simulated("paper", 0, 0.5)
    rows = np.linspace(0, 89, count).astype(int)
    with pytest.raises(lc.DegenerateError) as caught:
        lc.calibrate(simulation.observations[rows], initial=simulation.truth if started else None)
    text = str(caught.value)
    assert "undetermined" in text if started else "too few" in text


@pytest.mark.parametrize("started", [True, False], ids=["start", "no start"])
@pytest.mark.parametrize("count", [1, 2])
def test_a_plane_with_two_spots_is_named(count, started):
    simulation = simulated("paper", 0, 0.5)
    seen = simulation.observations[: 60 + count]
    assert seen.planes == ("1", "2", "3")
    with pytest.raises(lc.DegenerateError) as caught:
        lc.calibrate(seen, initial=simulation.truth if started else None)
    assert "plane '3'" in str(caught.value) or "plane 3." in str(caught.value)


def test_a_plane_with_three_spots_is_enough_with_the_others():
    simulation = simulated("paper", 0)
    rows = [*range(60), 60, 70, 80]
    result = lc.calibrate(simulation.observations[rows])
    for axis in "xyz":
        wanted = 1000 * simulation.truth.planes["3"].vector["xyz".index(axis)]
        assert result[f"a_3_{axis}"].refined == pytest.approx(wanted, abs=1e-6)


def test_just_enough_spots_give_no_sigma_and_say_so():
    """Eight unknowns from four spots: an exact fit, and nothing that tells how good it is."""
    simulation = simulated("paper", 3, 0.05)
    truth = simulation.truth.cameras["camera"].intrinsics
    known = {n: getattr(truth, n) for n in ("skew", "u0", "v0")} | {"aspect": 1.0}
    options = lc.CalibrationOptions(
        known=known, distortion="none", fixed=("T_base_camera",), robust="none"
    )
    seen = simulation.observations[[0, 5, 12, 25]]
    result = lc.calibrate(seen, initial=simulation.truth, options=options)
    assert result.fit.rms_px < 1e-6
    assert result.fit.dof == 0
    assert "no degrees of freedom" in result.fit.status
    assert np.isnan(result.fit.sigma0)
    assert np.isnan([result[name].sigma for name in ("fv", "laser_y", "a_1_z")]).all()
    # what is held has no sigma all the same
    assert {result[name].sigma for name in ("Tx", "k1", "u0")} == {0.0}
    assert "unknown" in result.table()


def test_distortion_that_one_plane_cannot_carry_is_given_up_with_a_word():
    """Spots in a small patch: no distortion can be told from them."""
    simulation = simulated("table2-2", 5, 2.0)
    centre = np.abs(simulation.observations.uv - [320, 240]).max(axis=1) < 110
    seen = simulation.observations[centre]
    assert len(seen) > 15
    options = lc.CalibrationOptions(known=simulation.known, priors={
        "k1": (0, 50), "k2": (0, 500), "p1": (0, 5), "p2": (0, 5),
    })  # fmt: skip
    try:
        result = lc.calibrate(seen, initial=simulation.truth, options=options)
    except lc.LasercalError as error:
        assert str(error)
    else:
        words = " ".join(
            [result.fit.status, *result.observability.held, *result.observability.notes]
        )
        weak = result.observability.weak
        assert weak or "held at zero" in words or "fold" in words or not result.fit.converged


def test_an_answer_that_folds_beyond_the_spots_says_so():
    simulation = simulated("paper", 0)
    truth = moved_intrinsics(simulation.truth, k1=-0.55, k2=0.0)
    # spots within 200 px of the centre: the model folds at 400 px / 1.1, before the corners
    seen = seen_from(truth, simulation.observations.T_base_hand, simulation.observations.plane)
    near = np.linalg.norm(seen.uv - [320, 240], axis=1) < 230
    result = lc.calibrate(seen[near], initial=truth)
    assert result.fit.converged
    assert "folds" in result.fit.status
    assert "beyond the spots" in result.fit.status
    assert any("folds" in note for note in result.observability.notes)


def test_a_known_distortion_that_folds_is_never_passed_over():
    simulation = simulated("paper", 0)
    strong = moved_intrinsics(simulation.truth, k1=-0.55, k2=0.0)
    seen = seen_from(strong, simulation.observations.T_base_hand, simulation.observations.plane)
    options = lc.CalibrationOptions(known={"k1": -1.2, "k2": 0.0}, robust="none")
    try:
        result = lc.calibrate(seen, initial=simulation.truth, options=options)
    except lc.LasercalError as error:
        assert "distortion" in str(error) or "start" in str(error)
    else:
        assert "folds" in result.fit.status or not result.fit.converged


def test_too_few_iterations_are_not_called_an_answer():
    simulation = simulated("paper-distorted", 2, 1.0)
    start = moved_intrinsics(simulation.truth, fu=500.0, fv=500.0, k1=0.0, k2=0.0)
    options = lc.CalibrationOptions(max_iterations=1, robust="none")
    result = lc.calibrate(simulation.observations, initial=start, options=options)
    enough = lc.calibrate(simulation.observations, initial=start)
    assert enough.fit.converged
    if result.fit.converged and "not converged" not in " ".join(result.observability.held):
        # the closing steps reached it all the same
        assert result["fu"].refined == pytest.approx(enough["fu"].refined, abs=1e-3)
    elif not result.fit.converged:
        assert "not converged" in result.fit.status
        assert "not to be trusted" in result.fit.status
