"""What the compiled engine does not cover it refuses: one line says what would be right; nothing is approximated."""

from dataclasses import replace

import pinocchio as pin
import pytest

import closedloop as cl
import robot_models
from closedloop.mechanics.robot.tree import tree_of


@pytest.mark.parametrize(
    ("changes", "engine", "words"),
    [
        ({"time.integrator": "dop853"}, "compiled", ["'dop853'", "'pinocchio'", "'rk4'"]),
        ({}, "mujoco", ["'mujoco'", "'pinocchio' or 'compiled'"]),
    ],
)
def test_refused_by_name(changes, engine, words):
    """An integrator that chooses its steps, and an engine that there is not."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.simulate(cl.load_scenario("wam_slide", changes), engine=engine)
    line = str(caught.value)
    assert "\n" not in line
    assert all(word in line for word in words), line


@pytest.mark.parametrize("kind", ["JointModelFreeFlyer", "JointModelPlanar"])
def test_joint_of_another_kind_is_refused_by_name(kind, monkeypatch):
    """A robot of one's own class may have any joint of Pinocchio's: the first that is not simulated is named."""
    model = replace(robot_models.load("wam4"))  # one of its own: what is known of its joints is kept with it

    def built(self):
        model = pin.Model()
        stick = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "stick")
        wrist = model.addJoint(stick, getattr(pin, kind)(), pin.SE3.Identity(), "wrist")
        model.addFrame(pin.Frame("tip", wrist, 0, pin.SE3.Identity(), pin.FrameType.BODY))
        return model

    monkeypatch.setattr(type(model), "pinocchio_model", built)
    with pytest.raises(cl.ModelError, match=f"joint 'wrist' is of Pinocchio's kind {kind[10:]}.*only revolute"):
        tree_of(model, "tip")


def test_command_line_refuses_with_one_line(command_line):
    """Exit status 2 and one line, before a word of compiling."""
    outcome = command_line("wam_slide", "--engine", "compiled", "--time.integrator", "dop853")
    assert outcome.status == 2
    assert len(outcome.err.splitlines()) == 1
    assert "'dop853'" in outcome.err
