"""What [law], [compensation] and [sensor] may say, and what becomes of it."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from closedloop.base.errors import ScenarioError
from closedloop.control import law as control
from closedloop.control.compensation.adaptive import AdaptiveCompensation
from closedloop.control.compensation.model import ModelCompensation
from closedloop.control.compensation.none import NoCompensation
from closedloop.control.compensation.normal import NormalCompensation
from closedloop.control.compensation.observer import ObserverCompensation
from closedloop.control.law import ControlLaw
from closedloop.control.laws.admittance import AdmittanceLaw
from closedloop.control.laws.dynamic_hybrid import DynamicHybridLaw
from closedloop.control.laws.hybrid import HybridLaw
from closedloop.control.laws.impedance import ImpedanceLaw
from closedloop.control.laws.none import NoLaw
from closedloop.control.laws.operational_space import OperationalSpaceLaw
from closedloop.control.laws.paper import PaperLaw
from closedloop.control.laws.servo_admittance import ServoAdmittanceLaw
from closedloop.control.sensor import SensorSection
from closedloop.jit.parameters import parameter_block
from closedloop.simulation.engines.scenario_numbers import pack_law

LAWS = (
    PaperLaw(kp=400.0, kd=30.0),
    HybridLaw(kp=400.0, kd=30.0),
    OperationalSpaceLaw(),
    DynamicHybridLaw(),
    ImpedanceLaw(),
    AdmittanceLaw(),
    ServoAdmittanceLaw(kp=400.0, kd=30.0),
    NoLaw(),
)
COMPENSATIONS = (
    NoCompensation(),
    ModelCompensation(),
    ObserverCompensation(),
    AdaptiveCompensation(),
    NormalCompensation(),
)


def test_every_kind_has_a_section_and_every_section_a_kind():
    """Laws and compensations by name are exactly those that a scenario may name, the paper's included."""
    for family, sections in ((control.LAWS, LAWS), (control.COMPENSATIONS, COMPENSATIONS)):
        assert {section.kind: type(section) for section in sections} == {kind: family[kind] for kind in family.names()}


@pytest.mark.parametrize("section", [*LAWS[1:], *COMPENSATIONS, SensorSection()], ids=lambda s: type(s).__name__)
def test_every_key_says_what_it_is(section):
    """Every key but `kind` has a description."""
    for key, field in type(section).model_fields.items():
        assert key == "kind" or len(field.description) > 10


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.kind)
def test_number_of_states(law):
    """One state for the integral of the force error, two for an admittance, and no others; none without a law."""
    assert pack_law(law, 7).states == {"admittance": 3, "servo_admittance": 3, "none": 0}.get(law.kind, 1)


@pytest.mark.parametrize(("section", "states"), list(zip(COMPENSATIONS, (0, 0, 7, 2, 2), strict=True)))
def test_number_of_states_of_a_compensation(section, states):
    """One for each joint for the observer, two for the adaptation and for the normal."""
    assert pack_law(section, 7).states == states


def values(section, n):
    """Return what the law's functions read, by name."""
    block = parameter_block(type(section))(pack_law(section, n).numbers, n)
    return {name: np.asarray(getattr(block, name)).tolist() for name in block.layout.at}


def test_lists_give_each_joint_its_own():
    """One number serves all joints; a list must have one entry a joint, and the refusal counts them."""
    law = HybridLaw(kp=(1.0, 2.0, 3.0), kd=5.0, approach_speed=0.07)
    read = values(law, 3)
    assert read["kp"] == [1.0, 2.0, 3.0]
    assert read["kd"] == [5.0, 5.0, 5.0]
    assert read["approach_speed"] == 0.07
    with pytest.raises(ScenarioError, match=r"law\.kp has 3 entries: the robot has 2 joints, a, b"):
        pack_law(law, 2, ("a", "b"))
    with pytest.raises(ScenarioError, match=r"law\.posture_damping has 1 entries: the robot has 2 joints"):
        pack_law(OperationalSpaceLaw(posture_damping=(1.0,)), 2)
    model = ModelCompensation(joint_coulomb=(0.1, 0.2), joint_viscous=0.3)
    assert values(model, 2)["joint_coulomb"] == [0.1, 0.2]
    assert values(model, 2)["joint_viscous"] == [0.3, 0.3]
    with pytest.raises(ScenarioError, match=r"compensation\.joint_coulomb has 2 entries"):
        pack_law(model, 3)


def test_adaptation_must_be_slower_than_the_damping():
    """`corner` below `motion_damping` is what the proof of convergence asks for; the refusal says so."""
    law = OperationalSpaceLaw(motion_damping=15.0)
    AdaptiveCompensation(corner=14.9).check(law)
    with pytest.raises(ScenarioError, match=r"compensation\.corner = 20: must be below law\.motion_damping, 15"):
        AdaptiveCompensation().check(law)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        ({"kind": "hybrid", "kp": 1.0}, "kd"),
        ({"kind": "hybrid", "kp": [1.0, -2.0], "kd": 1.0}, "entry 1 is -2: must not be negative"),
        ({"kind": "impedance", "posture_damping": -1}, "must not be negative"),
        ({"kind": "operational_space", "motion_damping": 0}, "greater than 0"),
        ({"kind": "admittance", "admittance_inertia": 0}, "greater than 0"),
        ({"kind": "admittance", "stiffness": 3}, "Extra inputs"),
        ({"kind": "dynamic_hybrid", "force": True}, "must be a number"),
        ({"kind": "dynamic_hybrid", "force_feedback": float("nan")}, "finite|greater than or equal"),
    ],
)
def test_laws_at_fault_are_refused(data, text):
    """Missing, unknown and impossible figures of a law."""
    with pytest.raises(ValidationError, match=text):
        TypeAdapter(Annotated[ControlLaw, control.LAWS]).validate_python(data)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "x"])
def test_seed_is_a_whole_number(seed):
    """A seed that numpy would refuse, or quietly round, is refused here."""
    with pytest.raises(ValidationError, match="must be a whole number, 0 or above"):
        SensorSection(seed=seed)


def test_static_friction_is_the_larger():
    """The believed static coefficient is the kinetic one unless given, and not below it."""
    read = values(ModelCompensation(kinetic=0.3), 2)
    assert read["static"] == read["kinetic"] == 0.3
    with pytest.raises(ValidationError, match=r"must not be below kinetic, 0\.3"):
        ModelCompensation(kinetic=0.3, static=0.2)


def test_an_instance_of_the_sections_survives_its_own_text():
    """What a section dumps, it reads back to an equal one: a scenario is repeated from its text."""
    for section in (*LAWS[1:], *COMPENSATIONS, SensorSection(seed=4, noise=0.1)):
        assert type(section)(**section.model_dump(exclude_none=True)) == section
