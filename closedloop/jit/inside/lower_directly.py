"""Write LLVM's code for elements of arrays and for arithmetic directly.

numba's own way to `a[i]` copies the array's description to the stack and back, and asks for the types and the
implementation again; of a kernel's compile time that was a third, most of it in Python. The code means the same, but
in kernels of this package an index may not be negative: it is not tested.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from numba.core import types
from numba.core.compiler_machinery import register_pass
from numba.core.cpu import CPUContext
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering
from numba.np.arrayobj import load_item, store_item

from closedloop.jit.inside.blocks import array_part
from closedloop.jit.inside.typing_once import call_type

# Of these, numba has forms for a whole number that is known when compiling.
_WITH_KNOWN_NUMBERS = operator.pow, operator.ipow


# Packages whose kernels have no negative index: an index that may be negative is tested at each access.
OURS = "closedloop", "validation"


def _kept_by_type(size_of: Callable[[Any, Any], int]) -> Callable[[Any, Any], int]:
    known: dict[Any, int] = {}

    def kept(context: Any, kind: Any) -> int:
        if kind not in known:
            known[kind] = size_of(context, kind)
        return known[kind]

    return kept


# numba asks LLVM for the size of a type each time that something of the type is written.
CPUContext.get_abi_sizeof = _kept_by_type(CPUContext.get_abi_sizeof)  # type: ignore[method-assign]


class DirectLower(Lower):
    """numba's writer of LLVM's code; what is not said here is as there."""

    def lower_expr(self, resty: Any, expr: Any) -> Any:
        """Write an expression: an element whose index is known as any other."""
        if expr.op == "static_getitem" and expr.index_var is not None and _in_rows(self.typeof(expr.value.name)):
            signature = self.fndesc.calltypes[expr]
            return self.lower_getitem(resty, expr, expr.value, expr.index_var, signature)
        return super().lower_expr(resty, expr)

    def lower_binop(self, resty: Any, expr: Any, op: Any) -> Any:
        """Write an operation on two numbers."""
        signature = self.fndesc.calltypes[expr]
        given = self.typeof(expr.lhs.name), self.typeof(expr.rhs.name)
        plain = all(isinstance(kind, types.Number | types.Boolean) for kind in (*given, signature.return_type))
        if not plain or op in _WITH_KNOWN_NUMBERS:
            return super().lower_binop(resty, expr, op)
        function = self.context.typing_context.resolve_value_type(op)
        values = [
            self.context.cast(self.builder, self.loadvar(side.name), kind, wanted)
            for side, kind, wanted in zip((expr.lhs, expr.rhs), given, signature.args, strict=True)
        ]
        wanted = call_type(self.context.typing_context, function, signature.args)
        result = self.context.get_function(function, wanted)(self.builder, values)
        return self.context.cast(self.builder, result, signature.return_type, resty)

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        """Write the reading of an element."""
        pointer = self._element(value, index, signature)
        if pointer is None:
            return super().lower_getitem(resty, expr, value, index, signature)
        kind = signature.args[0]
        return self.context.cast(
            self.builder, load_item(self.context, self.builder, kind, pointer), signature.return_type, resty
        )

    def lower_inst(self, inst: Any) -> None:
        """Write a statement: the assignment to an element whose index is known as any other."""
        if type(inst).__name__ == "StaticSetItem" and _in_rows(self.typeof(inst.target.name)):
            signature = self.fndesc.calltypes[inst]
            self.lower_setitem(inst.target, inst.index_var, inst.value, signature)
            return
        super().lower_inst(inst)

    def lower_setitem(self, target: Any, index: Any, value: Any, signature: Any) -> Any:
        """Write the assignment to an element."""
        pointer = self._element(target, index, signature)
        if pointer is None:
            return super().lower_setitem(target, index, value, signature)
        kind = signature.args[0]
        number = self.context.cast(self.builder, self.loadvar(value.name), self.typeof(value.name), kind.dtype)
        store_item(self.context, self.builder, kind, number, pointer)
        return self.context.get_dummy_value()

    def _ours(self) -> bool:
        """Whether the function is of this package: none of its indices counts from the end."""
        return str(self.func_ir.func_id.modname).partition(".")[0] in OURS

    def _element(self, array: Any, index: Any, signature: Any) -> Any:
        """Write the address of an element of an array in C order; None if it is not a single element of one."""
        kind: Any = self.typeof(array.name)
        among: Any = self.typeof(index.name)
        kinds = getattr(among, "types", (among,))
        single = _in_rows(kind) and len(kinds) == kind.ndim and all(isinstance(k, types.Integer) for k in kinds)
        if not single or self.context.enable_boundscheck or kind != signature.args[0]:
            return None
        builder, described, at = self.builder, self.loadvar(array.name), self.loadvar(index.name)
        shape = array_part(self.context, builder, kind, described, "shape")
        place = None
        for axis, each in enumerate(kinds):
            i = builder.extract_value(at, axis) if isinstance(among, types.BaseTuple) else at
            i, length = self.context.cast(builder, i, each, types.intp), builder.extract_value(shape, axis)
            if each.signed and not self._ours():  # it may count from the end
                negative = builder.icmp_signed("<", i, i.type(0))
                i = builder.select(negative, builder.add(length, i), i)
            place = i if place is None else builder.add(builder.mul(place, length), i)
        return builder.gep(array_part(self.context, builder, kind, described, "data"), [place])


def _in_rows(kind: Any) -> bool:
    """Whether a type is that of an array in C order, which can be written and is where its numbers may be."""
    return type(kind) is types.Array and kind.layout == "C" and kind.ndim > 0 and kind.aligned


@register_pass(mutates_CFG=True, analysis_only=False)
class LowerDirectly(NativeLowering):
    """numba's pass that writes LLVM's code, with `DirectLower`."""

    _name = "lower_directly"

    @property
    def lowering_class(self) -> Any:
        """The writer."""
        return DirectLower
