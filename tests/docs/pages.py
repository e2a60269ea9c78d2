"""The pages of the documentation, their code blocks and their links."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# A block that is a file: the words before it end with "in `my_laws.py`:".
FILE = re.compile(r"in\s+`([\w.]+\.(?:py|toml))`:\s*$")
LINK = re.compile(r"\]\(([^()\s]+)\)")


def blocks(text, *languages):
    """Return the fenced blocks of these languages as pairs: the file that the page says they are, or None; the code."""
    found = []
    for match in FENCE.finditer(text):
        if match[1] in languages:
            named = FILE.search(text[: match.start()])
            found.append((named[1] if named else None, match[2]))
    return found


def session(text):
    """Return a program of all Python blocks of a page, in order; blocks that are files are written where they stand."""
    lines = ["import importlib as _importlib", "from pathlib import Path as _Path"]
    for file, code in blocks(text, "python", "toml"):
        if file:
            lines += [f"_Path({file!r}).write_text({code!r}, encoding='utf-8')", "_importlib.invalidate_caches()"]
        elif (None, code) in blocks(text, "python"):
            lines.append(code)
    return "\n".join(lines)


def commands(text):
    """Return the commands that stand on a page, indented, a line each."""
    return "\n".join(
        re.findall(r"^    ((?:closedloop|python -m closedloop\.run) .*)$", FENCE.sub("", text), re.MULTILINE)
    )


def anchors(text):
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def left_out(index, pages):
    """Return those of the pages that no table of contents (toctree) of the text `index` has."""
    listed = re.findall(r"^```{toctree}\n(.*?)^```$", index, re.MULTILINE | re.DOTALL)
    return set(pages) - set(" ".join(listed).split())


def broken_links(page, text, generated):
    """Return the links of a page that lead nowhere; `generated` names the pages that the build makes."""
    broken = []
    for link in LINK.findall(FENCE.sub("", text)):
        path, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link) or (path.startswith("generated/") and Path(path).stem in generated):
            continue
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target.read_text(encoding="utf-8"))):
            broken.append(link)
    return broken
