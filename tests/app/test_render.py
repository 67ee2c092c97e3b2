"""Rendered pictures: the spot is where and as large as asked, and the camera's noise is right."""

from __future__ import annotations

import numpy as np
import pytest

from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate.render import (
    RenderOptions,
    Scene,
    make_scene,
    render_pair,
    spot_shape,
)

# a camera without noise, in a dark room, looking at a blank wall
CLEAN = {
    "bits": 16,
    "spot_level": 0.5,
    "speckle_contrast": 0.0,
    "psf_sigma_px": 0.8,
    "skirt_fraction": 0.0,
    "ambient_level": 0.0,
    "texture": 0.0,
    "patches": 0,
    "highlights": 0,
    "ghost_probability": 0.0,
    "flicker": 0.0,
    "jitter_px": 0.0,
    "full_well_e": 1e12,
    "read_noise_e": 0.0,
    "prnu": 0.0,
}
SHAPE = np.array([[9.0, 3.0], [3.0, 5.0]])


def clean(**changed: object) -> RenderOptions:
    return RenderOptions(**{**CLEAN, **changed})  # type: ignore[arg-type]


def take(uv, shape, options, size=(96, 80), seed=1):
    rng = np.random.default_rng(seed)
    return render_pair(uv, shape, make_scene(size, options, rng), options, rng)


def moments(image):
    light = image.astype(np.float64)
    v, u = np.mgrid[: light.shape[0], : light.shape[1]]
    total = light.sum()
    mean = np.array([(light * u).sum(), (light * v).sum()]) / total
    du, dv = u - mean[0], v - mean[1]
    second = [[du * du, du * dv], [du * dv, dv * dv]]
    return total, mean, np.array([[(light * x).sum() / total for x in row] for row in second])


@pytest.mark.parametrize("shape", [SHAPE, 0.3 * np.eye(2), np.diag([40.0, 1.0])])
@pytest.mark.parametrize("uv", [(48.0, 40.0), (47.31, 39.77)])
def test_spot_lies_where_it_was_asked_for_with_its_shape_lens_and_pixel(uv, shape):
    on, off = take(uv, shape, clean())
    total, mean, second = moments(on)
    np.testing.assert_allclose(mean, uv, atol=2e-3)
    # variances add: beam, lens, and the square pixel's 1/12
    np.testing.assert_allclose(second, shape + (0.8**2 + 1 / 12) * np.eye(2), atol=0.05)
    # the flux of a Gaussian of the asked peak
    expected = 0.5 * 65535 * 2 * np.pi * np.sqrt(np.linalg.det(shape))
    assert total == pytest.approx(expected, rel=2e-3)
    assert off.max() == 0


def test_spot_is_cut_by_the_edge_and_gone_beyond_it():
    inside = take((20.0, 20.0), SHAPE, clean())[0]
    cut = take((0.0, 20.0), SHAPE, clean())[0]
    np.testing.assert_allclose(inside[:, 20:40].astype(int), cut[:, :20], atol=1)
    assert take((-50.0, 20.0), SHAPE, clean())[0].max() == 0
    assert take(None, SHAPE, clean())[0].max() == 0


def test_skirt_takes_its_share_and_moves_the_centroid_along_the_major_axis():
    options = clean(skirt_fraction=0.2, skirt_scale=2.0, skirt_shift=1.5)
    uv = np.array([60.0, 60.0])
    total, mean, _ = moments(take(uv, SHAPE, options, (120, 120))[0])
    plain, _, _ = moments(take(uv, SHAPE, clean(), (120, 120))[0])
    assert total == pytest.approx(plain, rel=5e-3)
    variances, axes = np.linalg.eigh(SHAPE)
    moved = 0.2 * 1.5 * np.sqrt(variances[1])
    assert np.abs((mean - uv) @ axes[:, 1]) == pytest.approx(moved, rel=0.01)
    assert (mean - uv) @ axes[:, 0] == pytest.approx(0, abs=5e-3)


def test_speckle_has_its_contrast_and_grain():
    contrast, grain = 0.4, 2.5
    options = clean(speckle_contrast=contrast, speckle_grain_px=grain, psf_sigma_px=0.0)
    uv, shape = (100.0, 100.0), 500.0 * np.eye(2)
    on = take(uv, shape, options, (200, 200))[0].astype(np.float64)
    steady = take(uv, shape, clean(psf_sigma_px=0.0), (200, 200))[0].astype(np.float64)
    part = (slice(70, 130), slice(70, 130))
    ratio = on[part] / steady[part]
    assert ratio.mean() == pytest.approx(1, abs=0.05)
    # a pixel averages over a part of a grain: 0.4 becomes a little less
    assert 0.33 < ratio.std() < 0.42
    lag = ((ratio[:, 1:] - 1) * (ratio[:, :-1] - 1)).mean() / ratio.var()
    area = np.pi / -np.log(lag)
    assert area == pytest.approx(1.2 * grain**2, rel=0.25)


def test_centroid_scatter_of_speckle_follows_the_grain_area():
    # a speckled spot's plain centroid scatters by C sqrt(A / (8 pi)), whatever the spot's size
    contrast, grain = 0.5, 1.5
    options = clean(speckle_contrast=contrast, speckle_grain_px=grain, psf_sigma_px=0.0)
    rng = np.random.default_rng(3)
    scene = make_scene((48, 48), options, rng)
    uv = np.array([24.2, 23.9])
    errors = [
        moments(render_pair(uv, 9.0 * np.eye(2), scene, options, rng)[0])[1] - uv
        for _ in range(150)
    ]
    expected = contrast * np.sqrt(1.2 * grain**2 / (8 * np.pi))
    assert np.std(errors) == pytest.approx(expected, rel=0.15)


def test_same_seed_same_pictures_and_new_speckle_for_each():
    options = RenderOptions()
    first = take((40.0, 40.0), SHAPE, options)
    np.testing.assert_array_equal(first, take((40.0, 40.0), SHAPE, options))
    rng = np.random.default_rng(1)
    scene = make_scene((96, 80), options, rng)
    one = render_pair((40.0, 40.0), SHAPE, scene, options, rng)[0]
    two = render_pair((40.0, 40.0), SHAPE, scene, options, rng)[0]
    assert np.abs(one.astype(int) - two)[35:45, 35:45].max() > 10


def test_ambient_and_laser_meet_the_same_albedo():
    options = clean(ambient_level=0.2, psf_sigma_px=0.0, spot_level=0.3)
    scene = make_scene((96, 80), options, np.random.default_rng(1))
    stripes = np.where(np.arange(96) % 2 == 0, 0.5, 1.5).astype(np.float32)
    albedo = np.broadcast_to(stripes, (80, 96))
    striped = Scene(albedo, scene.ambient * albedo, scene.gain)
    uv, shape = (48.0, 40.0), 100.0 * np.eye(2)
    on, off = render_pair(uv, shape, striped, options, np.random.default_rng(2))
    blank_on, blank_off = render_pair(uv, shape, scene, options, np.random.default_rng(2))
    part = (slice(30, 50), slice(38, 58))
    spot = (on.astype(float) - off)[part] / (blank_on.astype(float) - blank_off)[part]
    np.testing.assert_allclose(spot, albedo[part], rtol=0.01)


def test_ghost_is_in_the_on_frame_only_and_highlights_in_both():
    options = clean(ghost_probability=1.0, ghost_level=(0.5, 0.5), highlights=1)
    on, off = take((200.0, 200.0), 2.0 * np.eye(2), options, (400, 400))
    difference = on.astype(float) - off
    highlight = np.unravel_index(np.argmax(off), off.shape)
    assert off[highlight] > 0.2 * 65535
    assert abs(difference[highlight]) < 1e-3 * 65535
    difference[190:211, 190:211] = 0  # the spot itself
    assert 0.3 * 0.5 < difference.max() / 65535 < 1.02 * 0.25  # the lens takes some of the peak


def test_jitter_moves_the_off_frame_and_flicker_dims_it():
    options = clean(ambient_level=0.3, texture=0.1, jitter_px=0.5)
    on, off = (x.astype(float) for x in take(None, SHAPE, options, (200, 200), seed=5))
    part = (slice(2, -2), slice(2, -2))
    gv, gu = np.gradient(on)
    A = np.stack([gu[part].ravel(), gv[part].ravel()], axis=1)
    shift, *_ = np.linalg.lstsq(A, (on - off)[part].ravel(), rcond=None)
    left = (on - off)[part].ravel() - A @ shift
    assert np.hypot(*shift) > 0.1
    assert left.std() < 0.5 * (on - off)[part].std()
    on, off = take(None, SHAPE, clean(ambient_level=0.3, flicker=0.05), (64, 64), seed=5)
    ratio = off.astype(float) / on
    assert ratio.std() < 1e-3
    assert 0.001 < abs(ratio.mean() - 1) < 0.2


@pytest.mark.parametrize(("bits", "dn"), [(8, None), (16, None), (16, 4095)])
def test_noise_and_saturation_of_the_sensor(bits, dn):
    options = clean(
        bits=bits,
        saturation_dn=dn,
        ambient_level=0.5,
        ambient_gradient=0.0,
        full_well_e=2000.0,
        read_noise_e=10.0,
        spot_level=50.0,
    )
    full = (2**bits - 1) if dn is None else dn
    on, off = take((48.0, 40.0), SHAPE, options)
    assert on.dtype == off.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert on.max() == full
    # half full scale is 1000 electrons: shot noise and read noise in quadrature, then rounding
    expected = np.sqrt(((1000 + 100) * (full / 2000) ** 2) + 1 / 12)
    assert off.std() == pytest.approx(expected, rel=0.05)
    assert off.mean() == pytest.approx(full / 2, rel=0.005)


def test_options_say_what_is_wrong_with_all_of_them():
    with pytest.raises(DataError) as caught:
        RenderOptions(bits=12, spot_level=0.0, speckle_contrast=1.5, jitter_px=-1.0)
    assert len(caught.value.problems) == 4
    assert "RenderOptions.bits: expected 8 or 16, got 12" in caught.value.problems
    with pytest.raises(DataError, match=r"saturation_dn: expected 1 to 255 with 8 bits, got 4095"):
        RenderOptions(saturation_dn=4095)
    with pytest.raises(DataError, match="two finite pixels"):
        take((np.nan, 1.0), SHAPE, clean())
    with pytest.raises(DataError, match="positive definite"):
        take((10.0, 10.0), np.zeros((2, 2)), clean())


# --- the spot's shape from the cell ------------------------------------------------------------

FOCAL, DEPTH, RADIUS = 800.0, 0.5, 0.002


def cell_looking_down(tilt: float) -> Cell:
    """Camera at the base origin looking along z at a plane at `DEPTH` turned about its x axis."""
    camera = Camera(Intrinsics(FOCAL, FOCAL, 0.0, 320.0, 240.0), np.eye(4), (640, 480))
    normal = rotation_exp(np.array([tilt, 0.0, 0.0])) @ np.array([0.0, 0.0, 1.0])
    return Cell(
        {"camera": camera},
        {"laser": Beam(np.array([0.0, 0.0, 1.0]), np.zeros(3))},
        {"plane": Plane.from_point(normal, np.array([0.0, 0.0, DEPTH]))},
    )


def test_shape_of_a_beam_along_the_optical_axis_ignores_the_planes_tilt():
    # the camera sees the beam end on: however oblique the plane, it projects as a circle, but for
    # the depth that changes along the tilt (second order in the beam's radius)
    hand = make_pose(np.eye(3), np.array([0.0, 0.0, 0.1]))
    sigma = 0.5 * RADIUS * FOCAL / DEPTH
    for tilt in (0.0, 0.7):
        shape = spot_shape(cell_looking_down(tilt), hand, "plane", "camera", "laser", RADIUS)
        assert shape.shape == (1, 2, 2)
        np.testing.assert_allclose(shape[0], sigma**2 * np.eye(2), rtol=1e-5, atol=1e-6)


def test_shape_of_an_oblique_beam_is_stretched_by_its_incidence():
    angle = 1.0
    turn = rotation_exp(np.array([0.0, angle, 0.0]))  # the beam leans in the x-z plane
    hand = make_pose(turn, np.array([0.0, 0.0, DEPTH]) - 0.2 * turn[:, 2])
    shape = spot_shape(cell_looking_down(0.0), hand, "plane", None, None, RADIUS)[0]
    sigma = 0.5 * RADIUS * FOCAL / DEPTH
    np.testing.assert_allclose(
        shape, sigma**2 * np.diag([1 / np.cos(angle) ** 2, 1.0]), rtol=1e-5, atol=1e-6
    )


def test_shape_is_nan_where_the_spot_is_not_seen_and_scales_with_the_radius():
    away = make_pose(rotation_exp(np.array([np.pi, 0.0, 0.0])), np.array([0.0, 0.0, 0.1]))
    hand = make_pose(np.eye(3), np.array([0.02, 0.01, 0.1]))
    poses = np.stack([away, hand])
    cell = cell_looking_down(0.4)
    shape = spot_shape(cell, poses, None, None, None, RADIUS)
    assert np.isnan(shape[0]).all()
    double = spot_shape(cell, poses, None, None, None, 2 * RADIUS)
    np.testing.assert_allclose(double[1], 4 * shape[1], rtol=1e-6)
    with pytest.raises(DataError, match="beam_radius_m"):
        spot_shape(cell, poses, None, None, None, 0.0)
