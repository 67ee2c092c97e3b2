"""The journal: what it acknowledged is there after a kill, a torn write, a full disk."""

from __future__ import annotations

import errno
import json
import os
import resource
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from journal_child import payload_of

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import LARGEST
from lasercal_gtsam.io import journal as module
from lasercal_gtsam.io.journal import (
    Damage,
    Journal,
    JournalReader,
    Record,
    observations_from,
    salvage,
    spots_payload,
)
from lasercal_gtsam.observations import Observations

CHILD = Path(__file__).with_name("journal_child.py")
ABOUT = {"start": "cell-3/calibration.json", "größe": [1, None, -0.0, {"a": True}]}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.jsonl"


@pytest.fixture
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests with very many openings in which nobody pulls the plug."""
    monkeypatch.setattr(module, "_sync", lambda handle: None)
    monkeypatch.setattr(os, "fsync", lambda handle: None)


def write(path: Path, count: int) -> list[bytes]:
    """A journal of ``count`` records, each in a sync of its own; its lines, the header first."""
    with Journal.create(path, ABOUT) as journal:
        for seq in range(1, count + 1):
            journal.append("test", {"number": seq, "text": "Größe " * (seq % 3)})
    return path.read_bytes().splitlines(keepends=True)


def numbers(path: Path) -> list[int]:
    """The numbers of the records that can be read, checked against their content."""
    found = []
    for record in JournalReader(path):
        assert record.payload["number"] == record.seq
        found.append(record.seq)
    return found


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


# What is written is read


def test_records_come_back_in_order(path: Path) -> None:
    with Journal.create(str(path), ABOUT) as journal:
        assert (journal.count, journal.about, journal.repaired) == (0, ABOUT, None)
        assert journal.append("spots", {"a": [0.1, -0.0, 5e-324]}) == 1
        assert journal.append_many([("reset", {}), ("note", {"text": "é\n\u2028\ud800"})]) == range(
            2, 4
        )
        assert journal.append_many([]) == range(4, 4)
        created = journal.created
    with Journal.open(path) as journal:
        assert (journal.count, journal.about, journal.repaired) == (3, ABOUT, None)
        assert journal.append("spots", {"b": None}) == 4
    reader = JournalReader(path)
    assert (reader.about, reader.created) == (ABOUT, created)
    expected = [
        Record(1, "spots", {"a": [0.1, -0.0, 5e-324]}),
        Record(2, "reset", {}),
        Record(3, "note", {"text": "é\n\u2028\ud800"}),
        Record(4, "spots", {"b": None}),
    ]
    assert list(reader) == expected == list(reader)
    assert str(expected[0]) == str(next(iter(reader)))  # the sign of -0.0
    assert reader.tail is None
    assert names(path.parent) == ["journal.jsonl"]


def test_each_line_is_json_that_a_person_can_read(path: Path) -> None:
    write(path, 3)
    lines = path.read_text("utf-8").splitlines()
    assert [json.loads(line)["seq"] for line in lines] == [0, 1, 2, 3]
    assert '"größe"' in lines[0]
    assert json.loads(lines[0])["payload"]["version"] == 1
    assert set(json.loads(lines[2])) == {"seq", "batch", "kind", "payload", "crc"}


def test_open_starts_a_journal_only_if_told_what_it_is_about(path: Path) -> None:
    with pytest.raises(DataError, match=r"journal\.jsonl: cannot be opened: No such file"):
        Journal.open(path)
    assert names(path.parent) == []
    with Journal.open(path, {"a": 1}) as journal:
        journal.append("test", {"number": 1})
    with Journal.open(path, {"a": 2}) as journal:
        assert (journal.about, journal.count) == ({"a": 1}, 1)
    with pytest.raises(DataError, match="there is a journal already"):
        Journal.create(path, {})
    assert numbers(path) == [1]


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        ("spots", {"a": float("nan")}),
        ("spots", {"a": float("inf")}),
        ("spots", {"a": np.zeros(2)}),
        ("spots", {"a": {1, 2}}),
        ("lasercal-journal", {}),
    ],
)
def test_what_json_cannot_say_is_refused_and_nothing_written(
    path: Path, kind: str, payload: dict[str, Any]
) -> None:
    with Journal.create(path, ABOUT) as journal:
        journal.append("test", {"number": 1})
        size = path.stat().st_size
        with pytest.raises(DataError, match=kind):
            journal.append_many([("test", {"number": 2}), (kind, payload)])
        assert path.stat().st_size == size
        assert journal.append("test", {"number": 2}) == 2
    assert numbers(path) == [1, 2]


def test_a_closed_journal_says_so(path: Path) -> None:
    journal = Journal.create(path, ABOUT)
    journal.close()
    journal.close()
    with pytest.raises(DataError, match="closed"):
        journal.append("test", {})


def test_reading_needs_little_memory_and_appending_constant_work(
    path: Path, monkeypatch: pytest.MonkeyPatch, no_sync: None
) -> None:
    written: list[int] = []

    def pwrite(handle: int, content: bytes, offset: int, real: Any = os.pwrite) -> int:
        written.append(len(content))
        return int(real(handle, content, offset))

    monkeypatch.setattr(os, "pwrite", pwrite)
    with Journal.create(path, ABOUT) as journal:
        for seq in range(1, 10_001):
            journal.append("test", {"number": seq, "text": "x" * 300})
    assert len(written) == 10_001
    assert max(written) < 400
    tracemalloc.start()
    assert sum(1 for _ in JournalReader(path)) == 10_000
    with Journal.open(path) as journal:
        assert journal.count == 10_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400_000 < path.stat().st_size / 5


# On the disk before it is acknowledged


def test_append_syncs_after_writing_and_before_returning(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    folders: list[bool] = []
    real = os.fsync

    def fsync(handle: int) -> None:
        folders.append(os.path.samestat(os.fstat(handle), path.parent.stat()))
        real(handle)

    monkeypatch.setattr(module, "_sync", lambda handle: sizes.append(os.fstat(handle).st_size))
    monkeypatch.setattr(os, "fsync", fsync)
    with Journal.create(path, ABOUT) as journal:
        assert sizes[-1] == path.stat().st_size > 0
        assert folders == [True]
        for batch in (1, 1, 50):
            before = len(sizes)
            journal.append_many([("test", {})] * batch)
            assert sizes[before:] == [path.stat().st_size]
    before = len(sizes)
    with Journal.open(path):  # what a killed writer wrote may not have been synced
        assert sizes[before:] == [path.stat().st_size]


# A damaged end


def test_cut_at_every_byte_of_the_last_record(path: Path, no_sync: None) -> None:
    lines = write(path, 4)
    content, last = b"".join(lines), len(lines[-1])
    start = len(content) - last
    for end in range(start, len(content)):
        path.write_bytes(content[:end])
        reader = JournalReader(path)
        assert [record.seq for record in reader] == [1, 2, 3]
        assert (reader.tail is None) == (end == start)
        with Journal.open(path) as journal:
            assert (journal.about, journal.count) == (ABOUT, 3)
            assert journal.append("test", {"number": 4}) == 4
            if end > start:
                kept = path.with_name(f"journal.jsonl.damaged-{start}")
                assert kept.read_bytes() == content[start:end]
                assert journal.repaired is not None
                assert str(kept) in journal.repaired
                assert f"journal.jsonl:5: byte {start}: the line has no end" in journal.repaired
                kept.unlink()
            else:
                assert journal.repaired is None
        assert numbers(path) == [1, 2, 3, 4]


def test_every_byte_of_the_last_record_counts(path: Path) -> None:
    lines = write(path, 3)
    content = bytearray(b"".join(lines))
    for place in range(len(content) - len(lines[-1]), len(content)):
        for bit in (0, 3, 5, 7):
            content[place] ^= 1 << bit
            path.write_bytes(content)
            reader = JournalReader(path)
            assert [record.seq for record in reader] == [1, 2]
            assert reader.tail is not None
            content[place] ^= 1 << bit


def test_every_byte_of_a_record_in_the_middle_counts(path: Path, no_sync: None) -> None:
    lines = write(path, 5)
    content = bytearray(b"".join(lines))
    start = sum(map(len, lines[:3]))
    for place in range(start, start + len(lines[3])):
        content[place] ^= 0x20
        path.write_bytes(content)
        where = rf"journal\.jsonl:4: byte {start}: the checksum does not fit, with [12] whole"
        with pytest.raises(DataError, match=where):
            numbers(path)
        with pytest.raises(DataError, match=where + r".*journal\.salvage"):
            Journal.open(path)
        assert path.read_bytes() == content
        content[place] ^= 0x20


@pytest.mark.parametrize("block", [1, 4096, 100_000])
def test_nul_bytes_at_the_end(path: Path, block: int) -> None:
    lines = write(path, 3)
    whole, start = b"".join(lines), len(b"".join(lines[:-1]))
    for end in (start, start + 1, start + 20, len(whole)):
        path.write_bytes(whole[:end] + bytes(block))
        kept = [1, 2, 3] if end == len(whole) else [1, 2]
        assert numbers(path) == kept
        with Journal.open(path) as journal:
            assert journal.repaired is not None
            assert ("NUL" in journal.repaired) == (end in (start, len(whole)))
            assert journal.append("test", {"number": journal.count + 1}) == len(kept) + 1
        assert numbers(path) == [*kept, len(kept) + 1]


def test_damage_twice_at_one_place_keeps_both(path: Path) -> None:
    write(path, 2)
    size = path.stat().st_size
    for rest in (b"first", b"second"):
        with path.open("ab") as handle:
            handle.write(rest)
        Journal.open(path).close()
    kept = path.with_name(f"journal.jsonl.damaged-{size}")
    assert kept.read_bytes() == b"first"
    assert kept.with_name(kept.name + "-2").read_bytes() == b"second"


def test_a_sync_cut_short_may_leave_whole_records_after_a_hole(path: Path) -> None:
    """Pages reach the disk in any order; nobody was told that any of them did."""
    write(path, 2)
    with Journal.open(path) as journal:
        journal.append_many([("test", {"number": seq}) for seq in range(3, 9)])
    lines = path.read_bytes().splitlines(keepends=True)
    torn = [*lines[:4], bytes(len(lines[4])), *lines[5:]]
    path.write_bytes(b"".join(torn))
    assert numbers(path) == [1, 2, 3]
    with Journal.open(path) as journal:
        assert journal.repaired is not None
        assert "then 3 whole records of the same unfinished write" in journal.repaired
        assert journal.count == 3
    assert next(path.parent.glob("*.damaged-*")).read_bytes() == b"".join(torn[4:])


def test_but_not_before_an_acknowledged_record(path: Path) -> None:
    with Journal.create(path, ABOUT) as journal:
        journal.append_many([("test", {"number": seq}) for seq in range(1, 5)])
        journal.append("test", {"number": 5})
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:2], bytes(len(lines[2])), *lines[3:]]))
    with pytest.raises(DataError, match=r"journal\.jsonl:3: .* with 2 whole records after it"):
        Journal.open(path)


@pytest.mark.parametrize(
    ("order", "line", "expected", "found"),
    [
        ([0, 1, 3, 4], 3, 2, 3),
        ([0, 1, 2, 4], 4, 3, 4),
        ([0, 2, 3, 4], 2, 1, 2),
        ([0, 1, 2, 3, 4, 4], 6, 5, 4),
        ([0, 1, 2, 2, 3, 4], 4, 3, 2),
        ([0, 1, 3, 2, 4], 3, 2, 3),
        ([0, 1, 2, 3, 4, 0], 6, 5, 0),
    ],
)
def test_records_missing_repeated_or_out_of_order(
    path: Path, order: list[int], line: int, expected: int, found: int
) -> None:
    lines = write(path, 4)
    content = b"".join(lines[k] for k in order)
    path.write_bytes(content)
    message = rf"journal\.jsonl:{line}: byte \d+: expected record {expected}, found record {found}"
    with pytest.raises(DataError, match=message):
        list(JournalReader(path))
    with pytest.raises(DataError, match=message):
        Journal.open(path)
    assert path.read_bytes() == content


# The header


def test_a_header_cut_at_every_byte(path: Path, no_sync: None) -> None:
    header = write(path, 0)[0]
    for end in range(len(header)):
        content = header[:end] + bytes(end // 2 % 2 * 500)
        path.write_bytes(content)
        for attempt in (JournalReader, Journal.open):
            with pytest.raises(DataError, match=r"journal\.jsonl.*remove it and start again"):
                attempt(path)
        assert path.read_bytes() == content
        start = Journal.create if end % 2 else Journal.open
        with start(path, ABOUT) as journal:
            assert (journal.count, journal.about) == (0, ABOUT)
            assert (journal.repaired is None) == (not content)
            journal.append("test", {"number": 1})
        assert numbers(path) == [1]
        if content:
            kept = path.with_name("journal.jsonl.damaged-0")
            assert kept.read_bytes() == content
            kept.unlink()


def test_a_damaged_header_before_records(path: Path) -> None:
    lines = write(path, 2)
    for place in range(len(lines[0])):
        content = bytearray(b"".join(lines))
        content[place] ^= 1
        path.write_bytes(content)
        for attempt in (JournalReader, Journal.open, lambda p: Journal.open(p, ABOUT)):
            with pytest.raises(DataError, match=r"journal\.jsonl:( not a journal|1: byte 0)"):
                attempt(path)
        assert path.read_bytes() == content
        left = list(salvage(path))
        assert [x.seq for x in left if isinstance(x, Record)][-1] == 2
        assert isinstance(left[0], Damage)


@pytest.mark.parametrize(
    "content",
    [
        b"u,v\n1,2\n",
        b"{}",
        b'{"seq":0,"batch":0,"kind":"other"}\n',
        b"\xef\xbb\xbf{",
        bytes(40_000) + b"CD001",
        b"\xff",
    ],
)
def test_another_file_is_left_alone(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    for attempt in (JournalReader, Journal.open, lambda p: Journal.create(p, {})):
        with pytest.raises(DataError, match=r"journal\.jsonl: not a journal: expected it to begin"):
            attempt(path)
    with pytest.raises(DataError, match="not a journal"):
        Journal.open(path, ABOUT)
    assert path.read_bytes() == content
    assert names(path.parent) == ["journal.jsonl"]


def test_empty_missing_and_a_folder(path: Path) -> None:
    with pytest.raises(DataError, match=r"journal\.jsonl: cannot be read: No such file"):
        JournalReader(path)
    path.touch()
    for attempt in (JournalReader, Journal.open):
        with pytest.raises(DataError, match=r"journal\.jsonl: the file is empty"):
            attempt(path)
    with pytest.raises(DataError, match="Is a directory"):
        Journal.open(path.parent)
    with pytest.raises(DataError, match="Is a directory"):
        JournalReader(path.parent)
    with pytest.raises(DataError, match="cannot be opened"):
        Journal.create(path.parent / "missing" / "a", ABOUT)


def test_a_newer_version(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(module, "VERSION", 2)
        with pytest.raises(DataError):
            Journal.create(path, ABOUT)
    for attempt in (JournalReader, Journal.open):
        with pytest.raises(DataError, match="has version 2, this program knows 1"):
            attempt(path)


# The way out of damage


def test_salvage_gives_what_is_left_and_says_what_is_not(path: Path) -> None:
    lines = write(path, 6)
    bad = b"?" * 10 + lines[2][10:]
    path.write_bytes(b"".join([*lines[:2], bad, *lines[3:5], lines[6], lines[6], b"half"]))
    start = len(lines[0]) + len(lines[1])
    after = start + sum(len(line) for line in lines[2:5])
    left = list(salvage(path))
    assert [x.seq if isinstance(x, Record) else x.problem for x in left] == [
        1,
        "the checksum does not fit",
        3,
        4,
        "expected record 5, found record 6",
        6,
        "expected record 7, found record 6",
        "the line has no end",
    ]
    assert left[1] == Damage(3, start, len(bad), "the checksum does not fit")
    assert left[4] == Damage(6, after, 0, "expected record 5, found record 6", torn=False)
    kept = [x for x in left if isinstance(x, Record)]
    new = path.with_name("new.jsonl")
    with Journal.create(new, ABOUT) as journal:
        journal.append_many((x.kind, x.payload) for x in kept)
    assert [x.payload["number"] for x in JournalReader(new)] == [1, 3, 4, 6]


# Errors of the disk


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Writes end at this size, as on a full disk (Python ignores the signal)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk(path: Path) -> None:
    lines = write(path, 3)
    size = len(b"".join(lines))
    with Journal.open(path) as journal:
        for room in (0, 1, 40, 150):
            with largest_file(size + room):
                for _ in range(2):
                    with pytest.raises(
                        DataError, match=r"could not be written: File too large.* 3 records"
                    ):
                        journal.append_many([("test", {"number": k}) for k in (4, 5, 6)])
                    assert (journal.count, path.stat().st_size) == (3, size)
        assert journal.append("test", {"number": 4}) == 4
    assert numbers(path) == [1, 2, 3, 4]
    assert names(path.parent) == ["journal.jsonl"]


def test_a_full_disk_when_creating(path: Path) -> None:
    with largest_file(20), pytest.raises(DataError, match="File too large"):
        Journal.create(path, ABOUT)
    with Journal.create(path, ABOUT) as journal:
        assert journal.repaired is None
        journal.append("test", {"number": 1})
    assert numbers(path) == [1]


def test_a_damaged_end_is_cut_only_once_it_is_kept(path: Path) -> None:
    write(path, 1)
    with path.open("ab") as handle:
        handle.write(b"x" * 500)
    content = path.read_bytes()
    with largest_file(100), pytest.raises(DataError, match="File too large"):
        Journal.open(path)
    assert path.read_bytes() == content
    assert names(path.parent) == ["journal.jsonl"]


@pytest.mark.parametrize("failures", [1, 2, 3, 4])
def test_a_sync_that_fails_is_no_acknowledgement(
    path: Path, monkeypatch: pytest.MonkeyPatch, failures: int
) -> None:
    """Odd: the append fails. Even: cutting back fails too, and is made up for."""
    left = 0

    def sync(handle: int, real: Any = module._sync) -> None:
        nonlocal left
        if left:
            left -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        real(handle)

    monkeypatch.setattr(module, "_sync", sync)
    write(path, 2)
    with Journal.open(path) as journal:
        size, left = path.stat().st_size, failures
        while left:
            with pytest.raises(DataError, match=r"could not be written: Input/output error"):
                journal.append("test", {"number": 3, "text": "not acknowledged"})
            assert (journal.count, path.stat().st_size) == (2, size)
        assert journal.append("test", {"number": 3}) == 3
    assert [record.payload for record in JournalReader(path)][2] == {"number": 3}


def test_an_interrupted_append_leaves_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    write(path, 2)
    with Journal.open(path) as journal:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(module, "_sync", interrupted)
            journal.append("test", {"number": 3, "text": "a long one that is not acknowledged"})
        assert journal.append("test", {"number": 3}) == 3
    reader = JournalReader(path)
    assert [record.payload for record in reader][2] == {"number": 3}
    assert reader.tail is None


def test_a_file_taken_away_or_changed_is_noticed(path: Path) -> None:
    content = b"".join(write(path, 2))
    with Journal.open(path) as journal:
        path.unlink()
        with pytest.raises(DataError, match="changed or deleted by another program"):
            journal.append("test", {"number": 3})
    for changed in (content[:-1], content + b"x", b""):
        path.write_bytes(content)
        with Journal.open(path) as journal:
            path.write_bytes(changed)
            with pytest.raises(DataError, match="changed or deleted by another program"):
                journal.append("test", {"number": 3})
        assert path.read_bytes() == changed


def test_a_file_cut_after_an_interrupted_append_is_not_filled_up(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(handle: int) -> None:
        raise KeyboardInterrupt

    content = b"".join(write(path, 2))
    with Journal.open(path) as journal:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(module, "_sync", interrupted)
            journal.append("test", {"number": 3})
        os.truncate(path, len(content) - 1)
        with pytest.raises(DataError, match="changed or deleted by another program"):
            journal.append("test", {"number": 3})
    assert path.read_bytes() == content[:-1]


# Two processes


@contextmanager
def child(task: str, path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The child program, open for writing; killed at the end."""
    command = [sys.executable, str(CHILD), task, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().strip().isdigit()
            yield process
        finally:
            process.kill()


def test_one_writer_in_a_process(path: Path) -> None:
    with Journal.create(path, ABOUT) as journal:
        message = rf": process {os.getpid()} on .* \(since .* has this journal open"
        for attempt in (Journal.open, lambda p: Journal.create(p, {})):
            with pytest.raises(DataError, match=message):
                attempt(path)
        list(JournalReader(path))  # opens and closes the file: the lock must survive it
        link = path.with_name("link")
        link.symlink_to(path)
        with pytest.raises(DataError, match=message):
            Journal.open(link)
        journal.append("test", {"number": 1})
    with Journal.open(path) as journal:
        assert journal.count == 1


def test_one_writer_in_two_processes_and_the_lock_dies_with_it(path: Path) -> None:
    write(path, 2)
    with child("hold", path) as process:
        message = rf"process {process.pid} on .*since .* end that one first"
        with pytest.raises(DataError, match=message):
            Journal.open(path)
        path.with_name("journal.jsonl.writer").unlink()
        with pytest.raises(DataError, match="another writer has this journal open"):
            Journal.open(path)
        process.kill()
        process.wait()
        with Journal.open(path) as journal:
            assert (journal.count, journal.repaired) == (2, None)
    assert names(path.parent) == ["journal.jsonl"]


def kill_at_random(path: Path, times: int) -> None:
    rng = np.random.default_rng(times)
    Journal.create(path, ABOUT).close()
    acknowledged = 0
    for _ in range(times):
        with child("append", path) as process:
            assert process.stdout is not None
            for _ in range(int(rng.integers(0, 12))):
                process.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(float(rng.uniform(1e-5, 0.02)))
            process.kill()
            told = process.stdout.read().split(b"\n")[:-1]  # the last one only if it was told whole
        before, acknowledged = acknowledged, max([acknowledged, *map(int, told)])
        with Journal.open(path) as journal:
            assert journal.count >= acknowledged >= before
            last = journal.count
        for record in JournalReader(path):
            if record.seq > before:
                assert record.payload == payload_of(record.seq)
        assert record.seq == last
        acknowledged = last


def test_kill_at_random_moments(path: Path) -> None:
    kill_at_random(path, 15)


@pytest.mark.slow
def test_kill_at_very_many_random_moments(path: Path) -> None:
    kill_at_random(path, 200)


def test_reading_while_another_process_writes(path: Path) -> None:
    Journal.create(path, ABOUT).close()
    with child("append", path) as process:
        assert process.stdout is not None
        last = 0
        for _ in range(60):
            told = int(process.stdout.readline())
            seen = 0
            for record in JournalReader(path):
                seen += 1
                assert record == Record(seen, "test", payload_of(seen))
            assert seen >= max(told, last)
            last = seen


@pytest.mark.parametrize("more", [b"", b"\n", b"\ny\nz\n", b'{"seq":3,"batch":3,'])
@pytest.mark.parametrize("half", [0, 20])
def test_a_tail_that_is_mended_while_it_is_read(path: Path, more: bytes, half: int) -> None:
    """The reader has the torn lines in its buffer when a writer cuts them off and goes on."""
    lines = write(path, 5)
    safe = len(b"".join(lines[:3]))
    path.write_bytes(b"".join(lines[:3]) + lines[3][:20] + more)
    reader = JournalReader(path)
    records = iter(reader)
    assert next(records).seq == 1
    with path.open("r+b") as handle:
        handle.truncate(safe)
        handle.seek(safe)
        handle.write(b"".join(lines[3:]) + lines[3][:half])
    assert [record.seq for record in records] == [2, 3, 4, 5]
    assert (reader.tail is None) == (half == 0)


def test_a_line_that_is_completed_while_it_is_read(path: Path) -> None:
    lines = write(path, 5)
    whole = b"".join(lines)
    path.write_bytes(whole[: len(b"".join(lines[:3])) + 20])
    found = salvage(path)
    assert [next(found), next(found)] == list(JournalReader(path))
    assert isinstance(next(found), Damage)
    path.write_bytes(whole)
    assert list(found) == []  # not the rest of that line as one of its own


# Observations

TEXT = st.text(st.characters(exclude_categories=()), max_size=8).filter(
    lambda text: not text.endswith("\0")  # numpy strings cannot end so
)
NUMBER = st.floats(-LARGEST, LARGEST)
VARIANCE = st.floats(1e-150, 1e150)


@st.composite
def some_observations(draw: st.DrawFn) -> Observations:
    count = draw(st.integers(0, 4))
    each = {"min_size": count, "max_size": count}
    T = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        rng = np.random.default_rng(draw(st.integers(0, 2**32)))
        Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        T[k, :3, :3] = Q * np.sign(np.linalg.det(Q))
        T[k, :3, 3] = draw(st.tuples(NUMBER, NUMBER, NUMBER))
        T[k, 3, :3] = draw(st.sampled_from([0.0, -0.0]))
    cov = np.full((count, 2, 2), np.nan)
    for k in range(count):
        if draw(st.booleans()):
            cov[k] = np.diag([draw(VARIANCE), draw(VARIANCE)])
            cov[k, 0, 1] = cov[k, 1, 0] = 0.5 * np.sqrt(cov[k, 0, 0]) * np.sqrt(cov[k, 1, 1])
            cov[k, 0, 1] = np.nextafter(cov[k, 0, 1], 0.0)  # symmetric but for the last bit
    camera = draw(st.lists(TEXT, **each))
    sizes = st.tuples(st.integers(1, 10**6), st.integers(1, 10**6))
    return Observations(
        uv=np.array(draw(st.lists(st.tuples(NUMBER, NUMBER), **each))).reshape(count, 2),
        cov_uv=cov,
        T_base_hand=T,
        camera=np.array(camera, dtype=np.str_),
        laser=np.array(draw(st.lists(TEXT, **each)), dtype=np.str_),
        plane=np.array(draw(st.lists(TEXT, **each)), dtype=np.str_),
        id=np.array(draw(st.lists(TEXT, **each)), dtype=np.str_),
        image_size={name: draw(sizes) for name in [*camera, draw(TEXT)]},
    )


@settings(
    max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
@given(batches=st.lists(some_observations(), max_size=3))
def test_observations_come_back_to_the_last_bit(
    batches: list[Observations], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("exact") / "journal.jsonl"
    with Journal.create(path, {}) as journal:
        for batch in batches:
            journal.append("spots", spots_payload(batch))
    again = [observations_from(record.payload) for record in JournalReader(path)]
    assert again == batches
    for got, given_ in zip(again, batches, strict=True):
        for name in ("uv", "cov_uv", "T_base_hand"):
            assert getattr(got, name).tobytes() == getattr(given_, name).tobytes()
        assert list(got.image_size.items()) == list(given_.image_size.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": None}, "these are no spots"),
        ({"uv": [[1.0, 2.0], [3.0, 4.0]]}, "these are no spots"),
        ({"id": 7}, "these are no spots"),
        ({"uv": [[10**400, 2.0]]}, "these are no spots"),
        ({"uv": [[1e300, 2.0]]}, "expected numbers up to 1e"),
        ({"image_size": {}}, "no size given for camera"),
        ({"T_base_hand": [[1.0] * 16]}, "expected a rigid transform"),
    ],
)
def test_payloads_that_are_no_spots(change: dict[str, Any], message: str) -> None:
    good = spots_payload(
        Observations.from_arrays([[1.0, 2.0]], [np.eye(4)], plane="1", image_size=(640, 480))
    )
    assert len(observations_from({**good, "time": "noon"})) == 1
    with pytest.raises(DataError, match=message):
        observations_from({**good, **change})
    for name in good:
        with pytest.raises(DataError, match=name):
            observations_from({key: good[key] for key in good if key != name})
