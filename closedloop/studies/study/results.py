"""The rows of a study as files."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from closedloop.base.files import write_whole


def write_results(folder: Path, name: str, columns: Sequence[str], results: list[dict[str, Any]]) -> str:
    """Write the rows as `name`.json and `name`.csv with these columns, and return the former's text.

    A number that is not finite is null, and an empty cell.
    """
    plain = [
        {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()} for row in results
    ]
    said = json.dumps(plain, indent=2)
    write_whole(folder / f"{name}.json", (said + "\n").encode())
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns)
    writer.writeheader()
    writer.writerows(plain)
    write_whole(folder / f"{name}.csv", text.getvalue().encode())
    return said
