"""Numbers of eight lanes in compiled code: what `float64x8` and `dual8` share.

Both are a register of eight float64. They differ in what each operation does with the lanes: each lane for itself
(`closedloop.jit.numba_simd8`), or lane 0 the value and the others its derivatives (`closedloop.jit.numba_dual8`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from closedloop.jit.numba_blocks import array_on
from closedloop.jit.simd8 import WIDE
from closedloop.jit.typing_once import plain

DOUBLES = ir.VectorType(ir.DoubleType(), WIDE)
LANE = ir.IntType(32)


class Vector(types.Type):
    """A type whose values are kept in one register; `others` become one by themselves."""

    others: tuple[type[types.Type], ...] = ()

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Say how another type becomes this one."""
        return Conversion.safe if isinstance(other, self.others) else None

    def unify(self, typingctx: Any, other: Any) -> Any:
        """Return the type of a variable that is at times this, at times the other."""
        return self if isinstance(other, self.others) else None


def made_of(kind: type[Vector], content: Any) -> None:
    """Tell numba what a value of a type is made of."""

    @register_model(kind)
    class Model(models.PrimitiveModel):
        def __init__(self, dmm: Any, fe_type: Any) -> None:
            super().__init__(dmm, fe_type, content)

    plain.append(kind)


def repeated(builder: Any, value: Any, kind: Any = DOUBLES) -> Any:
    """Write code for a number in every lane."""
    nothing = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(nothing, value, LANE(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(LANE, WIDE), [0] * WIDE))


def teach(function: Any, kinds: tuple[Any, ...], result: Any, emit: Callable[..., Any]) -> None:
    """Teach numba a function of vectors: `emit(context, builder, *values)` writes its code.

    It is for arguments of these kinds, of which at least one is a vector if any is; numbers become vectors.
    """
    some = any(isinstance(kind, Vector) for kind in kinds)

    @infer_global(function)
    class Typing(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            own = not some or any(isinstance(x, Vector) for x in args)
            fits = len(args) == len(kinds) and all(
                x == kind
                or (isinstance(kind, Vector) and isinstance(x, kind.others) and not isinstance(x, types.Boolean))
                for x, kind in zip(args, kinds, strict=True)
            )
            return signature(result, *kinds) if own and fits and not kws else None

    @lower_builtin(function, *kinds)
    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return emit(context, builder, *values)


def vectors_at(kind: Any, ndim: int, order: Any = "C") -> tuple[Any, Callable[..., Any]]:
    """Return the type of an array of vectors, and what writes code for one, of an address and its shape."""
    array = types.Array(kind, ndim, order)

    def lower(context: Any, builder: Any, call: Any, values: Any) -> Any:
        return array_on(context, builder, array, builder.inttoptr(values[0], DOUBLES.as_pointer()), list(values[1:]))

    return array, lower
