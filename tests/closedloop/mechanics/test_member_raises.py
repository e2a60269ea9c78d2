"""A user's class that raises: compiled or interpreted, the run stops there, says where and why, and keeps its rows."""

import numpy as np
import pytest

import closedloop as cl

TEXT = '''
import math

import numpy as np

from closedloop import ControlLaw, Surface
from closedloop.mechanics.friction.law import SurfaceFriction


class Late(ControlLaw):
    """Gives up at 0.02 s."""

    force: float = 10.0

    @staticmethod
    def torque(x, par, z, torque):
        """Carry the arm, until it raises."""
        if x.t > 0.02:
            raise ValueError("late")
        for j in range(torque.size):
            torque[j] = x.C[j] - 10.0 * x.A[0, j]


class Beyond(Late):
    """Writes beyond the end."""

    @staticmethod
    def torque(x, par, z, torque):
        """Write one more."""
        for j in range(torque.size + 1):
            torque[j] = x.C[min(j, 3)] - 10.0 * x.A[0, min(j, 3)]


class Rough(SurfaceFriction):
    """No such slip."""

    @staticmethod
    def slide(x, par, z, c, w):
        """Raise once the tip moves."""
        if x.speed > 1e-3:
            raise RuntimeError("too fast")


class Edge(Surface):
    """A table that ends."""

    @staticmethod
    def level(p, par, gradient, hessian):
        """Return z."""
        if p[1] > 0.001:
            raise IndexError("off the table")
        gradient[2] = 1.0
        return p[2]
'''
CASES = {
    "law": ({"law.kind": "my_raising:Late"}, "0.021", r"law.kind = .*: my_raising.py:\d+: ValueError: late"),
    "index": ({"law.kind": "my_raising:Beyond"}, "0 s", r"law.kind = .*: my_raising.py:\d+: IndexError"),
    "friction": ({"friction.kind": "my_raising:Rough"}, "0.0", r"friction.kind = .*my_raising.py:\d+: RuntimeError"),
    "surface": ({"surface.kind": "my_raising:Edge"}, "0.1", r"surface.kind = .*my_raising.py:\d+: IndexError"),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a user's module."""
    folder = tmp_path_factory.mktemp("raising")
    (folder / "my_raising.py").write_text(TEXT, encoding="utf-8")
    return folder


@pytest.mark.parametrize("engine", ["pinocchio", "compiled"])
@pytest.mark.parametrize("case", CASES)
def test_what_a_member_raises_stops_the_run(case, engine, folder, monkeypatch):
    """With file, line, type and message in one line, as of a law in Python; the rows until then are there."""
    monkeypatch.syspath_prepend(str(folder))
    changes, at, words = CASES[case]
    way = {"kind": "waypoints", "times": [0.05, 0.3], "points": [[0, 0, 0], [0, 0.003, 0]], "timing": "linear"}
    path = {"reference": way, "law.pd_start": 0.0} if case in ("friction", "surface") else {}
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.3} | path | changes)
    with pytest.raises(cl.LawError, match=rf"^stopped at t = {at}.*{words}") as caught:
        cl.simulate(scenario, engine=engine)
    assert "\n" not in str(caught.value)
    assert len(caught.value.run) == pytest.approx(caught.value.time / 0.001, abs=1.5)
    if case == "law":
        table = cl.simulate_batch(scenario, {"law.force": [10.0, 11.0]}, workers=1).to_pydict()
        assert table["status"] == ["stopped", "stopped"]
        assert all("ValueError: late" in reason for reason in table["reason"])
    if case == "surface":
        with pytest.raises(cl.ScenarioError, match=r"^surface.kind = .*IndexError: off the table"):
            cl.prepare(cl.load_scenario("wam_slide", changes))


def test_interpreted_as_well(folder, monkeypatch):
    """Before the loop is compiled the error is the same."""
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr("closedloop.simulation.loop_calls.at_hand", lambda kernel: False)
    scenario = cl.load_scenario("wam_slide", {"law.kind": "my_raising:Late", "time.duration": 0.03})
    with pytest.raises(cl.LawError, match=r"stopped at t = 0.021.*my_raising.py:\d+: ValueError: late"):
        cl.simulate(scenario)


def test_numbers_of_numpy_are_numbers():
    """A list of np.float64 is a column of numbers, as one of floats is."""
    scenario = cl.load_scenario("planar2_slide", {"time.duration": 0.01})
    for values in (list(np.linspace(5, 9, 3)), np.linspace(5, 9, 3), [5.0, 7.0, 9.0]):
        table = cl.simulate_batch(scenario, {"law.force": values}, workers=1)
        assert table.column("law.force").to_pylist() == [5.0, 7.0, 9.0]
