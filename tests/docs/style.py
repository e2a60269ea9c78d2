"""What can be checked of the language of a page: length of sentences and of pages, and words that are not used."""

import inspect
import re

MOST_WORDS_IN_A_SENTENCE = 40
MOST_WORDS_ON_A_PAGE = 1500
MOST_WITHOUT_SUMMARY = 1000  # a longer page begins with a section of this name
SUMMARY = "## Summary"

# Words that a stranger does not understand, or takes for something else, as regular expressions; and what to write.
NOT_USED = {
    r"(?:does|do) not mind": "is not affected",
    r"nobody'?s?\b": "name what is meant",
    r"given? up": "is not assumed, is replaced",
    r"gives? way": "is soft, is compliant",
    r"rubs?\b": "has friction",
    r"is not so(?=[.,;:])": "is wrong",
    r"(?<!there )(?:are|is) none\b": "say what happens: is set to zero, does not exist",
    r"no more\.": "no longer, or say what happens",
    r"lets? go\b": "releases",
    r"by itself": "alone, separately",
    r"of one's own": "of your own",
    r"told at once": "are reported together",
    r"is told\b": "is reported",
    r"told by\b": "is shown by",
    r"(?:is|are) asked (?:when|for)": "is called, is requested",
    r"Likewise one class": "a complete sentence",
    r"as good as": "practically",
    r"what held": "what was satisfied",
}

FENCE = re.compile(r"^(```+|~~~+).*?^\1\s*$", re.MULTILINE | re.DOTALL)
DISPLAY = re.compile(r"\$\$.*?\$\$", re.DOTALL)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
INLINE = re.compile(r"`[^`]+`|\$[^$\n]+(?:\n[^$\n]+)?\$")
LINK = re.compile(r"!?\[([^\]]*)\]\([^()]*\)")
# The end of a sentence; a number behind the full stop belongs to "Eq. 24" or "Fig. 5".
STOP = re.compile(r"(?<=[.!?])[)*\"']*\s+(?!\d|[a-z]{2})")
WORD = re.compile(r"[^\W_](?:[\w'’.,/-]*\w)?")


def paragraphs(text):
    """Return the paragraphs and list items of a page without code, formulas, tables and headings."""
    for pattern in (FENCE, COMMENT):
        text = pattern.sub("\n\n", text)
    text = DISPLAY.sub(" formula ", text)
    found, current, code = [], [], False
    for line in [*text.splitlines(), ""]:
        bare = line.strip()
        code = line.startswith("    ") and not current
        item = re.match(r"(?:[-*]|\d+\.) +", bare)
        if not bare or code or bare[0] in "|#" or item:
            if current:
                found.append(" ".join(current))
            current = [bare[item.end() :]] if item and not code else []
        else:
            current.append(bare)
    return found


def sentences(text):
    """Return the sentences of a page; what stands as code or as a formula in one is a word of it."""
    plain = (INLINE.sub("CODE", LINK.sub(r"\1", paragraph)) for paragraph in paragraphs(text))
    return [sentence for paragraph in plain for sentence in STOP.split(paragraph) if WORD.search(sentence)]


def words(text):
    """Return the number of words of a text."""
    return len(WORD.findall(text))


def long_sentences(text):
    """Return the sentences of a page that have too many words, each with their number."""
    counted = ((words(sentence), sentence) for sentence in sentences(text))
    return [(number, sentence) for number, sentence in counted if number > MOST_WORDS_IN_A_SENTENCE]


def words_not_used(text):
    """Return the expressions on a page that are not used, each with what to write in its place."""
    prose = "\n".join(INLINE.sub("CODE", paragraph) for paragraph in paragraphs(text))
    found = ((match[0], better) for word, better in NOT_USED.items() for match in re.finditer(rf"\b{word}", prose))
    return list(found)


def too_long(text):
    """Return the number of words on a page, without code, if they are too many, or many without a summary; or 0."""
    head = FENCE.sub("", text)
    number = words(head)
    first = re.search(r"^## .*$", head, re.MULTILINE)
    has_summary = first is not None and first[0] == SUMMARY
    return 0 if number <= (MOST_WORDS_ON_A_PAGE if has_summary else MOST_WITHOUT_SUMMARY) else number


def docstring_prose(text):
    """Return a docstring (NumPy's form) as a page: each parameter's text is a paragraph, without names and headings."""
    found, lines, sections = [], inspect.cleandoc(text).splitlines(), False
    for k, line in enumerate(lines):
        below = lines[k + 1] if k + 1 < len(lines) else ""
        if set(line.strip()) == {"-"} or (below.strip() and set(below.strip()) == {"-"}):
            sections = True
            found.append("")
        elif sections and not line.startswith(" ") and below.startswith("    "):
            found.append("")  # the name of a parameter and its type
        else:
            found.append(line.strip() if sections else line)
    return "\n".join(found)
