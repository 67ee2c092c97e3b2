"""Outliers of any share, found from the data alone: distance from the clean spots' optimum.

``python tests/montecarlo/outlier_study.py outliers.jsonl --seeds 200`` runs it, one line of a file
for each capture, and prints the table: for each share of outliers, anywhere in the picture or on
one ghost (the pixel of a fixed specular reflection), how often the answer is within half a sigma
(rms over all unknowns) of the optimum of the clean spots, and precision and recall of the spots
named. Begun again it goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4)
KINDS = ("uniform", "ghost")
# rms distance in sigmas from the optimum of the clean spots that counts as reached
REACHED = 0.5
# an outlier is at least this far from where the spot would be seen (pixel sigmas); what is nearer
# cannot be told from noise by anyone
_DISTINCT = 8.0
# scatter of a ghost's pixel, in pixel sigmas
_GHOST_SIGMAS = 2.0


@dataclass
class Outcome:
    """One capture: distance in sigmas (inf without an answer), spots named well, badly, missed."""

    distance: float
    right: int
    wrong: int
    missed: int
    converged: bool
    seconds: float
    refusal: str = ""


@dataclass(frozen=True)
class Tally:
    """All captures of one share and kind."""

    outcomes: tuple[Outcome, ...]

    @property
    def reached(self) -> float:
        """Share of the captures within `REACHED`."""
        return float(np.mean([o.distance <= REACHED for o in self.outcomes]))

    @property
    def silent(self) -> int:
        """Captures with a far answer that is called converged."""
        return sum(o.converged and o.distance > REACHED for o in self.outcomes)

    @property
    def precision(self) -> float:
        """Share of the spots named that are outliers (1 where none was named)."""
        named = sum(o.right + o.wrong for o in self.outcomes)
        return sum(o.right for o in self.outcomes) / named if named else 1.0

    @property
    def recall(self) -> float:
        """Share of the outliers that were named (1 where there are none)."""
        planted = sum(o.right + o.missed for o in self.outcomes)
        return sum(o.right for o in self.outcomes) / planted if planted else 1.0


def plant(
    seen: lc.Observations, share: float, kind: str, sigma_px: float, seed: int
) -> tuple[lc.Observations, np.ndarray]:
    """Replace a share of the spots; returns the observations and (N,) which are outliers.

    ``kind``: "uniform", anywhere in the picture, or "ghost", near one pixel of the capture.
    """
    count, size = len(seen), np.array(seen.image_size[seen.cameras[0]], dtype=np.float64)
    rng = np.random.default_rng([seed, round(100 * share), KINDS.index(kind)])
    ghost = rng.uniform(0.2, 0.8, 2) * size
    far = np.linalg.norm(seen.uv - ghost, axis=1) > _DISTINCT * sigma_px
    eligible = np.flatnonzero(far) if kind == "ghost" else np.arange(count)
    chosen = np.sort(rng.choice(eligible, round(share * count), replace=False))
    uv = seen.uv.copy()
    if kind == "ghost":
        uv[chosen] = ghost + _GHOST_SIGMAS * sigma_px * np.clip(
            rng.standard_normal((len(chosen), 2)), -2.0, 2.0
        )
    else:
        for k in chosen:
            while np.linalg.norm(uv[k] - seen.uv[k]) <= _DISTINCT * sigma_px:
                uv[k] = rng.uniform(0.0, size - 1.0)
    return replace(seen, uv=uv), np.isin(np.arange(count), chosen)


@cache
def captured(spots: int, sigma_px: float, seed: int) -> lc.Observations:
    """The paper's cell with 90 spots, or 900 (ten rotations of thirty poses on each plane)."""
    groups, shots = {90: (3, 10), 900: (10, 30)}[spots]
    noise = Noise(pixel_px=sigma_px)
    return simulate("paper", seed, noise, groups=groups, shots=shots).observations


def rms_sigmas(found: lc.Calibration, clean: lc.Calibration) -> float:
    """Rms over the unknowns of the distance between two answers, in the clean one's sigmas.

    ``sqrt(d^T C^-1 d / m)``, and ``d^T C^-1 d`` is how far, in pixel sigmas, the two cells predict
    the clean spots apart (which needs no coordinates).
    """
    seen = clean.inputs.observations
    names = {k: getattr(seen, k).tolist() for k in ("plane", "camera", "laser")}
    a, b = (lc.project(cell, seen.T_base_hand, **names) for cell in (found.cell, clean.cell))
    unknowns = 2 * len(seen) - clean.fit.dof
    distance = float(np.sqrt(np.sum((a - b) ** 2) / unknowns)) / clean.fit.sigma0
    return distance if np.isfinite(distance) else float("inf")


def distance_from_clean(
    found: lc.Calibration, seen: lc.Observations, truth: lc.Cell, options: lc.CalibrationOptions
) -> float:
    """`rms_sigmas` from least squares on the clean spots, begun at the truth or without a start.

    The two differ where the distortion has two minima that fit equally well (now and then, with 90
    spots): either is what the clean spots give.
    """
    distance = rms_sigmas(found, lc.calibrate(seen, initial=truth, options=options))
    if distance > REACHED:
        with suppress(lc.LasercalError):
            distance = min(distance, rms_sigmas(found, lc.calibrate(seen, options=options)))
    return distance


def outcome_of(
    spots: int, share: float, kind: str, seed: int, options: lc.CalibrationOptions, sigma_px: float
) -> Outcome:
    """One capture, without a start, against least squares on its clean spots from the same."""
    seen, spoiled = plant(captured(spots, sigma_px, seed), share, kind, sigma_px, seed)
    begin = time.process_time()
    try:
        found = lc.calibrate(seen, options=options)
    except lc.LasercalError as error:
        refusal = f"{type(error).__name__}: {str(error)[:90]}"
        seconds = time.process_time() - begin
        return Outcome(float("inf"), 0, 0, int(spoiled.sum()), False, seconds, refusal)
    seconds = time.process_time() - begin
    named = np.array([reason is not None for reason in found.spots.rejected])
    plain = replace(options, robust="none")
    return Outcome(
        distance_from_clean(found, seen[~spoiled], _truth(spots, seed), plain),
        int((named & spoiled).sum()),
        int((named & ~spoiled).sum()),
        int((~named & spoiled).sum()),
        found.fit.converged,
        seconds,
    )


def outlier_study(
    spots: int,
    share: float,
    kind: str,
    seeds: Sequence[int],
    robust: str = "auto",
    sigma_px: float = 1.0,
    distortion: str = "all",
) -> Tally:
    """Captures of the paper's cell with 90 or 900 spots, a share of them outliers of that kind."""
    cases = [Case(spots, kind, share, seed, robust, distortion, sigma_px) for seed in seeds]
    return Tally(tuple(case.run() for case in cases))


@cache
def _truth(spots: int, seed: int) -> lc.Cell:
    groups, shots = {90: (3, 10), 900: (10, 30)}[spots]
    return simulate("paper", seed, groups=groups, shots=shots).truth


def table_row(share: float, kind: str, tally: Tally, seeds: Sequence[int]) -> str:
    """One line of the study's table, and the seeds that were not reached."""
    far = [
        f"{seed}{'' if o.converged else '*'}"
        for seed, o in zip(seeds, tally.outcomes, strict=True)
        if o.distance > REACHED
    ]
    seconds = np.array([o.seconds for o in tally.outcomes])
    distances = np.array([o.distance for o in tally.outcomes])
    return (
        f"{100 * share:3.0f} % {kind:8} reached {100 * tally.reached:5.1f} %  "
        f"median {np.median(distances):.3f} most {distances.max():.3f} sigma  "
        f"silent {tally.silent}  "
        f"precision {tally.precision:.4f}  recall {tally.recall:.4f}  "
        f"{np.median(seconds):.2f} s  far: {' '.join(far) or 'none'}"
    )


@dataclass(frozen=True)
class Case:
    """One capture of the study."""

    spots: int
    kind: str
    share: float
    seed: int
    robust: str
    distortion: str
    pixel: float

    def run(self) -> Outcome:
        options = lc.CalibrationOptions(robust=self.robust, distortion=self.distortion)
        return outcome_of(self.spots, self.share, self.kind, self.seed, options, self.pixel)


def read_outcomes(path: Path) -> dict[Case, Outcome]:
    """What a file of `keep` holds."""
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [json.loads(line) for line in lines]
    return {Case(**row["case"]): Outcome(**row["outcome"]) for row in rows}


def run_into(path: Path, cases: Iterable[Case]) -> None:
    """Run what the file does not hold yet, one line for each as it goes."""
    known = read_outcomes(path)
    with path.open("a") as file:
        for case in cases:
            if case not in known:
                row = {"case": asdict(case), "outcome": asdict(case.run())}
                print(json.dumps(row), file=file, flush=True)


def print_table(outcomes: dict[Case, Outcome]) -> None:
    """A line for each number of spots, kind and share, over the seeds there are."""
    print("(seeds with * were refused or not called converged; seconds of processor time)")
    cells: dict[tuple[str, str, float, int, str, float], list[tuple[int, Outcome]]] = {}
    for case, outcome in outcomes.items():
        key = (case.robust, case.distortion, case.pixel, case.spots, case.kind, case.share)
        cells.setdefault(key, []).append((case.seed, outcome))
    for (robust, distortion, pixel, spots, kind, share), found in sorted(cells.items()):
        seeds, results = zip(*sorted(found, key=lambda pair: pair[0]), strict=True)
        head = f"{robust}, distortion {distortion}, {pixel:g} px, {spots} spots, {len(seeds)} seeds"
        print(f"{head}: {table_row(share, kind, Tally(tuple(results)), seeds)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="JSON lines; what it holds is not run again")
    parser.add_argument("--robust", nargs="+", default=["auto"])
    parser.add_argument("--spots", type=int, nargs="+", default=[90, 900], choices=[90, 900])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--pixel", type=float, default=1.0, help="px")
    parser.add_argument("--distortion", default="all", choices=["all", "none"])
    parser.add_argument("--shares", type=float, nargs="+", default=SHARES)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    given = parser.parse_args()
    run_into(
        given.file,
        (
            Case(spots, kind, share, seed, robust, given.distortion, given.pixel)
            for seed in range(given.first, given.first + given.seeds)
            for spots in given.spots
            for share in given.shares
            for kind in (given.kinds if share > 0 else given.kinds[:1])
            for robust in given.robust
        ),
    )
    print_table(read_outcomes(given.file))


if __name__ == "__main__":
    main()
