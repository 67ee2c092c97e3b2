"""The plain data: what is refused and in which words, equality, read-only arrays, order."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import gtsam
import numpy as np
import pytest

import lasercal_gtsam as lc

SIZE = (640, 480)


def turned(angle: float = 0.3) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0.1], [s, c, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])


def camera(**changes) -> lc.Camera:
    given = {"intrinsics": lc.Intrinsics(500, 510), "T_base_camera": turned(), "image_size": SIZE}
    return lc.Camera(**(given | changes))


def spots(n: int = 4, **changes) -> lc.Observations:
    given = {
        "uv": np.arange(2.0 * n).reshape(n, 2),
        "T_base_hand": np.stack([turned(0.1 * k) for k in range(n)]),
        "plane": "1",
        "image_size": SIZE,
    }
    return lc.Observations.from_arrays(**(given | changes))


def mirrored() -> np.ndarray:
    return np.diag([1.0, 1.0, -1.0, 1.0])


def sheared() -> np.ndarray:
    T = turned()
    T[0, 1] += 1e-4
    return T


def unfinished() -> np.ndarray:
    T = turned()
    T[3] = 0.0
    return T


# --- intrinsics ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fu": "wide", "fv": 500}, r"Intrinsics\.fu: expected a number, got 'wide'"),
        ({"fu": 500, "fv": None}, r"Intrinsics\.fv: expected a number"),
        ({"fu": 500, "fv": 500, "k2": np.nan}, r"Intrinsics\.k2: expected a finite number"),
        ({"fu": 500, "fv": 500, "u0": np.inf}, r"Intrinsics\.u0: expected a finite number"),
        ({"fu": 0.0, "fv": 500}, "focal lengths must be positive, got fu=0"),
        ({"fu": 500, "fv": -1.0}, r"must be positive.*fv=-1"),
    ],
)
def test_intrinsics_refuse_what_is_no_camera(values, words):
    with pytest.raises(lc.DataError, match=words):
        lc.Intrinsics(**values)


def test_intrinsics_have_the_order_of_gtsam():
    one = lc.Intrinsics(fu=501, fv=502, skew=3, u0=304, v0=205, k1=0.6, k2=0.7, p1=0.08, p2=0.09)
    same = one.to_gtsam()
    assert isinstance(same, gtsam.Cal3DS2)
    np.testing.assert_array_equal(one.vector, same.vector())
    assert (same.fx(), same.fy(), same.skew()) == (501, 502, 3)
    assert (same.px(), same.py(), same.k1(), same.k2()) == (304, 205, 0.6, 0.7)
    np.testing.assert_array_equal(one.vector, [501, 502, 3, 304, 205, 0.6, 0.7, 0.08, 0.09])
    np.testing.assert_array_equal(one.K, same.K())
    np.testing.assert_array_equal(one.dist_coeffs, [0.6, 0.7, 0.08, 0.09, 0.0])
    assert one.alpha_c == 3 / 501
    assert lc.Intrinsics.from_vector(one.vector) == one


def test_intrinsics_cannot_be_changed():
    one = lc.Intrinsics(500, 500)
    with pytest.raises(FrozenInstanceError):
        one.fu = 1.0


# --- camera, beam, plane, cell ------------------------------------------------------------------


@pytest.mark.parametrize("T", [mirrored(), sheared(), unfinished()])
def test_a_pose_must_be_a_rigid_transform(T):
    with pytest.raises(lc.DataError, match="T_base_camera: expected a rigid transform"):
        camera(T_base_camera=T)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"T_base_camera": np.eye(3)}, r"Camera\.T_base_camera: expected shape \(4, 4\)"),
        ({"T_base_camera": np.full((4, 4), np.nan)}, r"Camera\.T_base_camera: expected finite"),
        ({"T_base_camera": "here"}, r"Camera\.T_base_camera: expected numbers"),
        ({"image_size": (640,)}, r"image_size: expected \(width, height\)"),
        ({"image_size": (640, 0)}, r"image_size: expected \(width, height\)"),
        ({"image_size": (640.5, 480)}, r"image_size: expected \(width, height\)"),
        ({"image_size": None}, r"image_size: expected \(width, height\)"),
    ],
)
def test_camera_refuses(changes, words):
    with pytest.raises(lc.DataError, match=words):
        camera(**changes)


@pytest.mark.parametrize(
    ("direction", "point", "words"),
    [
        ([0, 0, 0], [0, 0, 0], r"Beam\.direction_hand: expected a direction, got the zero"),
        ([0, 0], [0, 0, 0], r"Beam\.direction_hand: expected shape \(3\)"),
        ([0, np.nan, 1], [0, 0, 0], r"Beam\.direction_hand: expected finite numbers, got nan"),
        ([0, 0, 1], [0, 0, np.inf], r"Beam\.point_hand: expected finite numbers"),
        ([0, 0, 1], [[0, 0, 0]], r"Beam\.point_hand: expected shape \(3\)"),
    ],
)
def test_beam_refuses(direction, point, words):
    with pytest.raises(lc.DataError, match=words):
        lc.Beam(direction, point)


def test_beam_direction_is_made_unit():
    beam = lc.Beam([3.0, 0.0, 4.0], [1, 2, 3])
    np.testing.assert_allclose(beam.direction_hand, [0.6, 0, 0.8], rtol=0, atol=1e-16)
    # unit to rounding: saving and loading must not move it
    assert lc.Beam(beam.direction_hand, beam.point_hand) == beam


@pytest.mark.parametrize(
    ("normal", "distance", "words"),
    [
        ([0, 0, 0], 1.0, r"Plane\.normal_base: expected a direction, got the zero"),
        ([0, 0, 1], np.nan, r"Plane\.distance: expected a finite number"),
        ([0, 0, 1, 1], 1.0, r"Plane\.normal_base: expected shape \(3\)"),
        ([0, 0, np.inf], 1.0, r"Plane\.normal_base: expected finite"),
    ],
)
def test_plane_refuses(normal, distance, words):
    with pytest.raises(lc.DataError, match=words):
        lc.Plane(normal, distance)


def test_a_plane_is_turned_so_that_its_distance_is_positive():
    plane = lc.Plane([0.0, 0.0, 2.0], -0.5)
    np.testing.assert_array_equal(plane.normal_base, [0, 0, -1])
    assert plane.distance == 0.5
    np.testing.assert_array_equal(plane.vector, [0, 0, -0.5])
    point = np.array([0.3, -0.2, -0.5])
    for same in (
        lc.Plane.from_vector([0, 0, -0.5]),
        lc.Plane.from_point([0, 0, 7.0], point),
        lc.Plane.from_point([0, 0, -0.1], point),
    ):
        assert same == plane
    through_origin = lc.Plane([0.0, 3.0, 0.0], 0.0)
    assert through_origin.distance == 0.0
    np.testing.assert_array_equal(through_origin.normal_base, [0, 1, 0])


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (([camera()], {}, {}), r"Cell\.cameras: expected a dict of name -> Camera"),
        (({"c": camera()}, {"l": 3}, {}), r"Cell\.lasers: expected a dict of name -> Beam"),
        (({"c": camera()}, {}, {1: lc.Plane([0, 0, 1], 1)}), r"Cell\.planes: .* -> Plane"),
    ],
)
def test_cell_refuses(parts, words):
    with pytest.raises(lc.DataError, match=words):
        lc.Cell(*parts)


def test_a_cell_does_not_follow_the_dict_it_was_made_from():
    planes = {"1": lc.Plane([0, 0, 1], 1)}
    cell = lc.Cell({"c": camera()}, {"l": lc.Beam([0, 0, 1], [0, 0, 0])}, planes)
    planes["2"] = planes["1"]
    assert list(cell.planes) == ["1"]
    assert list(cell.with_planes(planes).planes) == ["1", "2"]
    assert list(cell.planes) == ["1"]


def test_equality_is_by_value():
    assert camera() == camera()
    assert camera() != camera(image_size=(641, 480))
    assert camera() != camera(T_base_camera=turned(0.3000001))
    assert lc.Plane([0, 0, 1], 1) != lc.Beam([0, 0, 1], [0, 0, 1])
    assert spots() == spots()
    assert spots() != spots(id="abcd")
    assert spots(sigma_px=1.0) != spots()
    parts = {"c": camera()}, {"l": lc.Beam([0, 0, 1], [0, 0, 0])}, {"1": lc.Plane([0, 0, 1], 1)}
    other = {"2": parts[2]["1"]}
    assert lc.Cell(*parts) == lc.Cell(*parts)
    assert lc.Cell(*parts) != lc.Cell(*parts[:2], other)


def test_arrays_are_read_only_copies():
    T = turned()
    one = camera(T_base_camera=T)
    T[0, 3] = 99.0
    assert one.T_base_camera[0, 3] == 0.1
    beam, plane, seen = lc.Beam([0, 0, 1], [0, 0, 0]), lc.Plane([0, 0, 1], 1), spots()
    kept = [one.T_base_camera, beam.direction_hand, beam.point_hand, plane.normal_base]
    kept += [seen.uv, seen.cov_uv, seen.T_base_hand, seen.camera, seen.plane, seen.laser, seen.id]
    kept += [seen.camera_index, seen.plane_index, seen.laser_index]
    for array in kept:
        with pytest.raises(ValueError, match="read-only"):
            array[..., 0] = array[..., 0]
    for part in (one, beam, plane, seen):
        with pytest.raises(FrozenInstanceError):
            part.anything = 1


# --- observations -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"uv": np.zeros((4, 3))}, r"Observations\.uv: expected shape \(N, 2\), got \(4, 3\)"),
        ({"uv": np.full((4, 2), np.nan)}, r"Observations\.uv: expected finite numbers, got nan"),
        (
            {"uv": np.full((4, 2), 1e300)},
            r"uv: expected numbers up to 1e\+12, got 1e\+300 at index",
        ),
        ({"T_base_hand": np.eye(4)}, r"Observations\.T_base_hand: expected shape \(4, 4, 4\)"),
        (
            {"T_base_hand": np.stack([np.eye(4)] * 2 + [mirrored()] + [np.eye(4)])},
            "T_base_hand at index 2: expected a rigid transform",
        ),
        ({"plane": ["1", "2"]}, r"Observations\.plane: expected 4 names"),
        ({"camera": ["a"]}, r"Observations\.camera: expected 4 names"),
        ({"laser": [["a"] * 4]}, r"Observations\.laser: expected 4 names"),
        ({"id": ["a"]}, r"Observations\.id: expected 4 names"),
        ({"image_size": {"other": SIZE}}, r"image_size: no size given for camera 'camera'"),
        ({"image_size": (0, 480)}, "image_size: expected"),
        ({"sigma_px": 0.0}, "sigma_px must be positive"),
        ({"sigma_px": [1.0, 1.0, -2.0, 1.0]}, "sigma_px must be positive, got -2"),
        ({"sigma_px": np.nan}, "sigma_px must be positive"),
        ({"sigma_px": 1.0, "cov_uv": np.eye(2)}, "sigma_px or cov_uv, not both"),
        ({"cov_uv": [[1.0, 2.0], [2.0, 1.0]]}, r"cov_uv\[0\]: expected a symmetric positive"),
        ({"cov_uv": [[1.0, 0.5], [0.0, 1.0]]}, r"cov_uv\[0\]: expected a symmetric positive"),
        ({"cov_uv": [[1.0, 0.0], [0.0, np.nan]]}, r"cov_uv\[0\]: expected a symmetric positive"),
    ],
)
def test_observations_refuse(changes, words):
    with pytest.raises(lc.DataError, match=words):
        spots(**changes)


def test_covariances_are_kept_or_unknown():
    assert np.isnan(spots().cov_uv).all()
    sigmas = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(spots(sigma_px=sigmas).cov_uv[:, 0, 0], sigmas**2)
    np.testing.assert_array_equal(spots(sigma_px=sigmas).cov_uv[:, 0, 1], 0)
    own = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_array_equal(spots(cov_uv=own).cov_uv, np.stack([own] * 4))


def test_selection_keeps_rows_together():
    seen = spots(
        4, plane=["1", "2", "1", "2"], camera=["a", "a", "b", "b"], laser=["x", "y", "x", "y"],
        sigma_px=[1, 2, 3, 4], id="pqrs",
    )  # fmt: skip
    for which, rows in (
        (np.array([False, True, False, True]), [1, 3]),
        ([2, 0], [2, 0]),
        (slice(1, 3), [1, 2]),
        (3, [3]),
    ):
        part = seen[which]
        assert len(part) == len(rows)
        for name in ("uv", "cov_uv", "T_base_hand", "camera", "laser", "plane", "id"):
            np.testing.assert_array_equal(getattr(part, name), getattr(seen, name)[rows])
    assert seen[[0]].cameras == ("a",)
    assert seen[seen.plane == "2"].planes == ("2",)
    assert len(seen[[]]) == 0


def test_addition_joins_in_order_and_refuses_two_image_sizes():
    a, b = spots(2, camera="a", id="pq"), spots(3, camera="b", image_size=(800, 600), id="rst")
    both = a + b
    assert both.id.tolist() == list("pqrst")
    assert both.camera.tolist() == ["a"] * 2 + ["b"] * 3
    assert both.image_size == {"a": (640, 480), "b": (800, 600)}
    np.testing.assert_array_equal(both.uv, np.concatenate([a.uv, b.uv]))
    assert both[:2].uv.tolist() == a.uv.tolist()
    with pytest.raises(lc.DataError, match=r"camera 'a' has image size \(640, 480\) .*\(800, 600"):
        a + spots(1, camera="a", image_size=(800, 600))


def test_names_are_in_natural_order():
    names = ["table", "10", "2", "1", "Box", "2"]
    seen = spots(6, plane=names)
    assert seen.planes == ("1", "2", "10", "Box", "table")
    assert [seen.planes[k] for k in seen.plane_index] == names
    seen = spots(3, camera=["c10", "c1", "c10"], laser=["11", "9", "11"])
    assert seen.cameras == ("c1", "c10")
    assert seen.lasers == ("9", "11")
    assert seen.laser_index.tolist() == [1, 0, 1]


# --- options ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"sigma_px": 0},
            r"options\.sigma_px: expected a number of pixels from 1e-12 to 1e\+06, got 0",
        ),
        ({"sigma_px": "one"}, r"options\.sigma_px: .*got 'one'"),
        ({"sigma_px": np.inf}, r"options\.sigma_px"),
        ({"hand_sigma_m": -1e-3}, r"options\.hand_sigma_m: expected 0 or metres from 1e-12"),
        ({"hand_sigma_rad": np.nan}, r"options\.hand_sigma_rad: expected 0 or radians"),
        ({"max_iterations": 0}, r"options\.max_iterations: expected an integer from 1 to 1000000"),
        ({"max_iterations": 2.5}, r"options\.max_iterations: expected an integer from 1 to"),
        ({"max_iterations": 10**20}, r"options\.max_iterations: expected an integer from 1 to"),
        ({"seed": -1}, r"options\.seed: expected an integer >= 0, got -1"),
        ({"seed": 0.5}, r"options\.seed: expected an integer >= 0, got 0.5"),
        ({"robust": "maybe"}, r"options\.robust: expected one of auto, none"),
        ({"distortion": "k1"}, r"options\.distortion: .*written \('k1',\)"),
        ({"distortion": ("k1", "k7")}, r"options\.distortion: .*names out of k1, k2, p1, p2"),
        ({"fixed": "laser:laser"}, r"options\.fixed: expected a tuple of names"),
        ({"fixed": (1,)}, r"options\.fixed: expected a tuple of names"),
        ({"known": [("skew", 0)]}, r"options\.known: expected a dict"),
        ({"priors": ("Tz",)}, r"options\.priors: expected a dict"),
    ],
)
def test_options_refuse(fields, words):
    with pytest.raises(lc.DataError, match=words):
        lc.CalibrationOptions(**fields)


def test_options_name_all_that_is_wrong():
    with pytest.raises(lc.DataError) as caught:
        lc.CalibrationOptions(sigma_px=-1, robust="x", distortion="y")
    for name in ("sigma_px", "robust", "distortion"):
        assert f"options.{name}" in str(caught.value)


def test_options_keep_tuples():
    options = lc.CalibrationOptions(distortion=["k1"], fixed=["fu"])
    assert options.distortion == ("k1",)
    assert options.fixed == ("fu",)


def test_a_seed_may_come_from_numpy():
    assert lc.CalibrationOptions(seed=np.int64(3)).seed == 3


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("sigma_px", 10**400),
        ("sigma_px", 1e160),
        ("sigma_px", 1e-200),
        ("hand_sigma_m", 1e160),
        ("hand_sigma_rad", 1e-90),
    ],
)
def test_sigmas_whose_squares_are_no_numbers_are_refused(option, value):
    with pytest.raises(lc.DataError, match=rf"options\.{option}: expected .* from 1e-12 to 1e\+06"):
        lc.CalibrationOptions(**{option: value})


def test_fixed_takes_names_only():
    with pytest.raises(lc.DataError, match=r"options\.fixed: expected a tuple of names, got 3"):
        lc.CalibrationOptions(fixed=3)
