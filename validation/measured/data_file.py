"""The measured data that come with the package, or a file of a user in the same format."""

from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import ModelError
from closedloop.base.files import reason_of

DATA = Path(__file__).parent / "data"


def columns(file: str, names: Mapping[str, int], given: Path | None = None) -> dict[str, NDArray[np.float64]]:
    """Return columns of an .npz file, double precision.

    file: in the folder `data`
    names: each column that is needed, and how many entries a row of it has; 0 of one that is a vector
    given: a file to read in place of it
    Raises `ModelError` if it cannot be read, a column is missing, or has another shape.
    """
    path = DATA / file if given is None else given
    try:
        with np.load(path) as found:
            missing = [name for name in names if name not in found]
            if missing:
                raise ModelError(f"{path}: has no column {missing[0]!r}: it needs {', '.join(names)}")
            read = {name: np.asarray(found[name], dtype=np.float64) for name in names}
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {reason_of(error)}") from None
    except (ValueError, EOFError, BadZipFile, AttributeError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{path}: is no .npz file of numbers, as numpy.savez writes it") from None
    rows = len(next(iter(read.values())))
    for name, width in names.items():
        shape = (rows, width) if width else (rows,)
        if read[name].shape != shape:
            raise ModelError(f"{path}: {name} has shape {read[name].shape}: it must be {shape}")
    return read
