"""Figures of runs whose contact changes: modes are bands, events are marks, and every curve is the run's own."""

import dataclasses
from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb

import closedloop as cl
from closedloop.figures import closure_error, contact_force, draw_figures, files, friction_force, impacts, tip_position
from closedloop.figures.force import transients
from closedloop.figures.style import BANDS, SHAPES, intervals, marks, thinned
from closedloop.loop.events.table import IMPACT, KINDS
from closedloop.mechanics.closure.contact_force import FREE, PRESSED, STUCK

OVER_TIME = (tip_position, contact_force, closure_error)
UNITS = {"nm": 1e9, "µm": 1e6, "mm": 1e3}


@pytest.fixture(scope="module")
def sliding():
    """Return a slide with Coulomb friction: stuck, sliding from 0.5 s on, stuck again after the stop at 0.8 s."""
    changes = {"friction.kind": "coulomb", "friction.coefficient": 0.3, "reference.stop": 0.8, "time.duration": 1.2}
    return cl.simulate(cl.load_scenario("wam_slide", changes))


def start_of(name, **changes):
    """Return the first two steps of a shipped scenario."""
    return cl.simulate(cl.load_scenario(name, {"time.duration": 0.002} | changes))


def curves(axes):
    """Return the y data of the curves of an axes: lines of more than two points, marks of events left out."""
    return [
        np.asarray(line.get_ydata())
        for line in axes.lines
        if len(line.get_ydata()) > 2 and line.get_transform() == axes.transData
    ]


def bands(axes, mode):
    """Return the bands of a mode as (begin, end), s."""
    colour = mpl.colors.to_rgba(BANDS[mode][1]["facecolor"])
    found = [c for c in axes.collections if isinstance(c, PolyCollection) and tuple(c.get_facecolor()[0]) == colour]
    return [tuple(path.get_extents().intervalx) for c in found for path in c.get_paths()]


def event_times(axes, kind):
    """Return the instants at which an axes has the mark of a kind of event."""
    shape = SHAPES[kind]["marker"]
    lines = [line for line in axes.lines if line.get_marker() == shape and line.get_transform() != axes.transData]
    return np.concatenate([np.asarray(line.get_xdata()) for line in lines] or [np.empty(0)])


def unit_of(axes):
    """Return how many units of its vertical axis a metre has."""
    return UNITS[axes.get_ylabel().split("[")[1].rstrip("]")]


def names(legend):
    """Return the texts of a legend."""
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize("name", ["wam_touchdown", "wam_bounce", "wam_liftoff", "wam_edge", "planar2_drop"])
def test_intervals_are_the_modes_between_the_events(name, shipped_run):
    """Intervals fill the run without a gap, hold the mode of every row, and meet at the events' own instants."""
    run = shipped_run(name)
    found = intervals(run)
    assert found[0].begin == run.time[0]
    assert found[-1].end == run.time[-1]
    assert all(a.end == b.begin and a.mode != b.mode for a, b in pairwise(found))
    bounds = [each.end for each in found[:-1]]
    assert bounds == [event.time for event in run.events if event.kind in ("touchdown", "liftoff")]
    assert len(bounds) > 0
    which = np.searchsorted(bounds, run.time, side="right")
    assert np.array_equal(run.mode, np.array([each.mode for each in found])[which])


@pytest.mark.parametrize("draw", OVER_TIME)
def test_free_motion_is_a_band_in_every_panel(draw, shipped_run):
    """Each panel has the free time as its band, cut where the panel ends, and nothing behind the pressed time."""
    run = shipped_run("wam_edge")
    liftoff, touchdown = (next(e.time for e in run.events if e.kind == kind) for kind in ("liftoff", "touchdown"))
    figure = draw(run)
    assert len(figure.axes) >= 2
    for axes in figure.axes:
        if "impulses" in axes.get_ylabel():  # the second axis of a panel
            continue
        begin, end = axes.get_xlim()
        assert bands(axes, FREE) == [pytest.approx((max(liftoff, begin), min(touchdown, end)))]
        assert bands(axes, STUCK) == bands(axes, PRESSED) == []


@pytest.mark.parametrize("draw", OVER_TIME)
def test_every_event_has_its_mark_on_the_time_axis(draw, shipped_run):
    """The lowest panel over the whole run has the mark of every event; panels of a part have those within."""
    run = shipped_run("wam_edge")
    figure = draw(run)
    marked = [axes for axes in figure.axes if any(event_times(axes, kind).size for kind in KINDS)]
    assert marked
    for axes in marked:
        begin, end = axes.get_xlim()
        for kind in KINDS:
            inside = thinned(run.event_time[run.event_kind == kind], begin, end)
            assert np.array_equal(event_times(axes, kind), inside)
    whole = [axes for axes in marked if axes.get_xlim() == (run.time[0], run.time[-1])]
    assert len(whole) == 1


@pytest.mark.parametrize("draw", OVER_TIME)
def test_bands_and_events_are_explained_once(draw, shipped_run):
    """One legend a figure names the modes and the events of that run, and no others."""
    expected = {
        "wam_edge": ["free", "pressed", "impact", "touchdown", "liftoff"],
        "wam_liftoff": ["free", "pressed", "liftoff"],
    }
    for name, wanted in expected.items():
        figure = draw(shipped_run(name))
        assert [names(legend) for legend in figure.legends] == [wanted]


@pytest.mark.parametrize("draw", OVER_TIME)
def test_unbroken_contact_is_drawn_as_the_paper_does(draw, shipped_run):
    """A run that is pressed from start to end has no bands, no events and no legend of them."""
    figure = draw(shipped_run("wam_slide"))
    assert figure.legends == []
    for axes in figure.axes:
        assert len(axes.collections) == 0
        assert all(event_times(axes, kind).size == 0 for kind in KINDS)


def test_bands_and_events_are_told_apart_without_colour():
    """In grey, bands differ by a twentieth in lightness or by hatching; every kind of event has its own shape."""
    grey = {mode: np.dot((0.299, 0.587, 0.114), to_rgb(style["facecolor"])) for mode, (_, style) in BANDS.items()}
    assert grey[PRESSED] - grey[FREE] > 0.05
    assert BANDS[STUCK][1].get("hatch")
    assert not any(BANDS[mode][1].get("hatch") for mode in (FREE, PRESSED))
    assert set(SHAPES) == set(KINDS)
    assert len({shape["marker"] for shape in SHAPES.values()}) == len(KINDS)


def test_many_events_are_thinned_to_what_can_be_seen(shipped_run):
    """Ten thousand impacts are drawn as a few hundred marks, each at an event, all over the time that they took."""
    run = shipped_run("wam_bounce")
    count = 10_000
    many = {name: np.resize(run.columns[name], (count, *run.columns[name].shape[1:])) for name in run.columns}
    flood = {k: v for k, v in many.items() if k.startswith("event_")}
    flood["event_time"] = np.sort(np.random.default_rng(0).uniform(0.5, 2.0, count))
    flood["event_kind"] = np.full(count, IMPACT, dtype=np.int8)
    flooded = dataclasses.replace(run, columns={**run.columns, **flood})
    drawn = event_times(closure_error(flooded).axes[-1], IMPACT)
    assert 100 < drawn.size <= 251
    assert np.all(np.isin(drawn, flood["event_time"]))
    assert np.max(np.diff(drawn)) < 0.03
    assert drawn[0] == flood["event_time"][0]
    assert drawn[-1] > 1.97


def test_gap_and_closure_error_are_both_readable(shipped_run):
    """Above, e as a gap in millimetres; below, the error in contact in its own unit, and nothing while free."""
    run = shipped_run("wam_edge")
    above, below = closure_error(run).axes
    assert unit_of(above) == 1e3
    assert np.allclose(curves(above)[0], 1e3 * run.closure_error)
    free = run.mode == FREE
    error = curves(below)[0]
    assert np.all(np.isnan(error[free]))
    assert np.allclose(error[~free], unit_of(below) * run.closure_error[~free])
    assert 0.02 < np.max(np.abs(error[~free])) < 1000
    low, high = below.get_ylim()
    assert high - low < 2 * np.ptp(error[~free])
    assert "Gap" in above.get_title("left") + above.get_title("center")
    assert "Baumgarte" in below.get_title("left") + below.get_title("center")


def test_error_that_is_rounding_is_drawn_flat():
    """Projection leaves no error but rounding, which is not blown up to look like one."""
    run = cl.simulate(
        cl.load_scenario(
            "wam_slide", {"stabiliser.kind": "projection", "reference.kind": "hold", "time.duration": 0.01}
        )
    )
    assert np.max(np.abs(run.closure_error)) < 1e-15
    (axes,) = closure_error(run).axes
    assert axes.get_ylim()[1] > 1.5 * np.max(np.abs(run.closure_error))
    level = 4.0 * np.finfo(float).eps * np.max(np.abs(run.position))
    assert [line.get_ydata()[0] for line in axes.lines if len(line.get_ydata()) == 2] == [-level, level]
    assert "rounding" in " ".join(text.get_text() for text in axes.texts)


def test_run_that_never_touches_has_a_gap_only():
    """A tip that stays off the surface has one panel, and it is no error."""
    (axes,) = closure_error(start_of("wam_touchdown")).axes
    assert "Gap" in axes.get_title("left") + axes.get_title("center")


def test_force_is_drawn_with_the_profile_it_was_commanded(shipped_run):
    """The force is zero while free, and the commanded force is the profile, below zero where it pulls."""
    run = shipped_run("wam_edge")
    whole = contact_force(run).axes[0]
    force, commanded = curves(whole)[:2]
    assert np.array_equal(force, run.contact_force)
    assert np.all(force[run.mode == FREE] == 0.0)
    assert np.array_equal(commanded, run.reference_force)
    assert commanded.min() == -4.0


def test_what_is_enlarged_is_where_the_force_changes(shipped_run):
    """Liftoff and touchdown are enlarged; of the least-jerk motion's start and stop, where nothing happens, neither."""
    run = shipped_run("wam_edge")
    found = transients(run)
    assert [text.split(" at ")[0] for text, _ in found] == ["liftoff", "touchdown"]
    for (_, rows), kind in zip(found, ("liftoff", "touchdown"), strict=True):
        begin, end = run.time[rows][[0, -1]]
        (instant,) = (event.time for event in run.events if event.kind == kind)
        assert begin < instant < end
    assert transients(shipped_run("wam_slide_unstabilised"))
    assert transients(start_of("wam_touchdown")) == []


def test_sticking_is_enlarged_where_it_begins_and_ends(sliding):
    """The slip at 0.5 s and the stick after the stop at 0.8 s are in an enlarged part each."""
    windows = [sliding.time[rows][[0, -1]] for _, rows in transients(sliding)]
    assert len(windows) == 2
    for kind in ("slip", "stick"):
        (instant,) = (event.time for event in sliding.events if event.kind == kind)
        assert sum(begin < instant < end for begin, end in windows) == 1


def test_small_changes_are_not_enlarged(shipped_run):
    """Beside a force that rises from 0 to 10 N, 0.1 N at the end of a motion is nothing to enlarge; 0.5 N is."""
    run = shipped_run("wam_touchdown")
    assert [text.split(" at ")[0] for text, _ in transients(run)] == ["touchdown"]
    for change, panels in ((0.1, 1), (0.5, 2)):
        force = run.contact_force.copy()
        force[8000:] += change  # where the motion stops
        flawed = dataclasses.replace(run, columns={**run.columns, "contact_force": force})
        assert len(transients(flawed)) == panels


def test_no_more_is_enlarged_than_there_is_room_for(shipped_run):
    """Of four transients the three with the largest changes are enlarged, in order of time."""
    run = cl.simulate(cl.load_scenario("wam_edge", {"reference.timing": "constant"}))
    found = transients(run)
    assert [text.split(" at ")[0] for text, _ in found] == ["PD and motion start", "touchdown", "motion stops"]
    assert len(contact_force(run).axes) == 4 + 1  # and the impulses' axis


def test_impacts_are_the_events(shipped_run):
    """Rates, impulses and losses are the events', on logarithmic axes; a bounce cut to rest has its own mark."""
    run = shipped_run("wam_bounce")
    above, middle, below = impacts(run).axes
    before, after, cut = curves(above)
    assert np.array_equal(before, -run.event_rate_before)
    assert np.array_equal(after[:-1], run.event_rate_after[:-1])
    assert np.isnan(after[-1])
    assert np.all(np.isnan(cut[:-1]))
    assert cut[-1] == run.event_rate_cut[-1] > 0.0
    compression, decompression = curves(middle)
    assert np.array_equal(compression, run.event_compression)
    assert np.array_equal(decompression[:-1], run.event_decompression[:-1])
    assert np.array_equal(curves(below)[0], run.event_energy_lost)
    for axes in (above, middle, below):
        assert axes.get_yscale() == "log"
        low, high = axes.get_ylim()
        assert all(low < np.nanmin(curve) and np.nanmax(curve) < high for curve in curves(axes))
        assert axes.get_xlim()[0] < run.event_time[0] < run.event_time[-1] < axes.get_xlim()[1]


def test_a_single_impact_is_drawn_from_zero():
    """Without restitution the ball of one drop has one impact, too few for a logarithmic axis."""
    run = cl.simulate(cl.load_scenario("planar2_drop", {"impact.restitution": 0.0, "time.duration": 0.3}))
    assert [event.kind for event in run.events] == ["touchdown"]
    for axes in impacts(run).axes:
        assert axes.get_yscale() == "linear"
        assert axes.get_ylim()[0] == 0.0


def test_run_without_an_impact_has_none_to_draw(shipped_run):
    """A liftoff is no impact, nor is a slide."""
    for name in ("wam_liftoff", "wam_slide"):
        with pytest.raises(ValueError, match="no impact"):
            impacts(shipped_run(name))


def test_friction_stands_beside_what_it_can_be(sliding):
    """The friction drawn is the run's, at its limit μf while the tip slides and within it while the tip sticks."""
    above, below = friction_force(sliding).axes
    limit, below_zero, friction = curves(above)
    assert np.array_equal(limit, 0.3 * sliding.contact_force)
    assert np.array_equal(below_zero, -limit)
    friction = -friction  # it resists slip along the path
    assert np.allclose(friction, np.linalg.norm(sliding.friction_force, axis=1), atol=1e-6)
    stuck = sliding.mode == STUCK
    assert 500 < stuck.sum() < 1000
    assert friction[~stuck] == pytest.approx(limit[~stuck], rel=1e-9)
    assert np.all(friction[stuck] < limit[stuck])
    assert "μ f" in " ".join(names(above.get_legend()))
    speed = curves(below)[0]
    assert np.all(speed[stuck] < 1e-3)
    assert speed.max() == pytest.approx(1e3 * sliding.scenario.reference.speed, rel=0.1)
    for axes in (above, below):
        assert len(bands(axes, STUCK)) == 2
        assert bands(axes, FREE) == []


def test_both_levels_of_friction_are_drawn_where_there_are_two():
    """Stribeck's friction has a static and a kinetic level."""
    changes = {"friction.kind": "stribeck", "friction.kinetic": 0.2, "friction.static": 0.3}
    run = start_of("wam_slide", **changes, **{"friction.stribeck_speed": 0.005})
    static, _, kinetic, *_ = curves(friction_force(run).axes[0])
    assert np.array_equal(static, 0.3 * run.contact_force)
    assert np.array_equal(kinetic, 0.2 * run.contact_force)


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("wam_touchdown", ["fig_impacts"]), ("sliding", ["fig_friction"]),
        pytest.param("wam_liftoff", [], marks=pytest.mark.slow),
        pytest.param("wam_edge", ["fig_impacts"], marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_run_gets_the_figures_that_it_has_something_for(name, more, shipped_run, sliding, tmp_path, monkeypatch):
    """Impacts and friction have figures where there are any; that of friction is written as PNG and SVG."""
    whole = files.images_of
    none = {".svg": b"", ".png": b""}
    monkeypatch.setattr(
        files, "images_of", lambda draw, run, formats: whole(draw, run) if draw is friction_force else none
    )
    run = sliding if name == "sliding" else shipped_run(name)
    papers = run.scenario.name == "wam_slide"
    own = ("fig4", "fig5", "fig6") if papers else ("fig",) * 3
    usual = [f"{fig}_{what}" for fig, what in zip(own, ("tip_position", "contact_force", "closure_error"), strict=True)]
    paths = draw_figures(run, tmp_path)
    assert [p.stem for p in paths] == [*usual, "fig_force_control", *([] if papers else ["fig_joints"]), *more]
    if name == "sliding":
        assert paths[-1].stat().st_size > 5000
        assert paths[-1].with_suffix(".svg").stat().st_size > 5000


RASTER = {"reference.kind": "raster", "reference.length": 0.02, "reference.pitch": 0.01, "reference.passes": 2}
ALONG = {"reference.direction": [0, 1, 0], "reference.start": 0.3, "reference.stop": 0.6}
ROOM = {"start.q": [np.pi / 2, 1.0, 0.0, 2.0]}  # for a path that goes towards the base too
BOTH = [(0.3, "PD and motion start"), (0.6, "motion stops")]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"reference.kind": "line", **ALONG}, BOTH),
        ({"reference.kind": "circle", "reference.radius": 0.01, **ALONG}, BOTH),
        ({"reference.kind": "figure_eight", "reference.width": 0.02, "reference.height": 0.01, **ALONG, **ROOM}, BOTH),
        (RASTER | ALONG, BOTH),
        (
            {
                "reference.kind": "waypoints",
                "reference.times": [0.3, 0.4, 0.6],
                "reference.points": [[0, 0, 0], [0, 0.01, 0], [0, 0, 0]],
            },
            BOTH,
        ),
        ({"reference.kind": "hold"}, []),
        ({"reference.kind": "hold", "law.pd_start": 0.2}, [(0.2, "PD starts")]),
        ({"law.pd_start": 0.2}, [(0.2, "PD starts"), (0.5, "motion starts"), (6.5, "motion stops")]),
        ({"law.pd_start": 0.5}, [(0.5, "PD and motion start"), (6.5, "motion stops")]),
        (
            {"reference.kind": "hold", "force_profile.kind": "step", "force_profile.to": 12.0, "force_profile.at": 0.4},
            [(0.4, "force steps")],
        ),
        ({"law.kind": "operational_space"}, [(0.5, "motion starts"), (6.5, "motion stops")]),
    ],
)
def test_every_reference_is_marked_where_it_starts_and_stops(changes, expected):
    """Whatever the motion, its start and its stop are marked, and with them the PD part and a step of the force."""
    assert marks(start_of("wam_slide", **changes)) == expected


def test_law_of_the_user_has_no_marks():
    """A law of the user's need not follow the scenario's reference."""
    scenario = cl.load_scenario("wam_slide", {"time.duration": 0.002})
    assert marks(cl.simulate(scenario, law=lambda t, q, v, terms: terms.bias)) == []
