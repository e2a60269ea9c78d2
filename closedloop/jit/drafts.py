"""Drafts: the machine code of an entry before it is optimised, for a run that waits for the compiler.

Optimising takes a third of the time to compile. A draft computes the same numbers to the last bit, in some eight times
the time of optimised code. The process in the background (`closedloop.jit.background`) writes a draft before it
optimises, and optimised code takes its place. What the loop calls by address has drafts, and the step itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from closedloop.jit.cache_folder import DRAFT, is_kept
from closedloop.jit.calls import entry_address
from closedloop.jit.kernel import needs_compiling
from closedloop.jit.uninterrupted import compiler_at_work

# Engines of drafts that were loaded, which keep the code, and its addresses, by the entry.
_loaded: dict[Any, tuple[Any, int]] = {}


@contextmanager
def written_first() -> Iterator[None]:
    """Have what is compiled meanwhile written as a draft before it is optimised."""
    from closedloop.jit.inline_once import EntryLibrary

    EntryLibrary.write_draft = _write
    try:
        yield
    finally:
        EntryLibrary.write_draft = None


def _write(library: Any) -> None:
    cache, signature = library.kept_by
    if cache is not None and signature == _by_address():
        code = _machine(library.codegen).emit_object(library._final_module.clone())
        cache.save_draft(signature, library.codegen, (library.called_as, code))


def _by_address() -> tuple[Any, ...]:
    from numba import types

    return types.int64, types.int64


def _machine(codegen: Any) -> Any:
    """Return numba's target, without optimisation."""
    from llvmlite.binding import Target, get_process_triple

    options: dict[str, Any] = {}
    codegen._customize_tm_options(options)
    return Target.from_triple(get_process_triple()).create_target_machine(opt=0, **options)


def at_hand(function: Callable[..., Any]) -> bool:
    """Whether a kernel is compiled, or has a draft."""
    return not needs_compiling(function) or is_kept(function, DRAFT)


def draft_address(entry: Any) -> int:
    """Return the address of an entry's machine code, optimised if that is there, else of its draft."""
    if not needs_compiling(entry):
        return entry_address(entry)
    if entry not in _loaded:
        from llvmlite.binding import ObjectFileRef, create_mcjit_compiler, parse_assembly

        with compiler_at_work():
            codegen = entry.targetctx.codegen()
            found = entry._cache.load_draft(_by_address(), codegen)
            if found is None:  # optimised code has taken its place by now
                return entry_address(entry)
            engine = create_mcjit_compiler(parse_assembly(""), _machine(codegen))
            engine.add_object_file(ObjectFileRef.from_data(found[1]))
            engine.finalize_object()
            _loaded[entry] = engine, engine.get_function_address(found[0])
    return _loaded[entry][1]
