"""A process of its own that writes to a journal, to be killed or to be in the way.

``append PATH``: open, then append records without end; after each sync print the number of the
last record that was acknowledged. ``hold PATH``: open, print the number of records, wait.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from lasercal_gtsam.io.journal import Journal


def payload_of(seq: int) -> dict[str, object]:
    """What record ``seq`` holds: short and long ones (several pages), so that both are cut."""
    length = 30_000 if seq % 7 == 0 else seq * 37 % 300
    return {"number": seq, "fill": chr(97 + seq % 26) * length}


def main(task: str, path: Path) -> None:
    with Journal.open(path) as journal:
        print(journal.count, flush=True)
        if task == "hold":
            time.sleep(600)
        while True:
            first = journal.count + 1
            if first % 5 == 0:
                batch = [("test", payload_of(seq)) for seq in range(first, first + 4)]
                last = journal.append_many(batch)[-1]
            else:
                last = journal.append("test", payload_of(first))
            print(last, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
