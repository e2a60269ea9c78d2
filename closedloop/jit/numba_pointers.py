"""Arrays by their address in compiled code; see `closedloop.jit.pointers`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin

from closedloop.jit.numba_blocks import array_on
from closedloop.jit.pointers import fortran_at, integers_at, matrix_at, vector_at


def _compiled(function: Callable[..., Any], kind: Any) -> None:
    """Teach numba one of the functions above."""
    dtype = types.CPointer(kind.dtype)

    @infer_global(function)
    class At(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            fits = len(args) == 1 + kind.ndim and not kws and all(isinstance(x, types.Integer) for x in args)
            return signature(kind, *(types.intp for _ in args)) if fits else None

    @lower_builtin(function, *(types.intp for _ in range(1 + kind.ndim)))
    def lower(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        data = builder.inttoptr(arguments[0], context.get_value_type(dtype))
        return array_on(context, builder, kind, data, list(arguments[1:]))


_compiled(vector_at, types.Array(types.float64, 1, "C"))
_compiled(matrix_at, types.Array(types.float64, 2, "C"))
_compiled(fortran_at, types.Array(types.float64, 2, "F"))
_compiled(integers_at, types.Array(types.int64, 1, "C"))
