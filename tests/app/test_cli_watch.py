"""`lasercal watch`: fed row by row and line by line, killed, stopped, and gone on with."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cli_support import PROGRAM, Cli, contents, environment
from stream_cases import (
    OPTIONS,
    START,
    bumped,
    capture_of,
    differences,
    lines_of,
    named,
    start,
    stream,
)

import lasercal_gtsam as lc
from lasercal_gtsam.cli.answers import Answers
from lasercal_gtsam.cli.keeper import Keeper
from lasercal_gtsam.cli.live import Screen
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.incremental.journaled import JournaledCalibrator
from lasercal_gtsam.io.history_file import read_history
from lasercal_gtsam.io.journal import Journal, JournalReader
from lasercal_gtsam.io.journal_lines import sealed
from lasercal_gtsam.io.spot_lines import SpotLines

# the first child of a fresh installation compiles everything
PATIENCE_S = 300.0

N = len(stream())


@pytest.fixture
def lasercal(capsys):
    return Cli(capsys)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Header and rows of the whole stream."""
    return lines_of(capture_of(tmp_path_factory.mktemp("whole"), stream()))


@pytest.fixture
def growing(tmp_path, rows):
    """A capture without rows yet, a calibration to start with beside it."""
    folder = capture_of(tmp_path / "cell", stream())
    (folder / "poses.csv").write_bytes(rows[0])
    start().save(tmp_path / "start.json")
    return folder


def append(folder: Path, *pieces: bytes) -> None:
    with (folder / "poses.csv").open("ab") as file:
        for piece in pieces:
            file.write(piece)
            file.flush()


def uninterrupted(count: int = N) -> lc.Calibration:
    calibrator = IncrementalCalibrator(start())
    for k in range(START, count):
        calibrator.add(stream()[k : k + 1])
    assert calibrator.calibration is not None
    return calibrator.calibration


def journalled(folder: Path) -> list[str]:
    records = JournalReader(folder / "calibration.journal.jsonl")
    return [name for record in records if record.kind == "spot" for name in record.payload["id"]]


class Child:
    """`lasercal watch` in a process of its own."""

    def __init__(self, *args: object, stdin: bool = False) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "watch", *map(str, args)],
            stdin=subprocess.PIPE if stdin else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment(),
        )
        self.got = self.rest = b""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            if pipe is not None:
                pipe.close()
        self.process.wait(60)

    def line(self, seconds: float = PATIENCE_S) -> str:
        """The next line on stdout."""
        end = time.monotonic() + seconds
        while b"\n" not in self.rest:
            ready, _, _ = select.select([self.process.stdout], [], [], end - time.monotonic())
            assert ready, "no answer"
            got = os.read(self.process.stdout.fileno(), 1 << 16)
            assert got, self.process.stderr.read().decode()
            self.got += got
            self.rest += got
        line, _, self.rest = self.rest.partition(b"\n")
        return line.decode()

    def ask(self, *lines: object) -> list[dict]:
        """Send lines, wait for as many answers."""
        for line in lines:
            text = line if isinstance(line, str) else json.dumps(line)
            self.process.stdin.write(text.encode() + b"\n")
        self.process.stdin.flush()
        return [json.loads(self.line()) for _ in lines]

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, (self.rest + out).decode(), err.decode()


# --- rows ---------------------------------------------------------------------------------------


def test_from_nothing_to_a_calibration_and_on(lasercal, growing, rows):
    append(growing, *rows[1:31])
    seen = lc.load_capture(growing).observations()
    append(growing, rows[31][:20])
    outcome = lasercal("watch", growing, "--once", "--interval", "0.01")
    assert outcome.status == 0
    assert outcome.err == ""
    lines = outcome.out.splitlines()
    assert lines[0].startswith("1 spot, no estimate yet, at least 15 spots are needed")
    assert re.fullmatch(r"\d+ spots: started: with \d+ spots, RMS [01]\.\d+ px", lines[2])
    assert lines[-2].startswith("Ended: 30 spots taken, 30 in all; waiting: poses.csv:32: the last")
    assert lines[-1] == f"Saved {growing / 'calibration.json'}."
    # the same as the calibrator alone, digit for digit
    calibrator = IncrementalCalibrator(options=OPTIONS)
    for k in range(30):
        calibrator.add(seen[k : k + 1])
    assert lc.load_calibration(growing / "calibration.json") == calibrator.calibration
    history = read_history(growing / "calibration.history.csv")
    assert [row.spots for row in history] == [row.spots for row in calibrator.history]
    assert history[-1].spots == 30
    # once more: nothing is taken twice, and what comes then is
    before = contents(growing)
    outcome = lasercal("watch", growing, "--once", "--interval", "0.01")
    assert outcome.out.startswith(
        f"Going on from {growing / 'calibration.journal.jsonl'}: 30 spots"
    )
    assert "Ended: 0 spots taken, 30 in all" in outcome.out
    assert contents(growing)["calibration.history.csv"] == before["calibration.history.csv"]
    append(growing, rows[31][20:], *rows[32:34])
    outcome = lasercal("watch", growing, "--once", "--interval", "0.01")
    assert "Ended: 3 spots taken, 33 in all." in outcome.out
    for k in range(30, 33):
        calibrator.add(stream()[k : k + 1])
    result = lc.load_calibration(growing / "calibration.json")
    assert differences(result, calibrator.calibration) < 1e-9


def test_a_start_goes_on_and_its_rows_are_not_taken_again(lasercal, growing, rows):
    append(growing, *rows[1:])
    result = growing / "calibration.json"
    start().save(result)  # start and result are one file
    outcome = lasercal("watch", growing, "--once", "--interval", "0.01")
    assert outcome.status == 0
    assert outcome.out.startswith(f"Going on from a calibration: {START} spots so far.\n")
    assert f"Ended: {N - START} spots taken, {N} in all." in outcome.out
    assert journalled(growing) == stream().id[START:].tolist()
    first = lc.load_calibration(result)
    assert differences(first, uninterrupted()) < 1e-9
    saved = json.loads(result.read_text())["provenance"]["files"]
    assert set(saved) == {"capture.yaml", "calibration.journal.jsonl.start"}
    # the same command goes on from the copy that the journal has of its start
    outcome = lasercal("watch", growing, "--calibration", result, "--once", "--interval", "0.01")
    assert "Ended: 0 spots taken" in outcome.out
    assert differences(lc.load_calibration(result), first) < 1e-9
    # and without naming it
    assert lasercal("watch", growing, "--once").status == 0
    (growing / "calibration.journal.jsonl.start").unlink()
    outcome = lasercal("watch", growing, "--once")
    assert (outcome.status, outcome.out) == (1, "")
    assert "whose copy calibration.journal.jsonl.start is missing" in outcome.err


def feed_with_kills(growing, rows, kills: int, seed: int) -> set[str]:
    """Feed the stream in odd pieces, kill the reader at random moments; what it acknowledged."""
    rng = np.random.default_rng(seed)
    text = b"".join(rows[START + 1 :])
    append(growing, *rows[1 : START + 1])
    ends = sorted(rng.integers(0, len(text), kills).tolist())
    begin = ("--calibration", growing.parent / "start.json")
    acknowledged: set[str] = set()
    at = 0
    for end in ends:
        early = rng.uniform() < 0.2
        with Child(growing, *begin, "--json", "--interval", 0.01) as child:
            while at < end:
                step = min(int(rng.integers(1, 400)), end - at)
                append(growing, text[at : at + step])
                at += step
            if early:  # while it starts, or goes through its journal
                time.sleep(float(rng.uniform(0, 3)))
            else:  # in the middle of the work, or when it waits for more
                child.line()
                time.sleep(float(rng.uniform(0, 0.3)))
            child.process.kill()
            out = child.got + child.process.stdout.read()
        documents = [json.loads(line) for line in out.split(b"\n")[:-1]]
        acknowledged |= {d["id"] for d in documents if "notice" not in d}
        assert acknowledged <= set(journalled_so_far(growing))
    append(growing, text[at:])
    return acknowledged


def journalled_so_far(folder: Path) -> list[str]:
    try:
        return journalled(folder)
    except lc.DataError:  # not there, or its first line is not finished
        return []


def test_killed_at_random_moments_nothing_is_lost(lasercal, growing, rows):
    begin = ("--calibration", growing.parent / "start.json")
    acknowledged = feed_with_kills(growing, rows, kills=4, seed=1)
    assert acknowledged
    outcome = lasercal("watch", growing, *begin, "--once", "--interval", "0.01")
    assert outcome.status == 0, outcome.err
    assert journalled(growing) == stream().id[START:].tolist()
    result = lc.load_calibration(growing / "calibration.json")
    assert differences(result, uninterrupted()) < 1e-9


@pytest.mark.slow
def test_killed_200_times_nothing_is_lost(lasercal, tmp_path, rows):
    expected = uninterrupted()
    for run in range(20):
        folder = capture_of(tmp_path / str(run) / "cell", stream())
        (folder / "poses.csv").write_bytes(rows[0])
        start().save(tmp_path / str(run) / "start.json")
        feed_with_kills(folder, rows, kills=10, seed=100 + run)
        begin = ("--calibration", folder.parent / "start.json")
        assert lasercal("watch", folder, *begin, "--once", "--interval", "0.01").status == 0
        assert journalled(folder) == stream().id[START:].tolist()
        result = lc.load_calibration(folder / "calibration.json")
        assert differences(result, expected) < 1e-9


def test_sigterm_ends_it_cleanly(growing, rows):
    last = START + 40
    append(growing, *rows[1:last], b"wrong,row\n", rows[last][:-1])
    args = (growing, "--calibration", growing.parent / "start.json", "--interval", 0.05)
    with Child(*args) as child:
        deadline = time.monotonic() + PATIENCE_S
        while len(journalled_so_far(growing)) < last - 1 - START:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        append(growing, b"\n")
        while len(journalled(growing)) < last - START:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        status, out, err = child.end()
    assert status == 0
    assert err == f"Warning: poses.csv:{last + 1}: 2 cells, expected 11 as in the first line\n"
    assert out.splitlines()[-2:] == [
        f"Ended: {last - START} spots taken, {last} in all.",
        f"Saved {growing / 'calibration.json'}.",
    ]
    result = lc.load_calibration(growing / "calibration.json")
    assert differences(result, uninterrupted(last)) < 1e-9
    names = {path.name for path in growing.iterdir()}
    assert names == {
        "capture.yaml", "poses.csv", "calibration.json", "calibration.history.csv",
        "calibration.journal.jsonl", "calibration.journal.jsonl.start",
    }  # fmt: skip


def test_what_is_wrong_with_files_is_said(lasercal, growing, rows):
    append(growing, *rows[1:9])
    args = ("watch", growing, "--once", "--interval", "0.01")
    assert lasercal(*args).status == 0
    another_way = rows[5].replace(b"s004,", b"s004, ")
    other = rows[6].split(b",")
    other[-1] = b"200.5\n"
    bad = rows[9].replace(b",", b",x", 2)
    lines = [*rows[:5], another_way, b",".join(other), *rows[7:9], bad, rows[10]]
    (growing / "poses.csv").write_bytes(b"".join(lines))
    outcome = lasercal(*args)
    assert outcome.status == 0
    assert "Ended: 1 spot taken, 9 in all; at least 15 spots are needed" in outcome.out
    changed, wrong = sorted(outcome.err.splitlines(), key=len, reverse=True)
    assert "poses.csv:7: id 's005': other values, but this spot is in this journal" in changed
    assert re.search(r"poses\.csv:10: x: expected a number", wrong)
    # in JSON, on stdout
    outcome = lasercal(*args, "--json")
    documents = [json.loads(line) for line in outcome.out.splitlines()]
    assert [(d["notice"], d["id"]) for d in documents] == [("changed", "s005"), ("wrong", "s008")]


def test_an_alarm_names_the_cause_and_what_to_do(lasercal, growing, tmp_path):
    moved = named(bumped(stream()[START:]), "b")[:24]
    other = lines_of(capture_of(tmp_path / "other", moved))
    append(growing, *other[1:13])
    args = ("watch", growing, "--once", "--interval", "0.01")
    outcome = lasercal(*args, "--calibration", growing.parent / "start.json")
    assert outcome.status == 1
    alarms = [line for line in outcome.out.splitlines() if line.startswith("Alarm: ")]
    assert "camera 'camera' moved by" in alarms[-1]
    assert alarms[-1].endswith(
        "To free it, end this and start it again with --reset camera:camera; if nothing has moved, "
        "with --dismiss."
    )
    assert "ALARM open" in outcome.out
    again = lasercal(*args)  # it is said again, and stays open
    assert again.status == 1
    assert again.out.splitlines()[1].startswith("Alarm: since spot b")
    assert again.out.splitlines()[1].endswith(
        "--reset camera:camera; if nothing has moved, with --dismiss."
    )
    append(growing, *other[13:])
    outcome = lasercal(*args, "--reset", "camera")
    assert outcome.status == 0, outcome.out
    assert "reset: camera 'camera' freed" in outcome.out
    assert "recovered: camera 'camera' found again" in outcome.out
    kinds = [r.kind for r in JournalReader(growing / "calibration.journal.jsonl")]
    assert kinds.count("reset") == 1
    # gone through again, the same comes out
    first = lc.load_calibration(growing / "calibration.json")
    assert lasercal(*args).status == 0
    assert differences(lc.load_calibration(growing / "calibration.json"), first) < 1e-9


def test_refusals_are_one_clear_line(lasercal, growing, rows, tmp_path):
    append(growing, *rows[1:10], rows[START + 1])
    begin = ("--calibration", tmp_path / "start.json")
    start().save(growing / "calibration.json")

    def refused(*args: object) -> str:
        outcome = lasercal("watch", *args, "--once", "--interval", "0.01")
        assert outcome.status == 1
        assert all(line.startswith("Going on") for line in outcome.out.splitlines())
        assert all(line.startswith("Error: ") for line in outcome.err.splitlines())
        return outcome.err

    before = contents(growing)
    assert "there is no such file" in refused(tmp_path / "none", *begin)
    assert "not a lasercal calibration" in refused(growing, "-o", growing / "capture.yaml")
    assert contents(growing) == before
    (growing / "calibration.json").unlink()
    assert "there is no laser 'red'; there are laser:laser" in refused(
        growing, *begin, "--reset", "laser:red"
    )
    out = ("-o", tmp_path / "new.json")
    assert "there is no estimate yet" in refused(growing, *out, "--reset", "camera")
    assert lasercal("watch", growing, *begin, "--once").status == 0
    # a journal that was begun another way
    assert "automatic was False, now it is True" in refused(growing, "--automatic")
    lc.calibrate(stream()[:50], initial=start().cell, options=OPTIONS).save(tmp_path / "other.json")
    assert "with another calibration" in refused(growing, "--calibration", tmp_path / "other.json")
    assert lasercal("watch", growing, *out, "--once").status == 0
    assert "without a calibration" in refused(growing, *out, *begin)
    head = growing / "capture.yaml"
    head.write_text(head.read_text().replace("pixel: 1.0", "pixel: 0.5"))
    assert "option sigma_px was 1.0, now it is 0.5" in refused(growing, *out)
    # where nothing has come yet, a journal may be begun another way
    (growing / "poses.csv").write_bytes(rows[0])
    empty = ("watch", growing, "-o", tmp_path / "empty.json", "--once")
    assert lasercal(*empty).status == 0
    assert lasercal(*empty, "--automatic").status == 0
    assert JournalReader(tmp_path / "empty.journal.jsonl").about["automatic"] is True
    head.write_text(head.read_text().replace("width: 640", "width: 641"))
    assert "image size 641 x 480, but it was 640 x 480" in refused(growing)


def test_ids_of_another_capture_need_a_prefix(lasercal, growing, tmp_path):
    again = named(stream()[START : START + 5], "s")
    other = capture_of(tmp_path / "other", again)
    begin = ("--calibration", tmp_path / "start.json", "--once", "--interval", "0.01")
    outcome = lasercal("watch", other, *begin)
    assert outcome.status == 1
    assert "Saved" not in outcome.out
    assert "poses.csv:2: id 's000': other values, but this spot is in the start" in outcome.err
    assert "--prefix" in outcome.err
    assert lasercal("watch", other, *begin, "--prefix", "tue-").status == 0
    assert journalled(other) == [f"tue-{name}" for name in again.id.tolist()]


def test_killed_while_the_journal_was_begun(lasercal, growing, rows):
    append(growing, *rows[START + 1 : START + 3])
    result = growing / "calibration.json"
    begun = (growing.parent / "start.json").read_bytes()
    result.write_bytes(begun)
    args = ("watch", growing, "--calibration", result, "--once", "--interval", "0.01")
    assert lasercal(*args).status == 0
    journal = growing / "calibration.journal.jsonl"
    header, first, _ = journal.read_bytes().splitlines(keepends=True)
    for left, taken in ((b"", 2), (header[:70], 2), (header, 2), (header + first[:30], 2)):
        result.write_bytes(begun)
        journal.write_bytes(left)
        outcome = lasercal(*args)
        assert outcome.status == 0, outcome.err
        assert f"Ended: {taken} spots taken, {START + 2} in all." in outcome.out
        assert outcome.err.count("\n") == (0 if left in (b"", header) else 1)
    result.write_bytes(begun)
    journal.write_bytes(header + first)
    assert f"Ended: 1 spot taken, {START + 2} in all." in lasercal(*args).out


@pytest.mark.parametrize(
    ("kind", "payload", "words"),
    [
        (
            "reset",
            {"hand": "camera"},
            "is a 'reset' with {'hand': 'camera'}; expected the names of",
        ),
        ("reset", {"camera": ["camera"]}, "expected the names of parts (camera, laser, plane)"),
        ("spot", {"id": 7}, "these are no spots"),
        ("turn", {}, "is a 'turn', which this program does not know"),
    ],
)
def test_records_that_make_no_sense(lasercal, growing, rows, kind, payload, words):
    append(growing, *rows[1:4])
    watch = "watch", growing, "--once", "--calibration", growing.parent / "start.json"
    assert lasercal(*watch).status == 0
    path = growing / "calibration.journal.jsonl"
    with Journal.open(path) as journal:
        journal.append(kind, payload)
    again = lasercal(*watch)
    assert again.status == 1
    assert words in again.err
    assert "Traceback" not in again.err


def test_a_header_that_is_no_object(lasercal, growing, rows):
    append(growing, *rows[1:4])
    watch = "watch", growing, "--once", "--calibration", growing.parent / "start.json"
    assert lasercal(*watch).status == 0
    path = growing / "calibration.journal.jsonl"
    first, *others = path.read_bytes().splitlines(keepends=True)
    record = json.loads(first)
    record["payload"]["about"] = 7
    path.write_bytes(b"".join([sealed(0, 0, record["kind"], record["payload"]), *others]))
    again = lasercal(*watch)
    assert again.status == 1
    assert "the header cannot be understood" in again.err


def test_wrong_columns_at_the_start_are_an_error(lasercal, growing):
    (growing / "poses.csv").write_text("id,plane,x,y,z,u,v\n")
    outcome = lasercal("watch", growing, "--once")
    assert (outcome.status, outcome.out) == (1, "")
    assert outcome.err.startswith("Error: poses.csv: columns qw, qx, qy, qz missing")


def test_a_second_watch_is_kept_out(lasercal, growing, rows):
    append(growing, *rows[1:3])
    settings = {"automatic": False, "max_spots": None, "half_life": None}
    path = growing / "calibration.journal.jsonl"
    with JournaledCalibrator(path, options=OPTIONS, settings=settings):
        outcome = lasercal("watch", growing, "--once")
    assert outcome.status == 1
    assert "has this journal open" in outcome.err


def test_the_live_line(lasercal, growing, rows, monkeypatch):
    append(growing, *rows[1:])
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    outcome = lasercal("watch", growing, "--calibration", growing.parent / "start.json", "--once")
    drawn = outcome.err.split("\r\x1b[K")
    assert re.fullmatch(
        rf"{N} spots, \d+ used, RMS 1\.\d+ px, camera position \+-\d[\d.]* mm \(T[xyz]\)", drawn[-2]
    )
    assert drawn[-1] == ""  # wiped at the end
    assert outcome.out.splitlines()[-1].startswith("Saved")
    assert "\x1b" not in outcome.out


def test_pictures_are_looked_at_as_they_come(lasercal, tmp_path):
    folder = tmp_path / "pictures"
    small = ("--preset", "paper-1", "--groups", "1", "--shots", "4", "--pictures")
    assert lasercal("simulate", folder, *small).status == 0
    late = folder / "images" / "s003.png"
    late.rename(tmp_path / "late.png")
    args = ("watch", folder, "--once", "--interval", "0.05")
    outcome = lasercal(*args)
    assert (outcome.status, outcome.err) == (0, "")
    assert "Ended: 3 spots taken, 3 in all; " in outcome.out
    assert f"waiting: s003: the picture {late} is not there yet." in outcome.out
    assert not (folder / "calibration.json").exists()  # no estimate yet
    (tmp_path / "late.png").rename(late)
    assert "Ended: 1 spot taken, 4 in all" in lasercal(*args).out
    expected = lc.load_capture(folder).observations()
    records = JournalReader(folder / "calibration.journal.jsonl")
    seen = {r.payload["id"][0]: r.payload["uv"][0] for r in records}
    assert seen == dict(zip(expected.id.tolist(), expected.uv.tolist(), strict=True))


def test_usage(lasercal, growing):
    for args, words in (
        ((), "CAPTURE is needed"),
        ((growing, "--stdin", "--prefix", "x"), "--prefix"),
        ((growing, "--reset", "tripod"), "camera, laser or plane"),
        ((growing, "--max-spots", "3"), "--max-spots"),
    ):
        outcome = lasercal("watch", *args)
        assert outcome.status == 2
        assert words in outcome.err


# --- standard input -----------------------------------------------------------------------------


def spot(k: int, **changes: object) -> dict:
    one = stream()[k : k + 1]
    said = {
        "id": str(one.id[0]),
        "plane": str(one.plane[0]),
        "uv": one.uv[0].tolist(),
        "T_base_hand": one.T_base_hand[0].tolist(),
    }
    return {key: value for key, value in {**said, **changes}.items() if value is not None}


def test_a_conversation(growing, tmp_path):
    out = ("-o", growing / "calibration.json")
    args = ("--stdin", "--calibration", tmp_path / "start.json", *out)
    with Child(*args, stdin=True) as child:
        first, again, wrong, sizes, other = child.ask(
            spot(START), spot(START), '{"id": "a", "plane": ', {"image_size": [640, 480]},
            spot(START + 1, id=str(stream().id[0])),
        )  # fmt: skip
        assert first["id"] == stream().id[START]
        assert first["status"] in ("accepted", "rejected")
        assert first["n_spots"] == START + 1
        expected = IncrementalCalibrator(start()).add(stream()[START : START + 1])
        # not to the last digit: the child may be the process that compiles
        assert first["chi2"] == pytest.approx(expected.innovation.chi2[0], rel=1e-6)
        assert first["rms_px"] == pytest.approx(expected.rms_px, rel=1e-9)
        assert re.fullmatch(r"camera position \+-[\d.]+ mm \(T[xyz]\)", first["largest_sigma"])
        assert (first["alarm"], first["missing"], first["events"]) == (None, [], [])
        assert (again["id"], again["status"]) == (first["id"], "known")
        assert wrong["id"] is None
        assert wrong["error"].startswith("line 3: column 22: not JSON")
        assert sizes["image_size"] == {"camera": [640, 480]}
        assert other["error"].startswith("line 5: id: 's000' is in the start already with other")
        # what was answered is on the disk
        assert journalled(growing) == [first["id"]]
        answers = child.ask(*(spot(k) for k in range(START + 1, START + 20)))
        child.process.kill()
    assert [a["id"] for a in answers] == stream().id[START + 1 : START + 20].tolist()
    assert journalled(growing) == stream().id[START : START + 20].tolist()
    with Child(*args, stdin=True) as child:
        # the robot does not know which arrived, and sends the last ones again
        answers = child.ask(*(spot(k) for k in range(START + 18, N)))
        assert [a.get("status") for a in answers[:3]] == ["known", "known", "accepted"]
        (reset,) = child.ask({"reset": {"camera": "camera"}})
        assert reset["phase"] == "recovering"
        assert reset["missing"]
        (unknown,) = child.ask({"reset": {"plane": "9"}})
        assert "plane '9' is not among" in unknown["error"]
        child.process.stdin.close()
        child.process.stdin = None
        _, err = child.process.communicate(timeout=PATIENCE_S)
        assert child.process.returncode == 0
    assert f"Ended: {N - START - 20} spots taken, {N} in all" in err.decode()
    assert [r.kind for r in JournalReader(growing / "calibration.journal.jsonl")][-2:] == [
        "reset", "reset",
    ]  # fmt: skip


@pytest.fixture
def conversation(tmp_path, capsys):
    """The conversation without a process: lines in, documents out."""
    settings = {"automatic": False, "max_spots": None, "half_life": None}
    with JournaledCalibrator(tmp_path / "j.jsonl", options=OPTIONS, settings=settings) as session:
        screen = Screen(err=True)
        keeper = Keeper(session, tmp_path / "c.json", screen, sources={}, conversation=True)
        answers = Answers(keeper, SpotLines({}))

        def say(*lines: object) -> list[dict]:
            capsys.readouterr()
            answers.take([json.dumps(line).encode() for line in lines])
            return [json.loads(line) for line in capsys.readouterr().out.splitlines()]

        say.session = session
        yield say


def test_every_line_gets_its_answer_in_order(conversation):
    first = conversation(spot(0), {"image_size": [640, 480]}, spot(0), spot(1), spot(0), spot(2))
    assert [a.get("status") for a in first] == [
        None, None, "held back", "held back", "known", "held back",
    ]  # fmt: skip
    assert "the image size is not known yet" in first[0]["error"]
    assert [a.get("n_spots") for a in first[1:]] == [0, 1, 2, 2, 3]
    assert first[2]["missing"][0].startswith("at least 15 spots are needed")
    (again,) = conversation({"image_size": [641, 480]})
    assert "image size 641 x 480, but it was 640 x 480" in again["error"]
    clash = conversation(spot(3), spot(3, uv=[1, 1]))
    assert clash[0]["status"] == "held back"
    assert clash[1]["error"].startswith("line 9: id: 's003' is in this journal already")
    (early,) = conversation({"reset": {"camera": "camera"}})
    assert "there is no estimate yet" in early["error"]


def test_a_full_disk_is_answered_and_the_spot_may_come_again(conversation, monkeypatch):
    conversation({"image_size": [640, 480]}, spot(0))

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        answers = conversation(spot(1), spot(2))
    assert [a["id"] for a in answers] == ["s001", "s002"]
    assert all("No space left on device; it does not count" in a["error"] for a in answers)
    assert [a["n_spots"] for a in conversation(spot(1), spot(2))] == [2, 3]
    assert conversation.session.calibrator.n_spots == 3


def test_ctrl_c_on_standard_input(growing, tmp_path):
    with Child(growing, "--stdin", "--calibration", tmp_path / "start.json", stdin=True) as child:
        child.ask(spot(START))
        status, out, err = child.end(signal.SIGINT)
    assert (status, out) == (0, "")
    assert "Traceback" not in err
    assert f"Ended: 1 spot taken, {START + 1} in all." in err
    assert len(lc.load_calibration(growing / "calibration.json").spots) == START + 1
