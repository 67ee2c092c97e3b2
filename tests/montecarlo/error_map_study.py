"""Does the map of expected error hold? Located points against the truth over many captures.

``python tests/montecarlo/error_map_study.py paper --pixel 0.2 --seeds 2000`` solves the same hand
poses with new noise again and again, locates 25 pixels on every plane, and compares the root mean
squared distance from the true points with what `lasercal_gtsam.figures.error_map` says. Points
among the spots, and the same number outside them, where the answer is an extrapolation.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.figures import ErrorMap, error_maps
from lasercal_gtsam.projection import project_points
from lasercal_gtsam.simulate import PRESETS, Noise, Simulation, simulate
from lasercal_gtsam.units import MM_PER_M

POINTS = 25


@dataclass(frozen=True)
class PlaneStudy:
    """Errors of located points on one plane.

    Attributes
    ----------
    plane : its name
    inside : (P,) whether each point lies among the spots
    rms_mm : (P,) distance from the truth, root mean square over the captures
    expected_mm : (P,) what the calibrations say of it, root mean square over the captures
    map_mm : (P,) what the map of the first capture says
    """

    plane: str
    inside: np.ndarray
    rms_mm: np.ndarray
    expected_mm: np.ndarray
    map_mm: np.ndarray

    @property
    def ratio(self) -> np.ndarray:
        """Expected over true error: 1 is right, below 1 is too hopeful."""
        return np.asarray(self.expected_mm / self.rms_mm)


@dataclass(frozen=True)
class MapStudy:
    """All planes; ``sigma0`` of the first capture over that of all, which scales its map."""

    planes: tuple[PlaneStudy, ...]
    captures: int
    skipped: dict[int, str]
    scale: float

    def ratios(self, inside: bool = True) -> np.ndarray:
        """Ratios of all points among the spots, or outside them."""
        return np.concatenate([p.ratio[p.inside == inside] for p in self.planes])


def error_map_study(
    preset: str,
    noise: Noise,
    seeds: Sequence[int],
    options: lc.CalibrationOptions | None = None,
) -> MapStudy:
    """Solve the preset's own hand poses with new noise, once for each seed."""
    made = simulate(preset, 0)
    options = replace(options or lc.CalibrationOptions(), robust="none", known=made.known)
    first = _solved(made, noise, seeds[0], options)
    places = [_points(first.cell, one) for one in error_maps(first)]
    true = [
        lc.spot_on_ray(made.truth, uv, plane=one.plane, camera=one.camera)
        for one, uv, _, _ in places
    ]
    squares = [np.zeros(len(inside)) for _, _, inside, _ in places]
    variances = [np.zeros(len(inside)) for _, _, inside, _ in places]
    skipped: dict[int, str] = {}
    scales: list[float] = []
    for seed in seeds:
        try:
            found = _solved(made, noise, seed, options)
        except lc.LasercalError as error:
            skipped[seed] = str(error)[:100]
            continue
        if not found.fit.converged:
            skipped[seed] = found.fit.status[:100]
            continue
        scales.append(found.fit.sigma0)
        for k, (one, uv, _, _) in enumerate(places):
            points, cov = found.locate(uv, plane=one.plane, camera=one.camera)
            squares[k] += np.sum((points - true[k]) ** 2, axis=1)
            variances[k] += np.trace(cov, axis1=1, axis2=2)
    n = len(scales)
    return MapStudy(
        tuple(
            PlaneStudy(
                one.plane,
                inside,
                MM_PER_M * np.sqrt(square / n),
                MM_PER_M * np.sqrt(variance / n),
                mapped,
            )
            for (one, _, inside, mapped), square, variance in zip(
                places, squares, variances, strict=True
            )
        ),
        n,
        skipped,
        first.fit.sigma0 / float(np.sqrt(np.mean(np.square(scales)))),
    )


def _solved(
    made: Simulation, noise: Noise, seed: int, options: lc.CalibrationOptions
) -> lc.Calibration:
    """A new capture: the same commanded poses, other noise of the hand and of the pixels."""
    rng = np.random.default_rng([seed, 5])
    seen = made.observations
    hands = noise.moved_hands(seen.T_base_hand, rng)
    uv = lc.project(made.truth, hands, plane=seen.plane.tolist())
    uv = uv + noise.pixel_px * rng.standard_normal(uv.shape)
    return lc.calibrate(replace(seen, uv=uv), initial=made.truth, options=options)


def _points(cell: lc.Cell, one: ErrorMap) -> tuple[ErrorMap, np.ndarray, np.ndarray, np.ndarray]:
    """The map, pixels of 25 nodes among the spots and 25 outside, which is which, and the map."""
    chosen = []
    for mask in (one.near, one.seen & ~one.near):
        nodes = np.argwhere(mask)
        if len(nodes) < POINTS:
            continue
        chosen.append(nodes[_spread(_xy(one, nodes))])
    at = np.concatenate(chosen)
    uv = project_points(one.axes.to_base(_xy(one, at)), cell.cameras[one.camera])
    return one, uv, one.near[at[:, 0], at[:, 1]], one.error_mm[at[:, 0], at[:, 1]]


def _xy(one: ErrorMap, nodes: np.ndarray) -> np.ndarray:
    return np.column_stack([one.x_mm[nodes[:, 1]], one.y_mm[nodes[:, 0]]])


def _spread(xy: np.ndarray) -> list[int]:
    """So many points as far from each other as they can be, one after the other."""
    chosen = [int(np.argmin(np.linalg.norm(xy - xy.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(xy - xy[chosen[0]], axis=1)
    while len(chosen) < POINTS:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return chosen


def report_lines(found: MapStudy) -> list[str]:
    """One line a plane, for points among the spots and for those outside."""
    lines = [f"{found.captures} captures, {len(found.skipped)} without an answer {found.skipped}"]
    for where, inside in (("among the spots", True), ("outside them", False)):
        for p in found.planes:
            # far out, where the map is an extrapolation, a lens may fold in some captures
            located = np.isfinite(p.rms_mm)
            mine = (p.inside == inside) & located
            lost = int(((p.inside == inside) & ~located).sum())
            if lost:
                lines.append(
                    f"plane {p.plane}, {lost} points {where}: not located in every capture"
                )
            if not mine.any():
                continue
            e, r = p.rms_mm[mine], p.ratio[mine]
            m = p.map_mm[mine] / found.scale / e
            lines.append(
                f"plane {p.plane}, {int(mine.sum())} points {where}: error {e.min():.3f} to "
                f"{e.max():.3f} mm rms; expected / true {r.min():.3f} to "
                f"{r.max():.3f}, mean {r.mean():.3f}; map of the first capture / true "
                f"{m.min():.3f} to {m.max():.3f}"
            )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("preset", choices=list(PRESETS))
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--pixel", type=float, default=0.2, help="px")
    parser.add_argument("--hand-mm", type=float, default=0.0, help="robot noise, stated")
    parser.add_argument("--hand-deg", type=float, default=0.0, help="robot noise, stated")
    parser.add_argument("--distortion", default="all", choices=["all", "none"])
    given = parser.parse_args()
    noise = Noise(given.pixel, given.hand_mm / MM_PER_M, np.deg2rad(given.hand_deg))
    options = lc.CalibrationOptions(
        distortion=given.distortion,
        hand_sigma_m=noise.hand_translation_m,
        hand_sigma_rad=noise.hand_rotation_rad,
        sigma_px=given.pixel if given.hand_mm or given.hand_deg else None,
    )
    print(given.preset, noise, f"distortion {given.distortion}", flush=True)
    found = error_map_study(given.preset, noise, range(given.seeds), options)
    print("\n".join(report_lines(found)), flush=True)


if __name__ == "__main__":
    main()
