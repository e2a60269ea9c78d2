"""The lab and the shared page in a browser without a screen: what is dragged there is what runs."""

import re
import shlex
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures.scene.scene import scene_of
from closedloop.lab import in_browser
from closedloop.lab.share import MOST_FRAMES

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(in_browser.why_not()), reason=in_browser.why_not())]


@pytest.fixture(scope="module")
def browser():
    """Chromium without a screen, drawing space in software."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=in_browser.program(), args=in_browser.OPTIONS)
        yield started
        started.close()


@pytest.fixture
def offline(browser):
    """A window of the browser whose network is switched off."""
    context = browser.new_context(offline=True)
    context.set_default_timeout(120_000)
    yield context
    context.close()


@pytest.fixture
def lab(tmp_path):
    """A lab of wam_slide whose first run is shown."""
    pytest.importorskip("viser", reason="viser is not installed: the extra 'lab'")
    opened = cl.lab("wam_slide", port=8411, show=False)
    opened.keep.folder = tmp_path
    assert opened.wait(600.0)
    yield opened
    opened.close()


@pytest.fixture
def page(browser, lab):
    """The lab's page; at the end nothing must have been thrown in it."""
    opened = browser.new_page(viewport={"width": 1440, "height": 900})
    faults = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.goto(lab.url)
    opened.get_by_text("steps in").wait_for()
    yield opened
    opened.close()
    assert faults == []


def slider_beside(page, label):
    """Return the box of the slider in the row of a label."""
    row = page.get_by_text(label, exact=True).first.bounding_box()
    boxes = [slider.bounding_box() for slider in page.locator(".mantine-Slider-root").all() if slider.is_visible()]
    return min(boxes, key=lambda box: abs(box["y"] + box["height"] / 2 - row["y"] - row["height"] / 2))


def plotted(page):
    """Return the largest value of each trace in the first plot, from the browser's own chart."""
    script = """() => { const all = Object.values(window.__viserTestpoints.uplots); return all.map(u =>
        u.chart.series.slice(1).map((s, i) => [s.label, Math.max(...u.chart.data[i + 1])])); }"""
    return next(dict(chart) for chart in page.evaluate(script) if any(label == "commanded" for label, _ in chart))


def test_a_dragged_slider_redraws_the_run_and_the_last_value_stays(page, lab):
    """A drag gives many runs, and at its end slider, run, plot and page agree."""
    shown = []
    lab.after_show.append(shown.append)
    box = slider_beside(page, "force [N]")
    y, right = box["y"] + box["height"] / 2, box["x"] + 0.75 * box["width"]
    page.mouse.move(right, y)
    page.mouse.down()
    for k in range(40):
        page.mouse.move(right - 2 * k, y)
        time.sleep(1 / 60)
    page.mouse.up()
    time.sleep(0.5)
    assert lab.wait()
    force = lab.tabs.handle("law.force").value
    assert len(shown) > 5
    assert not any(answer.fault for answer in shown)
    assert lab.run.scenario.law.force == pytest.approx(force)
    page.wait_for_timeout(500)
    assert plotted(page)["commanded"] == pytest.approx(force)


def test_a_key_on_a_slider_moves_it_and_not_the_view(page, lab):
    """An arrow key raises the force by a step; with no slider in the focus it turns the view, as viser has it."""
    page.wait_for_timeout(1000)
    (client,) = lab.server.get_clients().values()
    seen, page_row = (
        client.camera.position.copy(),
        page.locator(".mantine-Flex-root", has=page.get_by_text("force [N]")),
    )
    thumb = page_row.last.get_by_role("slider").first
    thumb.focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight", delay=100)
    page.wait_for_timeout(1000)
    assert lab.wait()
    assert lab.run.scenario.law.force > 10.0
    assert np.array_equal(client.camera.position, seen)
    thumb.blur()
    page.keyboard.press("ArrowRight", delay=300)
    page.wait_for_timeout(1000)
    assert not np.allclose(client.camera.position, seen)


def test_a_fault_stands_beside_its_control_and_the_run_stays(page, lab):
    """A value at fault: one line on the page, and the last good run."""
    before = lab.run
    page.get_by_role("tab", name="stabiliser").click()
    box = slider_beside(page, "time_constant = 0.001 s")
    page.mouse.click(box["x"] + 0.1 * box["width"], box["y"] + box["height"] / 2)
    page.get_by_text(re.compile("^stabiliser.time_constant = .*unstable")).wait_for()
    assert lab.wait()
    assert lab.run is before


def test_the_page_says_what_is_shown_and_no_box_shows_a_logarithm(page, lab):
    """What the colours are and how to begin is on the page; boxes beside sliders have the values of the scenario."""
    page.get_by_text("Move any slider: the whole run of 8 s is computed again").wait_for()
    assert page.get_by_text("contact force on the tip").is_visible()
    boxes = (
        "[...document.querySelectorAll('.mantine-NumberInput-input')].filter(e => e.checkVisibility("
        "{visibilityProperty: true})).map(e => Number(e.value))"
    )
    shown = page.evaluate(boxes)
    assert 10.0 in shown
    tabs = page.get_by_role("tab")
    above = [tabs.nth(k).bounding_box()["y"] for k in range(tabs.count() - 1)]
    assert len(above) == 10
    assert set(above) == {above[0]}  # in one row; the last is that of the plots
    assert not any(abs(x - np.log10(900.0)) < 1e-3 for x in shown)
    lab.changed("law.force", 14.0)
    assert lab.wait()
    page.get_by_role("button", name="undo").click()
    page.wait_for_timeout(1000)
    assert lab.wait()
    assert lab.run.scenario.law.force == 10.0


def test_the_page_is_timed_from_the_pointer_to_the_plot(page, lab):
    """Each movement gives one time, none shorter than what the run alone takes; the frame comes after the drawing."""
    page.wait_for_function("Object.keys(window.__viserTestpoints?.uplots ?? {}).length > 3")
    page.evaluate(in_browser.WATCH)
    drawn, shown = in_browser.page_latencies(page, "force [N]", 3)
    assert drawn.shape == shown.shape == (3,)
    assert np.all(drawn > lab.run.wall_seconds)
    assert np.all(shown >= drawn)
    assert page.evaluate("window.lab.largest()") == lab.run.scenario.law.force != 10.0


def looks(page):
    """Return how the browser filters the plots and the picture in space."""
    found = "[...document.querySelectorAll('.uplot, canvas[data-engine]')].map(e => getComputedStyle(e).filter)"
    return page.evaluate(found)


def test_the_run_before_stays_greyed_until_the_new_one_is_there(page, lab, monkeypatch):
    """While a change is computed that takes long, plots and arm are grey; then they are the new run's, in colour."""
    assert len(looks(page)) > 4
    assert set(looks(page)) == {"none"}
    go, answer = threading.Event(), lab.answers.answer
    monkeypatch.setattr(lab.answers, "answer", lambda *request: go.wait(30.0) and answer(*request))
    before = lab.run
    lab.changed("law.force", 12.0)
    page.get_by_text("computing ...; what is shown is the run before").wait_for()
    assert all("grayscale" in look for look in looks(page))
    assert lab.run is before
    go.set()
    assert lab.wait()
    page.get_by_text("steps in").wait_for()
    assert set(looks(page)) == {"none"}
    assert plotted(page)["commanded"] == 12.0


def test_the_copied_command_repeats_the_run(page, lab, tmp_path):
    """The button puts it on the clipboard; pasted, it gives the contact force to the last bit."""
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    lab.changed("law.kp", [900.0, 800.0, 400.0, 300.0])
    lab.changed("time.duration", 0.5)
    lab.changed("friction.kind", "coulomb")
    assert lab.wait(600.0)
    page.get_by_role("tab", name="keep").click()
    page.get_by_role("button", name="copy command").click()
    page.get_by_role("button", name="copied").wait_for()
    program, *words = shlex.split(page.evaluate("navigator.clipboard.readText()"))
    assert program == "closedloop"
    assert main([*words, "--out", str(tmp_path / "again")]) == 0
    again = cl.load_run(tmp_path / "again" / "run.nc")
    assert again.scenario.friction.kind == "coulomb"
    assert np.array_equal(again.contact_force, lab.run.contact_force)


def test_a_click_on_the_map_loads_that_run(page, lab):
    """The cell under the pointer is the run that is shown then, and has the value of the map."""
    lab.map.x.value, lab.map.y.value, lab.map.quantity.value = "law.force", "law.kp J2", "peak_contact_force"
    lab.map.press("compute")
    assert lab.map.wait(600.0)
    page.get_by_role("tab", name="map").click()
    image = page.locator('img[alt="map"]')
    image.scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    box = image.bounding_box()
    page.mouse.click(box["x"] + 0.45 * box["width"], box["y"] + 0.4 * box["height"])
    page.wait_for_timeout(1000)
    assert lab.wait()
    row, column = map(int, re.findall(r"\d+", lab.map.cell.value))
    found = lab.map.map
    assert lab.run.scenario.law.force == pytest.approx(found.x.values[column])
    assert lab.run.scenario.law.kp[1] == pytest.approx(found.y.values[row])
    assert lab.run.summary()["peak_contact_force"] == pytest.approx(found.grid[row, column], rel=1e-6)


@pytest.mark.parametrize("name", cl.shipped_scenarios())
def test_the_shared_page_opens_from_disk_without_network(name, offline, tmp_path):
    """Of every scenario, offline: small, asks for nothing, throws nothing, shows tip and forces, and moves."""
    run = cl.simulate(cl.load_scenario(name), engine="compiled")
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
    assert ("contact force on the tip" in legend) == ("friction on the tip" in legend) == scene_of(run).ground.there
    page.evaluate(f"seek({0.5 * float(run.time[-1])!r})")
    page.click("#play")
    page.wait_for_function(f"Math.abs(state.time - {0.5 * float(run.time[-1])!r}) > 0.001")
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
