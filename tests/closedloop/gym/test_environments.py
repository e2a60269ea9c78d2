"""Every command in many surroundings, as a process: a documented status, and one line or nothing."""

import os
import re
import shutil
import subprocess

import pytest
from surroundings import CASES, COMMANDS, ROOT


def test_there_are_many():
    """Each surrounding is another one."""
    assert len({(case.line, case.where, case.before, repr(case.env)) for case in CASES}) == len(CASES) >= 30


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=() if case.quick else pytest.mark.slow) for case in CASES]
)
def test_status_and_one_line(case, tmp_path, tmp_path_factory):
    """The status is the documented one, at most one line is said, and what should be there is there."""
    if "setpriv" in case.line and (os.geteuid() != 0 or shutil.which("setpriv") is None):
        pytest.skip("needs to be root, with setpriv to be less")
    folder = tmp_path / "here"
    folder.mkdir()
    settings = {
        "PATH": os.environ["PATH"],
        "PYTHONPATH": str(ROOT),
        "HOME": str(tmp_path),
        "MPLCONFIGDIR": str(tmp_path_factory.getbasetemp() / "matplotlib"),  # it takes seconds to fill
        "LANG": "C.UTF-8",
        "NUMBA_DISABLE_JIT": "1",
    } | case.env
    environment = {key: value for key, value in settings.items() if value is not None}
    line = case.line.format(**COMMANDS)
    script = f"status=$PWD/../status\n{case.before}\n{{ {line}; echo $? >$status; }} {case.where}\n"
    done = subprocess.run(
        ["/bin/sh", "-c", script], cwd=folder, env=environment, capture_output=True, timeout=300, check=False
    )
    folder.chmod(0o700)
    err = re.sub(r"closedloop sweep: \d+ of \d+ runs, .*\n", "", done.stderr.decode(errors="backslashreplace"))
    assert int((tmp_path / "status").read_text() or -1) == case.status, err
    if case.says:
        assert re.fullmatch(case.says, err.rstrip("\n")), err
    else:
        assert err == ""
    case.check(folder, done.stdout.decode(errors="backslashreplace"))
