"""The language of README, CONTRIBUTING, pages and help: short sentences, no private words, long pages summarised."""

import inspect

import pytest
import style
from pages import PAGES, ROOT

import closedloop
from closedloop.command.table import COMMANDS
from closedloop.scenario import messages

STYLED = [*PAGES, ROOT / "CONTRIBUTING.md"]


def page_texts():
    """Return the text of each page by its name."""
    return {page.name: page.read_text(encoding="utf-8") for page in STYLED}


@pytest.mark.parametrize("text", page_texts().values(), ids=list(page_texts()))
def test_a_page_is_written_in_plain_sentences(text):
    """No sentence is too long, no word is private, and a long page begins with a summary."""
    assert style.long_sentences(text) == []
    assert style.words_not_used(text) == []
    assert not style.too_long(text), f"{style.too_long(text)} words: shorten it, or begin it with {style.SUMMARY}"


LONG = " ".join(["word"] * 41)


def test_a_long_sentence_is_seen():
    """In a paragraph of several lines, in an item of a list, behind a short sentence, and as a link."""
    lines, item, behind = LONG.replace(" ", "\n", 3), f"- item\n- {LONG}", f"Short. {LONG.capitalize()}."
    for text in (LONG, lines, item, behind, f"[{LONG}](a.md)"):
        assert [number for number, _ in style.long_sentences(text)] == [41], text
    assert style.long_sentences(LONG.removesuffix(" word")) == []


def test_only_prose_is_counted():
    """Code, tables, headings and formulas are no sentences; code and formulas in a sentence are one word each."""
    fence = f"```text\n{LONG}\n```"
    for text in (fence, f"| {LONG} |", f"# {LONG}", f"a\n\n    {LONG}", f"$$\n{LONG}\n$$", f"`{LONG}` and ${LONG}$"):
        assert style.long_sentences(text) == [], text


def test_sentences_end_where_a_reader_ends_them():
    """A number behind an abbreviation goes on with the sentence; a symbol or code may begin one."""
    assert style.sentences("Eq. 24 holds. f is its multiplier. `x` too.") == [
        "Eq. 24 holds.",
        "f is its multiplier.",
        "CODE too.",
    ]


@pytest.mark.parametrize(
    "said",
    [
        "The equations do not mind; a picture does.",
        "Each of these can be given up.",
        "What the controller believes and is not so.",
        "Rows are located no more.",
        "A rebound slower than 1e-4 rad/s is none.",
        "The file says which function is asked when.",
    ],
)
def test_a_word_that_is_not_used_is_seen(said):
    """Sentences that a reader who had never seen the project did not understand; as code they are none."""
    assert len(style.words_not_used(f"Before.\n{said}")) == 1
    assert style.words_not_used(f"`{said}`\n\n```\n{said}\n```") == []


def test_a_page_that_is_too_long_is_seen():
    """Words of code do not count; a summary has to be the first section, and does not help beyond the limit."""
    words = "word " * (style.MOST_WITHOUT_SUMMARY + 1)
    assert style.too_long(words) == style.MOST_WITHOUT_SUMMARY + 1
    assert style.too_long(f"# Page\n\n## Other\n\n## Summary\n\n{words}")
    assert not style.too_long(f"# Page\n\n## Summary\n\n{words}")
    assert style.too_long("## Summary\n" + "word " * style.MOST_WORDS_ON_A_PAGE)
    assert not style.too_long(f"```\n{words}\n```")


def spoken(name):
    """Return the docstrings of a public name, and of its own public methods and properties, by name."""
    thing = getattr(closedloop, name)
    found = {name: inspect.getdoc(thing) or ""}
    if isinstance(thing, type):
        own = {k: v for k, v in vars(thing).items() if not k.startswith("_")}
        found |= {
            f"{name}.{k}": inspect.getdoc(v) or "" for k, v in own.items() if callable(v) or isinstance(v, property)
        }
    return found


@pytest.mark.parametrize("name", closedloop.__all__)
def test_a_public_docstring_is_written_in_plain_sentences(name):
    """As a page is: no sentence is too long, and no word is private."""
    for of, text in spoken(name).items():
        prose = style.docstring_prose(text)
        assert style.long_sentences(prose) == [], of
        assert style.words_not_used(prose) == [], of


def test_texts_of_keys_and_commands_are_written_in_plain_words():
    """What `--help` prints of every key of a scenario and of every command."""
    for section, about in messages.sections().items():
        assert style.words_not_used(about) == [], section
        for key in messages.keys(section):
            assert style.words_not_used(key.field.description or "") == [], key.name
    for command in COMMANDS:
        assert style.words_not_used(command.help) == [], command.name


def test_a_docstring_is_read_by_its_parts():
    """The text of a parameter is a sentence of its own; code and names are none."""
    text = f"""Do it.

    Parameters
    ----------
    one : float
        {LONG}.
    two : float
        Short.
    """
    assert [number for number, _ in style.long_sentences(style.docstring_prose(text))] == [41]
    assert style.long_sentences(style.docstring_prose(text.replace("word word ", "word. Word "))) == []
