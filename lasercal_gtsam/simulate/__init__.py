"""Simulated captures with a known truth.

Public names: `simulate` (a preset by name), `simulate_cell` (any cell), `Simulation`, `Noise`,
`MotionDesign`, `DESIGNS`, `PRESETS`, `write_simulation` (a capture on disk with its truth),
`load_truth`.
Pictures are in `lasercal_gtsam.simulate.pictures`, which needs OpenCV.
"""

from __future__ import annotations

from lasercal_gtsam.simulate.motions import DESIGNS, MotionDesign
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.presets import PRESETS, Preset
from lasercal_gtsam.simulate.simulation import Simulation, simulate, simulate_cell
from lasercal_gtsam.simulate.write import load_truth, write_simulation

__all__ = [
    "DESIGNS",
    "PRESETS",
    "MotionDesign",
    "Noise",
    "Preset",
    "Simulation",
    "load_truth",
    "simulate",
    "simulate_cell",
    "write_simulation",
]
