"""One part of a cell from its spots: exact, noisy, with outliers, and what is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bump_cases import (
    bumped,
    outliers_among,
    spots_in_turn,
    with_part,
    with_sigma,
    without_part,
)
from core_cases import differences, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.incremental.relocate import (
    camera_candidates,
    locate_camera,
    locate_laser,
    locate_plane,
    missing_for,
)
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_exp
from lasercal_gtsam.simulate import PRESETS, Noise, simulate

LOCATE = {"camera": locate_camera, "laser": locate_laser, "plane": locate_plane}
NAMES = {"camera": "camera", "laser": "laser", "plane": "2"}
KINDS = tuple(NAMES)


def truth(seed: int = 0, preset: str = "paper") -> lc.Cell:
    return simulated(preset, seed).truth


def middle(cell: lc.Cell, plane: str, seed: int = 0) -> np.ndarray:
    made = simulated("paper", seed).observations
    made = made[made.plane == plane]
    return lc.spot_on_beam(cell, made.T_base_hand, plane=plane).mean(axis=0)


def after_bump(
    kind: str, seed: int, deg: float, mm: float, count: int, pixel_px: float = 0.0
) -> tuple[lc.Cell, lc.Cell, lc.Observations]:
    """A cell, the same with one part bumped, and spots of that part in the latter."""
    old, rng = truth(seed), np.random.default_rng(seed)
    new = bumped(old, kind, NAMES[kind], deg, mm, rng, middle(old, "2", seed))
    total = count * (3 if kind == "plane" else 1)
    spots = spots_in_turn(new, total, seed, pixel_px)
    return old, new, spots[getattr(spots, kind) == NAMES[kind]]


def moved(cell: lc.Cell, kind: str, step: np.ndarray) -> lc.Cell:
    """A part moved by local coordinates of the test's own."""
    name = NAMES[kind]
    if kind == "camera":
        camera = cell.cameras[name]
        T = make_pose(rotation_exp(step[:3]) @ camera.T_base_camera[:3, :3], np.zeros(3))
        T[:3, 3] = camera.T_base_camera[:3, 3] + step[3:]
        return with_part(cell, kind, name, replace(camera, T_base_camera=T))
    if kind == "laser":
        beam = cell.lasers[name]
        E = basis_of(beam.direction_hand)
        beam = lc.Beam(beam.direction_hand + E @ step[:2], beam.point_hand + E @ step[2:])
        return with_part(cell, kind, name, beam)
    return with_part(cell, kind, name, lc.Plane.from_vector(cell.planes[name].vector + step))


def predicted(cell: lc.Cell, seen: lc.Observations) -> np.ndarray:
    return lc.project(
        cell,
        seen.T_base_hand,
        plane=seen.plane.tolist(),
        camera=seen.camera.tolist(),
        laser=seen.laser.tolist(),
    )


def distance(kind: str, a: object, b: object) -> float:
    """Largest difference of two parts: rotation matrix entries or direction, and metres."""
    if kind == "camera":
        return float(np.abs(a.T_base_camera - b.T_base_camera).max())
    if kind == "plane":
        return float(np.abs(a.vector - b.vector).max())
    across = basis_of(b.direction_hand).T @ (a.point_hand - b.point_hand)
    return float(max(np.abs(a.direction_hand - b.direction_hand).max(), np.abs(across).max()))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(0.2, 1.0), (20.0, 100.0), (30.0, 150.0)])
def test_exact_spots_give_the_part_back(kind: str, size: tuple[float, float]) -> None:
    for seed in range(5):
        old, new, spots = after_bump(kind, seed, *size, count=6)
        name = NAMES[kind]
        found = LOCATE[kind](old, spots)
        assert distance(kind, found, getattr(new, f"{kind}s")[name]) < 1e-9
        assert np.abs(predicted(with_part(new, kind, name, found), spots) - spots.uv).max() < 1e-7


@pytest.mark.parametrize("kind", KINDS)
def test_the_part_need_not_be_in_the_cell(kind: str) -> None:
    old, new, spots = after_bump(kind, 3, 2.0, 10.0, count=6)
    name = NAMES[kind]
    rest = without_part(old, kind, name)
    intrinsics = {"intrinsics": old.cameras[name].intrinsics} if kind == "camera" else {}
    found = LOCATE[kind](rest, spots, **intrinsics)
    assert distance(kind, found, getattr(new, f"{kind}s")[name]) < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_noisy_spots_scatter_as_linear_propagation_says(kind: str) -> None:
    # squared length of the error in sigmas: chi-square with as many degrees of freedom as unknowns
    size = {"camera": 6, "laser": 4, "plane": 3}[kind]
    scores = []
    for seed in range(30):
        old, new, spots = after_bump(kind, seed, 5.0, 30.0, count=12, pixel_px=0.3)
        found = LOCATE[kind](old, with_sigma(spots, 0.3))
        fitted = with_part(new, kind, NAMES[kind], found)
        J = differences(
            lambda x, c=new, s=spots: predicted(moved(c, kind, x), s).ravel(), np.zeros(size)
        )
        # to first order the pixels of the fit are J times the error
        error = np.linalg.lstsq(
            J, (predicted(fitted, spots) - predicted(new, spots)).ravel(), rcond=None
        )[0]
        scores.append(float(np.sum((J @ error) ** 2)) / 0.3**2)
    # 30 seeds; the Cauchy loss costs about 5 % efficiency
    assert 0.75 * size < np.mean(scores) < 1.45 * size
    assert max(scores) < size + 8 * np.sqrt(2 * size)


@pytest.mark.parametrize("kind", KINDS)
def test_two_outliers_in_ten_do_no_harm(kind: str) -> None:
    for seed in range(5):
        old, new, spots = after_bump(kind, seed, 20.0, 100.0, count=10, pixel_px=0.0)
        spots = outliers_among(spots, [1, 6], np.random.default_rng(seed))
        found = LOCATE[kind](old, spots)
        # a redescending loss leaves the bad spots a weight, of the order of 1/distance
        fitted = with_part(new, kind, NAMES[kind], found)
        good = np.setdiff1d(np.arange(10), [1, 6])
        error = predicted(fitted, spots[good]) - spots.uv[good]
        assert np.abs(error).max() < 1.0


def test_a_bump_does_not_reverse_the_beam() -> None:
    for seed in range(20):
        old, new, spots = after_bump("laser", seed, 30.0, 150.0, count=5)
        found = locate_laser(old, spots)
        assert found.direction_hand @ new.lasers["laser"].direction_hand > 0
        assert np.isfinite(
            lc.spot_on_beam(
                with_part(old, "laser", "laser", found),
                spots.T_base_hand,
                plane=spots.plane.tolist(),
            )
        ).all()


def test_bad_spots_do_not_push_the_beam_s_point_away() -> None:
    for seed in range(10):
        old, _, spots = after_bump("laser", seed, 5.0, 20.0, count=10)
        clean = locate_laser(old, spots)
        spots = outliers_among(spots, [1, 6], np.random.default_rng(seed))
        found = locate_laser(old, spots)
        assert np.linalg.norm(found.point_hand) < np.linalg.norm(clean.point_hand) + 0.03


def test_a_new_camera_gets_its_intrinsics() -> None:
    old = truth(0, "paper-distorted")
    spots = spots_in_turn(old, 45, seed=4)
    found = locate_camera(without_part(old, "camera", "camera"), spots)
    want = old.cameras["camera"]
    assert np.abs(found.T_base_camera - want.T_base_camera).max() < 1e-9
    assert np.allclose(found.intrinsics.vector, want.intrinsics.vector, rtol=0, atol=1e-6)


def test_a_new_camera_keeps_usual_values_where_the_spots_say_nothing() -> None:
    old = truth(1)
    rest = without_part(old, "camera", "camera")
    spots = with_sigma(spots_in_turn(old, 12, seed=5, pixel_px=1.0), 1.0)
    lens = locate_camera(rest, spots).intrinsics
    assert (lens.k1, lens.k2, lens.p1, lens.p2).count(0.0) >= 1
    assert abs(lens.fu / 550.0 - 1.0) < 0.2
    one = spots_in_turn(old, 60, seed=6)
    one = one[one.plane == "1"]
    lens = locate_camera(rest, one).intrinsics
    assert np.isfinite(lens.vector).all()


def test_a_new_camera_is_found_among_outliers() -> None:
    old = truth(2)
    rest = without_part(old, "camera", "camera")
    for seed in range(3):
        spots = spots_in_turn(old, 24, seed=seed, pixel_px=0.3)
        spots = outliers_among(with_sigma(spots, 0.3), [2, 9, 13], np.random.default_rng(seed))
        found = with_part(old, "camera", "camera", locate_camera(rest, spots))
        error = np.linalg.norm(predicted(found, spots) - spots.uv, axis=1)
        assert np.delete(error, [2, 9, 13]).max() < 3.0


def test_few_spots_on_one_plane_may_leave_two_poses() -> None:
    ambiguous = 0
    for seed in range(20):
        old, new, spots = after_bump("camera", seed, 10.0, 50.0, count=12)
        few = spots[spots.plane == "1"]
        found = camera_candidates(old, few)
        assert min(distance("camera", c, new.cameras["camera"]) for c in found) < 1e-9
        ambiguous += len(found) > 1
    assert ambiguous > 5


@pytest.mark.parametrize("kind", KINDS)
def test_too_little_is_refused_in_words(kind: str) -> None:
    old, _, spots = after_bump(kind, 0, 2.0, 10.0, count=6)
    with pytest.raises(lc.DegenerateError, match=f"{kind} '{NAMES[kind]}'"):
        LOCATE[kind](old, spots[:1])
    same = spots[[0] * 6]
    with pytest.raises(lc.DegenerateError, match="add some"):
        LOCATE[kind](old, same)


def test_spots_in_a_line_do_not_fix_a_plane() -> None:
    old = truth(0)
    base = spots_in_turn(old, 3, seed=0)
    base = base[base.plane == "2"]
    along = basis_of(old.planes["2"].normal_base)[:, 0]
    T = np.repeat(base.T_base_hand, 8, axis=0)
    T[:, :3, 3] += np.linspace(-0.03, 0.03, 8)[:, None] * along
    uv = lc.project(old, T, plane="2")
    line = lc.Observations.from_arrays(uv, T, plane="2", image_size=(640, 480))
    with pytest.raises(lc.DegenerateError, match="one line"):
        locate_plane(old, line)
    (missing,) = missing_for("plane", "2", line, old)
    assert missing.have == 8 and missing.need > 8 and "line" in missing.words
    across = basis_of(old.planes["2"].normal_base)[:, 1]
    T[::2, :3, 3] += 0.03 * across
    wide = lc.Observations.from_arrays(
        lc.project(old, T, plane="2"), T, plane="2", image_size=(640, 480)
    )
    assert missing_for("plane", "2", wide, old) == ()


@pytest.mark.parametrize("kind", KINDS)
def test_missing_counts_down_to_nothing(kind: str) -> None:
    old, _, spots = after_bump(kind, 2, 2.0, 10.0, count=12, pixel_px=0.3)
    need = {"camera": 6, "laser": 3, "plane": 3}[kind]
    for count in range(need):
        (missing,) = missing_for(kind, NAMES[kind], spots[:count], old)
        assert (missing.part, missing.name) == (kind, NAMES[kind])
        assert (missing.have, missing.need) == (count, need)
        assert f"{kind} '{NAMES[kind]}' needs {need}" in missing.words
    assert missing_for(kind, NAMES[kind], spots, old) == ()


def test_spots_that_wait_for_another_part_are_not_counted() -> None:
    old = truth(0)
    spots = spots_in_turn(old, 9, seed=1)
    rest = without_part(old, "plane", "3")
    (missing,) = missing_for("camera", "camera", spots[:6], rest)
    assert missing.have == 4 and "2 more wait" in missing.words
    (missing,) = missing_for("camera", "new", spots[:0], rest)
    assert missing.need == 12


def test_wrong_questions_are_refused() -> None:
    old = truth(0)
    spots = spots_in_turn(old, 9, seed=1)
    with pytest.raises(lc.DataError, match="one plane"):
        locate_plane(old, spots)
    with pytest.raises(lc.DataError, match=r"plane '3'.*not in the cell"):
        locate_camera(without_part(old, "plane", "3"), spots)


def test_the_same_spots_give_the_same_digits() -> None:
    old, _, spots = after_bump("camera", 0, 2.0, 10.0, count=10, pixel_px=1.0)
    assert locate_camera(old, spots) == locate_camera(old, spots)


@pytest.mark.parametrize("preset", ["tool-z-2", "table2-4"])
@pytest.mark.parametrize("kind", KINDS)
def test_other_cells(preset: str, kind: str) -> None:
    made = simulate(preset, 0, Noise())
    assert preset in PRESETS
    name = {"camera": "camera", "laser": "laser", "plane": made.observations.planes[0]}[kind]
    spots = made.observations[getattr(made.observations, kind) == name][::3]
    old = bumped(made.truth, kind, name, 20.0, 50.0, np.random.default_rng(1))
    assert distance(kind, LOCATE[kind](old, spots), getattr(made.truth, f"{kind}s")[name]) < 1e-9
