"""Ask numba once, not at each place of each kernel, what an operator makes of arguments of plain types.

numba finds the type of `a * b` by trying all that is known of `*` in turn (strings, lists, array expressions ...), for
each such expression several times. Of numbers and of arrays of numbers the answer depends on their types alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NopythonTypeInference

# The types of which the answer is kept; `closedloop.jit.numba_simd8` adds its own.
plain: list[type[types.Type]] = [types.Number, types.Boolean, types.Array, types.UniTuple, types.SliceType]

# The answers, by the identity of numba's type of the function, which is another once more is known of the function;
# it is kept, so that the identity stays its own.
_answers: dict[tuple[int, Any], tuple[Any, Any]] = {}


def call_type(context: Any, function: Any, args: tuple[Any, ...]) -> Any:
    """Return the signature of a call of one of numba's own functions, as `function.get_call_type` would.

    Parameters
    ----------
    context : numba's typing context
    function : numba.types.Function
    args : tuple of types

    Raises
    ------
    numba.TypingError
        There is no such call.
    """
    if not all(isinstance(kind, tuple(plain)) for kind in args):
        return function.get_call_type(context, args, {})
    key = id(function), args
    if key not in _answers:
        found = function.get_call_type(context, args, {})
        if found is None or function.get_impl_key(found) is not function.typing_key:
            return found  # it is compiled for these arguments, with the flags of the caller
        _answers[key] = found, function
    return _answers[key][0]


@contextmanager
def _remembered(context: Any) -> Iterator[None]:
    """Let the typing context answer from what it said before; the caller holds numba's lock."""
    if "resolve_function_type" in vars(context):  # a kernel that another one calls
        yield
        return
    resolve = context.resolve_function_type

    def remember(function: Any, args: Any, kws: Any) -> Any:
        kind = function if isinstance(function, types.Type) else context._lookup_global(function)
        if kws or not isinstance(kind, types.Function):
            return resolve(function, args, kws)
        return call_type(context, kind, tuple(args))

    context.resolve_function_type = remember
    try:
        yield
    finally:
        del context.resolve_function_type


@register_pass(mutates_CFG=True, analysis_only=False)
class InferOnce(NopythonTypeInference):
    """numba's type inference, with answers kept."""

    _name = "infer_once"

    def run_pass(self, state: Any) -> Any:
        """Infer the types of a function."""
        with _remembered(state.typingctx):
            return super().run_pass(state)
