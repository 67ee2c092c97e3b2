"""Monte Carlo study of diagnosis: is the right cause named, how soon, and is the part given back?

``python tests/montecarlo/bump_study.py --spots 90 --pixel 1 --seeds 100`` knocks the camera, the
laser and a plane of the paper's cell by three sizes, and makes the robot worse, and prints how
often the cause is named after 3, 5, 10 and 20 spots. ``--give-back`` adds how far from the truth,
in sigmas, the part is that the spots after the diagnosis give back.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from lasercal_factors.chart import CellChart

import lasercal_gtsam as lc
from lasercal_gtsam.graph import cell_from_state, state_from_cell
from lasercal_gtsam.incremental.belief import Belief, calibrated_parts, coordinates
from lasercal_gtsam.incremental.diagnosis import Diagnosis, diagnose
from lasercal_gtsam.incremental.recover import recover
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.simulate.bumps import bumped, spots_in_turn

NAMES = {"camera": "camera", "laser": "laser", "plane": "2", "robot": "", "none": ""}
SIZES = {"0.2 deg/1 mm": (0.2, 1.0), "2 deg/10 mm": (2.0, 10.0), "20 deg/100 mm": (20.0, 100.0)}
WORSE_ROBOT = Noise(hand_translation_m=1e-3, hand_rotation_rad=np.deg2rad(0.1))
AFTER = (3, 5, 10, 20)
# a change of so many sigmas (of all spots together) is noticed three times in four by the best test
# that cries wolf once in 100 000 times: chi-square with 6 degrees passes 33.1 = 5.75^2 that often
NOTICEABLE = 6.0
_TRIES = 30


@dataclass
class Tally:
    """What came out for one kind and size of change, over all seeds.

    ``right``: number of spots -> whether the right cause was the most probable, one a seed;
    ``sure``: the same with a probability of 0.95 or more; ``wrong_sure``: another cause with that;
    ``signal``: how far the change moves the spots, in sigmas (`signal_in_sigmas`);
    ``far``: largest error of the part given back, in sigmas; ``milliseconds`` for 10 spots.
    """

    right: dict[int, list[bool]] = field(default_factory=lambda: {n: [] for n in AFTER})
    sure: dict[int, list[bool]] = field(default_factory=lambda: {n: [] for n in AFTER})
    wrong_sure: dict[int, list[bool]] = field(default_factory=lambda: {n: [] for n in AFTER})
    named: list[str] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    signal: dict[int, list[float]] = field(default_factory=lambda: {n: [] for n in AFTER})
    far: list[float] = field(default_factory=list)
    score: list[float] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    def rate(self, spots: int) -> float:
        return float(np.mean(self.right[spots]))

    def rate_of_noticeable(self, spots: int) -> tuple[float, int]:
        """The same among the seeds in which the change can be noticed at all, and their number."""
        seen = np.array(self.signal[spots]) > NOTICEABLE
        return float(np.mean(np.array(self.right[spots])[seen])) if seen.any() else np.nan, int(
            seen.sum()
        )


def believed(seed: int, spots: int, pixel_px: float) -> tuple[lc.Cell, Belief, lc.Calibration]:
    """Truth, and what a calibration from that many spots knows of it."""
    made = simulate("paper", seed, Noise(pixel_px=pixel_px), groups=spots // 30)
    seen = with_sigma(made.observations, pixel_px)
    calibration = lc.calibrate(seen, initial=made.truth)
    return made.truth, Belief.of(calibration), calibration


def with_sigma(observations: lc.Observations, sigma_px: float) -> lc.Observations:
    cov = np.broadcast_to(sigma_px**2 * np.eye(2), (len(observations), 2, 2))
    return replace(observations, cov_uv=cov)


def changed(
    truth: lc.Cell,
    seen: lc.Observations,
    kind: str,
    size: tuple[float, float],
    seed: int,
    px: float,
) -> tuple[lc.Cell, lc.Observations]:
    """The cell after the change, and spots since; another bump where none would be in view."""
    noise = Noise(pixel_px=px)
    if kind in ("robot", "none"):
        noise = replace(WORSE_ROBOT, pixel_px=px) if kind == "robot" else noise
        return truth, spots_in_turn(truth, max(AFTER), seed + 5000, noise)
    name = NAMES[kind]
    on_plane = seen[seen.plane == NAMES["plane"]]
    middle = lc.spot_on_beam(truth, on_plane.T_base_hand, plane=NAMES["plane"]).mean(axis=0)
    turn, shift = np.deg2rad(size[0]), size[1] * 1e-3
    for attempt in range(_TRIES):
        rng = np.random.default_rng((seed, attempt))
        cell = bumped(truth, kind, name, turn, shift, rng, middle)
        try:
            return cell, spots_in_turn(cell, max(AFTER), seed + 5000, noise)
        except lc.DataError:
            continue
    raise lc.DataError(f"no bump of {kind} in view for seed {seed}")


def study(
    kind: str,
    size: tuple[float, float],
    seeds: Sequence[int],
    *,
    spots: int = 90,
    pixel_px: float = 1.0,
    after: Sequence[int] = AFTER,
    give_back: bool = False,
    outlier_rate: float = 0.01,
) -> Tally:
    """Diagnose one kind and size of change for many seeds."""
    tally = Tally()
    for seed in seeds:
        truth, belief, calibration = believed(seed, spots, pixel_px)
        cell, stream = changed(truth, calibration.inputs.observations, kind, size, seed, pixel_px)
        cov = calibration.fit.sigma0**2 * with_sigma(stream, pixel_px).cov_uv
        wanted = ("outliers" if kind == "none" else kind, NAMES[kind])
        for count in after:
            begun = time.process_time()
            found = diagnose(belief, stream[:count], cov[:count], outlier_rate=outlier_rate)
            spent = time.process_time() - begun
            best = found.causes[0]
            right = (best.kind, best.name) == wanted
            tally.signal[count].append(
                signal_in_sigmas(calibration, truth, cell, stream[:count], cov[:count])
            )
            tally.right[count].append(right)
            tally.sure[count].append(right and best.probability > 0.95)
            tally.wrong_sure[count].append(not right and best.probability > 0.95)
            if count == 10:
                tally.named.append(f"{best.kind} {best.name}".strip())
                tally.probability.append(
                    next(c.probability for c in found.causes if (c.kind, c.name) == wanted)
                )
                tally.milliseconds.append(1e3 * spent)
                if give_back and right and kind in ("camera", "laser", "plane"):
                    far, score = error_in_sigmas(belief, found, stream, cov, cell, kind)
                    tally.far.append(far)
                    tally.score.append(score)
    return tally


def signal_in_sigmas(
    calibration: lc.Calibration,
    old: lc.Cell,
    new: lc.Cell,
    seen: lc.Observations,
    cov: np.ndarray,
) -> float:
    """How far a change moves the spots, against pixel noise and what the calibration leaves open.

    By differences of `lasercal_gtsam.project`: nothing of the diagnosis is used.
    """
    mean, planes = calibrated_parts(calibration), seen.plane.tolist()
    chart = CellChart(state_from_cell(mean))

    def pixels(cell: lc.Cell) -> np.ndarray:
        return np.asarray(lc.project(cell, seen.T_base_hand, plane=planes).ravel())

    sigmas = np.sqrt(np.diag(calibration.covariance))
    steps = 0.01 * np.diag(sigmas)
    cells = [[cell_from_state(chart.state(d * s), mean) for d in (1.0, -1.0)] for s in steps]
    J = np.stack([(pixels(after) - pixels(before)) / 0.02 for after, before in cells], axis=1)
    S = J @ (calibration.covariance / np.outer(sigmas, sigmas)) @ J.T
    for i, block in enumerate(cov):
        S[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += block
    shift = pixels(new) - pixels(old)
    # a spot that the changed cell shows and the old one cannot is as far as can be
    if not (np.isfinite(shift).all() and np.isfinite(S).all()):
        return np.inf
    return float(np.sqrt(shift @ np.linalg.solve(S, shift)))


def error_in_sigmas(
    belief: Belief,
    found: Diagnosis,
    stream: lc.Observations,
    cov: np.ndarray,
    truth: lc.Cell,
    kind: str,
) -> tuple[float, float]:
    """Error of the part given back by all spots of the stream after it was set free.

    Largest of its coordinates, in sigmas, and the squared length of all in sigmas, which is
    chi-square with as many degrees of freedom as coordinates.
    """
    columns = belief.columns(kind, NAMES[kind])  # type: ignore[arg-type]
    fused = recover(belief, kind, NAMES[kind], stream, cov, start=found.cell)  # type: ignore[arg-type]
    covariance = fused.belief.covariance[columns, columns]
    error = coordinates(fused.cell, truth)[columns]
    far = float(np.abs(error / np.sqrt(np.diag(covariance))).max())
    return far, float(error @ np.linalg.solve(covariance, error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--spots", type=int, default=90, help="spots of the calibration before")
    parser.add_argument("--pixel", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--give-back", action="store_true")
    arguments = parser.parse_args()
    for kind in arguments.kinds:
        sizes = SIZES if kind in ("camera", "laser", "plane") else {"": (0.0, 0.0)}
        for label, size in sizes.items():
            tally = study(
                kind,
                size,
                range(arguments.seeds),
                spots=arguments.spots,
                pixel_px=arguments.pixel,
                give_back=arguments.give_back,
            )
            rates = "  ".join(
                f"{n}: {100 * tally.rate(n):.0f} % (sure {100 * np.mean(tally.sure[n]):.0f}, "
                f"wrongly {100 * np.mean(tally.wrong_sure[n]):.0f})"
                for n in AFTER
            )
            print(f"{kind:7s} {label:14s} {rates}", end="")
            if kind in ("camera", "laser", "plane"):
                noticeable, count = tally.rate_of_noticeable(10)
                print(f"  of {count} noticeable: {100 * noticeable:.0f} %", end="")
            others = [x for x, ok in zip(tally.named, tally.right[10], strict=True) if not ok]
            if others:
                print("  else", ", ".join(f"{n} {x}" for x, n in Counter(others).items()), end="")
            if tally.far:
                print(
                    f"  given back: {100 * np.mean(np.array(tally.far) < 3):.0f} % within 3 sigma, "
                    f"mean square {np.mean(tally.score):.2f}",
                    end="",
                )
            print(f"  {np.median(tally.milliseconds):.0f} ms", flush=True)


if __name__ == "__main__":
    main()
