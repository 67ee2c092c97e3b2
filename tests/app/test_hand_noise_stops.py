"""Several spots from one stop: one hand pose, one error; against hand poses as variables."""

from __future__ import annotations

import json
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from core_cases import distance_in_sigmas, rows_of

import lasercal_gtsam as lc
from lasercal_gtsam.hand_noise.explicit import HandPoseGraph
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.simulate import Noise, simulate

NOISE = Noise(0.3, 1e-3, float(np.radians(0.05)))
STATED = {"sigma_px": 0.3, "hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.05))}


def options(**changes):
    return lc.CalibrationOptions(**({"robust": "none", "distortion": "none"} | STATED | changes))


def two_cameras(truth: lc.Cell) -> lc.Cell:
    """A second camera beside the first, for the same picture."""
    camera = truth.cameras["camera"]
    T = camera.T_base_camera.copy()
    T[:3, 3] += T[:3, :3] @ np.array([0.03, 0.0, 0.0])
    return replace(truth, cameras={"left": camera, "right": replace(camera, T_base_camera=T)})


def seen_twice(seed: int, stops: bool = True, noise: Noise = NOISE):
    """Every stop of the paper's cell seen by both cameras: truth and observations."""
    made = simulate("paper", seed, noise, groups=3, shots=6)
    seen, rng = made.observations, np.random.default_rng(100 + seed)
    cell = two_cameras(made.truth)
    parts = []
    for camera in cell.cameras:
        exact = lc.project(cell, made.T_base_hand_actual, plane=seen.plane, camera=camera)
        uv = exact + noise.pixel_px * rng.standard_normal(exact.shape)
        parts.append(
            replace(
                seen, uv=uv, camera=np.full(len(seen), camera), image_size={camera: (640, 480)},
                id=np.array([f"{name}-{camera}" for name in seen.id]),
                stop=seen.id if stops else None,
            )
        )  # fmt: skip
    return cell, parts[0] + parts[1]


def optimum(posed: HandPoseGraph) -> gtsam.Values:
    """Solved from hand poses and a lens that are off."""
    values = gtsam.Values(posed.values)
    rng = np.random.default_rng(0)
    for hand in posed.hands:
        values.update(hand, values.atPose3(hand).retract(1e-3 * rng.standard_normal(6)))
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setRelativeErrorTol(1e-14)
    return gtsam.LevenbergMarquardtOptimizer(posed.graph, values, params).optimize()


def camera_distance(result: lc.Calibration, posed: HandPoseGraph, values: gtsam.Values) -> float:
    """Largest difference of an intrinsic between the two, in its sigmas."""
    worst = 0.0
    cameras = result.cell.cameras.items()
    for (_, lens), (name, camera) in zip(posed.cell.cameras, cameras, strict=True):
        other = lc.Intrinsics.from_vector(values.atCal3DS2(lens).vector())
        prefix = f"{name}." if len(result.cell.cameras) > 1 else ""
        for term in ("fu", "fv", "u0", "v0"):
            difference = getattr(other, term) - getattr(camera.intrinsics, term)
            worst = max(worst, abs(difference) / result[prefix + term].sigma)
    return worst


def test_one_hand_pose_for_all_spots_of_a_stop():
    """Optimum, sigmas and poses are those of a graph with a variable for every stop."""
    truth, seen = seen_twice(1)
    result = lc.calibrate(seen, initial=truth, options=options())
    posed = lc.hand_pose_graph(result)
    assert len(posed.hands) == 54 and len(seen) == 108
    values = optimum(posed)
    assert camera_distance(result, posed, values) < 1e-5
    cost = 2 * posed.graph.error(values)
    assert result.fit.sigma0**2 * result.fit.dof == pytest.approx(cost, rel=1e-8)
    # unknowns: two cameras with 6 + 5, a beam with 4, three planes with 3
    assert result.fit.dof == 2 * 108 - 35
    marginals = gtsam.Marginals(posed.graph, values)
    lens = posed.cell.cameras[1][1]
    sigmas = posed.unit * np.sqrt(np.diag(marginals.marginalCovariance(lens)))
    stated = [result[f"right.{name}"].sigma for name in ("fu", "fv")]
    np.testing.assert_allclose(sigmas[:2], stated, rtol=1e-5)
    poses = lc.adjusted_hand_poses(result)
    for k in (0, 17, 60):
        hand = posed.hands[posed.hand_of_spot[k]]
        np.testing.assert_allclose(poses.T_base_hand[k], values.atPose3(hand).matrix(), atol=1e-9)
        expected = posed.unit**2 * marginals.marginalCovariance(hand)
        sigma = np.sqrt(np.diag(expected))
        outer = np.outer(sigma, sigma)
        np.testing.assert_allclose(poses.covariance[k] / outer, expected / outer, atol=2e-3)
    np.testing.assert_array_equal(poses.T_base_hand[:54], poses.T_base_hand[54:])
    assert sum(spot.leverage for spot in result.spots) == pytest.approx(35, rel=1e-9)


def test_sharing_matters_and_is_asked_for():
    truth, seen = seen_twice(2)
    shared = lc.calibrate(seen, initial=truth, options=options())
    apart = lc.calibrate(replace(seen, stop=None), initial=truth, options=options())
    one_camera = seen.camera == "left"
    alone = lc.calibrate(seen[one_camera], initial=truth, options=options())
    # twice the spots, but not twice the information on the beam
    name = "laser_y"
    assert apart[name].sigma / apart.fit.sigma0 < 0.9 * shared[name].sigma / shared.fit.sigma0
    assert shared[name].sigma / shared.fit.sigma0 < alone[name].sigma / alone.fit.sigma0
    assert shared.observability.notes == ()
    assert any("54 hand poses are those of other spots" in n for n in apart.observability.notes)
    # labels of their own are no stops in common, and nobody asks about them
    named = lc.calibrate(replace(seen, stop=seen.id), initial=truth, options=options())
    assert named.parameters == apart.parameters and not named.observability.notes
    exact = {"hand_sigma_m": 0.0, "hand_sigma_rad": 0.0}
    plain = lc.calibrate(seen, initial=truth, options=options(**exact))
    same = lc.calibrate(replace(seen, stop=None), initial=truth, options=options(**exact))
    assert plain.parameters == same.parameters


def test_sigmas_hold_with_shared_stops():
    """Mean normalised squared error of the rows, over 30 captures."""
    scores = []
    for seed in range(30):
        truth, seen = seen_twice(seed)
        found = lc.calibrate(seen, initial=truth, options=options())
        rows = rows_of(truth, found.cell)
        scores.append([(p.refined - rows[p.name]) / p.sigma for p in found.parameters if p.sigma])
    # angles of the paper's cell are far from the cut; rows are correlated, captures are not
    spread = np.square(scores).mean(axis=1)
    assert spread.mean() == pytest.approx(1.0, abs=4 * spread.std() / np.sqrt(len(spread)))


def test_order_does_not_matter():
    truth, seen = seen_twice(3)
    mixed = seen[np.random.default_rng(0).permutation(len(seen))]
    first = lc.calibrate(seen, initial=truth, options=options())
    second = lc.calibrate(mixed, initial=truth, options=options())
    assert distance_in_sigmas(first, second) < 1e-5
    leverage = {spot.id: spot.leverage for spot in second.spots}
    for spot in first.spots:
        assert leverage[spot.id] == pytest.approx(spot.leverage, rel=1e-5)


def test_an_outlier_does_not_spoil_the_others_of_its_stop():
    truth, seen = seen_twice(4)
    uv = seen.uv.copy()
    uv[[5, 80]] += [[60.0, -40.0], [-50.0, 70.0]]
    found = lc.calibrate(replace(seen, uv=uv), initial=truth, options=options(robust="auto"))
    assert [k for k, spot in enumerate(found.spots) if spot.rejected] == [5, 80]
    good = np.setdiff1d(np.arange(len(seen)), [5, 80])
    clean = lc.calibrate(seen[good], initial=truth, options=options())
    assert distance_in_sigmas(clean, found) < 1e-4
    poses = lc.adjusted_hand_poses(found)
    assert not poses.correction[5].any() and poses.correction[5 + 54].any()


def test_gnc_with_stops():
    truth, seen = seen_twice(5)
    uv = seen.uv.copy()
    uv[7] += [40.0, 30.0]
    found = lc.calibrate(replace(seen, uv=uv), initial=truth, options=options(robust="gnc-tls"))
    assert [k for k, spot in enumerate(found.spots) if spot.rejected] == [7]


def test_what_cannot_be_is_refused():
    truth, seen = seen_twice(1)
    with pytest.raises(lc.DataError, match="'huber' weighs spots one by one"):
        lc.calibrate(seen, initial=truth, options=options(robust="huber"))
    T = seen.T_base_hand.copy()
    T[3, 0, 3] += 1e-3
    with pytest.raises(
        lc.DataError, match=r"stop 's004' \(s004-left, s004-right\) have hand poses"
    ):
        replace(seen, T_base_hand=T)
    with pytest.raises(lc.DataError, match="expected 108 names"):
        replace(seen, stop=seen.stop[:3])
    plain = lc.calibrate(seen, initial=truth, options=lc.CalibrationOptions())
    for ask in (lc.adjusted_hand_poses, lc.hand_pose_graph):
        with pytest.raises(lc.DataError, match="takes them as exact"):
            ask(plain)
    tied = lc.calibrate(seen, initial=truth, options=options(known={"left.aspect": 1.0}))
    with pytest.raises(lc.DataError, match="tied focal lengths"):
        lc.hand_pose_graph(tied)


def test_stops_are_selected_joined_and_kept():
    _, seen = seen_twice(1)
    assert [members.shape for members in seen.shared_stops] == [(54, 2)]
    assert seen[:54].shared_stops == ()
    assert [m.shape for m in seen[[0, 54, 1]].shared_stops] == [(1, 2)]
    none = replace(seen[:2], stop=None)
    assert (none + none).stop is None
    assert (none + seen[2:4]).stop.tolist() == ["", "", "s003", "s004"]
    arrays = lc.Observations.from_arrays(
        seen.uv[[0, 54]], seen.T_base_hand[[0, 54]], plane="1", image_size=(640, 480), stop=[7, 7]
    )
    assert arrays.stop.tolist() == ["7", "7"]
    blank = replace(seen, stop=np.full(len(seen), ""))
    assert blank.shared_stops == ()


def test_stops_go_through_files(tmp_path):
    truth, seen = seen_twice(6)
    seen = replace(seen, stop=np.where(np.arange(108) % 54 < 50, seen.stop, ""))
    write_capture(
        tmp_path, seen, transform="T_base_hand", length="m", rotation="matrix", with_spots=True
    )
    assert "stop" in (tmp_path / "poses.csv").read_text().splitlines()[0].split(",")
    loaded = lc.load_capture(tmp_path).observations()
    assert loaded.stop.tolist() == seen.stop.tolist()
    result = lc.calibrate(loaded, initial=truth, options=options())
    result.save(tmp_path / "calibration.json")
    assert lc.load_calibration(tmp_path / "calibration.json") == result
    document = json.loads((tmp_path / "calibration.json").read_text())
    del document["inputs"]["observations"]["stop"], document["fit"]["noise"]
    (tmp_path / "old.json").write_text(json.dumps(document))
    old = lc.load_calibration(tmp_path / "old.json")  # as older versions wrote it
    assert old.inputs.observations.stop is None and old.fit.noise == ()


def test_a_running_calibration_says_that_it_takes_stops_apart():
    truth, seen = seen_twice(8)
    start = lc.calibrate(seen[seen.camera == "left"], initial=truth, options=options())
    running = lc.IncrementalCalibrator(start)
    assert any("spots of one stop" in words for words in running.calibration.observability.held)
    apart = replace(seen, stop=None)[seen.camera == "left"]
    running = lc.IncrementalCalibrator(lc.calibrate(apart, initial=truth, options=options()))
    assert not any("spots of one stop" in words for words in running.calibration.observability.held)


def test_judged_and_checked_as_calibrated():
    truth, seen = seen_twice(7)
    result = lc.calibrate(seen, initial=truth, options=options())
    assert lc.judge(result).grade == "good"
    checked = lc.check_sigma(result, trials=30)
    assert checked.nees.low < checked.nees.mean < checked.nees.high
