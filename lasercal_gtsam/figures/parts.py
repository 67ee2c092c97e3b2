"""The parts of a cell that a calibration is of: those that its covariance knows."""

from __future__ import annotations

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell


def calibrated_cell(calibration: Calibration) -> Cell:
    """The estimate without the parts that nothing was observed of, in the covariance's order.

    Rows of the result table and columns of the covariance follow this cell.
    """
    cell = calibration.cell
    owners = dict.fromkeys(label.rpartition(".")[0] for label in calibration.labels)
    planes = [owner.removeprefix("plane ") for owner in owners if owner.startswith("plane ")]
    return Cell(
        {name: cell.cameras[name] for name in owners if name in cell.cameras},
        {name: cell.lasers[name] for name in owners if name in cell.lasers},
        {name: cell.planes[name] for name in planes},
    )
