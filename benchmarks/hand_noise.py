"""Robot noise eliminated in closed form against hand poses as variables: same answer, time.

Both solve the same problem (1 mm, 0.05 deg, 0.3 px, all 28 unknowns of the cell) from the true cell
with the hand poses as commanded. Prints one row for each number of spots; README.md beside this
file explains the columns.
"""

from __future__ import annotations

import os

# read when numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gtsam
import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.graph import CellGraph, cell_from_state, make_graph, pixel_covariances
from lasercal_gtsam.hand_noise import HandNoise
from lasercal_gtsam.hand_noise.elimination import noisy_batch
from lasercal_gtsam.hand_noise.explicit import HandPoseGraph
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.incremental.belief import coordinates
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.solve import Solution, solve
from lasercal_gtsam.uncertainty import estimate_uncertainty

# number of spots: (hand rotations per plane, poses per rotation) on three planes
SIZES = {90: (3, 10), 300: (10, 10), 900: (10, 30)}
NOISE = Noise(0.3, 1e-3, float(np.radians(0.05)))
OPTIONS = lc.CalibrationOptions(
    sigma_px=NOISE.pixel_px,
    hand_sigma_m=NOISE.hand_translation_m,
    hand_sigma_rad=NOISE.hand_rotation_rad,
    robust="none",
)
TOLERANCE = 1e-10


def problem_of(seen: Observations, start: lc.Cell) -> CellGraph:
    """The cell's graph with the hand poses eliminated inside its factor."""
    nobody = np.zeros(len(seen), np.bool_)
    cov = pixel_covariances(seen, OPTIONS.sigma_px)
    batch = noisy_batch(seen, cov, HandNoise.of(OPTIONS), nobody)
    return make_graph(seen, batch, resolve_holds(seen, OPTIONS, start), start)


def checked(seen: Observations, start: lc.Cell) -> Solution:
    """With Newton polish and plausibility checks, covariance and leverages."""
    found = solve(problem_of(seen, start))
    estimate_uncertainty(found)
    return found


def begun_at(posed: HandPoseGraph, seen: Observations, start: lc.Cell) -> gtsam.Values:
    """Values of the explicit graph at a cell, hand poses as commanded."""
    values, keys = gtsam.Values(posed.values), posed.cell
    (camera,), (beam,) = start.cameras.values(), start.lasers.values()
    pose, lens = keys.cameras[0]
    values.update(pose, gtsam.Pose3(camera.T_base_camera))
    values.update(lens, camera.intrinsics.to_gtsam())
    values.update(keys.lasers[0], keys.frames[0].coordinates(beam.direction_hand, beam.point_hand))
    for key, name in zip(keys.planes, seen.planes, strict=True):
        n, d = start.planes[name].normal_base, start.planes[name].distance
        values.update(key, gtsam.OrientedPlane3(gtsam.Unit3(n), -d))
    for hand, k in zip(posed.hands, np.argsort(posed.hand_of_spot), strict=True):
        values.update(hand, gtsam.Pose3(seen.T_base_hand[k]))
    return values


def optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Levenberg-Marquardt, and the factorisation that marginals are read from."""
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setRelativeErrorTol(TOLERANCE)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    gtsam.Marginals(graph, found)
    return found


def polished(posed: HandPoseGraph, values: gtsam.Values) -> gtsam.Values:
    """Some Newton steps more, so that the comparison is with the optimum."""
    for _ in range(5):
        values = values.retract(posed.graph.linearize(values).optimize())
    return values


def distance(found: Solution, posed: HandPoseGraph, values: gtsam.Values) -> float:
    """Largest difference of a coordinate of the cell between the two answers, in its sigmas."""
    other = cell_from_state(posed.cell.read(values), found.cell)
    sigmas = np.sqrt(np.diag(estimate_uncertainty(found).covariance))
    return float(np.max(np.abs(coordinates(found.cell, other)) / sigmas))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    columns = ("spots", "core ms", "checked ms", "whole ms", "explicit ms")
    print(*columns, "explicit/core", "/checked", "/whole", "sigmas", sep=" | ")
    for spots, (groups, shots) in SIZES.items():
        made = simulate("paper", 1, NOISE, groups=groups, shots=shots)
        seen, start = made.observations, made.truth
        posed = lc.hand_pose_graph(lc.calibrate(seen, initial=start, options=OPTIONS))
        values, problem = begun_at(posed, seen, start), problem_of(seen, start)
        ways: dict[str, Callable[[], Any]] = {
            "core": partial(optimum, problem.graph, problem.start_values()),
            "checked": partial(checked, seen, start),
            "whole": partial(lc.calibrate, seen, initial=start, options=OPTIONS),
            "explicit": partial(optimum, posed.graph, values),
        }
        times: dict[str, list[float]] = {way: [] for way in ways}
        found: dict[str, Any] = {}
        for _ in range(rounds):
            for way, work in ways.items():
                for _ in range(1 if way == "explicit" else 5):
                    begin = time.process_time()
                    found[way] = work()
                    times[way].append(time.process_time() - begin)
        # what else the machine does can only add
        ms = {way: 1e3 * min(t) for way, t in times.items()}
        ratios = [ms["explicit"] / ms[way] for way in ("core", "checked", "whole")]
        apart = distance(found["checked"], posed, polished(posed, found["explicit"]))
        cells = [f"{x:.3g}" for x in (*ms.values(), *ratios)]
        print(spots, *cells, f"{apart:.1g}", sep=" | ", flush=True)


if __name__ == "__main__":
    main()
