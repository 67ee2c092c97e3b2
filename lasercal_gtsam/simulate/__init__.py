"""Simulated captures with a known truth.

Public names: `simulate` (a preset by name), `simulate_cell` (any cell), `Simulation`, `Noise`,
`MotionDesign`, `DESIGNS`, `PRESETS`.
"""

from __future__ import annotations

from lasercal_gtsam.simulate.motions import DESIGNS, MotionDesign
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.presets import PRESETS, Preset
from lasercal_gtsam.simulate.simulation import Simulation, simulate, simulate_cell

__all__ = [
    "DESIGNS",
    "PRESETS",
    "MotionDesign",
    "Noise",
    "Preset",
    "Simulation",
    "simulate",
    "simulate_cell",
]
