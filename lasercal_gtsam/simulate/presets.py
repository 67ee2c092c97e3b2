"""Named simulations: a cell, how the hand moves in it, and the noise that goes with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.simulate.cells import paper_cell, table2_cell, tool_z_cell
from lasercal_gtsam.simulate.noise import Noise

_TABLE1 = Noise.table1()
# Table 2's residuals are about 2.5 px rms; these pixel sigmas reproduce that (method note 9.3).
_TABLE2_TWO = Noise(pixel_px=1.98)
_TABLE2_ONE = Noise(pixel_px=1.88)


@dataclass(frozen=True)
class Preset:
    """One named simulation.

    Attributes
    ----------
    name, description : for a human
    cell : makes the truth; draws from the generator where the cell has a random part
    groups : hand rotations per plane
    shots : poses per hand rotation; 1 means arbitrary poses in no groups
    design : name of the motion design
    noise : the noise that goes with the preset (largest of the paper's, or Table 2's)
    """

    name: str
    description: str
    cell: Callable[[np.random.Generator], Cell]
    groups: int
    shots: int = 10
    design: str = "paper"
    noise: Noise = _TABLE1

    @property
    def spots_per_plane(self) -> int:
        """Number of spots on every plane."""
        return self.groups * self.shots


def _table2(planes: int) -> Callable[[np.random.Generator], Cell]:
    return lambda rng: table2_cell(planes)


def _tool_z(planes: int) -> Callable[[np.random.Generator], Cell]:
    return lambda rng: tool_z_cell(planes)


# Of the motion designs the far one comes closest to Table 2's sigmas (method note 9.3).
_PRESETS = (
    Preset("paper", "the paper's simulated cell, 3 planes, 90 spots", partial(paper_cell, 3), 3),
    Preset("paper-2", "the paper's simulated cell, 2 planes, 60 spots", partial(paper_cell, 2), 3),
    Preset("paper-1", "the paper's simulated cell, plane 1, 30 spots", partial(paper_cell, 1), 3),
    Preset(
        "paper-distorted",
        "the paper's simulated cell with strong radial distortion, 3 planes, 90 spots",
        partial(paper_cell, 3, k1=-0.55, k2=1.1),
        3,
        noise=Noise(pixel_px=1.0),
    ),
    Preset(
        "table2-1",
        "a cell like that of Table 2, as many spots as Test 1: 1 plane, 30 spots",
        _table2(1),
        3,
        design="far",
        noise=_TABLE2_ONE,
    ),
    Preset(
        "table2-2",
        "a cell like that of Table 2, as many spots as Test 2: 1 plane, 60 spots",
        _table2(1),
        6,
        design="far",
        noise=_TABLE2_ONE,
    ),
    Preset(
        "table2-3",
        "a cell like that of Table 2, as many spots as Test 3: 2 planes, 60 spots",
        _table2(2),
        3,
        design="far",
        noise=_TABLE2_TWO,
    ),
    Preset(
        "table2-4",
        "a cell like that of Table 2, as many spots as Test 4: 2 planes, 80 spots",
        _table2(2),
        4,
        design="far",
        noise=_TABLE2_TWO,
    ),
    Preset(
        "tool-z",
        "beam along the tool's z axis, a horizontal table, 60 spots",
        _tool_z(1),
        6,
        design="table",
    ),
    Preset(
        "tool-z-2",
        "beam along the tool's z axis, table and wedge, 60 spots",
        _tool_z(2),
        3,
        design="table",
    ),
    Preset(
        "no-groups",
        "the paper's simulated cell, 2 planes, 60 arbitrary hand poses",
        partial(paper_cell, 2),
        30,
        shots=1,
        design="arbitrary",
    ),
)
PRESETS = {preset.name: preset for preset in _PRESETS}
_ALIASES = {"table2": "table2-4"}


def preset_named(name: str) -> Preset:
    """The preset of that name; "table2" stands for "table2-4".

    Raises
    ------
    DataError
        The name is unknown; the message lists the choices.
    """
    name = _ALIASES.get(name, name)
    if name not in PRESETS:
        raise DataError(f"preset {name!r} is unknown; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
