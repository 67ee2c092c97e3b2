"""Comparisons: numbers against formulas of their own, chances against chance, moves by name."""

from __future__ import annotations

from dataclasses import replace

import compare_cases as cases
import figure_cases
import numpy as np
import pytest
from scipy import stats

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Plane
from lasercal_gtsam.comparison.parts import _flat, _frame_at_origin, _line_jacobian
from lasercal_gtsam.comparison.result import Comparison, PartChange
from lasercal_gtsam.io.origin import Origin
from lasercal_gtsam.rotations import basis_of

LENS = ("fu", "fv", "skew", "u0", "v0", "k1", "k2", "p1", "p2")


def part(found: Comparison, kind: str, name: str) -> PartChange:
    return next(p for p in found.parts if (p.kind, p.name) == (kind, name))


def test_the_sigma_of_separate_data_is_that_of_both_sigmas() -> None:
    a, b = cases.first(), cases.second()
    found = lc.compare(a, b)
    assert [row.name for row in found.rows] == [p.name for p in a.parameters]
    for row, p, q in zip(found.rows, a.parameters, b.parameters, strict=True):
        assert row.difference == pytest.approx(q.refined - p.refined, abs=1e-9)
        assert row.sigma == pytest.approx(np.hypot(p.sigma, q.sigma), rel=1e-6)
        assert row.sigmas == pytest.approx(row.difference / row.sigma)
    assert found.verdict == "same" and "within noise" in found.words
    assert "share no spot" in found.basis and found.inputs.shared == 0
    assert found.unknowns == 28


def test_the_distance_of_a_lens_is_mahalanobis() -> None:
    a, b = cases.first(), cases.second()
    d = b.cell.cameras["camera"].intrinsics.vector - a.cell.cameras["camera"].intrinsics.vector
    at = [a.labels.index(f"camera.{n}") for n in LENS]
    C = a.covariance[np.ix_(at, at)] + b.covariance[np.ix_(at, at)]
    lens = part(lc.compare(a, b), "lens", "camera")
    square = d @ np.linalg.solve(C, d)
    assert lens.distance == pytest.approx(np.sqrt(square), rel=1e-4)
    # both scales are known about equally well: Satterthwaite's freedom is between one and both
    low, high = (stats.f.sf(square / 9, 9, n * a.fit.dof) for n in (1, 2))
    assert min(low, high) <= lens.chance <= max(low, high)


def test_nested_data_differ_by_what_was_added() -> None:
    a, b = cases.fewer_spots(), cases.first()
    found = lc.compare(a, b)
    assert found.verdict == "same"
    assert "not independent" in found.basis and "60 spots" in found.basis
    assert (found.inputs.shared, len(found.inputs.only_b), found.inputs.only_a) == (60, 30, ())
    # C_a - C_b with one scale for both, for those rows where that is no small difference
    pooled = (a.fit.dof * a.fit.sigma0**2 + b.fit.dof * b.fit.sigma0**2) / (a.fit.dof + b.fit.dof)
    for row, p, q in zip(found.rows, a.parameters, b.parameters, strict=True):
        wanted = pooled * ((p.sigma / a.fit.sigma0) ** 2 - (q.sigma / b.fit.sigma0) ** 2)
        if wanted > 0.3 * p.sigma**2:
            assert row.sigma == pytest.approx(np.sqrt(wanted), rel=0.15), row.name


def test_a_calibration_that_went_on_from_the_other_shares_its_spots() -> None:
    a, seen = cases.fewer_spots(), cases.first().inputs.observations
    calibrator = lc.IncrementalCalibrator(a)
    calibrator.add(seen[np.arange(len(seen)) % 3 == 0])
    went_on = calibrator.calibration
    assert went_on is not None
    found, batch = lc.compare(a, went_on), lc.compare(a, cases.first())
    assert found.inputs.shared == 60 and len(found.inputs.only_b) == 30
    np.testing.assert_allclose(
        [r.sigma for r in found.rows], [r.sigma for r in batch.rows], rtol=0.05
    )


def test_one_spot_more_can_make_a_difference_in_two_unknowns() -> None:
    b = cases.first()
    found = lc.compare(cases.calibrated(b.inputs.observations[1:]), b)
    assert found.unknowns == 2
    assert found.inputs.only_b == (str(b.inputs.observations.id[0]),)


def test_the_same_spots_with_a_value_held() -> None:
    """What is left free in one only: a test of the held value (Hausman's), in one unknown."""
    b = cases.first()
    a = cases.calibrated(b.inputs.observations, known={"skew": 0.0})
    found = lc.compare(a, b)
    assert found.unknowns == 1
    skew = b["alpha_c"]
    assert found.distance == pytest.approx(abs(skew.refined / skew.sigma), rel=0.05)
    assert [(c.name, c.a) for c in found.inputs.options] == [("known", "skew = 0")]


def test_a_value_held_at_two_values_is_named() -> None:
    seen = cases.first().inputs.observations
    a, b = (cases.calibrated(seen, known={"skew": s}) for s in (0.0, 3.0))
    found = lc.compare(a, b)
    assert part(found, "lens", "camera").held == ("skew",)
    row = next(r for r in found.rows if r.name == "alpha_c")
    assert row.sigma < 1e-5 and row.difference > 1e-3


def test_a_moved_camera_is_named_with_its_size() -> None:
    found = lc.compare(cases.first(), cases.camera_moved())
    assert found.verdict == "different"
    assert found.words.startswith("Camera 'camera' moved by") and "lens" not in found.words
    moved = part(found, "camera", "camera")
    assert moved.corrected < 1e-6 and moved.unknowns == 6
    turn, shift = np.linalg.norm(cases.TURN_DEG), np.linalg.norm(cases.SHIFT_MM)
    assert abs(moved.turn_deg - turn) < 3 * moved.turn_sigma_deg
    assert abs(moved.shift_mm - shift) < 3 * moved.shift_sigma_mm
    # with lens, beam and planes as they were the move is known much better
    alone = moved.alone
    assert alone.turn_sigma_deg < 0.3 * moved.turn_sigma_deg
    assert abs(alone.turn_deg - turn) < 3 * alone.turn_sigma_deg
    assert abs(alone.shift_mm - shift) < 3 * alone.shift_sigma_mm
    assert all(p.corrected > 0.01 for p in found.parts if p.kind != "camera")
    assert "what moved it" in found.next_action


def test_maps_agree_with_locate_and_projection() -> None:
    a, b = cases.first(), cases.camera_moved()
    found = lc.compare(a, b)
    one = next(m for m in found.plane_maps if m.plane == "2")
    j, i = np.argwhere(one.near)[7]
    point = one.axes.to_base(np.array([[one.x_mm[i], one.y_mm[j]]]))
    camera = a.cell.cameras["camera"]
    uv = cv_project(point, camera)
    here, cov_a = a.locate(uv, plane="2")
    there, cov_b = b.locate(uv, plane="2")
    np.testing.assert_allclose(here, point, atol=1e-9)
    assert one.difference_mm[j, i] == pytest.approx(1e3 * np.linalg.norm(there - here), rel=1e-6)
    wanted = 1e3 * np.sqrt(np.trace(cov_a[0]) + np.trace(cov_b[0]))
    assert one.expected_mm[j, i] == pytest.approx(wanted, rel=1e-6)
    seen = next(m for m in found.pixel_maps if m.plane == "2")
    k = int(np.flatnonzero(seen.near)[0])
    base = lc.spot_on_ray(a.cell, seen.uv[k : k + 1], plane="2")
    change = cv_project(base, b.cell.cameras["camera"])[0] - seen.uv[k]
    np.testing.assert_allclose(seen.difference_px[k], change, atol=1e-6)
    assert seen.largest_px >= seen.median_px > 3 * seen.expected_median_px


def cv_project(points: np.ndarray, camera: lc.Camera) -> np.ndarray:
    """Pixels by OpenCV (no skew in its camera matrix: put in by hand)."""
    import cv2

    T = np.linalg.inv(camera.T_base_camera)
    i = camera.intrinsics
    rvec = cv2.Rodrigues(T[:3, :3])[0]
    xy = cv2.projectPoints(points, rvec, T[:3, 3], np.eye(3), i.dist_coeffs)[0].reshape(-1, 2)
    return np.column_stack([i.fu * xy[:, 0] + i.skew * xy[:, 1] + i.u0, i.fv * xy[:, 1] + i.v0])


def test_planes_of_one_only_are_named() -> None:
    seen = cases.second().inputs.observations
    b = cases.calibrated(seen[seen.plane != "3"])
    found = lc.compare(cases.first(), b)
    assert found.only_a == ("plane '3'",) and found.only_b == ()
    assert {m.plane for m in found.plane_maps} == {"1", "2"}
    assert lc.compare(b, cases.first()).only_b == ("plane '3'",)


def test_the_order_turns_the_signs() -> None:
    one, two = lc.compare(cases.first(), cases.second()), lc.compare(cases.second(), cases.first())
    # the paper's rows bend little at this distance
    np.testing.assert_allclose(
        [r.difference for r in one.rows], [-r.difference for r in two.rows], rtol=1e-6, atol=1e-9
    )
    assert one.chance == pytest.approx(two.chance, rel=0.05)


def test_the_same_twice_is_identical() -> None:
    found = lc.compare(cases.first(), cases.first())
    assert found.verdict == "identical" and found.unknowns == 0
    assert not found.inputs.only_a and not found.inputs.options


def test_without_sigmas_or_common_parts_it_says_so() -> None:
    found = lc.compare(figure_cases.no_freedom(), figure_cases.no_freedom())
    assert found.verdict == "identical"
    moved = replace(
        figure_cases.no_freedom(),
        cell=replace(
            figure_cases.no_freedom().cell,
            planes={
                k: Plane(p.normal_base, p.distance + 1e-3)
                for k, p in figure_cases.no_freedom().cell.planes.items()
            },
        ),
    )
    found = lc.compare(figure_cases.no_freedom(), moved)
    assert found.verdict == "unknown" and np.isnan(found.chance)
    assert all(np.isnan(row.sigma) for row in found.rows)
    other = figure_cases.two_cameras()
    alone = lc.compare(figure_cases.usual(), other)
    assert {"camera 'left'", "laser 'red'"} <= set(alone.only_b)


def test_without_spots_independence_is_not_claimed() -> None:
    found = lc.compare(figure_cases.without_spots(), cases.first())
    assert "cannot be verified" in found.basis


def test_another_laser_of_the_same_name_is_refused() -> None:
    b = cases.first()
    beam = b.cell.lasers["laser"]
    turned = lc.Beam(-beam.direction_hand, beam.point_hand)
    other = replace(b, cell=replace(b.cell, lasers={"laser": turned}))
    with pytest.raises(lc.DataError, match="90 deg or more away"):
        lc.compare(cases.second(), other)


def test_files_and_versions_that_differ() -> None:
    one = Origin(version="0.1.0", files={"poses.csv": "aa", "capture.yaml": "cc"})
    two = Origin(version="0.2.0", files={"poses.csv": "bb", "capture.yaml": "cc"})
    found = lc.compare(cases.first(), cases.second(), origins=(one, two)).inputs
    assert [(c.name, c.a, c.b) for c in found.files] == [("poses.csv", "aa", "bb")]
    assert [(c.a, c.b) for c in found.made] == [("0.1.0", "0.2.0")]


def test_derivatives_of_beam_and_plane_coordinates() -> None:
    rng = np.random.default_rng(4)
    one = lc.Beam(rng.normal(size=3), rng.normal(size=3))
    two = lc.Beam(one.direction_hand + 0.2 * rng.normal(size=3), rng.normal(size=3))
    frame = _frame_at_origin(one)
    from lasercal_factors.beam import BeamFrame

    own, J = BeamFrame.from_line(two.direction_hand, two.point_hand), _line_jacobian(two, frame)
    p = lc.Plane(rng.normal(size=3), 0.4)
    q = lc.Plane(-p.normal_base + 0.1 * rng.normal(size=3), 0.1)  # turned round
    middle = rng.normal(size=3)
    J_plane = _flat(q, p, middle)[1]

    def tilted(step: np.ndarray) -> np.ndarray:
        n = q.normal_base + basis_of(q.normal_base) @ step[:2]
        return _flat(lc.Plane(n, q.distance + step[2]), p, middle)[0]

    h = 1e-6
    for k in range(4):
        step = h * np.eye(4)[k]
        ends = [frame.coordinates(*own.line(s * step)) for s in (1, -1)]
        np.testing.assert_allclose(J[:, k], (ends[0] - ends[1]) / (2 * h), atol=1e-6)
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (tilted(step) - tilted(-step)) / (2 * h)
        np.testing.assert_allclose(J_plane[:, k], numeric, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("pairs", [16, pytest.param(200, marks=pytest.mark.slow)])
def test_chances_are_uniform(pairs: int, nested: bool) -> None:
    chances, z = [], []
    for k in range(pairs):
        rng = np.random.default_rng([11, k])
        b = cases.noisy(rng)
        a = b[np.arange(len(b)) % 3 > 0] if nested else cases.noisy(rng)
        found = lc.compare(cases.calibrated(a), cases.calibrated(b))
        chances.append([found.chance, *(p.chance for p in found.parts)])
        z.append([row.sigmas for row in found.rows])
    for column in np.array(chances).T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    # of 28 rows, each with its own spread: sqrt(1 / 2 pairs) is one sigma of it
    spread = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.abs(spread - 1.0).max() < 4.0 / np.sqrt(2 * pairs)
