"""`lasercal check-sigma`: the table, the verdict, the files, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import pytest
from cli_support import Cli
from core_cases import simulated

import lasercal_gtsam as lc
from lasercal_gtsam.cli import check_sigma as command
from lasercal_gtsam.sigma_check import study


@cache
def calibration() -> lc.Calibration:
    made = simulated("paper", 1, 1.0)
    options = lc.CalibrationOptions(distortion="none")
    return lc.calibrate(made.observations, initial=made.truth, options=options)


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture
def good(tmp_path):
    calibration().save(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


@pytest.fixture
def bad(tmp_path):
    result = calibration()
    parameters = tuple(replace(p, sigma=0.5 * p.sigma) for p in result.parameters)
    wrong = replace(result, covariance=0.25 * result.covariance, parameters=parameters)
    wrong.save(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


def test_the_table_is_what_the_function_finds(lasercal, good):
    outcome = lasercal("check-sigma", good, "--trials", 30, "--seed", 4)
    assert (outcome.status, outcome.err) == (0, "")
    found = lc.check_sigma(calibration(), trials=30, seed=4)
    lines = outcome.out.splitlines()
    assert lines[0].startswith(f"{good}: 90 spots; 30 trials with new noise of 1.04 px")
    rows = {
        cells[0]: cells[1:]
        for line in lines
        if line.count("|") == 8 and (cells := [c.strip() for c in line.split("|")])
    }
    assert rows[""] == ["sigma", "spread", "ratio", "68 %", "95 %", "own", "bias", "Unit"]
    for row in found.rows:
        sigma, spread, *numbers, unit = rows[row.name]
        assert float(sigma) == pytest.approx(row.sigma, rel=0.06)
        assert float(spread) == pytest.approx(row.scatter, rel=0.1)
        expected = [
            row.ratio,
            100 * row.coverage_68.share,
            100 * row.coverage_95.share,
            100 * row.own_coverage_95.share,
            row.bias,
        ]
        assert [float(x) for x in numbers] == pytest.approx(expected, abs=0.051)
        assert unit == row.unit
    assert rows["promised"] == ["", "", "1.00", "68.3", "95.0", "95.0", "0.00", ""]
    # sqrt(.683 .317 / 30), sqrt(.95 .05 / 30), 1 / sqrt(30), 1 / sqrt(60)
    assert rows["chance, +-"] == ["", "", "0.13", "8.5", "4.0", "4.0", "0.18", ""]
    assert set(rows) == {"", "promised", "chance, +-", *(row.name for row in found.rows)}
    assert max(len(line) for line in lines if "|" in line) <= 80
    assert "together (NEES)" in outcome.out
    assert lines[-1] == found.verdict


def test_sigmas_that_do_not_hold_are_status_1(lasercal, bad):
    outcome = lasercal("check-sigma", bad, "--trials", 30)
    assert outcome.status == 1
    assert outcome.err.startswith("Error: all 24 rows: the stated sigma is not ")
    assert "promised" in outcome.out
    assert outcome.out.splitlines()[-1] == "The sigmas do not all hold; see the errors."
    document = json.loads(lasercal("check-sigma", bad, "--trials", 30, "--json").out)
    assert not document["holds"]
    assert [f"Error: {p}" for p in document["problems"]] == outcome.err.splitlines()


def test_json_and_file_are_the_same(lasercal, good, tmp_path):
    target = tmp_path / "sigmas.json"
    printed = lasercal.json("check-sigma", good, "--trials", 25, "-o", target)
    assert json.loads(target.read_text()) == printed
    assert (printed["format"], printed["version"]) == ("lasercal-sigma-check", 1)
    assert printed["calibration"] == str(good)
    assert (printed["trials"], printed["solved"], printed["seed"]) == (25, 25, 0)
    rows = {row["name"]: row for row in printed["rows"]}
    assert rows["fu"]["sigma"] == calibration()["fu"].sigma
    assert 0 <= rows["fu"]["coverage_68"]["low"] < rows["fu"]["coverage_68"]["high"] <= 1
    assert printed["nees"]["low"] < printed["nees"]["high"]
    # an earlier result is replaced
    again = lasercal("check-sigma", good, "--trials", 20, "-o", target)
    assert again.out.splitlines()[-1] == f"Saved {target}."
    assert json.loads(target.read_text())["trials"] == 20


def test_nothing_else_is_overwritten(lasercal, good, tmp_path):
    before = good.read_bytes()
    outcome = lasercal("check-sigma", good, "-o", good)
    assert outcome.status == 1
    assert "not a result of check-sigma" in outcome.err
    assert good.read_bytes() == before
    outcome = lasercal("check-sigma", good, "-o", tmp_path / "none" / "x.json")
    assert outcome.status == 1
    assert "there is no folder" in outcome.err


def test_from_the_data_alone(lasercal, good, monkeypatch):
    real, starts = study.calibrate, []

    def noted(observations, *, initial, options):
        starts.append(initial)
        return real(observations, initial=calibration().cell, options=options)

    monkeypatch.setattr(study, "calibrate", noted)
    outcome = lasercal("check-sigma", good, "--trials", 20, "--from-data")
    assert "each solved from the data alone" in outcome.out
    # the first solves the calibration's own spots again
    assert starts == [calibration().cell] + [None] * 20
    lasercal("check-sigma", good, "--trials", 20)
    assert starts[21:] == [calibration().cell] * 21


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ([], "CALIBRATION"),
        (["x.json", "--trials", "5"], "20"),
        (["x.json", "--trials", "many"], "--trials"),
        (["x.json", "--seed", "-1"], "--seed"),
    ],
)
def test_wrong_usage(lasercal, args, words):
    outcome = lasercal("check-sigma", *args)
    assert outcome.status == 2
    assert words in outcome.err


def test_bad_files(lasercal, tmp_path):
    assert "no such file" in lasercal("check-sigma", tmp_path / "x.json").err.lower()
    (tmp_path / "y.json").write_text("{")
    outcome = lasercal("check-sigma", tmp_path / "y.json")
    assert outcome.status == 1
    assert outcome.err.startswith("Error: ")
    fit = replace(calibration().fit, converged=False, status="not to be trusted: an alarm")
    replace(calibration(), fit=fit).save(tmp_path / "z.json")
    outcome = lasercal("check-sigma", tmp_path / "z.json")
    assert (outcome.status, outcome.out) == (1, "")
    assert "not to be trusted: an alarm" in outcome.err


def test_help_fits_a_terminal(lasercal):
    page = lasercal("check-sigma", "-h")
    assert page.status == 0
    assert max(map(len, page.out.splitlines())) <= 80
    assert command.FORMAT == "lasercal-sigma-check"
