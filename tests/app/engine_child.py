"""A study in a process of its own, to be killed: ``engine_child.py FOLDER JOURNAL``."""

import sys

from engine_cases import draw

from lasercal_gtsam.engine import Work, run_all

if __name__ == "__main__":
    work = Work("draws", draw, {"seed": 1, "folder": sys.argv[1], "seconds": 0.01}, 200)
    run_all(work, journal=sys.argv[2], chunk_seconds=0.05)
