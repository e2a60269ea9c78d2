"""What is drawn of free bodies and of what they touch."""

from importlib import import_module

import matplotlib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import closedloop as cl
from closedloop.figures import draw_figures
from closedloop.figures.force import link_contacts, spans_of
from closedloop.figures.motion import bodies, turned
from closedloop.figures.scene.scene import scene_of
from closedloop.figures.style import MANY, MOST_CURVES, OTHERS
from closedloop.lab.curves import panels


@pytest.fixture(scope="module")
def toss():
    """A cube that has fallen on the floor."""
    low = {"start.q": [0, 0, 0.1, 0.87, 0.36, 0.24, 0.24], "start.v": [1, 0, -1, 5, -7, 3], "time.duration": 0.03}
    return cl.simulate(cl.load_scenario("cube_toss", low), progress=False)


def test_figures_are_of_the_body_and_its_contacts_and_of_no_tip(toss, tmp_path):
    """No figure of a tip that nothing leads, of joints that there are not, or of quaternions."""
    names = [path.stem for path in draw_figures(toss, tmp_path)]
    assert names == ["fig_bodies", "fig_link_contacts", "fig_impacts"]
    assert [axes.get_title(loc="left") for axes in toss.plot().axes][1] == "Horizontal distance from the start"


def test_what_is_drawn_is_the_run(toss):
    """Height in millimetres, the angle of the turn in degrees; a row of bars for each contact; at most eight curves."""
    with matplotlib.rc_context({"axes.titlelocation": "left"}):
        height, _, angle = bodies(toss).axes[:3]
        times, forces = link_contacts(toss).axes[:2]
    np.testing.assert_allclose(height.lines[0].get_ydata(), 1e3 * toss.q[:, 2])
    wanted = Rotation.from_quat(toss.q[:, 3:], scalar_first=True)
    np.testing.assert_allclose(
        angle.lines[0].get_ydata(), np.degrees((wanted[0].inv() * wanted).magnitude()), atol=1e-6
    )
    assert [text.get_text() for text in times.get_yticklabels()] == [f"corner {k}" for k in range(1, 9)]
    assert 0 < len([line for line in forces.lines if line.get_label().startswith("corner")]) <= 8


def test_bodies_at_rest_have_no_panel_of_rounding():
    """Of boxes that stand the height alone is drawn: they go nowhere and do not turn, but for 1e-16."""
    run = cl.simulate(cl.load_scenario("tower", {"time.duration": 0.02}), progress=False)
    (height,) = bodies(run).axes
    assert height.get_title(loc="left") or height.get_title()
    assert len([line for line in height.lines if not line.get_label().startswith("_")]) == 5


def test_angles_of_turns_to_rounding():
    """From nothing to half a turn, and of either sign of a quaternion."""
    angles = np.array([0.0, 1e-9, 0.3, 2.0, np.pi - 1e-6])
    quaternions = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    np.testing.assert_allclose(turned(quaternions), angles, atol=1e-15)
    np.testing.assert_allclose(turned(quaternions * [[1], [-1], [1], [-1], [1]]), angles, atol=1e-15)


def test_spans_are_from_the_first_row_to_the_next_after_the_last():
    """Of rows in which a condition holds."""
    now, time = np.array([True, False, True, True, False, True]), np.arange(6.0)
    assert spans_of(now, time) == [(0.0, 1.0), (2.0, 4.0), (5.0, 5.0)]


def test_the_scene_has_the_body_as_its_file_has_it_and_the_floor(toss):
    """A box of the size of the geom in its colour, a plane at z = 0, and no arrow of a force that is not commanded."""
    scene = scene_of(toss)
    (box,) = scene.shapes
    np.testing.assert_allclose(np.ptp(box.vertices, axis=0), 0.1048, rtol=1e-6)
    assert box.colour == (0.16, 0.38, 0.68)
    vertices, faces = scene.surface
    assert faces.shape == (2, 3)
    np.testing.assert_array_equal(vertices[:, 2], 0.0)
    assert scene.kinds == ["force between links"]


def test_joints_that_are_too_many_are_grey(monkeypatch):
    """Those with a drive are named, each in a colour of its own that its limits have; the others are counted."""
    monkeypatch.setattr(import_module("closedloop.figures.style"), "MOST_CURVES", 2)
    run = cl.simulate(cl.load_scenario("five_bar", {"time.duration": 0.002}))
    figure = cl.figures.joints(run)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["J1", "J2"]
    assert legend.get_title().get_text() == "joints; limits dashed; grey: 2 others"
    for axes in figure.axes:
        colours = [line.get_color() for line in axes.lines[:4]]
        assert colours.count(OTHERS) == 2
        assert len({*colours}) == 3


def test_every_named_curve_has_a_colour_of_its_own():
    """As many colours as a panel has curves at most, none of them black, which axes and marks have."""
    assert len(set(MANY)) == len(MANY) == MOST_CURVES
    assert "#000000" not in MANY


def test_the_first_figure_is_about_the_contacts_where_the_tip_touches_nothing(toss, tmp_path):
    """Of a cube that is thrown they are its contacts, before its motion and its impacts."""
    names = [path.stem for path in draw_figures(toss, tmp_path)]
    assert names[:2] == ["fig_bodies", "fig_link_contacts"]


def test_the_forces_of_links_are_drawn_where_no_tip_touches():
    """The first panel of an arm that pushes a block has a curve for each contact, with its name and its force."""
    run = cl.simulate(cl.load_scenario("push_block", {"time.duration": 0.7}))
    first = run.plot().axes[0]
    assert "Contact forces" in first.get_title(loc="left") + first.get_title()
    assert [line.get_label() for line in first.lines[:5]] == ["foot 1", "foot 2", "foot 3", "foot 4", "pusher"]
    for k, line in enumerate(first.lines[:5]):
        np.testing.assert_array_equal(line.get_ydata(), run.link_forces[:, k])
    assert run.link_forces[-1, 4] > 1.0


def test_boxes_that_rest_show_what_each_carries(tmp_path):
    """Of twenty points the curves are sums over the four of each box: 5, 4, 3, 2 and 1 weights of 9.81 N."""
    run = cl.simulate(cl.load_scenario("tower", {"time.duration": 0.02}))
    with matplotlib.rc_context({"axes.titlelocation": "left"}):
        _, forces, friction = run.plot().axes[:3]
    assert forces.get_title(loc="left") == "Contact forces, sums over points (tower)"
    assert [line.get_label() for line in forces.lines[:5]] == [f"box {k}" for k in range(1, 6)]
    weights = [line.get_ydata()[-1] for line in forces.lines[:5]]
    np.testing.assert_allclose(weights, 9.81 * np.arange(5, 0, -1), rtol=1e-6)
    limits = [line.get_ydata()[-1] for line in friction.lines[1:10:2]]
    np.testing.assert_allclose(limits, 0.5 * np.array(weights), rtol=1e-12)
    assert draw_figures(run, tmp_path)[0].stem == "fig_link_contacts"
    (panel,) = panels(run)
    assert panel.title == "link forces, sums over points [N]"
    np.testing.assert_allclose([t.values[-1] for t in panel.traces if not t.limit], weights)


def test_each_joint_has_its_own_unit_and_bars_hide_no_text():
    """Of an arm beside a free block: its own units, a limit in that of its joint; a height that stays has no panel."""

    def told(figure):
        return [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]

    run = cl.simulate(cl.load_scenario("push_block", {"time.duration": 0.7}))
    drawn = cl.figures.joints(run)
    assert [axes.get_ylabel() for axes in drawn.axes] == ["torque [N m]", "velocity [rad/s]", "position [rad]"]
    assert not any("|" in title for title in told(drawn))
    times, *_ = link_contacts(run).axes
    assert not times.texts
    assert told(bodies(run)) == ["Horizontal distance from the start (wam4)", "Rotation from the start"]
    delta = cl.simulate(cl.load_scenario("delta", {"time.duration": 0.01}))
    drawn = cl.figures.joints(delta)
    assert drawn.axes[0].get_ylabel() == "torque [N m | N]"
    assert not any("|" in title for title in told(drawn))
