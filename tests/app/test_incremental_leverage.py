"""Leverages of a running calibration are those of the batch solution."""

from __future__ import annotations

import numpy as np
import pytest
from incremental_cases import PLAIN, batch_of, feed, stream

import lasercal_gtsam as lc
from lasercal_gtsam.incremental import IncrementalCalibrator, result
from lasercal_gtsam.simulate import Noise

HAND = Noise(0.3, 1e-3, float(np.deg2rad(0.05)))
HAND_STATED = {"hand_sigma_m": HAND.hand_translation_m, "hand_sigma_rad": HAND.hand_rotation_rad}


def spoiled(spots, rows):
    """The same with some spots far from where they belong."""
    uv = spots.uv.copy()
    uv[rows] = 639.0 - uv[rows]
    names = {k: getattr(spots, k).tolist() for k in ("camera", "laser", "plane")}
    return lc.Observations.from_arrays(
        uv, spots.T_base_hand, **names, image_size=(640, 480), id=spots.id.tolist()
    )


@pytest.mark.parametrize(
    ("noise", "options", "relative"),
    [
        (Noise(0.3), {}, 0.0),
        (HAND, {"sigma_px": 0.3, **HAND_STATED}, 0.0),
        (Noise(0.3), {"known": {"aspect": 1.0, "skew": 0.0}}, 0.0),
        # the batch weighs priors by the residual scale, which it finds to half a percent
        (Noise(0.3), {"priors": {"fu": (551.0, 0.5)}}, 0.01),
    ],
    ids=["plain", "hand noise", "tied", "prior"],
)
def test_equal_those_of_the_batch_optimum(noise, options, relative):
    _, spots = stream(noise=noise)
    bad = [7, 100, 101]
    batch = lc.calibrate(
        spoiled(spots, bad), options=lc.CalibrationOptions(distortion="none", **options)
    )
    leverage = IncrementalCalibrator(batch).calibration.spots.leverage
    np.testing.assert_allclose(leverage, batch.spots.leverage, rtol=relative, atol=1e-6)
    assert not leverage[bad].any()
    good = np.delete(leverage, bad)
    assert 0 < good.min() < good.max() < 2


def test_stay_with_the_batch_s_as_spots_and_planes_come(monkeypatch):
    _, spots = stream()
    # the planes come in another order than the batch has them in, and not with every piece
    spots = spots[np.argsort(spots.plane != "3", kind="stable")]
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots[:60])
    update = feed(calibrator, spots[60:], step=7)[-1]
    batch = batch_of(spots, update)
    leverage = update.calibration.spots.leverage
    np.testing.assert_allclose(leverage, batch.spots.leverage, rtol=5e-3, atol=1e-6)
    monkeypatch.setattr(result, "_TOGETHER", 5)
    again = calibrator.add(spots[:0]).calibration.spots.leverage
    np.testing.assert_allclose(again, leverage, rtol=1e-9)


def test_spots_beside_older_ones_have_the_leverage_they_have_among_all():
    _, spots = stream(groups=20)
    calibrator = IncrementalCalibrator(options=PLAIN, max_spots=100)
    calibrator.add(spots[:60])
    update = feed(calibrator, spots[60:])[-1]
    kept = update.calibration.spots
    batch = batch_of(spots, update)
    among_all = {spot.id: spot.leverage for spot in batch.spots}
    np.testing.assert_allclose(
        kept.leverage, [among_all[name] for name in kept.id.tolist()], rtol=0.02, atol=1e-6
    )
    assert kept.leverage.sum() < 0.3 * batch.spots.leverage.sum()


def test_a_spot_that_has_faded_has_less():
    _, spots = stream(groups=8)
    calibrator = IncrementalCalibrator(options=PLAIN, half_life=50)
    calibrator.add(spots[:60])
    update = feed(calibrator, spots[60:])[-1]
    leverage = update.calibration.spots.leverage
    # nothing was let go: what is known, the spots that are stored have determined
    assert len(leverage) == len(spots)
    assert leverage.sum() == pytest.approx(24.0, abs=0.01)
    old, new = leverage[:50], leverage[-50:]
    ages = len(spots) - np.arange(len(spots))
    assert old.mean() / new.mean() == pytest.approx(
        np.mean(0.5 ** (ages[:50] / 50)) / np.mean(0.5 ** (ages[-50:] / 50)), rel=0.5
    )


def test_a_spot_held_back_has_none():
    _, spots = stream()
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots[spots.plane == "1"])
    update = calibrator.add(spots[spots.plane == "2"][:1])
    (waits,) = update.held_back
    leverage = {spot.id: spot.leverage for spot in update.calibration.spots}
    assert leverage.pop(waits) == 0.0
    assert min(leverage.values()) > 0
