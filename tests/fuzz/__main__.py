"""Feed spoilt files to the command line, and count what it says.

``python tests/fuzz --inputs 1000 --results FILE`` runs a thousand and prints a table; with
``--inputs 0`` it only prints what FILE holds. Every input is known by seed and number (``--only
NUMBER`` shows one). No traceback, no warning, no run over 10 s, nothing left half written, exit
status 0, 1 or 2: everything else is a finding, and makes the status of this program 1.
"""

from __future__ import annotations

import os

# read when numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1]), str(HERE.parents[1] / "factors")]

from fuzz_inputs import Input, make_corpus, make_input  # noqa: E402
from fuzz_oracle import LIMIT_S, PATIENCE, Outcome, left_behind, run, snapshot  # noqa: E402

# A worker ends after so many inputs, which bounds what a leak or a native crash can cost.
WORKER_INPUTS = 10_000
MEMORY_BYTES = 6 << 30


def main() -> int:
    parser = argparse.ArgumentParser(prog="python tests/fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=int, default=0, help="number of the first input")
    parser.add_argument("--results", type=Path, help="file for findings and counts, JSON lines")
    parser.add_argument("--only", type=int, nargs="+", help="run and show these inputs alone")
    parser.add_argument("--keep", type=Path, help="with --only: leave the files in this folder")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only is not None:
        return show(args)
    return work(args) if args.worker else oversee(args)


# --- one process does the work --------------------------------------------------------------------


class Bench:
    """A folder that holds the corpus again before every input."""

    def __init__(self, corpus: dict[str, bytes], folder: Path) -> None:
        self.corpus, self.folder = corpus, folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self._write(corpus)
        os.chdir(folder)

    def _write(self, files: dict[str, bytes]) -> None:
        for name, content in files.items():
            path = self.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def run(self, item: Input) -> Outcome:
        self._write(dict(item.files))
        before = {**self.corpus, **item.files}
        outcome = run(item.args, item.stdin)
        if item.results != ("*",):
            outcome.faults += left_behind(self.folder, before, outcome.status, item.results)
        self._restore()
        return outcome

    def _restore(self) -> None:
        os.chdir(self.folder)
        now = snapshot(self.folder)
        for name in now.keys() - self.corpus.keys():
            (self.folder / name).unlink()
        for path in self.folder.iterdir():
            if path.name not in {name.split("/")[0] for name in self.corpus}:
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        self._write({n: c for n, c in self.corpus.items() if now.get(n) != c})


def work(args: argparse.Namespace) -> int:
    """Inputs one after the other; a line of results for each hundred, and for each finding."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    home = args.worker
    corpus = _load(home / "corpus")
    bench = Bench(corpus, home / "bench")
    with args.results.open("a") as results, (home / "at").open("w+b", buffering=0) as at:
        counts = _Counts()
        for number in range(args.start, args.start + args.inputs):
            os.pwrite(at.fileno(), b"%12d" % number, 0)
            item = make_input(args.seed, number, corpus)
            outcome = bench.run(item)
            counts.add(number, item, outcome)
            if outcome.faults:
                _say(results, finding(number, item, outcome))
            if (number + 1) % 100 == 0 or number + 1 == args.start + args.inputs:
                _say(results, counts.document())
                counts = _Counts()
    return 0


class _Counts:
    def __init__(self) -> None:
        self.kinds: Counter[str] = Counter()
        self.seconds: Counter[str] = Counter()
        self.slowest: tuple[float, float, int, str] = (0.0, 0.0, -1, "")

    def add(self, number: int, item: Input, outcome: Outcome) -> None:
        self.kinds[f"{item.kind}|{outcome.status}"] += 1
        self.seconds[item.kind] += outcome.cpu_s
        self.slowest = max(self.slowest, (outcome.cpu_s, outcome.seconds, number, item.kind))

    def document(self) -> dict[str, Any]:
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        return {
            "counts": self.kinds,
            "seconds": self.seconds,
            "slowest": self.slowest,
            "MB": memory,
        }


def finding(number: int, item: Input, outcome: Outcome) -> dict[str, Any]:
    return {
        "finding": outcome.faults,
        "number": number,
        "kind": item.kind,
        "args": list(item.args),
        "status": outcome.status,
        "took": round(outcome.seconds, 2),
        "err": outcome.err[-500:],
        "trace": outcome.trace[-1500:],
    }


def _say(results: Any, document: dict[str, Any]) -> None:
    results.write(json.dumps(document) + "\n")
    results.flush()


def _load(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# --- another one watches it -----------------------------------------------------------------------


def oversee(args: argparse.Namespace) -> int:
    """Start workers until all inputs are done; one that dies is a finding of its own."""
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(prefix="lasercal-fuzz-", dir=memory) as folder:
        home = Path(folder)
        results = args.results or home / "results.jsonl"
        corpus = make_corpus(home / "made") if args.inputs else {}
        for name, content in corpus.items():
            path = home / "corpus" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        begun, number, end = time.monotonic(), args.start, args.start + args.inputs
        while number < end:
            number = _chunk(args, home, results, number, min(WORKER_INPUTS, end - number))
        print(summary(results, time.monotonic() - begun))
        return 1 if any("finding" in line for line in _read(results)) else 0


def _chunk(args: argparse.Namespace, home: Path, results: Path, start: int, count: int) -> int:
    command = [sys.executable, str(HERE), "--worker", str(home), "--results", str(results)]
    command += ["--seed", str(args.seed), "--start", str(start), "--inputs", str(count)]
    (home / "at").write_bytes(b"%12d" % start)
    with (home / "output").open("wb") as output:
        worker = subprocess.Popen(command, stdout=output, stderr=output)
        last, since = -1, time.monotonic()
        while worker.poll() is None:
            time.sleep(0.2)
            at = int((home / "at").read_bytes() or b"-1")
            if at != last:
                last, since = at, time.monotonic()
            elif (
                time.monotonic() - since > 1.5 * PATIENCE * LIMIT_S
            ):  # native code does not hear the alarm
                worker.kill()
    if worker.returncode == 0:
        return start + count
    at = int((home / "at").read_bytes())
    with results.open("a") as file:
        text = (home / "output").read_text(errors="replace")[-1500:]
        item = make_input(args.seed, at, _load(home / "corpus"))
        found = {
            "finding": [f"process ended with {worker.returncode}"],
            "number": at,
            "trace": text,
        }
        _say(file, {**found, "kind": item.kind, "args": list(item.args)})
        _say(file, {"counts": {f"{item.kind}|died": 1}})
    return at + 1


def show(args: argparse.Namespace) -> int:
    """Single inputs with everything they say."""
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        corpus = make_corpus(Path(folder) / "made")
        for number in args.only:
            item = make_input(args.seed, number, corpus)
            if args.keep:
                shutil.rmtree(args.keep, ignore_errors=True)
                for name, content in {**corpus, **item.files}.items():
                    path = args.keep / name
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
                (args.keep / "stdin").write_bytes(item.stdin)
            print(f"--- {number}: {item.kind}: lasercal {' '.join(map(repr, item.args))}")
            for name, content in {**item.files, "stdin": item.stdin}.items():
                was = set(corpus.get(name, b"").split(b"\n"))
                for line in [x for x in content.split(b"\n") if x not in was][:6]:
                    print(f"    {name}: {line[:300]!r}")
            outcome = Bench(corpus, Path(folder) / "bench").run(item)
            print(
                f"    status {outcome.status}, {outcome.seconds:.2f} s; findings: {outcome.faults}"
            )
            print(
                "\n".join(
                    f"    {line}" for line in (outcome.err[-1500:] + outcome.trace).splitlines()
                )
            )
            bad += bool(outcome.faults)
    return int(bad > 0)


# --- the end --------------------------------------------------------------------------------------


def _read(results: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in results.read_text().splitlines()]


def summary(results: Path, seconds: float) -> str:
    """Counts by kind and status, the slowest input, and the findings by what they are."""
    kinds: Counter[str] = Counter()
    time_of: Counter[str] = Counter()
    slowest: list[Any] = [0.0]
    found: dict[str, list[int]] = {}
    megabytes = 0
    for line in _read(results):
        kinds.update(line.get("counts", {}))
        time_of.update(line.get("seconds", {}))
        slowest = max(slowest, line.get("slowest", [0.0]))
        megabytes = max(megabytes, line.get("MB", 0))
        for text in line.get("finding", []):
            found.setdefault(text, []).append(line["number"])
    names = sorted({name.rpartition("|")[0] for name in kinds})
    statuses = sorted({name.rpartition("|")[2] for name in kinds})
    rows = [["input", *(f"status {s}" for s in statuses), "all", "ms each"]]
    for name in names:
        count = [kinds[f"{name}|{s}"] for s in statuses]
        mean = 1000 * time_of[name] / max(1, sum(count))
        rows.append([name, *map(str, count), str(sum(count)), f"{mean:.0f}"])
    total = [sum(kinds[f"{n}|{s}"] for n in names) for s in statuses]
    rows.append(["all", *map(str, total), str(sum(total)), ""])
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "| --- " * len(rows[0]) + "|")
    lines.append(f"\n{seconds:.0f} s; slowest: {slowest}; most memory: {megabytes} MB")
    lines.append(f"{sum(map(len, found.values()))} findings")
    for text, numbers in sorted(found.items(), key=lambda item: -len(item[1])):
        lines.append(f"  {len(numbers)}x {text}: {numbers[:8]}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
