"""What compiled code depends on beside its source: versions of the compiler, its settings, the processor."""

import sys
from functools import lru_cache
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core import config

from closedloop.base.interrupts import compiler_at_work

# numba's settings, each an environment variable, that change what it compiles.
SETTINGS = (
    "OPT", "ENABLE_AVX", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "DISABLE_INTEL_SVML",
    "DEBUG_NRT", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS", "EXTEND_VARIABLE_LIFETIMES",
)  # fmt: skip


@lru_cache(maxsize=1)
def compiler_and_processor() -> tuple[Any, ...]:
    """Return what compiled code depends on beside its source: versions, and the processor, which may be one's wish."""
    with compiler_at_work():
        numba_settings: Any = config  # its attributes are made at run time, which type checkers cannot see
        python = (sys.implementation.cache_tag, *sys.version_info[:3], getattr(sys, "abiflags", ""), sys.flags.optimize)
        versions = (numba.__version__, llvmlite.__version__, np.__version__, *python)
        name = numba_settings.CPU_NAME or llvm.get_host_cpu_name()
        features = numba_settings.CPU_FEATURES
        if features is None:
            features = "" if numba_settings.CPU_NAME else llvm.get_host_cpu_features().flatten()
        triple = llvm.get_process_triple()
        settings = tuple(str(getattr(numba_settings, setting, None)) for setting in SETTINGS)
    return (*versions, triple, name, features, *settings)


def address_of_compiled(compiled: Any) -> int:
    """Return the address of what numba has compiled, for callers from outside."""
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))
