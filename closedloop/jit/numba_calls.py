"""Calls by address in compiled code; see `closedloop.jit.calls`."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin

from closedloop.jit.calls import call_at

_WORD = ir.IntType(64)


@infer_global(call_at)
class _CallAt(AbstractTemplate):
    key = call_at

    def generic(self, args: Any, kws: Any) -> Any:
        fits = len(args) == 3 and not kws and all(isinstance(x, types.Integer) for x in args)
        return signature(types.int64, types.int64, types.int64, types.int64) if fits else None


@lower_builtin(call_at, types.int64, types.int64, types.int64)
def _lower_call_at(context: Any, builder: Any, call: Any, values: Any) -> Any:
    kind = ir.FunctionType(_WORD, [_WORD, _WORD])
    return builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
