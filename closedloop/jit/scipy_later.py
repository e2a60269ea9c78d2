"""numba's implementations of array functions, imported without scipy.

When numba loads or compiles its first function it imports `numba.np.arraymath`, which imports all of scipy.linalg to
detect BLAS: 0.3 s of processor time, a seventh of the command's start, for functions that no kernel here calls. Code
that uses BLAS (a user's compiled law with a matrix product, say) imports it before it is compiled.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType

BLAS = "scipy.linalg.cython_blas"


def import_array_functions() -> None:
    """Import `numba.np.arraymath`, if it is not there yet, as if scipy's BLAS were imported already."""
    if "numba.np.arraymath" in sys.modules or "scipy.linalg" in sys.modules or find_spec("scipy") is None:
        return
    sys.modules[BLAS] = ModuleType(BLAS)
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[BLAS]
