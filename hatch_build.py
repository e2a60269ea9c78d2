"""The README as a package index shows it: a link into the repository has its address, since an index has no files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# A picture or a link of Markdown to a file beside the README.
_BESIDE = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)")


def for_index(text: str, repository: str | None) -> str:
    """Return a README with absolute links; without a `repository`, its words alone."""

    def absolute(found: re.Match[str]) -> str:
        picture, words, path = found.groups()
        if repository is None:
            return "" if picture else words
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/HEAD/{path})"

    return _BESIDE.sub(absolute, text)


class CustomMetadataHook(MetadataHookInterface):
    """Sets `readme`; the address is `Repository` of [project.urls]."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Read README.md beside this file."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = for_index(text, metadata.get("urls", {}).get("Repository"))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
