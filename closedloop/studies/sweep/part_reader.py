"""Whether a part of a sweep can be read, as a program of its own: ``python part_reader.py arrow`` with it as its input.

Arrow trusts what it reads, and breaks down over bytes that somebody changed and sealed again.
"""

import io
import sys

import numpy as np


def main() -> None:
    """Read all of standard input as a part's rows (``arrow``) or columns (``npz``)."""
    content = sys.stdin.buffer.read()
    if sys.argv[1] == "npz":
        with np.load(io.BytesIO(content), allow_pickle=False) as columns:
            for name in columns.files:
                columns[name].shape  # noqa: B018  reads it
        return
    import pyarrow as pa

    rows = pa.ipc.open_file(pa.BufferReader(content)).read_all()
    rows.validate(full=True)
    rows.to_pydict()


if __name__ == "__main__":
    main()
