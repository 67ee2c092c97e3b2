"""How often the change detector cries wolf, and how soon it notices: callable studies.

Streams are made as the calibrator sees them: poses, cells and Jacobians of the paper's simulated
cell, innovations whitened with pixel noise and with the uncertainty left by `before` spots. Good
spots are drawn as what they are in a linear model, independent normal vectors; moved parts by
projecting through the moved cell.

    python tests/montecarlo/detector_study.py            # everything, about five minutes
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from lasercal_factors.batch import SpotBatch
from lasercal_factors.beam import basis_across
from scipy.spatial.transform import Rotation

from lasercal_gtsam.cell import Beam, Cell, Plane
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.incremental.detector import Detector, Looks
from lasercal_gtsam.projection import project, spot_on_beam
from lasercal_gtsam.simulate import simulate

SIZES = ((0.2, 1.0), (2.0, 10.0), (20.0, 100.0))
PARTS = ("camera", "laser", "plane")


@dataclass(frozen=True)
class Pool:
    """Spots of one cell with what a calibrator knows of them before it sees them."""

    cell: Cell
    T: Array
    plane: Array
    uv: Array
    W: Array  # (N, 2, 2) px -> whitened innovation
    G: Array  # (N, 2, 13) camera 6, laser 4, plane 3, whitened
    area: Array
    sigma_px: float

    def __len__(self) -> int:
        return len(self.T)

    @property
    def size(self) -> tuple[int, int]:
        return self.cell.cameras["camera"].image_size


def make_pool(seed: int, sigma_px: float, before: int = 600, groups: int = 35) -> Pool:
    """About 30 ``groups`` spots, known as well as ``before`` other spots of the cell allow."""
    simulated = simulate("paper", seed, groups=groups, shots=10)
    seen, cell = simulated.observations, simulated.truth
    order = np.random.default_rng(seed).permutation(len(seen))
    planes = list(cell.planes)
    who = np.array([planes.index(p) for p in seen.plane.tolist()])
    zeros = np.zeros(len(seen), dtype=int)
    cov = np.tile(sigma_px**2 * np.eye(2), (len(seen), 1, 1))
    batch = SpotBatch.from_arrays(seen.uv, cov, seen.T_base_hand, zeros, zeros, who)
    rows = batch.rows(state_from_cell(cell))[:, :, :22]
    J = np.zeros((len(seen), 2, 19 + 3 * len(planes)))
    J[:, :, :19] = rows[:, :, :19]
    for i, p in enumerate(who):
        J[i, :, 19 + 3 * p : 22 + 3 * p] = rows[i, :, 19:]
    known = J[order[np.arange(before) % len(order)]].reshape(-1, J.shape[2])
    P = np.linalg.inv(known.T @ known)
    S = np.eye(2) + J @ P @ np.swapaxes(J, 1, 2)
    W = np.linalg.inv(np.linalg.cholesky(S))
    G = W @ rows[:, :, [0, 1, 2, 3, 4, 5, *range(15, 22)]]
    width, height = cell.cameras["camera"].image_size
    area = width * height / sigma_px**2 * np.linalg.det(W)
    return Pool(cell, seen.T_base_hand, who, seen.uv, W / sigma_px, G, area, sigma_px)


def looks_of(pool: Pool, index: Array, e: Array, dof: float = math.inf) -> Looks:
    """Innovations ``e`` at spots of the pool."""
    who = np.zeros((len(index), 3), dtype=np.int64)
    who[:, 2] = pool.plane[index]
    G = pool.G[index]
    parts = (np.ascontiguousarray(G[:, :, s]) for s in (slice(6), slice(6, 10), slice(10, 13)))
    return Looks(e, who, *parts, pool.area[index], np.full(len(index), dof))


def outlier_innovations(pool: Pool, index: Array, rng: np.random.Generator) -> Array:
    """Uniform over the picture."""
    anywhere = rng.uniform(-0.5, np.array(pool.size) - 0.5, (len(index), 2))
    return np.einsum("nij,nj->ni", pool.W[index], pool.uv[index] - anywhere)


def false_alarms(
    spots: int,
    rate: float,
    sigma_px: float = 1.0,
    seed: int = 0,
    *,
    chunk: int = 20_000,
    outliers: Callable[..., Array] = outlier_innovations,
    started: float = 600.0,
) -> tuple[list[int], float, float]:
    """Alarms in a stream of good spots with outliers; largest statistic; CPU us per spot."""
    pool, rng = make_pool(seed, sigma_px), np.random.default_rng(seed + 1)
    detector = Detector.start(1, 1, 3, outliers=rate * started, good=(1 - rate) * started)
    alarms, largest, cpu = [], 0.0, 0.0
    for first in range(0, spots, chunk):
        count = min(chunk, spots - first)
        index = rng.integers(len(pool), size=count)
        e = rng.standard_normal((count, 2))
        bad = np.flatnonzero(rng.random(count) < rate)
        e[bad] = outliers(pool, index[bad], rng)
        looks, at = looks_of(pool, index, e), 0
        while at < count:
            t = time.process_time()
            verdicts = detector.look_many(Looks(*(a[at:] for a in looks)))
            cpu += time.process_time() - t
            at += len(verdicts)
            largest = max(largest, *(v.statistic for v in verdicts))
            if verdicts[-1].alarm:
                alarms.append(first + at - 1)
                detector.reset()
    return alarms, largest, cpu / spots * 1e6


def false_alarms_at_start(streams: int, spots: int, dof: int = 52, seed: int = 0) -> list[int]:
    """Spots at which streams alarm whose noise is only known from a start with ``dof``.

    The scale is estimated on as the stream goes, as the calibrator does.
    """
    pool, alarms = make_pool(seed, 1.0, before=40), []
    for stream in range(streams):
        rng = np.random.default_rng([seed, 3, stream])
        z = rng.standard_normal((spots, 2))
        nu = dof + 2.0 * np.arange(spots)
        sums = rng.chisquare(dof) + np.concatenate([[0.0], np.cumsum((z**2).sum(axis=1))[:-1]])
        scale = np.sqrt(sums / nu)
        looks = looks_of(pool, rng.integers(len(pool), size=spots), z / scale[:, None])
        detector = Detector.start(1, 1, 3, good=40)
        verdicts = detector.look_many(looks._replace(dof=nu))
        if verdicts[-1].alarm:
            alarms.append(len(verdicts))
    return alarms


def moved_cell(pool: Pool, part: str, turn_deg: float, shift_mm: float, seed: int) -> Cell:
    """The cell with one part moved in a random direction; planes: always the first."""
    rng, cell = np.random.default_rng([seed, 7]), pool.cell
    axis, across = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn, shift = np.radians(turn_deg), shift_mm / 1000
    R = Rotation.from_rotvec(turn * axis).as_matrix()
    if part == "camera":
        camera = cell.cameras["camera"]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, shift * across
        moved = replace(camera, T_base_camera=camera.T_base_camera @ T)
        return replace(cell, cameras={"camera": moved})
    if part == "laser":
        beam = cell.lasers["laser"]
        return replace(
            cell, lasers={"laser": Beam(R @ beam.direction_hand, beam.point_hand + shift * across)}
        )
    name = next(iter(cell.planes))
    n = cell.planes[name].normal_base
    T = pool.T[pool.plane == 0]
    middle = spot_on_beam(cell, T, plane=name, laser="laser").mean(axis=0)
    tilt = basis_across(n) @ (np.array([np.cos(a := rng.uniform(0, 2 * np.pi)), np.sin(a)]) * turn)
    normal = Rotation.from_rotvec(tilt).as_matrix() @ n
    distance = normal @ middle + shift * rng.choice([-1.0, 1.0]) * (n @ normal)
    planes = {**cell.planes, name: Plane(normal, distance)}
    return replace(cell, planes=planes)


@dataclass(frozen=True)
class Notice:
    """One bump: spots of the part until the alarm (nan: never), error of the onset, in spots."""

    delay: float
    onset_error: float
    bound: float  # ln(A) / (delta^2 / 2), what a clairvoyant test needs on average


def bump(pool: Pool, part: str, turn_deg: float, shift_mm: float, seed: int, rate: float) -> Notice:
    """A calm stream, then one part moves."""
    rng = np.random.default_rng([seed, 11])
    moved = moved_cell(pool, part, turn_deg, shift_mm, seed)
    names = np.array(list(moved.planes))
    uv = project(moved, pool.T, plane=names[pool.plane].tolist(), camera="camera", laser="laser")
    with np.errstate(invalid="ignore"):
        visible = np.all((uv >= -0.5) & (uv <= np.array(pool.size) - 0.5), axis=1)
    affected = visible & ((pool.plane == 0) if part == "plane" else True)
    shift = np.einsum("nij,nj->ni", pool.W, pool.uv - uv)
    bound = 2 * math.log(1e5) / np.mean(np.sum(shift[affected] ** 2, axis=1))
    detector = Detector.start(1, 1, 3, outliers=600 * rate, good=600 * (1 - rate))

    def stream(index: Array, e: Array) -> Looks:
        bad = np.flatnonzero(rng.random(len(index)) < rate)
        e[bad] = outlier_innovations(pool, index[bad], rng)
        return looks_of(pool, index, e)

    index = rng.integers(len(pool), size=200)
    detector.look_many(stream(index, rng.standard_normal((200, 2))))
    calm = detector.number
    index = rng.choice(np.flatnonzero(visible), size=3000 if turn_deg < 1 else 300)
    e = shift[index] + np.einsum(
        "nij,nj->ni", pool.W[index], pool.sigma_px * rng.standard_normal((len(index), 2))
    )
    verdicts = detector.look_many(stream(index, e))
    if not verdicts[-1].alarm:
        return Notice(math.nan, math.nan, bound)
    hit = affected[index]
    delay = int(hit[: len(verdicts)].sum())
    since = verdicts[-1].since - calm
    error = float(hit[:since].sum()) if since >= 0 else float(since)
    return Notice(delay, error, bound)


def delays(
    part: str, size: tuple[float, float], sigma_px: float, rate: float = 0.0, count: int = 100
) -> dict[str, float]:
    """Medians over random directions and ten cells."""
    pools = [make_pool(seed, sigma_px) for seed in range(10)]
    found = [bump(pools[s % 10], part, *size, s, rate) for s in range(count)]
    delay = np.array([np.nan_to_num(n.delay, nan=np.inf) for n in found])
    onset = np.abs([n.onset_error for n in found])
    return {
        "median": float(np.median(delay)),
        "p90": float(np.quantile(delay, 0.9, method="higher")),
        "max": float(delay.max()),
        "onset": float(np.nanmedian(onset)),
        "onset_p90": float(np.nanquantile(onset, 0.9)),
        "bound": float(np.median([n.bound for n in found])),
    }


def main() -> None:
    for sigma_px in (0.3, 1.0):
        for part in PARTS:
            for size in SIZES:
                for rate in (0.0, 0.1):
                    row = delays(part, size, sigma_px, rate)
                    words = " ".join(f"{k} {v:.3g}" for k, v in row.items())
                    print(
                        f"{part:7} {size} {sigma_px} px, {rate:.0%} outliers: {words}", flush=True
                    )
    for rate in (0.0, 0.01, 0.1):
        alarms, largest, cpu = false_alarms(1_000_000, rate)
        print(f"{rate:.0%}: {len(alarms)} alarms, {largest:.3f}, {cpu:.1f} us/spot", flush=True)


if __name__ == "__main__":
    main()
