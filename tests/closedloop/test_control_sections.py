"""What [law], [compensation] and [sensor] may say, and what becomes of it."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import Field, TypeAdapter, ValidationError

from closedloop.control import parameters as places
from closedloop.control.pack import pack_law
from closedloop.control.sections import (
    AdaptiveCompensationSection,
    AdmittanceLawSection,
    CompensationSection,
    DynamicHybridLawSection,
    ForceLawSection,
    HybridLawSection,
    ImpedanceLawSection,
    ModelCompensationSection,
    NoCompensationSection,
    ObserverCompensationSection,
    OperationalSpaceLawSection,
    PaperLawSection,
    SensorSection,
)
from closedloop.errors import ScenarioError

LAWS = (
    PaperLawSection(kp=400.0, kd=30.0),
    HybridLawSection(kp=400.0, kd=30.0),
    OperationalSpaceLawSection(),
    DynamicHybridLawSection(),
    ImpedanceLawSection(),
    AdmittanceLawSection(),
)
COMPENSATIONS = (
    NoCompensationSection(),
    ModelCompensationSection(),
    ObserverCompensationSection(),
    AdaptiveCompensationSection(),
)


def test_every_kind_has_a_section_and_every_section_a_kind():
    """Laws and compensations by name are exactly those that a scenario may name, the paper's included."""
    assert {law.kind for law in LAWS} == set(places.LAWS)
    assert {section.kind for section in COMPENSATIONS} == set(places.COMPENSATIONS)
    assert {type(law) for law in LAWS[1:]} == set(ForceLawSection.__args__)
    assert {type(section) for section in COMPENSATIONS} == set(CompensationSection.__args__)


@pytest.mark.parametrize("section", [*LAWS[1:], *COMPENSATIONS, SensorSection()], ids=lambda s: type(s).__name__)
def test_every_key_says_what_it_is(section):
    """Every key but `kind` has a description."""
    for key, field in type(section).model_fields.items():
        assert key == "kind" or len(field.description) > 10


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.kind)
def test_number_of_states(law):
    """One state for the integral, two for the admittance, n for the observer, two for the adaptation, and no others."""
    own = 2 if law.kind == "admittance" else 0
    for section, more in zip(COMPENSATIONS, (0, 0, 7, 2), strict=True):
        packed = pack_law(law, section, 7)
        assert packed.states == own + more
        assert packed.par.shape == (places.PARAMETERS + 14,)
        assert packed.gains.shape == (2, 7)
        if law.kind != "paper":
            integral = law.model_copy(update={"force_integral": 5.0})
            assert pack_law(integral, section, 7).states == own + more + 1


def test_lists_give_each_joint_its_own():
    """One number serves all joints; a list must have one entry a joint, and the refusal counts them."""
    packed = pack_law(HybridLawSection(kp=(1.0, 2.0, 3.0), kd=5.0), None, 3)
    assert np.array_equal(packed.gains, [[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])
    with pytest.raises(ScenarioError, match=r"law\.kp has 3 entries: the robot has 2 joints, a, b"):
        pack_law(HybridLawSection(kp=(1.0, 2.0, 3.0), kd=5.0), None, 2, joint_names=("a", "b"))
    with pytest.raises(ScenarioError, match=r"law\.posture_damping has 1 entries: the robot has 2 joints"):
        pack_law(OperationalSpaceLawSection(posture_damping=(1.0,)), None, 2)
    model = ModelCompensationSection(joint_coulomb=(0.1, 0.2), joint_viscous=0.3)
    assert pack_law(OperationalSpaceLawSection(), model, 2).par[places.PARAMETERS :] == pytest.approx(
        [0.1, 0.2, 0.3, 0.3]
    )
    with pytest.raises(ScenarioError, match=r"compensation\.joint_coulomb has 2 entries"):
        pack_law(OperationalSpaceLawSection(), model, 3)


def test_adaptation_must_be_slower_than_the_damping():
    """`corner` below `motion_damping` is what the proof of convergence asks for; the refusal says so."""
    law = OperationalSpaceLawSection(motion_damping=15.0)
    pack_law(law, AdaptiveCompensationSection(corner=14.9), 4)
    with pytest.raises(ScenarioError, match=r"compensation\.corner = 20: must be below law\.motion_damping, 15"):
        pack_law(law, AdaptiveCompensationSection(), 4)


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
        TypeAdapter(Annotated[ForceLawSection, Field(discriminator="kind")]).validate_python(data)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "x"])
def test_seed_is_a_whole_number(seed):
    """A seed that numpy would refuse, or quietly round, is refused here."""
    with pytest.raises(ValidationError, match="must be a whole number, 0 or above"):
        SensorSection(seed=seed)


def test_static_friction_is_the_larger():
    """The believed static coefficient is the kinetic one unless given, and not below it."""
    par = pack_law(OperationalSpaceLawSection(), ModelCompensationSection(kinetic=0.3), 2).par
    assert par[places.STATIC] == par[places.KINETIC] == 0.3
    with pytest.raises(ValidationError, match=r"must not be below kinetic, 0\.3"):
        ModelCompensationSection(kinetic=0.3, static=0.2)


def test_an_instance_of_the_sections_survives_its_own_text():
    """What a section dumps, it reads back to an equal one: a scenario is repeated from its text."""
    for section in (*LAWS[1:], *COMPENSATIONS, SensorSection(seed=4, noise=0.1)):
        assert type(section)(**section.model_dump(exclude_none=True)) == section
