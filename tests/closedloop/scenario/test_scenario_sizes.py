"""How large and how small the numbers of a scenario may be: refused beyond with the unit and the reason."""

import itertools
import re

import numpy as np
import pytest

import closedloop as cl
from closedloop.base.errors import LONGEST_LINE, one_line
from closedloop.base.sections import Section, Size, field_units, is_left_out, sizes
from closedloop.control.sensor import MOST_QUANTA, SensorSection, pack_sensor, sense
from closedloop.jit.interpreted import interpreted
from closedloop.scenario.messages import explain_key, variants
from closedloop.scenario.scenario import Scenario

# Numbers of any size: instants beyond the end of a run, and what has a bound or a check of its own.
ANY = {
    "start",
    "stop",
    "at",
    "pd_start",
    "times",
    "direction",
    "normal",
    "axis",
    "restitution",
    "stop_restitution",
    "passes",
    "seed",
    "tolerance",
}


def numbers():
    """Return (section, key, field) of every key of the project that takes a number, but for what tests have added."""
    for section in Scenario.model_fields:
        for variant in [each for each in variants(section).values() if each.__module__.startswith("closedloop.")]:
            for key, field in variant.model_fields.items():
                if re.search(r"\b(float|int)\b", str(field.annotation)) and not is_left_out(field):
                    yield section, key, field


def test_every_number_of_a_scenario_has_a_size():
    """A key that is added takes one too, or is named above with the reason."""
    found = {(section, key) for section, key, field in numbers()}
    assert len(found) > 60
    for section, key, field in numbers():
        own = [part for part in field.metadata if isinstance(part, Size)] or list(sizes(field.annotation))
        assert own or key in ANY, (section, key)


def test_every_number_of_a_scenario_has_one_unit():
    """Labels and tables take it from the field; help, which people read, says the same one."""
    for section, key, field in numbers():
        units = field_units(field)
        assert len(units) == 1, (section, key, units)
        unit = units.pop()
        assert not unit or re.search(rf", {re.escape(unit.partition(' (')[0])}(?=$|[,;:( ])", field.description), key


def test_help_says_the_sizes():
    """--explain has them."""
    assert "from 1e-09 to 1000 s" in explain_key("time.step")
    assert "at most 1e+06 m" in explain_key("surface.offset")
    assert "at most 1e+06 rad (m)" in explain_key("robot.lock")


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"law.force": 1e308}, "law.force = 1e+308: must be at most 1e+09 N: no arm presses so hard"),
        ({"law.force": -1e10}, "law.force = -10000000000.0: must be at least -1e+09 N: no arm presses so hard"),
        ({"law.kp": [1, 2, 1e300, 4]}, "law.kp = [1, 2, 1e+300, 4]: entry 2 is 1e+300: must be at most 1e+12 N m/rad:"),
        ({"law.kd": 1e308}, "law.kd = 1e+308: must be at most 1e+12 N m s/rad: no drive is so stiff"),
        ({"time.step": 1e-12}, "time.step = 1e-12: must be at least 1e-09 s: rounding of time would show in it"),
        ({"stabiliser.time_constant": 5e-324}, "stabiliser.time_constant = 5e-324: must be at least 1e-09 s"),
        ({"stabiliser.time_constant": -(10**400)}, "must be greater than 0 and finite"),
        ({"stabiliser.time_constant": 10**400}, "must be greater than 0 and finite"),
        ({"stabiliser.damping_ratio": 1e308}, "stabiliser.damping_ratio = 1e+308: must be at most 1e+06: no closure"),
        ({"sensor.quantisation": 1e-308}, "sensor.quantisation = 1e-308: must be at least 1e-12 N: no sensor is"),
        ({"sensor.noise": 2**63}, "sensor.noise = 9223372036854775808: must be at most 1e+09 N"),
        ({"surface.offset": 1e300}, "surface.offset = 1e+300: must be at most 1e+06 m: no arm reaches so far"),
        ({"robot.lock": {"J3": 1e300}}, "robot.lock.J3 = 1e+300: must be at most 1e+06 rad (m)"),
        ({"law.sample_period": 2**63 - 1}, "law.sample_period = 9223372036854775807: must be at most 1e+09 s"),
    ],
)  # fmt: skip
def test_number_beyond_its_size_is_refused_with_unit_and_reason(changes, line):
    """One line: the key, the value, the bound in its unit, and why."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario("wam_slide", changes)
    assert line in str(caught.value)


def test_the_edges_of_a_size_belong_to_it():
    """The bounds themselves are accepted, zero too, the numbers next to them not; entries of a list alike."""
    size = Size(10.0, "m", "far", 0.5, "near")
    for value in (0.0, 0.5, 10.0, -0.5, -10.0):
        assert size.check(value) == value
        assert size.check((value, 1.0)) == (value, 1.0)
    for value, sign in itertools.product((np.nextafter(0.5, 0.0), np.nextafter(10.0, 11.0)), (1.0, -1.0)):
        with pytest.raises(ValueError, match="must be"):
            size.check(sign * float(value))
    assert size.check("start") == "start"


def test_section_types_refuse_what_no_number_is():
    """A size is checked after the type: what is no number is refused as that."""
    with pytest.raises(cl.ScenarioError, match="must be a number"):
        cl.load_scenario("wam_slide", {"law.force": "1e400"})
    assert issubclass(SensorSection, Section)


def test_reading_of_more_quanta_than_digits_is_left_alone():
    """A coarse quantum rounds; one finer than the digits of a reading changes nothing."""
    for force, quantum in ((1e9, 1e-12), (1e9, 1e-6), (12.3456, 1e-3), (-12.3456, 0.5)):
        sensor = pack_sensor(SensorSection(quantisation=quantum), 1e-3)
        reading = interpreted(sense)(force, 0.0, 0, sensor.par, 0.0, np.zeros(sensor.ring))
        assert abs(reading - force) <= 0.5 * quantum + 1e-16 * abs(force)
        if abs(force) >= MOST_QUANTA * quantum:
            assert reading == force


def test_message_is_shortened_in_its_middle():
    """A name of any length leaves what is wrong and what would be right."""
    line = one_line(f"no frame {'x' * 100_000}: frames are tip")
    assert len(line) <= LONGEST_LINE + 10
    assert line.startswith("no frame x")
    assert line.endswith("frames are tip")
