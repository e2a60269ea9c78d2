"""Arrays by their address, and parts of arrays, in compiled code; see `closedloop.jit.pointers`.

Kernels count no references, so a compiled function cannot return a view: numba writes these where they are called.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin
from numba.np.arrayobj import make_array

from closedloop.jit.numba_blocks import array_on
from closedloop.jit.pointers import fortran_at, integers_at, known_matrix_at, matrix_at, matrix_of, row_of, vector_at


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
_compiled(known_matrix_at, types.Array(types.float64, 2, "C"))
_compiled(fortran_at, types.Array(types.float64, 2, "F"))
_compiled(integers_at, types.Array(types.int64, 1, "C"))


@infer_global(row_of)
class RowOf(AbstractTemplate):
    """The type of a row of a matrix."""

    key = row_of

    def generic(self, args: Any, kws: Any) -> Any:
        """Return the signature for a matrix in C order and a whole number."""
        fits = len(args) == 2 and not kws and isinstance(args[0], types.Array) and isinstance(args[1], types.Integer)
        if not fits or args[0].ndim != 2 or args[0].layout != "C":
            return None
        return signature(types.Array(args[0].dtype, 1, "C"), args[0], types.intp)


@lower_builtin(row_of, types.Array, types.intp)
def _lower_row(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    matrix = make_array(call.args[0])(context, builder, value=arguments[0])
    columns = cgutils.unpack_tuple(builder, matrix.shape)[1]
    data = builder.gep(matrix.data, [builder.mul(arguments[1], columns)])
    return array_on(context, builder, call.return_type, data, [columns])


@infer_global(matrix_of)
class MatrixOf(AbstractTemplate):
    """The type of the first numbers of a vector as a matrix."""

    key = matrix_of

    def generic(self, args: Any, kws: Any) -> Any:
        """Return the signature for a vector in C order and two whole numbers."""
        fits = len(args) == 3 and not kws and isinstance(args[0], types.Array)
        if not fits or args[0].ndim != 1 or args[0].layout != "C":
            return None
        return signature(types.Array(args[0].dtype, 2, "C"), args[0], types.intp, types.intp)


@lower_builtin(matrix_of, types.Array, types.intp, types.intp)
def _lower_matrix(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    vector = make_array(call.args[0])(context, builder, value=arguments[0])
    return array_on(context, builder, call.return_type, vector.data, list(arguments[1:]))
