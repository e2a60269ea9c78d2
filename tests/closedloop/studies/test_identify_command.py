"""`closedloop identify`: logs of several formats, a robot file that can be loaded, bad input in one line."""

import json
import tomllib
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pinocchio as pin
import pytest
from identified import simulated, true_base

import closedloop as cl
import robot_models
from closedloop.command.logs import identify as main
from closedloop.studies.identify.motion import LogError
from closedloop.studies.identify.read import log_of_run, read_log
from closedloop.studies.identify.regressor import Regressor, Terms
from closedloop.studies.identify.written import LEAST, _logarithms, physical, robot_files

PRODUCTS = [[0.05, 0.001, 0.002], [0.001, 0.06, 0.003], [0.002, 0.003, 0.07]]  # kg m²


@pytest.fixture(scope="module")
def log():
    """A log of planar2 with noise."""
    return simulated("planar2", count=3000, noise=(2e-5, 0.1))[0]


def frame(log, q="q {} [rad]", torque="effort_{}", number=False):
    """Return a log as a table, with its columns named so."""
    columns = {"time": log.time}
    for j, name in enumerate(log.joint_names):
        label = j if number else name
        columns[q.format(label)] = log.q[:, j]
        columns[torque.format(label)] = log.torque[:, j]
    return pd.DataFrame(columns)


def test_the_command_writes_a_robot_with_the_parameters_of_the_log(log, tmp_path, capsys):
    """robot.urdf and its sidecar load, and have the base parameters found; friction.toml is a section of a scenario."""
    frame(log).to_csv(tmp_path / "log.csv", index=False)
    assert main([str(tmp_path / "log.csv"), "--robot", "planar2", "--out", str(tmp_path / "out")]) == 0
    assert "not fitted" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written >= {"report.txt", "identified.json", "friction.toml", "robot.urdf", "robot.toml", "torque.png"}
    found = cl.identify(log, "planar2")
    again, _ = simulated(robot_models.load(tmp_path / "out" / "robot.urdf"), count=3000)
    inertial = cl.identify(again, robot_models.load(tmp_path / "out" / "robot.urdf"))
    for entry in found.estimates:
        if not entry.name.startswith(("viscous", "dry", "offset")):
            assert inertial[entry.name].value == pytest.approx(entry.value, abs=2e-3)
    summary = json.loads((tmp_path / "out" / "identified.json").read_text())
    assert summary["model_misses_something"] == []
    section = tomllib.loads((tmp_path / "out" / "friction.toml").read_text())["joint_friction"]
    assert section["kind"] == "coulomb_viscous"
    np.testing.assert_allclose(section["kinetic"], 2.0, atol=0.02)
    np.testing.assert_allclose(section["viscous"], 1.5, atol=0.02)


@pytest.mark.parametrize("ending", ["csv", "parquet", "nc"])
def test_formats_say_the_same(log, ending, tmp_path):
    """CSV, Parquet and NetCDF with columns by name or by number."""
    robot, path = robot_models.load("planar2"), tmp_path / f"log.{ending}"
    if ending == "csv":
        frame(log).to_csv(path, index=False)
    elif ending == "parquet":
        frame(log, "Position_{}", "tau{}", number=True).to_parquet(path)
    else:
        import xarray

        data = {"q": (("time", "joint"), log.q), "effort": (("time", "joint"), log.torque)}
        labels = {"time": log.time, "joint": list(log.joint_names)}
        xarray.Dataset(data, labels).to_netcdf(path, engine="h5netcdf")
    read = read_log(path, robot)
    np.testing.assert_array_equal(read.q, log.q)
    np.testing.assert_array_equal(read.torque, log.torque)


def test_units_and_gains_are_put_right(log, tmp_path):
    """Degrees and currents, when they are said to be."""
    robot, table = robot_models.load("planar2"), frame(log)
    for name in log.joint_names:
        table[f"q {name} [rad]"] = np.rad2deg(table[f"q {name} [rad]"])
    table.to_csv(tmp_path / "log.csv", index=False)
    read = read_log(tmp_path / "log.csv", robot, degrees=True, gain=[2.0, 3.0])
    np.testing.assert_allclose(read.q, log.q, rtol=1e-14)
    np.testing.assert_allclose(read.torque, log.torque * [2.0, 3.0], rtol=1e-14)
    table.rename(columns={f"effort_{j}": f"effort_{j} [mA]" for j in log.joint_names}).to_csv(tmp_path / "log.csv")
    read = read_log(tmp_path / "log.csv", robot, degrees=True, gain=1.0)
    np.testing.assert_allclose(read.torque, 1e-3 * log.torque, rtol=1e-14)


@pytest.mark.parametrize("ending", ["csv", "parquet", "nc"])
@pytest.mark.parametrize("zone", [None, "UTC", "text"])
def test_instants_are_seconds_from_the_first(log, ending, zone, tmp_path):
    """Time stamps of ISO 8601, and those of Parquet and NetCDF, in whatever unit they are kept."""
    path, table = tmp_path / f"log.{ending}", frame(log)
    stamps = pd.Timestamp("2026-01-01") + pd.to_timedelta(table.pop("time"), unit="s").dt.round("us")
    table.insert(0, "timestamp", stamps if zone != "UTC" or ending == "nc" else stamps.dt.tz_localize("UTC"))
    if ending == "csv":
        table.to_csv(path, index=False, date_format="%Y-%m-%dT%H:%M:%S.%f" + "+02:00" * (zone == "text"))
    elif ending == "parquet":
        (table.assign(timestamp=stamps.astype(str) + "Z") if zone == "text" else table).to_parquet(path)
    else:
        table.to_xarray().to_netcdf(path, engine="h5netcdf")
    np.testing.assert_allclose(read_log(path, robot_models.load("planar2")).time, log.time, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "given"),
    [
        (lambda t: t.assign(time=1e3 * t.time), {"time": "time [ms]"}),
        (lambda t: t.assign(time=1e3 * t.time).rename(columns={"time": "time_ms"}), {}),
        (lambda t: t.assign(time=1e9 * t.time).rename(columns={"time": "Timestamp (ns)"}), {}),
        (
            lambda t: t.rename(columns={"q J1 [rad]": "q J1 [deg]"}).assign(
                **{"q J1 [deg]": lambda x: np.rad2deg(x.iloc[:, 1])}
            ),
            {},
        ),
        (lambda t: t.assign(effort_J1=1e3 * t.effort_J1, effort_J2=1e3 * t.effort_J2), {"torque": "effort_{} [N mm]"}),
        (
            lambda t: t.rename(columns={"effort_J2": "effort_J2 [mN·m]"}).assign(
                **{"effort_J2 [mN·m]": 1e3 * t.effort_J2}
            ),
            {},
        ),
    ],
)
def test_a_unit_behind_a_name_counts(log, change, given, tmp_path):
    """Behind that of the column, or behind the one that is given for it."""
    change(frame(log)).to_csv(tmp_path / "log.csv", index=False)
    read = read_log(tmp_path / "log.csv", robot_models.load("planar2"), columns=given)
    for name in ("time", "q", "torque"):
        np.testing.assert_allclose(getattr(read, name), getattr(log, name), rtol=1e-12)


def test_a_run_of_the_simulator_is_a_log():
    """Torques of a run in contact, with the force on its tip added, are the inverse dynamics of its motion."""
    import pinocchio as pin

    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.3, "reference.start": 0.0}))
    log, model = log_of_run(run), run.model.pinocchio_model()
    data = model.createData()
    rows = range(20, len(run), 40)
    true = np.array([pin.rnea(model, data, run.q[k], run.v[k], run.acceleration[k]) for k in rows])
    assert np.abs(run.contact_force).max() > 1.0
    np.testing.assert_allclose(log.torque[list(rows)], true, atol=1e-8)
    moved = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 3.0}))
    found, same = (cl.identify(each, moved.model).summary() for each in (moved, log_of_run(moved)))
    np.testing.assert_equal(found, same)


def test_bodies_that_can_be_keep_the_torque(log):
    """Pseudo-inertias are positive definite, friction is not negative, estimates stay in their intervals."""
    robot = robot_models.load("planar2")
    found = cl.identify(log, robot)
    body = physical(found)
    for j in range(robot.n):
        mine = pin.PseudoInertia.FromDynamicParameters(body.parameters[10 * j : 10 * j + 10])
        assert np.linalg.eigvalsh(mine.toMatrix()).min() > 0.0
    assert body.distance < 1.0
    np.testing.assert_allclose(body.relative_error, found.relative_error, rtol=0.05)
    left = found.measured - found.regressor.averaged(found.motion) @ body.parameters
    error = np.sqrt(((left * found.used) ** 2).sum(axis=0) / ((found.measured * found.used) ** 2).sum(axis=0))
    np.testing.assert_allclose(body.relative_error, error, rtol=1e-9)
    assert np.abs(found.base.grouping @ body.parameters - true_base(found)).max() < 0.05


@pytest.mark.parametrize("name", ["wam4", "ur10"])
def test_a_written_robot_has_the_parameters_that_were_given(name):
    """All ten of each link, with products of inertia and centres of mass anywhere, from logarithms and from a file."""
    robot = robot_models.load(name)
    bodies = list(robot.pinocchio_model().inertias)[1:]
    for body in bodies:
        again = pin.LogCholeskyParameters(_logarithms(body)).toDynamicParameters()
        if np.linalg.eigvalsh(body.toPseudoInertia().toMatrix()).min() > LEAST:
            np.testing.assert_allclose(again, body.toDynamicParameters(), atol=1e-9)
    regressor = Regressor(robot, Terms())
    moved = [pin.Inertia(b.mass + 1.0, b.lever + 0.01, b.inertia + np.array(PRODUCTS)) for b in bodies]
    given = np.concatenate([*(b.toDynamicParameters() for b in moved), np.full(4 * robot.n, 0.3)])
    found = SimpleNamespace(robot=robot, regressor=regressor)
    urdf, _ = robot_files(found, given, "a test")
    written = pin.buildModelFromXML(urdf)
    for joint, body in zip(robot.joint_names, moved, strict=True):
        mine = written.inertias[written.getJointId(joint)]
        np.testing.assert_allclose(mine.toDynamicParameters(), body.toDynamicParameters(), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words", "says"),
    [
        (lambda t: t.drop(columns="time"), [], "no column time or t or timestamp for the time"),
        (lambda t: t.drop(columns=["effort_J1", "effort_J2"]), [], "no columns for torque of the joints J1, J2"),
        (lambda t: t.drop(columns="effort_J2"), [], "has torque of 1 of 2 joints: no column of numbers 'effort_J2'"),
        (lambda t: t, ["--columns", "torque=tau_{}"], "no column 'tau_J1'"),
        (lambda t: t, ["--columns", "force=x"], "'force' is none of time, q, v, torque"),
        (lambda t: t, ["--terms", "viscous,wet"], "'wet' is none of viscous"),
        (lambda t: t, ["--gain", "1,2,3"], "3 numbers: one, or 2"),
        (
            lambda t: t.rename(columns={"effort_J1": "effort_J1 [A]"}),
            [],
            "'effort_J1' is a current, in A: give the N m/A",
        ),
        (lambda t: t, ["--columns", "torque=effort_{} [mA]"], "is a current, in A: give the N m/A of each joint"),
        (lambda t: t, ["--cutoff", "1e4"], "must be above 0 and below half the rate"),
        (lambda t: t, ["--coupled", "J1,J7"], "has no joint 'J7'"),
        (lambda t: t, ["--coupled", "J1,J1"], "coupled J1, J1: must be two different joints"),
        (lambda t: t, ["--coupled", "J1,J2", "--coupled", "J2,J1"], "coupled J2, J1: the pair is there twice"),
        (lambda t: t, ["--gain", "0"], "gain is [0.0]: must be finite and not 0"),
        (lambda t: t, ["--gain", "nan"], "must be finite and not 0"),
        (lambda t: t, ["--slow", "-5"], "slow is -5.0: it must be from 0 to below 1"),
        (lambda t: t, ["--columns", "q=effort_J1,effort_J1"], "column 'effort_J1' is named for two of"),
        (lambda t: t.drop(index=range(1000, 1100)), [], "time jumps by 0.202 s after row 999"),
        (lambda t: t.rename(columns={"q J2 [rad]": "q J1 [rad]"}), [], "has several columns 'q J1 [rad]'"),
        (lambda t: t.assign(**{"Q_j1": 0.0, "q_J1 ": 0.0}), ["--columns", "q=q_j1,x"], "which is it?"),
        (lambda t: t.rename(columns=dict(zip(t, "12345", strict=True))), [], "its first line has numbers"),
        (lambda t: t.rename(columns=dict.fromkeys(t, " ")), [], "no column time or t or timestamp for the time"),
        (
            lambda t: t.assign(time=1e3 * t.time),
            [],
            "is its time in s? Give its unit, as in --columns time='NAME [ms]'",
        ),
        (lambda t: t.assign(time=1e6 * t.time), [], "--columns time='NAME [us]'"),
        (lambda t: t.assign(time=t.time / 60.0), [], "give the units, as in --columns q='NAME_{} [deg]'"),
        (lambda t: t.assign(effort_J1=1e301), [], "torques reach 1e+301 N m: give their unit"),
        (lambda t: t, ["--gain", "1e-300"], "e-299 N m: give their unit"),
        (lambda t: t, ["--gain", "1e3"], "where the robot's weight needs"),
        (lambda t: t, ["--gain", "1e-3"], "where the robot's weight needs"),
    ],
)
def test_bad_input_is_one_line(log, change, words, says, tmp_path, capsys):
    """Exit status 2; what, where, what would be right."""
    change(frame(log)).to_csv(tmp_path / "log.csv", index=False)
    assert main([str(tmp_path / "log.csv"), "--robot", "planar2", "--out", str(tmp_path / "o"), *words]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_a_file_that_is_no_log_is_refused(tmp_path):
    """A text, a damaged Parquet file, a file that is not there."""
    robot = robot_models.load("planar2")
    (tmp_path / "a.parquet").write_bytes(b"nothing")
    (tmp_path / "a.json").write_text("{}")
    for name in ("a.parquet", "a.json", "b.csv"):
        with pytest.raises(LogError, match=name):
            read_log(tmp_path / name, robot)
