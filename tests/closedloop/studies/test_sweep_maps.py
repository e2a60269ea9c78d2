"""Maps of a sweep: one panel a figure, axes with units, failed runs in sight; what is not there is refused."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pytest
from matplotlib.figure import Figure
from pyarrow import parquet
from sweep_runs import SMALL, refusal, sweep

import closedloop as cl
from closedloop.command.sweep import main
from closedloop.studies.sweep.maps import Scale, draw_maps


@pytest.fixture(scope="module")
def table():
    """Return a grid of 3 forces and 5 time constants, of which the shortest is refused."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.02})
    changes = {"law.force": [5.0, 10.0, 15.0], "stabiliser.time_constant": np.geomspace(5e-4, 0.05, 5)}
    return cl.simulate_batch(scenario, changes, grid=True)


def test_a_grid_is_a_map_with_every_run_in_its_cell(table):
    """The cell of a force and a time constant has that run's value; axes have units; the refused ones are bare."""
    figure = draw_maps(table, ["peak_contact_force"])
    panel, bar = figure.axes
    assert panel.get_xlabel() == "law.force [N]"
    assert panel.get_ylabel() == "stabiliser.time_constant [s]"
    assert (panel.get_xscale(), panel.get_yscale()) == ("linear", "log")
    assert panel.get_title(loc="left") == "highest contact force"
    assert bar.get_ylabel() == "N"
    assert panel.get_xticks().tolist() == [5.0, 10.0, 15.0]
    (mesh,) = panel.collections
    cells = np.ma.filled(mesh.get_array().reshape(5, 3), np.nan)
    np.testing.assert_array_equal(cells, table["peak_contact_force"].to_numpy().reshape(3, 5).T)
    assert np.isnan(cells[0]).all()
    assert np.isfinite(cells[1:]).all()
    assert "15 runs, 3 refused" in figure.get_suptitle()


def test_maps_are_drawn_on_axes_of_the_users_own(table, tmp_path):
    """Two panels side by side on a figure of one's own, no file; a number of axes that does not fit is refused."""
    own = Figure(figsize=(6.0, 2.0))
    axes = own.subplots(1, 2)
    assert cl.sweep_plot(table, ["peak_contact_force", "max_abs_closure_error"], ax=list(axes)) is own
    assert axes[0].get_title(loc="left") == "highest contact force"
    assert axes[1].get_title(loc="left").startswith("largest closure error")
    assert cl.sweep_plot(table, ["peak_contact_force", "max_abs_closure_error"], ax=own.add_subplot()) is own
    with pytest.raises(cl.ScenarioError, match="has 2 axes; give one"):
        cl.sweep_plot(table, ["peak_contact_force", "max_abs_closure_error", "rms_force_error"], ax=list(axes))
    with pytest.raises(cl.ScenarioError, match="out: cannot be given with ax"):
        cl.sweep_plot(table, ax=axes[0], out=tmp_path / "a.png")


def test_one_key_is_a_curve_and_a_second_few_more(table):
    """A curve for each value of the other key where x alone is named; lengths are in a unit that reads well."""
    (panel,) = draw_maps(table, ["max_abs_closure_error"], x="stabiliser.time_constant").axes
    curves = [line for line in panel.lines if line.get_label().startswith("law.force = ")]
    assert [line.get_label() for line in curves] == ["law.force = 5", "law.force = 10", "law.force = 15"]
    error = table["max_abs_closure_error"].to_numpy().reshape(3, 5)[1]
    factor = {"m": 1.0, "nm": 1e9, "µm": 1e6}[panel.get_ylabel()]
    np.testing.assert_allclose(curves[1].get_ydata(), factor * error)
    assert [line.get_label() for line in panel.lines][-1] == "failed, or none"


def test_draws_are_dots_and_words_are_in_order():
    """Random values of two keys are dots at their places; words keep the order in which they came."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.004})
    force, kp = [5.0, 7.0, 6.5, 9.0], [100.0, 300.0, 200.0, 500.0]
    drawn = cl.simulate_batch(scenario, {"law.force": force, "law.kp": kp})
    (dots,) = draw_maps(drawn, ["peak_contact_force"]).axes[0].collections
    np.testing.assert_array_equal(dots.get_offsets(), np.column_stack([force, kp]))
    words = cl.simulate_batch(scenario, {"time.integrator": ["rk4", "explicit_euler", "rk4"]})
    assert Scale(words, "time.integrator").words == ["rk4", "explicit_euler"]
    assert draw_maps(words).axes[0].get_xticklabels()[1].get_text() == "explicit_euler"


@pytest.mark.slow
def test_the_command_draws_a_file(capsys, tmp_path):
    """A picture beside the table, or where it is wanted."""
    out = tmp_path / "t.parquet"
    assert sweep(capsys, *SMALL, "--out", out)[0] == 0
    status, said, _ = sweep(capsys, "plot", out)
    assert status == 0
    assert said == f"wrote {tmp_path / 't.png'}\n"
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")
    assert sweep(capsys, "plot", out, "--of", "rms_force_error", "--out", tmp_path / "deep" / "t.svg")[0] == 0
    assert b"RMS error of the contact force" in (tmp_path / "deep" / "t.svg").read_bytes()


def test_one_row_and_missing_values_are_drawn(table):
    """A sweep of one run, and one of which no run came to anything, have maps too."""
    assert draw_maps(table.slice(4, 1)).axes
    bare = table.filter(pa.compute.equal(table["status"], "refused"))
    assert bare["peak_contact_force"].null_count == len(bare) == 3
    assert draw_maps(bare, ["peak_contact_force"]).axes


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Return a folder with the table of a sweep, and tables that are none, damaged or empty."""
    folder = tmp_path_factory.mktemp("tables")
    assert main([*SMALL, "--out", str(folder / "t.parquet")]) == 0
    rows = parquet.read_table(folder / "t.parquet")
    (folder / "text.parquet").write_text("not a table")
    (folder / "cut.parquet").write_bytes((folder / "t.parquet").read_bytes()[:-100])
    name, other = b"max_stabiliser_force", b"max_stabiliser_farce"
    before, between, behind = (folder / "t.parquet").read_bytes().split(name)
    (folder / "first.parquet").write_bytes(before + other + between + name + behind)
    (folder / "second.parquet").write_bytes(before + name + between + other + behind)
    parquet.write_table(rows.drop_columns("status"), folder / "other.parquet")
    parquet.write_table(rows.drop_columns(["law.force", "stabiliser.time_constant"]), folder / "keyless.parquet")
    parquet.write_table(rows.slice(0, 0), folder / "rowless.parquet")
    parquet.write_table(rows.set_column(1, "law.force", pa.nulls(12, pa.float64())), folder / "nulls.parquet")
    large, at = pa.array([1e308] * 6 + [-1e308] * 6), rows.column_names.index("min_contact_force")
    parquet.write_table(rows.set_column(at, "min_contact_force", large), folder / "large.parquet")
    parquet.write_table(rows.set_column(1, "law.force", large), folder / "far.parquet")
    return folder


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("no.parquet",), "no.parquet: there is no such file; name the table of a sweep"),
        (("text.parquet",), "text.parquet: is no Parquet file, or is damaged"),
        (("cut.parquet",), "cut.parquet: is no Parquet file, or is damaged"),
        (("first.parquet",), "first.parquet: is no Parquet file, or is damaged"),  # by the name of a column
        (("second.parquet",), "second.parquet: is no Parquet file, or is damaged"),
        (("folder.parquet",), "folder.parquet: is a folder; name the table of a sweep"),
        (("pipe.parquet",), "pipe.parquet: is a pipe; name the table of a sweep"),
        (("other.parquet",), "other.parquet: is not the table of a sweep"),
        (("keyless.parquet",), "the table has no key that changes, or no value to draw"),
        (("rowless.parquet",), "the table has no rows"),
        (("nulls.parquet",), "law.force: has no value in some rows: this is not the table of a sweep"),
        (("large.parquet",), "min_contact_force: has values of up to 1e+308, and is drawn up to 1e+150"),
        (("far.parquet",), "law.force: has values of up to 1e+308, and is drawn up to 1e+150"),
        (("t.parquet", "--x", "law.force", "--y", "law.force"), "law.force: is given for both axes"),
        (("t.parquet", "--of", "beauty"), "beauty: is not a value of this sweep; they are rows, end_time"),
        (("t.parquet", "--of", "min_contactforce"), "of this sweep; did you mean 'min_contact_force'?"),
        (("t.parquet", "--x", "law.kp"), "law.kp: is not a key of this sweep; they are law.force, stab"),
        (("t.parquet", "--out", "t.odt"), "--out t.odt: cannot be written: Format 'odt' is not supported"),
        (("t.parquet", "--out", "text.parquet/t.png"), "--out text.parquet/t.png: cannot be written: "),
    ],
)  # fmt: skip
def test_refusals(capsys, tmp_path, monkeypatch, tables, arguments, said):
    """One line and exit status 2."""
    monkeypatch.chdir(tmp_path)
    for file in tables.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "folder.parquet").mkdir()
    os.mkfifo(tmp_path / "pipe.parquet")
    assert said in refusal(capsys, "plot", *arguments)
