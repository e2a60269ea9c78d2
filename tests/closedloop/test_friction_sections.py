"""What a scenario may say of friction, what it may not, and the arrays that come of it."""

import importlib
import re

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

import closedloop as cl
import closedloop.friction
from closedloop.figures.friction_laws import draw
from closedloop.friction import KINDS, JointFriction, SurfaceFriction, energy_fault, pack
from closedloop.friction.layout import (
    DAMPING_SPEED,
    KINETIC,
    PARAMETERS,
    STATIC,
    STATIC_EXCESS,
    STRIBECK_SPEED,
    VISCOUS,
)
from closedloop.friction.packing import PLACES
from closedloop.friction.sections import (
    JointCoulombViscous,
    JointDahl,
    JointLuGre,
    JointSevenParameter,
    JointStribeck,
    NoFriction,
    SurfaceCoulomb,
    SurfaceDahl,
    SurfaceLuGre,
    SurfaceSevenParameter,
    SurfaceStribeck,
    names_of,
)

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
    """Return (family, section type) for every section of both unions."""
    return [
        (family, section)
        for family, union in (("surface", SurfaceFriction), ("joint", JointFriction))
        for section in union.__origin__.__args__
    ]


def example(section):
    """Return a section of this type with every required parameter."""
    wanted = {name: FIGURES[name] for name, field in section.model_fields.items() if field.is_required()}
    return section(**wanted)


def fault(union, data):
    """Return where pydantic finds fault with the data of a section, and in which words."""
    with pytest.raises(ValidationError) as caught:
        TypeAdapter(union).validate_python(data)
    first = caught.value.errors()[0]
    return ".".join(map(str, first["loc"])), str(first.get("ctx", {}).get("error", first["msg"]))


@pytest.mark.parametrize("union", [SurfaceFriction, JointFriction])
def test_every_law_has_a_section(union):
    """Both families have one section a law, told apart by its name."""
    assert [section.model_fields["kind"].default for section in union.__origin__.__args__] == list(KINDS)


@pytest.mark.parametrize(("family", "section"), families())
def test_every_parameter_is_described_and_packed(family, section):
    """Each parameter has a description with a unit, and a column of its own that gets its value."""
    given = example(section)
    kind, par = pack(given, 3 if family == "joint" else None)
    assert kind == KINDS[given.kind]
    assert par.shape == ((3, PARAMETERS) if family == "joint" else (PARAMETERS,))
    assert not par.flags.writeable
    columns = [PLACES[name] for name in names_of(given)]
    assert len(set(columns)) == len(columns)
    for name in names_of(given):
        field = section.model_fields[name]
        assert name == "exponent" or re.search(UNIT, field.description), name
        value = getattr(given, name)
        if value is not None:
            assert np.all(par[..., PLACES[name]] == value), name


def test_what_a_law_lacks_is_harmless():
    """A law without a static level sticks at its kinetic one; a speed that is not given is infinite."""
    _, par = pack(SurfaceDahl(coefficient=0.4, stiffness=1e4))
    assert par[STATIC] == par[KINETIC] == 0.4
    assert par[STRIBECK_SPEED] == par[DAMPING_SPEED] == np.inf
    _, par = pack(example(SurfaceSevenParameter))
    assert par[STATIC] == pytest.approx(par[KINETIC] + par[STATIC_EXCESS])
    assert not np.any(pack(NoFriction())[1][:STRIBECK_SPEED])


def test_joints_may_differ():
    """One number goes to all joints, a list to each its own."""
    _, par = pack(JointCoulombViscous(kinetic=[0.5, 0.4, 0.3], viscous=0.1), 3)
    assert par[:, KINETIC] == pytest.approx([0.5, 0.4, 0.3])
    assert par[:, VISCOUS] == pytest.approx([0.1, 0.1, 0.1])


def test_list_of_the_wrong_length():
    """A list that does not fit the robot is refused with its name, its length and the right one."""
    section = JointCoulombViscous(kinetic=[0.5, 0.4], viscous=0.1)
    with pytest.raises(cl.ScenarioError, match=r"^joint_friction\.kinetic has 2 entries: must be one number or 4, one"):
        pack(section, 4, "joint_friction")


@pytest.mark.parametrize(
    ("union", "data", "where", "words"),
    [
        (
            SurfaceFriction,
            {"kind": "coulomb", "coefficient": -0.1},
            "coulomb.coefficient",
            "greater than or equal to 0",
        ),
        (SurfaceFriction, {"kind": "coulomb", "coefficient": "0.1"}, "coulomb.coefficient", "must be a number"),
        (SurfaceFriction, {"kind": "coulomb", "mu": 0.1}, "coulomb.coefficient", "Field required"),
        (SurfaceFriction, {"kind": "rubber"}, "", "'rubber'|seven_parameter"),
        (
            SurfaceFriction,
            {"kind": "stribeck", "kinetic": 0.3, "static": 0.2, "stribeck_speed": 0.01},
            "stribeck.static",
            "must not be below kinetic, 0.3: static friction is the larger",
        ),
        (
            SurfaceFriction,
            {"kind": "stribeck", "kinetic": 0.2, "static": 0.3, "stribeck_speed": 0.0},
            "stribeck.stribeck_speed",
            "greater than 0",
        ),
        (
            SurfaceFriction,
            {"kind": "lugre", "kinetic": 0.0, "static": 0.3, "stribeck_speed": 0.1, "stiffness": 1e4, "damping": 0.0},
            "lugre.kinetic",
            "greater than 0",
        ),
        (SurfaceFriction, {"kind": "dahl", "coefficient": 0.3, "stiffness": -1.0}, "dahl.stiffness", "greater than 0"),
        (
            JointFriction,
            {"kind": "coulomb", "kinetic": [0.1, -0.2]},
            "coulomb.kinetic",
            "entry 1 is -0.2: must not be negative",
        ),
        (JointFriction, {"kind": "coulomb", "kinetic": -0.2}, "coulomb.kinetic", "must not be negative"),
        (
            JointFriction,
            {"kind": "stribeck", "kinetic": [0.1, 0.2], "static": [0.2, 0.1], "stribeck_speed": 0.1},
            "stribeck.static",
            "entry 1 is 0.1: must not be below kinetic, 0.2: static friction is the larger",
        ),
        (
            JointFriction,
            {"kind": "stribeck", "kinetic": [0.1, 0.2], "static": [0.2, 0.3, 0.3], "stribeck_speed": 0.1},
            "stribeck.static",
            "must have as many entries as kinetic, 2",
        ),
        (
            JointFriction,
            {"kind": "stribeck", "kinetic": 0.1, "static": 0.2, "stribeck_speed": [0.1, 0.0]},
            "stribeck.stribeck_speed",
            "entry 1 is 0: must be greater than 0",
        ),
    ],
)
def test_bad_figures_are_refused(union, data, where, words):
    """What cannot be is refused at the key that is at fault, with what would be right."""
    place, message = fault(union, data)
    assert place == where
    assert any(part in message for part in words.split("|"))
    assert "\n" not in message


def test_static_friction_may_equal_kinetic():
    """The edge itself is allowed: static friction no larger than kinetic is Coulomb's."""
    section = SurfaceStribeck(kinetic=0.3, static=0.3, stribeck_speed=0.01)
    assert pack(section)[1][STATIC] == 0.3
    assert JointStribeck(kinetic=[0.1, 0.2], static=0.2, stribeck_speed=0.1).static == 0.2


def test_energy_fault_says_what_would_be_right():
    """LuGre with constant damping is named with the two cures, and either of them, as printed, is one."""
    section = SurfaceLuGre(kinetic=0.2, static=0.3, stribeck_speed=1e-3, stiffness=1e4, damping=30.0)
    message = energy_fault(section, load=10.0)
    assert "lugre may add energy at high speed" in message
    assert "damping_speed = 0.0622 m/s or less" in message  # 4 √(2e) 0.2/30
    assert "viscous = 150 N s/m or more" in message  # 10 N × 30 × (0.3 − 0.2)/0.2
    assert energy_fault(section.model_copy(update={"damping_speed": 0.0621}), load=10.0) is None
    assert energy_fault(section.model_copy(update={"viscous": 150.1}), load=10.0) is None
    assert energy_fault(section.model_copy(update={"viscous": 150.1}), load=10.1) is not None
    assert energy_fault(SurfaceCoulomb(coefficient=0.3)) is None


def test_energy_fault_names_the_joint():
    """Of several joints the first that may gain energy is named."""
    joints = JointLuGre(kinetic=[0.2, 0.2], static=[0.2, 0.3], stribeck_speed=0.01, stiffness=1e3, damping=1.0)
    assert "lugre of joint 1 may add energy" in energy_fault(joints, n=2)


@pytest.mark.parametrize(("family", "section"), families())
def test_every_law_is_drawn(family, section, tmp_path):
    """Every section is drawn into a file, and on axes given."""
    from matplotlib.figure import Figure

    draw(example(section), tmp_path / "law.png", load=1.0 if family == "joint" else 10.0)
    assert (tmp_path / "law.png").stat().st_size > 5000
    axes = Figure().add_subplot()
    draw(example(section), axes)
    assert axes.lines
    assert axes.get_title().startswith(section.model_fields["kind"].default)
    for line in axes.lines:
        values = np.asarray(line.get_ydata(), dtype=float)
        assert np.any(np.isfinite(values))


def test_joints_that_differ_are_drawn_apart():
    """Joints of different figures have a line each, with their number."""
    from matplotlib.figure import Figure

    for section in (
        JointDahl(kinetic=[0.2, 0.5, 0.3], stiffness=1e3),
        JointSevenParameter(
            kinetic=0.2,
            static_excess=(0.1, 0.2, 0.3),
            stribeck_speed=0.1,
            stiffness=1e3,
            memory_delay=0.0,
            rise_time=1.0,
        ),
        JointCoulombViscous(kinetic=(0.1, 0.2, 0.3), viscous=0.1),
    ):
        axes = Figure().add_subplot()
        draw(section, axes)
        labels = {text.get_text() for text in axes.get_legend().get_texts()}
        assert {"joint 0", "joint 1", "joint 2"} <= labels


def test_file_that_cannot_be_written(tmp_path):
    """A folder that is not there, or a kind of file unknown, is one line."""
    for name in ("missing/law.png", "law.xyz"):
        with pytest.raises(cl.errors.OutputError, match="cannot be written") as caught:
            draw(NoFriction(), tmp_path / name)
        assert "\n" not in str(caught.value)


def test_public_names_are_there():
    """Every name that the package offers exists, and reading it twice gives the same thing."""
    for name in closedloop.friction.__all__:
        assert getattr(closedloop.friction, name) is getattr(importlib.import_module("closedloop.friction"), name)
    with pytest.raises(AttributeError, match="no attribute 'stiction'"):
        _ = closedloop.friction.stiction
