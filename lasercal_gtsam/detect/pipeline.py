"""From a picture, or a pair of pictures, to a spot with covariance and verdict."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lasercal_gtsam.detect.candidates import Candidate, find_candidates
from lasercal_gtsam.detect.detection import Detection, RunnerUp
from lasercal_gtsam.detect.difference import Difference, pair_difference, single_difference
from lasercal_gtsam.detect.measure import RIVAL_SIGMAS, Measurement, measure_spot
from lasercal_gtsam.detect.options import DetectionOptions
from lasercal_gtsam.detect.picture import Frames, read_frames
from lasercal_gtsam.detect.region import squared_distance
from lasercal_gtsam.detect.verdict import judge


def detect_spot(on: Any, off: Any = None, options: DetectionOptions | None = None) -> Detection:
    """Find the laser spot in a picture.

    Parameters
    ----------
    on : (height, width) or (height, width, 3) array
        Picture with the laser on; uint8, uint16 or float; colour in OpenCV's order (BGR).
    off : like ``on``, or None
        Picture of the same scene without the laser. Without it every bright blob looks like a
        spot: the verdict is stricter, and still less safe (`Detection.single_frame`);
        `median_frame` makes a stand-in out of several laser-on pictures.
    options : DetectionOptions, optional

    Returns
    -------
    Detection
        Always: a picture without a usable spot has a verdict and a reason.

    Raises
    ------
    DetectionError
        The arrays are no pictures, or differ in size or depth.
    """
    options = options or DetectionOptions()
    frames = read_frames(on, off, options)
    difference = laser_light(frames, options)
    candidates = find_candidates(difference, options.threshold_sigmas)
    if not candidates.ranked:
        return _nothing(frames, difference, options)
    # the strongest or nothing: a fall-back to the next would accept whatever is left
    spot = measure_spot(frames, difference, candidates.blurred, candidates.ranked[0], options)
    return _detection(spot, _rival(spot, candidates.ranked), frames, difference, options)


def laser_light(frames: Frames, options: DetectionOptions) -> Difference:
    """On minus off, or where there is no off frame, on minus its own smooth background."""
    if frames.off is None:
        return single_difference(frames.on, frames.step)
    return pair_difference(
        frames.on,
        frames.off,
        frames.step,
        options.clutter_shift_px,
        options.clutter_gain,
        frames.blind,
    )


def _rival(spot: Measurement, ranked: tuple[Candidate, ...]) -> RunnerUp | None:
    """The strongest light that is not the spot's own: another candidate, or a bulge beside it."""
    rivals = [RunnerUp(spot.beside_uv, spot.beside)] if spot.beside > 0 else []
    for other in ranked[1:]:
        at = np.array([other.u, other.v], dtype=np.float64)
        apart = squared_distance(at[:1], at[1:], spot.centre.uv, spot.centre.shape)
        if apart[0] > RIVAL_SIGMAS**2:
            rivals.append(RunnerUp(at, other.peak / ranked[0].peak))
            break
    return max(rivals, key=lambda rival: rival.ratio, default=None)


def _nothing(frames: Frames, difference: Difference, options: DetectionOptions) -> Detection:
    reason = (
        f"nothing rises above {options.threshold_sigmas:g} sigma of the background "
        f"(noise {difference.noise:.3g}) and the clutter"
    )
    if frames.off is not None:
        turned = find_candidates(
            replace(difference, light=-difference.light), options.threshold_sigmas
        )
        if turned.ranked:
            at = turned.ranked[0]
            reason += f"; the off frame is brighter at ({at.u}, {at.v}): are on and off swapped?"
    return Detection(
        verdict="none",
        reason=reason,
        uv=np.full(2, np.nan),
        cov_uv=np.full((2, 2), np.nan),
        noise=difference.noise,
        channel=frames.channel,
        single_frame=frames.off is None,
    )


def _detection(
    spot: Measurement,
    rival: RunnerUp | None,
    frames: Frames,
    difference: Difference,
    options: DetectionOptions,
) -> Detection:
    height, width = frames.on.shape
    single = frames.off is None
    verdict, reason = judge(spot, difference.noise, rival, (width, height), single, options)
    variances, axes = np.linalg.eigh(spot.centre.shape)
    angle = float(np.arctan2(axes[1, 1], axes[0, 1]))
    return Detection(
        verdict=verdict,
        reason=reason,
        uv=spot.centre.uv,
        cov_uv=spot.centre.cov_uv,
        peak=spot.peak,
        noise=difference.noise,
        snr=spot.peak / difference.noise,
        n_saturated=spot.n_saturated,
        sigma_major=float(np.sqrt(variances[1])),
        sigma_minor=float(np.sqrt(variances[0])),
        angle_rad=angle if -np.pi / 2 < angle <= np.pi / 2 else angle - np.sign(angle) * np.pi,
        channel=frames.channel,
        single_frame=single,
        method=spot.centre.method,
        runner_up=rival,
    )
