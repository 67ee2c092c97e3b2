"""The studies of lens, coverage and doctor run; the long ones hold what is stated of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from coverage_study import CELLS, capture_study, coverages
from doctor_study import KINDS, planted, right
from lens_study import lens_study


def test_the_studies_run():
    """One capture each, so that a study does not break unnoticed."""
    line = capture_study("tool-z", 1.0, 0, names=("fu", "a_1_z"))
    assert set(line["rows"]) == {"fu", "a_1_z"}
    score, root, adjusted, dof = line["rows"]["a_1_z"]
    assert abs(score - root) < 0.3
    assert abs(adjusted - root) < 0.3
    assert 95 < dof < 110
    assert json.loads(json.dumps(line)) == line
    assert coverages([line])["fu"][0] == 1
    tallies = lens_study("paper", 0.2, "k1", range(1))
    assert tallies["auto"].errors[0][0] ** 2 < tallies["none"].errors[0][0] ** 2
    assert right(2)["found"]


@pytest.mark.slow
@pytest.mark.parametrize("cell", CELLS)
def test_every_interval_covers(cell):
    """Six rows of 200 captures; all rows of 1000 take the script."""
    names = ("fu", "u0", "k1", "k2", "phi", "a_1_z")
    lines = [capture_study(cell, CELLS[cell], seed, names=names) for seed in range(200)]
    found = coverages(lines)
    assert len(found) >= 5
    # three standard deviations of a share of 200
    assert min(numbers[3] for numbers in found.values()) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 200)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_planted_mistake_is_found(kind):
    assert all(planted(kind, seed)["found"] for seed in range(3))


@pytest.mark.slow
def test_right_cells_raise_no_alarm():
    assert all(right(seed)["found"] for seed in range(24))
