"""Which part is blamed when a fault is planted: the confusion table of `lasercal_gtsam.opinions`.

Run ``PYTHONPATH=tests/app python tests/montecarlo/opinion_study.py [SEEDS]``; two minutes at 30.
"""

from __future__ import annotations

import sys
from collections import Counter

from opinion_cases import FAULTS, PIXELS, calibrated

from lasercal_gtsam.opinions.bench import lay_out
from lasercal_gtsam.opinions.suspects import accuse, culprit, rivals

PRESETS = ("paper", "table2-3", "tool-z-2")


def confusion(preset: str, fault: str | None, seeds: range) -> Counter[str]:
    """How often each part is named, and how often the right one is first or among its rivals."""
    table = Counter[str]()
    for seed in seeds:
        calibration = calibrated(preset, seed, fault)
        findings = accuse(lay_out(calibration))
        named = culprit(findings)
        table["nothing" if named is None else f"{named.part} {named.fault}"] += 1
        table["noise"] += round(1000 * calibration.fit.sigma0 / PIXELS.pixel_px)
        if named is not None and fault is not None:
            kinds = [(f.part, f.fault) for f in (named, *rivals(findings))]
            table["first"] += kinds[0] == FAULTS[fault]
            table["among"] += FAULTS[fault] in kinds
    return table


def main(count: int) -> None:
    """Print the table: right first, right among rivals, nothing, wrong, noise over the truth."""
    print(f"{'preset':10} {'fault':13} right among none wrong  noise  named")
    for preset in PRESETS:
        for fault in (None, *FAULTS):
            table = confusion(preset, fault, range(count))
            noise = table.pop("noise") / count / 1000
            first, among = table.pop("first", 0), table.pop("among", 0)
            none = table["nothing"]
            named = {k: v for k, v in table.items() if v}
            print(
                f"{preset:10} {fault or '-':13} {first:5} {among:5} {none:4} "
                f"{count - none - first:5} {noise:6.2f}  {named}",
                flush=True,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 30)
