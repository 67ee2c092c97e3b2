"""The running estimate is that of the batch problem, in every setting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from incremental_cases import (
    PLAIN,
    batch_of,
    feed,
    seen_in,
    shuffled,
    sigmas_between,
    stream,
)

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Beam, Camera, Cell, Intrinsics
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.io.conventions import columns_from_rotations, rotations_from_columns
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.simulate import Noise, simulate

HAND = Noise(0.3, 1e-3, float(np.deg2rad(0.05)))
HAND_STATED = {"hand_sigma_m": HAND.hand_translation_m, "hand_sigma_rad": HAND.hand_rotation_rad}


def agrees(calibrator, observations, options, sigmas=0.01):
    """Estimate, sigmas and account are those of the batch solution."""
    update = calibrator.add(observations[:0])
    batch, result = batch_of(observations, update, options), update.calibration
    assert sigmas_between(update.cell, batch) < sigmas
    for row in batch.parameters:
        assert result[row.name].sigma == pytest.approx(row.sigma, rel=0.01), row.name
    assert result.fit.sigma0 == pytest.approx(batch.fit.sigma0, rel=0.005)
    assert result.fit.rms_px == pytest.approx(batch.fit.rms_px, rel=1e-3)
    assert result.fit.n_spots == batch.fit.n_spots
    assert result.fit.dof == pytest.approx(batch.fit.dof, abs=0.01)
    assert result.fit.converged and not result.fit.status.startswith("not")
    assert [w.words[:12] for w in result.observability.weak] == [
        w.words[:12] for w in batch.observability.weak
    ]
    assert [r is None for r in result.spots.rejected] == [r is None for r in batch.spots.rejected]
    return batch, result


@pytest.mark.parametrize(
    ("preset", "noise", "options"),
    [
        ("paper", Noise(0.3), {"distortion": "none"}),
        ("paper-distorted", Noise(0.3), {}),
        ("paper", HAND, {"distortion": "none", "sigma_px": 0.3, **HAND_STATED}),
        ("table2-1", Noise(1.0), {}),
        ("paper", Noise(0.3), {"distortion": "none", "known": {"aspect": 1.0, "skew": 0.0}}),
        ("paper", Noise(0.3), {"distortion": "none", "priors": {"fu": (551.0, 0.5)}}),
    ],
    ids=["plain", "distortion", "hand noise", "one plane", "tied", "prior"],
)  # fmt: skip
def test_equals_the_batch_solution(preset, noise, options):
    _, spots = stream(preset, noise=noise)
    options = lc.CalibrationOptions(**options)
    calibrator = IncrementalCalibrator(options=options)
    calibrator.add(spots[:60])
    feed(calibrator, spots[60:], step=5)
    agrees(calibrator, spots, options)


def test_a_pixel_sigma_found_again_counts_for_the_spots_before_it_too():
    _, spots = stream(noise=HAND)
    options = lc.CalibrationOptions(distortion="none", **HAND_STATED)
    calibrator = IncrementalCalibrator(options=options)
    calibrator.add(spots[:60])
    feed(calibrator, spots[60:], step=20)
    found = [e.words for e in calibrator.events if "their noise is" in e.words]
    assert len(found) > 2
    sigma_px = float(found[-1].split()[-2])
    stated = batch_of(spots, calibrator.add(spots[:0]), replace(options, sigma_px=sigma_px))
    assert sigmas_between(calibrator.cell, stated) < 0.01


def test_agrees_at_every_update_from_the_start_on():
    _, spots = stream(groups=5)
    calibrator = IncrementalCalibrator(options=PLAIN)
    for k, update in enumerate(feed(calibrator, spots[:100]), start=1):
        assert update.n_spots == k
        if update.phase == "running" and k > 40:
            batch = batch_of(spots[:k], update)
            if batch.fit.n_rejected == k - update.n_used:
                assert sigmas_between(update.cell, batch) < 0.02, k
    assert update.phase == "running"


def test_background_passes_keep_up_with_the_batch_solution():
    _, spots = stream(groups=60, noise=Noise(1.0))
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots[:40])
    worst = 0.0
    for k in range(40, len(spots), 8):
        update = calibrator.add(spots[k : k + 8])
        if k > 1000 and k % 200 == 0:
            worst = max(worst, sigmas_between(update.cell, batch_of(spots[: k + 8], update)))
    assert 0 < worst < 0.02


def test_one_at_a_time_or_all_at_once_is_the_same_estimate():
    _, spots = stream()
    one, all_at_once = (IncrementalCalibrator(options=PLAIN) for _ in range(2))
    for calibrator in (one, all_at_once):
        calibrator.add(spots[:60])
    feed(one, spots[60:])
    all_at_once.add(spots[60:])
    batch = batch_of(spots, one.add(spots[:0]))
    assert sigmas_between(one.cell, batch) < 0.01
    assert sigmas_between(all_at_once.cell, batch) < 0.01


def test_the_same_calls_give_the_same_digits():
    _, spots = stream(groups=5)
    cells = []
    for _ in range(2):
        calibrator = IncrementalCalibrator(options=PLAIN)
        calibrator.add(spots[:30])
        feed(calibrator, spots[30:], step=3)
        cells.append(calibrator.calibration)
    assert cells[0] == cells[1]


def test_says_what_is_missing_until_it_can_begin():
    _, spots = stream(groups=4)
    calibrator = IncrementalCalibrator(options=PLAIN)
    update = calibrator.add(spots[:5])
    assert update.phase == "collecting" and update.cell is None and update.calibration is None
    assert update.parameters == () and np.isnan(update.innovation.chi2).all()
    (missing,) = update.missing
    assert (missing.part, missing.have) == ("cell", 5) and missing.need >= 15
    assert "5 so far" in missing.words and missing.words in update.words
    assert update.held_back == tuple(spots.id[:5])
    with pytest.raises(lc.DegenerateError, match="no estimate yet"):
        calibrator.reset(camera="camera")
    update = calibrator.add(spots[5:])
    assert update.phase == "running" and not update.missing
    assert [e.kind for e in update.events] == ["started"]


def test_one_hand_orientation_is_named_while_collecting():
    simulation = simulate("paper-1", 2, noise=Noise(0.3), groups=1, shots=20)
    update = IncrementalCalibrator(options=PLAIN).add(simulation.observations)
    assert update.phase == "collecting"
    assert "orientation" in update.missing[0].words


def test_the_innovation_has_the_covariance_it_says():
    """Whitened innovations of good spots are standard normal: chi-square with 2 degrees."""
    chi2 = []
    for seed in range(6):
        _, spots = stream(seed=seed, groups=6, noise=Noise(0.5))
        calibrator = IncrementalCalibrator(options=PLAIN)
        calibrator.add(spots[:60])
        chi2 += [u.innovation.chi2[0] for u in feed(calibrator, spots[60:])]
    # mean 2, standard deviation of the mean 2 / sqrt(n); a little more for the unknown scale
    assert np.mean(chi2) == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(chi2)))
    assert np.mean(np.array(chi2) > 5.99) == pytest.approx(0.05, abs=0.03)


def test_a_gross_outlier_is_left_out_named_and_accounted_for():
    _, spots = stream()
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots[:100])
    before = calibrator.cell
    uv = spots.uv[100] + [40.0, -25.0]
    bad = lc.Observations.from_arrays(
        [uv], spots.T_base_hand[100:101], plane=spots.plane[100:101].tolist(),
        image_size=(640, 480), id=["bad"],
    )  # fmt: skip
    update = calibrator.add(bad)
    (rejection,) = update.rejected
    assert rejection.id == "bad" and "sigma from where it was expected" in rejection.reason
    assert update.alarm is None and not update.accepted
    assert np.hypot(*update.innovation.residual_px[0]) == pytest.approx(np.hypot(40, 25), rel=0.1)
    assert np.allclose(
        calibrator.cell.cameras["camera"].T_base_camera, before.cameras["camera"].T_base_camera
    )
    account = {s.id: s.rejected for s in update.calibration.spots}
    assert account["bad"] is not None and sum(r is not None for r in account.values()) == 1


def test_spots_that_count_but_cannot_be_make_an_answer_that_is_not_trusted():
    """New hand poses read in a wrong way; the stated noise of the robot makes room for them."""
    noise = Noise.table1()
    made = simulate("paper-1", 0, noise, groups=3, shots=4)
    hand = {"hand_sigma_m": 1e-3, "hand_sigma_rad": noise.hand_rotation_rad, "sigma_px": 1.0}
    options = lc.CalibrationOptions(**hand, distortion="none", robust="none")
    first = lc.calibrate(made.observations, initial=made.truth, options=options)
    T = made.observations.T_base_hand[:4].copy()
    quat = columns_from_rotations("quat_wxyz", T[:, :3, :3]) * np.array([-1.0, 1.0, 1.0, 1.0])
    T[:, :3, :3] = rotations_from_columns("quat_wxyz", quat)
    seen = replace(made.observations[:4], T_base_hand=T, id=np.array(list("abcd")))
    running = IncrementalCalibrator(first)
    running.add(seen)
    answer = running.calibration
    counted = np.array([spot.residual_px for spot in answer.spots if spot.rejected is None])
    impossible = int(np.isnan(counted[:, 0]).sum())
    assert impossible > 0
    assert not answer.fit.converged
    assert f"{impossible} of {len(counted)} spots that count cannot be" in answer.fit.status
    assert np.isfinite(answer.fit.rms_px)


def test_ten_percent_outliers_do_not_move_it():
    rng = np.random.default_rng(3)
    _, spots = stream(groups=45, noise=Noise(1.0))
    bad = rng.random(len(spots)) < 0.1
    uv = np.where(bad[:, None], rng.uniform([0, 0], [639, 479], spots.uv.shape), spots.uv)
    dirty = lc.Observations.from_arrays(
        uv, spots.T_base_hand, plane=spots.plane.tolist(), image_size=(640, 480)
    )
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(dirty[:60])
    feed(calibrator, dirty[60:], step=4)
    assert calibrator.alarm is None
    _, result = agrees(calibrator, dirty, PLAIN, sigmas=0.05)
    rejected = np.array([r is not None for r in result.spots.rejected])
    assert (rejected & bad).sum() >= 0.98 * bad.sum()
    assert (rejected & ~bad).sum() <= 0.02 * bad.sum()


def test_goes_on_from_a_calibration_and_its_file(tmp_path):
    _, spots = stream()
    first = lc.calibrate(spots[:120], options=PLAIN)
    calibrator = IncrementalCalibrator(first)
    assert sigmas_between(calibrator.cell, first) < 1e-4
    assert np.allclose(calibrator.calibration.covariance, first.covariance, rtol=1e-4)
    feed(calibrator, spots[120:], step=6)
    agrees(calibrator, spots, PLAIN)
    calibrator.calibration.save(tmp_path / "calibration.json")
    loaded = lc.load_calibration(tmp_path / "calibration.json")
    assert loaded == calibrator.calibration
    again = IncrementalCalibrator(loaded)
    assert again.n_spots == len(spots)
    assert sigmas_between(again.cell, loaded) < 1e-6


def test_a_window_keeps_older_spots_as_a_prior():
    _, spots = stream(groups=20)
    calibrator = IncrementalCalibrator(options=PLAIN, max_spots=100)
    calibrator.add(spots[:60])
    feed(calibrator, spots[60:])
    update = calibrator.add(spots[:0])
    batch, result = batch_of(spots, update), update.calibration
    assert sigmas_between(update.cell, batch) < 0.05
    assert 100 <= len(result.inputs.observations) < 115
    assert result.fit.n_spots == len(spots) == update.n_spots
    assert result.fit.sigma0 == pytest.approx(batch.fit.sigma0, rel=1e-3)
    assert any("older spots" in note for note in result.observability.notes)
    # what does not hold all its spots goes on by its covariance
    again = IncrementalCalibrator(result)
    assert np.allclose(again.calibration.covariance, result.covariance, rtol=1e-6)
    assert again.n_spots == len(spots) and again.phase == "running"
    assert again.add(spots[:10]).n_used == len(spots) + 10


def test_fading_follows_a_drift_that_remembering_does_not():
    truth, spots = stream(groups=14)
    rng = np.random.default_rng(0)
    camera = truth.cameras["camera"]

    def drifted(share):
        T = camera.T_base_camera.copy()
        T[:3, 3] += share * np.array([2e-3, 0.0, 0.0])
        moved = Camera(camera.intrinsics, T, camera.image_size)
        return Cell({"camera": moved}, truth.lasers, truth.planes)

    pieces = [
        seen_in(drifted(k / len(spots)), spots[k : k + 10], 0.3, rng)
        for k in range(0, len(spots), 10)
    ]
    faded = IncrementalCalibrator(options=PLAIN, half_life=40)
    kept = IncrementalCalibrator(options=PLAIN)
    for calibrator in (faded, kept):
        for piece in pieces:
            calibrator.add(piece)
            if calibrator.alarm is not None:
                calibrator.dismiss()
    goal = drifted(1.0).cameras["camera"].T_base_camera[0, 3]
    errors = [abs(c.cell.cameras["camera"].T_base_camera[0, 3] - goal) for c in (faded, kept)]
    assert errors[0] < 0.5 * errors[1]
    # at rest it counts about half_life / ln 2 spots
    assert faded.add(spots[:0]).n_used == pytest.approx(40 / np.log(2), rel=0.1)


def test_a_new_plane_is_taken_in_and_one_plane_s_assumptions_go():
    _, spots = stream()
    one, two = spots[spots.plane == "1"], spots[spots.plane == "2"]
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(one)
    assert any("one plane only" in w for w in calibrator.calibration.observability.held)
    update = calibrator.add(two[:1])
    assert update.phase == "recovering" and update.held_back == (two.id[0],)
    assert [(m.part, m.name, m.have) for m in update.missing] == [("plane", "2", 1)]
    assert np.isnan(update.innovation.chi2).all()
    updates = feed(calibrator, two[1:], step=3)
    assert ["extended"] in [[e.kind for e in u.events] for u in updates]
    assert updates[-1].phase == "running"
    assert not any("one plane" in w for w in updates[-1].calibration.observability.held)
    agrees(calibrator, one + two, PLAIN)


def test_a_new_camera_and_a_new_laser_are_taken_in():
    truth, spots = stream()
    T = truth.cameras["camera"].T_base_camera.copy()
    T[:3, :3] = T[:3, :3] @ rotation_exp(np.array([0.1, 0.15, 0.3]))
    T[:3, 3] += [0.03, -0.04, 0.05]
    side = Camera(Intrinsics(fu=700, fv=690, u0=330, v0=230), T, (640, 480))
    beam = truth.lasers["laser"]
    turned = rotation_exp(np.array([0.05, -0.1, 0.0])) @ beam.direction_hand
    red = Beam(turned, beam.point_hand + np.array([0.02, 0.01, 0.0]))
    cell = Cell({**truth.cameras, "side": side}, {**truth.lasers, "red": red}, truth.planes)
    rng = np.random.default_rng(2)
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots)
    everything = spots
    for kind, name in (("camera", "side"), ("laser", "red")):
        more = shuffled(seen_in(cell, spots, 0.3, rng, **{kind: name}))[:60]
        updates = feed(calibrator, more, step=2)
        assert updates[0].missing[0].part == kind
        assert any(e.kind == "extended" for u in updates for e in u.events)
        assert updates[-1].phase == "running" and updates[-1].alarm is None
        everything = everything + more
        assert sigmas_between(calibrator.cell, batch_of(everything, updates[-1])) < 0.01


def test_history_grows_ever_more_slowly_and_ends_at_the_present():
    _, spots = stream(groups=20)
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots[:30])
    update = feed(calibrator, spots[30:])[-1]
    rows = calibrator.history
    numbers = [row.spots for row in rows]
    assert numbers == sorted(set(numbers)) and numbers[-1] == len(spots)
    assert len(rows) < 330
    assert [p.name for p in rows[0].parameters] == [p.name for p in update.parameters]
    fu = [next(p for p in row.parameters if p.name == "fu") for row in rows]
    assert fu[-1].sigma < 0.5 * fu[0].sigma
    assert "with" in rows[0].events[0]


def test_an_update_stays_as_it_was():
    _, spots = stream()
    calibrator = IncrementalCalibrator(options=PLAIN)
    early = calibrator.add(spots[:100])
    fu = early.parameters[0]
    calibrator.add(spots[100:])
    assert len(early.calibration.inputs.observations) == 100
    assert early.calibration["fu"] == fu
    assert early.calibration["fu"] != calibrator.calibration["fu"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [({"max_spots": 10}, "max_spots"), ({"half_life": 1}, "half_life")],
)
def test_settings_that_make_no_sense_are_refused(arguments, words):
    with pytest.raises(lc.DataError, match=words):
        IncrementalCalibrator(**arguments)


def test_wrong_requests_are_refused_in_words():
    _, spots = stream()
    calibrator = IncrementalCalibrator(options=PLAIN)
    calibrator.add(spots)
    with pytest.raises(lc.DataError, match="say what has moved"):
        calibrator.reset()
    with pytest.raises(lc.DataError, match=r"plane 'table' is not among 1, 2, 3"):
        calibrator.reset(plane="table")
    other = lc.Observations.from_arrays(
        spots.uv[:1], spots.T_base_hand[:1], plane="1", image_size=(1280, 960)
    )
    with pytest.raises(lc.DataError, match="had image size"):
        calibrator.add(other)
    assert calibrator.n_spots == len(spots)


def test_a_calibration_without_sigmas_cannot_be_continued_by_its_covariance():
    _, spots = stream()
    result = lc.calibrate(spots[:60], options=PLAIN)
    nothing = np.full_like(result.covariance, np.nan)
    with pytest.raises(lc.DataError, match="no sigmas"):
        IncrementalCalibrator(
            replace(
                result,
                covariance=nothing,
                fit=replace(result.fit, n_spots=500),
            )
        )
