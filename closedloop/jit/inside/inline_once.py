"""Compile the kernels inside a step once, not once for each level of their nesting.

numba optimises each compiled function together with all that it calls, generates machine code, and links the same
unoptimised code into its caller, where it is optimised again: a function five levels deep is optimised six times, and
only the outermost is called from Python. Here inner functions stay LLVM's input; the outermost is optimised once, with
all of them.

LLVM's code for elements of arrays and for arithmetic is written directly. numba's own way to `a[i]` copies the array's
description to the stack and back, and asks for the types and the implementation again; of a kernel's compile time that
was a third, most of it in Python. The code means the same, but in kernels of this package an index may not be negative:
it is not tested.

numba is asked once, not at each place of each kernel, what an operator makes of arguments of plain types: it finds the
type of `a * b` by trying all that is known of `*` in turn (strings, lists, array expressions ...), for each such
expression several times. Of numbers and of arrays of numbers the answer depends on their types alone.
"""

import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType
from typing import Any

from llvmlite.binding import Linkage, create_pass_builder, create_pipeline_tuning_options
from llvmlite.binding.newpassmanagers import create_new_function_pass_manager
from numba.core import config, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.cpu import CPUContext
from numba.core.lowering import Lower
from numba.core.postproc import PostProcessor
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import ConfigStack
from numba.core.transforms import canonicalize_cfg
from numba.core.typed_passes import IRLegalization, NativeLowering, NopythonRewrites, NopythonTypeInference
from numba.core.types import unliteral
from numba.core.untyped_passes import InlineClosureLikes, TranslateByteCode
from numba.np.arrayobj import load_item, store_item

from closedloop.jit.inside.blocks import array_part
from robot_models.cached import cached_property

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

    Raises numba.TypingError: there is no such call.
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


class KernelLibrary(JITCodeLibrary):
    """Code that was cleaned, function by function: what it is linked into has a third of the text."""

    def _optimize_functions(self, ll_module: Any) -> None:
        if not hasattr(self._codegen, "_pass_builder"):  # numba 0.61
            super()._optimize_functions(ll_module)
            return
        ll_module.data_layout = self._codegen._data_layout
        passes = create_new_function_pass_manager()
        passes.add_sroa_pass()
        passes.add_simplify_cfg_pass()
        passes.add_instruction_combine_pass()
        passes.add_aggressive_dce_pass()
        builder = create_pass_builder(self._codegen._tm, create_pipeline_tuning_options(0))
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)


class NestedLibrary(KernelLibrary):
    """Code to be linked into a caller: neither optimised nor turned into machine code by itself."""

    def finalize(self) -> None:
        """Leave everything to the outermost caller, which links what this code calls too."""
        self._raise_if_finalized()
        self._finalized = True

    @cached_property
    def own(self) -> Any:
        """The code without what it calls, marked as such that may be there several times."""
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.external:
                function.linkage = "linkonce_odr"
        return self._final_module

    def _get_module_for_linking(self) -> Any:
        """Return the code for a caller that numba compiles, which links only what it calls itself."""
        if self._shared_module is None:
            self._shared_module = self.own.clone()
            _link(self, self._shared_module)
        return self._shared_module


def _link(library: Any, module: Any) -> None:
    """Link what a library calls into a module, each once, after its callers: LLVM drops what nothing calls yet."""
    found: dict[Any, None] = {}
    _called(library, found)
    for each in reversed(found):
        if hasattr(each, "_reload_init"):  # since numba 0.62
            library._reload_init.update(each._reload_init)
        code = each.own if isinstance(each, NestedLibrary) else each._get_module_for_linking()
        module.link_in(code, preserve=True)


def _called(library: Any, found: dict[Any, None]) -> None:
    """Add all libraries that one calls, directly or through nested ones, each after those that it calls."""
    for each in library._linking_libraries:
        if each not in found:
            if isinstance(each, NestedLibrary):
                _called(each, found)
            found[each] = None


class EntryLibrary(KernelLibrary):
    """Code that Python calls, whose loops are neither unrolled nor vectorised.

    They run over two to seven joints, or three axes: eight at a time there are none. It was two thirds of LLVM's time.
    """

    vectorised = False

    def finalize(self) -> None:
        """Link all that this code calls, and optimise it."""
        _link(self, self._final_module)
        self._linking_libraries = []
        super().finalize()

    def _optimize_final_module(self) -> None:
        codegen = self._codegen
        if not hasattr(codegen, "_pass_builder"):  # numba 0.61
            super()._optimize_final_module()
            return
        super(KernelLibrary, self)._optimize_functions(self._final_module)
        first, builder = codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=codegen._opt_level, cost="cheap"
        )
        first.run(self._final_module, builder)
        options = create_pipeline_tuning_options(min(int(vars(config)["OPT"]), 3))
        options.loop_vectorization = self.vectorised
        options.slp_vectorization = options.loop_unrolling = False
        builder = create_pass_builder(codegen._tm, options)
        builder.getModulePassManager().run(self._final_module, builder)


class LongLoopsLibrary(EntryLibrary):
    """Code that Python calls, whose loops are vectorised: they run over the rows of many contacts."""

    vectorised = True


@register_pass(mutates_CFG=False, analysis_only=True)
class MakeEntry(AnalysisPass):
    """The compiler pass that makes the function's library an `EntryLibrary`."""

    _name = "make_entry"
    library = EntryLibrary

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Make the library before numba would make an ordinary one."""
        library = state["library"] = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        library.enable_object_caching()
        return False


@register_pass(mutates_CFG=False, analysis_only=True)
class MakeLongLoops(MakeEntry):
    """The compiler pass that makes the function's library a `LongLoopsLibrary`."""

    _name = "make_long_loops"
    library = LongLoopsLibrary


@register_pass(mutates_CFG=False, analysis_only=True)
class MarkKernel(AnalysisPass):
    """The compiler pass that marks the code of a kernel as such."""

    _name = "mark_kernel"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Mark the code that numba made of the function."""
        state.func_ir.of_kernel = not state.func_ir.is_generator
        return False


_put_in_order = PostProcessor.run


def _put_kernel_in_order(self: Any, *arguments: Any, **options: Any) -> None:
    """Put blocks in order, as numba does after most passes; of kernels, which own no memory, without lifetimes."""
    if getattr(self.func_ir, "of_kernel", False):
        self.func_ir.blocks = canonicalize_cfg(self.func_ir.blocks)
    else:
        _put_in_order(self, *arguments, **options)


PostProcessor.run = _put_kernel_in_order  # type: ignore[method-assign]


@register_pass(mutates_CFG=False, analysis_only=True)
class KeepNested(AnalysisPass):
    """The compiler pass that makes the function's library a `NestedLibrary`."""

    _name = "keep_nested"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Make the library before numba would make an ordinary one."""
        state["library"] = NestedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        return False


class EntryCompiler(CompilerBase):
    """numba's compiler, which infers types and writes LLVM's code in less time."""

    first: type[AnalysisPass] = MakeEntry

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes with changes."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(self.first, NopythonTypeInference)
        return [_quick(passes, self.state)]


class LongLoopsCompiler(EntryCompiler):
    """The same, for loops that are worth vectorising."""

    first = MakeLongLoops


def _quick(passes: Any, state: Any) -> Any:
    """Replace some of numba's passes; where no memory is owned, leave out those that look for what is not there then.

    That are array expressions, references to be released, and functions within the function.
    """
    quick = {NopythonTypeInference: InferOnce, NativeLowering: LowerDirectly}
    idle: set[Any] = set()
    if not state.flags.nrt:
        idle |= {NopythonRewrites, IRLegalization}
        if not any(isinstance(each, CodeType) for each in state.func_id.code.co_consts):
            idle.add(InlineClosureLikes)
        passes.add_pass_after(MarkKernel, TranslateByteCode)
    passes.passes = [(quick.get(each, each), why) for each, why in passes.passes if each not in idle]
    passes.finalize()
    return passes


class NestedCompiler(EntryCompiler):
    """The same, with `KeepNested`."""

    first = KeepNested


class NestedFunction(CPUDispatcher):
    """A function that compiled code calls without compiling it twice; called from Python it is an ordinary one.

    `function`: the Python function.
    `options`: numba's options of it.
    `ordinary`: makes what Python calls: the same function as numba would compile it by itself.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any], ordinary: Callable[..., Any]) -> None:
        nested = options | {"nopython": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        super().__init__(function, targetoptions=nested, pipeline_class=NestedCompiler)
        self._make_ordinary = ordinary

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return how the function is called: one form serves all numbers and flags that are known when compiling."""
        return super().get_call_template(tuple(map(unliteral, args)), {k: unliteral(v) for k, v in kws.items()})

    def add_overload(self, result: Any) -> None:
        """Keep what was compiled for compiled callers; for Python there is nothing to call."""
        key = object()  # what callers know it by
        parts = result._asdict()
        self.targetctx.insert_user_function(key, parts["fndesc"], [parts["library"]])
        self.overloads[tuple(result.signature.args)] = result._replace(entry_point=key)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the ordinary form, which numba compiles on first use."""
        return self.ordinary(*args, **kwargs)

    @cached_property
    def ordinary(self) -> Any:
        """What Python calls."""
        return self._make_ordinary()
