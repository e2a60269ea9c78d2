"""The table of a sweep as a Parquet file that tells damage: each page of values has a checksum, Parquet's own.

What stands outside of the pages, names and units, has none: a digest in the file's metadata would be kept by a program
that leaves rows out, and refuse what is as it should be. But a column's name is there more than once.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

METADATA = "closedloop_sweep"


def open_table(file: BinaryIO, columns: pa.Schema, description: str) -> ParquetWriter:
    """Return the writer of a table with these columns and so many rows; `description` says what the sweep is."""
    from pyarrow import parquet

    return parquet.ParquetWriter(file, columns.with_metadata({METADATA: description}), write_page_checksum=True)


def description_of(path: Path) -> str:
    """Return what a table's file says that the sweep is; raises as `pieces` does, KeyError if it says nothing."""
    from pyarrow import parquet

    with path.open("rb") as opened:
        said: bytes = (parquet.read_schema(opened).metadata or {})[METADATA.encode()]
    return said.decode()


def pieces(path: Path) -> Iterator[pa.Table]:
    """Yield the rows of a table's file, some at a time; files without checksums, as others write them, are read too.

    Raises
    ------
    ValueError, KeyError, pyarrow.ArrowException
        If it is no Parquet file, or is damaged.
    OSError
        If it cannot be read; without a number if it is damaged.
    """
    from pyarrow import parquet

    # Arrow would open names that are text only.
    with path.open("rb") as opened, parquet.ParquetFile(opened, page_checksum_verification=True) as file:
        yield file.schema_arrow.empty_table()
        columns = [file.schema.column(i).path for i in range(len(file.schema))]
        for group in range(file.num_row_groups):
            there = file.metadata.row_group(group)
            if [there.column(i).path_in_schema for i in range(there.num_columns)] != columns:
                raise ValueError("the names of its columns differ")
            yield file.read_row_group(group)


@contextmanager
def unreadable_is_none() -> Iterator[None]:
    """Pass over what Arrow says of a file that is none of its own, or damaged; not over what the system says."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, ValueError, KeyError, RecursionError):
        pass
    except OSError as error:
        if error.errno is not None:
            raise
