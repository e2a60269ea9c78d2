"""The measurement of speed: that every row did the same work, and that the command says what it measured.

No time is asserted: it belongs to the machine.
"""

import dataclasses
import json

import llvmlite.binding as llvm
import numpy as np
import pytest

import closedloop as cl
from validation.speed import loops, scenes
from validation.speed.__main__ import line_up, main
from validation.speed.contestants import ARMS, Contestant, chain, converged, final, our_engine, slide, with_errors
from validation.speed.loops import GIVES_WAY, MECHANISMS, coasting
from validation.speed.measure import Timing, growth, race, ratio, targets
from validation.speed.repeated import compiled_batch
from validation.speed.scenes import BOXES, ROBOTS, STANDS, WALL, bodies_of
from validation.speed.served import main as main_served

STEPS = 60


@pytest.mark.parametrize(
    "arm", ["planar2", *(pytest.param(arm, marks=pytest.mark.slow) for arm in ("wam4", "panda")), "chain12"]
)
def test_every_row_does_the_same_work(arm):
    """Whoever does the whole work ends at one q, and that is elsewhere than where it began by far."""
    everyone, _ = line_up([arm], STEPS * 5, 2)
    whole = [c for c in everyone if c.wanted is not None]
    names = {c.name for c in everyone}
    assert {"compiled", "pinocchio", "calls", "algorithms", "forward_dynamics"} <= names
    assert {c.name for c in whole} >= {"compiled", "pinocchio", "forward_dynamics"}
    for contestant in whole:
        seconds, end = contestant.lap()
        assert seconds is None or seconds > 0.0
        assert np.max(np.abs(end - contestant.wanted)) <= contestant.tolerance, contestant
    moved = np.max(np.abs(final(slide(arm, STEPS * 5)) - slide(arm, 1).q))
    assert moved > 3.0 * max(c.tolerance for c in whole if c.name != "drake")


@pytest.mark.parametrize("name", MECHANISMS)
def test_every_row_moves_the_mechanism(name):
    """Peers of a mechanism with loops end where ours does, which is elsewhere than where it began by far."""
    everyone = loops.racing(name, True)
    for contestant in everyone:
        end = contestant.lap()[1]
        assert end is None or np.max(np.abs(end - contestant.wanted)) <= contestant.tolerance, contestant
    assert np.max(np.abs(everyone[0].wanted - coasting(name).q)) > 10.0 * GIVES_WAY


@pytest.mark.parametrize("name", BOXES)
def test_every_row_moves_the_box(name):
    """MuJoCo's box on four feet ends where ours does: metres on, or where it stood."""
    everyone = scenes.racing(name, True)
    for contestant in everyone:
        assert np.max(np.abs(contestant.lap()[1] - contestant.wanted)) <= contestant.tolerance, contestant
    went = everyone[0].wanted[0]
    assert abs(went) < 1e-9 if name == STANDS else went > 1.5


@pytest.mark.parametrize("name", ["cube_toss", "tower_2"])
def test_every_row_moves_the_bodies(name):
    """The tower stands in both, and the cube lies on the floor; MuJoCo has four contacts for each body."""
    everyone = scenes.racing(name, True)
    for contestant in everyone:
        assert np.max(np.abs(contestant.lap()[1] - contestant.wanted)) <= contestant.tolerance, contestant
    height = everyone[0].wanted[2]
    assert height == pytest.approx(0.05 if name != "cube_toss" else 0.0524, abs=1e-6)


@pytest.mark.parametrize("name", ["stack_3", "bin_4"])
def test_every_row_moves_the_scene(name):
    """Boxes come to rest inside the bin in both, none below the floor."""
    for contestant in scenes.racing(name, True):
        q = contestant.lap()[1]
        count = len(bodies_of(name)[0])
        places = (q if contestant.name == "compiled" else q.reshape(count, 7)[:, :3].ravel()).reshape(count, -1)[:, :3]
        assert np.all(places[:, 2] > 0.025)
        assert np.max(np.abs(places[:, :2])) < WALL


@pytest.mark.parametrize("name", ROBOTS)
def test_every_row_puts_down_the_robot(name):
    """A car that coasts, a quadruped that stands, and a humanoid, are in both engines where they should be."""
    height = {"car": 0.1, "quadruped": 0.2785, "humanoid": 0.7919}[
        name
    ]  # the humanoid's spring gives by some millimetres
    for contestant in scenes.racing(name, True):
        x, y, z = contestant.lap()[1]
        np.testing.assert_allclose([x, y, z], contestant.wanted, atol=contestant.tolerance)
        assert x == pytest.approx(2.0, abs=0.01) if name == "car" else abs(x) < 0.02
        assert z == pytest.approx(height, abs=3e-3)


def test_mujoco_races_with_its_own_solver_settings():
    """Solving to rounding, as our comparisons of accuracy do, makes its step nearly twice as long."""
    mujoco = pytest.importorskip("mujoco")
    from validation.speed.contestants import slide_model
    from validation.speed.loops import connect_model

    own = mujoco.MjModel.from_xml_string("<mujoco/>").opt
    off = mujoco.mjtDisableBit
    allowed = [off.mjDSBL_LIMIT, off.mjDSBL_FRICTIONLOSS, off.mjDSBL_SPRING, off.mjDSBL_DAMPER, off.mjDSBL_ISLAND]
    for opt in (slide_model(slide("wam4", 5)).opt, connect_model(coasting("four_bar")).opt):
        for name in ("tolerance", "iterations", "ls_iterations", "solver", "jacobian", "cone"):
            assert getattr(opt, name) == getattr(own, name), name
        assert opt.disableflags & ~sum(int(flag) for flag in allowed) == 0
    exact = slide_model(slide("wam4", 5), exact=True).opt
    assert (exact.tolerance, exact.disableflags & int(off.mjDSBL_WARMSTART)) == (0.0, int(off.mjDSBL_WARMSTART))


@pytest.mark.parametrize("h", [5e-4, 1e-3])
def test_errors_shrink_with_the_step(h):
    """The error beside a time is that of the step's first order, and of MuJoCo's contact that gives way."""
    problem = slide("planar2", STEPS)
    changed = problem.scenario.replace({"time.step": h})
    one = our_engine("planar2", cl.prepare(changed), "compiled")
    (with_error,) = with_errors([one], problem)
    off = np.max(np.abs(one.wanted - with_error.converged))
    assert off == pytest.approx(h / 1e-3 * np.max(np.abs(final(problem) - converged(problem))), rel=0.1)


def test_arms_grow():
    """The arms have 2, 4, 7, 12 and 30 joints, and press at every step."""
    assert [slide(arm, 20).robot.n for arm in ARMS] == [2, 4, 7, 12, 30]
    assert chain(30).n == 30


def test_one_that_does_other_work_is_caught():
    """The negative control: a loop that takes a step less, or does not press, does not get into the table."""
    problem = slide("planar2", STEPS)
    lazy = our_engine("planar2", slide("planar2", STEPS - 1), "compiled")
    lazy = dataclasses.replace(lazy, wanted=final(problem))
    with pytest.raises(RuntimeError, match=r"compiled on planar2 ended .* not done the same work"):
        race([lazy], 1)


def test_batch_does_the_work_of_its_runs():
    """A batch comes to the least forces of its runs one by one, which differ, on one thread and on two."""
    problem = slide("wam4", STEPS)
    for threads in (1, 2):
        batch = compiled_batch("wam4", problem, 3, threads)
        assert np.all(np.diff(batch.wanted) > 0.05)
        assert np.array_equal(batch.lap()[1], batch.wanted)


def timing(arm, name, wall, share=1.0):
    """Return a timing with laps that were never run."""
    wall = np.array(wall)
    return Timing(Contestant(name, arm, 4, 10, lambda: (None, None)), wall, np.full(wall.size, share), None)


def test_ratio_is_of_neighbours_and_spread_of_quartiles():
    """A disturbance that hits a whole turn leaves a ratio alone; CPU time leaves out what others had of the core."""
    a, b = timing("x", "a", [2.0, 2.0, 20.0]), timing("x", "b", [1.0, 1.0, 10.0], share=0.5)
    assert ratio(a, b, wall=True) == 2.0
    assert ratio(a, b) == 4.0
    assert b.processor == 0.5
    assert timing("x", "a", [1.0, 2.0, 3.0, 4.0, 5.0]).spread == pytest.approx(1.0 / 3.0)


@pytest.mark.parametrize(("wide", "most"), [(True, 1.8), (False, 3.0)])
def test_what_seven_derivatives_may_take_depends_on_the_registers(wide, most, monkeypatch):
    """A register of 256 bits holds half of a dual number: a machine without wider ones was said to miss its target."""
    monkeypatch.setattr(llvm, "get_host_cpu_features", lambda: {"avx512f": wide})
    (wanted,) = [each.wanted for each in targets({}) if "seven derivatives" in each.what]
    assert wanted == most


def test_targets_are_judged_on_the_right_side():
    """Each target is met, missed or not measured as its value says."""
    laps = {"compiled": 1.0, "mujoco": 16.0, "mj_step": 4.0, "pinocchio": 12.0, "calls": 8.0}
    laps |= {"rnea_columns": 3.0, "crba": 2.0, "call": 3.2, "call_steps": 1.6}
    timings = {("wam4", name): timing("wam4", name, [value]) for name, value in laps.items()}
    found = [(target.measured, target.met) for target in targets(timings)]
    none = (None, None)
    assert found == [
        (16.0, True), (4.0, False), none, none, (0.75, False), (1.5, False), (2.0, False), *[none] * 8, (5.0, False),
        (1.5, True), *[none] * 19,
    ]  # fmt: skip
    both = [("compiled", 4.0, 10.0), ("algorithms", 8.0, 20.0)]
    chains = {
        (arm, name): timing(arm, name, [value])
        for name, *values in both
        for arm, value in zip(("chain12", "chain30"), values, strict=True)
    }
    assert growth(chains) == 0.5


@pytest.mark.slow
def test_command_writes_valid_json(tmp_path, capsys):
    """A tiny run prints both tables and writes every value, finite or null, with what was missing."""
    file = tmp_path / "speed.json"
    words = ["--quick", "--steps", str(STEPS), "--repeats", "2", "--runs", "2", "--arms", "planar2", "wam4"]
    assert main([*words, "--json", str(file)]) == 0
    out = capsys.readouterr().out
    assert "targets" in out
    assert "two threads of bare arithmetic" in out
    data = json.loads(file.read_text())
    assert {row["arm"] for row in data["rows"]} == {"machine", "planar2", "wam4"}
    for row in data["rows"]:
        assert len(row["laps"]) == 2
        assert row["seconds_per_step"] == np.median(row["laps"])
        joint = row["processor_seconds_per_step"] / row["joints"]
        assert joint == row["processor_seconds_per_step_and_joint"] == np.median(row["processor_laps"]) / row["joints"]
    assert len(data["targets"]) == 36
    assert data["targets"][-1]["measured"] is None  # no mechanisms and no chains in this run
    assert data["cold_start_seconds"] == {}


def test_peer_that_is_not_installed_is_a_line(monkeypatch, capsys):
    """Without MuJoCo and Drake their rows are missing, by name and with the command that installs them."""
    monkeypatch.setattr("validation.speed.__main__.find_spec", lambda name: None)
    assert main(["--quick", "--steps", "20", "--repeats", "1", "--runs", "2", "--arms", "planar2"]) == 0
    out = capsys.readouterr().out
    assert 'mujoco: not installed: pip install "closedloop[peers]"' in out
    assert "drake: not installed" in out
    assert "MuJoCo from Python /" in out  # among the targets, not measured
    assert "not measured" in out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--repeats", "0"], "at least 1"),
        (["--steps", "-3"], "at least 1"),
        (["--arms", "wam"], "wam4"),
        (["--json", "no/such/folder/x.json"], "cannot be written"),
        (["--nonsense"], "--help"),
        (["--steps", "many"], "--steps"),
    ],
)
def test_bad_input_is_one_line_and_status_2(words, expected, capsys):
    """A mistake on the command line is answered by one line, before anything is measured."""
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert expected in lines[0]


def test_steps_for_another_program_are_measured(monkeypatch, capsys):
    """The command steps in this process and for a client in another one, and says how often a second."""
    monkeypatch.setattr("validation.speed.served.find_spec", lambda name: None)
    words = ["--scenarios", "panda_slide", "--repeats", "2", "--steps"]
    assert main_served([*words, "30"]) == 0
    title, *rows = capsys.readouterr().out.splitlines()
    assert title == "panda_slide: median of 2 laps of 30 steps, in turns"
    assert [row.split(" a second")[0].rstrip("0123456789 ").strip() for row in rows] == [
        "Simulator.step",
        "binary, empty",
        "binary socket",
    ]
    assert main_served([*words, "0"]) == 2
    assert main_served([*words, "30", "--core", "100000"]) == 2
