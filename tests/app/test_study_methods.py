"""The comparison methods: exact without noise, equal to other solvers, and clear where they end."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lasercal_gtsam.errors import DataError, DegenerateError, SolveError
from lasercal_gtsam.rotations import make_pose
from lasercal_gtsam.simulate import Noise
from lasercal_gtsam.simulate.cells import paper_cell
from lasercal_gtsam.study.captures import (
    CORNER_OBJECT_M,
    MALM_PATTERN_M,
    horaud_views,
    ma_views,
    malm_views,
)
from lasercal_gtsam.study.methods import (
    EyeToHand,
    HandViews,
    calibrate_horaud_dornaika,
    calibrate_ma,
    calibrate_malm_heyden,
    refine_views,
)
from lasercal_gtsam.study.methods.horaud_dornaika import camera_matrices, hand_in_object

CAMERA = paper_cell(1).cameras["camera"]
FLAT = np.column_stack([MALM_PATTERN_M, np.zeros(len(MALM_PATTERN_M))])
EXACT, LITTLE = Noise(), Noise.table1(0.2)


def rng(seed):
    return np.random.default_rng([seed, 31])


def assert_same(found: EyeToHand, truth: EyeToHand, relative: float = 1e-8):
    np.testing.assert_allclose(found.K, truth.K, rtol=relative, atol=550 * relative)
    np.testing.assert_allclose(found.T_base_camera, truth.T_base_camera, atol=relative)
    np.testing.assert_allclose(found.points_hand, truth.points_hand, atol=relative)


def project_one(K, T_base_camera, T_base_hand, point):
    """One pixel, written with 4x4 matrices only."""
    p = np.linalg.inv(T_base_camera) @ T_base_hand @ np.append(point, 1.0)
    m = K @ p[:3]
    return m[:2] / m[2]


@pytest.mark.parametrize("make", [ma_views, malm_views, horaud_views])
def test_simulated_views_are_projections_of_ninety_points_in_view(make):
    made = make(CAMERA, EXACT, rng(3))
    views, truth = made.views, made.truth
    assert views.uv.shape[0] * views.uv.shape[1] == 90
    for s, j in ((0, 0), (4, 2), (-1, -1)):
        expected = project_one(
            truth.K, truth.T_base_camera, views.T_base_hand[s], truth.points_hand[j]
        )
        np.testing.assert_allclose(views.uv[s, j], expected, atol=1e-9)
    assert (views.uv >= 8).all()
    assert (views.uv <= np.array(CAMERA.image_size) - 9).all()


def test_ma_translations_are_orthogonal_triads():
    views = ma_views(CAMERA, EXACT, rng(4)).views
    assert [len(shots) for shots in views.orientations()] == [10, 10, 10]
    for shots in views.orientations():
        moves = (views.t[shots[1:]] - views.t[shots[0]]).reshape(3, 3, 3)
        for triad in moves:
            gram = triad @ triad.T
            np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-15)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("zero_skew", [False, True])
def test_ma_is_exact_without_noise(seed, zero_skew):
    made = ma_views(CAMERA, EXACT, rng(seed))
    found = calibrate_ma(made.views, zero_skew=zero_skew)
    assert_same(found, made.truth)
    assert_same(refine_views(made.views, found), made.truth)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("zero_skew", [False, True])
def test_malm_heyden_is_exact_without_noise(seed, zero_skew):
    made = malm_views(CAMERA, EXACT, rng(seed))
    found = calibrate_malm_heyden(made.views, MALM_PATTERN_M, zero_skew=zero_skew)
    assert_same(found, made.truth)
    assert_same(refine_views(made.views, found, FLAT), made.truth)


@pytest.mark.parametrize("seed", range(8))
def test_horaud_dornaika_is_exact_without_noise(seed):
    made = horaud_views(CAMERA, EXACT, rng(seed))
    found = calibrate_horaud_dornaika(made.views, CORNER_OBJECT_M)
    assert_same(found.camera, made.truth)
    np.testing.assert_allclose(found.T_hand_object, made.T_hand_target, atol=1e-8)
    np.testing.assert_allclose(found.T_hand_object_closed, made.T_hand_target, atol=1e-8)


def test_malm_heyden_needs_one_orientation_for_the_intrinsics_and_says_what_else():
    made = malm_views(CAMERA, EXACT, rng(1))
    one = HandViews(made.views.uv[:3], made.views.T_base_hand[:3], CAMERA.image_size)
    with pytest.raises(DegenerateError, match="pattern and camera position cannot be told apart"):
        calibrate_malm_heyden(one, MALM_PATTERN_M, zero_skew=True)  # K is found from one


def test_a_turned_pattern_and_a_turned_base_change_nothing_but_names():
    """The truth moves with the frames: catches a rotation on the wrong side."""
    made = malm_views(CAMERA, EXACT, rng(2))
    turn = make_pose(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), np.array([0.3, -0.2, 0.1]))
    views = HandViews(made.views.uv, turn @ made.views.T_base_hand, CAMERA.image_size)
    found = calibrate_malm_heyden(views, MALM_PATTERN_M)
    np.testing.assert_allclose(found.T_base_camera, turn @ made.truth.T_base_camera, atol=1e-8)
    made = horaud_views(CAMERA, EXACT, rng(2))
    held = made.views.T_base_hand @ np.linalg.inv(turn)
    found_object = calibrate_horaud_dornaika(
        HandViews(made.views.uv, held, CAMERA.image_size), CORNER_OBJECT_M
    )
    np.testing.assert_allclose(found_object.T_hand_object, turn @ made.T_hand_target, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_hand_eye_agrees_with_opencv(seed):
    """OpenCV solves A X = X B for the camera on the gripper: the object takes the camera's part."""
    exact = horaud_views(CAMERA, EXACT, rng(seed))
    M = camera_matrices(exact.views, CORNER_OBJECT_M)
    P = np.linalg.solve(exact.views.scaling @ exact.truth.K, M)
    R_oc = np.swapaxes(P[:, :, :3], 1, 2)
    t_oc = -(R_oc @ P[:, :, 3:])[..., 0]
    hands = exact.views.T_base_hand
    R, t = cv2.calibrateHandEye(
        list(hands[:, :3, :3]),
        list(hands[:, :3, 3]),
        list(R_oc),
        list(t_oc),
        method=cv2.CALIB_HAND_EYE_HORAUD,
    )
    ours = np.linalg.inv(hand_in_object(M, hands)[0])
    np.testing.assert_allclose(ours, make_pose(R, t[:, 0]), atol=1e-8)


def test_camera_matrices_agree_with_opencv_poses():
    made = horaud_views(CAMERA, EXACT, rng(11))
    M = camera_matrices(made.views, CORNER_OBJECT_M)
    for k in (0, 5):
        ok, r, t = cv2.solvePnP(CORNER_OBJECT_M, made.views.uv[k], made.truth.K, None)
        assert ok
        P = made.views.scaling @ made.truth.K @ np.column_stack([cv2.Rodrigues(r)[0], t])
        np.testing.assert_allclose(M[k], P, atol=1e-6)


def test_refinement_ends_in_one_minimum_below_the_truth():
    made = malm_views(CAMERA, LITTLE, rng(5))
    found = refine_views(made.views, calibrate_malm_heyden(made.views, MALM_PATTERN_M), FLAT)
    ours = np.linalg.norm(found.predicted(made.views.T_base_hand) - made.views.uv)
    true = np.linalg.norm(made.truth.predicted(made.views.T_base_hand) - made.views.uv)
    assert ours < true  # a minimum lies below the truth
    moved = EyeToHand(
        found.K * [[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]], *(found.T_base_camera, found.points_hand)
    )
    again = refine_views(made.views, moved, FLAT)
    assert_same(again, found, 1e-6)


def test_refinement_takes_most_of_mas_error_out():
    ratios = []
    for seed in range(12):
        made = ma_views(CAMERA, LITTLE, rng(100 + seed))
        closed = calibrate_ma(made.views)
        refined = refine_views(made.views, closed)
        truth = made.truth.T_base_camera
        error = [np.linalg.norm(x.T_base_camera - truth) for x in (closed, refined)]
        ratios.append(error[1] / error[0])
    assert np.exp(np.mean(np.log(ratios))) < 0.6


def test_what_cannot_be_solved_is_refused_in_words():
    made = ma_views(CAMERA, EXACT, rng(1))
    views = made.views
    one_point = HandViews(views.uv[:, :1], views.T_base_hand, CAMERA.image_size)
    with pytest.raises(DataError, match="needs 2 points on the hand or more, got 1"):
        calibrate_ma(one_point)
    one_way = HandViews(views.uv[:10], views.T_base_hand[:10], CAMERA.image_size)
    with pytest.raises(DegenerateError, match="points and camera position cannot be told apart"):
        calibrate_ma(one_way)
    still = HandViews(views.uv[::10], views.T_base_hand[::10], CAMERA.image_size)
    with pytest.raises(DegenerateError, match="never moves without turning"):
        calibrate_ma(still)
    with pytest.raises(DegenerateError, match="1 equations for 5 intrinsics"):
        calibrate_ma(HandViews(views.uv[:3], views.T_base_hand[:3], CAMERA.image_size))
    with pytest.raises(DataError, match=r"pattern: expected shape \(3, 2\)|needs 4 points"):
        calibrate_malm_heyden(views, MALM_PATTERN_M)
    spatial = horaud_views(CAMERA, EXACT, rng(1))
    with pytest.raises(DataError, match=r"points: expected shape \(10, 3\)"):
        calibrate_horaud_dornaika(spatial.views, MALM_PATTERN_M)
    two = HandViews(spatial.views.uv[:2], spatial.views.T_base_hand[:2], CAMERA.image_size)
    with pytest.raises(DataError, match=r"needs 3 shots or more, got 2$"):
        calibrate_horaud_dornaika(two, CORNER_OBJECT_M)
    with pytest.raises(DataError, match=r"HandViews\.T_base_hand: expected shape"):
        HandViews(spatial.views.uv, spatial.views.T_base_hand[:3], CAMERA.image_size)


def test_turning_about_one_axis_only_is_refused():
    made = horaud_views(CAMERA, EXACT, rng(1))
    first = made.views.T_base_hand[0]
    turns = [Rotation.from_rotvec([0, 0, a]).as_matrix() for a in (0.0, 0.1, 0.2, 0.3)]
    hands = np.array([first @ make_pose(turn, np.zeros(3)) for turn in turns])
    uv = made.truth.predicted(hands)
    with pytest.raises(DegenerateError, match="turns about one axis only"):
        calibrate_horaud_dornaika(HandViews(uv, hands, CAMERA.image_size), CORNER_OBJECT_M)


def test_a_refinement_that_ends_nowhere_says_so():
    made = ma_views(CAMERA, EXACT, rng(1))
    away = make_pose(made.truth.T_base_camera[:3, :3], made.truth.T_base_camera[:3, 3])
    away[:3, 3] += 2.0 * away[:3, 2]  # the points are behind the camera
    start = EyeToHand(made.truth.K, away, made.truth.points_hand)
    try:
        found = refine_views(made.views, start)
    except SolveError as error:
        assert "did not end at a camera that sees the points" in str(error)
    else:
        assert_same(found, made.truth)


def test_captures_need_a_view_wide_enough():
    from dataclasses import replace

    narrow = replace(CAMERA, intrinsics=replace(CAMERA.intrinsics, fu=9000.0, fv=9000.0))
    with pytest.raises(DataError, match="it needs a wider view"):
        horaud_views(narrow, EXACT, rng(0))


@pytest.mark.parametrize("seed", range(3))
def test_poses_may_be_rounded_as_robots_round_them(seed):
    """To 1 um and 1e-5 in the rotation matrix: orthogonal, and one orientation, only nearly."""
    made = ma_views(CAMERA, EXACT, rng(seed))
    rounded = HandViews(made.views.uv, made.views.T_base_hand.round(6), CAMERA.image_size)
    turned = np.array(rounded.T_base_hand)
    turned[::2, :3, :3] += 1e-5
    views = HandViews(made.views.uv, turned, CAMERA.image_size)
    found = calibrate_ma(views, orthogonal=1e-4)
    assert found.K[0, 0] == pytest.approx(550.0, rel=1e-2)


def test_two_shots_of_one_pose_are_named():
    views = malm_views(CAMERA, EXACT, rng(1)).views
    T = np.array(views.T_base_hand)
    T[1] = T[0]
    with pytest.raises(DataError, match="shots 0 and 1 have the same hand pose"):
        calibrate_malm_heyden(HandViews(views.uv, T, CAMERA.image_size), MALM_PATTERN_M)


def test_half_turns_do_not_spoil_the_hand_eye():
    """Noise swaps the axis of half a turn for its opposite; such motions are left out of it."""
    Y = make_pose(Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix(), np.array([0.1, 0.0, 0.2]))
    seen = make_pose(np.eye(3), np.array([0.0, 0.0, 0.5]))
    vectors = np.array([[0, 0, 0], [np.pi, 0, 0], [0.5, 0, 0.2], [0, 0.7, 0], [0.1, 0.2, 0.6]])
    jitter = Rotation.from_rotvec([-1e-3, 0.0, 0.0])
    hands, M = [], []
    for k, vector in enumerate(vectors):
        turn = Rotation.from_rotvec(vector)
        move = make_pose(turn.as_matrix(), np.array([0.01 * k, 0.0, 0.02 * k]))
        hands.append(np.linalg.inv(move))
        noisy = make_pose((turn * jitter).as_matrix() if k == 1 else turn.as_matrix(), move[:3, 3])
        # object to camera: fixed camera in the base, Y takes the hand to the object
        M.append((seen @ np.linalg.inv(noisy) @ np.linalg.inv(Y))[:3])
    closed, _ = hand_in_object(np.array(M), np.array(hands))
    np.testing.assert_allclose(closed[:3, :3], Y[:3, :3], atol=2e-3)
