"""Pages beside the lab's own, in a browser: the gallery, the shared page, a notebook's cell."""

import re
from pathlib import Path

import numpy as np
import pytest
from budget import others
from lab_page import opened_page, plotted, settled

import closedloop as cl
from closedloop.figures.scene.scene import scene_of
from closedloop.lab.history import MOST_FRAMES
from validation.speed import lab as in_browser
from validation.speed.lab import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(in_browser.why_not()), reason=in_browser.why_not())]


def test_the_first_page_offers_the_scenarios_that_ship(browser, tmp_path):
    """Without a name: all of them, with pictures that the page draws; a click opens one, with its sliders."""
    lab = cl.lab(port=8421, show=False)
    try:
        page, faults = opened_page(browser, lab)
        cards = page.locator(".card")
        cards.first.wait_for()
        assert cards.count() == len(cl.shipped_scenarios())
        drawn = """(() => { const c = document.querySelector('.card canvas'), g = c.getContext('2d');
            return c.width > 1 && g.getImageData(0, 0, c.width, c.height).data.some(x => x) })()"""
        wait_until(page, drawn)
        page.locator(".card", has_text="planar2 slide").click()
        wait_until(page, "document.title.startsWith('planar2_slide')")
        settled(page, lab)
        assert lab.run.scenario.name == "planar2_slide"
        assert not page.locator("#cards").is_visible()
        assert plotted(page)["commanded"] == pytest.approx(lab.run.scenario.law.force)
        page.close()
        assert faults == []
    finally:
        lab.close()


NAMES = r"""() => [...plots.plots.values()].map(p => {
  const box = p.names.getBoundingClientRect(), seen = p.listed.filter(s => !s.hidden);
  return [p.listed.length, seen.length, Number(p.more.textContent.match(/\d+/)?.[0] ?? 0),
          seen.every(s => s.getBoundingClientRect().bottom <= box.bottom + 1)];
})"""


def test_names_of_curves_are_seen_or_counted(offline, tmp_path):
    """In a narrow window two lines of names and how many more there are; in a wide one all six contacts."""
    run = cl.simulate(cl.load_scenario("gripper_block", {"time.duration": 0.05}), engine="compiled")
    page = offline.new_page()
    page.set_viewport_size({"width": 720, "height": 700})
    page.goto(Path(run.show(tmp_path / "page.html")).as_uri())
    narrow = page.evaluate(NAMES)
    assert all(listed == seen + more and inside for listed, seen, more, inside in narrow)
    assert narrow[0][2] > 0
    page.set_viewport_size({"width": 1800, "height": 900})
    page.wait_for_timeout(200)
    assert page.evaluate(NAMES)[0][1:] == [6, 0, True]
    page.close()


@pytest.mark.parametrize("name", others(cl.shipped_scenarios()))
def test_the_shared_page_opens_from_disk_without_network(name, offline, tmp_path):
    """Offline: small, asks for nothing, throws nothing, shows tip and forces, and moves."""
    shorter = {"time.duration": 1.0} if name == "push_block" else {}  # its pushed block takes the longest to compute
    run = cl.simulate(cl.load_scenario(name, shorter), engine="compiled")
    file = Path(run.show(tmp_path / "page.html"))
    assert file.stat().st_size < 5e6
    page, faults, asked = offline.new_page(), [], []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri())
    assert page.evaluate("Boolean(space.gl)")
    rows = np.unique(
        np.linspace(0, len(run) - 1, min(MOST_FRAMES, len(run))).round().astype(int)
    )  # those of its frames
    for row in rows[[0, 100, -1]]:
        pushed = page.evaluate(f"frameAt({float(run.time[row])!r}).arrows[0]")
        assert pushed["tail"] == pytest.approx(run.position[row], abs=1e-5)
        force = run.contact_force[row] * run.surface_normal[row]
        assert pushed["force"] == pytest.approx(force, rel=1e-4, abs=1e-4)
    legend = page.locator("#legend").inner_text()
    assert ("contact force on the tip" in legend) == scene_of(run).ground.there
    assert ("friction on the tip" in legend) == (scene_of(run).ground.there and run.scenario.friction.kind != "none")
    page.evaluate(f"seek({0.5 * float(run.time[-1])!r})")
    page.click("#play")
    wait_until(page, f"Math.abs(state.time - {0.5 * float(run.time[-1])!r}) > 0.001")
    assert faults == []
    assert [url for url in asked if not url.startswith("file:")] == []


NOTEBOOK = """import closedloop as cl
run = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.3}))
run.show()
%%
lab = cl.lab(run, port=8451)
%%
lab.close()"""


def test_a_notebook_shows_runs_and_the_lab_below_their_cells(browser):
    """Executed: the replay stands in its cell's output, whole and without the file of a page; the lab in a frame."""
    needs = "the extra 'notebooks' is not installed"
    nbformat, nbclient = (pytest.importorskip(name, reason=needs) for name in ("nbformat", "nbclient"))
    pytest.importorskip("ipykernel", reason=needs)
    cells = [nbformat.v4.new_code_cell(text) for text in NOTEBOOK.split("%%\n")]
    notebook = nbformat.v4.new_notebook(cells=cells)
    nbclient.NotebookClient(notebook, timeout=600).execute()
    shown, framed = ([o["data"]["text/html"] for o in cell.outputs if "data" in o][-1] for cell in notebook.cells[:2])
    page, faults, asked = browser.new_page(viewport={"width": 1100, "height": 700}), [], []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.set_content(shown)
    (inside,) = page.main_frame.child_frames
    inside.wait_for_selector("#play")
    assert inside.evaluate("Boolean(space.gl)")
    tail = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.3})).position[0]
    assert inside.evaluate("frameAt(0).arrows[0].tail") == pytest.approx(tail, abs=1e-5)
    assert (faults, [url for url in asked if not url.startswith("about:")]) == ([], [])
    page.close()
    assert re.search(r'<iframe[^>]*src="http://127.0.0.1:84\d\d', framed, re.DOTALL)
