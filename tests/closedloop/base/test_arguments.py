"""Wrong arguments of the functions that users call from Python are answered in one line."""

import inspect
import math
import warnings

import numpy as np
import pytest

import closedloop as cl
import robot_models
from closedloop.base.arguments import arguments_checked, fields_checked, fits, in_words

SCENARIO = cl.load_scenario("planar2_slide", {"time.duration": 0.005})
RUN = cl.simulate(SCENARIO)
TIME, ROWS = np.linspace(0.0, 1.0, 60), np.zeros((60, 2))
WRONG = [
    3, -1, 2.5, math.nan, True, None, "", "no such", b"x", [], (), {}, [3], ["no such"], [math.nan], {3: 4},
    {"law.force": []}, {"no such": [1.0]}, np.array([1.0, 2.0]), np.nan, object(), lambda: 0, SCENARIO, RUN,
]  # fmt: skip

# Of each function arguments that would do, and cost little.
GOOD = {
    "load_scenario": {"name": "wam_slide", "overrides": {"law.force": 5.0}},
    "load_run": {"path": "no such.nc"},
    "simulate": {"scenario": SCENARIO, "law": None, "model": None, "engine": "pinocchio", "record": None},
    "halve": {"scenario": SCENARIO, "law": None, "model": None, "engine": "pinocchio"},
    "Simulator": {"scenario": SCENARIO, "engine": "pinocchio", "model": None},
    "simulate_batch": {"scenario": SCENARIO, "changes": {"law.force": [1.0]}, "grid": False, "keep": (),
                       "engine": "pinocchio", "workers": 1, "model": None, "law": None},
    "sweep_plot": {"table": "no such.parquet", "of": None, "x": None, "y": None, "out": None,
                   "ax": None},
    "compare": {"scenarios": [SCENARIO], "over": None, "of": ("rms_force_error",), "engine": "pinocchio",
                "workers": 1},
    "compare_log": {"log": RUN, "scenario": SCENARIO, "model": None, "shift": None, "cutoff": None},
    "linearise": {"scenario": SCENARIO, "at": None, "model": None, "cache": None},
    "gradient": {"scenario": SCENARIO, "keys": ["law.force"], "of": ["rms_force_error"], "model": None, "workers": 1},
    "gradients": {"scenarios": [SCENARIO], "keys": ["law.force"], "of": ["rms_force_error"], "model": None,
                  "workers": 1},
    "sensitivities": {"scenario": SCENARIO, "keys": ["law.force"], "of": ["contact_force"], "model": None,
                      "workers": 1},
    "tune": {"scenario": SCENARIO, "vary": {"law.force": [5.0, 15.0]}, "minimise": "rms_force_error", "minimize": None,
             "subject_to": ["max_kkt_residual < 1"], "over": None, "robust": "worst", "log": (), "starts": 1,
             "seed": 0, "iterations": 1, "kept": None, "workers": 1},
    "excite": {"robot": "planar2", "target": ["no such"], "duration": 1.0, "harmonics": 1, "rate": 20.0, "noise": None,
               "acceleration": None, "share": 0.9, "friction": ("viscous",), "drive_inertia": True, "seed": 0},
    "identify": {"log": cl.Log(TIME, ROWS, ROWS), "robot": "planar2", "friction": ("viscous",), "drive_inertia": True,
                 "coupled": (), "stribeck_speed": None, "extra": None, "slow": 0.01, "cutoff": None,
                 "held_out": 0.25, "test": None, "method": "ls", "confidence": 0.95},
    "identify_contact": {"log": RUN, "robot": None, "normal": (0.0, 0.0, 1.0), "tip": None, "delay": None,
                         "cutoff": None, "confidence": 0.95},
    "prepare": {"scenario": SCENARIO, "model": None, "cache": None},
    "solve_closure": {"H": np.eye(2), "rhs": np.zeros(2), "A": np.array([1.0, 0.0]), "b": 0.0},
    "lab": {"scenario": "no such", "overrides": {}, "law": None, "model": None, "host": "127.0.0.1", "port": 8080,
            "dark": False, "show": False, "ghosts": ()},
    "Log": {"time": TIME, "q": ROWS, "torque": ROWS, "joint_names": (), "v": None, "source": "the log"},
    "Recording": {"time": TIME, "q": ROWS, "torque": None, "v": None, "force": None, "speed": None,
                  "source": "the log", "is_run": False},
    "Plane": {"normal": np.array([0.0, 0.0, 1.0]), "offset": 0.0},
    "Robot": {"model": robot_models.load("planar2"), "tip": None, "moved": ()},
    "Run": {"scenario": SCENARIO, "model": RUN.model, "columns": RUN.columns},
}  # fmt: skip
# What a step or a run hands over, and what users derive their classes from; `figures` is a module, `serve` a server.
MADE = {"Event", "LawInput", "Problem", "StepState", "Terms", "figures", "shipped_scenarios", "Law", "serve",
        "Compliance", "ControlLaw", "Scenario", "Surface", "SurfaceMotion"}  # fmt: skip


def test_every_public_function_is_tried():
    """Of `__all__` all but errors and `MADE`; every argument but `progress`, whose function is the user's own."""
    errors = {name for name in cl.__all__ if inspect.isclass(getattr(cl, name)) and name.endswith("Error")}
    assert {*GOOD} == {*cl.__all__} - errors - MADE
    for name, good in GOOD.items():
        left = set(inspect.signature(getattr(cl, name)).parameters) - good.keys()
        assert left <= {"progress", "law", *(() if name != "Run" else inspect.signature(cl.Run).parameters)}


@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x == "tune")) for x in GOOD])
def test_wrong_arguments_are_answered_in_one_line(name, tmp_path, monkeypatch):
    """Every argument with every kind of wrong value: done, or an error of the package on one line."""
    monkeypatch.chdir(tmp_path)
    function, good = getattr(cl, name), GOOD[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for key in good:
            for wrong in WRONG:
                if name == "lab" and key != "scenario" and fits(wrong, inspect.signature(cl.Robot).return_annotation):
                    continue
                try:
                    made = function(**{**good, key: wrong})
                    if name == "lab":
                        made.close()
                except cl.ClosedLoopError as error:
                    faults = error.faults if isinstance(error, cl.ScenarioError) else [str(error)]
                    assert faults
                    assert all(0 < len(text) < 1000 and text.isprintable() for text in faults), (key, wrong)
                except Exception as error:
                    raise AssertionError(f"{name}({key}={wrong!r:.60})") from error


def test_the_line_says_what_where_and_what_would_be_right():
    """In the words of the caller."""
    for call, said in (
        (lambda: cl.load_scenario(3), "name = 3: must be text or a path or a dictionary from keys to a value"),
        (lambda: cl.simulate(3), "scenario = 3: must be a Scenario, as load_scenario('wam_slide') returns"),
        (lambda: cl.linearise(SCENARIO, at=math.nan), "at = nan: must be a number or None"),
        (lambda: cl.gradient(SCENARIO, [3], ["rms_force_error"]), "keys = [3]: must be a list of keys"),
        (lambda: RUN.save(3), "path = 3: must be text or a path"),
        (lambda: RUN.animate("run.gif", speed="fast"), "speed = 'fast': must be a number"),
        (lambda: cl.simulate(SCENARIO, model="wam4"),
         "model = 'wam4': must be a robot, as robot_models.load('wam4') returns or None"),
    ):  # fmt: skip
        with pytest.raises(cl.ScenarioError) as caught:
            call()
        assert str(caught.value) == said


def test_environments_answer_in_one_line():
    """Of Gymnasium, single and many."""
    gymnasium = pytest.importorskip("gymnasium")
    import closedloop.gym  # noqa: F401

    for made in (gymnasium.make, lambda *a, **k: gymnasium.make_vec(*a, num_envs=1, **k)):
        for key, wrong in (
            ("scenario", 3), ("overrides", 3), ("actions", []), ("observations", "q"), ("rewards", 3),
            ("endings", {"x": 3}), ("ranges", 3), ("worlds", "x"), ("control_rate", math.nan), ("tolerance", "x"),
            ("hold", math.nan), ("privileged", 3), ("no_such", 1),
        ):  # fmt: skip
            with pytest.raises(cl.ScenarioError) as caught:
                made("closedloop/Press-v0", **{key: wrong})
            assert all(key in line and line.isprintable() for line in caught.value.faults)


def test_annotations_are_compared_by_their_parts():
    """Lists by their entries, dictionaries by keys and values; text is no list of names, True no number."""
    from collections.abc import Iterable, Mapping, Sequence

    for value, hint, good in (
        (["a"], Sequence[str], True), ("a", Sequence[str], False), ([1], Sequence[str], False),
        ({"a"}, Iterable[str], True), ({"a": [1.0]}, Mapping[str, Sequence[float]], True),
        ({"a": ["b"]}, Mapping[str, Sequence[float]], False), (np.arange(3.0), Sequence[float], True),
        (True, int, False), (np.int64(3), int, True), (3, float, True), (math.nan, float | None, False),
        (None, float | None, True), (("a", "b"), tuple[str, str], True), (("a",), tuple[str, str], False),
    ):  # fmt: skip
        assert fits(value, hint) == good, (value, hint)
    assert in_words(Sequence[str] | None) == "a list of names or None"


def test_a_name_for_type_checkers_alone_is_compared_by_its_text():
    """A function need not import what it only names."""

    @arguments_checked()
    def takes(table: "pa.Table | str") -> None:
        """Take it."""

    import pyarrow as pa

    takes(pa.table({"x": [1]}))
    takes("x")
    with pytest.raises(cl.ScenarioError, match=r"table = 3: must be a table of pyarrow or text"):
        takes(3)
    assert fields_checked  # of dataclasses: `test_wrong_arguments_are_answered_in_one_line` with Log and Plane
