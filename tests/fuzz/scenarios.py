"""Scenarios with wrong and extreme values, all of them: `python tests/fuzz/scenarios.py`.

Prints what is not clean, and the counts. It takes some twenty minutes of one processor; `--only TEXT` does the cases
whose name contains TEXT, `--seed N` draws other pairs, `--count N` the first N of the shuffled cases.
"""

from __future__ import annotations

import argparse
from collections import Counter

from bounded import judged
from combinations import combinations
from judged import FAULTY, judge
from scenario_cases import SEED, Case, all_cases, tables
from shipped_cases import shipped_cases, shipped_tables

# One of each form of the loop, so that nothing is compiled while a case's time is counted.
FIRST = [
    *(Case(robot, tables(robot, {}), {}) for robot in ("wam4", "pointmass3", "planar2")),
    Case("adaptive", tables("planar2", {"law": "paper"}), {}),
    Case("impact", tables("pointmass3", {}) | {"surface": {"contact": "unilateral", "gap": 1e-5},
                                               "start": {"v": [0.0, 0.01, -0.1]}}, {}),
    Case("adaptive impact", tables("planar2", {}) | {"surface": {"contact": "unilateral", "gap": 1e-5},
                                                     "friction": {"kind": "lugre", "kinetic": 0.2, "static": 0.3,
                                                                  "stribeck_speed": 0.01, "stiffness": 1e4,
                                                                  "damping": 10.0}}, {}),
    *(Case(name, shipped_tables(name), {}) for name in ("four_bar", "gripper_block", "panda_polish")),
]  # fmt: skip


def main() -> None:
    """Judge the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--extremes", type=int, default=6000, help="how many combinations of legal extremes")
    parser.add_argument("--count", type=int)
    parser.add_argument("--shipped", type=int, help="only so many shipped scenarios and mechanisms")
    parser.add_argument("--combined", type=int, help="only so many combinations of keys that are valid by themselves")
    parser.add_argument("--only", default="")
    parser.add_argument("--slow", type=float, default=2.0, help="name cases that take longer, s of processor time")
    options = parser.parse_args()
    if options.combined is not None:
        every = list(combinations(options.combined, options.seed))
    elif options.shipped is None:
        every = all_cases(options.extremes, options.seed)
    else:
        every = list(shipped_cases(options.shipped, options.seed))
    cases = [case for case in every if options.only in case.name][: options.count]
    counts: Counter[str] = Counter()
    for case, outcome, words, spent in judged(cases, judge, FAULTY, FIRST):
        counts[outcome] += 1
        if outcome == FAULTY:
            print(f"{case.name[:300]}\n    {words}", flush=True)
        elif spent > options.slow:
            print(f"{case.name[:300]}\n    {spent:.1f} s: {words}", flush=True)
        if counts.total() % 500 == 0:
            print(dict(counts), flush=True)
    print(f"{len(cases)} scenarios: {dict(counts)}")


if __name__ == "__main__":
    main()
