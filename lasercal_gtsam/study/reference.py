"""Numbers that the studies reproduce: an independent implementation's (method notes 9.1 and 9.2).

Means in per cent over the trials that did not fail. The paper prints its curves only.
"""

from __future__ import annotations

from lasercal_gtsam.study.fig6_runs import (
    HORAUD,
    MA,
    MA_REFINED,
    MALM,
    MALM_REFINED,
    REFINED,
)

FIG6_LEVELS = (0.2, 0.4, 0.6, 0.8, 1.0)
FIG6_MEANS: dict[str, dict[str, tuple[float, ...]]] = {
    REFINED: {
        "f_u": (0.269, 0.528, 0.718, 0.949, 1.27),
        "R": (0.358, 0.700, 1.05, 1.39, 1.77),
        "T": (0.139, 0.280, 0.370, 0.496, 0.659),
    },
    MA: {
        "f_u": (0.874, 1.83, 2.50, 3.41, 4.75),
        "R": (1.20, 2.65, 3.71, 4.61, 6.10),
        "T": (0.535, 1.09, 1.54, 2.25, 2.90),
    },
    MA_REFINED: {
        "f_u": (0.237, 0.498, 0.773, 0.934, 1.22),
        "R": (0.326, 0.593, 0.912, 1.30, 1.56),
        "T": (0.156, 0.323, 0.451, 0.612, 0.765),
    },
    MALM: {
        "f_u": (0.303, 0.588, 0.935, 1.23, 1.59),
        "R": (0.396, 0.779, 1.17, 1.59, 1.97),
        "T": (0.203, 0.402, 0.606, 0.850, 1.03),
    },
    MALM_REFINED: {
        "f_u": (0.335, 0.663, 1.04, 1.34, 1.65),
        "R": (0.388, 0.722, 1.14, 1.44, 1.90),
        "T": (0.201, 0.383, 0.660, 0.811, 1.03),
    },
    HORAUD: {"f_u": (0.236, 0.514, 0.735, 1.04, 1.37)},
}

FIG7_SAMPLES = (30, 60, 120, 180, 240, 300)
_NONE = float("nan")
FIG7_REFINED_MEANS: dict[str, tuple[float, ...]] = {
    "1 plane (a_1)": (2.16, 0.943, 0.645, 0.415, 0.334, 0.309),
    "1 plane (a_2)": (9.60, 4.32, 2.10, 1.85, 1.43, 1.32),
    "2 planes": (_NONE, 0.990, 0.364, 0.260, 0.205, 0.159),
    "3 planes": (10.1, 0.987, 0.426, 0.269, 0.195, 0.189),
}
"""Of f_u, after the refinement."""
