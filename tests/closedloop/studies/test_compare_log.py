"""A log over a scenario: planted differences are named with their size, and a log's own force is audited."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pinocchio as pin
import pytest

import closedloop as cl
from closedloop.command.logs import compare as main
from closedloop.studies.comparison.recording import (
    Hypothesis,
    Recording,
    alike_rows,
    explain,
    of_joints,
    of_run,
    of_torques,
    read_recording,
)
from closedloop.studies.identify.motion import LogError


@pytest.fixture(scope="module")
def run():
    """Return a slide of a planar arm."""
    return cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 3.0}), progress=False)


def late(x, seconds, run):
    """Return a column of the run as one who reads it so much later has it."""
    return np.stack([np.interp(run.time - seconds, run.time, column) for column in x.T], axis=1)


def test_a_run_over_its_own_scenario_is_equal(run):
    """No shift, no difference, and a force that agrees with its own motion and torques."""
    found = cl.compare_log(run, run.scenario)
    assert found.shift == 0.0
    for each in found.differences.values():
        assert not each.rms.any()
        assert each.reasons == []
    assert found.audit.consistent
    assert found.audit.what == "along the normal, on the robot"
    assert found.audit.rms < 0.01 * found.audit.size
    assert found.audit.explained > 0.99
    assert sum("equal, to rounding" in line for line in found.lines()) == 3


def test_another_clock_is_found(run):
    """The log begins elsewhere in time, and its clock is another one."""
    log = of_run(run)
    part = Recording(log.time[400:] + 1e6, log.q[400:], log.torque[400:], log.force[400:])
    found = cl.compare_log(part, run.scenario)
    assert found.shift == pytest.approx(-run.time[400], abs=1e-6)
    assert found.differences["q"].rms.max() < 1e-6
    wrong = cl.compare_log(part, run.scenario, shift=0.0)
    assert wrong.differences["q"].rms.max() > 1e-3


def test_a_sensor_is_told_from_its_force(run):
    """Gain, bias and delay of a force that varies: the time of the joints is right, that of the force is late."""
    log = of_run(run)
    lively = replace(log, force=log.force)
    force = lively.force + 2.0 * np.sin(9.0 * log.time)
    scenario = run.scenario
    rate = np.gradient(force, log.time)
    from closedloop.studies.comparison.recording import force_hypotheses

    sensed = 1.1 * force + 0.3 - 0.02 * rate
    reasons = {r.name: r for r in explain(sensed - force, force_hypotheses(force, rate), 10.0)}
    assert reasons["delay"].value[0] == pytest.approx(0.02, abs=1e-3)
    found = cl.compare_log(replace(log, force=1.2 * log.force), scenario)
    reasons = found.differences["force"].reasons
    assert reasons[0].value[0] == pytest.approx(0.2, rel=0.05) or "gain beyond 1" in reasons[0].as_well
    assert not found.audit.consistent


@pytest.mark.parametrize(
    ("plant", "name", "value"),
    [
        (lambda run: 0.3 * np.tanh(run.v / (1e-3 * np.abs(run.v).max(axis=0))), "dry friction", 0.3),
        (lambda run: 2.0 * run.v, "viscous friction", 2.0),
        (lambda run: np.full_like(run.torque, 0.7), "offset", 0.7),
    ],
)
def test_what_torques_lack_is_named(run, plant, name, value):
    """A term of the torque that the scenario has not: its name and size, or that others would explain it as well."""
    log = of_run(run)
    found = cl.compare_log(replace(log, torque=log.torque + plant(run)), run.scenario)
    first = found.differences["torque"].reasons[0]
    assert first.name == name or name in first.as_well
    if first.name == name:
        np.testing.assert_allclose(first.value, value, rtol=0.05)
    assert first.left < 0.02


def test_what_a_payload_and_a_force_add_is_that_of_the_robot_with_them(run):
    """Torques of a point mass at the tip, by inverse dynamics of the arm that has it; of a force, by virtual work."""
    robot = cl.prepare(run.scenario).robot
    model, loaded = robot.model.pinocchio_model(), robot.model.pinocchio_model()
    frame = model.frames[model.getFrameId(robot.tip)]
    payload = pin.Inertia(0.7, np.zeros(3), np.zeros((3, 3)))
    loaded.appendBodyToJoint(frame.parentJoint, payload, frame.placement)
    rng = np.random.default_rng(4)
    motion = q, v, a = tuple(rng.normal(size=(3, 40, 2)))
    both = [[pin.rnea(each, each.createData(), *row) for row in zip(q, v, a, strict=True)] for each in (loaded, model)]
    normal, time = rng.normal(size=(40, 3)), np.arange(40.0)
    pressed = [-5.0 * robot.position_and_jacobian(x)[1].T @ n for x, n in zip(q, normal, strict=True)]
    torque = rng.normal(size=(40, 2))
    for residual, name, value in (
        (np.subtract(*both), "payload at the tip", 0.7), (np.array(pressed), "force along the normal at the tip", 5.0),
    ):  # fmt: skip
        column, hypotheses = of_torques(residual, time, ("J1", "J2"), motion, torque, robot, normal)
        (given,) = (h for h in hypotheses if h.name == name)
        np.testing.assert_allclose(value * given.columns[:, 0], column, atol=1e-9)


def test_what_is_read_late_has_a_delay_above_zero():
    """Positions and torques at t are those of t − 2 ms; a joint gives as its torque pushes it."""
    t = np.linspace(0.0, 2.0, 2001)
    x, rate = np.sin(3.0 * t)[:, None], 3.0 * np.cos(3.0 * t)[:, None]
    change = np.sin(3.0 * (t - 2e-3))[:, None] - x
    for column, hypotheses in (
        of_joints(change, ("J1",), rate, x), of_torques(change, t, ("J1",), (x, rate, x), x, None, None),
    ):  # fmt: skip
        (delay,) = (h for h in hypotheses if h.name == "delay")
        np.testing.assert_allclose(2e-3 * delay.columns[:, 0], column, atol=2e-5)


def test_the_sign_of_a_force_is_found_out(run):
    """A force on the environment is not one on the robot, and the audit says which it is."""
    log = of_run(run)
    found = cl.compare_log(replace(log, force=-log.force), run.scenario)
    assert found.audit.what == "along the normal, on the environment"
    assert not found.audit.consistent
    assert "NOT consistent" in "\n".join(found.lines())
    vector = cl.compare_log(replace(log, force=log.force[:, None] * run.surface_normal), run.scenario)
    assert vector.audit.consistent
    assert vector.differences["force"].rms[0] < 1e-9


def test_the_interval_of_a_reason_covers_the_truth():
    """95 % of the intervals of a bias hold it, of white noise and of noise whose neighbours are alike."""
    rng = np.random.default_rng(0)
    for pole in (0.0, 0.9):
        inside = 0
        for _ in range(300):
            noise = rng.normal(size=2200)
            for k in range(1, len(noise)):
                noise[k] += pole * noise[k - 1]
            noise = noise[200:]
            reason = explain(5.0 + noise, [Hypothesis("bias", "N", np.ones((2000, 1)))])[0]
            inside += abs(reason.value[0] - 5.0) <= reason.half[0]
        assert 0.90 < inside / 300 <= 0.99, pole
    assert alike_rows(np.zeros(10)) == 1.0


def test_the_command_reads_files_and_writes_results(run, tmp_path, capsys):
    """CSV and run.nc; columns by name; JSON and a figure."""
    run.save(tmp_path / "run.nc")
    table = {"t": run.time}
    for j, name in enumerate(run.model.joint_names):
        table[f"angle_{name}"], table[f"effort_{name}"] = np.degrees(run.q[:, j]), run.torque[:, j]
    pd.DataFrame(table | {"sensor": run.contact_force}).to_csv(tmp_path / "log.csv", index=False)
    scenario = ["--scenario", "planar2_slide", "--time.duration", "3"]
    assert main([str(tmp_path / "run.nc"), *scenario]) == 0
    assert "it is consistent" in capsys.readouterr().out
    words = [str(tmp_path / "log.csv"), *scenario, "--degrees", "--columns", "force=sensor", "--out", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["audit"]["consistent"]
    assert max(told["q"]["rms"]) < 1e-12
    assert json.loads((tmp_path / "comparison.json").read_text()) == told
    assert "difference" in (tmp_path / "comparison.svg").read_text()


def test_two_runs_have_one_clock(run):
    """A path that begins later is a difference, and not a shift of the log; a log of it is shifted."""
    later = run.scenario.replace({"reference.start": 0.9})
    log = Recording(run.time, run.q, run.torque)
    assert cl.compare_log(run, later).shift == 0.0
    assert abs(cl.compare_log(log, later).shift) > 0.05


@pytest.mark.parametrize("ending", ["csv", "parquet", "mcap"])
def test_the_force_of_an_exported_run_has_three_components(ending, run, tmp_path):
    """No name is needed for it, so that friction can be identified from an export as from the run itself."""
    recording = read_recording(run.save(tmp_path / f"log.{ending}"), run.model)
    np.testing.assert_allclose(recording.force, run.tip_force, atol=1e-9)


def test_bad_input_is_one_line(run, tmp_path, capsys):
    """Missing columns and files, time that jumps, values that are not finite, other joints."""
    scenario = ["--scenario", "planar2_slide", "--time.duration", "3"]
    pd.DataFrame({"time": run.time, "x": run.time}).to_csv(tmp_path / "log.csv", index=False)
    for words, expected in (
        ([str(tmp_path / "log.csv")], "no columns for q"),
        ([str(tmp_path / "none.csv")], "cannot be read"),
        ([str(tmp_path / "log.csv"), "--columns", "pace=v"], "is none of time, q, torque, force"),
    ):
        with pytest.raises(SystemExit) as ended:
            raise SystemExit(main([*words, *scenario]))
        assert ended.value.code == 2
        told = capsys.readouterr().err
        assert expected in told
        assert len(told.strip().splitlines()) == 1
    log = of_run(run)
    jumping, missing = log.time.copy(), log.q.copy()
    jumping[50:] += 0.5
    missing[7, 0] = np.nan
    for wrong, expected in (
        (replace(log, time=jumping), "time jumps by 0.50"),
        (replace(log, q=missing), "q in row 7 is not finite"),
        (replace(log, q=log.q[:, :1]), "must be"),
        (Recording(log.time[:9], log.q[:9]), "at least 50"),
    ):
        with pytest.raises(LogError, match=expected):
            cl.compare_log(wrong, run.scenario)
    with pytest.raises(LogError, match="in common"):
        cl.compare_log(log, run.scenario, shift=100.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.drop(columns="effort_J2"), "has torque of 1 of 2 joints: no column of numbers 'effort_J2'"),
        (lambda t: t.assign(effort_J1="x"), "no column of numbers 'effort_J1'"),
        (
            lambda t: t.assign(**{f"velocity_J{k}": np.degrees(t[f"velocity_J{k}"]) for k in (1, 2)}),
            "look like degrees",
        ),
        (lambda t: t.rename(columns={"position_J1": "position_J2", "position_J2": "position_J1"}), "in another order"),
        (lambda t: t.assign(time=1e3 * t.time), "or time, has another unit"),
        (lambda t: t.drop(columns=["velocity_J1", "velocity_J2"]).assign(time=1e3 * t.time), "is its time in s?"),
        (lambda t: t.iloc[:0], "0 rows"),
    ],
)
def test_a_log_with_other_units_or_joints_is_one_line(change, says, run, tmp_path, capsys):
    """What cannot be is said, for a comparison and for a contact, and a log at rest ends in no traceback."""
    table = {"time": run.time, "force": run.contact_force}
    for j, name in enumerate(("J1", "J2")):
        table |= {f"position_{name}": run.q[:, j], f"velocity_{name}": run.v[:, j], f"effort_{name}": run.torque[:, j]}
    change(pd.DataFrame(table)).to_csv(tmp_path / "log.csv", index=False)
    assert main([str(tmp_path / "log.csv"), "--scenario", "planar2_slide", "--time.duration", "3"]) == 2
    told = capsys.readouterr().err
    assert says in told
    assert told.count("\n") == 1


def test_a_log_at_rest_is_compared(run):
    """Nothing moves, so what its force should be is that of the torques alone."""
    n = len(run.time)
    log = Recording(run.time, np.tile(run.q[0], (n, 1)), np.tile(run.torque[0], (n, 1)), np.full(n, 5.0))
    found = cl.compare_log(log, run.scenario)
    assert found.differences["q"].rms.max() > 0.0


def test_a_log_of_force_and_speed_alone_is_compared(run, tmp_path, capsys):
    """Without joints the shift is found by the force; half the force is named, and the speed is the tip's."""
    force = np.array(run.contact_force) + 2.0 * np.sin(9.0 * run.time)
    speed = np.linalg.norm(run.velocity, axis=1)
    rows = {"time": run.time[200:] + 5.0, "force": 0.5 * force[200:], "tcp_speed": speed[200:]}
    pd.DataFrame(rows).to_csv(tmp_path / "force.csv", index=False)
    scenario = ["--scenario", "planar2_slide", "--time.duration", "3.0"]
    assert main([str(tmp_path / "force.csv"), *scenario, "--shift", "-0.2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) >= {"force", "speed"}
    assert "q" not in found
    assert max(found["speed"]["rms"]) < 1e-6
    assert found["force"]["rms"][0] > 0.3 * found["force"]["size"][0]
    assert "the log has no joint positions: joints are not compared" in found["notes"]
    part = Recording(run.time[200:], force=np.array(run.contact_force)[200:], speed=speed[200:])
    assert cl.compare_log(part, run.scenario).shift == pytest.approx(-0.2, abs=2e-3)
    with pytest.raises(LogError, match="neither q nor force nor speed"):
        cl.compare_log(Recording(run.time), run.scenario)
    with pytest.raises(LogError, match="it needs both force and speed"):
        cl.identify_contact(Recording(run.time, speed=np.ones(len(run.time))), "planar2", normal=(0.0, 1.0, 0.0))


@pytest.mark.parametrize("name", ["delta", "joint_friction", "planar2_drop", "payload_mismatch"])
def test_a_force_is_audited_beside_all_that_acts(name):
    """Reactions of loops, friction of joints, impulses, a payload: a run's force is consistent, a quarter more not."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 2.0}))
    found = cl.compare_log(run, run.scenario)
    assert found.audit.consistent
    assert found.audit.usual < 0.06 * found.audit.size
    assert any("impulses" in note for note in found.notes) == (name == "planar2_drop")
    log = of_run(run)
    assert not cl.compare_log(replace(log, force=1.25 * log.force), run.scenario).audit.consistent
