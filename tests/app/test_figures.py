"""The figures' numbers: residuals, coverage, error maps, correlation and the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from figure_cases import SPOILED, no_freedom, one_plane, two_cameras, usual, without_spots
from scipy.stats import norm

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import SpotResults
from lasercal_gtsam.figures import (
    correlation,
    error_map,
    error_maps,
    image_coverages,
    plane_coverages,
    residual_fields,
    residual_histograms,
    scene,
)
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.figures.residuals import residual_sigmas
from lasercal_gtsam.figures.spots import MOST_SPOTS, rejected_spots
from lasercal_gtsam.opinions.bench import lay_out
from lasercal_gtsam.opinions.split import fit_halves
from lasercal_gtsam.projection import project_points, spot_on_ray
from lasercal_gtsam.simulate import Noise, simulate

# --- residuals ---------------------------------------------------------------------------------


def test_a_residual_is_predicted_minus_seen():
    found = usual()
    (field,) = residual_fields(found)
    seen = found.inputs.observations
    there = lc.project(found.cell, seen.T_base_hand, plane=seen.plane.tolist())
    np.testing.assert_allclose(field.uv + field.residual_px, there[field.shown], atol=1e-9)
    assert field.rms_px == pytest.approx(found.fit.rms_px)
    assert field.total == len(field.shown) == found.fit.n_spots
    assert field.means is None
    # an arrow of typical length is well seen, and none is longer than a fifth of the picture
    lengths = field.magnification * np.linalg.norm(field.residual_px, axis=1)
    assert 10 < np.median(lengths) < lengths.max() < 200


def test_rejected_spots_are_shown_apart():
    found = two_cameras()
    fields = residual_fields(found)
    assert [f.camera for f in fields] == ["left", "right"]
    assert sum(len(f.rejected) for f in fields) == found.fit.n_rejected >= SPOILED - 2
    out = set(np.flatnonzero(rejected_spots(found)).tolist())
    for f in fields:
        assert not out & set(f.shown.tolist())
        assert set(f.rejected.tolist()) <= out
        assert (found.inputs.observations.camera[f.shown] == f.camera).all()


def test_of_many_spots_a_sample_and_means_are_shown():
    many = _many(6000)
    (field,) = residual_fields(many)
    assert field.total == 6000
    assert len(field.shown) == MOST_SPOTS
    assert field.means is not None
    assert field.means.count.sum() == 6000
    # the mean of all residuals is that of the fields, weighed by their spots
    weighed = (field.means.residual_px * field.means.count[:, None]).sum(axis=0) / 6000
    np.testing.assert_allclose(weighed, field.mean_px, atol=1e-12)
    assert field.means.magnification > field.magnification


def _many(count: int) -> lc.Calibration:
    """A calibration with that many spots and made-up residuals."""
    base = usual()
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(base.inputs.observations), count)
    seen = base.inputs.observations[rows]
    spots = SpotResults(
        seen.id, seen.plane, seen.camera, seen.laser, rng.standard_normal((count, 2)),
        np.ones(count), (None,) * count,
    )  # fmt: skip
    return replace(base, spots=spots, inputs=replace(base.inputs, observations=seen))


def test_sigmas_of_residuals_are_those_of_repeated_captures():
    made = simulate("paper", 2)
    rng = np.random.default_rng(5)
    options = lc.CalibrationOptions(robust="none", sigma_px=0.2)
    errors = []
    for _ in range(60):
        uv = made.observations.uv + 0.2 * rng.standard_normal(made.observations.uv.shape)
        seen = replace(made.observations, uv=uv)
        found = lc.calibrate(seen, initial=made.truth, options=options)
        errors.append(found.spots.residual_px)
    sigma = residual_sigmas(lay_out(found)) / found.fit.sigma0
    scatter = np.sqrt(np.mean(np.square(errors), axis=0))
    # 180 standard deviations, each known to 9 %: their ratios scatter by that about one
    ratio = scatter / sigma
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.03)
    assert np.std(ratio) < 0.13
    # the fit takes more of some spots than of others, and this shows
    assert np.corrcoef(scatter.ravel(), sigma.ravel())[0, 1] > 0.4


def test_the_histogram_counts_every_coordinate_and_expects_as_many():
    found = usual()
    (one,) = residual_histograms(found, lay_out(found))
    assert one.coordinates == 180 == one.counts.sum() + one.beyond
    assert one.expected is not None
    assert one.expected_rms_px == pytest.approx(one.rms_px, rel=1e-6)
    # all sigmas are nearly alike here: a normal distribution of the residuals' own size
    low, high = one.edges_px[:-1], one.edges_px[1:]
    plain = 180 * (norm.cdf(high, scale=one.rms_px) - norm.cdf(low, scale=one.rms_px))
    np.testing.assert_allclose(one.expected, plain, atol=0.6)
    chi2 = np.sum((one.counts - one.expected) ** 2 / one.expected)
    assert chi2 < 3 * len(one.counts)
    assert one.curve is not None
    middles = 0.5 * (low + high)
    np.testing.assert_allclose(np.interp(middles, one.curve_px, one.curve), one.expected, atol=0.1)


def test_without_a_bench_nothing_is_expected():
    (one,) = residual_histograms(usual(), None)
    assert one.expected is None
    assert one.curve is None
    assert one.expected_rms_px is None


# --- coverage ----------------------------------------------------------------------------------


def test_every_spot_is_counted_in_its_field():
    found = two_cameras()
    images = image_coverages(found)
    used = ~rejected_spots(found)
    for one in images:
        mine = used & (found.inputs.observations.camera == one.camera)
        assert one.counts.sum() == one.total == mine.sum()
        w, h = one.image_size
        assert one.counts.shape == (12, 16)
        j, i = np.unravel_index(np.argmax(one.counts), one.counts.shape)
        uv = found.inputs.observations.uv[mine]
        box = (np.array([i, j]) * (w / 16, h / 12) - 0.5, np.array([i + 1, j + 1]))
        high = box[1] * (w / 16, h / 12) - 0.5
        assert ((uv >= box[0]) & (uv < high)).all(axis=1).sum() == one.counts[j, i]
        assert 0.0 < one.hull_share < 1.0


def test_on_planes_the_spots_lie_where_the_camera_saw_them():
    found = usual()
    seen = found.inputs.observations
    for one in plane_coverages(found):
        back = project_points(one.axes.to_base(one.xy_mm), found.cell.cameras["camera"])
        np.testing.assert_allclose(back, seen.uv[one.shown], atol=1e-6)
        assert one.total == (seen.plane == one.plane).sum()
        (view,) = one.views
        assert view.share is not None
        assert 0.01 < view.share < 0.5


def test_a_plane_without_spots_is_all_view():
    for one in plane_coverages(without_spots()):
        assert (one.total, len(one.hull_mm), one.hull_cm2) == (0, 0, 0.0)
        assert [view.share for view in one.views] == [0.0]


# --- error maps --------------------------------------------------------------------------------


def test_the_map_is_the_uncertainty_of_located_points():
    found = usual()
    maps = error_maps(found)
    assert [one.plane for one in maps] == ["1", "2", "3"]
    for one in maps:
        j, i = np.argwhere(one.near)[::17].T
        at = one.axes.to_base(np.column_stack([one.x_mm[i], one.y_mm[j]]))
        uv = project_points(at, found.cell.cameras["camera"])
        points, cov = found.locate(uv, plane=one.plane)
        np.testing.assert_allclose(points, at, atol=1e-9)
        error = 1e3 * np.sqrt(np.trace(cov, axis1=1, axis2=2))
        np.testing.assert_allclose(one.error_mm[j, i], error, rtol=1e-9)
        inner = one.error_mm[one.near]
        assert one.median_mm == pytest.approx(np.median(inner))
        assert one.largest_mm == inner.max()
        assert one.outside_mm is not None
        assert one.outside_mm > one.largest_mm  # extrapolation is worse
        assert np.isfinite(one.error_mm[one.seen]).all()
        # the area of a pixel on the plane, by stepping one in the picture
        p, right, below = (
            spot_on_ray(found.cell, uv + step, plane=one.plane)
            for step in np.array([[0, 0], [1, 0], [0, 1]])
        )
        sides = 1e3 * np.sqrt(np.linalg.norm(np.cross(right - p, below - p), axis=1))
        assert one.mm_per_px == pytest.approx(np.median(sides), rel=0.05)


def test_contours_lie_where_the_map_has_their_value():
    found = usual()
    (one, *_) = error_maps(found)
    assert len(one.contours) >= 4
    for contour in one.contours:
        at = np.concatenate(contour.lines)
        uv = project_points(one.axes.to_base(at), found.cell.cameras["camera"])
        w, h = found.cell.cameras["camera"].image_size
        seen = ((uv > 0) & (uv < (w - 1, h - 1))).all(axis=1)
        _, cov = found.locate(uv[seen], plane=one.plane)
        error = 1e3 * np.sqrt(np.trace(cov, axis1=1, axis2=2))
        # linear between nodes of a grid of 41
        np.testing.assert_allclose(error, contour.level_mm, rtol=0.05)


def test_halves_differ_by_what_their_covariances_say():
    """Over ten captures: one draw of a map may be twice as large as expected, the mean not."""
    ratios = []
    for seed in range(10):
        made = simulate("paper", seed, Noise(pixel_px=0.2))
        found = lc.calibrate(made.observations, initial=made.truth)
        for one in error_maps(found, fit_halves(found)):
            assert one.split is not None
            ratios.append(one.split.rms_mm / one.split.expected_rms_mm)
            # half the difference of halves is as large as the error of the whole
            assert one.split.expected_rms_mm == pytest.approx(one.median_mm, rel=0.5)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.25)


def test_maps_of_several_cameras_and_of_none_with_spots():
    maps = error_maps(two_cameras())
    assert {(one.plane, one.camera) for one in maps} == {
        (p, c) for p in "123" for c in ("left", "right")
    }
    for one in error_maps(without_spots()):
        assert one.total == len(one.hull_mm) == 0
        assert (one.near == one.seen).all()
        assert one.outside_mm is None
    assert len(error_maps(one_plane())) == 1
    assert error_maps(no_freedom()) == ()


def test_a_map_that_cannot_be_is_refused_in_words():
    with pytest.raises(lc.DataError, match="plane: the cell has 1, 2, 3; none was named"):
        error_map(usual())
    with pytest.raises(lc.DataError, match=r"camera: .* 'eye' is not among them"):
        error_map(usual(), "1", "eye")
    with pytest.raises(lc.DataError, match="no degrees of freedom"):
        error_map(no_freedom(), no_freedom().inputs.observations.planes[0])
    assert error_map(usual(), "2") == error_maps(usual())[1]


# --- correlation -------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [usual, one_plane, two_cameras, without_spots])
def test_correlation_has_the_tables_own_sigmas(case):
    found = case()
    one = correlation(found)
    rows = {p.name: p for p in found.parameters}
    assert list(one.names) == [p.name for p in found.parameters if p.sigma > 0]
    assert set(one.held) == {p.name for p in found.parameters if p.sigma == 0}
    sigma = [rows[name].sigma for name in one.names]
    np.testing.assert_allclose(np.sqrt(np.diag(one.covariance)), sigma, rtol=1e-9)
    np.testing.assert_allclose(
        one.covariance, one.matrix * np.outer(sigma, sigma), rtol=1e-9, atol=1e-15
    )
    assert list(one.units) == [rows[name].unit for name in one.names]
    values = [abs(value) for _, _, value in one.strong(0.5)]
    assert values == sorted(values, reverse=True)
    assert min(values) >= 0.5


def test_without_sigmas_there_is_no_correlation():
    one = correlation(no_freedom())
    assert one.names == ()
    assert one.matrix.shape == (0, 0)


def test_parts_that_nothing_was_seen_of_have_no_rows():
    found = usual()
    more = found.cell.planes | {"unseen": lc.Plane(np.array([0.0, 0.0, 1.0]), 0.3)}
    wider = replace(found, cell=found.cell.with_planes(more))
    assert list(calibrated_cell(wider).planes) == ["1", "2", "3"]
    assert correlation(wider).names == correlation(found).names
    assert [one.plane for one in error_maps(wider)] == ["1", "2", "3"]


# --- scene -------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [usual, one_plane, two_cameras, without_spots, no_freedom])
def test_the_scene_holds_every_part_in_base_coordinates(case):
    found = case()
    drawn = scene(found)
    names = {layer.name for layer in drawn.layers}
    assert {p.layer for p in drawn.primitives} == names
    for p in drawn.primitives:
        assert np.isfinite(p.points).all()
        assert len(p.points) >= 1
        assert p.points.shape[1] == 3
    polygons = {p.name: p.points for p in drawn.primitives if p.kind == "polygon"}
    assert set(polygons) == set(found.cell.planes)
    for name, corners in polygons.items():
        plane = found.cell.planes[name]
        np.testing.assert_allclose(corners @ plane.normal_base, plane.distance, atol=1e-9)
    labels = {p.text: p.points[0] for p in drawn.primitives if p.kind == "label"}
    for name, camera in found.cell.cameras.items():
        np.testing.assert_allclose(labels[f"camera {name}"], camera.T_base_camera[:3, 3])
    assert np.linalg.norm(drawn.centre) < drawn.radius or "base" not in names


def test_beams_end_at_their_spots():
    found = usual()
    seen = found.inputs.observations
    ends = np.array([p.points[1] for p in scene(found).primitives if p.layer == "beams"])
    at = lc.spot_on_beam(found.cell, seen.T_base_hand, plane=seen.plane.tolist())
    assert len(ends) == len(at)
    assert np.linalg.norm(ends - at, axis=1).max() < 2e-3  # two rays that pass each other


def test_ellipsoids_are_the_covariance_enlarged():
    found = usual()
    drawn = scene(found)
    layers = {layer.name: layer for layer in drawn.layers}
    layer = layers["camera-uncertainty"]
    assert layer.magnification is not None
    assert f"{layer.magnification:g} times" in layer.words
    circles = [p.points for p in drawn.primitives if p.layer == "camera-uncertainty"]
    centre = found.cell.cameras["camera"].T_base_camera[:3, 3]
    off = (np.concatenate(circles) - centre) / layer.magnification
    # the table has the same sigmas by another way: sqrt of the diagonal bounds the ellipsoid
    sigma = np.array([found[name].sigma for name in ("Tx", "Ty", "Tz")]) / 1e3
    assert (np.abs(off).max(axis=0) <= sigma * (1 + 1e-9)).all()
    assert (np.abs(off).max(axis=0) > 0.5 * sigma).all()
    largest = np.linalg.norm(off, axis=1).max() * layer.magnification
    assert 0.02 * drawn.radius < largest < 0.3 * drawn.radius
