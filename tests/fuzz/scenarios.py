"""Scenarios with wrong and extreme values, all of them: `python tests/fuzz/scenarios.py`.

Prints what is not clean, and the counts. It takes some twenty minutes of one processor; `--only TEXT` does the cases
whose name contains TEXT, `--seed N` draws other pairs, `--count N` the first N of the shuffled cases.
"""

import argparse
import json
import re
from collections import Counter
from pathlib import Path

from bounded import MOST_SECONDS, judged
from combinations import combinations
from judged import FAULTY, HELD, STOPPED, judge, judge_halved
from scenario_cases import SEED, Case, all_cases, tables
from shipped_cases import shipped_cases, shipped_tables

SLOWEST = 60.0  # s of processor time of a case with its run at half the step, and what they compile
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
    *(Case(name, shipped_tables(name), {}) for name in ("four_bar", "gripper_gear", "panda_polish")),
]  # fmt: skip


def main() -> None:
    """Judge the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--extremes", type=int, default=6000, help="how many combinations of legal extremes")
    parser.add_argument("--count", type=int)
    parser.add_argument("--shipped", type=int, help="only so many shipped scenarios and mechanisms")
    parser.add_argument("--combined", type=int, help="only so many combinations of keys that are valid by themselves")
    parser.add_argument(
        "--halved", type=float, help="with --combined: so long, s, and good runs again at half the step"
    )
    parser.add_argument(
        "--contacts", action="store_true", help="with --combined: contacts of links, loops and free bodies in each"
    )
    parser.add_argument("--keep", help="write the cases that are not clean to this file, a line of JSON each")
    parser.add_argument("--again", help="judge the cases of such a file")
    parser.add_argument("--only", default="")
    parser.add_argument("--slow", type=float, default=2.0, help="name cases that take longer, s of processor time")
    options = parser.parse_args()
    if options.again:
        lines = Path(options.again).read_text(encoding="utf-8").splitlines()
        every = [Case(name, content, {}) for name, content in map(json.loads, lines)]
    elif options.combined is not None:
        every = list(combinations(options.combined, options.seed, options.halved, options.contacts))
    elif options.shipped is None:
        every = all_cases(options.extremes, options.seed)
    else:
        every = list(shipped_cases(options.shipped, options.seed))
    cases = [case for case in every if options.only in case.name][: options.count]
    counts: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    shares: list[float] = []
    how = (judge_halved, FAULTY, FIRST) if options.halved else (judge, FAULTY, FIRST)
    for case, outcome, words, spent in judged(cases, *how, most=SLOWEST if options.halved else MOST_SECONDS):
        counts[outcome] += 1
        why = reason(words)
        reasons[f"{outcome}: {why}"] += options.halved is not None and outcome not in (FAULTY, HELD)
        shares += [float(words)] if outcome == HELD else []
        if outcome == FAULTY:
            print(f"{case.name[:300]}\n    {words}", flush=True)
            if options.keep:
                with open(options.keep, "a", encoding="utf-8") as file:
                    file.write(json.dumps([case.name, case.content]) + "\n")
        elif outcome == STOPPED and options.halved:  # whether the cause it names is true is for a reader
            print(f"{case.name[:300]}\n    {words}", flush=True)
        elif spent > options.slow:
            print(f"{case.name[:300]}\n    {spent:.1f} s: {words}", flush=True)
        if counts.total() % 500 == 0:
            print(dict(counts), flush=True)
    for words, count in (+reasons).most_common():
        print(f"{count:6} {words}")
    print(f"{len(cases)} scenarios: {dict(counts)}")
    if shares:
        print(f"differences of f at half the step, N: {sorted(shares, reverse=True)[:10]}")


def reason(words: str) -> str:
    """Return what a line is about, without its values: what is before its first colon, and the keys that it names."""
    return re.sub(r"[-+]?\d[\w.+-]*", "#", words.removeprefix("closedloop: ").partition(": ")[0])[:80]


if __name__ == "__main__":
    main()
