"""The rooms of `closedloop`: each imports only rooms above it in the list, lazily and for types as well."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROOMS = (
    "interrupts", "jit", "errors", "files", "progress", "sections", "parameters", "families", "user_code",
    "integrators", "robot", "surface", "closure", "friction", "impact", "control", "reference", "scenario", "step",
    "events", "record", "report", "engines", "figures", "simulation", "batch", "command", "sweep", "study", "run",
    "__main__", "__init__",
)  # fmt: skip
# A run gives its summary on request.
UPWARDS = {("closedloop.record.run", "closedloop.report")}
# Files that import each other, with what for: a run's summary; a message about a key names the keys of a scenario.
CIRCLES = [
    {"closedloop.record.netcdf", "closedloop.record.run", "closedloop.report", "closedloop.report.assumptions",
     "closedloop.report.summary", "closedloop.report.tables"},
    {"closedloop.scenario.messages", "closedloop.scenario.scenario"},
]  # fmt: skip


def modules(package):
    """Return name -> file of every module of a package."""
    found = {}
    for file in sorted((ROOT / package).rglob("*.py")):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix(".__init__")] = file
    return found


def imported(file, known):
    """Return the modules among `known` that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
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
def house():
    """Return module -> modules of `closedloop` that it imports."""
    known = modules("closedloop")
    return {name: imported(file, known) - {name} for name, file in known.items()}


def room(module):
    """Return the room that a module stands in."""
    return [*module.split("."), "__init__"][1]


def circles(arrows):
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


def test_every_room_is_in_the_list():
    """No file or folder stands at the top of the package that the list does not place; it has at most twelve files."""
    top = {room(name) for name in house()}
    assert top <= set(ROOMS)
    assert sum(file.parent == ROOT / "closedloop" for file in modules("closedloop").values()) <= 12


def test_no_import_runs_upwards():
    """A room imports from itself and from rooms above it in the list."""
    upwards = {
        (name, other)
        for name, others in house().items()
        for other in others
        if ROOMS.index(room(other)) > ROOMS.index(room(name))
    }
    assert upwards == UPWARDS


def test_no_other_files_import_each_other():
    """Circles of imports are those that are named here."""
    found = circles({name: others - {"closedloop"} for name, others in house().items() if name != "closedloop"})
    assert sorted(map(sorted, found)) == sorted(map(sorted, CIRCLES))


def test_a_circle_and_an_arrow_upwards_are_seen():
    """Three modules in a loop are a circle, a tree is none."""
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []


def test_the_compiler_is_known_in_its_room_only():
    """The inside of numba, and llvmlite, are imported in `jit` alone."""
    inside = ("numba.core", "numba.extending", "numba.np", "llvmlite")
    knowing = {
        name
        for name, file in modules("closedloop").items()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        for said in (
            [node.module or ""] if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        )
        if said.startswith(inside)
    }  # fmt: skip
    assert {room(name) for name in knowing} == {"jit"}


def test_packages_know_each_other_one_way():
    """`closedloop` never imports `validation`, and `robot_models` imports neither."""
    everything = modules("closedloop") | modules("validation") | modules("robot_models")
    for package, never in (("closedloop", ("validation",)), ("robot_models", ("closedloop", "validation"))):
        for name, file in modules(package).items():
            assert not [other for other in imported(file, everything) if other.split(".")[0] in never], name
