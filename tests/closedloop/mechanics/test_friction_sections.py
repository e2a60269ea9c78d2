"""What a scenario may say of friction, what it may not, and the arrays that come of it."""

import re
from typing import Annotated

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

import closedloop as cl
from closedloop.jit.parameters import pack_each_joint
from closedloop.mechanics.friction.law import JOINT_LAWS, SURFACE_LAWS, joint_parameters, surface_parameters
from closedloop.mechanics.friction.laws.coulomb import SurfaceCoulomb
from closedloop.mechanics.friction.laws.coulomb_viscous import JointCoulombViscous
from closedloop.mechanics.friction.laws.lugre import JointLuGre, SurfaceLuGre, passive_damping_speed, passive_viscous
from closedloop.mechanics.friction.laws.stribeck import JointStribeck, SurfaceStribeck

# A unit stands between commas or at the end; 1 is that of numbers without.
UNIT = r", (1|s|m/s|rad/s|1/m|s/m|N s/m|N m|N m/rad|N m s/rad)(,|;|$)"
FIGURES = {
    "coefficient": 0.3,
    "kinetic": 0.2,
    "static": 0.3,
    "static_excess": 0.1,
    "stribeck_speed": 0.01,
    "stiffness": 1e4,
    "damping": 10.0,
    "dead_band": 1e-3,
    "memory_delay": 0.01,
    "rise_time": 1.0,
    "viscous": 0.5,
}


def families():
    """Return (family, section type) for every section of both families."""
    return [
        (name, section)
        for name, family in (("surface", SURFACE_LAWS), ("joint", JOINT_LAWS))
        for kind, section in family.items()
        if ":" not in kind
    ]


def example(section):
    """Return a section of this type with every required parameter."""
    wanted = {name: FIGURES[name] for name, field in section.model_fields.items() if field.is_required()}
    return section(**wanted)


def fault(family, data):
    """Return where pydantic finds fault with the data of a section, and in which words."""
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(Annotated[family.base, family]).validate_python(data)
    first = caught.value.errors()[0]
    return ".".join(map(str, first["loc"])), str(first.get("ctx", {}).get("error", first["msg"]))


@pytest.mark.parametrize(("family", "section"), families())
def test_every_parameter_is_described_and_packed(family, section):
    """Each parameter has a description with a unit, and the functions of the law read its value by its name."""
    given = example(section)
    blocks = joint_parameters(given, 3) if family == "joint" else [surface_parameters(given)]
    assert len(blocks) == (3 if family == "joint" else 1)
    names = [name for name in section.model_fields if name != "kind"]
    seen = {"coefficient": "kinetic"}  # of a law with one level, which the functions have as a joint's
    for name in names:
        assert name == "exponent" or re.search(UNIT, section.model_fields[name].description), name
        value = getattr(given, name)
        for par in blocks:
            assert getattr(par, seen.get(name, name)) == (np.inf if value is None else value), name
    assert set(blocks[0].layout.at) == {seen.get(name, name) for name in names}


def test_joints_may_differ():
    """One number goes to all joints, a list to each its own."""
    joints = joint_parameters(JointCoulombViscous(kinetic=[0.5, 0.4, 0.3], viscous=0.1), 3)
    assert [par.kinetic for par in joints] == [0.5, 0.4, 0.3]
    assert [par.viscous for par in joints] == [0.1, 0.1, 0.1]


def test_list_of_the_wrong_length():
    """A list that does not fit the robot is refused with its name, its length and the right one."""
    section = JointCoulombViscous(kinetic=[0.5, 0.4], viscous=0.1)
    with pytest.raises(cl.ScenarioError, match=r"^joint_friction\.kinetic has 2 entries: must be one number or 4, one"):
        pack_each_joint(section, 4, "joint_friction")


@pytest.mark.parametrize(
    ("family", "data", "where", "words"),
    [
        (
            SURFACE_LAWS,
            {"kind": "coulomb", "coefficient": -0.1},
            "coefficient",
            "greater than or equal to 0",
        ),
        (SURFACE_LAWS, {"kind": "coulomb", "coefficient": "0.1"}, "coefficient", "must be a number"),
        (SURFACE_LAWS, {"kind": "coulomb", "mu": 0.1}, "coefficient", "Field required"),
        (SURFACE_LAWS, {"kind": "rubber"}, "", "'rubber'|seven_parameter"),
        (
            SURFACE_LAWS,
            {"kind": "stribeck", "kinetic": 0.3, "static": 0.2, "stribeck_speed": 0.01},
            "static",
            "must not be below kinetic, 0.3: static friction is the larger",
        ),
        (
            SURFACE_LAWS,
            {"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.0},
            "stribeck_speed",
            "greater than 0",
        ),
        (
            SURFACE_LAWS,
            {"kind": "lugre", "kinetic": 0.0, "static": 0.3, "stribeck_speed": 0.1, "stiffness": 1e4, "damping": 0.0},
            "kinetic",
            "greater than 0",
        ),
        (SURFACE_LAWS, {"kind": "dahl", "coefficient": 0.3, "stiffness": -1.0}, "stiffness", "greater than 0"),
        (
            JOINT_LAWS,
            {"kind": "coulomb", "kinetic": [0.1, -0.2]},
            "kinetic",
            "entry 1 is -0.2: must not be negative",
        ),
        (JOINT_LAWS, {"kind": "coulomb", "kinetic": -0.2}, "kinetic", "must not be negative"),
        (
            JOINT_LAWS,
            {"kind": "stribeck", "kinetic": [0.1, 0.2], "static": [0.2, 0.1], "stribeck_speed": 0.1},
            "static",
            "entry 1 is 0.1: must not be below kinetic, 0.2: static friction is the larger",
        ),
        (
            JOINT_LAWS,
            {"kind": "stribeck", "kinetic": [0.1, 0.2], "static": [0.2, 0.3, 0.3], "stribeck_speed": 0.1},
            "static",
            "must have as many entries as kinetic, 2",
        ),
        (
            JOINT_LAWS,
            {"kind": "stribeck", "kinetic": 0.1, "static": 0.2, "stribeck_speed": [0.1, 0.0]},
            "stribeck_speed",
            "entry 1 is 0: must be greater than 0",
        ),
    ],
)
def test_bad_figures_are_refused(family, data, where, words):
    """What cannot be is refused at the key that is at fault, with what would be right."""
    place, message = fault(family, data)
    assert place == where
    assert any(part in message for part in words.split("|"))
    assert "\n" not in message


def test_static_friction_may_equal_kinetic():
    """The edge itself is allowed: static friction no larger than kinetic is Coulomb's."""
    section = SurfaceStribeck(kinetic=0.3, static=0.3, stribeck_speed=0.01)
    assert surface_parameters(section).static == 0.3
    assert JointStribeck(kinetic=[0.1, 0.2], static=0.2, stribeck_speed=0.1).static == 0.2


def test_energy_fault_says_what_would_be_right():
    """LuGre with constant damping is named with the two cures, and either of them, as printed, is one."""
    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    message = section.energy_fault(load=10.0)
    assert "lugre may add energy at high speed" in message
    assert "damping_speed = 0.0622 m/s or less" in message  # 4 √(2e) 0.2/30
    assert "viscous = 150 N s/m or more" in message  # 10 N × 30 × (0.3 − 0.2)/0.2
    assert section.model_copy(update={"damping_speed": 0.0621}).energy_fault(load=10.0) is None
    assert section.model_copy(update={"viscous": 150.1}).energy_fault(load=10.0) is None
    assert section.model_copy(update={"viscous": 150.1}).energy_fault(load=10.1) is not None
    par = surface_parameters(section)  # just at its bound neither is too little
    assert section.model_copy(update={"damping_speed": passive_damping_speed(par)}).energy_fault(load=10.0) is None
    assert section.model_copy(update={"viscous": passive_viscous(par, 10.0)}).energy_fault(load=10.0) is None
    assert SurfaceCoulomb(coefficient=0.3).energy_fault() is None


def test_energy_fault_names_the_joint():
    """Of several joints the first that may gain energy is named."""
    joints = JointLuGre(kinetic=[0.2, 0.2], static=[0.2, 0.3], stribeck_speed=0.01, stiffness=1e3, damping=1.0)
    assert "lugre of joint 1 may add energy" in joints.energy_fault(n=2)
