"""Files given as scenarios: read if they are one, refused at once and in one line whatever else they are."""

import pytest

import closedloop as cl

MINIMAL = "[law]\nkp = 1\nkd = 1\n"


def refused(path):
    """Return the one line with which a file is refused."""
    with pytest.raises(cl.ScenarioError) as caught:
        cl.load_scenario(path)
    assert str(caught.value).isprintable()
    return str(caught.value)


def test_folder_is_refused(tmp_path):
    """A folder is named as one."""
    assert "is a folder" in refused(tmp_path)


def test_byte_order_mark_is_no_part_of_the_text(tmp_path):
    """Editors on Windows write one."""
    file = tmp_path / "marked.toml"
    file.write_text(MINIMAL, encoding="utf-8-sig")
    assert cl.load_scenario(file).name == "marked"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a" + ".a" * 50_000 + " = 1", "a key has more than 20 parts"),
        ("[a" + " . 'a'" * 20_000 + "]", "a key has more than 20 parts"),
        ("a = " + "[" * 100_000, "nested too deeply"),
        ("a = " + "{a = " * 20_000, "nested too deeply"),
        ("a = 1\na = 2\n", "not valid TOML"),
        (MINIMAL + "force = 0x" + "f" * 10_000, "law.force = a number of thousands of digits: must be"),
        (MINIMAL + "[start]\nq = [0x" + "f" * 10_000 + "]", "start.q[0] = a number of thousands of digits: must"),
        ("x" * 100_000 + " = 1\n" + MINIMAL, "unknown key 'xxxx"),
        ("[reference]\nkind = '" + "x" * 100_000 + "'\n" + MINIMAL, "reference.kind = 'xxxx"),
        ("[reference]\nkind = [" + "1, " * 1000 + "]\n" + MINIMAL, "reference.kind = "),
    ],
    ids=lambda text: text[:30],
)  # fmt: skip
def test_text_made_to_last_is_refused_soon_and_shortly(text, words, tmp_path):
    """Deep nesting, dotted keys without end, numbers that Python does not write out: refused, and shown shortly."""
    file = tmp_path / "odd.toml"
    file.write_text(text)
    line = refused(file)
    assert words in line
    assert len(line) < 500


def test_value_nested_too_deeply_for_an_override():
    """A table handed over in Python may be deeper than Python can copy."""
    deep: list = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(cl.ScenarioError, match="nested too deeply"):
        cl.load_scenario("wam_slide", {"law.kp": deep})
    while deep:  # else Python's own clean-up would go as deep
        deep = deep.pop()
