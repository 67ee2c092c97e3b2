"""The contact sheet and the off frame made of on frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detect_cases import PLAIN, ellipse

from lasercal_gtsam.detect import contact_sheet, detect_spot, median_frame
from lasercal_gtsam.errors import DetectionError
from lasercal_gtsam.simulate.render import RenderOptions, make_scene, render_pair


def shots(n, options, size=(160, 120), seed=1):
    rng = np.random.default_rng(seed)
    scene = make_scene(size, options, rng)
    places = rng.uniform((20, 20), (size[0] - 20, size[1] - 20), (n, 2))
    return places, [render_pair(uv, ellipse(2.0, 1.5, 0.3), scene, options, rng) for uv in places]


def test_sheet_has_a_tile_for_every_picture_coloured_by_its_verdict():
    _, pairs = shots(5, PLAIN)
    found = [detect_spot(*pair) for pair in pairs[:4]] + [detect_spot(pairs[4][1], pairs[4][1])]
    assert [d.verdict for d in found] == ["used"] * 4 + ["none"]
    sheet = contact_sheet((on for on, _ in pairs), found, list("abcde"), columns=3, tile=120)
    assert sheet.dtype == np.uint8
    rows = sheet.shape[0] // 2
    assert sheet.shape == (2 * (120 + 30 + 4) + 4, 3 * 124 + 4, 3)
    for k in range(6):
        y, x = (k // 3) * rows + 4, (k % 3) * 124 + 4
        tile = sheet[y : y + 150, x : x + 120].astype(int)
        green = np.count_nonzero((tile[..., 1] - tile[..., 0] > 60) & (tile[..., 1] > 150))
        assert (green > 30) == (k < 4)
        assert (tile.std() > 1) == (k < 5)


def test_cross_marks_the_spot():
    options = replace(PLAIN, ambient_level=0.0)
    places, pairs = shots(1, options)
    found = detect_spot(*pairs[0])
    tile = contact_sheet([pairs[0][0]], [found], tile=160)[4:164, 4:164]
    # the crop is centred on the pixel nearest to the spot; the cross is drawn at the sub-pixel
    side = int(np.clip(16 * found.sigma_major, 32, 160))
    corner = np.rint(places[0]) - side // 2
    expected = (places[0] - corner + 0.5) * 160 / side - 0.5
    coloured = np.abs(tile[..., 1].astype(int) - tile[..., 2]) > 60
    v, u = np.nonzero(coloured[68:93, 68:93])  # the cross; the ellipse is wider
    u, v = u + 68, v + 68
    centre = np.array([(u.min() + u.max()) / 2, (v.min() + v.max()) / 2])
    np.testing.assert_allclose(centre, expected, atol=2.5)


def test_sheet_of_hundreds_streams_and_stays_bounded():
    _, pairs = shots(1, PLAIN)
    found = detect_spot(*pairs[0])
    alive = 0

    def pictures():
        nonlocal alive
        for _ in range(700):
            alive += 1
            yield pairs[0][0]

    sheet = contact_sheet(pictures(), [found] * 700)
    assert alive == 700
    assert max(sheet.shape) <= 6000
    tall = contact_sheet((pairs[0][0] for _ in range(200)), [found] * 200, columns=1)
    assert tall.shape[1] < 200  # smallest tiles; only a silly number of columns exceeds the bound


def test_sheet_takes_colour_sixteen_bits_and_odd_names():
    _, pairs = shots(2, replace(PLAIN, bits=16))
    colour = np.stack([pairs[0][0]] * 3, axis=-1)
    found = [detect_spot(colour, np.stack([pairs[0][1]] * 3, -1)), detect_spot(*pairs[1])]
    sheet = contact_sheet([colour, pairs[1][0]], found, ["spot ä 1", "2"])
    assert sheet.std() > 5
    assert contact_sheet([], []).size > 0


def test_sheet_refuses_what_does_not_match():
    _, pairs = shots(1, PLAIN)
    found = detect_spot(*pairs[0])
    with pytest.raises(DetectionError, match="2 detections but 1 pictures"):
        contact_sheet([pairs[0][0]], [found, found])
    with pytest.raises(DetectionError, match="1 detections but 2 ids"):
        contact_sheet([pairs[0][0]], [found], ["a", "b"])


def test_median_of_on_frames_stands_in_for_the_off_frame():
    options = RenderOptions(highlights=3, ghost_probability=0.0, jitter_px=0.1)
    places, pairs = shots(9, options, size=(320, 240))
    off = median_frame(on for on, _ in pairs)
    assert off.dtype == np.uint8
    found = [detect_spot(on, off) for on, _ in pairs]
    assert sum(d.usable for d in found) >= 8
    for d, uv in zip(found, places, strict=True):
        if d.usable:
            assert np.hypot(*(d.uv - uv)) < 0.6
    # by themselves the same pictures are ambiguous: the highlights look like spots
    assert not any(detect_spot(on).usable for on, _ in pairs)


def test_median_is_the_middle_value_and_refuses_a_mixture():
    stack = [np.full((9, 10, 3), k, dtype=np.uint16) for k in (5, 1, 300)]
    np.testing.assert_array_equal(median_frame(stack), np.full((9, 10, 3), 5))
    with pytest.raises(DetectionError, match="3 pictures or more, got 2"):
        median_frame(stack[:2])
    with pytest.raises(DetectionError, match="picture 2 is uint8"):
        median_frame([*stack[:2], stack[0].astype(np.uint8)])
