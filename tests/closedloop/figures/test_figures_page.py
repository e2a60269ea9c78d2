"""Figures for a paper: the width and the font that are asked for, TrueType text, legends beside titles, own axes."""

import io
import re
import zlib

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import closedloop as cl
from closedloop import figures
from closedloop.record.columns.record import SYMBOLS

DRAWN = ("tip_position", "contact_force", "closure_error", "force_control", "joints", "impacts", "columns")


@pytest.fixture(scope="module")
def run():
    """Return a run with free motion, impacts, contact, and marks of the law: titles and legends of all kinds."""
    return cl.simulate(cl.load_scenario("wam_touchdown", {"time.duration": 1.6}))


def drawn(name, run, **more):
    """Return a figure of the run."""
    return getattr(figures, name)(run, *([["f", "q"]] if name == "columns" else []), **more)


def overlap(one, other):
    """Tell whether two boxes have more than a pixel in common, across and upwards."""
    across, up = (
        min(a[1], b[1]) - max(a[0], b[0]) for a, b in zip(one.get_points().T, other.get_points().T, strict=True)
    )
    return across > 1.0 and up > 1.0


@pytest.mark.parametrize("width", [3.5, 7.2])
@pytest.mark.parametrize("name", DRAWN)
def test_no_legend_lies_over_a_title_and_nothing_leaves_the_page(run, name, width):
    """In a column of a journal as on a page, for each title, each legend and each axis label."""
    with figures.styled(width=width, font=8):
        page = drawn(name, run)
        FigureCanvasAgg(page).draw()
    assert page.get_figwidth() == width
    titles = [axes._left_title.get_window_extent() for axes in page.axes if axes.get_title(loc="left")]
    legends = [each.get_window_extent() for each in (*(a.get_legend() for a in page.axes), *page.legends) if each]
    assert not any(overlap(title, legend) for title in titles for legend in legends)
    assert all(each.x0 > -1.0 and each.x1 < page.bbox.x1 + 1.0 for each in (*titles, *legends))
    panels = [axes.get_window_extent() for axes in page.axes]
    assert not any(overlap(legend, panel) for legend in legends for panel in panels)
    assert not any(overlap(title, panel) for title in titles for panel in panels)
    assert all(panel.width > 0.25 * page.bbox.width or name == "force_control" for panel in panels)


def test_a_figure_has_its_font_and_a_pdf_its_text_as_truetype(run):
    """Also if it is saved after the style was left; Type 3, matplotlib's default, has no file of the font in it."""
    with figures.styled(width=3.5, font=8):
        page = figures.contact_force(run)
    assert page.axes[0].xaxis.label.get_fontsize() == 8
    for figure, truetype in ((page, True), (Figure(), False)):
        if not truetype:
            figure.subplots().set_title("of matplotlib alone")
        file = io.BytesIO()
        figure.savefig(file, format="pdf")
        streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", file.getvalue(), re.DOTALL)
        text = file.getvalue() + b"".join(zlib.decompress(each) for each in streams if each[:1] == b"x")
        assert (b"/FontFile2" in text) is truetype
        assert (b"/Type3" in text) is not truetype


@pytest.mark.parametrize("name", DRAWN)
def test_plots_draw_on_axes_of_the_user(run, name):
    """One Axes is the first panel and has its curves; a sequence has one for each; the user's figure is returned."""
    own = drawn(name, run)
    figure = Figure()
    axes = figure.subplots()
    assert drawn(name, run, ax=axes) is figure
    assert axes.get_xlabel() == "time [s]"
    assert len(axes.lines) == len(own.axes[0].lines)
    assert all(
        np.array_equal(a.get_ydata(), b.get_ydata(), equal_nan=True)
        for a, b in zip(axes.lines, own.axes[0].lines, strict=True)
    )
    with pytest.raises(ValueError, match="ax: has 9 axes; give one, for the first panel, or"):
        drawn(name, run, ax=Figure().subplots(9))


def test_columns_are_drawn_by_name_or_symbol(run):
    """Each has its panel, its unit and its parts; a column that is not there is named beside those that are."""
    figure = figures.columns(run, ["f", "contact_force", "wrist_wrench", "e"])
    assert [axes.get_ylabel() for axes in figure.axes[:2]] == ["f [N]", "contact force [N]"]
    assert np.array_equal(figure.axes[0].lines[0].get_ydata(), run.contact_force)
    assert [line.get_label() for line in figure.axes[2].lines][:6] == ["fx", "fy", "fz", "mx", "my", "mz"]
    assert figure.axes[3].get_ylabel() == "e [mm]"
    with pytest.raises(cl.ScenarioError, match="'g': the run has no such column over time; there are f, f_des"):
        figures.columns(run, ["g"])
    with pytest.raises(cl.ScenarioError, match="event_time"):
        figures.columns(run, ["event_time"])


def test_symbols_of_the_equations_name_columns(run):
    """`run.f` is `run.contact_force`, and so on; every symbol is of a column that runs have."""
    for symbol, column in SYMBOLS.items():
        assert getattr(run, symbol) is getattr(run, column)
        assert run[symbol] is run[column]
        assert run.units(symbol) == run.units(column)
        assert symbol in dir(run)


def test_a_notebook_names_a_figure_as_matplotlib_does(run):
    """The value of a cell reads as that of any figure."""
    assert re.fullmatch(r"<Figure size [\d.]+x[\d.]+ with \d Axes>", repr(figures.contact_force(run)))
