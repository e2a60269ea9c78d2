"""What the page of the lab says in words, and how it looks beyond what viser sets: styles, legend, explanations."""

from __future__ import annotations

import html
from collections.abc import Sequence

from closedloop.figures.scene.scene import ARROWS, JOINTS, LOOP, PATH, TOUCH, WANTED
from closedloop.scenario.scenario import Scenario

# The label of a slider has its value and unit, and needs the place. The box beside a slider over decades would show the
# decimal logarithm: such sliders have three marks or more (`closedloop.lab.view_controls`), viser's others have two.
# The last two curves of a plot are the cursor and the events (`closedloop.lab.view_plots`): they have no values.
STYLE = """<style>
div:has(> p.mantine-Text-root > label){width:9.5em!important}
p.mantine-Text-root:has(> label){letter-spacing:0!important}
.mantine-Flex-root:has(> .mantine-Slider-root .mantine-Slider-markWrapper:nth-child(3)) > .mantine-NumberInput-root
{visibility:hidden}
[data-dock-tab]{padding:0 0.62em!important}
.uplot .u-legend tr:nth-last-child(-n+2){display:none}
</style>"""
# Keys that move a slider do not turn the view as well: viser does that with arrow keys that come to the document.
KEYS = (
    """<img hidden src="data:," onerror="document.getElementById('root').addEventListener('keydown', """
    """e => { if (e.target.closest('[role=slider]')) e.stopPropagation(); })">"""
)
# What is shown has been overtaken, and the new run is not there yet.
GREYED = (
    "<style>.uplot{filter:grayscale(1) opacity(0.45)}canvas[data-engine]{filter:grayscale(0.9) opacity(0.55)}</style>"
)
# What the arrows and lines in space are, by the names of `closedloop.figures.scene.scene`.
MEANINGS = {
    "contact force": "contact force on the tip",
    "friction": "friction on the tip",
    "commanded force": "force commanded",
    LOOP: "force of a joint that closes a loop",
    TOUCH: "force of one link on another, or of the world on it",
    JOINTS: "joint that closes a loop",
    "actual path": "path of the tip",
    "desired path": "path desired",
}
PLOTS = (
    "All against time. The grey line is the instant shown on the left, ticks at the bottom are events. "
    "Hover: values. Drag across: enlarge. Double click: all again."
)
KEEP = (
    "<b>pin</b> keeps the run shown, to compare it with what you change next. <b>save</b> writes scenario.toml and "
    "run.nc, <b>share</b> a page.html that opens anywhere, into a new folder out/{name}-lab/1, 2 ... "
    "below the current one."
)
MAP = (
    "Choose two numbers of the scenario and a value of the run: <b>compute</b> runs them all, and a click into the map "
    "loads the run of that place. The map is below: scroll, or drag the grey bar between here and the plots."
)


def paragraph(text: str) -> str:
    """Return a line of explanation, which may have HTML in it."""
    return f'<div style="font-size:0.8em;line-height:1.35;opacity:0.75;padding:0.2em 0.8em">{text}</div>'


def caption(
    scenario: Scenario, changed: bool, kinds: Sequence[str], metres_per_newton: float | None, panel_width: int
) -> str:
    """Return what stands below the picture in space: what is shown, what to do, what the colours mean, and the scale.

    `changed` says whether the scenario is another by now than its description was written for, and `kinds` are those of
    the arrows, of `closedloop.figures.scene.scene.ARROWS`. It is fixed to the window, beside a panel of so many px,
    since viser has text in its panels only.
    """
    place = (
        f"position:fixed;left:14px;bottom:10px;max-width:calc(100vw - {panel_width + 40}px);font-size:0.85em;"
        "line-height:1.4;pointer-events:none;padding:0.1em 0.4em;border-radius:4px;"
        "background:color-mix(in srgb,var(--mantine-color-body) 75%,transparent)"
    )
    about = scenario.description or scenario.name
    about = html.escape(about[:1].upper() + about[1:]) + (", before what you changed" if changed else "")
    return (
        f'{STYLE}<div id="closedloop-caption" style="{place}"><b>{about}</b><br>{_legend(kinds, metres_per_newton)}<br>'
        f"Move any slider: the whole run of {scenario.time.duration:g} s is computed again; <b>undo</b> goes back. "
        "<b>play</b> moves the arm. Hover over a name to read what it is. Here: drag to turn, scroll to zoom.</div>"
    )


def _legend(kinds: Sequence[str], metres_per_newton: float | None) -> str:
    """Return what the colours in space mean, and how long an arrow is."""
    colours = {kind: ARROWS[kind] for kind in kinds} | {"actual path": PATH, "desired path": WANTED}
    chips = [
        f'<span style="white-space:nowrap;margin-right:0.9em"><span style="display:inline-block;width:0.9em;'
        f"height:{'0.6em' if name in ARROWS else '0.2em'};vertical-align:middle;margin-right:0.3em;"
        f'background:rgb({",".join(str(round(255 * c)) for c in colour)})"></span>{MEANINGS[name]}</span>'
        for name, colour in colours.items()
    ]
    if metres_per_newton is not None:
        chips.append(f'<span style="white-space:nowrap">10 N = {10.0 * metres_per_newton:.2g} m</span>')
    return " ".join(chips)
