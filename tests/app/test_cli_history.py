"""`lasercal history` and the file behind it."""

from __future__ import annotations

import builtins
import csv
import math
import subprocess
import sys

import pytest
from cli_support import Cli, environment

from lasercal_gtsam.calibration import Parameter
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.history import HistoryRow
from lasercal_gtsam.io.history_file import (
    earlier_rows,
    history_path,
    parameter_names,
    read_history,
    write_history,
)


def parameter(name: str, value: float, sigma: float, unit: str = "mm") -> Parameter:
    return Parameter(name, math.nan, value, sigma, unit)


def rows() -> list[HistoryRow]:
    """Two parameters; a plane comes later, between them; names differ in case only."""
    made = []
    for k in range(40):
        spots = 20 + 3 * k
        parameters = [
            parameter("fu", 540 + 1 / 3 + k / 7, 30 / math.sqrt(spots), "px"),
            parameter("Tx", -512.123456789012345, math.nan if k == 0 else 100 / spots),
            parameter("skew", 0.0, 0.0, "1"),
        ]
        if k >= 10:
            parameters[1:1] = [parameter("a_A_x", 1e-17, 2.0), parameter("a_a_x", 1.0, math.inf)]
        events = {10: ("plane 'A' found", "alarm: since spot a | b"), 0: ("with 20 spots, ok",)}
        made.append(
            HistoryRow(spots, 1.1 + 1e-16 * k, math.nan if k < 2 else 0.9, tuple(parameters),
                       events.get(k, ()))
        )  # fmt: skip
    return made


@pytest.fixture
def result(tmp_path):
    """A result with its history beside it."""
    (tmp_path / "calibration.json").write_text("{}")
    write_history(tmp_path / "calibration.history.csv", rows())
    return tmp_path / "calibration.json"


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


def same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))


def test_round_trip_is_exact(tmp_path):
    made = rows()
    write_history(tmp_path / "h.csv", made)
    read = read_history(tmp_path / "h.csv")
    assert len(read) == len(made)
    for a, b in zip(made, read, strict=True):
        assert a.spots == b.spots
        assert same(a.rms_px, b.rms_px)
        assert same(a.sigma0, b.sigma0)
        assert [(p.name, p.unit) for p in a.parameters if p.name in ("fu", "Tx")] == [
            (p.name, p.unit) for p in b.parameters if p.name in ("fu", "Tx")
        ]
        there = {p.name: p for p in b.parameters}
        assert set(there) == {p.name for p in a.parameters}
        for p in a.parameters:
            assert there[p.name].refined == p.refined
            assert same(there[p.name].sigma, p.sigma)
    assert read[10].events == ("plane 'A' found", "alarm: since spot a / b")
    again = tmp_path / "again.csv"
    write_history(again, read)
    assert again.read_bytes() == (tmp_path / "h.csv").read_bytes()


def test_columns_are_as_promised(tmp_path):
    write_history(tmp_path / "h.csv", rows())
    with (tmp_path / "h.csv").open(newline="") as file:
        table = list(csv.reader(file))
    assert table[0] == [
        "spots", "rms_px", "sigma0",
        "fu [px]", "sigma_fu [px]", "a_A_x [mm]", "sigma_a_A_x [mm]", "a_a_x [mm]",
        "sigma_a_a_x [mm]", "Tx [mm]", "sigma_Tx [mm]", "skew [1]", "sigma_skew [1]",
        "event",
    ]  # fmt: skip
    assert table[1][5:9] == [""] * 4  # the plane was not there yet
    assert table[1][10] == ""  # not known
    assert table[1][12] == "0.0"  # held
    assert all(len(line) == len(table[0]) for line in table)


def test_names_keep_the_places_they_had():
    a, b, c, d = (parameter(n, 1.0, 1.0) for n in "abcd")
    made = [HistoryRow(k, 1.0, 1.0, ps) for k, ps in enumerate([(a, c), (a, b, c), (b, c, d)])]
    assert [name for name, _ in parameter_names(made)] == ["a", "b", "c", "d"]


def test_earlier_rows(tmp_path):
    assert earlier_rows(tmp_path / "none.csv", 100) == ()
    write_history(tmp_path / "h.csv", rows())
    assert [row.spots for row in earlier_rows(tmp_path / "h.csv", 26)] == [20, 23]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("id,u,v\n1,2,3\n", "not a history"),
        ("spots,rms_px,sigma0,fu [px],event\n", r":1: fu \[px\]: expected .* its sigma"),
        ("spots,rms_px,sigma0,fu [px],sigma_fv [px],event\n", "sigma_<name>"),
        ("spots,rms_px,sigma0,event\n20,one,1,\n", ":2: rms_px: expected a number, got 'one'"),
        ("spots,rms_px,sigma0,event\n2.5,1,1,\n", ":2: spots: expected a whole number"),
        ("spots,rms_px,sigma0,event\n20,1,1,\n3,4\n", ":3: 2 cells, expected 4"),
    ],
)
def test_what_is_no_history(tmp_path, text, words):
    (tmp_path / "h.csv").write_text(text)
    with pytest.raises(DataError, match=words):
        read_history(tmp_path / "h.csv")


def test_the_table_shows_some_rows_and_all_events(lasercal, result):
    outcome = lasercal("history", result, "fu", "a_*")
    assert outcome.status == 0
    assert outcome.err == ""
    table, events = outcome.out.split("\n\n")
    lines = table.splitlines()
    header = lines[0].split()
    assert header[:3] == ["spots", "RMS", "px"]
    assert "fu px" in lines[0]
    assert "a_A_x mm" in lines[0]
    assert "Tx" not in lines[0]
    shown = [int(line.split()[0]) for line in lines[2:]]
    assert shown == [20, 50, 101, 137]  # first, an event at 50, past 100, last
    assert lines[2].split() == ["20", "1.1", "540.3", "6.7"]  # no plane, no sigma0 yet
    assert lines[-1].split()[-1] == "unknown"
    assert events.splitlines() == [
        "Events, by the number of spots:",
        "  20: with 20 spots, ok",
        "  50: plane 'A' found",
        "  50: alarm: since spot a / b",
    ]
    # by default where the camera is; the folder, the result and the file are the same
    default = lasercal("history", result)
    assert "Tx mm" in default.out.splitlines()[0]
    assert lasercal("history", result.parent) == default
    assert lasercal("history", history_path(result)) == default


def test_json_has_columns_of_all_rows(lasercal, result):
    document = lasercal.json("history", result, "a_A_x", "Tx")
    assert document["spots"] == [row.spots for row in rows()]
    plane, position = document["parameters"]
    assert (plane["name"], plane["unit"]) == ("a_A_x", "mm")
    assert plane["value"] == [None] * 10 + [1e-17] * 30
    assert position["sigma"][0] is None
    assert position["sigma"][1:] == [100 / row.spots for row in rows()[1:]]
    assert len(document["events"]) == 3


def test_wrong_names_and_places_are_one_line(lasercal, result, tmp_path):
    for args, words in (
        (
            ("history", result, "a_A_y"),
            "no parameter 'a_A_y' (did you mean 'a_a_x'?); there are fu",
        ),
        (("history", tmp_path / "none.json"), "there is no such file"),
        (("history", result, "--plot", tmp_path / "no" / "x.png"), "there is no folder"),
    ):
        outcome = lasercal(*args)
        assert (outcome.status, outcome.out) == (1, "")
        assert outcome.err.count("\n") == 1
        assert words in outcome.err
    history_path(result).unlink()
    outcome = lasercal("history", result)
    assert "there is no history beside" in outcome.err
    assert lasercal("history", result, "--plot", "x.gif").status == 1


def test_help_of_the_running_commands_is_light():
    code = (
        "import sys\n"
        "from lasercal_gtsam.cli.main import main\n"
        "for name in ('watch', 'update', 'history'):\n"
        "    assert main([name, '-h']) == 0\n"
        "heavy = {'gtsam', 'numba', 'cv2', 'scipy', 'numpy', 'pydantic', 'rich', 'matplotlib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True
    )
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_plot_kinds(lasercal, result):
    outcome = lasercal("history", result, "--plot", "x.gif")
    assert outcome.status == 2
    assert ".png, .svg, .pdf" in outcome.err


def test_without_matplotlib_it_says_what_to_install(lasercal, result, tmp_path, monkeypatch):
    really = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return really(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    outcome = lasercal("history", result, "--plot", tmp_path / "x.png")
    assert outcome.status == 1
    assert "pip install 'lasercal-gtsam[report]'" in outcome.err
    assert not (tmp_path / "x.png").exists()


def test_the_drawing(lasercal, result, tmp_path):
    pytest.importorskip("matplotlib")
    outcome = lasercal("history", result, "fu", "a_A_x", "--plot", tmp_path / "x.svg")
    assert (outcome.status, outcome.out) == (0, f"Saved {tmp_path / 'x.svg'}.\n")
    drawing = (tmp_path / "x.svg").read_text()
    for words in ("fu  [px]", "a_A_x  [mm]", "spots given so far"):
        assert f"<!-- {words}" in drawing
    assert lasercal("history", result, "--plot", tmp_path / "x.png").status == 0
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
