"""`compare`: two calibrations beside each other."""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.comparison.inputs import inputs_change
from lasercal_gtsam.comparison.maps import pixel_maps, plane_maps
from lasercal_gtsam.comparison.parts import differences, distance_of, part_changes
from lasercal_gtsam.comparison.result import Comparison, RowChange
from lasercal_gtsam.comparison.together import Together, lay_together
from lasercal_gtsam.comparison.words import Findings, basis_words, conclude, remarks
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.graph import beam_frames
from lasercal_gtsam.io.origin import Origin
from lasercal_gtsam.report_map import (
    BeamChart,
    row_jacobian,
    row_names,
    row_values,
    tangent_labels,
)

_TURN_DEG = 360.0


def compare(
    a: Calibration, b: Calibration, *, origins: tuple[Origin, Origin] | None = None
) -> Comparison:
    """Say what differs between two calibrations, by how much, and whether noise explains it.

    All differences are B minus A. Their sigmas count what the two share: spots that are in both
    (B goes on from A, or the same spots with other options) make no difference between them.

    Parameters
    ----------
    a, b : the calibrations; parts are matched by their names
    origins : where they came from (`lasercal_gtsam.io.origin.Origin.of_file`), for what differs in
        files and versions

    Returns
    -------
    Comparison
        Also where nothing can be said for want of sigmas or of common parts; it then says so.

    Raises
    ------
    DataError
        The beams of a laser are 90 deg or more apart in the hand: no difference of one laser.
    """
    cells = calibrated_cell(a), calibrated_cell(b)
    common = Cell(
        {name: part for name, part in cells[0].cameras.items() if name in cells[1].cameras},
        {name: part for name, part in cells[0].lasers.items() if name in cells[1].lasers},
        {name: part for name, part in cells[0].planes.items() if name in cells[1].planes},
    )
    errors = lay_together(a, b, tangent_labels(common))
    found = differences(a, b, common, errors.cells)
    distance, unknowns, chance = (0.0, 0, float("nan"))
    if found:
        distance, unknowns, chance = distance_of(
            np.concatenate([one.value for one in found]),
            np.vstack([one.J_a for one in found]),
            np.vstack([one.J_b for one in found]),
            errors,
        )
    parts = part_changes(found, errors)
    inputs = inputs_change(a, b, origins or (Origin(), Origin()))
    on_planes = plane_maps(a, b, common, errors)
    in_pictures = pixel_maps(a, b, common, errors)
    only = _only(cells[0], cells[1]), _only(cells[1], cells[0])
    rows = _rows(common, b.cell, errors) if found else ()
    findings = Findings(
        parts, rows, chance, on_planes, in_pictures, errors, inputs,
        b.cell.restricted(common) == common, bool(found),
    )  # fmt: skip
    verdict, words, next_action = conclude(findings)
    return Comparison(
        verdict=verdict,
        words=words,
        next_action=next_action,
        basis=basis_words(errors, inputs),
        distance=distance,
        unknowns=unknowns,
        chance=chance,
        rows=rows,
        parts=parts,
        pixel_maps=in_pictures,
        plane_maps=on_planes,
        inputs=inputs,
        only_a=only[0],
        only_b=only[1],
        notes=remarks(a, b, common, inputs, parts),
    )


def _only(cell: Cell, other: Cell) -> tuple[str, ...]:
    """Names of the parts that the other cell does not have."""
    return tuple(
        f"{kind} {name!r}"
        for kind, mine, theirs in (
            ("camera", cell.cameras, other.cameras),
            ("laser", cell.lasers, other.lasers),
            ("plane", cell.planes, other.planes),
        )
        for name in mine
        if name not in theirs
    )


def _rows(common: Cell, other: Cell, errors: Together) -> tuple[RowChange, ...]:
    """Every row of the table in A's charts, with the sigma of its difference."""
    there = other.restricted(common)
    charts = {name: BeamChart.of(beam) for name, beam in common.lasers.items()}
    values = row_values(common, charts), row_values(there, charts)
    names = row_names(common, charts)
    change = values[1] - values[0]
    turns = np.array([unit == "deg" for _, unit in names])
    change[turns] = (change[turns] + _TURN_DEG / 2) % _TURN_DEG - _TURN_DEG / 2
    J_a, J_b = (
        row_jacobian(cell, charts, beam_frames(cell))
        for cell in (cell.restricted(common) for cell in errors.cells)
    )
    with np.errstate(invalid="ignore"):  # gimbal lock
        sigma = np.linalg.norm(J_b @ errors.root_b - J_a @ errors.root_a, axis=1)
    if not errors.known:
        sigma[:] = np.nan
    return tuple(
        RowChange(name, unit, float(x), float(y), float(d), float(s))
        for (name, unit), x, y, d, s in zip(names, *values, change, sigma, strict=True)
    )
