"""Figures 4-7: the run's own numbers are on them, and any run can be drawn."""

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import closedloop as cl
from closedloop.figures import closure_error, contact_force, draw_figures, files, tip_position
from closedloop.figures.files import save_figure
from closedloop.figures.motion import directions


@pytest.fixture(scope="module")
def run():
    """Return a run with the start of the motion in it."""
    return cl.simulate(cl.load_scenario("wam_slide", {"time.duration": 0.7}))


def curves(axes):
    """Return the y data of the curves of an axes, dashed marks left out."""
    return [np.asarray(line.get_ydata()) for line in axes.lines if len(line.get_ydata()) > 2]


def pixels(figure):
    """Return what a figure looks like, coarsely: drawn once, where its two files are drawn thrice."""
    figure.set_dpi(40)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return bytes(canvas.buffer_rgba())


def test_force_figure_shows_the_force(run):
    """Fig. 5 has the whole force in newtons against time, and a second curve around the start of the motion."""
    figure = contact_force(run)
    assert np.array_equal(curves(figure.axes[0])[0], run.contact_force)
    assert "N" in figure.axes[0].get_ylabel()
    assert len(figure.axes) == 2
    near = curves(figure.axes[1])[0]
    assert near.min() == run.contact_force.min()


def test_force_that_is_constant_is_drawn_flat(run):
    """A force constant to rounding is not blown up to its sixteenth digit."""
    rest = cl.simulate(cl.load_scenario("wam_slide", {"reference.kind": "hold", "time.duration": 0.1}))
    low, high = contact_force(rest).axes[0].get_ylim()
    assert high - low > 1.0
    assert low < 10.0 < high


def test_position_figure_shows_the_displacement(run):
    """Fig. 4 has the tip's position, as the paper has it, and its displacement along x, y and z in millimetres."""
    where, axes = tip_position(run).axes[:2]
    assert all(np.array_equal(curve, run.position[:, k]) for k, curve in enumerate(curves(where)[:3]))
    assert where.get_ylabel() == "position [m]"
    moved = 1e3 * (run.position - run.position[0])
    assert "mm" in axes.get_ylabel()
    for k, curve in enumerate(curves(axes)[:3]):
        assert np.allclose(curve, moved[:, k], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("name", "stabiliser"), [("wam_slide", "Baumgarte"), ("wam_slide_unstabilised", "without")])
def test_closure_figure_shows_the_error_in_its_unit(name, stabiliser):
    """Figs. 6 and 7 have e in a unit in which it can be read, and say whether a stabiliser was at work."""
    run = cl.simulate(cl.load_scenario(name, {"time.duration": 0.7}))
    axes = closure_error(run).axes[0]
    factor = {"nm": 1e9, "µm": 1e6, "mm": 1e3}[axes.get_ylabel().split("[")[1].rstrip("]")]
    assert np.allclose(curves(axes)[0], factor * run.closure_error)
    assert 0.05 < np.max(np.abs(curves(axes)[0])) < 1000
    assert stabiliser in axes.get_title("left") + axes.get_title("center")


@pytest.mark.parametrize(
    "changes",
    [
        {"time.duration": 0.001},
        pytest.param({"reference.kind": "hold", "time.duration": 0.01}, marks=pytest.mark.slow),
        pytest.param({"law.pd_start": 0.1, "time.duration": 0.7}, marks=pytest.mark.slow),
    ],
    ids=["two rows", "hold", "PD before the motion"],
)
def test_any_run_can_be_drawn(changes, tmp_path, monkeypatch):
    """Short runs, runs without a motion and runs without a force are drawn without a complaint."""
    monkeypatch.setattr(files, "images", lambda figure, formats: {".png": pixels(figure), ".svg": b""})
    run = cl.simulate(cl.load_scenario("wam_slide", changes))
    paths = draw_figures(run, tmp_path)
    assert [p.stem for p in paths] == [
        "fig4_tip_position", "fig5_contact_force", "fig6_closure_error", "fig_force_control",
    ]  # fmt: skip
    assert all(np.unique(np.frombuffer(path.read_bytes(), np.uint8)).size > 20 for path in paths)


def test_a_tip_that_rests_has_no_path_to_draw():
    """Neither on a surface nor without one; a path without a surface says whence it is seen, not by a key."""
    still = {"reference.kind": "hold", "time.duration": 0.05}
    figure = cl.simulate(cl.load_scenario("planar2_slide", still)).plot()
    assert [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes][1:] == ["Tip error"]
    moving = cl.simulate(cl.load_scenario("push_block", {"time.duration": 0.3})).plot()
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in moving.axes]
    assert "Path, seen from above" in titles


def test_a_singular_pose_is_seen_in_the_first_figure():
    """The tip's mobility along the normal is 0 where the arm passes it; a desired path that is a point is a dot."""
    run = cl.simulate(cl.load_scenario("wam_through_singularity"))
    figure = run.plot()
    mobility = next(axes for axes in figure.axes if axes.get_title(loc="left").startswith("Mobility"))
    drawn = mobility.lines[0].get_ydata()
    assert run.time[np.argmin(drawn)] == pytest.approx(0.6, abs=2e-3)
    assert np.min(drawn) < 1e-3 * np.max(drawn)
    path = next(axes for axes in figure.axes if axes.get_title(loc="left").startswith("Path"))
    assert path.lines[0].get_marker() == "o"
    slide = cl.simulate(cl.load_scenario("planar2_slide", {"time.duration": 0.7})).plot()
    assert not any(axes.get_title(loc="left").startswith("Mobility") for axes in slide.axes)
    assert slide.axes[-2].lines[0].get_marker() in ("", "None", None)


def test_run_without_rows_has_no_figures(tmp_path):
    """A run that stopped at t = 0 has nothing to draw, and is drawn as nothing."""
    changes = {"start.q": [0.0, 0.0], "surface.normal": [1, 0, 0], "reference.kind": "hold"}
    with pytest.raises(cl.SingularClosureError) as caught:
        cl.simulate(cl.load_scenario("planar2_slide", changes))
    assert draw_figures(caught.value.run, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_figures_are_reproducible_and_leave_matplotlib_alone(run, tmp_path):
    """Drawn twice the SVGs are the same bytes, and the user's own settings of matplotlib are as before."""
    before = dict(mpl.rcParams)
    for name in ("one", "two"):
        save_figure(contact_force, run, tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()
    assert dict(mpl.rcParams) == before


@pytest.mark.slow
def test_folder_that_is_not_there_is_an_output_error(run, tmp_path):
    """Figures that cannot be written are an OutputError with the path."""
    with pytest.raises(cl.OutputError, match=r"fig4_tip_position.*cannot be written"):
        draw_figures(run, tmp_path / "missing")


def test_the_direction_of_a_path_on_a_surface_that_moves():
    """It is that of the path in the surface: where the surface breathes, slip and friction change no sign with it."""
    changes = {"reference.start": 0.2, "reference.stop": 0.9, "surface.gap": 0.0, "time.duration": 1.1}
    run = cl.simulate(cl.load_scenario("panda_scan", changes | {"surface_motion.frequency": 2.0}))
    along = directions(run)
    assert np.min(np.sum(along[1:] * along[:-1], axis=1)) > 0.99
    assert along[0, 1] > 0.99


@pytest.mark.slow
def test_a_soft_surface_has_no_unstabilised_closure(tmp_path, monkeypatch):
    """Its figure has the usual name, though there is no stabiliser."""
    monkeypatch.setattr("closedloop.figures.files.save_figure", lambda draw, run, stem: stem.with_suffix(".png"))
    soft = cl.simulate(cl.load_scenario("soft_table", {"time.duration": 0.01}))
    assert "fig_closure_error.png" in {path.name for path in draw_figures(soft, tmp_path)}
