"""Is ``distortion="auto"`` better than "all"? What it chooses, what errors and sigmas come of it.

``python tests/montecarlo/lens_study.py --seeds 200`` prints, for several cells, lenses and noises:
how often each model was chosen; the rms error of f_u (px), of the camera's place and of points
located on the planes (mm); and the smallest and the mean coverage of 95 % intervals by sigma over
the rows that all models have. The start has no distortion, so that what is left out is zero.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.simulate import PRESETS, Noise, Simulation, simulate, simulate_cell

TERMS = ("k1", "k2", "p1", "p2")
LENSES: dict[str, dict[str, float] | None] = {
    "own": None,
    "none": {},
    "mild": {"k1": -0.05, "k2": 0.02},
    "k1": {"k1": -0.2},
    "k1 k2": {"k1": -0.5, "k2": 1.0},
    "all": {"k1": -0.3, "k2": 0.3, "p1": 0.004, "p2": -0.003},
}
CASES = (
    ("paper", 1.0, "none"),
    ("paper", 1.0, "mild"),
    ("paper", 1.0, "k1"),
    ("paper", 1.0, "k1 k2"),
    ("paper", 1.0, "all"),
    ("paper", 0.3, "all"),
    ("table2-4", 1.98, "own"),
    ("table2-2", 1.88, "own"),
    ("tool-z", 1.0, "own"),
    ("tool-z", 1.0, "none"),
    ("no-groups", 1.0, "k1"),
)


@dataclass
class Tally:
    """What one way of choosing came to."""

    errors: list[list[float]] = field(default_factory=list)
    scores: list[dict[str, float]] = field(default_factory=list)
    chosen: Counter[str] = field(default_factory=Counter)
    failed: int = 0

    @property
    def rms(self) -> np.ndarray:
        return np.asarray(np.sqrt(np.mean(np.square(self.errors), axis=0)))

    @property
    def coverage(self) -> dict[str, float]:
        names = [n for n in self.scores[0] if all(n in s for s in self.scores)]
        return {n: float(np.mean([abs(s[n]) < 1.96 for s in self.scores])) for n in names}


def made_with(preset: str, pixel_px: float, lens: str, seed: int) -> Simulation:
    """A preset's cell and motions with another lens."""
    noise = Noise(pixel_px=pixel_px)
    base = simulate(preset, seed, noise)
    terms = LENSES[lens]
    if terms is None:
        return base
    cell = with_lens(base.truth, {t: terms.get(t, 0.0) for t in TERMS})
    plan = PRESETS[preset]
    return simulate_cell(
        cell, groups=plan.groups, shots=plan.shots, design=plan.design, noise=noise, seed=seed
    )


def with_lens(cell: lc.Cell, terms: dict[str, float]) -> lc.Cell:
    """The cell with other distortion terms in its camera."""
    camera = cell.cameras["camera"]
    moved = replace(camera, intrinsics=replace(camera.intrinsics, **terms))
    return replace(cell, cameras={"camera": moved})


def lens_study(preset: str, pixel_px: float, lens: str, seeds: Sequence[int]) -> dict[str, Tally]:
    """Tallies of "none", "all" and "auto" over captures."""
    tallies = {way: Tally() for way in ("none", "all", "auto")}
    for seed in seeds:
        made = made_with(preset, pixel_px, lens, seed)
        start = with_lens(made.truth, dict.fromkeys(TERMS, 0.0))
        known = {"principal_point": (320.0, 240.0), "skew": 0.0} if len(start.planes) == 1 else {}
        for way, tally in tallies.items():
            options = lc.CalibrationOptions(robust="none", distortion=way, known=known)
            try:
                found = lc.calibrate(made.observations, initial=start, options=options)
            except lc.LasercalError:
                tally.failed += 1
                continue
            if not found.fit.converged:
                tally.failed += 1
                continue
            tally.errors.append(errors_of(found, made))
            tally.scores.append(scores_of(found, made.truth))
            tally.chosen[" ".join(t for t in TERMS if found[t].sigma > 0) or "none"] += 1
    return tallies


def errors_of(found: lc.Calibration, made: Simulation) -> list[float]:
    """Errors of f_u (px), of the camera's place and, rms, of points located (mm)."""
    ours, true = found.cell.cameras["camera"], made.truth.cameras["camera"]
    names = made.observations.plane.tolist()
    points = [
        lc.spot_on_ray(c, made.observations.uv, plane=names) for c in (found.cell, made.truth)
    ]
    return [
        ours.intrinsics.fu - true.intrinsics.fu,
        1e3 * float(np.linalg.norm(ours.T_base_camera[:3, 3] - true.T_base_camera[:3, 3])),
        1e3 * float(np.sqrt(np.nanmean(np.sum((points[0] - points[1]) ** 2, axis=1)))),
    ]


def scores_of(found: lc.Calibration, truth: lc.Cell) -> dict[str, float]:
    """Error / sigma of every row but those of the distortion."""
    charts = {name: BeamChart.of(beam) for name, beam in truth.lasers.items()}
    true = dict(
        zip((n for n, _ in row_names(truth, charts)), row_values(truth, charts), strict=True)
    )
    scores = {}
    for row in found.parameters:
        if row.sigma > 0 and row.name not in TERMS and row.name in true:
            error = row.refined - float(true[row.name])
            error = (error + 180.0) % 360.0 - 180.0 if row.unit == "deg" else error
            scores[row.name] = error / row.sigma
    return scores


def print_case(preset: str, pixel_px: float, lens: str, seeds: Sequence[int]) -> None:
    print(f"{preset}, {pixel_px:g} px, lens {lens}")
    for way, tally in lens_study(preset, pixel_px, lens, seeds).items():
        f, T, located = tally.rms
        worst = min(tally.coverage, key=tally.coverage.__getitem__)
        mean = np.mean(list(tally.coverage.values()))
        chosen = dict(tally.chosen) if way == "auto" else ""
        print(
            f"  {way:5} f_u {f:6.2f} px  T {T:6.2f} mm  located {located:6.3f} mm  coverage least "
            f"{100 * tally.coverage[worst]:5.1f} % ({worst}), mean {100 * mean:5.1f} %  {chosen}"
            + (f"  {tally.failed} without an answer" if tally.failed else ""),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    given = parser.parse_args()
    for case in CASES:
        print_case(*case, range(given.seeds))


if __name__ == "__main__":
    main()
