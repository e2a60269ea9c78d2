"""Interpreted loops: arrays as Python's own buffers, and drafts of machine code for a run that waits.

An element of a numpy array is a numpy number, and to take it, to calculate with it and to put it back costs twice what
a float costs that comes from a memoryview. The arithmetic is the same, IEEE's in double precision. But buffers cannot
do all that arrays can (a row of a matrix, a number assigned to a slice), and dividing a float by zero raises where
numpy gives an infinity: what a kernel cannot do with buffers, it does with arrays (`closedloop.jit.interpreted`).

In a kernel that is interpreted so, the functions of `BUFFERS` stand in place of their keys, and a `BufferBlock` in
place of each block. A user's plug-ins, which the loop calls by address, get arrays as ever.

Drafts: the machine code of an entry before it is optimised, for a run that waits for the compiler.

Optimising takes a third of the time to compile. A draft computes the same numbers to the last bit, in some eight times
the time of optimised code. The process in the background (`closedloop.jit.background`) writes a draft before it
optimises, and optimised code takes its place. What the loop calls by address has drafts, and the step itself.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from typing import Any

import numpy as np

from closedloop.jit.blocks import Block
from closedloop.jit.cache_folder import DRAFT, is_kept
from closedloop.jit.calls import (
    MOST_KEPT,
    call_at,
    call_with_buffers,
    entry_address,
    fortran_at,
    integers_at,
    known_matrix_at,
    matrix_at,
    matrix_of,
    row_of,
    vector_at,
)
from closedloop.jit.kernel import needs_compiling
from closedloop.jit.uninterrupted import compiler_at_work

Buffer = Any  # a memoryview of one or two dimensions

# Blocks of one class that are kept: an interpreted loop makes the same few at every step.
MOST_BLOCKS = 8


def _reals(address: int, count: int) -> Buffer:
    return memoryview((ctypes.c_double * count).from_address(address)).cast("B").cast("d")


@lru_cache(maxsize=MOST_KEPT)
def vector_buffer(address: int, n: int) -> Buffer:
    """Return the n numbers at an address."""
    return _reals(int(address), int(n))


@lru_cache(maxsize=MOST_KEPT)
def matrix_buffer(address: int, rows: int, columns: int) -> Buffer:
    """Return the matrix at an address, row after row."""
    return np.asarray(_reals(int(address), int(rows * columns))).reshape(int(rows), int(columns)).data


@lru_cache(maxsize=MOST_KEPT)
def fortran_buffer(address: int, rows: int, columns: int) -> Buffer:
    """Return the matrix at an address, column after column."""
    flat = np.asarray(_reals(int(address), int(rows * columns)))
    return flat.reshape((int(rows), int(columns)), order="F").data


@lru_cache(maxsize=MOST_KEPT)
def integers_buffer(address: int, n: int) -> Buffer:
    """Return the n whole numbers at an address."""
    return memoryview((ctypes.c_int64 * int(n)).from_address(int(address))).cast("B").cast("q")


def matrix_buffer_of(vector: Any, rows: int, columns: int) -> Buffer:
    """Return the first numbers of a vector as a matrix, row after row."""
    return np.asarray(vector[0 : rows * columns]).reshape(rows, columns).data


def row_buffer(matrix: Any, i: int) -> Buffer:
    """Return a row of a matrix."""
    array: Any = matrix.obj if isinstance(matrix, memoryview) else matrix
    return array[i].data


class BufferBlock:
    """What makes blocks of one class on buffers; those on arrays, of SIMD lanes for example, it makes as ever.

    A block on a buffer is a structure of ctypes: its single numbers are read and written without a line of Python.
    """

    def __init__(self, kind: type[Block]) -> None:
        self._kind = kind
        self._structures: dict[tuple[str, tuple[int, ...]], type[ctypes.Structure]] = {}
        self._kept: dict[int, tuple[Any, tuple[int, ...], Any]] = {}

    def __call__(self, memory: Any, *sizes: int) -> Any:
        """Return a block, the same for the same memory."""
        found = self._kept.get(id(memory))
        if found is not None and found[0] is memory and found[1] == sizes:
            return found[2]
        if not isinstance(memory, memoryview):
            return self._kind(memory, *sizes)
        block: Any = self._structure(memory.format, sizes).from_buffer(memory)
        block.memory = memory
        if len(self._kept) >= MOST_BLOCKS:
            self._kept.clear()
        self._kept[id(memory)] = memory, sizes, block
        return block

    def _structure(self, number: str, sizes: tuple[int, ...]) -> type[ctypes.Structure]:
        """Return the class of blocks of these sizes: its fields are the single numbers, with what is between them."""
        if (number, sizes) not in self._structures:
            kind: Any = {"d": ctypes.c_double, "q": ctypes.c_int64}[number]
            layout, places = self._kind.layout, self._kind.layout.places(*sizes)
            inner = {name: (with_buffers(part), layout.sizes_of(part, sizes)) for name, part in layout.blocks.items()}
            begins = {name: layout.at[name].value(dict(zip(layout.sizes, sizes, strict=True))) for name in layout.at}
            ends = {name: end for name, _, end, _ in places.values()}
            ends |= {name: begins[name] + maker.count(*of) for name, (maker, of) in inner.items()}
            fields = [
                (name, kind) if name in places and not places[name][3] else (f"_{name}", kind * (ends[name] - begin))
                for name, begin in begins.items()
            ]

            def part(block: Any, name: str) -> Any:
                """Return an array or a block of a block when it is first asked for, and keep it there."""
                if name not in begins:
                    raise AttributeError(name)
                view: Any = block.memory[begins[name] : ends[name]]
                if name in inner:
                    maker, of = inner[name]
                    memory, view = view, maker._structure(number, of).from_buffer(view)
                    view.memory = memory
                elif len(places[name][3]) > 1:
                    view = np.asarray(view).reshape(places[name][3]).data
                setattr(block, name, view)
                return view

            body = {"_fields_": fields, "__getattr__": part}
            self._structures[number, sizes] = type(self._kind.__name__, (ctypes.Structure,), body)
        return self._structures[number, sizes]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kind, name)


BUFFERS: dict[Any, Callable[..., Any]] = {
    call_at: call_with_buffers,
    vector_at: vector_buffer,
    matrix_at: matrix_buffer,
    known_matrix_at: matrix_buffer,
    fortran_at: fortran_buffer,
    integers_at: integers_buffer,
    row_of: row_buffer,
    matrix_of: matrix_buffer_of,
}


def with_buffers(value: Any) -> Any:
    """Return what stands in place of a global of a kernel that is interpreted with buffers; else the value itself."""
    if isinstance(value, type) and issubclass(value, Block):
        kind: Any = value
        return _block_maker(kind)
    try:
        return BUFFERS.get(value, value)
    except TypeError:  # it has no hash
        return value


@cache
def _block_maker(kind: Any) -> BufferBlock:
    return BufferBlock(kind)


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
