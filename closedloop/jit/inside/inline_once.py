"""Compile the kernels inside a step once, not once for each level of their nesting.

numba optimises each compiled function together with all that it calls, generates machine code, and links the same
unoptimised code into its caller, where it is optimised again: a function five levels deep is optimised six times, and
only the outermost is called from Python. Here inner functions stay LLVM's input; the outermost is optimised once, with
all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from types import CodeType
from typing import Any

from llvmlite.binding import Linkage, create_pass_builder, create_pipeline_tuning_options
from llvmlite.binding.newpassmanagers import create_new_function_pass_manager
from numba.core import config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.postproc import PostProcessor
from numba.core.registry import CPUDispatcher
from numba.core.transforms import canonicalize_cfg
from numba.core.typed_passes import IRLegalization, NativeLowering, NopythonRewrites, NopythonTypeInference
from numba.core.types import unliteral
from numba.core.untyped_passes import InlineClosureLikes, TranslateByteCode

from closedloop.jit.inside.lower_directly import LowerDirectly
from closedloop.jit.inside.typing_once import InferOnce
from robot_models.cached import cached_property


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


class NestedCompiler(CompilerBase):
    """numba's compiler, with `KeepNested`."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes and ours among them."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(KeepNested, NopythonTypeInference)
        return [_quick(passes, self.state)]


class NestedFunction(CPUDispatcher):
    """A function that compiled code calls without compiling it twice; called from Python it is an ordinary one.

    Parameters
    ----------
    function : callable
        The Python function.
    options : dict
        numba's options of it.
    ordinary : callable
        Makes what Python calls: the same function as numba would compile it by itself.
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
