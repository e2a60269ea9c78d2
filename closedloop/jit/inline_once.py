"""Compile the kernels inside a step once, not once for each level of their nesting.

numba optimises each compiled function together with all that it calls, generates machine code, and links the same
unoptimised code into its caller, where it is optimised again: a function five levels deep is optimised six times, and
only the outermost is called from Python. Here inner functions stay LLVM's input; the outermost is optimised once, with
all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite.binding import create_pass_builder, create_pipeline_tuning_options
from numba.core import config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering, NopythonTypeInference

from closedloop.jit.lower_directly import LowerDirectly
from closedloop.jit.typing_once import InferOnce
from robot_models.cached import cached_property


class NestedLibrary(JITCodeLibrary):
    """Code to be linked into a caller: neither optimised nor turned into machine code by itself."""

    def finalize(self) -> None:
        """Collect what this code calls; leave the rest to the caller."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            if hasattr(library, "_reload_init"):  # since numba 0.62
                self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class EntryLibrary(JITCodeLibrary):
    """Code that Python calls, whose loops are neither unrolled nor vectorised.

    They run over two to seven joints, or three axes: eight at a time there are none. It was two thirds of LLVM's time.
    """

    vectorised = False

    def _optimize_final_module(self) -> None:
        codegen = self._codegen
        if not hasattr(codegen, "_pass_builder"):  # numba 0.61
            super()._optimize_final_module()
            return
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
        state["library"] = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        state["library"].enable_object_caching()
        return False


@register_pass(mutates_CFG=False, analysis_only=True)
class MakeLongLoops(MakeEntry):
    """The compiler pass that makes the function's library a `LongLoopsLibrary`."""

    _name = "make_long_loops"
    library = LongLoopsLibrary


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
        """Return numba's passes, two of them replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(self.first, NopythonTypeInference)
        return [_quick(passes)]


class LongLoopsCompiler(EntryCompiler):
    """The same, for loops that are worth vectorising."""

    first = MakeLongLoops


def _quick(passes: Any) -> Any:
    quick = {NopythonTypeInference: InferOnce, NativeLowering: LowerDirectly}
    passes.passes = [(quick.get(each, each), why) for each, why in passes.passes]
    passes.finalize()
    return passes


class NestedCompiler(CompilerBase):
    """numba's compiler, with `KeepNested`."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's passes and ours among them."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(KeepNested, NopythonTypeInference)
        return [_quick(passes)]


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
