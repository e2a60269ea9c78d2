"""What `import closedloop` offers, what it costs, and who may import whom."""

import ast
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import closedloop as cl

ROOT = Path(cl.__file__).parent.parent
HEAVY = ("numba", "pinocchio", "matplotlib", "xarray", "pydantic", "scipy", "h5py", "rich")


def python(code, **options):
    """Run Python in a process of its own and return what it printed."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120, **options
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("name", cl.__all__)
def test_every_public_name_is_there(name):
    """Each name of `__all__` can be had, and says what it is."""
    assert getattr(cl, name) is not None
    if name != "Law":  # an alias of a type, which has no docstring of its own
        assert getattr(cl, name).__doc__
    assert name in dir(cl)


def test_public_names_are_those_that_type_checkers_see():
    """The names loaded on use are exactly those that the stub of the package declares, by whatever it imports them."""
    tree = ast.parse(Path(f"{cl.__file__}i").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    assert {alias.asname for node in imports for alias in node.names} == set(cl.__all__)


def test_unknown_names_are_refused():
    """A name that is not public raises AttributeError, as Python expects."""
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        cl.simulat  # noqa: B018


def test_what_is_not_used_is_not_loaded():
    """Importing the package loads nothing heavy, a run without figures or file no plotting.

    Reading a scenario loads no engine, and of each family the members that it picks.
    """
    other_paths = [f"closedloop.control.reference.paths.{name}" for name in ("circle", "hold", "raster", "waypoints")]
    assert all(map(find_spec, other_paths))
    code = "import sys, closedloop\n"
    for use, absent in (
        ("", HEAVY),
        ("closedloop.shipped_scenarios()", ("numba", "pinocchio", "matplotlib", "xarray")),
        ("closedloop.load_scenario('wam_slide')", ("numba", "pinocchio", "matplotlib", "xarray", *other_paths)),
        (
            "closedloop.simulate(closedloop.load_scenario('wam_slide', {'time.duration': 0.01})).summary()",
            ("matplotlib", "xarray", "h5py", "mujoco", "pydrake", "exudyn"),
        ),
    ):
        code += f"{use}\nprint({use!r}, *[m for m in {absent!r} if m in sys.modules], sep='|')\n"
    lines = python(code)
    assert len(lines) == 4
    assert [line.split("|")[1:] for line in lines] == [[]] * 4


def test_files_from_users_cannot_make_code_run():
    """Nothing in the package unpickles or evaluates; a module is imported where the command line or Python names it."""
    calls, risky = [], ("eval", "exec", "loads", "load", "import_module", "resolve_name", "__import__")
    for file in sorted((ROOT / "closedloop").rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if not re.search(rf"\b({'|'.join(risky)})\b", text):
            continue  # there is nothing of that name to be called
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call):
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                if name in risky:
                    owner = getattr(getattr(node.func, "value", None), "id", "")
                    if any(k.arg == "allow_pickle" and k.value.value is False for k in node.keywords):
                        continue  # numpy reads numbers, and refuses the rest
                    if owner != "builder":  # which builds machine code
                        calls.append((file.name, f"{owner}.{name}".lstrip(".")))
    assert {call for _, call in calls} <= {
        "tomllib.loads",
        "json.loads",
        "importlib.import_module",
        "resolve_name",
        "import_module",
        "robot_models.load",
        "URDF.load",
    }
    importing = {file for file, call in calls if call.endswith(("import_module", "resolve_name"))}
    assert importing == {
        "__init__.py",
        "user_module.py",
        "families.py",
        "upwards.py",
        "table.py",
        "lists.py",
        "compile_all.py",
    }


def test_errors_have_one_root():
    """Every error of the package is a ClosedLoopError, and tells apart what a caller would."""
    for name in (
        "DivergenceError",
        "ModelError",
        "OutputError",
        "RunFileError",
        "ScenarioError",
        "SingularClosureError",
    ):
        assert issubclass(getattr(cl, name), cl.ClosedLoopError)
    assert issubclass(cl.DivergenceError, cl.SimulationError)
    assert issubclass(cl.SingularClosureError, cl.SimulationError)
    assert not issubclass(cl.SimulationError, ValueError)
    assert issubclass(cl.ScenarioError, ValueError)
