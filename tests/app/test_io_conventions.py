"""Rotation formats: each vendor against a published formula or a worked example, by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.conventions import (
    ROTATION_FORMATS,
    columns_from_rotations,
    rotation_columns,
    rotation_format,
    rotation_problems,
    rotations_from_columns,
    rounding_of_rotations,
)

ORDERS = [
    "".join(axes)
    for letters in ("xyz", "XYZ")
    for axes in itertools.product(letters, repeat=3)
    if axes[0] != axes[1] != axes[2]
]
ALL_FORMATS = [*ROTATION_FORMATS, *(f"euler:{o}:{u}" for o in ORDERS for u in ("deg", "rad"))]


def read(fmt: str, *numbers: float) -> np.ndarray:
    return rotations_from_columns(fmt, np.array([numbers]))[0]


def Rx(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def Ry(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def Rz(deg: float) -> np.ndarray:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def from_xyzw(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Rotation matrix of a quaternion as the rc_cube manual prints it (appendix, pose formats)."""
    return 2 * np.array(
        [
            [0.5 - y * y - z * z, x * y - z * w, x * z + y * w],
            [x * y + z * w, 0.5 - x * x - z * z, y * z - x * w],
            [x * z - y * w, y * z + x * w, 0.5 - x * x - y * y],
        ]
    )


# --- one cited case per vendor ------------------------------------------------------------------
# Angles of 90 degrees in two of three columns: the columns of R say where the tool axes point,
# which can be checked with three fingers; then an odd pose against the manual's own formula.


def test_kuka_is_rz_ry_rx_of_a_b_c() -> None:
    # rc_visard manual, "KUKA XYZ-ABC format": z-y'-x'', r_z(A) r_y(B) r_x(C)
    # A = 90: tool x along base y. C = 90 about that x: tool y up, so tool z along base x.
    np.testing.assert_allclose(
        read("kuka", 90, 0, 90), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    a, b, c = (math.radians(v) / 2 for v in (12.0, -34.0, 56.0))
    ca, sa, cb, sb, cc, sc = (f(v) for v in (a, b, c) for f in (math.cos, math.sin))
    x, y = ca * cb * sc - sa * sb * cc, ca * sb * cc + sa * cb * sc
    z, w = sa * cb * cc - ca * sb * sc, ca * cb * cc + sa * sb * sc
    np.testing.assert_allclose(read("kuka", 12, -34, 56), from_xyzw(x, y, z, w), atol=1e-14)


def test_mitsubishi_swaps_kukas_a_and_c() -> None:
    # rc_cube manual, "Mitsubishi XYZ-ABC format": r_z(C) r_y(B) r_x(A)
    np.testing.assert_allclose(
        read("mitsubishi", 90, 0, 90), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    # A = 90 alone: tool y up
    np.testing.assert_allclose(
        read("mitsubishi", 90, 0, 0), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15
    )
    np.testing.assert_allclose(
        read("mitsubishi", 56, -34, 12), Rz(12) @ Ry(-34) @ Rx(56), atol=1e-14
    )


def test_fanuc_is_rz_ry_rx_of_r_p_w() -> None:
    # rc_visard manual, "FANUC XYZ-WPR format": r_z(R) r_y(P) r_x(W). The usual gripper pose
    # W = 180 looks straight down with tool x forward.
    np.testing.assert_allclose(read("fanuc", 180, 0, 0), np.diag([1, -1, -1]), atol=1e-15)
    # W = 90, then R = 90 about the fixed z: tool x along y, tool y up
    np.testing.assert_allclose(
        read("fanuc", 90, 0, 90), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    w_, p_, r_ = (math.radians(v) / 2 for v in (12.0, -34.0, 56.0))
    cw, sw, cp, sp, cr, sr = (f(v) for v in (w_, p_, r_) for f in (math.cos, math.sin))
    x, y = cr * cp * sw - sr * sp * cw, cr * sp * cw + sr * cp * sw
    z, w = sr * cp * cw - cr * sp * sw, cr * cp * cw + sr * sp * sw
    np.testing.assert_allclose(read("fanuc", 12, -34, 56), from_xyzw(x, y, z, w), atol=1e-14)


def test_yaskawa_is_rz_ry_rx_of_rz_ry_rx() -> None:
    # rc_cube manual, "Yaskawa pose format": r_z(Rz) r_y(Ry) r_x(Rx)
    np.testing.assert_allclose(
        read("yaskawa", 90, 90, 0), [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15
    )
    np.testing.assert_allclose(read("yaskawa", 12, -34, 56), Rz(56) @ Ry(-34) @ Rx(12), atol=1e-14)


def test_staubli_is_rx_ry_rz() -> None:
    # RoboDK robomath: Pose_2_Staubli is Pose_2_TxyzRxyz in degrees, and TxyzRxyz_2_Pose is
    # rotx(rx) roty(ry) rotz(rz): moving axes, unlike Yaskawa with the same letters.
    np.testing.assert_allclose(
        read("staubli", 90, 90, 0), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    np.testing.assert_allclose(read("staubli", 12, -34, 56), Rx(12) @ Ry(-34) @ Rz(56), atol=1e-14)
    # the closed forms by which Pose_2_TxyzRxyz goes back
    R = read("staubli", 12, -34, 56)
    assert math.degrees(math.asin(R[0, 2])) == pytest.approx(-34)
    assert math.degrees(math.atan2(-R[1, 2], R[2, 2])) == pytest.approx(12)
    assert math.degrees(math.atan2(-R[0, 1], R[0, 0])) == pytest.approx(56)


def test_kawasaki_is_rz_ry_rz_of_o_a_t() -> None:
    # rc_cube manual, "Kawasaki XYZ-OAT format": z-y'-z'', r_z(O) r_y(A) r_z(T)
    # A = 90 lays tool z along base x; O = 90 then turns it to base y
    np.testing.assert_allclose(read("kawasaki", 90, 90, 0)[:, 2], [0, 1, 0], atol=1e-15)
    o, a, t = (math.radians(v) / 2 for v in (12.0, 34.0, 56.0))
    co, so, ca, sa, ct, st_ = (f(v) for v in (o, a, t) for f in (math.cos, math.sin))
    x, y = co * sa * st_ - so * sa * ct, co * sa * ct + so * sa * st_
    z, w = so * ca * ct + co * ca * st_, co * ca * ct - so * ca * st_
    np.testing.assert_allclose(read("kawasaki", 12, 34, 56), from_xyzw(x, y, z, w), atol=1e-14)


def test_abb_is_w_first() -> None:
    # RAPID reference manual, data type orient, example 1: x' = -z, y' = y, z' = x is
    # q1 = 0.707, q2 = 0, q3 = 0.707, q4 = 0
    h = math.sqrt(0.5)
    np.testing.assert_allclose(
        read("abb", h, 0, h, 0), [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-15
    )
    assert rotation_columns("abb") == ("qw", "qx", "qy", "qz")


def test_ur_is_a_rotation_vector_in_radians() -> None:
    # rc_visard manual, "Universal Robots pose format": x = RX sin(theta/2)/theta, w = cos(theta/2)
    theta = 2 * math.pi / 3
    third = theta / math.sqrt(3)
    # a third of a turn about (1, 1, 1) carries x to y, y to z, z to x
    np.testing.assert_allclose(
        read("ur", third, third, third), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    r = np.array([0.3, -1.1, 0.7])
    theta = float(np.linalg.norm(r))
    x, y, z = r * math.sin(theta / 2) / theta
    np.testing.assert_allclose(read("ur", *r), from_xyzw(x, y, z, math.cos(theta / 2)), atol=1e-14)
    # looking down: half a turn about x
    np.testing.assert_allclose(read("ur", math.pi, 0, 0), np.diag([1, -1, -1]), atol=1e-15)


def test_quaternion_orders_and_rotvec_units() -> None:
    half = math.radians(40) / 2
    np.testing.assert_allclose(
        read("quat_wxyz", math.cos(half), 0, 0, math.sin(half)), Rz(40), atol=1e-15
    )
    np.testing.assert_allclose(
        read("quat_xyzw", 0, 0, math.sin(half), math.cos(half)), Rz(40), atol=1e-15
    )
    np.testing.assert_allclose(read("rotvec_deg", 0, 40, 0), Ry(40), atol=1e-15)
    np.testing.assert_allclose(read("rotvec_rad", math.radians(40), 0, 0), Rx(40), atol=1e-15)
    np.testing.assert_allclose(read("matrix", *Rx(40).ravel()), Rx(40), atol=0)


def test_lower_case_is_fixed_upper_case_is_moving() -> None:
    # scipy's rule, in words: extrinsic xyz = Rz(e3) Ry(e2) Rx(e1), intrinsic XYZ = Rx Ry Rz
    np.testing.assert_allclose(read("euler:xyz:deg", 10, 20, 30), Rz(30) @ Ry(20) @ Rx(10))
    np.testing.assert_allclose(read("euler:XYZ:deg", 10, 20, 30), Rx(10) @ Ry(20) @ Rz(30))
    np.testing.assert_allclose(read("euler:YXY:rad", 0.1, 0.2, 0.3), _yxy(0.1, 0.2, 0.3))


def _yxy(a: float, b: float, c: float) -> np.ndarray:
    return Ry(math.degrees(a)) @ Rx(math.degrees(b)) @ Ry(math.degrees(c))


@pytest.mark.parametrize("order", ORDERS)
def test_every_order_agrees_with_scipy(order: str) -> None:
    from scipy.spatial.transform import Rotation

    angles = np.random.default_rng(1).uniform(-180, 180, (20, 3))
    np.testing.assert_allclose(
        rotations_from_columns(f"euler:{order}:deg", angles),
        Rotation.from_euler(order, angles, degrees=True).as_matrix(),
        atol=1e-14,
    )


def test_column_names_are_the_documented_ones() -> None:
    wanted = {
        "quat_wxyz": "qw qx qy qz",
        "quat_xyzw": "qx qy qz qw",
        "matrix": "r11 r12 r13 r21 r22 r23 r31 r32 r33",
        "rotvec_rad": "rx ry rz",
        "rotvec_deg": "rx ry rz",
        "staubli": "rx ry rz",
        "kuka": "a b c",
        "fanuc": "w p r",
        "yaskawa": "rx ry rz",
        "abb": "qw qx qy qz",
        "ur": "rx ry rz",
        "kawasaki": "o a t",
        "mitsubishi": "a b c",
        "euler:zyx:rad": "e1 e2 e3",
    }
    assert {name: " ".join(rotation_columns(name)) for name in wanted} == wanted
    assert set(ROTATION_FORMATS) == set(wanted) - {"euler:zyx:rad"}


# --- there and back -----------------------------------------------------------------------------


@st.composite
def rotations(draw: st.DrawFn) -> np.ndarray:
    """Random rotations, and the awkward ones: multiples of 90 degrees with a tiny step beside."""
    if draw(st.booleans()):
        q = np.random.default_rng(draw(st.integers(0, 2**32))).standard_normal(4)
        x, y, z, w = q / np.linalg.norm(q)
        return from_xyzw(x, y, z, w)
    turns = st.sampled_from([-180, -90, 0, 90, 180])
    tiny = st.sampled_from([0.0, 1e-13, -1e-9, 1e-7, 1e-5])
    a, b, c = (draw(turns) + draw(tiny) for _ in range(3))
    return Rz(a) @ Ry(b) @ Rx(c)


@pytest.mark.parametrize("fmt", ALL_FORMATS)
@settings(deadline=None, derandomize=True, max_examples=20)
@given(R=rotations())
def test_writing_and_reading_returns_the_rotation(fmt: str, R: np.ndarray) -> None:
    values = columns_from_rotations(fmt, R[None])
    assert values.shape == (1, len(rotation_columns(fmt)))
    back = rotations_from_columns(fmt, values)[0]
    np.testing.assert_allclose(back, R, atol=2e-15, rtol=0)
    np.testing.assert_allclose(back.T @ back, np.eye(3), atol=4e-15)


@pytest.mark.parametrize("fmt", ["kuka", "fanuc", "staubli", "kawasaki", "euler:XZY:rad"])
def test_angles_come_back_where_they_are_unique(fmt: str) -> None:
    rng = np.random.default_rng(2)
    unit = np.pi / 180 if fmt.endswith("rad") else 1.0
    middle = (5, 175) if fmt == "kawasaki" else (-85, 85)
    angles = np.stack(
        [rng.uniform(-179, 179, 50), rng.uniform(*middle, 50), rng.uniform(-179, 179, 50)], axis=1
    )
    R = rotations_from_columns(fmt, unit * angles)
    np.testing.assert_allclose(columns_from_rotations(fmt, R), unit * angles, atol=1e-10)


def test_ranges_of_the_written_numbers() -> None:
    turns = (-180, -135, -90, 0, 45, 90, 180)
    R = np.stack([Rz(a) @ Ry(b) @ Rx(c) for a, b, c in itertools.product(turns, repeat=3)])
    assert (columns_from_rotations("quat_wxyz", R)[:, 0] >= 0).all()
    length = np.linalg.norm(columns_from_rotations("rotvec_rad", R), axis=1)
    assert length.max() <= np.pi * (1 + 1e-15)
    assert np.abs(columns_from_rotations("kuka", R)[:, 1]).max() <= 90 + 1e-9
    assert columns_from_rotations("kawasaki", R)[:, 1].min() >= -1e-9


def test_no_rows_are_no_problem() -> None:
    for fmt in ALL_FORMATS:
        empty = np.zeros((0, len(rotation_columns(fmt))))
        assert rotations_from_columns(fmt, empty).shape == (0, 3, 3)
        assert columns_from_rotations(fmt, np.zeros((0, 3, 3))).shape == empty.shape


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("kukka", "did you mean 'kuka'"),
        ("KUKA", "did you mean 'kuka'"),
        ("quat_wxzy", "did you mean 'quat_wxyz'"),
        ("rotvec", "did you mean 'rotvec_"),
        ("doosan", "euler:<order>:<deg|rad>"),
    ],
)
def test_unknown_format_lists_the_choices(name: str, hint: str) -> None:
    with pytest.raises(DataError, match="allowed are quat_wxyz") as caught:
        rotation_format(name)
    assert hint in str(caught.value)


@pytest.mark.parametrize(
    "name", ["euler", "euler:xyz", "euler:xyZ:deg", "euler:xxz:deg", "euler:zyy:rad", "euler:xyz:°"]
)
def test_bad_euler_format_says_the_form(name: str) -> None:
    with pytest.raises(DataError, match="lower case about fixed axes"):
        rotation_format(name)


def test_quaternion_of_norm_two_names_its_row() -> None:
    values = np.array([[1.0, 0, 0, 0], [2.0, 0, 0, 0], [0, 0, 0, 0]])
    with pytest.raises(DataError) as caught:
        rotations_from_columns("quat_wxyz", values)
    assert len(caught.value.problems) == 2
    assert "row 1: quaternion of norm 2" in caught.value.problems[0]
    assert "row 2: quaternion of norm 0" in caught.value.problems[1]


def test_rounded_quaternion_is_normalised_and_rounded_matrix_projected() -> None:
    R = Rz(12) @ Ry(-34) @ Rx(56)
    for fmt in ("quat_xyzw", "matrix"):
        exact = columns_from_rotations(fmt, R[None])
        for decimals, limit in ((3, 2e-3), (6, 2e-6)):
            values = np.round(exact, decimals)
            back = rotations_from_columns(fmt, values)[0]
            np.testing.assert_allclose(back.T @ back, np.eye(3), atol=1e-15)
            assert np.abs(back - R).max() < limit
            assert 0 < rounding_of_rotations(fmt, values, back[None]) < limit
        assert rounding_of_rotations(fmt, exact, R[None]) < 1e-15


def test_matrices_that_are_no_rotations() -> None:
    R = Rz(30) @ Rx(20)
    scaled, sheared, mirrored, column = R * 1.01, R.copy(), R @ np.diag([1, 1, -1]), R.copy()
    sheared[0, 1] += 0.01
    column[:, 0] = 0
    values = np.stack([R, scaled, sheared, mirrored, column, np.zeros((3, 3))]).reshape(-1, 9)
    problems = dict(rotation_problems("matrix", values))
    assert set(problems) == {1, 2, 3, 4, 5}
    assert "a reflection" in problems[3]
    assert "nearest rotation differs by 0.0" in problems[1]
    with pytest.raises(DataError, match="row 5"):
        rotations_from_columns("matrix", values)


def test_not_a_number_names_its_row() -> None:
    with pytest.raises(DataError, match="row 1: expected finite numbers, got 0, nan, 0"):
        rotations_from_columns("kuka", np.array([[0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises(DataError, match="row 0"):
        rotations_from_columns("quat_wxyz", np.array([[np.inf, 0, 0, 0]]))


def test_wrong_number_of_columns() -> None:
    with pytest.raises(DataError, match=r"shape \(N, 4\) with columns qw, qx, qy, qz"):
        rotations_from_columns("abb", np.zeros((2, 3)))


def test_long_lists_are_cut_and_say_so() -> None:
    with pytest.raises(DataError) as caught:
        rotations_from_columns("quat_wxyz", np.full((100, 4), 2.0))
    assert len(caught.value.problems) == 21
    assert "80 more" in caught.value.problems[-1]
