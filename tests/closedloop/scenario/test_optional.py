"""Packages that a run does not need: what needs an absent one is refused in one line that says what to install."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import closedloop as cl
import robot_models
from closedloop.base import errors
from closedloop.command.border import BAD_INPUT, run_command
from closedloop.figures.export.files import write_csv
from closedloop.studies.identify.read import table_of
from robot_models import example_robots

SHORT = {"time.duration": 0.01}
# Without these the rest of the package is to work.
BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("pyarrow", "pandas", "xarray", "example_robot_data"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Blocked())
"""


@pytest.fixture
def plain(monkeypatch):
    """Let the packages of the extra `tables` seem not to be installed."""
    monkeypatch.setattr(errors, "find_spec", lambda name: None)


@pytest.mark.parametrize(
    ("use", "said"),
    [
        (lambda run, folder: cl.simulate_batch(run.scenario, {"law.force": [5.0]}), "tables of runs need pyarrow"),
        (lambda run, folder: cl.compare({"a": run.scenario}, {}), "data frames need pandas"),
        (lambda run, folder: run.to_xarray(), "datasets of xarray need xarray"),
        (lambda run, folder: run.to_pandas(), "data frames need pandas"),
        (lambda run, folder: write_csv(run, folder / "a.csv"), "tables of runs need pyarrow"),
        (lambda run, folder: table_of(folder / "log.csv"), "tables of runs need pyarrow"),
        (lambda run, folder: table_of(folder / "log.nc"), "datasets of xarray need xarray"),
    ],
)
def test_what_needs_an_extra_names_it(use, said, plain, tmp_path):
    """One line: what needs which package, and the command that installs it."""
    run = cl.simulate(cl.load_scenario("planar2_slide", SHORT), progress=False)
    with pytest.raises(cl.ScenarioError) as refused:
        use(run, tmp_path)
    assert str(refused.value) == f'{said}, which is not installed: pip install "closedloop[tables]"'


def test_a_command_that_needs_an_extra_ends_with_a_line(capsys):
    """An import that fails for want of such a package is no traceback; that of any other package is."""

    def fail(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    assert run_command("closedloop", lambda words: fail("pyarrow.csv"), []) == BAD_INPUT
    assert 'need pyarrow, which is not installed: pip install "closedloop[tables]"' in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):
        run_command("closedloop", lambda words: fail("nobody"), [])


def test_a_robot_of_an_absent_package_names_its_extra(monkeypatch):
    """The robots of this package are there; of another the line says what to install."""
    monkeypatch.setattr(example_robots, "_table", lambda: None)
    assert robot_models.load("wam4").n == 4
    with pytest.raises(robot_models.ModelError, match=r"panda and ur5, need .* pip install \"closedloop\[robots\]\""):
        robot_models.load("ur5_gripper")


def test_a_run_needs_none_of_them(tmp_path):
    """A run with its figures and its file, read again, with all these packages absent."""
    code = BLOCKED + (
        "from closedloop.__main__ import main\n"
        "assert main(['run', 'wam_slide', '--time.duration', '0.05', '--reference.stop', '0.04', '--reference.start', "
        "'0.01', '--out', 'a']) == 0\n"
        "import closedloop as cl\n"
        "assert len(cl.load_run('a/run.nc')) == 51\n"
        "assert main(['run', 'panda_slide', '--out', 'b']) == 2\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300,
                          check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a" / "fig5_contact_force.png").exists()
    assert done.stderr.strip().endswith(f"need {example_robots.NEEDS} (or give the path of a .urdf or MJCF .xml)")


def test_every_extra_that_is_named_exists():
    """Also those of `all` and `dev`, which a user would install."""
    project = tomllib.loads((Path(cl.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert {extra for _, extra in errors.EXTRAS.values()} | {"robots"} <= extras.keys()
    for names in (words for words in extras.values() for words in words if words.startswith("closedloop[")):
        assert set(names.removeprefix("closedloop[").rstrip("]").split(",")) <= extras.keys()
