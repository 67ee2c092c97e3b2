"""The convention doctor names planted mistakes, and never one that is not there."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lasercal_gtsam as lc
from lasercal_gtsam.check.diagnosis import Judged, judge, sentences
from lasercal_gtsam.check.doctor import diagnose
from lasercal_gtsam.check.readings import MIRRORED, RawPoses, pose_readings, swapped_pixels
from lasercal_gtsam.check.trials import seen_from_behind
from lasercal_gtsam.io.capture_head import read_head
from lasercal_gtsam.io.capture_rows import inverse_poses
from lasercal_gtsam.io.conventions import columns_from_rotations, rotation_format
from lasercal_gtsam.simulate import Noise, simulate, write_simulation

LIGHT = Noise(pixel_px=0.5)


def raw_poses(T_base_hand, rotation, transform="T_base_hand", declared=None):
    """A pose table as a controller of this kind writes it, declared in another way."""
    T = inverse_poses(T_base_hand) if transform == "T_hand_base" else T_base_hand
    numbers = columns_from_rotations(rotation, T[:, :3, :3])
    said = {"rotation": rotation, "transform": transform, **(declared or {})}
    columns = rotation_format(said["rotation"]).columns
    ids = tuple(str(k) for k in range(len(T)))
    return RawPoses(ids, T[:, :3, 3], numbers, columns, said["transform"], said["rotation"])


def diagnosis_of(simulation, raw, pixels=None):
    seen = simulation.observations
    if pixels is not None:
        uv = pixels.apply(seen.uv, seen.image_size["camera"])
        seen = replace(seen, uv=uv)
    options = lc.CalibrationOptions(known=simulation.known)
    return diagnose(seen, pose_readings(raw), options)


def pose_of(diagnosis, raw):
    """Hand poses of the reading that the doctor likes best."""
    by_words = {reading.words: reading.T_base_hand for reading in pose_readings(raw)}
    words = re.sub(r", (image|u and v).*", "", diagnosis.best.words)
    return by_words[words]


# --- readings -----------------------------------------------------------------------------------


def test_every_euler_order_is_read_as_scipy_reads_it():
    rng = np.random.default_rng(1)
    angles = rng.uniform(-80, 80, (5, 3))
    raw = RawPoses(tuple("abcde"), np.zeros((5, 3)), angles, ("e1", "e2", "e3"), "T_base_hand",
                   "euler:xyz:deg")  # fmt: skip
    found = {reading.words: reading.T_base_hand for reading in pose_readings(raw)}
    orders = [
        w.split(":")[1] for w in found if w.startswith("T_base_hand, euler") and "of" not in w
    ]
    assert len(set(orders)) == 24
    for order in orders:
        expected = Rotation.from_euler(order, angles, degrees=True).as_matrix()
        np.testing.assert_allclose(
            found[f"T_base_hand, euler:{order}:deg"][:, :3, :3], expected, atol=1e-12
        )
    expected = Rotation.from_rotvec(np.deg2rad(angles)).as_matrix()
    np.testing.assert_allclose(found["T_base_hand, rotvec_deg"][:, :3, :3], expected, atol=1e-12)


@pytest.mark.parametrize(("largest", "both"), [(3.0, True), (170.0, False)])
def test_radians_are_tried_only_where_the_numbers_can_be_radians(largest, both):
    angles = np.linspace(-largest, largest, 12).reshape(4, 3)
    raw = RawPoses(tuple("abcd"), np.zeros((4, 3)), angles, ("a", "b", "c"), "T_base_hand", "kuka")
    units = {
        word.rpartition(":")[2] for word in (r.words for r in pose_readings(raw)) if ":" in word
    }
    assert units == ({"deg", "rad"} if both else {"deg"})


def test_the_declared_reading_comes_first_and_changes_nothing():
    T = simulate("paper-2", 0).observations.T_base_hand
    for rotation in ("quat_wxyz", "matrix", "kuka", "rotvec_rad"):
        first, *others = pose_readings(raw_poses(T, rotation, "T_hand_base"))
        assert first.change == ()
        np.testing.assert_allclose(first.T_base_hand, T, atol=1e-12)
        assert all(other.change for other in others)
        assert all(np.abs(o.T_base_hand - first.T_base_hand).max() > 1e-9 for o in others)


def test_a_format_with_the_same_columns_needs_no_new_names():
    T = simulate("paper-2", 0).observations.T_base_hand
    changes = {r.words: r.change for r in pose_readings(raw_poses(T, "kuka"))}
    assert changes["T_base_hand, mitsubishi"] == (
        "in capture.yaml, under poses, write 'rotation: mitsubishi'",
    )
    rename = changes["T_base_hand, euler:ZYZ:deg"][1]
    assert "name the columns e1, e2, e3 (they are named a, b, c)" in rename


def test_a_quaternion_is_read_in_the_order_of_the_file():
    T = simulate("paper-2", 0).observations.T_base_hand
    wxyz = columns_from_rotations("quat_wxyz", T[:, :3, :3])
    # the numbers are w x y z, the header says qx qy qz qw
    by_name = wxyz[:, [3, 0, 1, 2]]
    raw = RawPoses(tuple(map(str, range(len(T)))), T[:, :3, 3], by_name, ("qx", "qy", "qz", "qw"),
                   "T_base_hand", "abb")  # fmt: skip
    right = [r for r in pose_readings(raw) if np.abs(r.T_base_hand - T).max() < 1e-12]
    assert [r.words for r in right] == ["T_base_hand, quaternion in the order wxyz"]
    assert "name the columns qw, qx, qy, qz" in right[0].change[0]


# --- planted mistakes ---------------------------------------------------------------------------

MISTAKES = [
    ("inverse", "quat_wxyz", "T_base_hand", {"transform": "T_hand_base"}),
    ("inverse of an inverse", "quat_wxyz", "T_hand_base", {"transform": "T_base_hand"}),
    ("kuka for mitsubishi", "mitsubishi", "T_base_hand", {"rotation": "kuka"}),
    ("fanuc for kuka", "kuka", "T_hand_base", {"rotation": "fanuc"}),
    ("degrees for radians", "rotvec_rad", "T_base_hand", {"rotation": "rotvec_deg"}),
    ("radians for degrees", "euler:ZYX:deg", "T_base_hand", {"rotation": "euler:ZYX:rad"}),
    ("staubli for ur", "ur", "T_base_hand", {"rotation": "staubli"}),
    ("ur for yaskawa", "yaskawa", "T_hand_base", {"rotation": "ur"}),
    ("kawasaki for fanuc", "fanuc", "T_base_hand", {"rotation": "kawasaki"}),
    ("both wrong", "mitsubishi", "T_hand_base",
     {"rotation": "kuka", "transform": "T_base_hand"}),
]  # fmt: skip
QUICK = ("inverse", "kuka for mitsubishi")


@pytest.mark.parametrize(
    ("rotation", "transform", "declared", "seed"),
    [
        pytest.param(*case, seed, id=f"{name} {seed}", marks=[] if quick else [pytest.mark.slow])
        for seed in range(3)
        for name, *case in MISTAKES
        if (quick := name in QUICK and seed == 0) or True
    ],
)
def test_a_wrong_declaration_is_named(rotation, transform, declared, seed):
    preset = ("tool-z-2", "paper", "table2-3")[seed % 3]
    simulation = simulate(preset, 10 + seed, LIGHT)
    truth = simulation.observations.T_base_hand
    raw = raw_poses(truth, rotation, transform, declared)
    found = diagnosis_of(simulation, raw)
    assert found.verdict == "other"
    np.testing.assert_allclose(pose_of(found, raw), truth, atol=1e-9)
    assert not [other for other in found.alike if not other.harmless]
    assert found.best.residual_px < 1.0
    assert found.declared.residual_px > 10 * found.best.residual_px
    text = " ".join(sentences(found))
    assert "probably the right one" in text
    for key in declared:
        assert f"{key}: " in text


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_a_quaternion_with_its_columns_misnamed_is_named(order):
    simulation = simulate("tool-z-2", 4, LIGHT)
    T = simulation.observations.T_base_hand
    numbers = columns_from_rotations(f"quat_{order}", T[:, :3, :3])
    declared = "quat_xyzw" if order == "wxyz" else "quat_wxyz"
    raw = RawPoses(tuple(map(str, range(len(T)))), T[:, :3, 3], numbers,
                   rotation_format(declared).columns, "T_base_hand", declared)  # fmt: skip
    found = diagnosis_of(simulation, raw)
    assert found.verdict == "other"
    assert found.best.words == f"T_base_hand, quaternion in the order {order}"


def test_a_transposed_matrix_is_named():
    simulation = simulate("paper", 5, LIGHT)
    T = simulation.observations.T_base_hand.copy()
    T[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    found = diagnosis_of(simulation, raw_poses(T, "matrix"))
    assert found.verdict == "other"
    assert found.best.words == "T_base_hand, matrix of the transposed rotation"
    assert "r11, r21, r31" in " ".join(found.best.change)


@pytest.mark.parametrize("pixels", MIRRORED, ids=lambda reading: reading.words)
def test_mirrored_pixels_are_found_but_which_mirror_cannot_be_told(pixels):
    simulation = simulate("tool-z-2", 6, LIGHT)
    raw = raw_poses(simulation.observations.T_base_hand, "quat_wxyz")
    found = diagnosis_of(simulation, raw, pixels)
    assert found.verdict == "other"
    named = {judged.words for judged in (found.best, *found.alike)}
    assert named == {f"T_base_hand, quat_wxyz, {mirror.words}" for mirror in MIRRORED}
    assert "cannot tell" in " ".join(sentences(found))


def test_a_mirrored_picture_of_one_plane_fits_from_behind_the_plane():
    simulation = simulate("tool-z", 7, LIGHT)
    raw = raw_poses(simulation.observations.T_base_hand, "quat_wxyz")
    right = diagnosis_of(simulation, raw)
    assert right.verdict == "consistent"
    mirrored = next(j for j in right.readings if j.words.endswith("left to right"))
    assert mirrored.residual_px < 1.1 * right.best.residual_px
    assert mirrored.wrong_side and not right.best.wrong_side

    wrong = diagnosis_of(simulation, raw, MIRRORED[1])
    assert wrong.verdict == "other"
    assert wrong.declared.wrong_side
    assert "translucent" in " ".join(sentences(wrong))


def test_the_side_of_the_planes_is_seen():
    simulation = simulate("tool-z", 0)
    assert seen_from_behind(simulation.truth, simulation.observations) == 0.0
    camera = simulation.truth.cameras["camera"]
    below = camera.T_base_camera.copy()
    below[2, 3] = -1.0  # the table is at z = -0.12
    moved = replace(simulation.truth, cameras={"camera": replace(camera, T_base_camera=below)})
    assert seen_from_behind(moved, simulation.observations) == 1.0


# --- nothing where nothing is wrong -------------------------------------------------------------


def check_no_alarm(preset, seed, rotation="quat_wxyz"):
    simulation = simulate(preset, seed, Noise(pixel_px=1.0))
    raw = raw_poses(simulation.observations.T_base_hand, rotation)
    found = diagnosis_of(simulation, raw)
    assert found.verdict == "consistent"
    assert found.best is found.declared
    assert not [other.words for other in found.alike if not other.harmless]


@pytest.mark.parametrize("preset", ["paper-2", "tool-z", "table2-3"])
def test_the_right_declaration_is_confirmed(preset):
    check_no_alarm(preset, 3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100))
def test_no_false_alarm(seed):
    check_no_alarm(("paper", "table2-3", "tool-z-2", "tool-z", "paper-2")[seed % 5], seed)


def test_poses_in_no_groups_are_judged_too():
    check_no_alarm("no-groups", 2)


def with_outliers(preset, count):
    simulation = simulate(preset, 8, LIGHT)
    rng = np.random.default_rng(8)
    uv = simulation.observations.uv.copy()
    uv[rng.permutation(len(uv))[:count]] = rng.uniform(20, 460, (count, 2))
    return replace(simulation, observations=replace(simulation.observations, uv=uv))


@pytest.mark.parametrize(
    ("preset", "count"),
    [("table2-3", 6), *(pytest.param(p, n, marks=pytest.mark.slow)
                        for p, n in (("tool-z-2", 6), ("paper-2", 6), ("paper", 9)))],
)  # fmt: skip
def test_outliers_do_not_raise_an_alarm(preset, count):
    spoiled = with_outliers(preset, count)
    raw = raw_poses(spoiled.observations.T_base_hand, "quat_wxyz")
    found = diagnosis_of(spoiled, raw)
    assert found.verdict == "consistent"
    assert found.best.fitting == len(spoiled.observations) - count


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "count"), [("table2-3", 6), ("paper-2", 6), ("paper", 9)])
def test_outliers_do_not_hide_the_right_reading(preset, count):
    spoiled = with_outliers(preset, count)
    raw = raw_poses(
        spoiled.observations.T_base_hand, "quat_wxyz", declared={"transform": "T_hand_base"}
    )
    found = diagnosis_of(spoiled, raw)
    assert found.verdict == "other"
    assert found.best.words == "T_base_hand, quat_wxyz"


@pytest.mark.slow
def test_spots_of_another_capture_are_explained_by_no_reading():
    simulation = simulate("paper-2", 9, LIGHT)
    seen = simulation.observations
    shuffled = replace(seen, uv=seen.uv[np.random.default_rng(0).permutation(len(seen))])
    raw = raw_poses(seen.T_base_hand, "quat_wxyz")
    found = diagnosis_of(replace(simulation, observations=shuffled), raw)
    assert found.verdict == "none"
    assert "Something else is wrong" in sentences(found)[0]


def test_the_unit_of_length_cannot_be_seen():
    simulation = simulate("paper-2", 3, LIGHT)
    raw = raw_poses(simulation.observations.T_base_hand, "quat_wxyz")
    in_mm = replace(raw, position_m=1000 * raw.position_m)
    right, scaled = diagnosis_of(simulation, raw), diagnosis_of(simulation, in_mm)
    assert scaled.verdict == right.verdict == "consistent"
    assert scaled.best.residual_px == pytest.approx(right.best.residual_px, rel=1e-3)
    assert "unit of the positions cannot be seen" in sentences(right)[-1]


# --- the judgement ------------------------------------------------------------------------------

DECLARED = Judged("declared", (), 10.0, 10, "refined")
OTHER = Judged("other", ("write other",), 10.0, 60, "refined")


@pytest.mark.parametrize(
    ("declared_px", "other_px", "verdict"),
    [(1.0, 1.0, "consistent"), (1.04, 1.0, "consistent"), (1.5, 1.0, "unclear"),
     (2.1, 1.0, "other"), (np.inf, 1.0, "other"), (30.0, 20.0, "none"), (0.5, 9.0, "consistent")],
)  # fmt: skip
def test_verdicts(declared_px, other_px, verdict):
    readings = [replace(DECLARED, residual_px=declared_px), replace(OTHER, residual_px=other_px)]
    assert judge(readings, 60, 800.0).verdict == verdict


def test_a_camera_behind_a_plane_loses_against_an_equal_fit_only():
    behind = replace(DECLARED, residual_px=1.0, wrong_side=True)
    assert judge([behind, replace(OTHER, residual_px=1.1)], 60, 800.0).verdict == "other"
    assert judge([behind, replace(OTHER, residual_px=4.0)], 60, 800.0).verdict == "consistent"


def test_of_equal_readings_the_smaller_change_is_named():
    far = replace(DECLARED, residual_px=50.0)
    one = replace(OTHER, residual_px=1.0)
    two = Judged("two", ("write one", "write two"), 1.0, 60, "refined")
    found = judge([far, two, one], 60, 800.0)
    assert found.best is one
    assert found.alike == (two,)


def test_exchanged_columns_are_noticed_where_spots_lie_outside(tmp_path):
    simulation = simulate("paper-2", 0, LIGHT)
    path = write_simulation(tmp_path / "c", simulation)
    head, _ = read_head(path)
    assert swapped_pixels(head, path.parent) == []
    table = path.parent / "poses.csv"
    table.write_text(table.read_text().replace("u,v", "v,u", 1))
    outside = simulation.observations.uv[:, 0].max() > 480
    assert bool(swapped_pixels(head, path.parent)) == outside
