"""A bump is noticed, named, measured and mended; what has not moved is kept."""

from __future__ import annotations

import numpy as np
import pytest
from incremental_cases import PLAIN, feed, seen_in, shuffled, sigmas_between, stream

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Beam, Camera, Cell, Plane
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.incremental.belief import Belief, coordinates
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.simulate import Noise

SIGMA = 0.3
TURN = rotation_exp(np.deg2rad(2.0) * np.array([0.6, -0.64, 0.48]))
SHIFT = 0.01 * np.array([-0.48, 0.6, 0.64])


def moved(cell, kind):
    """The cell after a bump of 2 deg and 10 mm."""
    if kind == "camera":
        old = cell.cameras["camera"]
        T = old.T_base_camera.copy()
        T[:3, :3] = T[:3, :3] @ TURN
        T[:3, 3] += SHIFT
        new = Camera(old.intrinsics, T, old.image_size)
        return Cell({"camera": new}, cell.lasers, cell.planes)
    if kind == "laser":
        old = cell.lasers["laser"]
        beam = Beam(TURN @ old.direction_hand, old.point_hand + SHIFT)
        return Cell(cell.cameras, {"laser": beam}, cell.planes)
    old = cell.planes["2"]
    new = Plane(TURN @ old.normal_base, old.distance + 0.01)
    return Cell(cell.cameras, cell.lasers, {**cell.planes, "2": new})


def turned(cell, kind):
    """How far that turns the part, degrees (a turn about the beam itself is none)."""
    axis = {"laser": cell.lasers["laser"].direction_hand, "plane": cell.planes["2"].normal_base}
    if kind == "camera":
        return 2.0
    return float(np.degrees(np.arccos(axis[kind] @ TURN @ axis[kind])))


NAMES = {"camera": "camera", "laser": "laser", "plane": "2"}


@pytest.fixture(scope="module")
def scene():
    truth, spots = stream(groups=16, noise=Noise(SIGMA))
    return truth, spots[:300], spots[300:]


def started(scene, **settings):
    calibrator = IncrementalCalibrator(options=PLAIN, **settings)
    calibrator.add(scene[1])
    assert calibrator.alarm is None
    return calibrator


def after_the_bump(scene, kind, count=40, seed=0):
    truth, _, later = scene
    cell = moved(truth, kind)
    spots = seen_in(cell, later, SIGMA, np.random.default_rng(seed))
    if kind == "plane":
        spots = spots[np.argsort(spots.plane != "2", kind="stable")]
    return cell, spots[:count]


def normalised_error(calibrator, cell, kind):
    """Squared error of a part over its covariance, per coordinate."""
    known = Belief.of(calibrator.calibration)
    columns = known.columns(kind, NAMES[kind])
    z = coordinates(known.cell, cell)[columns]
    return float(z @ np.linalg.solve(known.covariance[columns, columns], z)) / len(z)


@pytest.mark.parametrize("kind", ["camera", "laser", "plane"])
def test_a_bump_is_noticed_named_and_measured(scene, kind):
    calibrator = started(scene)
    before = calibrator.cell
    _, spots = after_the_bump(scene, kind)
    updates = feed(calibrator, spots[:10])
    first = next(k for k, u in enumerate(updates) if u.alarm is not None)
    assert first < 4
    alarm = updates[-1].alarm
    assert alarm.since in spots.id[: first + 1]
    assert alarm.since_number == 300 + spots.id.tolist().index(alarm.since)
    assert (alarm.cause.kind, alarm.cause.name) == (kind, NAMES[kind])
    assert alarm.cause.probability > 0.99
    assert sum(c.probability for c in alarm.causes) == pytest.approx(1.0)
    assert alarm.cause.turn_deg == pytest.approx(turned(scene[0], kind), rel=0.3)
    assert kind in alarm.words and alarm.since in alarm.words
    assert [e.kind for u in updates for e in u.events] == ["alarm"]
    # what does not fit is held back, and the estimate stays as it was
    assert set(updates[-1].held_back) == {spots.id[9]}
    assert np.allclose(
        calibrator.cell.cameras["camera"].T_base_camera,
        before.cameras["camera"].T_base_camera,
        atol=1e-4,
    )
    assert not calibrator.calibration.fit.converged


@pytest.mark.parametrize("kind", ["camera", "laser", "plane"])
def test_reset_frees_that_part_and_keeps_the_rest(scene, kind):
    calibrator = started(scene)
    before = calibrator.calibration
    cell, spots = after_the_bump(scene, kind)
    feed(calibrator, spots[:10])
    update = calibrator.reset(**{kind: NAMES[kind]})
    assert update.alarm is None and "reset" in [e.kind for e in update.events]
    assert sum("recovered" in [e.kind for e in u.events] for u in [update]) == 1
    assert update.phase == "running"
    feed(calibrator, spots[10:20])
    assert calibrator.alarm is None and calibrator.phase == "running"
    assert normalised_error(calibrator, cell, kind) < 3.0
    assert update.n_used == pytest.approx(310, abs=2)
    # all else is where it was, and known at least as well
    for label in ("fu", "fv", "k1", "Tx", "laser_y", "a_1_x", "a_3_z"):
        old, new = before[label], calibrator.calibration[label]
        if (kind, label[:2]) not in (("camera", "Tx"), ("laser", "la")):
            assert abs(new.refined - old.refined) <= 2.0 * old.sigma, label
    result = calibrator.calibration
    label = {"camera": "camera.rot", "laser": "laser.", "plane": "plane 2."}[kind]
    for i, name in enumerate(before.labels):
        if not name.startswith((label, "camera.trans")) and before.covariance[i, i] > 0:
            assert result.covariance[i, i] < 1.1 * before.covariance[i, i], name


@pytest.mark.parametrize("kind", ["camera", "laser", "plane"])
def test_automatic_does_it_by_itself_and_records_it(scene, kind):
    calibrator = started(scene, automatic=True)
    cell, spots = after_the_bump(scene, kind)
    feed(calibrator, spots[:30])
    assert [e.kind for e in calibrator.events] == ["started", "alarm", "reset", "recovered"]
    assert "moved by" in calibrator.events[2].words
    assert calibrator.alarm is None and normalised_error(calibrator, cell, kind) < 3.0
    rows = [row for row in calibrator.history if row.events]
    # what was known before stays known in the trace
    assert all(p.sigma > 0 for p in calibrator.history[0].parameters if p.unit != "1")
    assert any("freed" in word for row in rows for word in row.events)


def test_a_reset_before_there_are_spots_waits_for_them(scene):
    calibrator = started(scene)
    cell, spots = after_the_bump(scene, "camera")
    update = calibrator.reset(camera="camera")
    assert update.phase == "recovering" and update.missing[0].part == "camera"
    result = update.calibration
    assert np.isnan(result["Tx"].sigma) and result["fu"].sigma > 0
    assert not result.fit.converged and "camera" in result.fit.status
    updates = feed(calibrator, spots[:12])
    assert updates[0].held_back == (spots.id[0],)
    assert "recovered" in [e.kind for u in updates for e in u.events]
    assert normalised_error(calibrator, cell, "camera") < 3.0


def test_a_few_outliers_in_a_row_do_not_end_as_a_bump(scene):
    truth, _, later = scene
    calibrator = started(scene, automatic=True)
    good = seen_in(truth, later, SIGMA, np.random.default_rng(5))[:60]
    uv = good.uv.copy()
    uv[10:13] = [[100.0, 400.0], [600.0, 50.0], [320.0, 20.0]]
    mixed = lc.Observations.from_arrays(
        uv, good.T_base_hand, plane=good.plane.tolist(), image_size=(640, 480), id=good.id
    )
    feed(calibrator, mixed)
    assert calibrator.alarm is None
    assert "reset" not in [e.kind for e in calibrator.events]
    rejected = {s.id for s in calibrator.calibration.spots if s.rejected is not None}
    assert rejected == set(good.id[10:13])


def test_dismissing_an_alarm_takes_the_spots_as_they_are(scene):
    calibrator = started(scene)
    _, spots = after_the_bump(scene, "camera")
    feed(calibrator, spots[:6])
    assert calibrator.alarm is not None
    update = calibrator.dismiss()
    assert update.alarm is None and [e.kind for e in update.events] == ["resolved"]
    held = [s.rejected for s in update.calibration.spots if "held back" in (s.rejected or "")]
    assert not held and update.n_spots == 306
    # six spots cannot overrule three hundred: they are outliers now, by name
    assert update.calibration.fit.n_rejected >= 4


def test_a_worse_robot_is_not_taken_for_a_bump(scene):
    truth, _, later = scene
    rng = np.random.default_rng(4)
    T = later.T_base_hand.copy()
    T[:, :3, 3] += 2e-3 * rng.standard_normal((len(T), 3))
    T[:, :3, :3] = T[:, :3, :3] @ rotation_exp(np.deg2rad(0.2) * rng.standard_normal((len(T), 3)))
    actual = lc.Observations.from_arrays(
        later.uv, T, plane=later.plane.tolist(), image_size=(640, 480), id=later.id
    )
    seen = seen_in(truth, actual, SIGMA, rng)
    commanded = dict(zip(later.id.tolist(), later.T_base_hand, strict=True))
    spots = lc.Observations.from_arrays(
        seen.uv, np.array([commanded[i] for i in seen.id.tolist()]), plane=seen.plane.tolist(),
        image_size=(640, 480), id=seen.id,
    )  # fmt: skip
    calibrator = started(scene)
    updates = feed(calibrator, spots[:25])
    alarms = [u.alarm for u in updates if u.alarm is not None]
    assert alarms and alarms[-1].cause.kind == "robot"
    assert 1.0 < alarms[-1].cause.shift_mm < 4.0


def test_no_alarm_on_good_spots(scene):
    truth, _, later = scene
    calibrator = started(scene)
    for seed in range(4):
        good = seen_in(truth, shuffled(later, seed), SIGMA, np.random.default_rng(seed))
        feed(calibrator, good, step=10)
    assert calibrator.alarm is None and [e.kind for e in calibrator.events] == ["started"]
    everything = calibrator.calibration.inputs.observations
    batch = lc.calibrate(everything, initial=calibrator.cell, options=PLAIN)
    assert sigmas_between(calibrator.cell, batch) < 0.02
