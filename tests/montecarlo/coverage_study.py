"""Does the 95 % interval of every row of Table 2 hold the truth in 95 % of the captures?

``python tests/montecarlo/coverage_study.py run paper out.jsonl --seeds 1000`` adds one line for
each capture to a file (and goes on where it stopped); ``... table out.jsonl`` prints, for every
row, how often the truth lies in ``estimate +- t sigma``, in the likelihood's interval to first
order, and in the interval that `lasercal_gtsam.intervals` gives.

An interval holds the truth exactly if the truth's root lies within the limit, so that no end of an
interval has to be found.

Cells with one plane have weak priors. A posterior does not promise to cover one fixed truth but the
truth on the average over the prior; so what a prior says is drawn about the truth, like one more
measurement (as `check-sigma` does). ``--priors-as-they-are`` leaves them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

import lasercal_gtsam as lc
from lasercal_gtsam.confidence import likelihood_of
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.profile import RowProfile
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.simulate import Noise, Simulation, simulate

# the paper's cell, both cells of Table 2, and the commonest mount; pixel noise of the study
# below this root a value lies inside, whatever the correction makes of it (no end is there)
NEAR = 0.9
CELLS = {"paper": 1.0, "table2-4": 1.98, "table2-2": 1.88, "tool-z": 1.0}


def capture_study(
    preset: str, pixel_px: float, seed: int, draw_priors: bool = True, names: Sequence[str] = ()
) -> dict[str, object]:
    """One capture: row -> score, root, adjusted root and the interval's degrees of freedom.

    A row that the fit held in the end has no scores; ``trouble`` says where there is no answer.
    """
    made = simulate(preset, seed, Noise(pixel_px=pixel_px))
    options = lc.CalibrationOptions(robust="none", known=made.known)
    if draw_priors:
        options = replace(options, priors=drawn_priors(made, options, seed))
    try:
        found = lc.calibrate(made.observations, initial=made.truth, options=options)
        if not found.fit.converged:
            return {"seed": seed, "trouble": found.fit.status}
        likelihood = likelihood_of(found)
    except lc.LasercalError as error:
        return {"seed": seed, "trouble": str(error)}
    charts = {name: BeamChart.of(beam) for name, beam in made.truth.lasers.items()}
    rows: dict[str, list[float] | None] = {}
    truth = row_values(made.truth, charts)
    for (name, _), value, stated in zip(
        row_names(made.truth, charts), truth, found.parameters, strict=True
    ):
        if names and name not in names:
            continue
        if stated.name != name or not stated.sigma > 0:
            rows[name] = None
            continue
        profile = RowProfile.of(likelihood, name, charts)
        score = -profile.row.difference(float(value), stated.refined) / stated.sigma
        standing = profile.standing(float(value))
        roots = [np.nan, np.nan] if standing is None else [standing.root, standing.adjusted]
        rows[name] = [float(x) for x in (score, *roots, likelihood.dof)]
    return {"seed": seed, "rows": rows}


def drawn_priors(
    made: Simulation, options: lc.CalibrationOptions, seed: int
) -> dict[str, tuple[float, float]]:
    """The priors that one plane gets, with their means drawn about the truth."""
    i = made.truth.cameras["camera"].intrinsics
    rng = np.random.default_rng([seed, 77])
    drawn = {}
    for name, (_, sigma) in resolve_holds(made.observations, options, made.truth).priors.items():
        z = rng.standard_normal()
        if name == "aspect":
            ratio = i.fu / i.fv
            drawn[name] = (ratio * float(np.exp(sigma / ratio * z)), sigma)
        else:
            drawn[name] = (getattr(i, name) + sigma * z, sigma)
    return drawn


def results(path: Path) -> Iterator[dict[str, object]]:
    """Lines of a study's file."""
    if path.exists():
        with path.open() as file:
            for line in file:
                yield json.loads(line)


def coverages(lines: Sequence[dict[str, object]], level: float = 0.95) -> dict[str, np.ndarray]:
    """Row -> number of captures, coverage by sigma, by the root and by the adjusted root.

    Where a value is not reached the truth counts as outside.
    """
    rows: dict[str, list[list[float]]] = {}
    for line in lines:
        for name, scores in line.get("rows", {}).items():
            if scores is not None:
                rows.setdefault(name, []).append(scores)
    found = {}
    for name, scores in rows.items():
        x = np.array(scores, dtype=float)
        limit = stdtrit(x[:, 3], 0.5 + level / 2)
        inside = np.abs(x[:, :3]) <= limit[:, None]
        inside[:, 2] |= np.abs(x[:, 1]) < NEAR
        found[name] = np.array([len(x), *inside.mean(axis=0), np.isnan(x[:, 2]).sum()])
    return found


def print_table(path: Path) -> None:
    """One line for every row."""
    lines = list(results(path))
    troubled = [line for line in lines if "trouble" in line]
    print(f"{path.name}: {len(lines)} captures, {len(troubled)} without an answer")
    for line in troubled[:5]:
        print(f"  seed {line['seed']}: {str(line['trouble'])[:100]}")
    print(f"{'row':12} {'n':>5} {'sigma':>7} {'root':>7} {'interval':>8} {'not reached':>12}")
    for name, (n, *covered, lost) in coverages(lines).items():
        mark = "" if 0.93 <= covered[2] <= 0.97 else "  <--"
        values = " ".join(f"{100 * c:7.1f}" for c in covered)
        print(f"{name:12} {int(n):5d} {values} {int(lost):12d}{mark}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["run", "table"])
    parser.add_argument("cell", help=f"run: a preset, such as {', '.join(CELLS)}; table: the file")
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--pixel", type=float)
    parser.add_argument("--priors-as-they-are", action="store_true")
    given = parser.parse_args()
    if given.what == "table":
        print_table(Path(given.cell))
        return
    done = {line["seed"] for line in results(given.out)}
    pixel = CELLS.get(given.cell, 1.0) if given.pixel is None else given.pixel
    with given.out.open("a") as file:
        for seed in range(given.seeds):
            if seed not in done:
                line = capture_study(given.cell, pixel, seed, not given.priors_as_they_are)
                file.write(json.dumps(line) + "\n")
                file.flush()
    print_table(given.out)


if __name__ == "__main__":
    main()
