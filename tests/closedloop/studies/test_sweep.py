"""Sweeps: axes and designs, the table and where it came from, and that nothing is lost, doubled or overwritten."""

import json
import re
import tomllib
from pathlib import Path

import h5netcdf
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from sweep_runs import SMALL, refusal, sweep
from test_sweep_axes import values_of

import closedloop as cl
from closedloop.base import files
from closedloop.base.progress import progress_text
from closedloop.command import sweep as sweep_command
from closedloop.studies.sweep import store as store_module
from closedloop.studies.sweep.sweep import Design, Sweep, parse_axis, run_sweep


def small(keep=(), runs=6):
    """Return a sweep of runs of ten steps."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.01})
    return Sweep.of(scenario, Design([parse_axis(f"law.force=5:15:{runs}")]), keep)


def same_columns(a, b):
    """Return whether two NetCDF files have the same variables, to the bit (the files have times of writing in them)."""
    with h5netcdf.File(a) as first, h5netcdf.File(b) as second:
        return set(first.variables) == set(second.variables) and all(
            np.array_equal(first.variables[name][...], second.variables[name][...], equal_nan=True)
            for name in first.variables
        )


def test_a_sweep_is_the_batch_of_its_points(capsys, tmp_path):
    """The table has the same rows as `simulate_batch`, refused runs among them, and says what made it."""
    status, out, err = sweep(capsys, *SMALL, "--out", tmp_path / "small.parquet")
    assert (status, err) == (0, "")
    assert "12 runs: 8 done, 4 refused" in out
    table = parquet.read_table(tmp_path / "small.parquet")
    batch = cl.simulate_batch(
        cl.load_scenario("wam_slide", {"time.duration": 0.02}),
        {"law.force": values_of("law.force=5:15:4"), "stabiliser.time_constant": [5e-4, 0.001, 0.01]},
        grid=True,
    )
    assert table.replace_schema_metadata().equals(batch, check_metadata=True)
    assert "Baumgarte is unstable" in table["reason"][0].as_py()
    identity = json.loads(table.schema.metadata[b"closedloop_sweep"])["identity"]
    assert identity["axes"]["law.force"] == "5:15:4"
    assert identity["versions"]["closedloop"]
    assert [path.name for path in tmp_path.iterdir()] == ["small.parquet"]


@pytest.mark.parametrize("draw", [(), ("--random", "12", "--seed", "3"), ("--latin", "12", "--seed", "3")])
def test_the_table_does_not_depend_on_the_workers(capsys, tmp_path, draw):
    """One thread and three write the same file, byte by byte."""
    arguments = ("wam_bounce", "--time.duration", "0.1", "--over", "surface.gap=0:0.01:12", "--keep", "f", *draw)
    files = []
    for workers in (1, 3):
        folder = tmp_path / str(workers)
        assert sweep(capsys, *arguments, "--workers", workers, "--out", folder / "t.parquet")[0] == 0
        files.append((folder / "t.parquet").read_bytes())
    assert files[0] == files[1]


def test_whole_columns_are_those_of_the_runs(capsys, tmp_path):
    """The NetCDF file has f, e and q of every run; what a run did not reach is NaN."""
    out = tmp_path / "kept.parquet"
    arguments = ("wam_slide", "--over", "time.duration=0.01,0.02,0.0005", "--over", "law.force=5,6", "--keep", "f,e,q")
    assert sweep(capsys, *arguments, "--out", out)[0] == 0
    run = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.02, "law.force": 6.0}), engine="compiled")
    with h5netcdf.File(out.with_suffix(".nc")) as file:
        assert file.variables["contact_force"].dimensions == ("run", "time")
        assert file.variables["contact_force"].attrs["units"] == "N"
        np.testing.assert_array_equal(file.variables["contact_force"][3], run.contact_force)
        np.testing.assert_array_equal(file.variables["q"][3], run.q)
        np.testing.assert_allclose(file.variables["time"][:], run.time, atol=1e-15)
        short = file.variables["closure_error"][0]
        assert np.isfinite(short[:11]).all()
        assert np.isnan(short[11:]).all()
        assert np.isnan(file.variables["contact_force"][4:]).all()  # refused: 0.0005 s is no whole number of steps


class Killed(BaseException):
    """What stands for the end of the process."""


@pytest.mark.parametrize("keep", [(), ("f",)], ids=["table", "columns"])
def test_an_end_before_or_after_any_rename_costs_nothing(tmp_path, monkeypatch, keep):
    """Ended at each file's rename in turn, just before or just after, and gone on with: the same table in the end."""
    whole = run_sweep(small(keep), tmp_path / "whole.parquet", workers=1).table.read_bytes()
    replace = Path.replace
    for after in (False, True):
        out, deaths = tmp_path / f"ended_{after}.parquet", 0
        for _ in range(20):
            renames = iter(range(100))

            def rename(self, target, renames=renames, after=after):
                # A part is one file: less than a part each time would never come to an end.
                if next(renames) == (1 if after else 2):
                    if after:
                        replace(self, target)
                    raise Killed
                return replace(self, target)

            with monkeypatch.context() as patch:
                patch.setattr(Path, "replace", rename)
                try:
                    run_sweep(small(keep), out, workers=1)
                    break
                except Killed:
                    deaths += 1
        assert deaths >= 3
        assert out.read_bytes() == whole
        assert not keep or same_columns(out.with_suffix(".nc"), tmp_path / "whole.nc")
        assert not out.with_name(f"{out.name}.parts").exists()


@pytest.mark.parametrize("damage", [b"", b"PK", b"not a zip"])
def test_damaged_columns_are_made_again(tmp_path, monkeypatch, damage):
    """Columns that a disk has lost are no part, whatever is left of them."""
    with monkeypatch.context() as patch:
        patch.setattr("closedloop.studies.sweep.store.join", lambda *_: None)
        run_sweep(small(["f"]), tmp_path / "t.parquet", workers=1)
    (tmp_path / "t.parquet.parts" / "part-00000003.arrow").write_bytes(damage)
    run_sweep(small(["f"]), tmp_path / "t.parquet", workers=1)
    with h5netcdf.File(tmp_path / "t.nc") as file:
        assert np.isfinite(file.variables["contact_force"][...]).all()


def test_only_what_is_missing_is_run(tmp_path, monkeypatch):
    """Parts that are there are not run again; a part that is damaged is; leftovers of a killed writer go."""
    made = []

    def counted(job, first, *rest):
        made.append(first)
        return run_part(job, first, *rest)

    from closedloop.studies.sweep.store import run_part

    monkeypatch.setattr("closedloop.studies.sweep.store.run_part", counted)
    monkeypatch.setattr("closedloop.studies.sweep.store.join", lambda *_: None)
    out = tmp_path / "t.parquet"
    folder = tmp_path / "t.parquet.parts"
    run_sweep(small(), out, workers=1)
    assert made == list(range(6))
    (folder / "part-00000002.arrow").unlink()
    (folder / "part-00000004.arrow").write_bytes(b"")
    left = folder / files._unfinished_name()
    left.write_bytes(b"half")
    made.clear()
    run_sweep(small(), out, workers=1)
    assert made == [2, 4]
    assert not left.exists()


def test_a_sweep_that_is_done_is_not_run_again(capsys, tmp_path, monkeypatch):
    """The same command says that all is there; a folder left by a kill after the last rename goes."""
    out = tmp_path / "t.parquet"
    assert sweep(capsys, *SMALL, "--out", out)[0] == 0
    before = out.read_bytes()
    (tmp_path / "t.parquet.parts").mkdir()
    monkeypatch.setattr("closedloop.studies.sweep.sweep.side_by_side", lambda *_: 1 / 0)
    status, said, _ = sweep(capsys, *SMALL, "--out", out)
    assert status == 0
    assert "all were there before" in said
    assert out.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["t.parquet"]


def test_two_at_once_are_one_too_many(tmp_path):
    """While one process is at work on a sweep, another is refused."""
    sweep_ = small()
    with store_module.Store(sweep_.identity, tmp_path / "t.parquet"), pytest.raises(cl.OutputError) as refused:
        run_sweep(sweep_, tmp_path / "t.parquet")
    assert "another process is at work on this sweep" in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--over", "law.forse=1,2"), "wam_slide: unknown key 'law.forse'; did you mean 'law.force'?"),
        (("--over", "law.force=5:15:0"), "--over law.force=5:15:0: 0 values: must be"),
        ((), "--over: name at least one key and its values, such as --over law.force=5:15:11"),
        (("--over", "law.force=1,2", "--over", "law.force=3"), "--over law.force: comes twice"),
        (("--over", "law.force=1:2", "--random", "0"), "--random 0: must be at least 1"),
        (("--over", "law.force=1:2", "--random", "2", "--seed", "-1"), "--seed -1: must be 0 or above"),
        (("--over", "law.force=1:2", "--latin", "2000000"), "2000000 runs: a latin sweep may have 1000000"),
        (("--over", "law.force=1:2:20000", "--over", "law.kp=1:2:20000"), "400000000 runs: a grid sweep may have"),
        (("--over", "law.force=1,2", "--keep", "g"), "keep: no column 'g'; there are f (contact_force)"),
        (("--over", "robot.drive_inertia=true,false", "--keep", "q"), "keep: q has a number a joint, and the robot"),
        (("--over", "law.force=1,2", "--time.integrator", "dop853"), "engine = 'compiled': has no integrator that"),
        (("--over", "law.force=1,2", "--workers", "0"), "workers = 0: must be at least 1"),
        (
            ("--over", "law.force=1,2", "--workers", "1000000"),
            "workers = 1000000: must be at least 1, and at most 1000",
        ),
        (("--over", "law.force=1,2", "--bogus"), "command line: unrecognized arguments: --bogus; see --help"),
        (("--over", "law.force=1,2", "--robot.model", "nobody"), "no robot is named 'nobody'"),
        (("--over", "law.force=1,2", "--out", "t.csv"), "--out t.csv: must end in .parquet"),
        (
            ("--over", "law.force=1,2", "--out", "a_file/t.parquet"),
            "--out a_file/t.parquet: cannot be written: Not a dir",
        ),
        (("--over", "law.force=1,2", "--out", "a_folder.parquet"), "--out a_folder.parquet: exists and is not a sweep"),
        (("--over", "law.force=1,2", "--scheduler", "nowhere"), "--scheduler nowhere: "),
        (("--over", "law.force=1,2", "--scheduler", "tcp://127.0.0.1:1"), "must be the address of a Dask scheduler"),
    ],
)
def test_refusals(capsys, tmp_path, monkeypatch, arguments, said):
    """One line, exit status 2, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("closedloop.studies.sweep.sweep.PATIENCE", 0.5)
    (tmp_path / "a_file").write_text("mine")
    (tmp_path / "a_folder.parquet").mkdir()
    assert said in refusal(capsys, "wam_slide", *arguments)
    assert not list(tmp_path.glob("**/*.arrow"))
    assert (tmp_path / "a_file").read_text() == "mine"


def test_a_key_that_must_be_given_may_be_one_that_changes(capsys, tmp_path):
    """A scenario without it is no scenario of its own, but every run of the sweep has it."""
    (tmp_path / "s.toml").write_text('[robot]\nmodel = "planar2"\n[law]\nkd = 5\n[time]\nduration = 0.01\n')
    words = [str(tmp_path / "s.toml"), "--out", str(tmp_path / "t.parquet"), "--over", "law.force=5,6"]
    assert "'law.kp' is missing" in refusal(capsys, *words)
    sweep(capsys, *words, "--over", "law.kp=100:300:2")
    assert parquet.read_table(tmp_path / "t.parquet")["status"].to_pylist() == ["done"] * 4


def test_no_value_that_was_given_is_dropped(capsys, tmp_path):
    """Beside kinds that change, a key that one of them does not know is refused; one that all know is in every run."""
    out = tmp_path / "t.parquet"
    kinds = ("wam_slide", "--time.duration", "0.002", "--over", "law.kind=paper,hybrid", "--out", out)
    line = refusal(capsys, *kinds, "--law.pd_start", "0.1", "--law.kd", "40")
    assert line.startswith("law.pd_start is given, and law.kind = 'hybrid' has no such key: sweep each kind with its")
    assert sweep(capsys, *kinds, "--law.kd", "40")[0] == 0
    kept = json.loads(parquet.read_schema(out).metadata[store_module.METADATA.encode()])["identity"]["scenario"]
    assert tomllib.loads(kept)["law"]["kd"] == 40.0


def test_what_a_file_says_of_its_kind_stays_beside_a_key_that_it_lacks(tmp_path):
    """The key is taken from the sweep, the kind from the file: else its own keys would be dropped."""
    file = tmp_path / "s.toml"
    file.write_text('[robot]\nmodel = "planar2"\n[law]\nkind = "hybrid"\nkp = 9\napproach_damping = 70.0\n')
    axes = [parse_axis(text) for text in ("law.kind=paper,hybrid", "law.kd=1,2")]
    assert sweep_command._common(str(file), {}, axes, drawn=False).law.approach_damping == 70.0


def test_faults_of_the_scenario_and_of_the_place_are_said_together(capsys, tmp_path):
    """As `closedloop run` does: a line each."""
    (tmp_path / "a_file").write_text("mine")
    words = ("wam_slide", "--law.banana", "1", "--over", "law.force=5,6", "--out", tmp_path / "a_file" / "t.parquet")
    status, _, err = sweep(capsys, *words)
    assert status == 2
    assert ["law.banana" in err.splitlines()[0], "a_file is not a folder" in err.splitlines()[1]] == [True, True]


def test_values_that_only_toml_knows_are_text_in_the_table(capsys, tmp_path):
    """A date among forces is a refused run, not the end of the sweep."""
    out = tmp_path / "t.parquet"
    dates = ("--over", "law.force=1979-05-27,5.0", "--time.duration", "0.002")
    assert sweep(capsys, "wam_slide", *dates, "--out", out)[0] == 0
    table = parquet.read_table(out)
    assert table["status"].to_pylist() == ["refused", "done"]
    assert "1979-05-27" in table["law.force"][0].as_py()


def test_identity_is_all_that_the_table_depends_on(tmp_path):
    """Another force, seed, range, column or robot file is another sweep; the number of workers is not part of it."""
    urdf = Path(cl.__file__).parent.parent / "robot_models" / "planar2" / "planar2.urdf"
    mine = tmp_path / "mine.urdf"
    mine.write_text(urdf.read_text())

    def identity(force=10.0, spec="law.kp=1:2", seed=0, keep=()):
        values = {"robot.model": str(mine), "robot.tip": "tip", "start.q": [0.5, 0.7], "law.force": force}
        scenario = cl.load_scenario("planar2_slide", values)
        return Sweep.of(scenario, Design([parse_axis(spec, True)], "random", 5, seed), keep).identity

    base = identity()
    assert identity() == base
    for change in ({"force": 11.0}, {"spec": "law.kp=1:3"}, {"seed": 1}, {"keep": ("f",)}):
        assert identity(**change) != base, change
    mine.write_text(re.sub(r'mass value="([^"]*)"', 'mass value="1.2345"', urdf.read_text()))
    assert (heavy := identity()["robot"]) != base["robot"]
    mine.with_suffix(".toml").write_text("[drive_inertia]\nJ1 = 0.5\n")
    assert identity()["robot"] != heavy


def test_the_commands_of_the_page_run(capsys, tmp_path, monkeypatch):
    """With fewer and shorter runs, as they stand there."""
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[3] / "docs" / "sweeps.md").read_text(encoding="utf-8")
    commands = re.findall(r"^    closedloop sweep (.*)$", page, re.MULTILINE)
    assert len(commands) == 3
    for command in commands:
        few = re.sub(r":(101|20)\b", ":3", command).replace("--random 10000", "--random 5")
        short = () if few.startswith("plot") else ("--time.duration", "0.02")
        status, out, err = sweep(capsys, *few.split(), *short)
        assert (status, err) == (0, ""), err
        assert "wrote " in out
    assert {path.name for path in tmp_path.iterdir()} == {"sweep.parquet", "random.parquet", "sweep.png"}


def test_an_interrupted_sweep_says_how_to_go_on(capsys, tmp_path, monkeypatch):
    """Ctrl-C ends it with exit status 130 and one line."""

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("closedloop.studies.sweep.store.run_part", interrupt)
    status, _, err = sweep(capsys, *SMALL, "--out", tmp_path / "t.parquet")
    assert (status, err) == (130, "closedloop sweep: interrupted; the same command goes on from here\n")


def test_progress_has_rate_and_time_left():
    """What was done before has no part in the rate; long times are in hours."""
    assert progress_text(0, 10, 0, 0.0) == "0 of 10 runs"
    assert progress_text(150, 1000, 50, 10.0) == "150 of 1000 runs, 5 runs/s, 2 min 50 s left"
    assert progress_text(10, 100_000, 10, 1.0) == "10 of 100000 runs, 10 runs/s, 2 h 46 min left"


def test_a_run_that_fails_is_counted_and_not_run_again(capsys, tmp_path, monkeypatch):
    """An error that nobody foresaw costs its row; exit status 3, now and when asked again; --debug shows where."""
    from closedloop.simulation.batch import worker as worker_module

    whole = worker_module.problem_of

    def broken(scenario, *rest):
        return 1 / 0 if scenario.law.force == 5.0 else whole(scenario, *rest)

    monkeypatch.setattr(worker_module, "problem_of", broken)
    out = tmp_path / "t.parquet"
    arguments = ("wam_slide", "--time.duration", "0.01", "--over", "law.force=5,6,7", "--out", out)
    status, said, err = sweep(capsys, *arguments)
    assert (status, err) == (3, "")
    assert "3 runs: 2 done, 1 failed; 3 in " in said
    row = parquet.read_table(out).to_pylist()[0]
    assert row["status"] == "failed"
    assert row["reason"].startswith("ZeroDivisionError: division by zero (test_sweep.py:")
    status, said, _ = sweep(capsys, *arguments)
    assert status == 3
    assert "3 runs: 2 done, 1 failed; all were there before" in said
    out.unlink()
    assert sweep(capsys, *arguments, "--strict")[0] == 4


@pytest.mark.parametrize(
    ("statuses", "verdicts", "strict", "plain", "said"),
    [
        (["done", "done"], ["good", "good"], 0, 0, "2 runs: 2 done; "),
        (["done", "refused"], ["good", None], 0, 0, "2 runs: 1 done, 1 refused; "),
        (["done", "stopped"], ["good", "stopped"], 4, 0, "1 done, 1 stopped; 1 with a bad verdict: 1 stopped; "),
        (["done", "failed"], ["good", None], 4, 3, "2 runs: 1 done, 1 failed; "),
        (["done", "done"], ["good", "energy, chatter"], 4, 0, "; 1 with a bad verdict: 1 energy, chatter; "),
        (["done", "done"], ["chatter", "chatter"], 4, 0, "; 2 with a bad verdict: 2 chatter; "),
    ],
)
def test_strict_takes_bad_verdicts_and_ends_for_a_failure(
    capsys, tmp_path, monkeypatch, statuses, verdicts, strict, plain, said
):
    """Exit status 4 with --strict, whether the rows are new or read from the table; the last line counts them."""
    from closedloop.studies.sweep import store

    table_of = store.table_of

    def judged(*arguments):
        table = table_of(*arguments)
        at = table["run"].to_pylist()
        for name, column in (("status", statuses), ("verdict", verdicts)):
            values = pa.array([column[i] for i in at], pa.string())
            table = table.set_column(table.column_names.index(name), table.schema.field(name), values)
        return table

    monkeypatch.setattr(store, "table_of", judged)
    arguments = ("wam_slide", "--time.duration", "0.01", "--over", "law.force=5,6", "--out", tmp_path / "t.parquet")
    for options, expected in (((), plain), (("--strict",), strict), ((), plain)):
        status, out, err = sweep(capsys, *arguments, *options)
        assert (status, err) == (expected, "")
        assert f"{said}2 in " in out or f"{said}all were there before" in out  # and nothing in between
