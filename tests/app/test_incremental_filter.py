"""The compiled steps of the running estimate, each against an independent way to the number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from incremental_cases import PLAIN, batch_of, shuffled, sigmas_between, stream
from lasercal_factors import stream_kernels
from lasercal_factors.batch import Loss
from lasercal_factors.chart import CellChart
from lasercal_factors.stream_kernels import HELD_BACK, LEFT_OUT, USED, Weighing

import lasercal_gtsam as lc
from lasercal_gtsam.graph import (
    cell_from_state,
    make_batch,
    pixel_covariances,
    state_from_cell,
)
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.incremental.belief import Belief, coordinates, fuse, marginalised
from lasercal_gtsam.incremental.filter import Filter, about_origin, about_point
from lasercal_gtsam.incremental.store import SEGMENT, SpotStore, records_of, split_records
from lasercal_gtsam.rotations import rotation_exp, rotation_log
from lasercal_gtsam.simulate import Noise

NO_NOISE = Weighing(np.zeros(6), 1.0)


@pytest.fixture(scope="module")
def spots():
    return stream(groups=5, noise=Noise(1.0))[1]


@pytest.fixture(scope="module")
def calibration(spots):
    return lc.calibrate(spots, options=PLAIN)


def stored(spots, sigma_px=1.0, mark=USED):
    store = SpotStore(dict(spots.image_size))
    store.append(spots, sigma_px, mark)
    return store


def running(spots, calibration, **settings):
    held = np.diag(calibration.covariance) == 0.0
    tied = settings.pop("aspects", (None,))
    return Filter(stored(spots), calibration.cell, held, tied, **settings)


def somewhere(chart, seed=0):
    """Chart coordinates well away from the origin: 3 deg, 10 mm, 10 px."""
    size = np.r_[[0.05] * 3, [0.01] * 3, [10.0] * 5, [0.02] * 2, [1e-3] * 2]
    size = np.concatenate([size, [0.02, 0.02, 0.002, 0.002], np.tile([0.05, 0.05, 0.01], 3)])
    return size * np.random.default_rng(seed).uniform(-1, 1, chart.n)


def whitened(chart, template, z, spots, cov):
    """Whitened residuals (2N,) at chart coordinates, spot by spot; numpy only."""
    cell = cell_from_state(chart.state(z), template)
    names = {k: getattr(spots, k).tolist() for k in ("plane", "camera", "laser")}
    r = lc.project(cell, spots.T_base_hand, **names) - spots.uv
    w = np.linalg.cholesky(np.linalg.inv(cov)).transpose(0, 2, 1)
    return np.einsum("nij,nj->ni", w, r)


def numerical(chart, template, z, spots, cov):
    """Whitened Jacobian and residuals, (2N, n+1)."""
    step = 1e-6
    columns = []
    for j in range(chart.n):
        d = np.zeros(chart.n)
        d[j] = step
        sides = [whitened(chart, template, z + s * d, spots, cov).ravel() for s in (1, -1)]
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.column_stack([*columns, whitened(chart, template, z, spots, cov).ravel()])


def test_accumulate_is_the_information_of_the_used_spots_in_the_chart(spots, calibration):
    cov = np.tile([[1.2, 0.3], [0.3, 0.7]], (len(spots), 1, 1))
    store = SpotStore(dict(spots.image_size))
    store.append(replace(spots, cov_uv=cov), mark=USED)
    filter = Filter(store, calibration.cell, np.zeros(28, np.bool_), (None,))
    filter.use(0, len(spots))
    z = somewhere(filter.chart)
    linear = filter._at(z)
    (_, (records, path, _)) = next(store.slices(0, len(spots)))
    J = numerical(filter.chart, calibration.cell, z, spots, cov)
    lengths = np.hypot(*J[:, -1].reshape(-1, 2).T)
    limit = float(np.median(lengths))
    mark = np.full(len(spots), USED, np.uint8)
    mark[:5] = HELD_BACK
    H, sums = stream_kernels.accumulate(
        records, path, mark, linear.view, NO_NOISE, limit, True, len(spots) - 1
    )
    good = lengths <= limit
    assert np.array_equal(mark[5:], np.where(good, USED, LEFT_OUT)[5:]) and (mark[:5] == 2).all()
    used = np.repeat(mark == USED, 2)
    expected = J[used].T @ J[used]
    scale = np.sqrt(np.diag(expected))
    assert np.abs((H - expected) / np.outer(scale, scale)).max() < 1e-6
    pixels = (
        lc.project(
            cell_from_state(filter.chart.state(z), calibration.cell),
            spots.T_base_hand,
            plane=spots.plane.tolist(),
        )
        - spots.uv
    )
    assert sums[0] == (mark == USED).sum()
    assert sums[1] == pytest.approx((pixels[mark == USED] ** 2).sum())
    assert sums[2] == pytest.approx((lengths[mark == USED] ** 2).sum())
    assert sums[3] == (mark == LEFT_OUT).sum()


def test_fading_weighs_each_spot_by_those_that_came_after_it(spots, calibration):
    filter = running(spots, calibration, weighing=Weighing(np.zeros(6), 0.9))
    for k in range(len(spots)):
        filter.use(k, k + 1)
    weights = 0.9 ** np.arange(len(spots))[::-1]
    batch = make_batch(spots, 1.0).weighted(weights)
    assert filter._linear.sums[0] == pytest.approx(weights.sum())
    assert filter._linear.H[-1, -1] == pytest.approx(
        batch.total_loss(state_from_cell(calibration.cell), Loss())
    )
    before = filter._linear.H.copy()
    filter.relinearise()
    again = running(spots, calibration, weighing=Weighing(np.zeros(6), 0.9))
    again.use(0, len(spots))
    assert np.allclose(again._linear.H, before, rtol=1e-9, atol=1e-9 * np.abs(before).max())


def test_hand_corrections_are_those_of_the_batch_method(spots, calibration):
    noise = HandNoise(1e-3, np.deg2rad(0.05))
    cov = pixel_covariances(spots, 0.5)
    store = SpotStore(dict(spots.image_size))
    store.append(spots, 0.5, USED)
    weighing = Weighing(noise.variances, 1.0)
    filter = Filter(store, calibration.cell, np.zeros(28, np.bool_), (None,), weighing=weighing)
    filter.use(0, len(spots))
    eta = np.zeros((len(spots), 6))
    for _ in range(6):
        eta = corrections(*linearized(spots, calibration.cell, eta), cov, noise)
    batch = corrected_batch(spots, cov, calibration.cell, noise, eta)
    state = state_from_cell(calibration.cell)
    assert filter._linear.H[-1, -1] == pytest.approx(batch.total_loss(state, Loss()), rel=1e-5)
    rows = batch.rows(state)
    assert np.trace(filter._linear.H[15:19, 15:19]) == pytest.approx(
        (rows[..., 15:19] ** 2).sum(), rel=1e-4
    )


def test_an_innovation_is_prediction_and_its_covariance(spots, calibration):
    """Against `Calibration.predict`, which has its own derivatives."""
    known, new = spots[:-1], spots[-1:]
    first = lc.calibrate(known, options=PLAIN)
    filter = running(known, first, scale=first.fit.sigma0)
    filter.use(0, len(known))
    filter.relinearise()
    filter.store.append(new)
    seen = filter.expect(len(known))
    names = {"plane": str(new.plane[0])}
    uv, cov = first.predict(new.T_base_hand, **names)
    assert seen.residual_px == pytest.approx((uv - new.uv)[0], abs=1e-4)
    total = cov[0] + first.fit.sigma0**2 * np.eye(2)
    assert seen.covariance_px2 == pytest.approx(total, rel=1e-4)
    assert seen.chi2 == pytest.approx(
        float((uv - new.uv)[0] @ np.linalg.solve(total, (uv - new.uv)[0])), rel=1e-3
    )
    assert seen.area == pytest.approx(np.sqrt(np.linalg.det(total)), rel=1e-4)
    # whitened derivatives by what may move, numerically
    L = np.linalg.cholesky(np.linalg.inv(total)).T
    chart = filter.chart
    for block, columns in ((slice(0, 6), range(6)), (slice(6, 10), range(15, 19))):
        for column, j in zip(range(*block.indices(13)), columns, strict=True):
            z = np.zeros(28)
            z[j] = 1e-6
            sides = []
            for sign in (1, -1):
                cell = cell_from_state(chart.state(filter.z + sign * z), first.cell)
                sides.append(lc.project(cell, new.T_base_hand, **names)[0])
            by = (sides[0] - sides[1]) / 2e-6
            mine = seen.by_parts[:, column]
            # whitening is unique up to a rotation
            assert np.linalg.norm(mine) == pytest.approx(np.linalg.norm(L @ by), rel=1e-3)
            e = L @ (uv - new.uv)[0]
            assert mine @ seen.e == pytest.approx(
                (L @ by) @ e, rel=5e-3, abs=1e-3 * abs(mine).max()
            )


@pytest.mark.parametrize("aspect", [None, 1.01])
def test_estimate_solves_the_constrained_normal_equations(spots, calibration, aspect):
    filter = running(spots, calibration, aspects=(aspect,))
    filter.use(0, len(spots))
    linear, n = filter._linear, 28
    free = ~(np.diag(calibration.covariance) == 0.0)
    E = np.eye(n)[:, free]
    if aspect is not None:
        E = np.eye(n)
        E[6, 7] = aspect
        free[6] = False
        E = E[:, free]
    A, b = linear.H[:n, :n], linear.H[:n, n]
    step = E @ np.linalg.solve(E.T @ A @ E, E.T @ b)
    assert filter.z == pytest.approx(linear.z - step, rel=1e-6, abs=1e-12)
    left = linear.H[n, n] - b @ step
    assert filter.estimate.cost == pytest.approx(left, rel=1e-9)
    assert filter.dof == 2 * len(spots) - free.sum()


def test_a_quadratic_moved_there_and_back_is_the_same():
    rng = np.random.default_rng(0)
    J, z = rng.standard_normal((12, 6)), rng.standard_normal(5)
    quadratic = J.T @ J
    there = about_point(quadratic, z)
    moved = np.column_stack([J[:, :5], J[:, 5] + J[:, :5] @ z])
    assert there == pytest.approx(moved.T @ moved)
    assert about_origin(there, z) == pytest.approx(quadratic)


@pytest.mark.parametrize("aspect", [None, 1.01])
def test_one_spot_adds_the_same_by_its_own_rows(spots, calibration, aspect):
    slow, fast = (running(spots, calibration, aspects=(aspect,)) for _ in range(2))
    for filter in (slow, fast):
        filter.use(0, 100)
        filter.store.mark(120, 121, LEFT_OUT)
    slow.use(100, 130)
    for k in range(100, 130):
        fast.use(k, k + 1, fast.expect(k))
    scale = np.sqrt(np.maximum(np.diag(slow._linear.H), 1e-12))
    assert np.abs((fast._linear.H - slow._linear.H) / np.outer(scale, scale)).max() < 1e-12
    assert fast._linear.sums == pytest.approx(slow._linear.sums, rel=1e-9)
    assert fast.z == pytest.approx(slow.z, rel=1e-9, abs=1e-12)


def test_taking_spots_out_is_never_having_had_them(spots, calibration):
    filter, without = (running(spots, calibration) for _ in range(2))
    filter.use(0, len(spots))
    filter.take_out(100, len(spots), HELD_BACK)
    without.store.mark(100, len(spots), HELD_BACK)
    without.use(0, len(spots))
    assert filter.z == pytest.approx(without.z, rel=1e-9, abs=1e-12)
    assert filter.estimate.cost == pytest.approx(without.estimate.cost, rel=1e-9)


def test_folding_changes_nothing_at_the_point_of_linearisation(spots, calibration):
    filter = running(spots, calibration)
    filter.use(0, len(spots))
    before = filter.estimate
    filter.fold(90)
    after = filter.estimate
    assert after.z == pytest.approx(before.z, rel=1e-7, abs=1e-11)
    assert after.sigma0 == pytest.approx(before.sigma0, rel=1e-9)
    assert len(filter.store) == len(spots) - 90
    assert np.allclose(after.covariance(), before.covariance(), rtol=1e-6, atol=1e-15)


def test_forgetting_a_part_leaves_the_rest_its_marginal(spots, calibration):
    filter = running(spots, calibration)
    filter.use(0, len(spots))
    filter.relinearise()
    known = filter.estimate.covariance()
    filter.fold(len(spots))
    filter.forget_part(slice(0, 6))
    open_now = filter.estimate.covariance()
    assert np.isnan(open_now[:6]).all()
    # marginalised: the covariance of the rest is what it was
    assert np.allclose(open_now[6:, 6:], known[6:, 6:], rtol=1e-5, atol=1e-14)


def test_a_step_that_makes_it_worse_is_taken_back(spots, calibration):
    """From a bad start plain Gauss-Newton diverges; damping brings it back."""
    rng = np.random.default_rng(3)
    good = lc.calibrate(spots, options=PLAIN)
    start = np.zeros(28)
    start[:3] = 0.35 * rng.standard_normal(3)
    start[6:8] = 250.0
    start[15:17] = 0.2
    filter = running(spots, good, start=start, robust=False)
    filter.use(0, len(spots))
    for _ in range(6):
        filter.relinearise(0.01)
    assert filter.fallbacks > 0
    assert sigmas_between(filter.estimate.cell, good) < 0.01


def test_marginalised_is_the_schur_complement():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((20, 8))
    information = A.T @ A
    held = np.zeros(8, np.bool_)
    rest = marginalised(information, slice(2, 5), held)
    keep = [0, 1, 5, 6, 7]
    covariance = np.linalg.inv(information)
    assert rest[np.ix_(keep, keep)] == pytest.approx(
        np.linalg.inv(covariance[np.ix_(keep, keep)]), rel=1e-9
    )
    assert not rest[2:5].any() and not rest[:, 2:5].any()


def test_belief_and_spots_together_are_all_spots(spots):
    """Half as a Gaussian, half as spots: the batch solution of all, but for the curvature."""
    spots = shuffled(spots, 4)
    half = len(spots) // 2
    options = lc.CalibrationOptions(distortion="none", sigma_px=1.0)
    first = lc.calibrate(spots[:half], options=options)
    belief = Belief.of(first)
    assert belief.covariance == pytest.approx(first.covariance, rel=1e-6, abs=1e-12)
    cov = first.fit.sigma0**2 * pixel_covariances(spots[half:], 1.0)
    fused = fuse(belief, spots[half:], cov)
    assert not fused.troubles
    batch = lc.calibrate(spots, options=options, initial=first.cell)
    assert sigmas_between(fused.cell, batch) < 0.3
    assert np.sqrt(np.diag(fused.belief.covariance)) == pytest.approx(
        np.sqrt(np.diag(batch.covariance)), rel=0.15
    )


def test_coordinates_undo_the_chart(calibration):
    chart = CellChart(state_from_cell(calibration.cell), (None,))
    for seed in range(5):
        z = somewhere(chart, seed)
        cell = cell_from_state(chart.state(z), calibration.cell)
        assert coordinates(calibration.cell, cell) == pytest.approx(z, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 2.0, 3.0, 3.14, np.pi])
def test_rotation_log_undoes_exp(angle):
    rng = np.random.default_rng(0)
    for _ in range(5):
        axis = rng.standard_normal(3)
        w = angle * axis / np.linalg.norm(axis)
        R = rotation_exp(w)
        assert rotation_exp(rotation_log(R)) == pytest.approx(R, abs=1e-9)
        assert np.linalg.norm(rotation_log(R)) == pytest.approx(angle, abs=1e-8)


def test_the_store_gives_back_what_it_got_across_segments(spots):
    store = SpotStore(dict(spots.image_size))
    whole = spots
    while len(whole) < 3000:
        whole = whole + whole
    pieces = 0
    while len(store) < SEGMENT + 500:
        store.append(whole, 2.0, USED)
        pieces += 1
    back = store.observations(SEGMENT - 100, SEGMENT + 100)
    number = (SEGMENT - 100) % len(whole)
    expected = whole[[(number + i) % len(whole) for i in range(200)]]
    assert np.array_equal(back.uv, expected.uv) and np.array_equal(back.id, expected.id)
    assert np.array_equal(back.plane, expected.plane)
    assert np.abs(back.T_base_hand - expected.T_base_hand).max() < 1e-15
    assert np.isnan(back.cov_uv).all()
    store.forget(SEGMENT + 10)
    assert store.first == SEGMENT + 10 and store.label(SEGMENT + 20)
    with pytest.raises(KeyError):
        store.label(5)


def test_a_stored_spot_takes_112_bytes(spots):
    records = records_of(spots, np.zeros(len(spots), np.bool_), 0.7)
    assert records[0].nbytes == 112
    uv, cov, T = split_records(records)
    assert np.array_equal(uv, spots.uv)
    assert cov == pytest.approx(pixel_covariances(spots, 0.7), rel=1e-12)
    assert pytest.approx(spots.T_base_hand, abs=1e-15) == T


def test_the_estimate_is_the_batch_one_whatever_the_order(spots, calibration):
    for seed in range(3):
        mixed = shuffled(spots, seed)
        filter = running(mixed, calibration)
        filter.use(0, len(mixed))
        filter.relinearise()
        batch = batch_of(mixed, type("U", (), {"cell": calibration.cell}))
        assert sigmas_between(filter.estimate.cell, batch) < 1e-3
