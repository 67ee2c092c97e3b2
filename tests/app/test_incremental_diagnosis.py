"""What has moved: evidence against direct integration, the right cause, how far, in words."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bump_cases import bumped, outliers_among, spots_in_turn, with_sigma
from core_cases import differences, simulated
from test_core_cameras import capture, two_eyed_cell

import lasercal_gtsam as lc
from lasercal_gtsam.hand_noise import HandNoise
from lasercal_gtsam.incremental.belief import Belief, coordinates
from lasercal_gtsam.incremental.diagnosis import PRIOR_ODDS, Diagnosis, diagnose
from lasercal_gtsam.incremental.evidence import Scene
from lasercal_gtsam.incremental.recover import recover
from lasercal_gtsam.rotations import basis_of
from lasercal_gtsam.simulate import Noise

NAMES = {"camera": "camera", "laser": "laser", "plane": "2"}
KINDS = tuple(NAMES)
WORSE_ROBOT = Noise(hand_translation_m=1e-3, hand_rotation_rad=np.deg2rad(0.1))
PX = 0.3


@cache
def calibrated(seed: int = 0, pixel_px: float = PX) -> tuple[lc.Cell, lc.Calibration]:
    made = simulated("paper", seed, pixel_px)
    seen = with_sigma(made.observations, pixel_px)
    return made.truth, lc.calibrate(seen, initial=made.truth)


@cache
def belief(seed: int = 0) -> Belief:
    return Belief.of(calibrated(seed)[1])


def middle(truth: lc.Cell, seed: int) -> np.ndarray:
    seen = simulated("paper", seed, PX).observations
    seen = seen[seen.plane == "2"]
    return lc.spot_on_beam(truth, seen.T_base_hand, plane="2").mean(axis=0)


@cache
def after(
    kind: str, size: tuple[float, float], count: int = 10, seed: int = 0
) -> tuple[lc.Cell, lc.Observations]:
    """The cell with something changed, and spots since."""
    truth, _ = calibrated(seed)
    hand = WORSE_ROBOT if kind == "robot" else None
    for attempt in range(20):
        rng = np.random.default_rng((seed, attempt))
        new = truth
        if kind in NAMES:
            new = bumped(truth, kind, NAMES[kind], *size, rng, middle(truth, seed))
        try:
            return new, with_sigma(spots_in_turn(new, count, seed + 500, PX, hand), PX)
        except lc.DataError:
            continue
    raise AssertionError("no bump in view")


def diagnosed(seen: lc.Observations, seed: int = 0, rate: float = 0.01) -> Diagnosis:
    return diagnose(belief(seed), seen, seen.cov_uv, outlier_rate=rate)


def gaussian(r: np.ndarray, S: np.ndarray) -> float:
    sign, log_det = np.linalg.slogdet(2 * np.pi * S)
    assert sign > 0
    return float(-0.5 * (log_det + r @ np.linalg.solve(S, r)))


def residuals(cell: lc.Cell, seen: lc.Observations) -> np.ndarray:
    return (lc.project(cell, seen.T_base_hand, plane=seen.plane.tolist()) - seen.uv).ravel()


def sharp(known: Belief) -> Belief:
    """As if the cell were known a thousand times better."""
    return replace(known, information=1e6 * known.information)


# --- the evidence ------------------------------------------------------------------------------


def test_evidence_without_a_move_is_the_predictive_density() -> None:
    # Gaussian spots about the belief's mean: density with covariance S + J C J'
    known, (_, seen) = belief(), after("none", (0, 0), 6)
    # ten times sharper than the calibration, so that the cell is straight within its sigmas
    known = replace(known, information=1e2 * known.information)
    scene = Scene.of(known, seen, 1e-12)
    mode = scene.mode(seen.cov_uv, np.zeros((scene.chart.n, 0)))
    C = 1e-2 * calibrated()[1].covariance
    sigmas = np.sqrt(np.diag(C))

    def pixels(x: np.ndarray) -> np.ndarray:
        return residuals(scene.cell(x * sigmas), seen)

    J = differences(lambda x: pixels(0.01 * x), np.zeros(len(C))) / 0.01
    S = J @ (C / np.outer(sigmas, sigmas)) @ J.T + PX**2 * np.eye(2 * len(seen))
    assert mode.log_evidence == pytest.approx(gaussian(residuals(known.cell, seen), S), abs=0.01)


def test_evidence_of_a_moved_plane_is_the_integral_over_its_displacements() -> None:
    known = sharp(belief())
    _, seen = after("plane", (0.2, 1.0), 9)
    plane = known.cell.planes["2"]
    sigmas = np.array([5e-3, 5e-3, 2e-3])
    D = np.zeros((len(known.information), 3))
    D[known.columns("plane", "2")] = np.diag(sigmas)
    rate = 0.01
    scene = Scene.of(known, seen, rate)
    found = scene.mode(seen.cov_uv, D, trusting=True)
    # importance sampling around the mode, three coordinates; the cell itself is sharp
    rng = np.random.default_rng(0)
    size = len(scene.known.T)
    cov = np.linalg.inv(found.information)[size:, size:] * 1.5
    draws = rng.multivariate_normal(found.y[size:], cov, 6000)
    E, n = basis_of(plane.normal_base), plane.normal_base
    logs = np.empty(len(draws))
    for i, b in enumerate(draws):
        step = sigmas * b
        normal = n + E @ step[:2]
        moved = lc.Plane(normal, plane.distance + step[2])
        r = residuals(known.cell.with_planes({**known.cell.planes, "2": moved}), seen)
        m = (r.reshape(-1, 2) ** 2).sum(axis=1) / PX**2
        good = np.log(1 - rate) - 0.5 * m - np.log(2 * np.pi * PX**2)
        spots = np.logaddexp(good, np.log(rate / (640 * 480))).sum()
        logs[i] = spots + gaussian(b, np.eye(3)) - gaussian(b - found.y[size:], cov)
    integral = np.logaddexp.reduce(logs) - np.log(len(logs))
    assert found.log_evidence == pytest.approx(integral, abs=0.05)


def test_evidence_does_not_depend_on_the_order_of_the_spots() -> None:
    _, seen = after("camera", (2.0, 10.0))
    shuffled = seen[np.random.default_rng(1).permutation(len(seen))]
    a, b = diagnosed(seen), diagnosed(shuffled)
    assert [(c.kind, c.name) for c in a.causes[:3]] == [(c.kind, c.name) for c in b.causes[:3]]
    assert a.causes[0].log_likelihood == pytest.approx(b.causes[0].log_likelihood, abs=1e-3)


# --- causes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(2.0, 10.0), (20.0, 100.0)])
@pytest.mark.parametrize("seed", range(3))
def test_the_part_that_moved_is_named_with_its_displacement(
    kind: str, size: tuple[float, float], seed: int
) -> None:
    new, seen = after(kind, size, 12, seed)
    truth, _ = calibrated(seed)
    found = diagnosed(seen, seed)
    cause = found.causes[0]
    assert (cause.kind, cause.name) == (kind, NAMES[kind])
    assert cause.probability > 0.999
    assert sum(c.probability for c in found.causes) == pytest.approx(1.0)
    assert len(found.causes) == 1 + 1 + 3 + 2
    assert abs(cause.turn_deg - size[0]) < 4 * cause.sigma_deg
    if kind == "camera":
        assert abs(cause.shift_mm - size[1]) < 4 * cause.sigma_mm
    if kind == "laser":
        # from truth to truth, at the points nearest to the hand's origin
        a, b = truth.lasers["laser"], new.lasers["laser"]
        feet = [x.point_hand - x.point_hand @ x.direction_hand * x.direction_hand for x in (a, b)]
        want = 1e3 * np.linalg.norm(feet[1] - feet[0])
        assert abs(cause.shift_mm - want) < 4 * cause.sigma_mm
    # a sigma as large as the bump would pass the above
    assert cause.sigma_deg < max(0.25 * size[0], 1.0)
    assert cause.sigma_mm < max(0.25 * size[1], 1.5)


def test_a_worse_robot_is_named() -> None:
    for seed in range(3):
        _, seen = after("robot", (0, 0), 12, seed)
        cause = diagnosed(seen, seed).causes[0]
        assert cause.kind == "robot" and cause.probability > 0.95
        # the sigmas are per axis; 24 pixels give them to about a sixth
        assert abs(cause.shift_mm - 1.0) < 4 * cause.sigma_mm < 2.0
        assert "robot" in cause.words


def test_declared_robot_noise_is_no_news() -> None:
    _, seen = after("robot", (0, 0), 12)
    noise = HandNoise(1e-3, np.deg2rad(0.1))
    found = diagnose(belief(), seen, seen.cov_uv, outlier_rate=0.01, hand_noise=noise)
    assert found.causes[0].kind == "outliers"


def test_a_few_bad_spots_among_good_ones_are_outliers() -> None:
    for seed in range(3):
        _, seen = after("none", (0, 0), 10, seed)
        rows = [0, 3]
        seen = outliers_among(seen, rows, np.random.default_rng(seed))
        found = diagnosed(seen, seed)
        assert found.causes[0].kind == "outliers"
        # the rest goes to displacements too small to be seen
        assert found.settled and found.causes[0].probability > 0.5
        assert np.isnan(found.causes[0].shift_mm)
        assert (found.good[rows] < 1e-3).all()
        assert (np.delete(found.good, rows) > 0.9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_bump_is_named_among_outliers_and_spots_from_before(kind: str) -> None:
    _, before = after("none", (0, 0), 3)
    _, seen = after(kind, (20.0, 100.0), 12)
    seen = before[:2] + outliers_among(seen, [4], np.random.default_rng(0))
    found = diagnosed(seen)
    assert (found.causes[0].kind, found.causes[0].name) == (kind, NAMES[kind])
    assert found.good[2 + 4] < 1e-3


def test_nothing_moved_is_not_called_a_move() -> None:
    for seed in range(5):
        _, seen = after("none", (0, 0), 10, seed)
        found = diagnosed(seen, seed)
        assert max(c.probability for c in found.causes if c.kind != "outliers") < 0.9


def test_the_cause_is_open_with_one_spot() -> None:
    _, seen = after("camera", (2.0, 10.0))
    found = diagnosed(seen[:1])
    assert found.causes[0].probability < 0.95 and not found.settled
    assert found.words.startswith("the cause is open after 1 spot:")
    moved = {(c.kind, c.name) for c in found.causes}
    assert ("plane", str(seen.plane[0])) in moved
    assert sum(kind == "plane" for kind, _ in moved) == 1


def test_words_name_cause_size_probability_and_runner_up() -> None:
    _, seen = after("camera", (2.0, 10.0))
    found = diagnosed(seen)
    best, second = found.causes[:2]
    assert found.words.startswith("camera 'camera' moved by ")
    for part in (" mm and ", " deg (probability 1; next: ", " +- "):
        assert part in found.words
    name = {"outliers": "bad spots", "robot": "robot"}.get(second.kind, second.kind)
    assert f"next: {name}" in found.words
    assert best.words in found.words


def test_likelihoods_are_relative_to_outliers_and_give_the_probabilities() -> None:
    _, seen = after("laser", (0.2, 1.0), 4)
    causes = diagnosed(seen).causes
    assert next(c.log_likelihood for c in causes if c.kind == "outliers") == 0.0
    score = np.array([c.log_likelihood + np.log(PRIOR_ODDS[c.kind]) for c in causes])
    odds = np.exp(score - score.max())
    assert np.allclose([c.probability for c in causes], odds / odds.sum(), atol=1e-12)
    assert list(odds) == sorted(odds, reverse=True)


@pytest.mark.parametrize("kind", KINDS)
def test_the_part_set_free_is_given_back(kind: str) -> None:
    truth, _ = calibrated()
    new, seen = after(kind, (20.0, 100.0), 20)
    columns = belief().columns(kind, NAMES[kind])
    fused = recover(belief(), kind, NAMES[kind], seen, seen.cov_uv, start=diagnosed(seen[:10]).cell)
    assert not fused.troubles
    covariance = fused.belief.covariance[columns, columns]
    error = coordinates(fused.cell, new)[columns]
    assert float(error @ np.linalg.solve(covariance, error)) < 25.0
    # and it is not where it was
    assert float(np.abs(coordinates(fused.cell, truth)[columns]).max()) > 0.05


def test_a_start_from_which_the_optimiser_cannot_move_is_no_trap() -> None:
    # the plane so steep that the next step leaves a beam without a hit
    new, seen = after("plane", (20.0, 100.0), 20)
    known = belief()
    steep = new.planes["2"].normal_base + 0.5 * basis_of(new.planes["2"].normal_base)[:, 0]
    mean = lc.spot_on_beam(new, seen.T_base_hand, plane=seen.plane.tolist())
    plane = lc.Plane.from_point(steep, mean[seen.plane == "2"].mean(axis=0))
    start = new.with_planes({**new.planes, "2": plane})
    fused = recover(known, "plane", "2", seen, seen.cov_uv, start=start)
    assert fused.spot_cost < 4 * len(seen)
    assert float(np.abs(residuals(fused.cell, seen)).max()) < 6 * PX


def test_recovering_fails_in_words() -> None:
    _, seen = after("camera", (2.0, 10.0))
    behind = replace(seen, T_base_hand=seen.T_base_hand @ np.diag([1.0, -1.0, -1.0, 1.0]))
    with pytest.raises(lc.SolveError, match="plane '2' cannot be given back"):
        recover(belief(), "plane", "2", behind, behind.cov_uv)


def test_a_small_bump_is_measured_against_the_old_place_not_against_its_sigma() -> None:
    # the camera's own place is known worse than it moved, but the move itself is known well
    known = belief()
    truth, calibration = calibrated()
    columns = known.columns("camera", "camera")
    own = 1e3 * np.sqrt(np.diag(known.covariance)[columns][3:]).max()
    rng = np.random.default_rng(5)
    new = bumped(truth, "camera", "camera", 0.1, 0.5, rng)
    seen = with_sigma(spots_in_turn(new, 40, 77, PX), PX)
    cause = next(c for c in diagnosed(seen).causes if c.kind == "camera")
    assert calibration.fit.converged
    assert cause.sigma_mm < own
    assert abs(cause.shift_mm - 0.5) < 4 * cause.sigma_mm


def test_the_same_spots_give_the_same_digits() -> None:
    _, seen = after("plane", (2.0, 10.0))
    assert repr(diagnosed(seen).causes) == repr(diagnosed(seen).causes)


def test_held_and_tied_intrinsics_are_respected() -> None:
    made = simulated("paper", 0, PX)
    seen = with_sigma(made.observations, PX)
    options = lc.CalibrationOptions(known={"aspect": 1.0, "skew": 0.0})
    known = Belief.of(lc.calibrate(seen, initial=made.truth, options=options))
    _, spots = after("camera", (2.0, 10.0))
    found = diagnose(known, spots, spots.cov_uv, outlier_rate=0.01)
    assert (found.causes[0].kind, found.causes[0].probability > 0.99) == ("camera", True)
    lens = found.cell.cameras["camera"].intrinsics
    assert lens.skew == 0.0 and lens.fu == pytest.approx(lens.fv, rel=1e-12)


def test_what_cannot_be_diagnosed_is_refused() -> None:
    _, seen = after("camera", (2.0, 10.0))
    with pytest.raises(lc.DataError, match="no spots"):
        diagnosed(seen[:0])
    names = seen.plane.astype("<U9")
    names[0] = "table"
    with pytest.raises(lc.DataError, match="'table'"):
        diagnosed(replace(seen, plane=names))
    known = belief()
    vague = known.without(known.columns("plane", "1"))
    with pytest.raises(lc.DegenerateError, match="not determined"):
        diagnose(vague, seen, seen.cov_uv, outlier_rate=0.01)
    # what the spots do not touch need not be known
    rest = seen[seen.plane != "1"]
    assert diagnose(vague, rest, rest.cov_uv, outlier_rate=0.01).causes[0].kind == "camera"


def test_of_two_cameras_and_two_lasers_the_one_that_moved_is_named() -> None:
    cell = two_eyed_cell()
    pairs = [("left", "blue"), ("right", "blue"), ("left", "red"), ("right", "red")]
    seen = with_sigma(capture(cell, pairs, Noise(pixel_px=PX)), PX)
    known = Belief.of(lc.calibrate(seen, initial=cell))
    for kind, name in (("camera", "right"), ("laser", "red"), ("plane", "3")):
        new = bumped(cell, kind, name, 2.0, 10.0, np.random.default_rng(3))
        spots = with_sigma(capture(new, pairs, Noise(pixel_px=PX)), PX)[::7]
        found = diagnose(known, spots, spots.cov_uv, outlier_rate=0.01)
        assert len(found.causes) == 2 + 2 + 3 + 2
        cause = found.causes[0]
        assert (cause.kind, cause.name) == (kind, name)
        assert cause.probability > 0.999
        assert abs(cause.turn_deg - 2.0) < 4 * cause.sigma_deg < 4.0
