"""Several cameras, lasers and planes in one capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core_cases import distance_in_sigmas, rows_of

import lasercal_gtsam as lc
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, simulate_cell
from lasercal_gtsam.simulate.cells import paper_cell

EXACT = Noise()
PIXEL = Noise(pixel_px=0.5)


def two_eyed_cell():
    """The paper's cell with a second camera beside the first, and a second laser on the hand."""
    cell = paper_cell(3)
    camera, beam = cell.cameras["camera"], cell.lasers["laser"]
    aside = make_pose(rotation_exp(np.array([0.05, -0.12, 0.1])), np.array([0.05, 0.02, -0.03]))
    right = lc.Camera(
        lc.Intrinsics(620.0, 610.0, 0.0, 400.0, 300.0, -0.1, 0.05),
        camera.T_base_camera @ aside,
        (800, 600),
    )
    red = lc.Beam(
        rotation_exp(np.array([0.0, 0.15, 0.1])) @ beam.direction_hand, beam.point_hand + 0.01
    )
    return lc.Cell({"left": camera, "right": right}, {"blue": beam, "red": red}, cell.planes)


def capture(cell, pairs, noise, planes=None):
    parts = [
        simulate_cell(
            cell, planes, groups=3, shots=8, seed=k, noise=noise, camera=camera, laser=laser,
            prefix=f"{camera}-{laser}-",
        ).observations
        for k, (camera, laser) in enumerate(pairs)
    ]  # fmt: skip
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


@pytest.fixture(scope="module")
def cell():
    return two_eyed_cell()


@pytest.mark.parametrize("started", [True, False], ids=["start", "no start"])
def test_exact_pixels_give_every_part(cell, started):
    seen = capture(cell, [("left", "blue"), ("right", "blue"), ("left", "red")], EXACT)
    assert (seen.cameras, seen.lasers) == (("left", "right"), ("blue", "red"))
    result = lc.calibrate(seen, initial=cell if started else None)
    assert result.fit.converged, result.fit.status
    truth = rows_of(cell, result.cell)
    names = [p.name for p in result.parameters]
    assert names == list(truth)
    assert {"left.fu", "right.fu", "blue.laser_y", "red.laser_phi", "a_3_z"} <= set(names)
    for row in result.parameters:
        usual = {"px": 1.0, "1": 1e-2, "mm": 100.0, "deg": 10.0}[row.unit]
        wanted = truth[row.name]
        assert abs(row.refined - wanted) <= 1e-9 * max(abs(wanted), usual), row
    assert len(result.labels) == len(result.covariance) == 2 * 15 + 2 * 4 + 3 * 3


def test_noisy_pixels_give_every_part_within_its_sigmas(cell):
    seen = capture(cell, [("left", "blue"), ("right", "blue"), ("right", "red")], PIXEL)
    result = lc.calibrate(seen)
    assert result.fit.converged, result.fit.status
    assert result.fit.dof == 2 * len(seen) - 47
    assert result.fit.sigma0 == pytest.approx(0.5, rel=0.15)
    truth = rows_of(cell, result.cell)
    off = np.array([(p.refined - truth[p.name]) / p.sigma for p in result.parameters])
    assert np.abs(off).max() < 4.5
    assert np.sqrt(np.mean(off**2)) < 1.8


def test_a_second_camera_helps_the_first(cell):
    """They share beam and planes: common spots, smaller sigmas."""
    left = capture(cell, [("left", "blue")], PIXEL)
    both = left + capture(cell, [("right", "blue")], PIXEL)
    alone, together = lc.calibrate(left, initial=cell), lc.calibrate(both, initial=cell)
    for name in ("laser_y", "laser_z"):
        shared = together[name].sigma / together.fit.sigma0
        assert shared < 0.9 * alone[name].sigma / alone.fit.sigma0
    assert "left.fu" in [p.name for p in together.parameters]
    assert "fu" in [p.name for p in alone.parameters]


def test_two_cells_that_share_nothing_are_two_calibrations(cell):
    """Joined or apart: the same estimates; only the noise scale is common."""
    first = capture(cell, [("left", "blue")], PIXEL)
    other = capture(cell, [("right", "red")], PIXEL)
    other = replace(other, plane=np.char.add("other ", other.plane))
    planes = cell.planes | {f"other {k}": p for k, p in cell.planes.items()}
    whole = lc.Cell(cell.cameras, cell.lasers, planes)
    options = lc.CalibrationOptions(robust="none")
    joined = lc.calibrate(first + other, initial=whole, options=options)
    apart = [lc.calibrate(part, initial=whole, options=options) for part in (first, other)]
    for part, camera, laser in zip(apart, ("left", "right"), ("blue", "red"), strict=True):
        rows = {
            p.name.replace(f"{camera}.", "").replace(f"{laser}.", ""): p for p in joined.parameters
        }
        scale = joined.fit.sigma0 / part.fit.sigma0
        for p in part.parameters:
            assert rows[p.name].refined == pytest.approx(p.refined, abs=2e-5 * p.sigma)
            assert rows[p.name].sigma == pytest.approx(scale * p.sigma, rel=1e-5)


def test_one_camera_sees_one_plane_the_other_three(cell):
    """Only the first camera needs the assumptions of one plane."""
    seen = capture(cell, [("left", "blue")], PIXEL, planes=["1"])
    seen = seen + capture(cell, [("right", "blue")], PIXEL)
    result = lc.calibrate(seen, initial=cell)
    assert result.fit.converged, result.fit.status
    assert {result[f"left.{n}"].sigma for n in ("u0", "v0", "alpha_c")} == {0.0}
    assert all(result[f"right.{n}"].sigma > 0 for n in ("u0", "v0", "alpha_c"))
    words = " ".join(result.observability.held)
    assert "camera 'left' sees one plane only" in words
    assert "'right'" not in words


def test_each_camera_has_its_own_options(cell):
    seen = capture(cell, [("left", "blue"), ("right", "blue")], PIXEL)
    options = lc.CalibrationOptions(
        known={"left.skew": 0.0, "right.aspect": 62 / 61},
        fixed=("right.distortion",),
        priors={"left.u0": (320.0, 0.5)},
    )
    result = lc.calibrate(seen, initial=cell, options=options)
    assert result["left.alpha_c"].sigma == 0.0
    assert result["right.alpha_c"].sigma > 0.0
    right = result.cell.cameras["right"].intrinsics
    assert right.fu == pytest.approx(62 / 61 * right.fv, rel=1e-14)
    assert (right.k1, right.k2) == (-0.1, 0.05)
    assert result["left.k1"].sigma > 0.0
    assert result["left.u0"].sigma < 0.5
    with pytest.raises(lc.DataError, match="unknown name 'u0'"):
        lc.calibrate(seen, initial=cell, options=lc.CalibrationOptions(priors={"u0": (320, 1)}))


def test_robot_noise_and_outliers_with_two_cameras(cell):
    noise = Noise(pixel_px=0.3, hand_translation_m=5e-4, hand_rotation_rad=5e-4)
    seen = capture(cell, [("left", "blue"), ("right", "red")], noise)
    uv = seen.uv.copy()
    uv[[4, 100]] += [[150.0, -90.0], [-120.0, 60.0]]
    options = lc.CalibrationOptions(sigma_px=0.3, hand_sigma_m=5e-4, hand_sigma_rad=5e-4)
    spoiled = lc.calibrate(replace(seen, uv=uv), initial=cell, options=options)
    assert [k for k, spot in enumerate(spoiled.spots) if spot.rejected] == [4, 100]
    good = np.setdiff1d(np.arange(len(seen)), [4, 100])
    clean = lc.calibrate(seen[good], initial=cell, options=options)
    assert distance_in_sigmas(clean, spoiled) < 1e-4
    assert clean.fit.sigma0 == pytest.approx(1.0, abs=0.15)


def test_names_decide_nothing(cell):
    """Renamed and in another order: the same numbers."""
    seen = capture(cell, [("left", "blue"), ("right", "blue")], PIXEL)
    names = {"left": "z", "right": "a"}
    renamed = replace(
        seen[::-1],
        camera=np.array([names[c] for c in seen.camera[::-1]]),
        image_size={names[c]: size for c, size in seen.image_size.items()},
    )
    other = lc.Cell({names[k]: c for k, c in cell.cameras.items()}, cell.lasers, cell.planes)
    first, second = lc.calibrate(seen, initial=cell), lc.calibrate(renamed, initial=other)
    assert second.parameters[0].name == "a.fu"
    for p in first.parameters:
        name = p.name.replace("left.", "z.").replace("right.", "a.")
        assert second[name].refined == pytest.approx(p.refined, abs=1e-5 * p.sigma)
        assert second[name].sigma == pytest.approx(p.sigma, rel=1e-5)
