"""What a human reads: weak directions in words, the status sentence, the table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core_cases import moved_intrinsics, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import Parameter, table_decimals, table_row
from lasercal_gtsam.observability import RangeSvd, plausible_ranges
from lasercal_gtsam.simulate import Noise, simulate_cell
from lasercal_gtsam.solve import fold_radius, fold_warnings, implausible_cameras

LABELS = ("camera.rot_x", "camera.trans_z", "camera.fu", "camera.k1", "laser.offset_x")


# --- weak directions ----------------------------------------------------------------------------


def test_ranges_are_in_si_and_by_kind():
    np.testing.assert_array_equal(plausible_ranges(LABELS), [0.1, 0.05, 50.0, 0.2, 0.02])
    # a name may hold dots and the words of a kind
    names = ("left.fu.v0", "plane table.normal_1", "plane distance.distance")
    np.testing.assert_array_equal(plausible_ranges(names), [50.0, 0.1, 0.05])


def test_a_weak_direction_is_named_in_units_and_by_size():
    ranges = plausible_ranges(LABELS)
    # strong everywhere but where fu and trans_z move together: 50 px against -50 mm
    weak = np.array([0.0, -1.0, 1.0, 0.0, 0.0]) / np.sqrt(2)
    basis = np.linalg.qr(np.column_stack([weak, np.eye(5)[:, [0, 3, 4]], [0, 1, 1, 0, 0]]))[0]
    strengths = np.array([0.02, 30.0, 40.0, 50.0, 60.0])
    R = strengths[:, None] * basis.T / ranges
    found = RangeSvd.of(R, LABELS, np.ones(5, dtype=bool)).weak_directions()
    assert len(found) == 1
    assert found[0].strength == pytest.approx(0.02)
    assert set(found[0].words.split(", ")) in (
        {"camera.fu +35 px", "camera.trans_z -35 mm"},
        {"camera.fu -35 px", "camera.trans_z +35 mm"},
    )


def test_strength_is_in_sigmas():
    R = np.diag(2.0 / plausible_ranges(LABELS))
    svd = RangeSvd.of(R, LABELS, np.ones(5, dtype=bool))
    assert svd.weak_directions() == ()
    # three times the noise, a third of the information
    assert [w.strength for w in svd.weak_directions(sigma=3.0)] == pytest.approx([2 / 3] * 5)
    nothing = RangeSvd.of(0.0 * R, LABELS, np.ones(5, dtype=bool)).weak_directions(sigma=0.0)
    assert [w.strength for w in nothing] == [0.0] * 5
    np.testing.assert_allclose(svd.covariance(), np.diag((plausible_ranges(LABELS) / 2) ** 2))


def test_held_coordinates_are_not_weak():
    R = np.diag([1e-9, 1e3, 1e3, 1e3, 1e3])
    free = np.array([False, True, True, True, True])
    assert RangeSvd.of(R, LABELS, free).weak_directions() == ()


def test_good_data_have_no_weak_direction():
    assert lc.calibrate(simulated("paper", 3, 0.3).observations).observability.weak == ()


def test_weak_data_name_what_moves_together():
    """A plane nearly parallel to the image: focal lengths and distance look alike."""
    simulation = simulated("paper-1", 3)
    camera = simulation.truth.cameras["camera"].T_base_camera
    normal = camera[:3, :3] @ np.array([0.06, 0.06, 1.0])
    plane = lc.Plane.from_point(normal, camera[:3, 3] + 0.3 * camera[:3, 2])
    made = simulate_cell(
        simulation.truth.with_planes({"1": plane}), groups=4, seed=1, noise=Noise(pixel_px=0.3)
    )
    options = lc.CalibrationOptions(known=simulation.known, distortion="none")
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    weak = result.observability.weak
    assert weak
    assert 0 < weak[0].strength < 1
    moves = dict(part.rsplit(" ", 2)[:2] for part in weak[0].words.split(", "))
    assert {"camera.fu", "camera.fv", "camera.trans_z"} <= set(moves)
    # further away and longer lenses look the same: the camera steps back along its own axis
    assert float(moves["camera.fu"]) * float(moves["camera.trans_z"]) < 0
    strengths = [w.strength for w in weak]
    assert strengths == sorted(strengths)


# --- what no camera does ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("k1", "k2"), [(-0.5, 0.0), (-0.3, -0.1), (0.2, -0.5), (-0.5, 0.02), (0.0, -0.2)]
)
def test_fold_is_where_the_distorted_radius_stops_growing(k1, k2):
    r = np.linspace(0, 6, 600_001)
    distorted = r * (1 + k1 * r**2 + k2 * r**4)
    wanted = distorted[np.argmax(np.diff(distorted) <= 0)]
    assert fold_radius(lc.Intrinsics(500, 500, k1=k1, k2=k2)) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (0.3, 0.0), (-0.55, 1.1), (0.3, 0.4)])
def test_no_fold_is_infinity(k1, k2):
    assert fold_radius(lc.Intrinsics(500, 500, k1=k1, k2=k2)) == np.inf


def test_folds_are_said_only_where_the_image_reaches_them():
    cell = simulated("paper", 0).truth
    # f 550 px, corner 400 px from the centre: 0.73
    assert fold_warnings(moved_intrinsics(cell, k1=-0.2)) == []
    (warning,) = fold_warnings(moved_intrinsics(cell, k1=-0.4))
    for word in ("'camera'", "k1 -0.4", "folds", "335 px", "beyond the spots"):
        assert word in warning


class Seen:
    """A problem of which only the pixels are asked."""

    def __init__(self, uv):
        self.uv = uv

    def spot_pixels(self, camera):
        return self.uv


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fu": 60.0}, ["fu = 60 px", "0.1 to 50 image widths"]),
        ({"fv": 40_000.0}, ["fv = 4e+04 px"]),
        ({"k1": -0.8}, ["folds", "inside the spots"]),
        ({"k1": -0.2}, []),
        ({}, []),
    ],
)
def test_what_no_camera_does_is_said(changes, words):
    cell = moved_intrinsics(simulated("paper", 0).truth, **changes)
    found = implausible_cameras(Seen(np.array([[100.0, 100.0], [500.0, 400.0]])), cell)
    assert len(found) == (1 if words else 0)
    for word in words:
        assert word in found[0]


# --- status and table ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result():
    simulation = simulated("paper", 3, 1.0)
    options = lc.CalibrationOptions(known={"skew": 0.0}, distortion=("k1",))
    return lc.calibrate(simulation.observations, options=options)


def test_the_status_is_a_sentence_of_what_happened(result):
    assert result.fit.converged
    status = result.fit.status
    assert status.startswith("converged (")
    assert f"{result.fit.iterations} iterations" in status
    assert "90 spots" in status
    assert f"RMS {result.fit.rms_px:.3g} px" in status
    assert "rejected" not in status


def test_the_table_is_the_papers(result):
    lines = result.table().splitlines()
    assert [c.strip() for c in lines[0].split("|")] == ["", "Initial", "Refined", "sigma", "Unit"]
    assert set(lines[1]) == set(lines[-2]) == {"-", "+"}
    names = [line.split("|")[0].strip() for line in lines[2:-2]]
    assert names == [
        "fu", "fv", "alpha_c", "u0", "v0", "k1", "k2", "p1", "p2", "theta", "phi", "psi",
        "Tx", "Ty", "Tz", "laser_theta", "laser_phi", "laser_y", "laser_z",
        "a_1_x", "a_1_y", "a_1_z", "a_2_x", "a_2_y", "a_2_z", "a_3_x", "a_3_y", "a_3_z",
    ]  # fmt: skip
    last = [c.strip() for c in lines[-1].split("|")]
    assert last == ["RMS", "", f"{result.fit.rms_px:.4g}", "", "px"]
    # bars stand under each other, and nothing runs out of its column
    bars = {tuple(i for i, c in enumerate(line) if c in "|+") for line in lines}
    assert len(bars) == 1
    assert max(map(len, lines)) < 80
    assert all(line == line.rstrip() for line in lines)


def test_the_table_says_the_numbers_and_what_is_held(result):
    cells = {
        line.split("|")[0].strip(): [c.strip() for c in line.split("|")[1:]]
        for line in result.table().splitlines()[2:-2]
    }
    for p in result.parameters:
        initial, refined, sigma, unit = cells[p.name]
        assert unit == p.unit
        if p.sigma == 0:
            assert sigma == "held"
            continue
        assert float(refined) == pytest.approx(p.refined, abs=0.06 * p.sigma)
        assert float(initial) == pytest.approx(p.initial, abs=0.06 * p.sigma)
        assert float(sigma) == pytest.approx(p.sigma, rel=0.06)
        digits = sigma.replace(".", "").lstrip("0")
        assert len(digits) in (2, 3)
    assert {n for n, c in cells.items() if c[2] == "held"} == {"alpha_c", "k2", "p1", "p2"}


@pytest.mark.parametrize(
    ("sigma", "decimals"), [(25.9, 0), (9.96, 1), (1.0, 1), (0.47, 2), (0.0081, 4), (230.0, 0)]
)
def test_decimals_follow_the_sigma(sigma, decimals):
    row = Parameter("fu", 1.0, 550.123456789, sigma, "px")
    assert table_decimals(row) == decimals
    assert table_row(row)[2] == f"{550.123456789:.{decimals}f}"


def test_rows_without_a_number_stay_readable():
    assert table_row(Parameter("x", np.nan, -1e-9, 0.5, "mm")) == ("x", "", "0.00", "0.50", "mm")
    assert table_row(Parameter("x", 1.0, 2.0, np.nan, "mm"))[3] == "unknown"
    assert table_row(Parameter("x", 1.0, 2.0, 0.0, "mm"))[3] == "held"
    assert table_row(Parameter("x", np.inf, 2.0, 0.1, "mm"))[1] == ""


def test_a_row_is_found_by_name(result):
    assert result["fu"].unit == "px"
    with pytest.raises(KeyError, match="laser_theta"):
        result["f"]


def test_every_spot_is_accounted_for(result):
    seen = result.inputs.observations
    assert len(result.spots) == len(seen) == len(list(result.spots))
    assert [s.id for s in result.spots] == seen.id.tolist()
    assert [s.plane for s in result.spots] == seen.plane.tolist()
    uv = lc.project(result.cell, seen.T_base_hand, plane=seen.plane)
    np.testing.assert_allclose(result.spots.residual_px, uv - seen.uv, atol=1e-9)
    lengths = np.linalg.norm(uv - seen.uv, axis=1)
    assert result.fit.rms_px == pytest.approx(np.sqrt(np.mean(lengths**2)), rel=1e-12)


def test_the_result_can_be_recomputed_from_its_inputs(result):
    again = lc.calibrate(result.inputs.observations, options=result.inputs.options)
    assert again == result


def test_a_beam_along_the_tools_axis_has_tilts_and_sane_sigmas():
    simulation = simulated("tool-z-2", 3, 0.5)
    result = lc.calibrate(simulation.observations)
    assert result.fit.converged
    names = [p.name for p in result.parameters if p.name.startswith("laser")]
    assert names == ["laser_tilt_x", "laser_tilt_y", "laser_x", "laser_y"]
    for name in names:
        row = result[name]
        assert abs(row.refined) < 4.5 * row.sigma  # the truth is zero
        assert row.sigma < (0.5 if row.unit == "deg" else 3.0)
    given = lc.calibrate(simulation.observations, initial=simulation.truth)
    assert given.fit.iterations < 10
    turned = replace(simulation.truth.lasers["laser"], direction_hand=[0.02, -0.03, 1.0])
    start = lc.Cell(simulation.truth.cameras, {"laser": turned}, simulation.truth.planes)
    assert lc.calibrate(simulation.observations, initial=start).fit.iterations < 10
