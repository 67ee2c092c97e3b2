"""The command line as a whole: help without heavy imports, exit statuses, interrupts, pipes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from cli_support import PROGRAM, Cli, environment, in_fresh_process

import lasercal_gtsam
from lasercal_gtsam.cli import main as main_module
from lasercal_gtsam.cli.main import cli

HEAVY = ("gtsam", "numba", "cv2", "scipy", "numpy", "pydantic", "ruamel", "rich", "matplotlib")


@pytest.fixture
def lasercal(capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(capsys)


@pytest.mark.parametrize("args", [["--help"], ["--version"], ["calibrate", "-h"], ["nonsense"]])
def test_help_imports_nothing_heavy(args):
    code = (
        "import sys\n"
        "from lasercal_gtsam.cli.main import main\n"
        "main(sys.argv[1:])\n"
        f"print(sorted(set({HEAVY!r}) & set(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *args],
        capture_output=True,
        text=True,
        env=environment(),
        check=True,
    )
    assert done.stderr.splitlines()[-1] == "[]"


def test_help_names_every_command_and_fits_a_terminal(lasercal):
    outcome = lasercal("-h")
    assert outcome.status == 0
    for name in ("calibrate", "detect", "simulate", "demo"):
        assert f"\n  {name} " in outcome.out
        page = lasercal(name, "--help")
        assert page.status == 0
        assert max(map(len, page.out.splitlines())) <= 80
    assert "..." not in outcome.out.partition("Commands:")[2]  # no short help is cut off


def test_every_option_explains_itself():
    for command in cli.commands.values():
        for parameter in command.params:
            if isinstance(parameter, click.Option):
                assert parameter.help and parameter.help.endswith((".", "  ", "]")), parameter.name


def test_version(lasercal):
    assert lasercal("--version") == (0, f"lasercal {lasercal_gtsam.__version__}\n", "")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["calibrat"], "calibrat"),
        (["calibrate"], "CAPTURE"),
        (["calibrate", "x", "--distorsion", "all"], "--distortion"),
        (["calibrate", "x", "--distortion", "k7"], "k1,k2,p1,p2"),
        (["calibrate", "x", "--known", "skew"], "NAME=VALUE"),
        (["calibrate", "x", "--known", "skew=zero"], "expected a number"),
        (["calibrate", "x", "--known", "skew=nan"], "expected a number"),
        (["calibrate", "x", "--sigma-px", "0"], "--sigma-px"),
        (["detect", "x", "--set", "chanel=red"], "channel"),
        (["detect", "x", "--set", "channel=pink"], "gray"),
        (["detect", "x", "--set", "min_snr=high"], "a number"),
        (["detect", "x", "--set", "region=1,2"], "3 corners"),
        (["simulate", "x", "--preset", "papr"], "paper-distorted"),
        (["simulate", "x", "--rotation", "kuk"], "did you mean 'kuka'"),
        (["simulate", "x", "--seed", "-1"], "--seed"),
        (["simulate", "x", "--ambient", "0.1"], "--pictures"),
    ],
)
def test_wrong_usage_is_status_2_with_what_is_allowed(lasercal, args, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = lasercal(*args)
    assert outcome.status == 2
    assert outcome.out == ""
    assert words in outcome.err
    assert "Usage:" in outcome.err
    assert not list(tmp_path.iterdir())


def test_a_bug_keeps_its_traceback(lasercal, monkeypatch):
    def broken(*args, **kwargs):
        raise RuntimeError("a bug")

    monkeypatch.setattr("lasercal_gtsam.io.capture.load_capture", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        lasercal("calibrate", "x")


def test_all_problems_are_printed_a_line_each(lasercal, monkeypatch):
    def wrong(*args, **kwargs):
        raise lasercal_gtsam.DataError("poses.csv:2: one", "poses.csv:7: two")

    monkeypatch.setattr("lasercal_gtsam.io.capture.load_capture", wrong)
    assert lasercal("calibrate", "x") == (
        1,
        "",
        "Error: poses.csv:2: one\nError: poses.csv:7: two\n",
    )


def test_interrupt_is_status_130_and_says_so(lasercal, monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("lasercal_gtsam.io.capture.load_capture", interrupted)
    outcome = lasercal("calibrate", "x")
    assert outcome.status == main_module.INTERRUPTED == 130
    assert outcome.err.strip() == "Interrupted: nothing was saved half written."


def test_ctrl_c_leaves_nothing_half_written(tmp_path):
    out = tmp_path / "demo"
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "demo", "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    deadline = time.monotonic() + 60
    while not any(out.glob(".writing-*/images/*")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    printed, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert printed == ""
    assert "Traceback" not in said
    assert list(out.iterdir()) == []


def test_a_closed_pipe_is_no_traceback():
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "simulate", "-h"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
    )
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) in (0, 1)
    assert said == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, "-h"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.startswith("Error: ")
    assert "Traceback" not in done.stderr.splitlines()[0]


def test_a_name_the_terminal_cannot_show_is_escaped():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, "calibrate", "Łódź"],
        capture_output=True,
        env={**environment(), "PYTHONIOENCODING": "latin-1"},
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(b"Error: \\u0141\xf3d\\u017a: ")


def test_a_missing_capture_is_one_line_and_status_1(tmp_path):
    outcome = in_fresh_process("calibrate", "nowhere", cwd=tmp_path)
    assert outcome == (1, "", "Error: nowhere: there is no such file or folder\n")


@pytest.mark.parametrize(
    "args",
    [("a\x1b[31mb",), ("plan", "x", "\r"), ("simulate", "x", "--seed", "\x1b[2J")],
)
def test_what_a_terminal_would_obey_is_shown_instead(lasercal, args):
    outcome = lasercal(*args)
    assert outcome.status == 2
    told = outcome.err
    assert not any(c in told for c in "\r\x1b")
    assert r"\x1b[" in told or r"\r" in told
