"""The harness holds bodies that turn freely: engines agree, identities hold on the manifold, and faults are seen."""

from pathlib import Path

import numpy as np
import pytest

import robot_models
from validation.comparison import compare
from validation.engines.drake import Drake
from validation.engines.interface import Refused
from validation.engines.loop import ClosedLoop, Compiled
from validation.engines.mujoco import MuJoCo
from validation.engines.pinocchio_cpp import PinocchioCpp
from validation.engines.registry import available
from validation.identities import IDENTITIES, draw_sample
from validation.plant import FAULTS, TURNING_FAULTS, plant_all
from validation.suite import ROBOTS, load_robot


@pytest.fixture(scope="module")
def model():
    """A floating trunk with an arm, and a stick that hangs on a ball joint."""
    return load_robot("free bodies")


def state(model, seed):
    """Return q, as the loop has it, and q̇."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, model.n), 0.5 * rng.normal(size=model.n)


def test_engines_that_share_nothing_agree(model):
    """Pinocchio's, MuJoCo's and Drake's own algorithms, and the simulator's two sources, in all that they cover."""
    engines = available(model, "tip", [ClosedLoop, PinocchioCpp, MuJoCo, Drake, Compiled])
    cells = compare(model, states=5, built=engines).cells
    agreed = {cell.engine for cell in cells if cell.status == "agrees"}
    assert agreed == {"pinocchio", "mujoco", "drake", "compiled"}
    assert {cell.status for cell in cells} == {"agrees", "not covered"}


def test_each_engine_is_caught_with_a_fault_in_what_turns_freely(model):
    """The gyroscopic term, the orientation, the axes of the angular velocity, mass and tip of an MJCF."""
    names = ("last link's mass +1 ppm", "tip 1 µm off", *(fault.name for fault in TURNING_FAULTS))
    catches = plant_all(model, states=3, faults=[fault for fault in FAULTS if fault.name in names])
    assert all(catch.caught for catch in catches)
    carriers = {"closedloop", "compiled", "pinocchio", "mujoco", "drake"}
    assert {(catch.fault, catch.engine) for catch in catches} == {(name, each) for name in names for each in carriers}


def test_a_tip_that_no_joint_moves_is_refused(model):
    """A frame in the centre of a ball joint: one line."""
    with pytest.raises(robot_models.ModelError, match="'stick' cannot move along the normals"):
        compare(model, "stick", states=2)


def checks(engine, model, seed):
    """Return the identities that do not hold."""
    q, v = state(model, seed)
    sample = draw_sample(q, v, np.random.default_rng(seed))
    able = {name: check for name, (check, needs) in IDENTITIES.items() if all(n in engine.covers for n in needs)}
    found = {name: check(engine, sample) for name, check in able.items()}
    return {name for name, residual in found.items() if not residual.value <= residual.tolerance}


@pytest.mark.parametrize("engine", [PinocchioCpp, MuJoCo, Drake, ClosedLoop])
def test_identities_hold_on_the_manifold(model, engine):
    """Derivatives along a rotation, and Euler's and Poincaré's equations."""
    for seed in range(3):
        assert checks(engine(model, "tip"), model, seed) == set()


def test_what_an_engine_cannot_hold_is_said(tmp_path):
    """One line, no traceback: Drake's armatures are those of actuators, and no actuator drives a ball joint."""
    path = tmp_path / "bodies.xml"
    text = Path(ROBOTS["free bodies"][0]).read_text(encoding="utf-8")
    path.write_text(
        text.replace('name="hanger" type="ball"', 'name="hanger" type="ball" armature="0.1"'), encoding="utf-8"
    )
    found = available(robot_models.load(str(path)), "tip", [Drake, Compiled, MuJoCo])
    assert isinstance(found[0], Refused)
    assert "Drake has no actuator for the armature of 'hanger_wx'" in str(found[0])
    assert [type(each) for each in found[1:]] == [Compiled, MuJoCo]
