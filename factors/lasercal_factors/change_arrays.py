"""The plain arrays that `change_kernels` works on, bundled by name."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

SLOTS = 32  # onsets kept for each part and magnitude
WINDOW = 1000  # spots of a part after which an onset is forgotten
LAG = 16  # spots after which a part's own rate learns of one: a run must not excuse itself


class Bank(NamedTuple):
    """Everything remembered of P parts of one kind, each with d coordinates that could change.

    M magnitudes of change, K = `SLOTS` onsets, oldest first.

    log_weight (P, M, K): logarithm of onset weight times likelihood ratio, -inf where empty;
    first (P, M, K): number of the onset's first spot; age (P, M, K): how many spots the part had
    before it; mean (P, M, d, K), cov (P, M, d, d, K): the change, estimated from the spots since;
    used (P, M): onsets held; seen (P,): spots so far; log_total (P,): logarithm of the sum of the
    weights; prior (P, M, d, d): covariance of a change; share (M,): weight of a new onset;
    run (P, 3): logarithm of the statistic of runs of outliers, its cumulative sum, its onset;
    run_share (1,): weight of a new onset of a run; outliers (P, 2): expected number of outliers and
    number of spots, fading.
    """

    log_weight: Array
    first: Index
    age: Index
    mean: Array
    cov: Array
    used: Index
    seen: Index
    log_total: Array
    prior: Array
    share: Array
    run: Array
    run_share: Array
    outliers: Array


class Watch(NamedTuple):
    """State of the detector.

    cameras (d = 6), lasers (d = 4), planes (d = 3): `Bank`; middle (P, 3): where the spots of each
    plane are, in the coordinates of its tilt, and how many they are; spread (S, 3): as `Bank.run`,
    for variances inflated by spread_factor (S,); spread_share (S,); outliers (2,): as
    `Bank.outliers`, for all spots; recent (T, 4): probability to be an outlier, camera, laser and
    plane of the last T spots, spot i in row i mod T; number (1,): spots seen.
    """

    cameras: Bank
    lasers: Bank
    planes: Bank
    middle: Array
    spread: Array
    spread_factor: Array
    spread_share: Array
    outliers: Array
    recent: Array
    number: Index


class Looks(NamedTuple):
    """N innovations.

    e (N, 2): whitened, NaN where no spot should be; who (N, 3): indices of camera, laser and plane;
    by_camera (N, 2, 6), by_laser (N, 2, 4), by_plane (N, 2, 3): whitened Jacobians;
    area (N,): of the picture in whitened units; dof (N,): of the noise scale.
    """

    e: Array
    who: Index
    by_camera: Array
    by_laser: Array
    by_plane: Array
    area: Array
    dof: Array
