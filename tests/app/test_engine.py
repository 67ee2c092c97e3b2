"""Runs on any executor: the same results in the same order, nothing lost, nothing run twice."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from engine_cases import die_always, die_once, draw, fail, not_plain, refuse, times_run

from lasercal_gtsam.engine import OneProcess, Processes, Work, apart, run_all, workers_for
from lasercal_gtsam.engine.work import RunError
from lasercal_gtsam.engine.workers import _refuse_other_versions
from lasercal_gtsam.errors import DataError, SolveError
from lasercal_gtsam.io.calibration_file import program_version
from lasercal_gtsam.io.journal import JournalReader
from lasercal_gtsam.simulate.streams import NOISE, stream

SPEC = {"seed": 1}


def test_results_are_those_of_the_function_in_the_order_of_the_runs():
    results = run_all(Work("draws", draw, SPEC, 10))
    for k, value in enumerate(results.values):
        expected = stream(1, NOISE, k).standard_normal(3)
        assert value == {"run": k, "numbers": expected.tolist()}
    assert (results.resumed, results.executed, results.deaths) == (0, 10, 0)


def test_no_runs_give_no_results():
    assert run_all(Work("draws", draw, SPEC, 0)).values == ()


@pytest.mark.parametrize("chunk_seconds", [1e-9, 1e-3, 10.0])
def test_chunks_do_not_matter(tmp_path, chunk_seconds):
    work = Work("draws", draw, SPEC, 57)
    plain = run_all(work)
    path = tmp_path / "study.journal"
    assert run_all(work, journal=path, chunk_seconds=chunk_seconds).digest == plain.digest
    sizes = [len(r.payload["results"]) for r in JournalReader(path)]
    assert sum(sizes) == 57
    if chunk_seconds == 1e-9:
        assert max(sizes) == 1
    if chunk_seconds == 10.0:
        assert max(sizes) > 4


def test_two_processes_give_the_same_digest(tmp_path):
    spec = {**SPEC, "folder": str(tmp_path)}
    work = Work("draws", draw, spec, 40)
    results = run_all(work, Processes(2))
    assert times_run(tmp_path, 40) == [1] * 40
    assert results.digest == run_all(work).digest


def test_other_seeds_give_another_digest():
    digests = {run_all(Work("draws", draw, {"seed": s}, 5)).digest for s in (1, 2)}
    assert len(digests) == 2


def test_a_killed_worker_costs_what_it_held(tmp_path):
    runs = 30
    spec = {**SPEC, "folder": str(tmp_path)}
    results = run_all(Work("deaths", die_once, spec, runs), Processes(2), journal=tmp_path / "j")
    assert results.deaths == 1
    assert results.digest == run_all(Work("draws", draw, SPEC, runs)).digest
    twice = sum(n > 1 for n in times_run(tmp_path, runs))
    assert twice <= 3 * 8  # at most the chunks in flight: two that ran and one spare


def test_a_run_that_kills_every_worker_is_named(tmp_path):
    work = Work("deaths", die_always, SPEC, 6)
    with pytest.raises(SolveError, match=r"workers died 3 times while they had run .*3"):
        run_all(work, Processes(1), journal=tmp_path / "j")


def test_a_resumed_study_runs_only_the_rest(tmp_path):
    path = tmp_path / "study.journal"
    spec = {**SPEC, "folder": str(tmp_path)}
    run_all(Work("draws", draw, spec, 12), journal=path)
    seen: list[int] = []
    more = run_all(
        Work("draws", draw, spec, 20), journal=path, progress=lambda p: seen.append(p.done)
    )
    assert (more.resumed, more.executed) == (12, 8)
    assert times_run(tmp_path, 20) == [1] * 20
    assert more.digest == run_all(Work("draws", draw, SPEC, 20)).digest
    assert seen == sorted(seen)
    assert seen[-1] == 20
    fewer = run_all(Work("draws", draw, spec, 5), journal=path)
    assert (fewer.resumed, fewer.executed) == (5, 0)


def test_a_study_killed_at_any_moment_goes_on_with_the_same_digest(tmp_path):
    path, folder = tmp_path / "study.journal", tmp_path / "notes"
    folder.mkdir()
    kills = 0
    while kills < 6:
        child = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("engine_child.py")), folder, path]
        )
        before = len(list(folder.iterdir()))
        while child.poll() is None and len(list(folder.iterdir())) < before + 20 + 3 * kills:
            time.sleep(0.005)
        if child.poll() is not None:
            break
        child.send_signal(signal.SIGKILL)
        child.wait()
        kills += 1
    assert kills >= 3
    spec = {"seed": 1, "folder": str(folder), "seconds": 0.01}
    results = run_all(Work("draws", draw, spec, 200), journal=path)
    assert results.resumed > 0
    assert results.digest == run_all(Work("draws", draw, SPEC, 200)).digest
    counts = times_run(folder, 200)
    # each kill may cost the chunk in flight, about 0.05 s of runs of 0.01 s
    assert min(counts) == 1
    assert sum(counts) - 200 <= kills * 20


def test_the_journal_of_another_study_is_refused(tmp_path):
    path = tmp_path / "study.journal"
    run_all(Work("draws", draw, {"seed": 1, "level": 0.5}, 3), journal=path)
    with pytest.raises(DataError, match=r"another study \(level: 0\.5 there, 0\.6 here\)"):
        run_all(Work("draws", draw, {"seed": 1, "level": 0.6}, 3), journal=path)
    with pytest.raises(DataError, match="work: 'draws' there, 'others' here"):
        run_all(Work("others", draw, {"seed": 1, "level": 0.5}, 3), journal=path)


@pytest.mark.parametrize("workers", [OneProcess(), Processes(1)])
def test_a_bug_in_a_run_is_named_and_the_finished_runs_are_kept(tmp_path, workers):
    path = tmp_path / "study.journal"
    with pytest.raises(RunError, match="run 5 broke: ZeroDivisionError"):
        run_all(Work("bug", fail, {}, 9), workers, journal=path, chunk_seconds=1e-9)
    assert sum(len(r.payload["results"]) for r in JournalReader(path)) >= 4


@pytest.mark.parametrize("workers", [OneProcess(), Processes(1)])
def test_what_a_user_can_mend_comes_through_as_it_is(workers):
    with pytest.raises(DataError) as caught:
        run_all(Work("refused", refuse, {}, 4), workers)
    assert str(caught.value) == "the cell is too small\nthe hand too large"


def test_workers_of_another_version_are_refused():
    here = program_version()
    _refuse_other_versions({"tcp://a:1": here})
    with pytest.raises(DataError, match=f"need lasercal-gtsam {here} as here, but tcp://b:1 has 0"):
        _refuse_other_versions({"tcp://a:1": here, "tcp://b:1": "0.0.1"})


def test_what_json_cannot_say_is_refused():
    with pytest.raises(RunError, match="run 0 broke: ValueError"):
        run_all(Work("nan", not_plain, {}, 1))
    with pytest.raises(DataError, match="settings cannot be said in JSON"):
        Work("draws", draw, {"level": float("nan")}, 1)
    with pytest.raises(DataError, match="runs: expected an integer >= 0, got -1"):
        Work("draws", draw, SPEC, -1)


def test_apart_is_another_process(tmp_path):
    apart(draw, {**SPEC, "folder": str(tmp_path)}, 4)
    assert times_run(tmp_path, 5) == [0, 0, 0, 0, 1]
    with pytest.raises(SolveError, match="a run in a process of its own failed: ZeroDivisionError"):
        apart(fail, {}, 5)


def test_progress_tells_how_long_it_takes():
    seen = []
    work = Work("draws", draw, {**SPEC, "seconds": 0.002}, 30)
    run_all(work, progress=seen.append, chunk_seconds=0.01)
    assert seen[-1].seconds_left == 0.0
    assert all(p.seconds_left >= 0.0 and p.runs == 30 for p in seen)
    assert seen[0].seconds_left > 0.002 * 10


def test_workers_for_a_command_line():
    assert workers_for(1) == OneProcess()
    assert workers_for(3) == Processes(3)
    assert workers_for().count >= 1
    with pytest.raises(DataError, match="jobs: expected an integer >= 1, got 0"):
        workers_for(0)
    with pytest.raises(DataError, match="not both"):
        workers_for(2, "tcp://host:8786")


def test_a_cluster_that_does_not_answer_is_refused():
    pytest.importorskip("distributed")
    from lasercal_gtsam.engine import Cluster

    with pytest.raises(DataError, match=r"no cluster answers at 'tcp://127\.0\.0\.1:9'"):
        run_all(Work("draws", draw, SPEC, 3), Cluster("tcp://127.0.0.1:9", patience_s=0.5))


@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_gives_the_same_digest(tmp_path):
    distributed = pytest.importorskip("distributed")
    from lasercal_gtsam.engine import Cluster

    work = Work("deaths", die_once, {**SPEC, "folder": str(tmp_path)}, 30)
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**settings, host="127.0.0.1") as cluster:
        results = run_all(work, Cluster(cluster.scheduler_address), journal=tmp_path / "j")
    assert (tmp_path / "died").exists()
    assert results.digest == run_all(Work("draws", draw, SPEC, 30)).digest
