"""Ask numba once, not at each place of each kernel, what an operator makes of arguments of plain types.

numba finds the type of `a * b` by trying all that is known of `*` in turn (strings, lists, array expressions ...), for
each such expression several times. Of numbers and of arrays of numbers the answer depends on their types alone.
"""

import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import types
from numba.core.compiler_machinery import register_pass
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NopythonTypeInference

# The types of which the answer is kept; `closedloop.jit.inside.simd8` adds its own.
plain: list[type[types.Type]] = [types.Number, types.Boolean, types.Array, types.UniTuple, types.SliceType]

# Flags that functions are compiled with, each once; and those asked for last, with their place among them.
_known_flags: list[Any] = []
_last: tuple[Any, int] = None, -1

# The answers, by the identity of numba's type of the function, which is another once more is known of the function;
# it is kept, so that the identity stays its own. And by the place of the caller's flags, if it is compiled with them.
_answers: dict[tuple[Any, ...], tuple[Any, Any, Any]] = {}


def call_type(context: Any, function: Any, args: tuple[Any, ...]) -> Any:
    """Return the signature of a call of one of numba's own functions, as `function.get_call_type` would.

    Raises
    ------
    numba.TypingError
        There is no such call.
    """
    if not all(map(_is_plain, args)):
        return function.get_call_type(context, args, {})
    key: Any = id(function), args
    if key not in _answers:
        key = *key, _flags()
    if key not in _answers:
        found = function.get_call_type(context, args, {})
        if found is None:
            return None
        code = function.get_impl_key(found)
        if code is function.typing_key:  # else it is compiled, with the flags of the caller
            key = id(function), args
        _answers[key] = found, function, code
    found, _, code = _answers[key]
    function._impl_keys[found.args] = code  # as if numba had been asked
    return found


def _flags() -> int:
    """Return which of `_known_flags` the function in work is compiled with."""
    global _last
    flags = ConfigStack.top_or_none()
    if flags is not _last[0]:
        if flags not in _known_flags:
            _known_flags.append(flags if flags is None else flags.copy())
        _last = flags, _known_flags.index(flags)
    return _last[1]


def _is_plain(kind: Any) -> bool:
    """Whether a type is one of which the answer is kept, or an index of such."""
    return isinstance(kind, tuple(plain)) or (
        isinstance(kind, types.Tuple) and all(isinstance(each, types.Integer) for each in kind.types)
    )


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

    def assign(target: Any, index: Any, value: Any) -> Any:
        return call_type(context, context.resolve_value_type(operator.setitem), (target, index, value))

    context.resolve_function_type, context.resolve_setitem = remember, assign
    try:
        yield
    finally:
        del context.resolve_function_type, context.resolve_setitem


@register_pass(mutates_CFG=True, analysis_only=False)
class InferOnce(NopythonTypeInference):
    """numba's type inference, with answers kept."""

    _name = "infer_once"

    def run_pass(self, state: Any) -> Any:
        """Infer the types of a function."""
        with _remembered(state.typingctx):
            return super().run_pass(state)
