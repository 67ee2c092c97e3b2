"""The change detector: its arithmetic, how rarely it cries wolf, how soon it notices."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from lasercal_factors import change_densities, change_kernels, change_rates
from lasercal_factors.change_arrays import SLOTS, WINDOW
from scipy import stats

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.incremental.detector import Detector, Look, Looks
from lasercal_gtsam.incremental.detector_state import MAGNITUDES, change_covariance

sys.path.insert(0, str(Path(__file__).parents[1] / "montecarlo"))
import detector_study as study

AREA = 640.0 * 480.0


@pytest.fixture(scope="module")
def pool() -> study.Pool:
    return study.make_pool(0, 1.0)


def good_looks(pool: study.Pool, count: int, seed: int) -> Looks:
    rng = np.random.default_rng(seed)
    return study.looks_of(
        pool, rng.integers(len(pool), size=count), rng.standard_normal((count, 2))
    )


def part_of(looks: Looks, rows: slice) -> Looks:
    return Looks(*(a[rows] for a in looks))


def single(looks: Looks, i: int) -> Look:
    who = looks.who[i].tolist()
    G = looks.by_camera[i], looks.by_laser[i], looks.by_plane[i]
    return Look(looks.e[i], *who, *G, float(looks.area[i]), float(looks.dof[i]))


def statistic(detector: Detector) -> float:
    return sum(math.exp(o.log_weight) for o in detector.onsets())


# --- densities ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [3.0, 52.0, 1e9])
def test_expected_density_is_the_bivariate_t(dof: float) -> None:
    for x in ([0.0, 0.0], [1.0, -2.0], [4.0, 5.0]):
        want = stats.multivariate_t([0, 0], np.eye(2), df=dof).pdf(x)
        found = change_densities.expected_density(x[0] ** 2 + x[1] ** 2, dof)
        assert found == pytest.approx(want, rel=1e-5)


@pytest.mark.parametrize("area", [1e4, AREA, 1e7])
def test_outlier_density_has_mass_one_over_a_disc_of_the_picture(area: float) -> None:
    r = np.linspace(0, math.sqrt(area / math.pi), 200_001)
    density = np.array([change_densities.outlier_density(x * x, area) for x in r])
    assert np.trapezoid(2 * np.pi * r * density, r) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("rate", "dof"), [(5e-4, 52.0), (0.01, 1e9), (0.2, 1e9)])
def test_at_the_gate_both_explanations_are_equally_probable(rate: float, dof: float) -> None:
    r = change_densities.gate_length(rate, AREA, dof)
    good = (1 - rate) * change_densities.expected_density(r * r, dof)
    assert good == pytest.approx(rate * change_densities.outlier_density(r * r, AREA), rel=1e-3)
    assert 3.0 < r < 8.0


# --- the statistic -----------------------------------------------------------------------------


def test_weight_of_an_onset_is_the_evidence_of_its_linear_model() -> None:
    """Against 1/2 b (A + D^-1)^-1 b - 1/2 log det(I + D A), spots taken all at once."""
    rng = np.random.default_rng(1)
    detector = Detector.start()
    bank = detector.watch.cameras
    e, G = 2 * rng.standard_normal((12, 2)), 300 * rng.standard_normal((12, 2, 6))
    for i in range(12):
        good = change_densities.expected_density(float(e[i] @ e[i]), math.inf)
        common = (1.0, 1e-290, good, math.inf)
        change_kernels._look_at_part(bank, 0, i, e[i], G[i], common)
    for m, magnitude in enumerate(MAGNITUDES):
        D = change_covariance("cameras", *magnitude)
        for k in range(12):
            A = sum(g.T @ g for g in G[k:])
            b = sum(g.T @ x for g, x in zip(G[k:], e[k:], strict=True))
            want = 0.5 * b @ np.linalg.solve(A + np.linalg.inv(D), b)
            want -= 0.5 * np.linalg.slogdet(np.eye(6) + D @ A)[1]
            found = bank.log_weight[0, m, k] - math.log(bank.share[m])
            assert found == pytest.approx(want, rel=1e-9, abs=1e-9)
            assert bank.first[0, m, k] == k
            mean = np.linalg.solve(A + np.linalg.inv(D), b)
            np.testing.assert_allclose(bank.mean[0, m, :, k], mean, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dof", [30.0, math.inf])
@pytest.mark.parametrize("rate", [0.0, 0.1])
def test_statistic_grows_by_one_a_good_spot_on_average(
    pool: study.Pool, rate: float, dof: float
) -> None:
    """The martingale that bounds the false alarms, from a state with evidence and merged onsets."""
    rng = np.random.default_rng(5)
    detector = Detector.start(1, 1, 3, outliers=1e5 * rate, good=1e5 * (1 - rate))
    looks = good_looks(pool, 90, 2)
    looks.e[80:] += np.einsum("nij,j->ni", looks.by_camera[80:], [6e-4, -6e-4, 6e-4, 0, 0, 0])
    detector.look_many(looks)
    before, saved = statistic(detector), detector.arrays()
    assert detector.watch.cameras.used.max() == SLOTS
    watch, plane = detector.watch, pool.plane[17]
    parts = watch.cameras.outliers[0], watch.lasers.outliers[0], watch.planes.outliers[plane]
    eps = change_rates.outlier_rate(watch.outliers, *parts)

    def mean_and_error(e: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
        looks = study.looks_of(pool, np.full(len(e), 17), e, dof)
        after = np.empty(len(e))
        for i in range(len(e)):
            again = Detector.from_arrays(saved)
            after[i] = again.look_many(part_of(looks, slice(i, i + 1)))[0].statistic
        after = weight * np.exp(after * math.log(detector.threshold))
        return float(after.mean()), float(after.std() / math.sqrt(len(after)))

    # good spots drawn too wide, and weighted: the mean hangs on rare large ratios
    normal, wide = stats.multivariate_normal([0, 0], np.eye(2)), stats.multivariate_t([1, 1], 9, 3)
    e = np.concatenate([rng.standard_normal((2000, 2)), wide.rvs(2000, random_state=rng)])
    drawn = 0.5 * normal.pdf(e) + 0.5 * wide.pdf(e)
    density = np.array([change_densities.expected_density(m, dof) for m in (e**2).sum(axis=1)])
    good, error = mean_and_error(e, density / drawn)
    gross, gross_error = mean_and_error(
        study.outlier_innovations(pool, np.full(1000, 17), rng), np.ones(1000)
    )
    mean = (1 - eps) * good + eps * gross
    error = math.hypot((1 - eps) * error, eps * gross_error)
    assert before > 10
    assert error < 0.05 * before
    assert mean < before + 1 + 3.5 * error
    assert mean > 0.9 * (before + 1) - 3.5 * error


def test_old_onsets_are_merged_and_forgotten(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3, good=600)
    detector.look_many(good_looks(pool, 3 * WINDOW, 3))
    bank = detector.watch.cameras
    for m in range(len(MAGNITUDES)):
        ages = bank.seen[0] - bank.age[0, m, : bank.used[0, m]]
        assert ages[0] <= WINDOW + 1
        assert np.all(np.diff(ages) < 0)
        assert ages[-16:].tolist() == list(range(16, 0, -1))
        assert np.max(ages[:-1] / ages[1:]) <= 2.0
    number = detector.number
    assert bank.first[0, 0, bank.used[0, 0] - 1] == number - 1


@pytest.mark.parametrize("sigma_px", [0.02, 5e-5])
def test_precise_pixels_keep_the_numbers_sound(sigma_px: float) -> None:
    """Information far beyond the prior's: rounding must not make evidence, nor hide a change."""
    precise = study.make_pool(2, sigma_px)
    detector = Detector.start(1, 1, 3, good=600)
    assert len(detector.look_many(good_looks(precise, 3000, 18))) == 3000
    for bank in (detector.watch.cameras, detector.watch.lasers, detector.watch.planes):
        assert np.isfinite(bank.log_total).all()
        assert np.isfinite(bank.mean).all()
        assert np.isfinite(bank.cov).all()
    index = np.arange(20)
    looks = study.looks_of(precise, index, np.zeros((20, 2)))
    turned = looks._replace(e=looks.by_camera[:, :, 0] * sigma_px * 0.06)
    assert detector.look_many(turned)[-1].alarm


# --- false alarms ------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [0.0, 0.01, 0.1, 0.2])
def test_good_streams_with_outliers_do_not_alarm(rate: float) -> None:
    alarms, largest, _ = study.false_alarms(40_000, rate, seed=1)
    assert alarms == []
    assert 0.4 < largest < 1


def test_uncertain_noise_scale_does_not_alarm() -> None:
    """40 000 spots right after a start with 52 degrees of freedom; Gaussian innovations would."""
    assert len(study.false_alarms_at_start(400, 100)) <= 1


def test_outliers_of_one_plane_only_do_not_alarm(pool: study.Pool) -> None:
    rng = np.random.default_rng(0)
    index = rng.integers(len(pool), size=20_000)
    e = rng.standard_normal((len(index), 2))
    bad = np.flatnonzero((rng.random(len(index)) < 0.2) & (pool.plane[index] == 0))
    e[bad] = study.outlier_innovations(pool, index[bad], rng)
    detector, looks = Detector.start(1, 1, 3), study.looks_of(pool, index, e)
    detector.remember(looks.who[:600], np.isin(np.arange(600), bad))
    assert detector.outlier_rate == pytest.approx(0.2 / 3, abs=0.02)
    assert len(detector.look_many(part_of(looks, slice(600, None)))) == len(index) - 600
    counts = detector.watch.planes.outliers
    np.testing.assert_allclose(counts[:, 0] / counts[:, 1], [0.2, 0, 0], atol=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.0, 0.01, 0.1])
def test_a_million_good_spots_alarm_in_no_more_than_ten_places(rate: float) -> None:
    alarms, _, _ = study.false_alarms(1_000_000, rate)
    assert len(alarms) <= 10


# --- delays ------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", study.PARTS)
@pytest.mark.parametrize(("size", "spots"), list(zip(study.SIZES, (5, 3, 2), strict=True)))
def test_a_moved_part_is_noticed_soon(part: str, size: tuple[float, float], spots: int) -> None:
    found = study.delays(part, size, 0.3, count=40)
    assert found["median"] <= spots
    assert found["onset"] <= 1
    assert found["onset_p90"] <= 4


def test_a_small_shift_in_much_noise_is_noticed_near_the_bound() -> None:
    found = study.delays("camera", (0.2, 1.0), 1.0, count=40)
    assert found["median"] <= 2 * found["bound"]
    assert found["onset"] <= 3


def test_a_bump_is_noticed_among_outliers() -> None:
    assert study.delays("camera", (0.2, 1.0), 0.3, rate=0.1, count=40)["median"] <= 5


def test_worse_noise_is_noticed_as_such(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3, good=600)
    detector.look_many(good_looks(pool, 300, 4))
    looks = good_looks(pool, 100, 5)
    found = detector.look_many(looks._replace(e=2.0 * looks.e))
    assert found[-1].alarm
    assert len(found) < 30
    assert detector.onsets()[0].kind == "spread"


def test_onsets_name_the_plane_that_moved(pool: study.Pool) -> None:
    looks = good_looks(pool, 200, 6)
    moved = looks.who[:, 2] == 1
    moved[:100] = False
    looks.e[moved] += np.einsum("nij,j->ni", looks.by_plane[moved], [0, 0, 4e-3])
    detector = Detector.start(1, 1, 3, good=600)
    verdict = detector.look_many(looks)[-1]
    assert verdict.alarm
    assert verdict.since is not None
    assert abs(int(moved[: verdict.since].sum())) <= 2
    found: dict[tuple[str, int], float] = {}
    for o in detector.onsets():
        key = o.kind, o.part
        found[key] = found.get(key, 0.0) + math.exp(o.log_weight)
    assert max(found, key=found.__getitem__) == ("planes", 1)


# --- the gate ----------------------------------------------------------------------------------


def test_gate_tells_outliers_from_good_spots(pool: study.Pool) -> None:
    rng = np.random.default_rng(8)
    index = rng.integers(len(pool), size=5000)
    e, bad = rng.standard_normal((5000, 2)), rng.random(5000) < 0.1
    e[bad] = study.outlier_innovations(pool, index[bad], rng)
    detector = Detector.start(1, 1, 3, outliers=60, good=540)
    verdicts = detector.look_many(study.looks_of(pool, index, e))
    called = np.array([v.outlier for v in verdicts])
    assert called[bad].mean() > 0.99
    assert called[~bad].mean() < 0.005
    assert detector.outlier_rate == pytest.approx(0.1, abs=0.01)
    for v, x in zip(verdicts, e, strict=True):
        assert v.length == pytest.approx(np.linalg.norm(x))
        assert v.outlier == (v.length > v.limit)
        assert bool(v.reason) == v.outlier
    v = next(v for v in verdicts if v.outlier)
    assert f"{v.length:.3g} sigma" in v.reason
    assert f"{v.limit:.3g}" in v.reason


def test_impossible_spots_are_outliers_and_a_run_of_them_alarms(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3, good=600)
    detector.look_many(good_looks(pool, 50, 9))
    looks = good_looks(pool, 5, 10)
    verdicts = detector.look_many(looks._replace(e=np.full((5, 2), np.nan)))
    assert len(verdicts) <= 3
    assert all(v.outlier and v.reason == "no spot should be there at all" for v in verdicts)
    assert not verdicts[0].alarm
    assert verdicts[-1].alarm
    assert verdicts[-1].since == 50
    assert detector.onsets()[0].kind.startswith("run of")


# --- state -------------------------------------------------------------------------------------


def test_one_by_one_equals_all_at_once(pool: study.Pool) -> None:
    looks = good_looks(pool, 120, 11)
    together, alone = Detector.start(1, 1, 3), Detector.start(1, 1, 3)
    verdicts = together.look_many(looks)
    assert [alone.look(single(looks, i)) for i in range(120)] == verdicts
    assert together.since() == alone.since()


def test_a_restored_detector_goes_on_to_the_same_digits(pool: study.Pool) -> None:
    looks = good_looks(pool, 400, 12)
    straight, first = Detector.start(1, 1, 3, good=40), Detector.start(1, 1, 3, good=40)
    straight.look_many(looks)
    first.look_many(part_of(looks, slice(0, 171)))
    second = Detector.from_arrays(first.arrays())
    second.look_many(part_of(looks, slice(171, 400)))
    want, found = straight.arrays(), second.arrays()
    assert want.keys() == found.keys()
    for name in want:
        np.testing.assert_array_equal(want[name], found[name], err_msg=name)


def test_a_copy_is_independent(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3)
    saved = detector.arrays()
    detector.look_many(good_looks(pool, 10, 13))
    assert saved["number"][0] == 0
    assert not np.isfinite(saved["cameras.log_total"]).any()


def test_new_parts_change_nothing_for_the_old(pool: study.Pool) -> None:
    looks = good_looks(pool, 300, 14)
    plain, grown = Detector.start(1, 1, 3), Detector.start(1, 1, 3)
    want = plain.look_many(looks)
    found = grown.look_many(part_of(looks, slice(0, 150)))
    grown.cover(2, 3, 5)
    grown.cover(1, 1, 1)
    found += grown.look_many(part_of(looks, slice(150, 300)))
    assert found == want
    assert len(grown.watch.planes.seen) == 5
    assert not grown.look(single(looks, 0)._replace(camera=1, laser=2, plane=4)).alarm
    assert grown.watch.planes.seen[4] == 1


def test_reset_forgets_the_evidence_and_the_outliers_of_a_moved_part(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3, good=600)
    looks = good_looks(pool, 100, 15)
    detector.look_many(looks)
    before = detector.outlier_rate
    verdict = detector.look_many(looks._replace(e=looks.e + 200.0))[-1]
    assert verdict.alarm
    assert verdict.since is not None
    assert abs(verdict.since - 100) <= 1
    assert detector.outlier_rate > 1.5 * before
    detector.reset(since=100)
    assert detector.onsets() == []
    assert detector.since() is None
    assert detector.outlier_rate == pytest.approx(before, rel=0.02)
    assert not detector.look_many(good_looks(pool, 200, 16))[-1].alarm


# --- what cannot be ----------------------------------------------------------------------------


def test_bad_input_is_refused_and_changes_nothing(pool: study.Pool) -> None:
    detector = Detector.start(1, 1, 3)
    look = single(good_looks(pool, 1, 17), 0)
    cases = [
        (look._replace(plane=3), "planes: there are 3, got index"),
        (look._replace(camera=-1), "cameras: there are 1"),
        (look._replace(area=0.0), "area"),
        (look._replace(dof=math.nan), "degrees of freedom"),
        (look._replace(e=np.zeros(3)), r"expected shape \(1, 2\)"),
        (look._replace(by_camera=np.zeros((2, 5))), "by_camera: expected shape"),
        (look._replace(by_laser=np.full((2, 4), np.nan)), "finite"),
        (look._replace(by_plane=np.zeros((2, 3))), "a plane must move its spots"),
    ]
    for bad, words in cases:
        with pytest.raises(DataError, match=words):
            detector.look(bad)
    assert detector.number == 0
    assert not detector.look(look).alarm


def test_bad_starts_are_refused() -> None:
    for threshold in (1.0, math.nan, math.inf):
        with pytest.raises(DataError, match="threshold"):
            Detector.start(threshold=threshold)
    with pytest.raises(DataError, match="counts"):
        Detector.start(outliers=-1)
    with pytest.raises(DataError, match="planes: there are 1, got index 1"):
        Detector.start().remember(np.array([[0, 0, 1]]), np.array([True]))
    with pytest.raises(DataError, match="expected shape"):
        Detector.start().remember(np.zeros((2, 3), dtype=int), np.array([True]))


def test_a_spoilt_checkpoint_is_refused() -> None:
    arrays = Detector.start(1, 1, 2).arrays()
    for name in ("planes.mean", "threshold", "spread"):
        with pytest.raises(DataError, match=name):
            Detector.from_arrays({k: v for k, v in arrays.items() if k != name})
    with pytest.raises(DataError, match=r"planes\.cov"):
        Detector.from_arrays({**arrays, "planes.cov": arrays["planes.cov"][:1]})
    with pytest.raises(DataError, match="number"):
        Detector.from_arrays({**arrays, "number": np.zeros(1)})
