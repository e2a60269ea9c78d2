"""Figures of a run as files, and as Jupyter shows it."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from closedloop.base.files import write_whole
from closedloop.base.second_process import Beside
from closedloop.figures.errors import closure_error, force_control, shows_bodies
from closedloop.figures.force import contact_force, friction_force, has_friction, has_impacts, impacts, link_contacts
from closedloop.figures.motion import bodies, has_bodies, has_joints, has_tool, joints, rests, tip_position, tool
from closedloop.figures.style import COLOURS, styled, tip_is_idle
from closedloop.record.report.control_verdict import unknown_text
from closedloop.record.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Of the picture: inches, dots for each, and points of the curve at most.
SIZE, DOTS, MOST_POINTS = (3.4, 1.9), 90, 1000


def html(run: Run) -> str:
    """Return a run as HTML: its verdict, its force as a picture, and how large every error was."""
    from closedloop.record.report import report_rows

    title = f"<b>{escape(repr(run).strip('<>'))}</b>"
    lines = "".join(
        f"<tr><td style='text-align:left'>{escape(name)}</td><td>{escape(value)}</td>"
        f"<td style='text-align:left'>{escape(unit)}</td></tr>"
        for name, value, unit, _ in (report_rows(run) if len(run) else ())
    )
    said, control = _said("verdict", run.summary()["verdict"]), _said("control", run.summary()["control_verdict"])
    picture = f"<div>{_picture(run)}</div>" if len(run) > 1 else ""
    return (
        f"<div>{title}<br>{escape(said)}<br>{escape(control)}</div>"
        f"<div style='display:flex;gap:1.5em;align-items:flex-start'>{picture}<table>{lines}</table></div>"
    )


def _said(of: str, verdict: dict[str, Any]) -> str:
    said = "good" if verdict["good"] else "BAD: " + "; ".join(each["text"] for each in verdict["problems"])
    return f"{of}: {said}{unknown_text(verdict.get('not_known', ()))}"


def _picture(run: Run) -> str:
    """Return the contact force over time as SVG: two curves and four numbers, without the cost of a figure's layout."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DOTS)
    axes = figure.add_axes((0.15, 0.24, 0.83, 0.72))
    rows = _telling(run.contact_force)
    axes.plot(run.time[rows], run.reference_force[rows], ":", color="0.4", linewidth=0.9)
    axes.plot(run.time[rows], run.contact_force[rows], color=COLOURS[0], linewidth=1.0)
    low, high = axes.get_ylim()
    if high - low < 0.1:
        axes.set_ylim(low - 0.5, high + 0.5)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel("f [N]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    axes.spines[["top", "right"]].set_visible(False)
    text = io.StringIO()
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(text, metadata={"Date": None})
    drawn = text.getvalue()
    return drawn[drawn.index("<svg") :]


def _telling(values: Any) -> Any:
    """Return rows enough to draw (N,) values: of each stretch the least and the greatest."""
    count = len(values)
    if count <= MOST_POINTS:
        return np.arange(count)
    stretches = np.array_split(np.arange(count), MOST_POINTS // 2)
    extremes = [(rows[np.argmin(values[rows])], rows[np.argmax(values[rows])]) for rows in stretches]
    return np.unique(np.concatenate([np.ravel(extremes), [0, count - 1]]))


# The content of a figure's files, by their endings; the files that are written if nothing is asked for; and what each
# says of who made it.
Images = dict[str, bytes]
IMAGES = (".png", ".svg")
METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Source": "closedloop"}, ".svg": {"Source": "closedloop", "Date": None},
    ".pdf": {"Creator": "closedloop", "CreationDate": None},
}  # fmt: skip

# Scenarios of the paper's slide, whose figures are Figs. 4-7 of the paper.
PAPERS = ("wam_slide", "wam_slide_unstabilised")


def draw_figures(
    run: Run, folder: str | Path, unstabilised: Run | Callable[[], Run | Images | None] | None = None,
    formats: Sequence[str] = IMAGES,
) -> list[Path]:  # fmt: skip
    """Write the figures of a run into `folder`, each as PNG and SVG, and return the paths of the PNGs.

    Every run has its tip position, contact force, closure error, the errors that force control is about, and its
    joints; one with impacts, friction, a tool or free bodies has a figure of them. Where links touch instead of a
    tip that never does, they are drawn in place of its force and gap. The paper's slide has the paper's figures, with
    its numbers, and the errors; its joints can be had from `closedloop.figures.motion`.

    Parameters
    ----------
    unstabilised : Run or callable, optional
        The same scenario without its stabiliser, for Fig. 7 beside Fig. 6; or what gives that run, or what `images_of`
        makes of its `closure_error`, or None, and is called when all others are drawn.
    formats : sequence of str
        Endings of the files: ".png", ".svg", ".pdf". The paths returned are those of the first.

    Raises
    ------
    OutputError
        If a figure cannot be written.
    """
    papers = is_papers(run.scenario.name)
    plain = run.scenario.stabiliser.kind == "none" and run.scenario.compliance.kind == "none"
    bare = "fig7_closure_error_unstabilised" if papers else "fig_closure_error_unstabilised"
    idle = tip_is_idle(run)  # there is nothing to see of the force and the gap
    unled = idle and shows_bodies(run)  # nor of a tip that nothing leads
    of_tip: list[tuple[str, Callable[[Run], Figure], bool]] = [
        ("fig4_tip_position" if papers else "fig_tip_position", tip_position, not unled),
        ("fig5_contact_force" if papers else "fig_contact_force", contact_force, not idle),
        (bare if plain else "fig6_closure_error" if papers else "fig_closure_error", closure_error, not idle),
        ("fig_force_control", force_control, not unled),
        ("fig_joints", joints, not papers and has_joints(run)),
    ]
    of_links: list[tuple[str, Callable[[Run], Figure], bool]] = [
        ("fig_bodies", bodies, has_bodies(run)),
        ("fig_link_contacts", link_contacts, bool(run.scenario.contact)),
    ]
    if run.scenario.contact and rests(run):  # forces where nothing moves
        of_links.reverse()
    all_figures = [*of_links, *of_tip] if idle else [*of_tip, *of_links]  # the first shows what the run is about
    all_figures += [
        ("fig_impacts", impacts, has_impacts(run)),
        ("fig_friction", friction_force, has_friction(run)),
        ("fig_tool", tool, has_tool(run)),
    ]
    wanted = [(name, draw) for name, draw, there in all_figures if there and len(run) > 0]
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg  # noqa: F401  before there are two processes

    rest = Beside(lambda: [images_of(draw, run, formats) for _, draw in wanted[1::2]])
    try:
        images = [images_of(draw, run, formats) for _, draw in wanted[::2]]
        other = None if plain else unstabilised() if callable(unstabilised) else unstabilised
        if isinstance(other, Run):
            other = images_of(closure_error, other, formats) if len(other) > 0 else None
        beside = rest.result()
    finally:
        rest.stop()
    images = [(beside if i % 2 else images)[i // 2] for i in range(len(wanted))]
    written = [write_images(each, Path(folder) / name) for each, (name, _) in zip(images, wanted, strict=True)]
    if other is not None:
        written.append(write_images(other, Path(folder) / bare))
    return written


def is_papers(scenario: str) -> bool:
    """Tell whether a scenario is the paper's slide, or that with some keys changed."""
    return scenario in PAPERS


def images_of(draw: Callable[[Run], Figure], run: Run, formats: Sequence[str] = IMAGES) -> Images:
    """Draw a figure of a run and return its images, as `images` does."""
    with styled():
        return images(draw(run), formats)


def images(figure: Figure, formats: Sequence[str] = IMAGES) -> Images:
    """Return the content of the files of a figure that is drawn, by their endings; the first is the one that is named.

    Each says who made it, so that results of another run may be told and removed, and not when.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)  # all is in its place: else each file would be laid out anew
    found = {}
    for suffix in formats:
        image = io.BytesIO()
        figure.savefig(image, format=suffix[1:], metadata=METADATA[suffix])
        found[suffix] = image.getvalue()
    return found


def save_figure(draw: Callable[[Run], Figure], run: Run, path: Path, formats: Sequence[str] = IMAGES) -> Path:
    """Draw a figure of a run and write it as `path`.png and `path`.svg, or as `formats` say; return the first."""
    return write_images(images_of(draw, run, formats), path)


def write_figure(figure: Figure, path: Path, formats: Sequence[str] = IMAGES) -> Path:
    """Write a figure that is drawn as `path`.png and `path`.svg, or as `formats` say; return the first."""
    return write_images(images(figure, formats), path)


def write_images(images: Images, path: Path) -> Path:
    """Write the images of a figure, each whole or not at all, and return the path of the first."""
    written = [write_whole(path.with_name(path.name + suffix), content) for suffix, content in images.items()]
    return written[0]
