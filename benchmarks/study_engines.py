"""One study on every engine: the same digest, whatever dies, and nothing run twice.

``python benchmarks/study_engines.py --trials 20`` runs Fig. 6 on one process, on two, on two with a
worker killed in the middle, on a local Dask cluster of two workers (one of them killed), and by the
command line with the run killed twice and resumed; it prints the digest, the time and how many runs
were executed more than once.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from lasercal_gtsam import study
from lasercal_gtsam.engine import Cluster, OneProcess, Processes, Progress, Workers
from lasercal_gtsam.io.journal import JournalReader

LEVELS = (0.2, 0.6, 1.0)


def descendants() -> list[int]:
    """Process numbers of everything below this process, whichever thread started it."""
    found, todo = [], [os.getpid()]
    while todo:
        threads = Path(f"/proc/{todo.pop()}/task").glob("*/children")
        below = [int(x) for children in threads for x in children.read_text().split()]
        found += below
        todo += below
    return found


def busiest_worker() -> int:
    """The descendant that has used most CPU, of those that work for a pool or a cluster."""

    def used(pid: int) -> int:
        try:
            if b"spawn_main" not in Path(f"/proc/{pid}/cmdline").read_bytes():
                return -1
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return -1
        return int(fields[11]) + int(fields[12])

    return max(descendants(), key=used)


def killer(at: int) -> tuple[Callable[[Progress], None], list[int]]:
    """A progress function that kills a worker once, after so many runs."""
    killed: list[int] = []

    def show(progress: Progress) -> None:
        if progress.done >= at and not killed:
            killed.append(busiest_worker())
            os.kill(killed[0], signal.SIGKILL)

    return show, killed


def run(name: str, trials: int, workers: Workers, kill_at: int | None = None) -> str:
    begin = time.perf_counter()
    show, killed = killer(kill_at) if kill_at is not None else ((lambda _: None), [])
    found = study.fig6(trials=trials, levels=LEVELS, workers=workers, progress=show)
    seconds = time.perf_counter() - begin
    print(
        f"{name:42s} {found.results.digest[:16]}  {seconds:6.1f} s"
        + (f"  killed process {killed[0]}, pools broken {found.results.deaths}" if killed else ""),
        flush=True,
    )
    return found.results.digest


def killed_and_resumed(trials: int) -> str:
    """The command line, killed twice on the way."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", "from lasercal_gtsam.cli.main import main; main()"]
        command += ["study", "fig6", "--trials", str(trials), "-j", "2", "-o", folder, "--json"]
        command += ["--levels", ",".join(map(str, LEVELS))]
        journal = Path(folder) / "fig6.journal"
        runs = trials * len(LEVELS)
        for share in (0.3, 0.6):
            child = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
            while child.poll() is None and finished(journal)[0] < share * runs:
                time.sleep(0.05)
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        done, twice = finished(journal)
        last = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        done_after, twice = finished(journal)
        digest = str(json.loads(last.stdout)["digest"])
        print(
            f"{'command line, killed at 30 % and 60 %':42s} {digest[:16]}  "
            f"{done} of {runs} runs kept, {twice} of {done_after} written twice",
            flush=True,
        )
        return digest


def finished(journal: Path) -> tuple[int, int]:
    """Runs in a journal, and how many of them are there more than once."""
    if not journal.exists() or not journal.stat().st_size:
        return 0, 0
    runs: list[int] = []
    try:
        for record in JournalReader(journal):
            if record.kind == "chunk":
                first = record.payload["first"]
                runs += range(first, first + len(record.payload["results"]))
    except Exception:  # being written just now
        return 0, 0
    return len(set(runs)), len(runs) - len(set(runs))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    trials = parser.parse_args().trials
    middle = trials * len(LEVELS) // 2
    digests = {run("one process", trials, OneProcess())}
    digests.add(run("two processes", trials, Processes(2)))
    digests.add(run("two processes, a worker killed", trials, Processes(2), middle))
    try:
        from distributed import LocalCluster
    except ImportError:
        print("Dask is not installed: no cluster")
    else:
        settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with LocalCluster(**settings, host="127.0.0.1", silence_logs=50) as cluster:
            workers = Cluster(cluster.scheduler_address)
            digests.add(run("Dask cluster of two workers", trials, workers))
            digests.add(run("Dask cluster, a worker killed", trials, workers, middle))
    digests.add(killed_and_resumed(trials))
    print("all the same" if len(digests) == 1 else f"DIFFERENT: {len(digests)} digests")
    sys.exit(len(digests) != 1)


if __name__ == "__main__":
    main()
