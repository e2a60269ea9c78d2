"""``closedloop COMMAND``: the table of commands, and those that look at what is there."""

import json
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
from closedloop.__main__ import main
from closedloop.command.lists import names
from closedloop.command.table import COMMANDS, overview
from closedloop.control.law import LAWS, ControlLaw
from closedloop.mechanics.loops import reactions
from closedloop.scenario.load import toml_value
from validation.loops.cases import MECHANISMS
from validation.robot_check import checks

ROOT = Path(cl.__file__).parent.parent


class Own(ControlLaw):
    """A user's law."""

    @staticmethod
    def torque(x, par, z, torque):
        """Ask for nothing."""
        torque[:] = 0.0


@pytest.fixture
def closedloop(capsys, monkeypatch, tmp_path):
    """Return a function that runs ``closedloop`` here, in an empty folder, and returns (status, output, errors)."""
    monkeypatch.chdir(tmp_path)

    def call(*words):
        capsys.readouterr()
        status = main([str(word) for word in words])
        said = capsys.readouterr()
        return status, said.out, "".join(x for x in said.err.splitlines(True) if not x.startswith("compiling "))

    return call


@pytest.fixture(scope="module")
def saved(tmp_path_factory, shipped_run):
    """Return the file of a run."""
    return shipped_run("planar2_slide").save(tmp_path_factory.mktemp("saved") / "run.nc")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_command_is_there_and_says_what_it_is(command, closedloop):
    """The function that the table names exists, its --help fits on a screen, and a wrong word is refused."""
    module, _, function = command.main.partition(":")
    assert callable(getattr(import_module(module), function))
    status, out, err = closedloop(command.name, "--help")
    assert (status, err) == (0, "")
    assert len(out.splitlines()) <= 51
    assert f"\n  {command.name} " in overview()
    assert len(command.help) + 14 <= 80
    status, out, err = closedloop(command.name, "--nosuch")
    assert (status, out) == (2, "")
    assert re.fullmatch(r"(closedloop|closedloop sweep|closedloop study|validation): command line: .*\n", err)


def test_the_words_before_a_command(closedloop):
    """Without a word the user is told of --help; a misspelt command is refused with the nearest; a scenario runs."""
    assert closedloop()[2].startswith("closedloop: name a command, such as `closedloop run wam_slide`")
    assert closedloop("swep")[::2] == (
        2, "closedloop: there is no command and no scenario 'swep'; did you mean 'sweep'?\n"
    )  # fmt: skip
    assert closedloop("--help")[:2] == (0, overview() + "\n")
    assert closedloop("--version")[1] == closedloop("version")[1]
    for words in (["planar2_slide"], ["run", "planar2_slide"]):
        status, out, err = closedloop(*words, "--time.duration", "0.01", "--no-figures", "--json")
        assert (status, err) == (0, "")
        assert json.loads(out)["steps"] == 10


def test_a_command_imports_what_it_needs_and_no_more(tmp_path):
    """The overview loads no other command; a foreign package called validation is named, and its code is not run."""
    code = "import sys; from closedloop.__main__ import main; main(['--help']); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout.split()
    assert not {"pydantic", "pinocchio", "closedloop.run", "validation", "closedloop.studies.sweep"} & set(loaded)
    (tmp_path / "validation").mkdir()
    (tmp_path / "validation" / "__init__.py").write_text("")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]\n" + "from closedloop.__main__ import main\n"
    code += "sys.exit(main(['validate', '--quick']))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert re.fullmatch(
        r"closedloop: validate: needs the module validation.run, and the package 'validation' in .*__init__.py is "
        r"another one\n",
        done.stderr,
    )


def test_a_saved_run_is_shown(closedloop, saved):
    """`show` prints the report, with --json the summary; a file that is no run is refused."""
    status, out, err = closedloop("show", saved)
    assert (status, err) == (0, "")
    assert out.startswith("verdict: good\ncontrol: good\nplanar2_slide: the paper's assumptions")
    assert json.loads(closedloop("show", saved, "--json")[1]) == cl.load_run(saved).summary()
    assert closedloop("show", "nosuch.nc")[::2] == (2, "closedloop: nosuch.nc: there is no such file\n")


@pytest.mark.slow
def test_a_saved_run_is_drawn(closedloop, saved, tmp_path, monkeypatch):
    """`plot` writes the figures of the file, into the folder that is named, and nothing else."""

    def drawn_quickly(draw, run, stem):
        (file := stem.with_suffix(".png")).touch()
        return file

    monkeypatch.setattr("closedloop.figures.files.save_figure", drawn_quickly)
    status, out, err = closedloop("plot", saved, "--out", "figures")
    assert (status, err) == (0, "")
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"fig_tip_position", "fig_contact_force", "fig_closure_error", "fig_force_control"} <= drawn
    assert all(f"{name}.png" in out for name in drawn)


def test_a_saved_run_is_drawn_for_a_journal(closedloop, saved, tmp_path):
    """With a format, a width, a font, and the columns that are asked for; what is none of these is refused."""
    asked = ("--columns", "f,e", "--format", "pdf", "--width", "3.5", "--font", "8", "--out", "paper")
    assert closedloop("plot", saved, *asked) == (0, "wrote paper/: fig_f_e.pdf\n", "")
    assert [path.name for path in (tmp_path / "paper").iterdir()] == ["fig_f_e.pdf"]
    both = ["--columns", "f,e", "--out", "both", "--format", "pdf,png"]
    assert closedloop("plot", saved, *both) == (0, "wrote both/: fig_f_e.pdf, each also as .png\n", "")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+)", (tmp_path / "paper" / "fig_f_e.pdf").read_bytes())
    assert float(box[1]) == 3.5 * 72
    for wrong, said in (
        (("--format", "gif"), "--format gif: 'gif' is none of png, svg, pdf"),
        (("--width", "0"), "--width 0: must be from 1.5 to 40 inches"),
        (("--font", "900"), "--font 900: must be from 3 to 40 points"),
        (("--columns", "g"), "columns: 'g': the run has no such column over time; there are f, f_des"),
    ):
        status, _, err = closedloop("plot", saved, *wrong, "--out", "none")
        assert status == 2
        assert err.startswith(f"closedloop: {said}")
    assert not (tmp_path / "none").exists()


def test_numbers_with_commas_are_a_list_and_a_normal_has_a_direction(closedloop):
    """A list on the command line needs no brackets; a normal without a length is refused as it is read."""
    assert toml_value("0,0,1") == [0.0, 0.0, 1.0]
    assert toml_value("a,b") == "a,b"
    status, _, err = closedloop("run", "planar2_slide", "--surface.normal", "0,0,0")
    said = "surface.normal = [0.0, 0.0, 0.0]: has no direction; give a vector such as [0, 0, 1]"
    assert status == 2
    assert err.startswith(f"closedloop: planar2_slide: {said}")
    with pytest.raises(cl.ScenarioError, match="has no direction"):
        cl.load_scenario("wam_slide", {"surface.normal": [0, 0, 0]})


def test_american_spelling_and_names_of_other_programs(closedloop):
    """`linearize` and `analyze` are there; a name that is none says what to call."""
    assert cl.linearize is cl.linearise
    assert closedloop("analyze", "--help")[0] == 0
    for name, said in (
        ("sim", "; call closedloop.simulate(scenario)"),
        ("simulat", "; did you mean 'simulate'?"),
        ("zzzz", ""),
    ):
        with pytest.raises(AttributeError) as refused:
            getattr(cl, name)
        assert str(refused.value) == f"module 'closedloop' has no attribute '{name}'{said}"


def test_robots_are_listed_with_their_joints(closedloop, monkeypatch):
    """Each robot has a line, or the reason why not; one robot's joints, limits and frames are shown."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("closedloop.command.lists.names", lambda: ("planar2", "ur5", "cassie"))
    status, out, err = closedloop("robots")
    assert (status, err) == (0, "")
    assert max(map(len, out.partition("not to be used")[0].splitlines())) <= 80
    assert re.search(r"ur5 +6 +tool0 +shoulder_pan_joint", out)
    assert "'cassie' is described in SDF" in out
    assert "shoulder_lift_joint " in closedloop("robots", "ur5")[1]  # whole, at the width of a terminal
    one = closedloop("robots", "panda")[1]
    for words in (
        "panda_joint7",
        "-3.072",
        "held rigid: panda_finger_joint1 at 0",
        "tip: panda_hand_tcp",
        "panda_link8",
    ):
        assert words in one
    assert closedloop("robots", "pandas")[0] == 2
    assert {"wam4", "ur5", "panda", "talos_arm"} <= set(names())


TENDON_HAND = """<mujoco model="hand"><worldbody><body name="palm"><geom size=".05" mass="1"/>
<body name="left" pos="0 .1 0"><joint name="l" type="slide" range="0 .1"/><geom type="box" size=".01 .02 .03"/></body>
<body name="right"><joint name="r" type="slide" axis="0 0 1"/><geom type="box" size=".01 .02 .03"/>
<body name="end" pos="0 0 .1"><joint name="e" axis="1 0 0" stiffness="2"/><geom size=".02"/></body></body></body>
</worldbody>
<equality><joint name="both" joint1="r" joint2="l" polycoef="0 -1 0.5 0 0"/></equality>
<tendon><fixed name="t" stiffness="30 1" springlength="-.1 .2" frictionloss=".3" range="-.5 .5" limited="true">
<joint joint="l" coef=".5"/><joint joint="r" coef="-.5"/></fixed></tendon>
<actuator><motor tendon="t" ctrlrange="-5 5"/></actuator><sensor><jointpos joint="l"/></sensor></mujoco>"""


def test_robots_prints_and_checks_what_was_read(closedloop, tmp_path, monkeypatch):
    """Drives, couplings, shapes, masses and warnings; H and C are those of Pinocchio and of MuJoCo, or it says so."""
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "hand.xml").write_text(TENDON_HAND)
    status, out, err = closedloop("robots", str(tmp_path / "hand.xml"), "--check")
    assert (status, err) == (0, "")
    for words in (
        "total mass: ", "joints without a drive: e", "coupling: both: r = -1 l + 0.5 l^2", "2 box, 2 sphere",
        "warning: sensors of the file are left out", "the limits are stops with robot.stops = true",
        "tendon: t: 0.5 l + -0.5 r: spring 30 1 about [-0.1, 0.2], friction 0.3, range [-0.5, 0.5]",
        "spring: e: 1 e: spring 2 about 0", "(damping and frictionloss; t) does not act",
        "Pinocchio: equal", "MuJoCo: equal at 20 random states", "potential energy ", "Jacobian of the tip ", "loops ",
    ):  # fmt: skip
        assert words in out, words
    out = closedloop("robots", "panda", "--check")[1]
    assert [line.split()[1] for line in out.splitlines() if "random states" in line] == ["equal", "equal"]
    tree_terms = "closedloop.mechanics.robot.tree.tree_terms"
    monkeypatch.setattr(tree_terms, lambda tree, q, v, work, H, C, of_tip: C.fill(1.0))  # a planted fault
    status, out, _ = closedloop("robots", str(tmp_path / "hand.xml"), "--check")
    assert status == 1
    assert "Pinocchio: DIFFERENT: H, C, Jacobian of the tip;" in out
    assert "MuJoCo: DIFFERENT: H, C, Jacobian of the tip;" in out


@pytest.mark.parametrize(
    ("fault", "differs"),
    [
        ("closedloop.mechanics.robot.tree.tree_potential_energy", "potential energy"),
        ("closedloop.mechanics.loops.reactions.loop_rows", "rows of loops"),
    ],
)
def test_robots_checks_energy_and_loops(closedloop, tmp_path, monkeypatch, fault, differs):
    """A planted fault in the energy, or in the rows of a loop that a `connect` closes, is named."""
    (tmp_path / "loop.xml").write_text(CLOSED_BY_CONNECT)
    assert closedloop("robots", str(tmp_path / "loop.xml"), "--check")[0] == 0
    whole = import_module(fault.rpartition(".")[0]).__dict__[fault.rpartition(".")[2]]
    planted = {
        "potential energy": lambda tree, q, work: whole(tree, 1.001 * q, work),
        "rows of loops": lambda robot, q, v: (whole(robot, q, v)[0] * [1.0, 1.001, 1.0], whole(robot, q, v)[1]),
    }
    monkeypatch.setattr(fault, planted[differs])
    status, out, _ = closedloop("robots", str(tmp_path / "loop.xml"), "--check")
    assert status == 1
    assert f"DIFFERENT: {differs};" in out


CHECKED = ("four_bar", "slider_crank", "spatial_slider", "cut_coupler", "plate", "gears", "cardan", "distance")


@pytest.mark.parametrize("name", CHECKED)
def test_loops_of_a_urdf_are_checked_by_pinocchios_constraints(name, monkeypatch):
    """Loop joints of every type hold what Pinocchio's constraints or Jacobians hold, but with a planted fault."""
    mechanism = MECHANISMS[name]()
    found = {check.program: check for check in checks(mechanism, name)}["Pinocchio's constraints"]
    assert found.apart["rows of loops"] < 1e-12
    whole = reactions.loop_rows

    def planted(robot, q, v):
        rows, errors = whole(robot, q, v)
        return rows + 1e-3 * np.roll(rows, 1, axis=-1), errors

    monkeypatch.setattr(reactions, "loop_rows", planted)
    found = {check.program: check for check in checks(mechanism, name)}["Pinocchio's constraints"]
    assert found.apart["rows of loops"] > found.most


CLOSED_BY_CONNECT = """<mujoco model="loop"><worldbody>
<body name="a"><joint name="a" axis="0 1 0"/><geom type="box" size=".02 .02 .1" pos="0 0 .1"/>
<body name="b" pos="0 0 .2"><joint name="b" axis="0 1 0"/><geom type="box" size=".1 .02 .02" pos=".1 0 0"/></body>
</body><body name="c" pos=".2 0 0"><joint name="c" axis="0 1 0"/>
<geom type="box" size=".02 .02 .1" pos="0 0 .1"/></body>
</worldbody><equality><connect name="pin" body1="b" body2="c" anchor=".2 0 0"/></equality></mujoco>"""


def test_completion_knows_commands_options_and_keys(closedloop):
    """The words come from the table, the parsers and the schema; bash gives those that begin as what is typed."""
    pytest.importorskip("shtab", reason="shtab is not installed")
    LAWS.named(Own, "law.kind")  # which is not among them: the words do not depend on what the process has seen
    _, script, _ = closedloop("completion", "bash")
    lines = {
        "ru": "run", "run wam_slide_un": "wam_slide_unstabilised", "study ": "drift controllers surfaces",
        "run wam_slide --law.k": "--law.kind --law.kp --law.kd", "run --law.kind ": " ".join(LAWS.names()),
        "run x --engine ": "pinocchio compiled", "run --str": "--strict", "robots wam": "wam4 wam7",
        "sweep wam_slide --ov": "--over --overwrite", "analyse --time.st": "--time.step",
    }  # fmt: skip
    ask = [script]
    for line in lines:
        *before, word = f"closedloop {line}".split(" ")
        ask.append(
            f"COMP_WORDS=({' '.join(before)} '{word}'); COMP_CWORD={len(before)}; "
            f"_shtab_closedloop closedloop '{word}' {before[-1]}; echo ${{COMPREPLY[@]}}"
        )
    done = subprocess.run(["bash"], input="\n".join(ask), capture_output=True, text=True, check=True)
    assert dict(zip(lines, done.stdout.splitlines(), strict=True)) == lines
    for shell in ("zsh", "fish"):
        assert "closedloop" in closedloop("completion", shell)[1]
    assert closedloop("completion", "tcsh")[2].startswith("closedloop: command line: argument shell: invalid choice")


@pytest.mark.parametrize(("given", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_a_command_computes_in_one_thread_unless_it_is_told(given, threads):
    """A small matrix takes two threads of OpenBLAS seconds where another process has a core."""
    code = "import os, sys; sys.argv = ['closedloop']; import closedloop; print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"} | given
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == f"{threads}\n"
