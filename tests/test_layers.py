"""The wings of `closedloop`: each imports only itself and those before it in the list, lazily and for types as well."""

import ast
import re
from functools import cache
from importlib import import_module
from pathlib import Path

from closedloop.base.upwards import ABOVE
from closedloop.command.table import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
WINGS = (
    "paper", "base", "jit", "mechanics", "control", "scenario", "loop", "record", "simulation", "figures", "studies",
    "lab", "gym", "serve", "command", "plugins", "run", "__main__", "__init__",
)  # fmt: skip
# Modules that import by name what users named, and their own files.
NEVER_UPWARDS = {"closedloop.base.families", "closedloop.scenario.user_module"}


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


def wing(module):
    """Return the wing of a module: its package or file at the top of `closedloop`."""
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


def test_every_wing_is_in_the_list():
    """The list has every file and folder at the top of the package, and nothing else."""
    assert {wing(name) for name in import_graph()} == set(WINGS)


def test_the_map_names_every_room():
    """CONTRIBUTING's table has each wing, in the order of the imports, with all packages in it and what each is for."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE)
    assert [name for name, _ in rows] == ["paper", *(name for name in WINGS if (ROOT / "closedloop" / name).is_dir())]
    for name, said in rows[1:]:
        rooms = {file.parent.name for file in (ROOT / "closedloop" / name).glob("*/__init__.py")}
        assert not rooms - set(re.findall(r"`(\w+)`", said)), name


def test_no_import_runs_upwards():
    """A wing imports from itself and from those before it in the list."""
    upwards = {
        (name, other)
        for name, others in import_graph().items()
        for other in others
        if WINGS.index(wing(other)) > WINGS.index(wing(name))
    }
    assert not upwards


def test_the_paper_stands_alone():
    """The paper's simulation in one file imports nothing of the package, and nothing of it is imported."""
    assert not import_graph()["closedloop.paper"]
    assert not [name for name, others in import_graph().items() if "closedloop.paper" in others]


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
    """Below the commands only what a run calls above itself is imported by a name that is not in an import."""
    below = {n: file.read_text(encoding="utf-8") for n, file in modules("closedloop").items()}
    below = {name: text for name, text in below.items() if WINGS.index(wing(name)) < WINGS.index("command")}
    by_name = {name for name, text in below.items() if "import_module" in text or "resolve_name" in text}
    assert by_name == {"closedloop.base.upwards", *NEVER_UPWARDS}
    for above in ABOVE.values():
        module, _, function = above.partition(":")
        assert wing(module) in ("scenario", "simulation", "figures", "lab")
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
    assert {wing(name) for name in knowing} == {"jit"}


def test_validation_is_named_by_the_table_of_commands_alone():
    """`validate`, `study` and `robots --check` start the harness by its name; no other text names a module of it."""
    naming = {
        (name, node.value)
        for name, file in modules("closedloop").items()
        for node in nodes(file)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        and re.fullmatch(r"validation[.:][\w.:]+", node.value)
    }  # fmt: skip
    starts = {"validation.run:main", "validation.studies.__main__:main", "validation.robot_check:said"}
    assert naming == {("closedloop.command.table", start) for start in starts}


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
