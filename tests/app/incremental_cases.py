"""Streams of spots with a known truth, and how far an estimate is from another."""

from __future__ import annotations

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.incremental.belief import calibrated_parts, coordinates
from lasercal_gtsam.simulate import Noise, simulate

PLAIN = lc.CalibrationOptions(distortion="none")


def shuffled(observations, seed=0):
    return observations[np.random.default_rng(seed).permutation(len(observations))]


def stream(preset="paper", seed=1, noise=Noise(0.3), groups=8):  # noqa: B008
    simulation = simulate(preset, seed, noise=noise, groups=groups)
    return simulation.truth, shuffled(simulation.observations, seed)


def seen_in(cell, observations, sigma_px, rng, **names):
    """The same hand poses with the pixels of another cell; spots out of the picture left out."""
    given = {k: getattr(observations, k).tolist() for k in ("camera", "laser", "plane")}
    for kind, name in names.items():
        given[kind] = [name] * len(observations)
    uv = lc.project(cell, observations.T_base_hand, **given)
    uv = uv + sigma_px * rng.standard_normal(uv.shape)
    size = cell.cameras[given["camera"][0]].image_size
    inside = np.isfinite(uv).all(axis=1)
    inside[inside] = ((uv[inside] > 0) & (uv[inside] < np.array(size) - 1)).all(axis=1)
    rows = np.flatnonzero(inside)
    prefix = "".join(f"{name}-" for name in names.values())
    return lc.Observations.from_arrays(
        uv[rows],
        observations.T_base_hand[rows],
        **{k: [v[i] for i in rows] for k, v in given.items()},
        image_size=size,
        id=[prefix + str(i) for i in observations.id[rows]],
    )


def feed(calibrator, observations, step=1):
    """Add piece by piece; all updates."""
    return [calibrator.add(observations[k : k + step]) for k in range(0, len(observations), step)]


def restricted(cell, like):
    return lc.Cell(
        {name: cell.cameras[name] for name in like.cameras},
        {name: cell.lasers[name] for name in like.lasers},
        {name: cell.planes[name] for name in like.planes},
    )


def sigmas_between(cell, batch):
    """Largest difference of a cell from a batch calibration, over all coordinates, in sigmas."""
    reference = calibrated_parts(batch)
    z = coordinates(reference, restricted(cell, reference))
    sigma = np.sqrt(np.diag(batch.covariance))
    return float(np.max(np.abs(z[sigma > 0]) / sigma[sigma > 0]))


def batch_of(observations, update, options=PLAIN):
    """The batch optimum of the same spots."""
    return lc.calibrate(observations, initial=update.cell, options=options)
