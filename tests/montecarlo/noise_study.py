"""Robot noise: are the sigmas right, and what is it worth to state it.

``python tests/montecarlo/noise_study.py nees --seeds 500`` prints, for pixel noise only, robot
noise only and both, the mean normalised squared error (NEES) of all unknowns together, the
likelihood ratio of the truth (which does not care how the unknowns are written), and the spread of
each row of the table. ``... components`` does so with the noise levels estimated along with the
cell. ``... mixture`` compares the errors of f_u, R and T with those of least squares that knows
nothing of the robot, over the noise levels of the paper's Figure 6; ``... limit`` says what any
unbiased estimate can gain there.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from lasercal_factors.batch import Loss
from scipy.stats import chi2, f

import lasercal_gtsam as lc
from lasercal_gtsam.graph import make_batch, pixel_covariances, spread_columns, state_from_cell
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.incremental.belief import coordinates
from lasercal_gtsam.options import HAND_NOISE_NAMES
from lasercal_gtsam.sigma_check.statistics import nees_check
from lasercal_gtsam.simulate import Noise, simulate

# noise, and what is stated of it; a pixel sigma of zero whitens nothing, so that a hundredth stands
# for it
BOTH = Noise(0.3, 1e-3, float(np.radians(0.05)))
CASES = {
    "pixel": (Noise(0.3), Noise(0.3)),
    "robot": (replace(BOTH, pixel_px=0.0), replace(BOTH, pixel_px=0.01)),
    "both": (BOTH, BOTH),
}  # fmt: skip
ESTIMATED = {"hand_sigma_m": 0.0, "hand_sigma_rad": 0.0, "estimate_noise": HAND_NOISE_NAMES}
LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)


def stated(noise: Noise) -> dict[str, float]:
    """What is told of the noise."""
    return {
        "sigma_px": noise.pixel_px,
        "hand_sigma_m": noise.hand_translation_m,
        "hand_sigma_rad": noise.hand_rotation_rad,
    }


@dataclass(frozen=True)
class Nees:
    """Normalised squared errors of all free unknowns together, one a capture.

    ``stated``: with the covariance of the stated noise; ``scaled``: with the reported one, which
    the residuals scale (``dof`` degrees of freedom), so that it has an F distribution times
    ``dimension``. ``ratio``: cost at the truth over that at the estimate, which is chi-square too
    if the model holds, however curved it is. ``scores``: (seeds, rows) error over reported sigma of
    the table's rows. ``levels``: (seeds, levels) noise levels found, ``reach``: whether their 95 %
    intervals hold the truth.
    """

    stated: np.ndarray
    ratio: np.ndarray
    scaled: np.ndarray
    dimension: int
    dof: float
    names: tuple[str, ...]
    scores: np.ndarray
    skipped: Mapping[int, str]
    levels: np.ndarray
    reach: np.ndarray

    @property
    def expected_scaled(self) -> tuple[float, float, float]:
        """Mean of ``scaled`` to expect, and its 99 % band (normal approximation)."""
        law = f(self.dimension, self.dof)
        mean, sigma = self.dimension * law.mean(), self.dimension * law.std()
        half = 2.576 * sigma / np.sqrt(len(self.scaled))
        return mean, mean - half, mean + half


def nees_study(
    noise: Noise, options: Mapping[str, Any], seeds: Sequence[int], preset: str, **shape: int
) -> Nees:
    """Solve captures from the truth and weigh the errors."""
    plain, ratio, scaled, scores, levels, reach, skipped = [], [], [], [], [], [], {}
    real = stated(noise)
    for seed in seeds:
        made = simulate(preset, seed, noise, **shape)
        chosen = lc.CalibrationOptions(**{"robust": "none", "known": made.known, **options})
        try:
            found = lc.calibrate(made.observations, initial=made.truth, options=chosen)
        except lc.LasercalError as error:
            skipped[seed] = str(error)[:100]
            continue
        if not found.fit.converged:
            skipped[seed] = found.fit.status[:100]
            continue
        free = np.diag(found.covariance) > 0
        truth = made.truth.restricted(found.cell)
        e = coordinates(found.cell, truth)[free]
        P = found.covariance[np.ix_(free, free)]
        scale = np.sqrt(np.diag(P))
        value = float((e / scale) @ np.linalg.solve(P / np.outer(scale, scale), e / scale))
        scaled.append(value)
        # where the pixel sigma was missing, sigma0 holds it
        unit = found.fit.sigma0 if chosen.sigma_px else 1.0
        plain.append(value * unit**2)
        ratio.append(_cost(found, truth) - _cost(found, found.cell))
        scores.append(_scores(found, made.truth))
        levels.append([x.value for x in found.fit.noise])
        reach.append([x.low <= real[x.name] <= x.high for x in found.fit.noise])
    names = tuple(p.name for p in found.parameters if p.sigma > 0)
    usual = max({len(x) for x in scores}, key=[len(x) for x in scores].count)
    return Nees(
        np.array(plain), np.array(ratio), np.array(scaled), int(free.sum()), found.fit.dof, names,
        np.array([x for x in scores if len(x) == usual]), skipped,
        np.array(levels), np.array(reach),
    )  # fmt: skip


def _cost(found: lc.Calibration, cell: lc.Cell) -> float:
    """Whitened cost of a cell at the likeliest hand poses, with the noise that the fit had."""
    seen, options = found.inputs.observations, found.options_used
    noise = HandNoise.of(options)
    cov = pixel_covariances(seen, options.sigma_px or found.fit.sigma0)
    eta = np.zeros((len(seen), 6))
    for _ in range(6):
        eta = corrections(*linearized(seen, cell, eta), cov, noise, seen.shared_stops)
    return corrected_batch(seen, cov, cell, noise, eta).total_loss(state_from_cell(cell), Loss())


def _scores(found: lc.Calibration, truth: lc.Cell) -> np.ndarray:
    from studies import _difference, _rows

    rows = _rows(truth, found.cell)
    return np.array(
        [
            _difference(p.refined, rows[p.name], p.unit) / p.sigma
            for p in found.parameters
            if p.sigma > 0
        ]
    )


def print_nees(title: str, found: Nees) -> None:
    """NEES against its bands, coverage, and the rows."""
    n, d = len(found.scaled), found.dimension
    check = nees_check(found.stated, d)
    print(f"{title}: {n} captures, {d} unknowns, {len(found.skipped)} skipped {found.skipped}")
    print(
        f"  stated noise: NEES {found.stated.mean():.3f} +- {found.stated.std() / np.sqrt(n):.3f}, "
        f"99 % band {check.low:.3f} to {check.high:.3f}; "
        f"inside 95 %: {np.mean(found.stated < chi2(d).ppf(0.95)):.3f}"
    )
    print(f"  likelihood ratio {found.ratio.mean():.3f}; inside 95 %: "
          f"{np.mean(found.ratio < chi2(d).ppf(0.95)):.3f}")  # fmt: skip
    mean, low, high = found.expected_scaled
    inside = np.mean(found.scaled / d < f(d, found.dof).ppf(0.95))
    print(
        f"  scaled by residuals: NEES {found.scaled.mean():.3f}, F promises {mean:.3f}, 99 % band "
        f"{low:.3f} to {high:.3f}; inside 95 %: {inside:.3f}"
    )
    std, bias = found.scores.std(axis=0, ddof=1), found.scores.mean(axis=0)
    cover = (np.abs(found.scores) < 1.96).mean(axis=0)
    print(
        f"  rows: std {std.min():.3f} ({found.names[std.argmin()]}) to {std.max():.3f} "
        f"({found.names[std.argmax()]}), bias up to {np.abs(bias).max():.3f} sigma, 95 % interval "
        f"covers {cover.min():.3f} ({found.names[cover.argmin()]}) to {cover.max():.3f}, "
        f"mean {cover.mean():.3f}",
        flush=True,
    )
    if found.levels.size:
        print(
            f"  levels: median {np.median(found.levels, axis=0)}, mean square root "
            f"{np.sqrt((found.levels**2).mean(axis=0))}, zero in "
            f"{(found.levels == 0).mean(axis=0)}, 95 % interval covers {found.reach.mean(axis=0)}",
            flush=True,
        )


def mixture(seeds: Sequence[int]) -> None:
    """Figure 6: mean errors of f_u, R, T (percent) without and with the robot's noise stated."""
    from studies import _errors

    total: dict[str, list[np.ndarray]] = {"unweighted": [], "stated": [], "estimated": []}
    for level in LEVELS:
        noise = Noise.table1(level)
        ways = {
            "unweighted": {},
            "stated": stated(noise),
            "estimated": {"estimate_noise": HAND_NOISE_NAMES},
        }
        errors: dict[str, list[tuple[float, float, float]]] = {way: [] for way in ways}
        for seed in seeds:
            made = simulate("paper", seed, noise)
            row = {}
            for way, told in ways.items():
                options = lc.CalibrationOptions(robust="none", distortion="none", **told)
                try:
                    found = lc.calibrate(made.observations, initial=made.truth, options=options)
                except lc.LasercalError as error:
                    print(f"  level {level} seed {seed} {way}: {error}", flush=True)
                    break
                row[way] = _errors(found.cell, made.truth)
            else:
                for way in ways:
                    errors[way].append(row[way])
        for way in ways:
            total[way].append(np.array(errors[way]) / level)
        print_mixture(f"level {level}", {w: np.array(e) for w, e in errors.items()})
    print_mixture("all levels (over level)", {w: np.concatenate(e) for w, e in total.items()})


def limit(seeds: Sequence[int], level: float = 1.0) -> None:
    """What stating the robot's noise can gain at most, by linear propagation.

    With ``V`` the whole covariance of the pixels, least squares has ``(A^T A)^-1 A^T V A
    (A^T A)^-1``, the best linear unbiased estimate ``(A^T V^-1 A)^-1``: the Cramer-Rao bound.
    """
    noise = Noise.table1(level)
    hand = HandNoise(noise.hand_translation_m, noise.hand_rotation_rad)
    options = lc.CalibrationOptions(distortion="none")
    gains = []
    for seed in seeds:
        made = simulate("paper", seed)
        seen, cell = made.observations, made.truth.restricted(made.observations)
        B, _ = linearized(seen, cell, np.zeros((len(seen), 6)))
        V = noise.pixel_px**2 * np.eye(2) + np.einsum("nij,j,nkj->nik", B, hand.variances, B)
        rows = make_batch(seen, 1.0).rows(state_from_cell(cell))[..., :-1]
        free = ~resolve_holds(seen, options, cell).held
        A = spread_columns(rows, cell, seen)[..., free]
        scale = np.linalg.norm(A, axis=(0, 1))
        A = A / scale
        plain = np.linalg.inv(np.einsum("nai,naj->ij", A, A))
        spread = plain @ np.einsum("nai,nab,nbj->ij", A, V, A, optimize=True) @ plain
        best = np.linalg.inv(np.einsum("nai,naj->ij", A, np.linalg.solve(V, A)))
        parts = slice(6, 7), slice(0, 3), slice(3, 6)  # f_u, R, T
        rms = [
            [np.sqrt(np.sum((np.diag(P) / scale**2)[part])) for part in parts]
            for P in (spread, best)
        ]
        gains.append(rms)
    before, after = np.array(gains).transpose(1, 0, 2)
    print(
        f"level {level}: at most f_u, R, T less by "
        f"{np.round(100 * (1 - after.mean(axis=0) / before.mean(axis=0)), 2)} % over {len(gains)} "
        "captures"
    )


def print_mixture(title: str, errors: Mapping[str, np.ndarray]) -> None:
    """Mean errors and how far each way is below the first, with its standard error."""
    first = next(iter(errors.values()))
    print(f"{title}, {len(first)} captures: f_u, R, T in percent")
    for way, e in errors.items():
        gain = 1 - e.mean(axis=0) / first.mean(axis=0)
        paired = (e - (1 - gain) * first).std(axis=0) / first.mean(axis=0) / np.sqrt(len(e))
        rms = 1 - np.sqrt((e**2).mean(axis=0) / (first**2).mean(axis=0))
        text = ", ".join(f"{x:.3f}" for x in 100 * e.mean(axis=0))
        less = ", ".join(
            f"{100 * g:.1f} +- {100 * s:.1f}" for g, s in zip(gain, paired, strict=True)
        )
        print(f"  {way:10} mean {text}; less by {less} %; rms less by {np.round(100 * rms, 1)} %",
              flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=["nees", "mixture", "limit", "components"])
    parser.add_argument("--seeds", type=int, default=500)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--groups", type=int)
    parser.add_argument("--shots", type=int)
    parser.add_argument("--distortion", default="none", help="all, none or names with commas")
    parser.add_argument("--cases", default=",".join(CASES))
    given = parser.parse_args()
    seeds = range(given.seeds)
    if given.study == "mixture":
        return mixture(seeds)
    if given.study == "limit":
        return limit(seeds)
    terms = given.distortion
    distortion = terms if terms in ("all", "none") else tuple(terms.split(","))
    shape = {k: v for k in ("groups", "shots") if (v := getattr(given, k)) is not None}
    for case in given.cases.split(","):
        noise, told = CASES[case]
        options: dict[str, Any] = {"distortion": distortion, **stated(told)}
        if given.study == "components":
            options |= {"sigma_px": None, **ESTIMATED}
        found = nees_study(noise, options, seeds, given.preset, **shape)
        print_nees(f"{given.study}, {given.preset} {shape}, distortion {terms}, {case}", found)
    return None


if __name__ == "__main__":
    main()
