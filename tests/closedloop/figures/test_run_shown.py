"""How a run shows itself: as a figure, as a DataFrame, in Jupyter; and what help says."""

import pydoc
import xml.etree.ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest
from rounding import within

import closedloop as cl
from closedloop.figures.motion import directions, tip_errors
from closedloop.mechanics.closure.contact_force import FREE


@pytest.fixture(scope="module")
def run():
    """Return a run that comes down on the surface, with a noisy force sensor."""
    return cl.simulate(cl.load_scenario("wam_touchdown", {"time.duration": 4.0, "sensor.noise": 0.05}))


def test_plot_shows_force_errors_and_path(run):
    """The figure has f − f_des in contact, true and measured, the tip's three errors, and the path in two colours."""
    before = dict(mpl.rcParams)
    figure = run.plot()
    assert dict(mpl.rcParams) == before
    force, tip, path, *_ = figure.axes
    true = np.where(run.mode != FREE, run.contact_force - run.reference_force, np.nan)
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in force.lines}
    assert np.array_equal(drawn["true"], true, equal_nan=True)
    assert np.nanstd(drawn["measured"] - drawn["true"]) == pytest.approx(0.05, rel=0.1)
    assert "N" in force.get_ylabel()
    (normal,) = (line for line in tip.lines if line.get_label().startswith("normal"))
    assert np.asarray(normal.get_ydata()) == pytest.approx(1e3 * tip_errors(run).normal)
    assert "mm" in tip.get_ylabel()
    (pieces,) = path.collections
    assert pieces.get_array().min() >= 0.0
    assert "f [N]" in [axes.get_ylabel() for axes in figure.axes]


def test_tip_errors_are_the_parts_of_one_vector(run):
    """Along the path, across it and along the normal are an orthonormal frame: their squares are the error's."""
    off = np.linalg.norm(run.position - run.reference_tip, axis=1)
    assert within(16, np.linalg.norm(tip_errors(run), axis=0), off, run.position)
    assert np.linalg.norm(directions(run), axis=1) == pytest.approx(np.ones(len(run)))


def test_limits_are_drawn_where_they_are_near():
    """Torque beyond a joint's limit is drawn with the limit, a limit far away only named."""
    run = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.1}))
    low, high = -run.model.effort_limit, run.model.effort_limit

    def dashed(axes):
        return sorted(line.get_ydata()[0] for line in axes.lines if len(line.get_ydata()) == 2)

    assert dashed(cl.figures.joints(run).axes[0]) == []
    torque = np.linspace(0.0, 1.2, len(run))[:, None] * high
    strong = cl.Run(run.scenario, run.model, {**run.columns, "torque": torque})
    axes = cl.figures.joints(strong).axes[0]
    assert set(high) < set(dashed(axes))
    assert "120 % of a limit" in axes.get_title("left") + axes.get_title("center")
    assert min(low) not in dashed(axes)


def test_data_frame_has_every_column_over_time(run):
    """A column for each component, named after joints and axes, with the run's numbers and units."""
    table = run.to_pandas()
    assert table.index.name == "time"
    assert np.array_equal(table.index, run.time)
    for k, joint in enumerate(run.model.joint_names):
        assert np.array_equal(table[f"q[{joint}]"], run.q[:, k])
    assert np.array_equal(table["position[z]"], run.position[:, 2])
    assert np.array_equal(table["contact_force"], run.contact_force)
    assert table.attrs["units"]["torque[J1]"] == "N m"
    assert set(table.attrs["units"]) == {*table.columns, "time"}


def test_page_in_jupyter_is_whole_and_says_the_verdict(run):
    """The HTML has balanced tags, one picture, the verdict and the numbers of the report; short runs have theirs."""
    short = cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.001}))
    for each in (run, short):
        page = each._repr_html_()
        tree = ET.fromstring(f"<page>{page.replace('<br>', '<br/>')}</page>")
        assert len([element for element in tree.iter() if element.tag.endswith("svg")]) == 1
        assert "verdict: good" in page
        assert "contact force f at the end" in page
        assert len(page) < 60_000


def test_run_without_rows_shows_what_stopped_it():
    """A run that stopped at t = 0 has nothing to draw, and its page says why."""
    changes = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold"}
    with pytest.raises(cl.SingularClosureError) as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes))
    run = caught.value.run
    with pytest.raises(ValueError, match="has no row to draw"):
        run.plot()
    assert "singular" in run._repr_html_()
    assert len(run.to_pandas()) == 0


def test_help_is_one_screen_of_public_names():
    """help(closedloop) names all that is public, and not what is inside."""
    text = pydoc.render_doc(cl, renderer=pydoc.plaintext)
    shown, _, contents = text.partition("PACKAGE CONTENTS")
    missing = [name for name in cl.__all__ if name not in shown and name not in ("ClosedLoopError",)]
    assert missing == []
    assert len(text.splitlines()) < 100
    assert "Method resolution order" not in text
    assert contents


def test_everything_can_be_imported_by_star():
    """`from closedloop import *` gives the public names."""
    names = {}
    exec("from closedloop import *", names)
    assert set(cl.__all__) <= set(names)
    assert [names[name].__name__ for name in ("Simulator", "figures", "simulate")] == [
        "Simulator", "closedloop.figures", "simulate",
    ]  # fmt: skip
