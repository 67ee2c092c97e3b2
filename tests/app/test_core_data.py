"""Plain data: what may be in it, that it cannot change, and when two are equal."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import gtsam
import numpy as np
import pytest

import lasercal_gtsam as lc
from lasercal_gtsam.cell import INTRINSIC_NAMES
from lasercal_gtsam.observations import natural_key
from lasercal_gtsam.rotations import make_pose, rotation_exp

POSE = make_pose(rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, 0.3]))
SIZE = (640, 480)


def spots(count=4, **changes):
    given = {
        "uv": np.arange(2.0 * count).reshape(count, 2),
        "T_base_hand": np.stack([POSE] * count),
        "plane": ["1", "2"] * (count // 2),
        "image_size": SIZE,
    }
    return lc.Observations.from_arrays(**(given | changes))


def message(call):
    with pytest.raises(lc.DataError) as caught:
        call()
    return str(caught.value)


# --- intrinsics, camera, beam, plane ------------------------------------------------------------


def test_intrinsics_keep_gtsams_and_opencvs_order():
    values = np.array([501.0, 502.0, 3.0, 320.0, 240.0, 0.1, -0.2, 0.003, -0.004])
    intrinsics = lc.Intrinsics.from_vector(values)
    assert [getattr(intrinsics, name) for name in INTRINSIC_NAMES] == values.tolist()
    np.testing.assert_array_equal(intrinsics.vector, values)
    np.testing.assert_array_equal(intrinsics.to_gtsam().vector(), values)
    np.testing.assert_array_equal(intrinsics.to_gtsam().K(), intrinsics.K)
    np.testing.assert_array_equal(intrinsics.dist_coeffs, [0.1, -0.2, 0.003, -0.004, 0.0])
    assert intrinsics.alpha_c == 3.0 / 501.0
    assert isinstance(intrinsics.to_gtsam(), gtsam.Cal3DS2)


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("fu", 0.0, "positive"),
        ("fv", -1.0, "positive"),
        ("k1", np.nan, "finite"),
        ("u0", "x", "number"),
    ],
)
def test_intrinsics_name_the_field_that_is_wrong(field, value, word):
    good = {"fu": 500.0, "fv": 500.0}
    text = message(lambda: lc.Intrinsics(**(good | {field: value})))
    assert field in text
    assert word in text


def test_a_camera_needs_a_rigid_pose_and_whole_pixels():
    good = lc.Intrinsics(500, 500)
    stretched, mirrored, shifted = POSE.copy(), POSE.copy(), POSE.copy()
    stretched[0, :3] *= 1.00001
    mirrored[:3, 0] *= -1.0
    shifted[3, 0] = 1e-9
    for pose in (stretched, mirrored, shifted):
        assert "T_base_camera" in message(lambda pose=pose: lc.Camera(good, pose, SIZE))
    assert "shape" in message(lambda: lc.Camera(good, POSE[:3], SIZE))
    for size in ((640,), (640.5, 480), (0, 480), "big"):
        assert "image_size" in message(lambda size=size: lc.Camera(good, POSE, size))


def test_a_beam_is_a_unit_direction():
    beam = lc.Beam([0.0, 3.0, 4.0], [1, 2, 3])
    np.testing.assert_array_equal(beam.direction_hand, [0.0, 0.6, 0.8])
    assert "zero vector" in message(lambda: lc.Beam([0, 0, 0], [0, 0, 0]))
    assert "finite" in message(lambda: lc.Beam([0, 0, np.inf], [0, 0, 0]))
    assert "shape" in message(lambda: lc.Beam([0, 1], [0, 0, 0]))


def test_a_plane_points_away_from_the_base_origin():
    plane = lc.Plane([0.0, 0.0, 2.0], -0.5)
    np.testing.assert_array_equal(plane.normal_base, [0.0, 0.0, -1.0])
    assert plane.distance == 0.5
    np.testing.assert_array_equal(plane.vector, [0.0, 0.0, -0.5])
    # the same points either way round: n.x = d
    again = lc.Plane.from_point([0, 0, 5.0], [0.3, 0.4, -0.5])
    assert again == plane
    assert lc.Plane.from_vector(plane.vector) == plane
    through_origin = lc.Plane.from_point([1.0, 0, 0], [0.0, 7.0, 8.0])
    assert through_origin.distance == 0.0
    assert "zero vector" in message(lambda: lc.Plane.from_vector([0, 0, 0]))
    assert "finite" in message(lambda: lc.Plane([1, 0, 0], np.nan))


def test_unit_vectors_survive_being_rebuilt_to_the_last_bit():
    rng = np.random.default_rng(0)
    for v in rng.standard_normal((200, 3)):
        beam, plane = lc.Beam(v, v), lc.Plane(v, abs(v[0]))
        assert lc.Beam(beam.direction_hand, beam.point_hand) == beam
        assert lc.Plane(plane.normal_base, plane.distance) == plane


# --- frozen, and equal by value -----------------------------------------------------------------


def cell():
    camera = lc.Camera(lc.Intrinsics(500, 510), POSE, SIZE)
    beam, plane = lc.Beam([0, 0, 1.0], [0, 0, 0.1]), lc.Plane([0, 0, 1.0], 0.2)
    return lc.Cell({"camera": camera}, {"laser": beam}, {"1": plane})


def test_cells_are_equal_by_value():
    assert cell() == cell()
    moved = lc.Plane([0, 0, 1.0], np.nextafter(0.2, 1))
    assert cell() != cell().with_planes({"1": moved})
    assert cell() != cell().with_planes({"2": cell().planes["1"]})
    assert spots() == spots()
    assert spots() != spots(uv=np.zeros((4, 2)))
    assert spots(sigma_px=1.0) != spots()  # NaN, "not known", equals NaN only
    assert lc.CalibrationOptions() == lc.CalibrationOptions()


def test_nothing_can_be_changed_afterwards():
    one, seen = cell(), spots()
    with pytest.raises(FrozenInstanceError):
        one.cameras["camera"].intrinsics.fu = 1.0
    with pytest.raises(FrozenInstanceError):
        seen.uv = np.zeros((4, 2))
    for array in (
        one.cameras["camera"].T_base_camera, one.lasers["laser"].direction_hand,
        one.planes["1"].normal_base, seen.uv, seen.cov_uv, seen.T_base_hand, seen.plane,
        seen.plane_index,
    ):  # fmt: skip
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[0]


def test_data_do_not_follow_the_arrays_they_were_made_from():
    uv, pose = np.zeros((2, 2)), POSE.copy()
    seen = spots(2, uv=uv)
    camera = lc.Camera(lc.Intrinsics(500, 500), pose, SIZE)
    uv[0], pose[0, 3] = 9.0, 9.0
    assert seen.uv[0, 0] == 0.0
    assert camera.T_base_camera[0, 3] == POSE[0, 3]


def test_a_cell_takes_named_parts_of_the_right_kind():
    one = cell()
    assert "Cell.cameras" in message(lambda: lc.Cell([1], one.lasers, one.planes))
    assert "Cell.planes" in message(lambda: lc.Cell(one.cameras, one.lasers, {"1": one.lasers}))
    assert "Cell.lasers" in message(lambda: lc.Cell(one.cameras, {1: one.lasers["laser"]}))


# --- observations -------------------------------------------------------------------------------


def test_planes_come_in_natural_order():
    names = ["10", "2", "table", "1", "Table", "02"]
    seen = spots(6, plane=names)
    assert seen.planes == ("1", "02", "2", "10", "Table", "table")
    assert sorted(names, key=natural_key) == list(seen.planes)
    assert [seen.planes[i] for i in seen.plane_index] == names


def test_selecting_keeps_every_column_together():
    seen = spots(6, id="abcdef", sigma_px=np.arange(1.0, 7.0), camera=["l", "r"] * 3)
    wanted = [5, 0, 2]
    for which, rows in ((wanted, wanted), (seen.plane == "2", [1, 3, 5]), (slice(2, 4), [2, 3])):
        part = seen[which]
        assert part.id.tolist() == [seen.id[i] for i in rows]
        np.testing.assert_array_equal(part.uv, seen.uv[rows])
        np.testing.assert_array_equal(part.cov_uv, seen.cov_uv[rows])
        assert part.camera.tolist() == [seen.camera[i] for i in rows]
        assert part.plane.tolist() == [seen.plane[i] for i in rows]
    assert len(seen[np.zeros(6, dtype=bool)]) == 0
    assert len(seen[3]) == 1


def test_sets_of_observations_add_up():
    left = spots(2, camera="left", id=["a", "b"])
    right = spots(4, camera="right", image_size=(800, 600), sigma_px=0.5)
    both = left + right
    assert len(both) == 6
    assert both.cameras == ("left", "right")
    assert both.image_size == {"left": SIZE, "right": (800, 600)}
    assert both[:2] == replace(left, image_size=both.image_size)
    assert np.isnan(both.cov_uv[:2]).all()
    np.testing.assert_array_equal(both.cov_uv[2:], [0.25 * np.eye(2)] * 4)
    text = message(lambda: left + spots(2, camera="left", image_size=(320, 240)))
    assert "left" in text
    assert "(640, 480)" in text
    assert "(320, 240)" in text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"uv": np.zeros((4, 3))}, ["Observations.uv", "(4, 3)"]),
        ({"uv": np.full((4, 2), np.nan)}, ["Observations.uv", "nan", "(0, 0)"]),
        ({"T_base_hand": np.stack([POSE] * 3)}, ["T_base_hand", "(3, 4, 4)"]),
        ({"T_base_hand": np.stack([POSE, POSE, 2 * POSE, POSE])}, ["T_base_hand", "index 2"]),
        ({"plane": ["1"]}, ["plane", "4 names"]),
        ({"id": ["a", "b"]}, ["id", "4 names"]),
        ({"sigma_px": 0.0}, ["sigma_px", "positive"]),
        ({"sigma_px": 1.0, "cov_uv": np.eye(2)}, ["sigma_px or cov_uv"]),
        ({"cov_uv": np.array([[1.0, 2.0], [2.0, 1.0]])}, ["cov_uv[0]", "positive definite"]),
        ({"cov_uv": np.array([[1.0, 0.5], [0.0, 1.0]])}, ["cov_uv[0]", "symmetric"]),
        ({"image_size": {"other": SIZE}}, ["image_size", "'camera'"]),
    ],
)  # fmt: skip
def test_observations_say_what_is_wrong_and_where(changes, words):
    text = message(lambda: spots(**changes))
    for word in words:
        assert word in text


# --- options ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"robust": "ransac"}, ["options.robust", "auto", "'ransac'"]),
        ({"distortion": "k1"}, ["options.distortion", "('k1',)"]),
        ({"distortion": "some"}, ["options.distortion", "'some'"]),
        ({"distortion": ("k1", "k3")}, ["options.distortion", "k3"]),
        ({"sigma_px": 0.0}, ["options.sigma_px", "from 1e-12"]),
        ({"sigma_px": -1.0}, ["options.sigma_px"]),
        ({"sigma_px": "1"}, ["options.sigma_px"]),
        ({"hand_sigma_m": -1e-3}, ["options.hand_sigma_m"]),
        ({"hand_sigma_rad": np.nan}, ["options.hand_sigma_rad"]),
        ({"max_iterations": 0}, ["options.max_iterations", "from 1 to 1000000"]),
        ({"fixed": "u0"}, ["options.fixed", "tuple"]),
        ({"known": ["skew"]}, ["options.known", "dict"]),
        ({"priors": [("u0", 1)]}, ["options.priors", "dict"]),
    ],
)  # fmt: skip
def test_options_without_meaning_are_refused(changes, words):
    text = message(lambda: lc.CalibrationOptions(**changes))
    for word in words:
        assert word in text


def test_all_that_is_wrong_with_the_options_is_said_at_once():
    with pytest.raises(lc.DataError) as caught:
        lc.CalibrationOptions(sigma_px=-1, max_iterations=0, robust="x", distortion="y")
    assert len(caught.value.problems) == 4


def test_lists_in_options_become_tuples():
    options = lc.CalibrationOptions(fixed=["u0"], distortion=["k1", "k2"])
    assert options == lc.CalibrationOptions(fixed=("u0",), distortion=("k1", "k2"))
