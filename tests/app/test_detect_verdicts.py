"""Whole pictures: every one has a verdict, wrong ones are never taken, and bad input is refused."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detect_cases import PLAIN, ellipse, run

from lasercal_gtsam.detect import Detection, DetectionOptions, detect_spot
from lasercal_gtsam.errors import DataError, DetectionError
from lasercal_gtsam.simulate.render import RenderOptions, make_scene, render_pair

FRAME = (640, 480)
ROUGH = RenderOptions(texture=0.1, patches=10, highlights=4, jitter_px=0.1, flicker=0.015)


def picture(uv, options=PLAIN, size=(160, 120), sigma=2.5, seed=1, ratio=1.0):
    rng = np.random.default_rng(seed)
    scene = make_scene(size, options, rng)
    return render_pair(uv, ellipse(sigma, ratio, 0.4), scene, options, rng)


def add_spot(image, uv, sigma, level):
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    spot = level * np.exp(-0.5 * ((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / sigma**2)
    top = np.iinfo(image.dtype).max
    return np.clip(image + spot, 0, top).astype(image.dtype)


# --- whole frames ------------------------------------------------------------------------------


def test_frames_of_a_usual_cell_are_accurate_and_nothing_wrong_is_used():
    outcome = run(RenderOptions(), 40, sigma=(1.3, 4.0), ratio=(1.0, 2.2), size=FRAME, spread=None)
    assert outcome.count("used") + outcome.count("ambiguous") == 40
    assert outcome.count("used") >= 34
    assert outcome.rms < 0.15
    assert outcome.worst < 1.0
    assert outcome.inside95 > 0.85


def test_rough_frames_with_ghosts_are_found_or_flagged():
    options = replace(ROUGH, ghost_probability=0.5, speckle_contrast=0.5, speckle_grain_px=1.8)
    outcome = run(options, 40, sigma=(1.3, 4.0), ratio=(1.0, 2.2), size=FRAME, spread=None)
    assert outcome.used.mean() > 0.75
    assert outcome.worst < 2.0
    assert outcome.count("none") == 0


@pytest.mark.parametrize("jitter", [0.1, 0.3])
def test_no_false_alarm_on_frames_without_a_spot(jitter):
    options = replace(ROUGH, jitter_px=jitter)
    for seed in range(20):
        on, off = picture(None, options, FRAME, seed=seed)
        found = detect_spot(on, off)
        assert found.verdict == "none"
        assert np.isnan(found.uv).all()
        assert "sigma of the background" in found.reason


def test_clipped_highlights_do_not_light_up_when_the_lamp_flickers():
    # they stay at full scale while the rest is matched to the lamp
    options = replace(ROUGH, flicker=0.06, highlights=6)
    for seed in range(20):
        on, off = picture(None, options, FRAME, seed=seed)
        assert np.count_nonzero(off == 255) > 0
        assert detect_spot(on, off).verdict == "none"


def test_a_strong_ghost_is_flagged_and_a_weak_one_is_not():
    options = replace(PLAIN, spot_level=0.4)
    on, off = picture((60.0, 60.0), options)
    strong = detect_spot(add_spot(on, (110, 40), 2.5, 60), off)
    assert strong.verdict == "ambiguous"
    assert not strong.usable
    assert strong.runner_up is not None
    np.testing.assert_allclose(strong.runner_up.uv, (110, 40), atol=1.5)
    assert strong.runner_up.ratio == pytest.approx(0.6, abs=0.1)
    np.testing.assert_allclose(strong.uv, (60, 60), atol=0.1)  # kept, with the reason
    weak = detect_spot(add_spot(on, (110, 40), 2.5, 20), off)
    assert weak.verdict == "used"
    assert weak.runner_up is not None
    assert weak.runner_up.ratio == pytest.approx(0.2, abs=0.06)


def test_two_spots_that_touch_are_flagged():
    on, off = picture((60.0, 60.0), replace(PLAIN, spot_level=0.5))
    for distance in (9.5, 10, 11, 12, 14):
        found = detect_spot(add_spot(on, (60 + distance, 60), 2.5, 110), off)
        assert found.verdict == "ambiguous", (distance, found)


# --- gates -------------------------------------------------------------------------------------


@pytest.mark.parametrize("uv", [(1.0, 60.0), (80.0, 118.5), (158.0, 3.0), (-1.0, 60.0)])
def test_spot_at_the_edge_is_not_used(uv):
    found = detect_spot(*picture(uv))
    assert found.verdict == "edge"
    assert "edge of the picture" in found.reason


def test_region_of_the_plane_is_kept_to():
    on, off = picture((60.0, 60.0))
    around = ((40.0, 40.0), (80.0, 40.0), (80.0, 80.0), (40.0, 80.0))
    beside = tuple((u + 60, v) for u, v in around)
    assert detect_spot(on, off, DetectionOptions(region=around)).usable
    found = detect_spot(on, off, DetectionOptions(region=beside))
    assert found.verdict == "outside"
    assert "(60, 60)" in found.reason


def test_hot_pixel_line_and_large_glow_are_no_spots():
    on, off = picture(None)
    hot = on.copy()
    hot[60, 80] = 250
    assert detect_spot(hot, off).verdict == "too_small"
    line = on.copy()
    cv2.line(line, (30, 30), (120, 90), 200, 2)
    assert detect_spot(line, off).verdict == "elongated"
    glow = add_spot(on, (80, 60), 24, 100)
    found = detect_spot(glow, off)
    assert found.verdict == "too_large"
    np.testing.assert_allclose(found.uv, (80, 60), atol=3)
    raised = detect_spot(glow, off, DetectionOptions(max_area_px=100_000))
    assert raised.verdict == "used"
    np.testing.assert_allclose(raised.uv, (80, 60), atol=0.5)


def test_hopelessly_saturated_spot_is_not_used():
    on, off = picture((80.0, 60.0))
    burnt = on.copy()
    cv2.circle(burnt, (80, 60), 9, 255, -1)
    found = detect_spot(burnt, off)
    assert found.verdict == "saturated"
    assert found.n_saturated == pytest.approx(np.pi * 9**2, rel=0.15)
    assert "expose less" in found.reason


def test_weak_and_uncertain_spots_can_be_refused():
    on, off = picture((80.0, 60.0), replace(PLAIN, spot_level=0.1))
    found = detect_spot(on, off)
    assert found.usable
    assert 15 < found.snr < 60
    assert detect_spot(on, off, DetectionOptions(min_snr=100.0)).verdict == "weak"
    assert detect_spot(on, off, DetectionOptions(max_sigma_px=0.01)).verdict == "uncertain"


def test_floor_is_added_to_the_covariance():
    on, off = picture((80.0, 60.0))
    plain = detect_spot(on, off, DetectionOptions(floor_px=0.0))
    raised = detect_spot(on, off, DetectionOptions(floor_px=0.3))
    np.testing.assert_allclose(raised.cov_uv - plain.cov_uv, 0.09 * np.eye(2), atol=1e-12)


# --- kinds of pictures -------------------------------------------------------------------------


def test_depth_makes_no_difference():
    uv = (80.3, 60.2)
    eight = detect_spot(*picture(uv))
    sixteen = detect_spot(*picture(uv, replace(PLAIN, bits=16)))
    on, off = picture(uv, replace(PLAIN, bits=16))
    floating = detect_spot(on / 65535.0, off / 65535.0)
    for found in (eight, sixteen, floating):
        assert found.usable
        np.testing.assert_allclose(found.uv, uv, atol=0.05)
    np.testing.assert_allclose(floating.uv, sixteen.uv, atol=1e-3)
    assert sixteen.peak == pytest.approx(257 * eight.peak, rel=0.02)


def test_saturation_of_a_12_bit_camera_in_a_16_bit_file_is_noticed():
    options = replace(PLAIN, bits=16, saturation_dn=4095, spot_level=3.0)
    on, off = picture((80.0, 60.0), options)
    clipped = int(np.count_nonzero(on == 4095))
    assert detect_spot(on, off).n_saturated == clipped > 20
    assert detect_spot(on, off, DetectionOptions(saturation_level=4095)).n_saturated == clipped
    assert detect_spot(on, off, DetectionOptions(saturation_level=60000)).n_saturated == 0


def test_colour_takes_the_brightest_channel_that_does_not_clip():
    uv = (80.3, 60.2)
    pairs = [
        picture(uv, replace(PLAIN, spot_level=level), seed=k)
        for k, level in enumerate((0.02, 0.3, 0.6))
    ]
    on, off = (np.stack(x, axis=-1) for x in zip(*pairs, strict=True))
    assert detect_spot(on, off).channel == "red"
    burnt = np.stack(
        [*(p[0] for p in pairs[:2]), picture(uv, replace(PLAIN, spot_level=4.0))[0]], -1
    )
    found = detect_spot(burnt, off)
    assert found.channel == "green"
    assert found.n_saturated == 0
    np.testing.assert_allclose(found.uv, uv, atol=0.1)
    # a channel that shows next to nothing is no way out of clipping
    dim = burnt.copy()
    dim[..., 1] = dim[..., 0]
    assert detect_spot(dim, off).channel == "red"
    for channel in ("blue", "green", "red", "gray"):
        assert detect_spot(on, off, DetectionOptions(channel=channel)).channel == channel
    with_alpha = np.concatenate([on, np.full_like(on[..., :1], 255)], axis=-1)
    assert detect_spot(with_alpha, np.concatenate([off, off[..., :1]], -1)) == detect_spot(on, off)


def test_without_an_off_frame_one_spot_on_a_blank_wall_is_used_and_any_rival_flagged():
    on, _ = picture((80.0, 60.0), replace(PLAIN, ambient_gradient=0.3), size=(320, 240))
    found = detect_spot(on)
    assert found.usable
    assert found.single_frame
    np.testing.assert_allclose(found.uv, (80, 60), atol=0.1)
    rival = detect_spot(add_spot(on, (200, 150), 2.5, 30))
    assert rival.verdict == "ambiguous"


def test_without_off_frames_decoys_are_not_used():
    options = RenderOptions(highlights=4, ghost_probability=0.5)
    outcome = run(options, 20, sigma=(1.3, 4.0), size=FRAME, spread=None, off=False)
    assert outcome.used.sum() == 0 or outcome.worst < 2.0
    assert outcome.count("ambiguous") >= 15


def test_swapped_frames_are_recognised():
    on, off = picture((80.0, 60.0))
    found = detect_spot(off, on)
    assert found.verdict == "none"
    assert "are on and off swapped?" in found.reason
    assert "(80, 60)" in found.reason


def test_same_pictures_same_answer_and_pictures_are_left_alone():
    on, off = picture((80.0, 60.0), RenderOptions())
    before = on.copy(), off.copy()
    assert detect_spot(on, off) == detect_spot(on, off)
    np.testing.assert_array_equal((on, off), before)


# --- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("on", "off", "message"),
    [
        (None, None, "expected an array, got NoneType"),
        (np.zeros((20, 20), dtype=np.int32), None, "expected uint8, uint16, float32 or float64"),
        (np.zeros((20, 20, 2), dtype=np.uint8), None, r"expected \(height, width\)"),
        (np.zeros((5, 20), dtype=np.uint8), None, "8 x 8 pixels or more, got 20 x 5"),
        (np.full((20, 20), np.nan), None, "400 pixels are not finite"),
        (
            np.zeros((20, 20), dtype=np.uint8),
            np.zeros((20, 24), dtype=np.uint8),
            "off frame: expected the same size and depth .*20 x 20 uint8 mono.*, got 24 x 20",
        ),
        (
            np.zeros((20, 20), dtype=np.uint8),
            np.zeros((20, 20), dtype=np.uint16),
            "off frame: expected the same size and depth",
        ),
    ],
)
def test_what_is_no_picture_is_refused(on, off, message):
    with pytest.raises(DetectionError, match=message):
        detect_spot(on, off)


@pytest.mark.parametrize("value", [0, 7, 255])
def test_blank_pictures_hold_nothing(value):
    blank = np.full((64, 64), value, dtype=np.uint8)
    assert detect_spot(blank, blank).verdict == "none"
    assert detect_spot(blank).verdict == "none"


def test_smallest_picture_and_noise_free_spot_are_survived():
    for size in ((8, 8), (9, 30), (40, 17)):
        for level in (0, 200):
            image = add_spot(np.zeros(size[::-1], dtype=np.uint8), (4, 4), 1.0, level)
            found = detect_spot(image, np.zeros_like(image))
            assert isinstance(found, Detection)


def test_bad_options_are_refused_all_at_once():
    with pytest.raises(DataError) as caught:
        DetectionOptions(channel="infrared", min_snr=-1.0, region=((0.0, 0.0), (1.0, 1.0)))
    assert len(caught.value.problems) == 3
    with pytest.raises(DataError, match="verdict: expected one of used, none"):
        Detection("perhaps", "", np.zeros(2), np.eye(2))  # type: ignore[arg-type]
