"""README and documentation: the code in them runs, the links lead somewhere, the site is built without a warning."""

import ast
import builtins
import importlib.util
import os
import re
import subprocess
import sys
import tomllib

import pytest
from forks import command, load_for_forks, program
from pages import DOCS, PAGES, ROOT, blocks, broken_links, commands, left_out, session

import closedloop
import robot_models
import validation
from validation.studies.__main__ import STUDIES

WITH_CODE = [page for page in PAGES if blocks(page.read_text(encoding="utf-8"), "python")]
# Pages whose commands, in the folder of their Python blocks, run too; those of others take minutes, or a browser. So do
# studies, of which each has a test with its quick form, and the figures of a run, which quickstart's commands draw.
WITH_COMMANDS = ("scenarios", "controllers", "extending", "own-surfaces")
# Scenarios that the built site has in its gallery: an arm, a mechanism with a loop, and bodies.
SIMULATED = ("planar2_slide", "five_bar", "ball_on_turntable")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}


@pytest.fixture(scope="module")
def generate():
    """Return docs/generate.py as a module."""
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generated(generate, tmp_path_factory):
    """Return the pages that follow from the code, by name."""
    folder = tmp_path_factory.mktemp("generated")
    generate.write(folder, ["planar2_slide"])  # all of them take minutes
    return {page.stem: page.read_text(encoding="utf-8") for page in folder.glob("*.md")}


def test_both_verdicts_are_tabled(generate, generated):
    """A row for each scenario, with what is wrong of one that is bad."""
    assert "`planar2_slide` | good | good |" in generated["verdicts"]
    good, bad = {"problems": []}, {"problems": [{"name": "bouncing", "text": "3 touchdowns"}]}
    facts = {"verdict": good, "control_verdict": bad}
    assert generate.verdicts_of(facts) == ("good", "bouncing", "3 touchdowns")


@pytest.fixture(scope="module")
def loaded():
    """Have here what the forks of the tests below need."""
    load_for_forks()


def run_all(commands, folder):
    """Run the commands of a page one after the other, as they stand there."""
    for line in commands.splitlines():
        status, said = command(line, folder)
        assert status == 0, f"{line}\n{said}"


def undrawn(commands):
    """Return commands whose runs make no figures, which take most of their time."""
    return re.sub(r"(closedloop[ .]run) ", r"\1 --no-figures ", commands)


def test_the_readme_is_a_door():
    """It fits on a screen or two, and has the two commands."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 90
    assert len(re.findall(r"^    \S.*", text, re.MULTILINE)) == 2


@pytest.mark.parametrize("repository", [None, "https://example.org/closedloop"])
def test_a_package_index_shows_the_readme(repository):
    """In the metadata no link leads to a file beside the README; with an address each leads into the repository."""
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    config["project"]["urls"] = {} if repository is None else {"Repository": repository}
    shown = ProjectMetadata(str(ROOT), PluginManager(), config).core.readme
    links = re.findall(r"\]\(([^)]*)\)", shown)
    beside = re.findall(r"\]\(([^)]*)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert all(link.startswith("https://") for link in links)
    inside = [re.sub(rf"^{repository}/(raw|blob)/HEAD/", "", link) for link in links]
    assert inside == (beside if repository else [link for link in beside if link.startswith("https://")])
    assert ("![" in shown) == (repository is not None)


def test_links_lead_somewhere(generated):
    """Every link of README and pages to a file, a page or a heading; and a wrong one is seen."""
    for page in PAGES:
        assert broken_links(page, page.read_text(encoding="utf-8"), generated) == [], page.name
    wrong = "[a](nowhere.md) [b](theory.md#no-such-heading) [c](generated/nothing.md) [d](theory.md#the-tip)"
    assert len(broken_links(DOCS / "index.md", wrong, generated)) == 3


def test_every_page_is_in_the_contents(generated):
    """No page is left out of index.md; one that only a sentence of it names is."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    pages = {page.stem for page in DOCS.glob("*.md")} - {"index"} | {f"generated/{name}" for name in generated}
    assert left_out(index, pages) == set()
    named = index.replace("\nspeed-log\n", "\n") + "\nSee speed-log .\n"
    assert left_out(named, pages) == {"speed-log"}


def test_the_reference_is_complete(generated):
    """Every key of a scenario, every column and every public name has an entry, and a name without one is refused."""
    from closedloop.record.columns.record import COLUMNS
    from closedloop.scenario.messages import all_keys

    for key in all_keys():
        assert f"`{key}`" in generated["scenario"] or key.endswith(".kind"), key
    assert all(f"| `{name}` |" in generated["columns"] for name in COLUMNS)
    for name in closedloop.__all__:
        assert re.search(rf"^\.\. auto\w+:: closedloop\.(\w+\.)*{name}\b", generated["api"], re.MULTILINE), name


def test_a_public_name_without_a_place_is_refused(generate, monkeypatch):
    """The page of public names cannot leave one out."""
    monkeypatch.setattr(closedloop, "__all__", sorted([*closedloop.__all__, "newcomer"]))
    with pytest.raises(ValueError, match="newcomer"):
        list(generate.api())


def names_of_others(code):
    """Return the names that a program reads at its top level and in its functions and does not make itself."""
    tree = ast.parse(code)
    made = {alias.asname or alias.name.split(".")[0] for node in ast.walk(tree)
            if isinstance(node, (ast.Import, ast.ImportFrom)) for alias in node.names}  # fmt: skip
    made |= {node.name for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    made |= {node.arg for node in ast.walk(tree) if isinstance(node, ast.arg)}
    made |= {node.name for node in ast.walk(tree) if isinstance(node, ast.ExceptHandler) and node.name}
    read = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    made |= {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    return read - made - set(dir(builtins))


def test_a_recipe_stands_alone():
    """Each section's blocks make or import every name that they use; one that needs another section is seen."""
    sections = re.split(r"^## ", (DOCS / "recipes.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[2:]
    assert len(sections) >= 9
    for section in sections:
        code = "\n".join(code for _, code in blocks(section, "python"))
        assert code, section[:40]
        assert names_of_others(code) == set(), section.splitlines()[0]
    assert names_of_others("import a\nb = a.c(d)\n") == {"d"}


def test_every_study_on_a_page_exists():
    """Studies take too long to run here, but their names are those of the command."""
    given = "\n".join(commands(page.read_text(encoding="utf-8")) for page in PAGES)
    named = set(re.findall(r"^closedloop study (\S+)", given, re.MULTILINE))
    assert named == STUDIES.keys()


def test_the_controller_of_the_page_is_short():
    """The example with an integral and a state of its own has at most 25 lines."""
    text = (DOCS / "controllers.md").read_text(encoding="utf-8")
    (code,) = [code for file, code in blocks(text, "python") if file == "my_control.py"]
    assert len([line for line in code.splitlines() if line.strip()]) <= 25


def without_example(code):
    """Return the public names of the packages that a program uses nowhere."""
    used = {(node.value.id, node.attr) for node in ast.walk(ast.parse(code))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)}  # fmt: skip
    used |= {(node.module, alias.name) for node in ast.walk(ast.parse(code))
             if isinstance(node, ast.ImportFrom) for alias in node.names}  # fmt: skip
    packages = {closedloop: ("cl", "closedloop"), robot_models: ("robot_models",), validation: ("validation",)}
    return [
        f"{package.__name__}.{name}" for package, aliases in packages.items() for name in package.__all__
        if not any((alias, name) in used for alias in aliases)
    ]  # fmt: skip


def test_every_public_name_has_an_example_that_is_run():
    """Each name that the packages offer is used in the code of a page or a notebook, all of which are run."""
    pages = [code for page in PAGES for _, code in blocks(page.read_text(encoding="utf-8"), "python")]
    notebooks = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "notebooks").glob("*.py"))]
    everything = "\n".join([*pages, *notebooks])
    assert without_example(everything) == []
    assert without_example(everything.replace("robot_models.Tool", "Tool")) == ["robot_models.Tool"]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page, loaded, tmp_path):
    """All Python blocks of a page, in order, as one session in an empty folder, and then its commands."""
    text = page.read_text(encoding="utf-8")
    status, said = program(session(text), tmp_path)
    assert status == 0, said
    if page.stem in WITH_COMMANDS:
        run_all(undrawn(commands(text)), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("text", ["1 / 0", "import my_module", "raise SystemExit(2)"])
def test_code_that_fails_is_seen(text, loaded, tmp_path):
    """A program that raises or ends with another status, and a command that is refused."""
    assert program(f"print('so far')\n{text}\n", tmp_path)[0] != 0
    with pytest.raises(AssertionError, match=r"nosuch\n.*no scenario named"):
        run_all("closedloop version\nclosedloop run nosuch", tmp_path)


@pytest.mark.slow
def test_the_commands_of_the_quickstart_run(loaded, tmp_path):
    """As they stand there, one after the other, in an empty folder; the first ones with their figures."""
    text = (DOCS / "quickstart.md").read_text(encoding="utf-8")
    (_, first), (_, more) = blocks(text, "sh")
    assert (first.count("closedloop run"), more.count("closedloop run")) == (1, 3)
    run_all(first, tmp_path)
    assert (tmp_path / "out" / "wam_slide" / "fig5_contact_force.png").exists()
    run_all(undrawn(more), tmp_path)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"wam_slide", "my_slide"}
    assert all((tmp_path / name / "run.nc").exists() for name in ("stronger", "tilted"))


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    """Sphinx takes every page, docstring and link of the site; no page asks for anything from the network."""
    pytest.importorskip("sphinx", reason="the extra `docs` is not installed")
    few = f"simulated={','.join(SIMULATED)}"
    words = ["-q", "-W", "--keep-going", "-b", "html", "-D", few, DOCS, tmp_path]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    html = {
        page.relative_to(tmp_path).as_posix(): page.read_text(encoding="utf-8") for page in tmp_path.rglob("*.html")
    }
    assert {"index.html", "theory.html", "generated/api.html"} <= html.keys()
    for name, text in html.items():
        assert not re.search(r"<(?:script|img)[^>]* src=\"https?:|<link[^>]* href=\"https?:", text), name
