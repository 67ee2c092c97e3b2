"""Does the running calibration keep its promises? Everything measured anew; exit 1 if not.

``python benchmarks/incremental all --quick`` is a look in a minute or two; README.md beside this
folder says what each part measures.
"""

from __future__ import annotations

import os

# read when numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import re
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import agreement
import moved
import quiet
from findings import Finding, print_findings

ROOT = Path(__file__).resolve().parents[2]
KILL_TESTS = ("tests/app/test_io_journal.py", "tests/app/test_cli_watch.py")
OUTLIERS = 0.1


def stream(args: argparse.Namespace) -> list[Finding]:
    return agreement.run(args, outliers=0.0)


def outliers(args: argparse.Namespace) -> list[Finding]:
    return agreement.run(args, outliers=OUTLIERS)


def kill(args: argparse.Namespace) -> list[Finding]:
    """The tests of journal and watch, the slow ones too unless the look is to be quick."""
    findings = []
    for name in KILL_TESTS:
        if not (ROOT / name).exists():
            findings.append(Finding(name, "all tests pass", "there is none", False))
            continue
        command = [sys.executable, "-m", "pytest", "-q", "-m", "slow or not slow", name]
        if args.quick:
            command[-2] = "not slow"
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        last = run.stdout.strip().splitlines()[-1] if run.stdout.strip() else run.stderr[-200:]
        words = re.sub(r"=+ ?| ?in [\d.]+s.*", "", last)
        findings.append(Finding(name, "all tests pass", words.strip(), run.returncode == 0))
    return findings


PARTS: dict[str, Callable[[argparse.Namespace], list[Finding]]] = {
    "stream": stream,
    "outliers": outliers,
    "bumps": moved.run,
    "quiet": quiet.run,
    "kill": kill,
}
# size of the long stream, and seeds or spots of the others: as promised, and for a quick look
FULL = {"spots": 120_000, "seeds": 100, "good": 1_000_000, "stained": 100_000}
QUICK = {"spots": 4_000, "seeds": 3, "good": 10_000, "stained": 3_000}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python benchmarks/incremental", description=__doc__)
    parser.add_argument("part", choices=[*PARTS, "all"])
    parser.add_argument("--quick", action="store_true", help="small sizes")
    parser.add_argument("--seed", type=int, default=0, help="stream, outliers: which cell")
    parser.add_argument("--spots", type=int, help="stream, outliers: length of the stream")
    parser.add_argument("--distortion", choices=["none", "all"], default="none")
    parser.add_argument("--seeds", type=int, help="bumps: of each kind and size")
    parser.add_argument("--kinds", nargs="+", choices=moved.KINDS, default=list(moved.KINDS))
    parser.add_argument("--pixel", type=float, default=0.3, help="bumps: noise, px")
    parser.add_argument("--good", type=int, help="quiet: good spots, over ten cells")
    parser.add_argument("--stained", type=int, help="quiet: spots with 1 %% and 10 %% outliers")
    parser.add_argument("--processes", type=int, default=1, help="quiet: cells at the same time")
    args = parser.parse_args()
    for name, size in (QUICK if args.quick else FULL).items():
        if getattr(args, name) is None:
            setattr(args, name, size)
    met = True
    for part in list(PARTS) if args.part == "all" else [args.part]:
        begin, cpu = time.perf_counter(), time.process_time()
        print(f"## {part}", flush=True)
        try:
            findings = PARTS[part](args)
        except Exception as error:  # the other parts are still to be measured
            traceback.print_exc()
            findings = [Finding(part, "an answer", f"{type(error).__name__}: {error}", False)]
        met &= print_findings(findings)
        wall, cpu = time.perf_counter() - begin, time.process_time() - cpu
        print(f"{wall:.0f} s, of them {cpu:.0f} s of CPU time\n", flush=True)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
