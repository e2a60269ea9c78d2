"""A contact is reached as any section is: by its name, by its number, or all; with --help, --explain and in sweeps."""

import pyarrow.parquet
import pytest

import closedloop as cl
from closedloop.command.sweep import main as sweep
from closedloop.mechanics.contacts.sections import ContactSection
from closedloop.scenario.messages import describe_section, explain_key, key_description, key_unit
from closedloop.scenario.tables import patches_of

NAME = "gripper_gear"


def frictions(changes):
    """Return the friction of every contact, with changes."""
    return [contact.friction for contact in cl.load_scenario(NAME, changes).contact]


def test_one_contact_by_name_or_number_or_all():
    """What is for one is laid over what is for all, whichever is given first."""
    usual = frictions({})
    for key, changed in (
        ("contact.floor left.friction", [4]),
        ("contact.0.friction", [0]),
        ("contact.*.friction", range(6)),
    ):
        assert frictions({key: 0.25}) == [0.25 if i in changed else usual[i] for i in range(6)]
    both = {"contact.left above.friction": 0.2, "contact.*.friction": 0.1}
    assert frictions(both) == frictions(dict(reversed(both.items()))) == [0.1, 0.2, 0.1, 0.1, 0.1, 0.1]


def test_a_contact_without_a_name_and_one_whose_name_has_dots():
    """The one is called contact 1 as in columns, of the other the longest name counts; sections in it are reached."""
    tables = [{"link": "left_tip"}, {"link": "left_tip", "name": "a.b"}, {"link": "left_tip", "name": "a"}]
    changes = {
        "contact": tables,
        "contact.contact 1.friction": 0.1,
        "contact.a.b.friction": 0.2,
        "contact.a.friction": 0.3,
    }
    assert frictions(changes) == [0.1, 0.2, 0.3]
    changes = {"contact": tables, "contact.1.surface.radius": 0.2, "contact.1.surface.kind": "sphere"}
    contacts = cl.load_scenario(NAME, changes).contact
    assert (contacts[1].surface.radius, contacts[0].surface) == (0.2, None)
    again = {"contact": contacts, "contact.1.surface.kind": "plane"}  # which knows no radius
    assert cl.load_scenario(NAME, again).contact[1].surface.kind == "plane"


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("contact.friction", "which contact? 'contact.0.friction' or 'contact.left below.friction' or 'contact.*."),
        ("contact.6.friction", "there is no contact '6'; there are 'left below' (0), "),
        ("contact.0", "which key of it?"),
        ("contact.0.mu", "did you mean 'contact[0].friction'?"),
        ("contact.0.friction.x", "'friction' is not a section"),
    ],
)  # fmt: skip
def test_what_names_no_contact_is_refused(key, words):
    """The line says which there are."""
    with pytest.raises(cl.ScenarioError) as refused:
        cl.load_scenario(NAME, {key: 0.1})
    assert words in str(refused.value)


def test_points_of_one_table_are_listed_by_its_name():
    """Twenty corners of five boxes are five names."""
    words = r"there is no contact 'box9'; there are 'box 1' \(0 to 3\), .*'box 5' \(16 to 19\)$"
    with pytest.raises(cl.ScenarioError, match=words):
        cl.load_scenario("tower", {"contact.box9.friction": 0.3})


def test_no_contacts_and_two_of_a_name():
    """Neither is guessed at."""
    with pytest.raises(cl.ScenarioError, match=r"the scenario has no \[\[contact\]\]"):
        cl.load_scenario("wam_slide", {"contact.0.friction": 0.1})
    twice = [{"link": "left_tip", "name": "a"}] * 2
    with pytest.raises(cl.ScenarioError, match=r"the name 'a' is that of contact.0 and contact.1: use the number"):
        cl.load_scenario(NAME, {"contact": twice, "contact.a.friction": 0.1})


def test_help_and_explain_know_contacts():
    """Under its own name, and a section in it under that of the section."""
    assert all(f"--contact.N.{name} (" in describe_section("contact") for name in ContactSection.model_fields)
    assert explain_key("contact.friction").startswith("contact.friction: Coulomb's coefficient")
    assert (
        explain_key("contact.floor left.friction")
        == explain_key("contact.*.friction")
        == explain_key("contact.friction")
    )
    assert explain_key("contact.0.surface.radius") == explain_key("surface.radius")
    assert key_unit("contact.floor left.surface.radius") == "m"
    assert key_description("contact.0.restitution").startswith("coefficient of restitution")


def test_a_sweep_over_a_contact(command_line, tmp_path):
    """The column has the key's name and meaning, and each run its value; the command line takes the keys too."""
    words = (
        "--time.duration",
        "0.01",
        "--over",
        "contact.floor left.friction=0.1,0.3",
        "--over",
        "contact.*.restitution=0,0.5",
    )
    assert (
        command_line(NAME, "--contact.floor left.friction", "0.3", "--time.duration", "0.002", "--no-figures").status
        == 0
    )
    assert sweep([NAME, *words, "--engine", "pinocchio", "--out", str(tmp_path / "s.parquet")]) == 0
    table = pyarrow.parquet.read_table(tmp_path / "s.parquet")
    assert table["contact.floor left.friction"].to_pylist() == [0.1, 0.1, 0.3, 0.3]
    assert table["contact.*.restitution"].to_pylist() == [0.0, 0.5, 0.0, 0.5]
    assert b"Coulomb" in table.schema.field("contact.floor left.friction").metadata[b"meaning"]
    assert set(table["status"].to_pylist()) == {"done"}


def test_a_list_of_points_is_a_contact_for_each():
    """Each has a name and a number; the name of the table is that of all of them."""
    feet = [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]
    tables = [{"link": "left_tip", "name": "floor", "at": feet}, {"link": "left_tip", "at": feet[:2]}]
    contacts = cl.load_scenario(NAME, {"contact": tables}).contact
    assert [contact.name for contact in contacts] == ["floor 1", "floor 2", "floor 3", "contact 2 1", "contact 2 2"]
    assert [list(contact.at) for contact in contacts] == feet + feet[:2]
    for key, changed in (
        ("contact.floor.friction", [0, 1, 2]),
        ("contact.floor 2.friction", [1]),
        ("contact.4.friction", [4]),
    ):
        assert frictions({"contact": tables, key: 0.7}) == [0.7 if i in changed else 0.0 for i in range(5)]
        assert frictions({"contact": contacts, key: 0.7}) == frictions({"contact": tables, key: 0.7})
    with pytest.raises(cl.ScenarioError, match=r"contact\[1\]\.at = \[1\.0, 2\.0\]: must be three numbers"):
        cl.load_scenario(NAME, {"contact": [{"link": "left_tip", "at": [[0.0, 0.0, 0.0], [1.0, 2.0]]}]})


def test_a_list_of_points_takes_the_place_of_the_list_that_was_there():
    """By the table's name; others stay, what is added is as the last, and a read scenario answers alike."""
    feet = [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]
    tables = [{"link": "left_tip", "name": "floor", "at": feet, "friction": 0.4}, {"link": "left_tip", "name": "knee"}]
    wanted = [[0.2, 0.0, 0.0], [-0.2, 0.0, 0.0], [0.0, 0.2, 0.0]]
    for start in (tables, cl.load_scenario(NAME, {"contact": tables}).contact):
        changes = {"contact": start, "contact.floor.at": wanted, "contact.floor 2.friction": 0.3}
        contacts = cl.load_scenario(NAME, changes).contact
        assert [contact.name for contact in contacts] == ["floor 1", "floor 2", "floor 3", "knee"]
        assert [list(contact.at) for contact in contacts[:3]] == wanted
        assert [contact.friction for contact in contacts] == [0.4, 0.3, 0.4, 0.0]
        fewer = cl.load_scenario(NAME, {"contact": start, "contact.floor.at": wanted[:1]}).contact
        assert [contact.name for contact in fewer] == ["floor 1", "knee"]
    spread = cl.load_scenario(NAME, {"contact": tables, "contact.knee.at": wanted, "contact.0.at": [0.0, 0.0, 0.5]})
    assert [contact.name for contact in spread.contact] == ["floor 1", "floor 2", "knee 1", "knee 2", "knee 3"]
    assert list(spread.contact[0].at) == [0.0, 0.0, 0.5]
    both = cl.load_scenario(NAME, {"contact": tables, "contact.*.at": wanted}).contact
    assert [contact.name for contact in both] == [f"{name} {k}" for name in ("floor", "knee") for k in (1, 2, 3)]


def test_contacts_without_names_are_not_points_of_one():
    """Of two corners called "foot 1" and "foot 2" a figure draws the sum; two contacts without names stay apart."""
    points = [
        {"link": "wam/wrist", "name": name} for name in ("", "", "foot 1", "foot 2", "contact 5 1", "contact 5 2")
    ]
    sections = tuple(ContactSection.model_validate(point) for point in points)
    assert patches_of(sections) == {"contact 1": [0], "contact 2": [1], "foot": [2, 3], "contact 5": [4, 5]}
