"""Any sequence of calls leaves a state that can be read, saved and gone on from."""

from __future__ import annotations

import json

import numpy as np
import pytest
from incremental_cases import seen_in, stream
from test_incremental_alarm import NAMES, moved

import lasercal_gtsam as lc
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.io.plain import to_json
from lasercal_gtsam.simulate import Noise

STEPS = 25


def chosen(rng, **settings):
    """Some of the settings, each with its probability."""
    return {k: value for k, (share, value) in settings.items() if rng.random() < share}


def check(calibrator, update, given):
    assert sorted([*update.accepted, *(r.id for r in update.rejected), *update.held_back]) == given
    assert update.n_used <= update.n_spots == calibrator.n_spots
    assert (update.phase == "collecting") == (update.cell is None)
    assert bool(update.missing) == (update.phase != "running")
    assert update.words
    if update.alarm is not None and not update.alarm.causes:
        assert "what it is cannot be told" in update.alarm.words
    elif update.alarm is not None:
        assert sum(c.probability for c in update.alarm.causes) == pytest.approx(1.0)
    for row in update.parameters:
        assert np.isfinite(row.refined) and not row.sigma < 0
    result = update.calibration
    if result is not None:
        variances = np.diag(result.covariance)
        assert not np.any(variances < 0)
        assert result.fit.n_spots >= 0 and len(result.spots) == len(result.inputs.observations)
        assert json.loads(to_json(result.to_dict()))["format"] == "lasercal-calibration"
        result.table()


def run(seed):
    rng = np.random.default_rng(seed)
    truth, spots = stream(seed=seed % 7, groups=16, noise=Noise(0.3))
    options = lc.CalibrationOptions(
        **chosen(
            rng,
            distortion=(0.7, "none"),
            hand_sigma_m=(0.3, 1e-4),
            known=(0.2, {"aspect": 1.0}),
            robust=(0.1, "none"),
        )
    )
    settings = chosen(
        rng,
        automatic=(0.3, True),
        max_spots=(0.3, int(rng.integers(50, 120))),
        half_life=(0.2, float(rng.integers(20, 200))),
    )
    calibrator, cell = IncrementalCalibrator(options=options, **settings), truth
    calibrator.add(spots[:60] if rng.random() < 0.8 else spots[spots.plane == "1"][:40])
    for _ in range(STEPS):
        what, given = rng.choice(6, p=[0.55, 0.15, 0.1, 0.08, 0.07, 0.05]), []
        kind = str(rng.choice(["camera", "laser", "plane"]))
        if what <= 1:
            picked = spots[rng.integers(0, len(spots), int(rng.choice([1, 1, 2, 5, 17])))]
            new = seen_in(cell, picked, 0.3, rng)
            if what == 1 and len(new):  # a gross outlier among them
                uv = new.uv.copy()
                uv[0] = rng.uniform([0, 0], [639, 479])
                new = lc.Observations.from_arrays(
                    uv, new.T_base_hand, plane=new.plane.tolist(), image_size=(640, 480), id=new.id
                )
            given = sorted(new.id.tolist())
            update = calibrator.add(new)
        elif what == 2:
            cell = moved(cell, kind)
            continue
        elif what == 3:
            names = () if calibrator.cell is None else getattr(calibrator.cell, f"{kind}s")
            if NAMES[kind] not in names:
                continue
            update = calibrator.reset(**{kind: NAMES[kind]})
        elif what == 4:
            update = calibrator.dismiss()
        else:
            result = calibrator.calibration
            if result is None or not np.isfinite(result.covariance).all():
                continue
            calibrator = IncrementalCalibrator(result, **settings)
            update = calibrator.add(spots[:0])
        check(calibrator, update, given)
    assert calibrator.history[-1].spots == calibrator.n_spots or calibrator.cell is None


@pytest.mark.parametrize("seed", range(6))
def test_random_calls(seed):
    run(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6, 100))
def test_many_random_calls(seed):
    run(seed)
