"""What each test costs in processor time, its fixtures and the processes that it starts with it.

    CPULOG=cost.txt python -m pytest -p tests.cost     # a line for each test: seconds, and which
    python -m tests.cost cost.txt                      # together, by folder, and the dearest files and tests

Wall time says little on a machine that does something else, and nothing about the two cores of CI.
"""

import os
import sys
from collections import Counter
from pathlib import Path

import pytest

SHOWN = 15  # of the dearest


def used():
    """Return the processor time of this process and of those that it has waited for, s."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Write a line after each test."""
    before = used()
    result = yield
    with open(os.environ["CPULOG"], "a", encoding="utf-8") as log:
        log.write(f"{used() - before:.3f} {item.nodeid}\n")
    return result


def table(lines):
    """Return the report of a log's lines, as text."""
    tests = [(float(seconds), test) for seconds, _, test in (line.rstrip("\n").partition(" ") for line in lines)]
    folders, files = Counter(), Counter()
    for seconds, test in tests:
        file = test.partition("::")[0]
        files[file] += seconds
        folders[str(Path(file).parent)] += seconds
    told = [f"{sum(folders.values()):8.1f} s  {len(tests)} tests"]
    for counted in (folders.most_common(), files.most_common(SHOWN)):
        told += ["", *(f"{seconds:8.1f} s  {what}" for what, seconds in counted)]
    return "\n".join([*told, "", *(f"{seconds:8.1f} s  {test}" for seconds, test in sorted(tests)[: -SHOWN - 1 : -1])])


if __name__ == "__main__":
    print(table(Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()))
