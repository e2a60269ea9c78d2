"""The layers of `closedloop`: each package imports only those before it in the list, lazily and for types as well."""

import ast
import re
from functools import cache
from importlib import import_module
from pathlib import Path

from closedloop.command.table import COMMANDS
from closedloop.record.run import DRAWN_BY

ROOT = Path(__file__).resolve().parent.parent
LAYERS = (
    "interrupts", "jit", "errors", "files", "progress", "second_process", "sections", "parameters", "families",
    "user_code", "integrators", "robot", "surface", "closure", "loops", "friction", "impact", "control", "reference",
    "scenario", "contacts", "step", "events", "columns", "report", "record", "engines", "figures", "simulation",
    "batch", "command", "sweep", "lab", "export", "study", "run", "__main__", "__init__",
)  # fmt: skip
# Modules that import by name what users named, and their own files.
NEVER_UPWARDS = {"closedloop.base.families.family", "closedloop.mechanics.friction"}


def modules(package):
    """Return name -> file of every module of a package."""
    found = {}
    for file in sorted((ROOT / package).rglob("*.py")):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = file
    return found


@cache
def nodes(file):
    """Return what is looked at of a file's syntax tree, imports and texts; the whole trees would stay in memory."""
    found = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
    return tuple(
        node
        for node in found
        if isinstance(node, (ast.Import, ast.ImportFrom))
        or (isinstance(node, ast.Constant) and isinstance(node.value, str))
    )


def imported(file, known):
    """Return the modules among `known` that a file imports, wherever in it."""
    names = set()
    for node in nodes(file):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    found = set()
    for name in names:
        parts = name.split(".")
        while parts and ".".join(parts) not in known:
            parts.pop()
        if parts:
            found.add(".".join(parts))
    return found


@cache
def import_graph():
    """Return module -> modules of `closedloop` that it imports."""
    known = modules("closedloop")
    return {name: imported(file, known) - {name} for name, file in known.items()}


def layer(module):
    """Return the layer of a module: its package or file at the top of `closedloop`."""
    return [*module.split("."), "__init__"][1]


def cycles(arrows):
    """Return the sets of modules that import each other in a loop (Tarjan's strongly connected components)."""
    index, low, stack, found = {}, {}, [], []

    def visit(node):
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in arrows[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = set(stack[stack.index(node) :])
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(group)

    for node in arrows:
        if node not in index:
            visit(node)
    return found


def test_every_package_is_in_the_list():
    """Every file and folder at the top of the package is in the list; at most twelve are files."""
    top = {layer(name) for name in import_graph()}
    assert top <= set(LAYERS)
    assert sum(file.parent == ROOT / "closedloop" for file in modules("closedloop").values()) <= 12


def test_no_import_runs_upwards():
    """A layer imports from itself and from those before it in the list."""
    upwards = {
        (name, other)
        for name, others in import_graph().items()
        for other in others
        if LAYERS.index(layer(other)) > LAYERS.index(layer(name))
    }
    assert not upwards


def test_no_files_import_each_other():
    """There is no circle of imports, lazy ones and those for types included."""
    assert not cycles(
        {name: others - {"closedloop"} for name, others in import_graph().items() if name != "closedloop"}
    )


def test_a_cycle_is_found():
    """Three modules in a loop are a cycle, a tree has none."""
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
    assert cycles({"a": {"b"}, "b": {"c"}, "c": set()}) == []


def test_what_is_imported_by_name_is_named_in_one_place():
    """Below the commands only a run's drawings, which are above it, are imported by a name that is not in an import."""
    by_name = {
        name
        for name, file in modules("closedloop").items()
        if "import_module" in file.read_text(encoding="utf-8") and LAYERS.index(layer(name)) < LAYERS.index("command")
    }
    assert by_name == {"closedloop.record.run", *NEVER_UPWARDS}
    for drawn_by in DRAWN_BY.values():
        module, _, function = drawn_by.partition(":")
        assert layer(module) in ("figures", "lab")
        assert callable(getattr(import_module(module), function))


def test_only_jit_imports_the_inside_of_numba():
    """The inside of numba, and llvmlite, are imported in `jit` alone."""
    inside = ("numba.core", "numba.extending", "numba.np", "llvmlite")
    knowing = {
        name
        for name, file in modules("closedloop").items()
        for node in nodes(file)
        for name_imported in (
            [node.module or ""] if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        )
        if name_imported.startswith(inside)
    }  # fmt: skip
    assert {layer(name) for name in knowing} == {"jit"}


def test_validation_is_named_by_the_table_of_commands_alone():
    """`closedloop validate` starts the harness by its name; no other text of the package names a module of it."""
    naming = {
        (name, node.value)
        for name, file in modules("closedloop").items()
        for node in nodes(file)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        and re.fullmatch(r"validation[.:][\w.:]+", node.value)
    }  # fmt: skip
    assert naming == {("closedloop.command.table", "validation.run:main")}


def test_commands_are_of_this_project():
    """The table names modules of the project, which exist: nothing of a user's is imported by it."""
    known = modules("closedloop") | modules("validation")
    assert {command.main.partition(":")[0] for command in COMMANDS} <= set(known)


def test_packages_know_each_other_one_way():
    """`closedloop` never imports `validation`, and `robot_models` imports neither."""
    everything = modules("closedloop") | modules("validation") | modules("robot_models")
    for package, never in (("closedloop", ("validation",)), ("robot_models", ("closedloop", "validation"))):
        for name, file in modules(package).items():
            assert not [other for other in imported(file, everything) if other.split(".")[0] in never], name
            assert not [node for node in nodes(file) if isinstance(node, ast.ImportFrom) and node.level], name
