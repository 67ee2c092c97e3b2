"""Outliers: found by consensus, named, and left out of the final estimate.

`scale` says how long residuals may be, `consensus` what most spots agree on, `parts` supplies more
starts where none is good, and `rejection` puts them in order.
"""

from __future__ import annotations

from lasercal_gtsam.robust.consensus import Consensus, consensus
from lasercal_gtsam.robust.rejection import (
    Accepted,
    Finish,
    Finished,
    Refine,
    Ways,
    refine_without_outliers,
    refit,
)
from lasercal_gtsam.robust.scale import (
    FALSE_ALARM,
    Mask,
    lengths_in,
    lengths_of,
    outlier_reasons,
    rejection_length,
    robust_scale,
)

__all__ = [
    "FALSE_ALARM",
    "Accepted",
    "Consensus",
    "Finish",
    "Finished",
    "Mask",
    "Refine",
    "Ways",
    "consensus",
    "lengths_in",
    "lengths_of",
    "outlier_reasons",
    "refine_without_outliers",
    "refit",
    "rejection_length",
    "robust_scale",
]
