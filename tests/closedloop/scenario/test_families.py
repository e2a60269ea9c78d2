"""Plug-ins: a user's path and integrator, in a file outside the package, have every right that a shipped one has."""

import copy
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path as File
from typing import Annotated

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

import closedloop as cl
from closedloop.base.families import Family
from closedloop.command.sweep import main as sweep_main
from closedloop.control.reference.path import PATHS
from closedloop.control.reference.paths.line import Line
from closedloop.mechanics.closure.baumgarte import largest_stable_ratio, spectral_radius
from closedloop.mechanics.integrators import ADAPTIVE, INTEGRATORS, Integrator
from closedloop.scenario.load import parse_scenario
from closedloop.scenario.messages import key_unit
from closedloop.studies.sweep.sweep import Design, Sweep, parse_axis

ROOT = File(__file__).resolve().parents[3]
RALSTON = '''

from closedloop.mechanics.integrators import Integrator


class Ralston(Integrator):
    """Least bound on the error of all schemes of two stages."""

    order = 2
    a = ((), (2 / 3,))
    b = (1 / 4, 3 / 4)
    source = "Ralston 1962"
'''
SHORT = {"time.duration": 0.05}
MINE = ("--reference.kind", "my_paths:Wave", "--time.integrator", "my_paths:Ralston")


def example():
    """Return the path of the documentation."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "extending.md").read_text(encoding="utf-8"), re.DOTALL)
    (block,) = [block for block in blocks if "class Wave(Path)" in block]
    return block


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a folder with a user's module, outside the package."""
    folder = tmp_path_factory.mktemp("users")
    (folder / "my_paths.py").write_text(example() + RALSTON, encoding="utf-8")
    (folder / "never.py").write_text(f"open({str(folder / 'ran')!r}, 'w').close()\n{example()}", encoding="utf-8")
    return folder


@pytest.fixture
def mine(folder, monkeypatch):
    """Let the user's module be imported, and return it."""
    monkeypatch.syspath_prepend(str(folder))
    import my_paths

    return my_paths


def load(changes=None, **kinds):
    """Return the paper's slide, shortened, with these changes."""
    return cl.load_scenario("wam_slide", SHORT | (changes or {}) | {k.replace("__", "."): v for k, v in kinds.items()})


def test_a_path_and_an_integrator_run_on_both_engines(mine):
    """The tip runs where the closed form says, to the stabiliser's sliding error, and the engines agree."""
    scenario = load({"time.duration": 6.5}, reference__kind="my_paths:Wave", time__integrator="my_paths:Ralston",
                    reference__swing=0.008, reference__stop=6.0)  # fmt: skip
    assert type(scenario.reference) is mine.Wave
    runs = {engine: cl.simulate(scenario, engine=engine) for engine in ("pinocchio", "compiled")}
    run = runs["pinocchio"]
    x = np.clip(run.time / 6.0, 0.0, 1.0)
    s = x**3 * (10 - 15 * x + 6 * x**2)
    wanted = run.position[0] + np.outer(0.008 * np.sin(4 * np.pi * s), [1, 0, 0]) + np.outer(0.05 * s, [0, 1, 0])
    assert np.max(np.abs(run.reference_tip - wanted)) < 1e-12
    assert np.max(np.abs(run.position - wanted)) < 2e-3  # what the PD law leaves
    assert np.max(np.abs(runs["compiled"].q - run.q)) < 1e-9
    assert run.summary()["verdict"]["good"]


def test_in_a_batch_and_in_a_sweep(mine, capsys, tmp_path, monkeypatch):
    """A batch has the rows of single runs, also where the kind itself changes; a sweep takes the class by its name."""
    kinds = ["hold", mine.Wave, "my_paths:Wave"]
    table = cl.simulate_batch(load(), {"reference.kind": kinds, "time.integrator": [mine.Ralston] * 3}, keep=["q"])
    assert table["reference.kind"].to_pylist() == ["hold", "my_paths:Wave", "my_paths:Wave"]
    for kind, kept in zip(kinds, table["q"], strict=True):
        single = cl.simulate(load(reference__kind=kind, time__integrator=mine.Ralston), engine="compiled")
        assert np.array_equal(np.ravel(kept.as_py()), single.q.ravel())
    monkeypatch.chdir(tmp_path)
    words = ("wam_slide", *MINE, "--time.duration", "0.02", "--over", "reference.swing=0.005,0.01")
    assert sweep_main([*words, "--out", "s.parquet"]) == 0, capsys.readouterr().err
    import pyarrow.parquet as pq

    assert pq.read_table("s.parquet")["status"].to_pylist() == ["done"] * 2
    assert key_unit("reference.swing") == "m"
    capsys.readouterr()


def test_a_sweep_knows_the_text_of_the_class(mine, folder):
    """What a sweep depends on has the digest of the class's text, and a worker is told which classes were named."""
    sweep = Sweep.of(load(), Design([parse_axis("reference.kind=hold,my_paths:Wave")], "grid", 0, 0))
    assert sweep.job.members == (("reference.kind", "my_paths:Wave"),)
    before = Sweep.of(load(), Design([parse_axis("law.force=5,10")], "grid", 0, 0)).identity
    assert sweep.identity["members"].keys() == {"my_paths:Wave"}
    assert "members" not in before


LOOK = """
import pathlib, sys
import closedloop as cl
from closedloop.figures import draw_figures
run = cl.load_run("first/run.nc")
print(run.scenario.reference.kind, run.scenario.reference.swing, sorted(run.member_digests))
run.summary(), run.save("again.nc"), draw_figures(run, pathlib.Path("."), None)
assert "my_paths" not in sys.modules
try:
    cl.simulate(run.scenario)
except cl.ScenarioError as error:
    print(error)
from closedloop.run import main
sys.exit(main(["first/run.nc", "--no-figures"]))
"""


@pytest.mark.slow
def test_from_the_command_line_and_back(command_line, folder, tmp_path):
    """The command runs the page's example; its run.nc keeps name and digest, and repeats once they are named."""
    (tmp_path / "my_paths.py").write_text((folder / "my_paths.py").read_text())
    words = ("wam_slide", *MINE, "--reference.swing", "0.02", "--time.duration", "0.02", "--no-figures")
    here = command_line(*words, "--out", "first")
    assert here.status == 0, here.err
    again = subprocess.run([sys.executable, "-c", LOOK], cwd=tmp_path, capture_output=True, text=True)
    first, refused = again.stdout.splitlines()
    assert first == "my_paths:Wave 0.02 ['my_paths:Ralston', 'my_paths:Wave']"
    assert "--reference.kind my_paths:Wave on the command line" in refused
    assert again.returncode == 2, again.stderr
    assert again.stderr.count("\n") == 2
    assert "--reference.kind my_paths:Wave" in again.stderr
    assert "--time.integrator my_paths:Ralston" in again.stderr
    assert command_line("first/run.nc", *MINE, "--no-figures", "--json", "--out", "second").status == 0
    first, second = cl.load_run("first/run.nc"), cl.load_run("second/run.nc")
    assert first.scenario == second.scenario
    assert np.array_equal(first.q, second.q)


def test_another_text_of_the_class_is_said(command_line, mine, folder, tmp_path):
    """A repeat with a class whose text has changed says so, in one line, and is another run."""
    run = cl.simulate(load(reference__kind=mine.Wave))
    assert re.fullmatch("[0-9a-f]{64}", run.member_digests["my_paths:Wave"])
    run.save(tmp_path / "run.nc")
    text = (folder / "my_paths.py").read_text()
    try:
        (folder / "my_paths.py").write_text(text + "\n# another\n")
        outcome = command_line("run.nc", "--reference.kind", "my_paths:Wave", "--no-figures", "--json", "--out", "o")
    finally:
        (folder / "my_paths.py").write_text(text)
    assert outcome.status == 0
    assert outcome.err == "closedloop: the text of my_paths:Wave is not the one that run.nc was made with\n"


@pytest.mark.parametrize("key", ["reference.kind", "time.integrator"])
def test_a_file_alone_names_no_class(key, folder, command_line, tmp_path, monkeypatch):
    """A scenario file that names one is refused in a line that says how to; its module is not imported."""
    monkeypatch.syspath_prepend(str(folder))
    section, _, name = key.partition(".")
    (tmp_path / "mine.toml").write_text(f'[law]\nkp = 1\nkd = 1\n[{section}]\n{name} = "never:Wave"\n')
    line = command_line("mine.toml", "--no-figures").refusal()
    assert line == (
        f"mine.toml: {key} = 'never:Wave': names a class of a user's own, and a file can make no code run: name it "
        f'yourself, with --{key} never:Wave on the command line or {{"{key}": "never:Wave"}} in Python'
    )
    assert "never" not in sys.modules
    assert not (folder / "ran").exists()


def test_a_file_and_the_command_line_together(mine, tmp_path):
    """Where Python names the class too, its parameters come from the file, checked like any."""
    file = tmp_path / "mine.toml"
    file.write_text('[law]\nkp = 1\nkd = 1\n[reference]\nkind = "my_paths:Wave"\nswing = 0.03\n')
    assert cl.load_scenario(file, {"reference.kind": mine.Wave}).reference.swing == 0.03


def test_in_python(mine):
    """A scenario built in Python takes an instance; texts, copies and pickles of it are equal to it."""
    base = load()
    scenario = cl.Scenario(law=base.law, reference=mine.Wave(swing=0.02), time={"integrator": mine.Ralston})
    assert scenario.time.integrator == "my_paths:Ralston"
    assert parse_scenario(scenario.to_toml()) == scenario
    assert cl.Scenario.model_validate_json(scenario.model_dump_json()) == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario == copy.deepcopy(scenario)
    assert json.loads(scenario.model_dump_json())["reference"] == {
        "kind": "my_paths:Wave", "length": 0.05, "swing": 0.02, "stop": 6.0, "on_surface": "projected",
        "orientation": "free",
    }  # fmt: skip
    assert load({"reference": {"kind": "my_paths:Wave", "swing": 0.02}}).reference == scenario.reference
    assert load({"reference": scenario.reference}).reference is not None


def test_a_class_made_on_the_spot(mine):
    """A class that no module holds, as in a notebook's function, is named by itself; its runs can be varied."""

    class Faster(mine.Wave):
        stop: float = 3.0

    scenario = load(reference__kind=Faster)
    assert scenario.reference.kind.endswith("<locals>.Faster")
    table = cl.simulate_batch(scenario, {"reference.swing": [0.005, 0.01]}, engine="pinocchio")
    assert table["status"].to_pylist() == ["done", "done"]


REFUSED = {
    "unknown key": ({"reference.kind": "my_paths:Wave", "reference.speed": 1.0}, "unknown key 'reference.speed'"),
    "misspelt key": ({"reference.kind": "my_paths:Wave", "reference.swings": 1.0}, "did you mean 'reference.swing'?"),
    "below its bound": ({"reference.kind": "my_paths:Wave", "reference.swing": -1}, "reference.swing = -1: must be gr"),
    "above its size": ({"reference.kind": "my_paths:Wave", "reference.swing": 1e9}, "at most 1e+06 m: no arm reaches"),
    "text": ({"reference.kind": "my_paths:Wave", "reference.swing": "far"}, "'far': must be a number"),
    "no module": ({"reference.kind": "no_such:Wave"}, "reference.kind = 'no_such:Wave': there is no module 'no_such'"),
    "no class": ({"reference.kind": "my_paths:Wav"}, "'my_paths' has no class 'Wav'"),
    "of another family": ({"reference.kind": "my_paths:Ralston"}, "derived from closedloop.control.reference"),
    "a path to integrate": ({"time.integrator": "my_paths:Wave"}, "derived from closedloop.mechanics.integ"),
    "no name": ({"reference.kind": "my_paths:"}, "named MODULE:CLASS"),
    "a name in a folder": ({"reference.kind": "../my_paths:Wave"}, "named MODULE:CLASS"),
    "the base": ({"reference.kind": "closedloop.control.reference.path:Path"}, "must be a class derived from"),
    "no tip_path": ({"reference.kind": type("Nothing", (PATHS.base,), {})}, "must define tip_path"),
    "too long a path": ({"reference.kind": "my_paths:Wave", "reference.length": 3.0}, "shorten the path or start"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_bad_member_is_refused_in_one_line(case, mine):
    """What is wrong with a class or its parameters is said as it is for a shipped one."""
    changes, words = REFUSED[case]
    with pytest.raises(cl.ScenarioError) as caught:
        cl.prepare(load(changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


FAULTS = {
    "raises": ("        return 1 / 0\n", "faulty.py:6: ZeroDivisionError: division by zero"),
    "no path": ("        return [origin]\n", "TypeError: tip_path returned list, not a TipPath"),
    "a curve that raises": (
        "        return TipPath(origin, (Segment(0.0, 1.0, origin, lambda s: s[7] if s.max() else [s * 0] * 3,"
        " constant, 0.1),))\n",
        "faulty.py:6: IndexError: index 7 is out",
    ),
    "a curve of two numbers": (
        "        return TipPath(origin, (Segment(0.5, 1.0, origin, lambda s: [np.zeros((s.size, 2))] * 3,"
        " constant, 0.1),))\n",
        "ValueError: ",
    ),
    "another start": ("        return TipPath(origin + 1.0)\n", "its path begins at"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_path_that_fails(case, command_line, tmp_path):
    """What a user's path does wrong is one line with the line of its file, and status 2."""
    body, words = FAULTS[case]
    head = (
        "import numpy as np; from closedloop.control.reference.tip_path import constant\n"
        "from closedloop.control.reference.path import Path\n"
        "from closedloop.control.reference.tip_path import Segment, TipPath\n"
    )
    name = f"faulty_{case.replace(' ', '_')}"
    (tmp_path / f"{name}.py").write_text(f"{head}class Mine(Path):\n    def tip_path(self, origin, normal):\n{body}")
    line = command_line("wam_slide", "--reference.kind", f"{name}:Mine", "--no-figures").refusal()
    assert line.startswith(f"reference.kind = {name}:Mine: ")
    assert words.replace("faulty.py", f"{name}.py") in line


TABLEAUS = {
    "short row": ({"a": ((), ()), "b": (0.5, 0.5)}, "row s of a must have s entries"),
    "weights": ({"a": ((),), "b": (0.5,)}, "must sum to 1"),
    "nodes": ({"a": ((), (0.2113248654051871,)), "b": (0.5, 0.5)}, "equal parts"),
    "beyond the step": ({"a": ((), (1.5,)), "b": (0.5, 0.5)}, "must lie in the step"),
    "semi-implicit": ({"a": ((), (1.0,)), "b": (0.5, 0.5), "semi_implicit": True}, "has one stage"),
}


@pytest.mark.parametrize("case", TABLEAUS)
def test_a_tableau_that_is_none(case):
    """A class with such a tableau cannot be made."""
    numbers, words = TABLEAUS[case]
    with pytest.raises(ValueError, match=words):
        type("Mine", (Integrator,), numbers | {"order": 1, "source": ""})


def test_order_and_limit_of_a_users_scheme(mine):
    """Ralston's scheme converges with order 2 where its node is at two thirds, and has Heun's limit of stability.

    Schemes of two stages and order 2 have one stability polynomial, so z = h/T of ζ = 0 never dies out, and for
    critical damping the limit is that of a double real eigenvalue −z: z = 2.
    """
    heun = type("Heun", (Integrator,), {"order": 2, "a": ((), (1.0,)), "b": (0.5, 0.5), "source": "Heun 1900"})
    assert (mine.Ralston.parts, heun.parts) == (3, 1)
    for damping in (0.3, 0.707, 1.5):
        assert largest_stable_ratio("my_paths:Ralston", damping) == largest_stable_ratio(mine.Ralston, damping)
        assert largest_stable_ratio(mine.Ralston, damping) == pytest.approx(largest_stable_ratio(heun, damping))
    assert spectral_radius(mine.Ralston, 1.0, 1.99) < 1.0 < spectral_radius(mine.Ralston, 1.0, 2.01)
    changes = {"reference.kind": mine.Wave, "reference.stop": 0.4, "stabiliser.kind": "none", "time.duration": 0.4}

    def end(scheme, h):
        return cl.simulate(load(changes | {"time.integrator": scheme, "time.step": h}), engine="compiled").q[-1]

    truth = end("rk4", 0.0005)
    for scheme in (mine.Ralston, heun):
        errors = [np.max(np.abs(end(scheme, h) - truth)) for h in (0.004, 0.002)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)
        assert errors[1] > 1e-10


def test_help_knows_a_class_that_was_named(command_line, mine):
    """--help has the keys of a class that the same line names; and all kinds that ship, in order."""
    out = command_line("--reference.kind", "my_paths:Wave", "--help", "reference").out
    assert "--reference.swing (0.01)  [my_paths:Wave" in out
    swing = command_line("--reference.kind", "my_paths:Wave", "--explain", "reference.swing").out
    assert "from 1e-09 to 1e+06 m" in swing
    shipped = [kind for kind in PATHS if ":" not in kind]
    assert shipped == ["circle", "figure_eight", "hold", "line", "raster", "waypoints"]
    assert re.findall('kind = "(\\w+)"', out) == shipped


def test_the_registry(tmp_path, monkeypatch):
    """A file is a member by its name; a file of two is a mistake; a folder may hold the members of two families."""
    package = tmp_path / "animals"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from closedloop.base.families import Member\n"
        "class Bird(Member):\n    folder = 'animals'\n"
        "class Fish(Member):\n    folder = 'animals'\n"
    )
    (package / "wren.py").write_text("from animals import Bird\nclass Wren(Bird):\n    pass\n")
    (package / "diver.py").write_text(
        "from animals import Bird, Fish\nclass Diver(Bird):\n    pass\nclass Pike(Fish):\n    pass\n"
    )
    (package / "two.py").write_text("from animals import Fish\nclass A(Fish):\n    pass\nclass B(Fish):\n    pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import animals

    birds, fish = Family(animals.Bird), Family(animals.Fish)
    assert list(birds) == ["diver", "wren"]
    assert birds["wren"].member_name() == "wren"
    assert (birds["diver"].__name__, fish["diver"].__name__) == ("Diver", "Pike")
    assert "wren" not in fish
    assert "Wren" not in birds
    with pytest.raises(TypeError, match="holds A, B"):
        fish.get("two")
    with pytest.raises(KeyError):
        birds["os:path"]


@pytest.mark.parametrize("changes", [{"time.integrator": "heum"}, {"reference.kind": "elipse"}])
def test_a_refusal_lists_what_ships(changes, mine):
    """What is said of a wrong name does not depend on the classes that were named in this process before."""
    cl.load_scenario("wam_slide", {"time.integrator": mine.Ralston, "reference.kind": mine.Wave})
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario("wam_slide", changes)
    assert mine.__name__ not in str(caught.value)
    assert re.search("'rk4'|'circle'", str(caught.value))


def test_shipped_members_are_found():
    """Each shipped scheme is there by its name, and of one family."""
    assert [name for name in INTEGRATORS if ":" not in name] == [
        "explicit_euler",
        "rk4",
        "semi_implicit_euler",
        "time_stepping",
    ]
    assert list(ADAPTIVE) == ["dop853"]
    assert PATHS["line"] is Line
    assert Line.member_name() == "line"


def test_the_usual_kind_of_a_section():
    """A family with a usual kind takes a section that names none; without one a kind is asked for."""
    assert TypeAdapter(Annotated[PATHS.base, PATHS]).validate_python({}).kind == "hold"
    with pytest.raises(ValidationError, match="discriminator"):
        TypeAdapter(Annotated[PATHS.base, Family(PATHS.base)]).validate_python({})
    with pytest.raises(cl.ScenarioError, match=r"is 'hold' where it is not given, and stop is a key of 'circle' or "):
        parse_scenario("[law]\nkp = 1\nkd = 1\n[reference]\nstop = 2.0\n")
