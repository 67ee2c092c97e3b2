"""One long stream: how far from the batch optimum, how much time and memory an update takes."""

from __future__ import annotations

import argparse
import gc
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from findings import Finding, at_least, at_most, print_table
from lasercal_factors import stream_kernels
from lasercal_factors.chart import CellChart
from spots import Stream, good_stream

import lasercal_gtsam as lc
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.incremental.belief import coordinates
from lasercal_gtsam.incremental.store import USED, SpotStore

START = 40  # spots given at once, before the others come one by one
EVERY, LATER = 1000, 300  # every update is compared below the first number; then so many more
STEADY = 1000  # spots from which on times are judged
MS_MEDIAN, MS_99, GROWTH = 0.3, 0.6, 1.2
_AHEAD = 500  # observations cut beforehand, so that only `add` is timed
_RANGES = (200, 1_000, 5_000, 20_000)


class Distance(NamedTuple):
    """Of an estimate from the batch optimum, in the latter's sigmas."""

    spots: int
    largest: float
    joint: float
    same_outliers: bool
    alarm: bool


@dataclass(frozen=True)
class Times:
    """CPU milliseconds of each `add` after the start, those of the reference, and memory."""

    update: Array
    reference: Array
    bytes_a_spot: float
    cpu_share: float


def run(args: argparse.Namespace, outliers: float) -> list[Finding]:
    """Both measurements on the same spots, one after the other."""
    made = good_stream(args.seed, args.spots, distortion=args.distortion, outliers=outliers)
    options = lc.CalibrationOptions(distortion=args.distortion)
    findings = _time_findings(measure_times(made, options), args.spots)
    distances, last = measure_distances(made, options)
    return findings + _distance_findings(distances, last, made, 0.05 if outliers else 0.02)


def singles(observations: lc.Observations, start: int) -> Iterator[lc.Observations]:
    """The spots from ``start`` on, one at a time."""
    for begin in range(start, len(observations), _AHEAD):
        block = observations[begin : begin + _AHEAD]
        yield from [block[k : k + 1] for k in range(len(block))]


def measure_times(made: Stream, options: lc.CalibrationOptions) -> Times:
    """CPU time of every update; garbage is collected as it is by default."""
    calibrator = lc.IncrementalCalibrator(options=options)
    calibrator.add(made.observations[:START])
    reference = _Reference(made)
    spent, fixed = [], []
    resident, wall, cpu = 0, time.perf_counter(), time.process_time()
    for k, spot in enumerate(singles(made.observations, START), START):
        if k == STEADY:
            gc.collect()
            resident = _resident_bytes()
        begin = time.process_time()
        calibrator.add(spot)
        spent.append(time.process_time() - begin)
        if k % 50 == 0:
            fixed.append(reference.seconds())
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    gc.collect()
    grown = (_resident_bytes() - resident) / max(len(made.observations) - STEADY, 1)
    return Times(1e3 * np.array(spent), 1e3 * np.array(fixed), grown, cpu / wall)


class _Reference:
    """A fixed piece of compiled work: the information of 1000 spots at one point."""

    def __init__(self, made: Stream) -> None:
        seen = made.observations[:1000]
        store = SpotStore(dict(seen.image_size))
        store.append(seen, 1.0, USED)
        chart = CellChart(state_from_cell(made.truth))
        planes = [list(made.truth.planes).index(path[2]) for path in store.paths]
        paths = np.array([(0, 0, p) for p in planes])
        offsets = np.array([(0, 6, 15, 19 + 3 * p) for p in planes])
        about = chart.aspect_array, chart.reference
        view = stream_kernels.view_at(np.zeros(chart.n), *about, paths, offsets)
        _, slice = next(store.slices(0, len(seen)))
        weighing = stream_kernels.Weighing(np.zeros(6), 1.0)
        self._arguments = (*slice, view, weighing, np.inf, False, 0)
        self.seconds()  # compiled here

    def seconds(self) -> float:
        begin = time.process_time()
        stream_kernels.accumulate(*self._arguments)
        return time.process_time() - begin


def measure_distances(
    made: Stream, options: lc.CalibrationOptions
) -> tuple[list[Distance], lc.Update]:
    """Compare with the batch solution at every early update and at some later ones."""
    observations = made.observations
    compared = set(range(START, EVERY))
    compared |= set(np.geomspace(EVERY, len(observations), LATER).astype(int).tolist())
    calibrator = lc.IncrementalCalibrator(options=options)
    update = calibrator.add(observations[:START])
    distances = []
    for count, spot in enumerate(singles(observations, START), START + 1):
        update = calibrator.add(spot)
        if count in compared and update.cell is not None:
            distances.append(_distance(update, observations[:count], options))
    return distances, update


def _distance(
    update: lc.Update, observations: lc.Observations, options: lc.CalibrationOptions
) -> Distance:
    batch = lc.calibrate(observations, initial=update.cell, options=options)
    if not batch.fit.converged:
        raise lc.SolveError(f"the batch solution of {len(observations)} spots: {batch.fit.status}")
    assert update.cell is not None
    free = np.diag(batch.covariance) > 0
    step = coordinates(batch.cell, update.cell)[free]
    covariance = batch.covariance[np.ix_(free, free)]
    sigmas = np.sqrt(np.diag(covariance))
    scaled = step / sigmas
    joint = scaled @ np.linalg.solve(covariance / np.outer(sigmas, sigmas), scaled)
    return Distance(
        len(observations),
        float(np.abs(scaled).max()),
        float(np.sqrt(joint)),
        update.n_used == batch.fit.n_spots,
        update.alarm is not None,
    )


def _time_findings(times: Times, spots: int) -> list[Finding]:
    steady = times.update[max(STEADY - START, 0) :]
    if len(steady) < 1000:
        return [Finding("CPU time of an update", "2000 spots or more", f"{spots} spots", False)]
    deciles = np.array_split(steady, 10)
    fixed = np.array_split(times.reference[-len(steady) // 50 :], 10)
    medians = np.array([np.median(d) for d in deciles])
    relative = medians / np.array([np.median(f) for f in fixed])
    undisturbed = float(np.percentile(times.reference, 10))
    rows = [("decile of the updates", "median ms", "99 % ms", "median / reference")]
    for i, (decile, ratio) in enumerate(zip(deciles, relative, strict=True), 1):
        rows.append(
            (f"{i}", f"{np.median(decile):.3f}", f"{np.percentile(decile, 99):.3f}", f"{ratio:.2f}")
        )
    print_table(rows)
    return [
        at_most("CPU time of an update, median", float(np.median(steady)), MS_MEDIAN, " ms"),
        at_most("CPU time, 99th percentile", float(np.percentile(steady, 99)), MS_99, " ms"),
        at_most("median of the last decile / of the second", medians[-1] / medians[1], GROWTH),
        Finding("the same, in units of the reference", "", f"{relative[-1] / relative[1]:.3g}"),
        Finding("longest update", "", f"{steady.max():.3g} ms"),
        Finding(
            "reference (1000 spots accumulated), median and fastest tenth",
            "",
            f"{np.median(times.reference):.3g} ms, {undisturbed:.3g} ms",
        ),
        Finding(
            "median update where the reference is at its fastest tenth",
            "",
            f"{np.median(relative) * undisturbed:.3g} ms",
        ),
        Finding("memory", "", f"{times.bytes_a_spot:.0f} bytes a spot"),
        Finding(
            "machine",
            "",
            f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; "
            f"{100 * times.cpu_share:.0f} % of a core for us",
        ),
    ]


def _distance_findings(
    distances: list[Distance], last: lc.Update, made: Stream, limit: float
) -> list[Finding]:
    if not distances:
        return [Finding("distance from the batch optimum", "an estimate", last.words, False)]
    edges = (0, *_RANGES, len(made.observations) + 1)
    rows = [
        (
            "spots",
            "compared",
            "largest of a coordinate",
            "joint",
            "other outliers left out",
            "alarm",
        )
    ]
    for low, high in pairwise(edges):
        found = [d for d in distances if low <= d.spots < high]
        if found:
            rows.append(
                (
                    f"{low} to {high - 1}",
                    f"{len(found)}",
                    f"{max(d.largest for d in found):.4f}",
                    f"{max(d.joint for d in found):.4f}",
                    f"{sum(not d.same_outliers for d in found)}",
                    f"{sum(d.alarm for d in found)}",
                )
            )
    print_table(rows)
    asked = "distance from the batch optimum, largest of a coordinate"
    findings = [
        at_most(asked, max(d.largest for d in distances), limit, " sigma"),
        at_most("the same, joint", max(d.joint for d in distances), limit, " sigma"),
        Finding("compared at", "", f"{len(distances)} updates from {distances[0].spots} spots on"),
    ]
    if made.outlier.any():
        findings += _naming_findings(last, made)
    return findings


def _naming_findings(last: lc.Update, made: Stream) -> list[Finding]:
    """Were the right spots left out, at the end of the stream?"""
    assert last.calibration is not None
    named = np.array([reason is not None for reason in last.calibration.spots.rejected])
    # an outlier that falls where its spot is, cannot be told
    away = np.linalg.norm(made.observations.uv - made.uv_true, axis=1) > 6.0
    return [
        at_least("spots left out that are outliers", 100 * made.outlier[named].mean(), 99.9, " %"),
        at_least(
            "outliers (6 px away or more) left out",
            100 * named[made.outlier & away].mean(),
            99.9,
            " %",
        ),
        Finding("outliers, of them left out", "", f"{made.outlier.sum()}, "
                f"{(named & made.outlier).sum()}"),
    ]  # fmt: skip


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
