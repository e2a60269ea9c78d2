"""What textbooks and other simulators call a key: a refusal names the key that is meant, wherever keys are named."""

import pytest

import closedloop as cl
from closedloop.command.sweep import main as sweep
from closedloop.scenario import messages
from closedloop.scenario.messages import all_keys, explain_key, sections
from closedloop.scenario.scenario import Scenario
from closedloop.scenario.tables import described_key

MEANT = {
    "friction.mu": "friction.coefficient", "law.Kp": "law.kp", "law.kv": "law.kd", "law.mu": "friction.coefficient",
    "time.dt": "time.step", "time.step_size": "time.step", "time.timestep": "time.step", "time.T": "time.duration",
    "time.tend": "time.duration", "start.pose": "start.q", "compliance.k": "compliance.stiffness",
    "stabiliser.zeta": "stabiliser.damping_ratio", "simulation.dt": "time.step", "controller.Kp": "law.kp",
    "transmission.c": "transmission.damping", "impact.e": "impact.restitution", "law.ki": "law.force_integral",
}  # fmt: skip


@pytest.mark.parametrize("word", MEANT)
def test_another_name_of_a_key_is_understood(word):
    """In a file and in Python; where another kind has the key, its kinds are named."""
    with pytest.raises(cl.ScenarioError) as refused:
        cl.load_scenario("wam_slide", {word: 0.5})
    assert f"did you mean '{MEANT[word]}'?" in str(refused.value)
    if word in ("friction.mu", "compliance.k"):
        assert "kind is 'none' where it is not given" in str(refused.value)
    with pytest.raises(cl.ScenarioError, match="did you mean"):
        explain_key(word)


MISSPELT = {
    "friction.coeficient": ("coefficient", "'none' where it is not given", "'coulomb'"),
    "law.stifness": ("stiffness", "'paper'", "'impedance'"),
    "surface.radus": ("radius", "'plane'", "'capsule'"),  # a plane's edge_radius is less like it
}


@pytest.mark.parametrize("word", MISSPELT)
def test_a_misspelt_key_of_another_kind_is_understood(word):
    """It is named with the kinds that have it, where this kind has nothing more like it."""
    name, kind, other = MISSPELT[word]
    with pytest.raises(cl.ScenarioError) as refused:
        cl.load_scenario("wam_slide", {word: 0.5})
    section = word.partition(".")[0]
    meant = f"unknown key '{word}'; did you mean '{section}.{name}'? "
    assert f"{meant}{section}.kind is {kind}, and {name} is a key of {other}" in str(refused.value)


def test_on_the_command_line_and_in_a_sweep(command_line, capsys):
    """An option without a section too."""
    assert "did you mean 'friction.coefficient'" in command_line("wam_slide", "--friction.mu", "0.3").refusal()
    assert command_line("wam_slide", "--dt", "1e-3").refusal().endswith("did you mean --time.step?")
    assert command_line("wam_slide", "--explain", "mu").refusal().endswith("did you mean 'friction.coefficient'?")
    assert sweep(["wam_slide", "--over", "friction.mu=0.1,0.2"]) == 2
    assert "did you mean 'friction.coefficient'" in capsys.readouterr().err


def test_every_other_name_leads_to_a_key_that_there_is():
    """A key that is renamed leaves no line behind; and what is a key of every kind is no other's name."""
    names = {key.partition(".")[2] for key in all_keys()}
    for word, meant in messages._other_words()["keys"].items():
        assert set(meant) <= names, word
        assert word == word.lower()
        assert word not in meant
    assert set(messages._other_words()["sections"].values()) <= set(sections())
    assert not set(messages._other_words()["sections"].keys() - {"stiffness", "friction"}) & set(Scenario.model_fields)
    assert all(described_key(key) == key for key in all_keys())
