"""The lab and the shared page in a browser without a screen: what is dragged there is what runs."""

import re
import shlex
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from budget import budget

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures.scene.scene import scene_of
from closedloop.lab import in_browser, mapping_work, server
from closedloop.lab.share import MOST_FRAMES
from closedloop.studies.analysis.stability import Stability

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
def lab(tmp_path, monkeypatch):
    """A lab of wam_slide whose first run is shown; the map that begins by itself ends early, and pings come often."""
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    monkeypatch.setattr(mapping_work, "AT_MOST", 1.0)
    monkeypatch.setattr(server, "PING", 1.0)
    opened = cl.lab("wam_slide", port=8411, show=False)
    opened.folder = tmp_path
    assert opened.run is not None
    assert opened.wait(600.0)
    yield opened
    opened.close()


# How many colours the picture in space has.
COLOURS = """() => {
  const g = Object.assign(document.createElement('canvas'), {width: 300, height: 300}).getContext('2d');
  space.drawing.present();
  g.drawImage(space.canvas, 0, 0);
  return new Set(new Uint32Array(g.getImageData(0, 0, 300, 300).data.buffer)).size;
}"""


def opened_page(browser, lab, **settings):
    """Return a page of the lab that shows a run, and the list of what is thrown in it."""
    page, faults = browser.new_page(**({"viewport": {"width": 1440, "height": 900}} | settings)), []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.set_default_timeout(60_000)
    page.goto(lab.url)
    page.get_by_text("steps in").wait_for()
    page.wait_for_function("space.scene && run && map.x.options.length")
    return page, faults


@pytest.fixture
def page(browser, lab):
    """The lab's page; at the end nothing must have been thrown in it."""
    opened, faults = opened_page(browser, lab)
    yield opened
    opened.close()
    assert faults == []


def settled(page, lab):
    """Wait until the page shows the newest run, with all that follows it."""
    page.wait_for_timeout(300)
    assert lab.wait(120.0)
    page.wait_for_function(f"run.n >= {lab._count}")
    page.wait_for_timeout(100)


def plotted(page):
    """Return the largest value of each trace in the plot of the force, from what the page draws."""
    script = "() => run.panels[0].traces.map(t => [t.label, Math.max(...t.values)])"
    return dict(page.evaluate(script))


def row(page, key):
    """Return the row of a key; of a list that of all its numbers."""
    return page.locator(f'.row[data-key="{key}"]').first


def test_a_dragged_slider_redraws_the_run_and_the_last_value_stays(page, lab):
    """A drag gives many runs, which the picture follows; at its end slider, number box, run, plot and page agree."""
    shown = []
    lab.after_show.append(shown.append)
    box = in_browser.slider_of(page, "law.force")
    y, right = box["y"] + box["height"] / 2, box["x"] + 0.75 * box["width"]
    page.mouse.move(right, y)
    page.mouse.down()
    for k in range(3000):  # however slow the computer is
        page.mouse.move(right - 0.5 * (k % 40), y)
        time.sleep(1 / 60)
        if k >= 40 and len(shown) > 5:
            break
    page.mouse.up()
    settled(page, lab)
    force = float(row(page, "law.force").locator("input[type=range]").input_value())
    assert len(shown) > 5
    assert page.evaluate("still.robot === space.about.robot && still.time[0] === state.time")
    assert not any(answer.fault for answer in shown)
    assert lab.run.scenario.law.force == pytest.approx(force)
    assert float(row(page, "law.force").locator(".num").input_value()) == pytest.approx(force)
    assert plotted(page)["commanded"] == pytest.approx(force)
    page.keyboard.press("Control+z")  # the drag is one step
    settled(page, lab)
    assert lab.run.scenario.law.force == 10.0


def test_keys_move_the_slider_in_the_focus_else_the_replay(page, lab):
    """An arrow key raises the force by a step; without a slider in the focus it goes a step of the run on."""
    row(page, "law.force").locator("input[type=range]").focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight", delay=50)
    settled(page, lab)
    assert lab.run.scenario.law.force > 10.0
    assert page.evaluate("state.time") == 0.0
    page.keyboard.press("Escape")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("state.time") == pytest.approx(1e-3)
    page.keyboard.press("End")
    assert page.evaluate("state.time") == pytest.approx(8.0)
    page.keyboard.press("Home")
    page.keyboard.press("Space")
    page.wait_for_function("state.playing && state.time > 0.1")
    page.keyboard.press("Space")
    at = page.evaluate("state.time")
    page.wait_for_timeout(200)
    assert page.evaluate("state.time") == at


def test_a_fault_stands_beside_its_control_and_the_run_stays(page, lab):
    """A value at fault: one sentence at its slider, and the last good run; a good value takes it away."""
    before = lab.run
    page.locator("#search").fill("time_constant")
    box = row(page, "stabiliser.time_constant").locator(".num")
    box.fill("1e-5")
    page.keyboard.press("Enter")
    fault = row(page, "stabiliser.time_constant").locator(".fault")
    fault.filter(has_text="unstable").wait_for()
    assert fault.inner_text().startswith("stabiliser.time_constant = ")
    assert "\n" not in fault.inner_text()
    assert lab.wait()
    assert lab.run is before
    box.fill("much")
    page.keyboard.press("Enter")
    fault.filter(has_text="is no number").wait_for()
    box.fill("0.002")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert not fault.is_visible()
    assert lab.run.scenario.stabiliser.time_constant == 0.002


def test_all_joints_move_together_or_each_by_itself(page, lab):
    """The slider of a list keeps the ratios; opened, one joint moves alone; the arrow beside it takes it back."""
    every = row(page, "law.kp")
    every.locator(".num").fill("450")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert lab.run.scenario.law.kp == (450.0, 450.0, 200.0, 150.0)
    every.locator(".open").click()
    one = page.locator('.row.joint[data-key="law.kp"]').nth(1)
    one.locator(".num").fill("800")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert lab.run.scenario.law.kp == (450.0, 800.0, 200.0, 150.0)
    one.locator(".reset").click()
    settled(page, lab)
    assert lab.run.scenario.law.kp == (450.0, 900.0, 200.0, 150.0)
    every.hover()
    assert "law.kp" in page.locator("#doc").inner_text()


def test_the_strip_answers_whether_the_run_is_good(page, lab):
    """Both verdicts in words, errors, margins; against a pinned run what is better is green, and what worse red."""
    strip = page.locator("#strip")
    for words in ("numbers\ngood", "control\ngood", "force RMS", "force peak", "gain margin", "settled"):
        assert words in strip.inner_text()
    page.keyboard.press("p")
    page.locator("#unpin").wait_for()
    lab.changed("friction.kind", "coulomb")
    settled(page, lab)
    worse = strip.locator(".tile", has_text="force RMS").locator(".bad")
    assert worse.inner_text().strip().startswith("+")
    assert "pin 1" in worse.get_attribute("title")
    page.locator("#tab-compare").click()
    assert "pin 1" in page.locator("#pane").inner_text()
    assert page.evaluate("plots.pins.length") == 1


def test_the_page_is_timed_from_the_pointer_to_the_plot(page, lab):
    """Each movement gives one time, none shorter than what the run alone takes; the frame comes after the drawing."""
    page.evaluate(in_browser.WATCH)
    drawn, shown = in_browser.page_latencies(page, "law.force", 3)
    assert drawn.shape == shown.shape == (3,)
    assert np.all(drawn > lab.run.wall_seconds)
    assert np.all(shown >= drawn)
    assert page.evaluate("window.lab.largest()") == pytest.approx(lab.run.scenario.law.force)
    assert page.evaluate("window.lab.largest()") != 10.0


def test_the_run_before_is_grey_until_the_new_one_is_there(page, lab, monkeypatch):
    """While a change is computed that takes long the curves are grey; then they are the new run's, in colour."""
    look = "() => getComputedStyle(document.getElementById('plots')).filter"
    assert page.evaluate(look) == "none"
    go, answer = threading.Event(), lab.answers.answer
    monkeypatch.setattr(lab.answers, "answer", lambda *request: go.wait(30.0) and answer(*request))
    before = lab.run
    row(page, "law.force").locator(".num").fill("12")
    page.keyboard.press("Enter")
    page.get_by_text("computing ...; what is shown is the run before").wait_for()
    assert "grayscale" in page.evaluate(look)
    assert lab.run is before
    go.set()
    settled(page, lab)
    assert page.evaluate(look) == "none"
    assert plotted(page)["commanded"] == 12.0


def test_the_copied_command_repeats_the_run(page, lab, tmp_path):
    """The button puts it on the clipboard; pasted, it gives the contact force to the last bit."""
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    lab.changed("law.kp", [900.0, 800.0, 400.0, 300.0])
    lab.changed("time.duration", 0.5)
    lab.changed("friction.kind", "coulomb")
    settled(page, lab)
    page.locator("#tab-scenario").click()
    page.get_by_role("button", name="copy command").click()
    page.get_by_role("button", name="copied").wait_for()
    program, *words = shlex.split(page.evaluate("navigator.clipboard.readText()"))
    assert program == "closedloop"
    assert main([*words, "--out", str(tmp_path / "again")]) == 0
    again = cl.load_run(tmp_path / "again" / "run.nc")
    assert again.scenario.friction.kind == "coulomb"
    assert np.array_equal(again.contact_force, lab.run.contact_force)
    page.locator("#save").click()
    page.get_by_text("wrote ").wait_for()
    (saved,) = tmp_path.glob("wam_slide-lab/1/run.nc")
    assert np.array_equal(cl.load_run(saved).contact_force, lab.run.contact_force)


def test_a_drag_in_the_map_loads_the_runs_below_the_pointer(page, lab, monkeypatch):
    """The place under the pointer is the run that is shown, the ring goes with it, and the drag is one step of undo."""
    monkeypatch.setattr(mapping_work, "CELLS", 16)
    lab.changed("time.duration", 0.2)
    settled(page, lab)
    page.locator("#tabs select").nth(0).select_option("law.force")
    page.locator("#tabs select").nth(1).select_option("law.kp J2")
    page.locator("#tabs select").nth(2).select_option("peak_contact_force")
    page.locator("#compute").click()
    page.wait_for_function("map.m?.complete", timeout=300_000)
    assert page.evaluate("map.m.grid.every(Number.isFinite)")
    box = page.locator("#map").bounding_box()
    left, top, wide, high = page.evaluate("map.area()")
    page.mouse.move(box["x"] + left + 0.2 * wide, box["y"] + top + 0.5 * high)
    page.mouse.down()
    page.mouse.move(box["x"] + left + 0.7 * wide, box["y"] + top + 0.25 * high, steps=8)
    page.mouse.up()
    settled(page, lab)
    found = lab.map.map
    assert lab.run.scenario.law.force == pytest.approx(found.x.at(0.7), rel=0.02)
    assert lab.run.scenario.law.kp[1] == pytest.approx(found.y.at(0.75)[1], rel=0.05)
    assert page.evaluate("map.point") == pytest.approx([lab.run.scenario.law.force, lab.run.scenario.law.kp[1]])
    again = "() => { const moved = map.canvas.toDataURL(); map.shown(); return moved === map.canvas.toDataURL(); }"
    assert page.evaluate(again)  # where the ring has moved, the cells below it are those of the map
    page.keyboard.press("Control+z")
    settled(page, lab)
    assert (lab.run.scenario.law.force, lab.run.scenario.law.kp[1]) == (10.0, 900.0)


def test_the_map_shows_where_the_loop_becomes_unstable(page, lab, monkeypatch):
    """It begins by itself, stops for a slider, and says what it lacks; whole, its red line is where a pole leaves."""
    short = {"reference.start": 0.05, "reference.stop": 0.55, "time.duration": 0.6}
    cl.simulate_batch(cl.load_scenario("wam_slide", {"time.duration": 0.1}), {"law.force": [10.0] * 8})
    lab.ask()  # no map begins by itself until what it needs is compiled, as it is now
    page.wait_for_function("map.m")
    monkeypatch.setattr(mapping_work, "AT_MOST", 600.0)
    monkeypatch.setattr(mapping_work, "POINTS", 8)
    monkeypatch.setattr(mapping_work, "CELLS", 12)
    for key, value in short.items():
        lab.changed(key, value)
    settled(page, lab)
    page.wait_for_function("map.m.complete && map.canvas.classList.contains('late')")
    assert "another reference.start" in page.locator("#pane").inner_text()
    assert page.locator("#tabs select").nth(0).input_value() == "law.kp, all"
    assert page.locator("#tabs select").nth(1).input_value() == "law.kd, all"
    page.evaluate("map.line = null")
    page.locator("#compute").click()
    page.wait_for_function("map.line?.x && map.m.complete", timeout=300_000)
    kps, kds = (page.evaluate(f"[...map.line.{axis}]") for axis in "xy")
    for k in (0, -1):
        for share, stable in ((0.98, True), (1.02, False)):
            values = {"law.kp": [kps[k] * each / 900.0 for each in (900.0, 900.0, 400.0, 300.0)],
                      "law.kd": [share * kds[k] * each / 60.0 for each in (60.0, 60.0, 30.0, 20.0)]}  # fmt: skip
            scenario = cl.load_scenario("wam_slide", short)
            assert (Stability(scenario).growth(values) < 0.0) == stable
    red = """() => { const c = map.canvas, g = c.getContext('2d'); let n = 0, d;
        d = g.getImageData(0, 0, c.width, c.height).data;
        for (let k = 0; k < d.length; k += 4) n += d[k] === 255 && d[k + 1] === 90 && d[k + 2] === 54; return n }"""
    assert page.evaluate(red) > 50
    assert page.evaluate("map.point") == [900.0, 60.0]


def test_the_label_of_the_vertical_axis_of_a_map_is_whole(page, lab):
    """It stands within the canvas, left of the numbers; where all values are equal the map says the value."""
    page.wait_for_function("map.m && map.under")
    texts = """() => {
      const found = [], write = CanvasRenderingContext2D.prototype.fillText;
      CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        const m = this.getTransform();
        found.push([text, (m.a * x + m.c * y + m.e) / devicePixelRatio, m.b]);
        return write.call(this, text, x, y);
      };
      map.m.grid = map.m.grid.map(() => 2.5);
      map.shown();
      CanvasRenderingContext2D.prototype.fillText = write;
      return found;
    }"""
    found = page.evaluate(texts)
    turned = [at for _, at, turn in found if turn]
    assert len(turned) == 1
    assert 9 <= turned[0] <= 20
    assert "2.5 N in every run" in [text for text, *_ in found]


def test_two_tabs_and_a_reload_show_the_same_run(page, browser, lab):
    """What one page changes the other shows, controls included; a page that is loaded again shows it as well."""
    other, faults = opened_page(browser, lab)
    row(page, "law.force").locator(".num").fill("13")
    page.keyboard.press("Enter")
    settled(page, lab)
    for each in (page, other):
        assert plotted(each)["commanded"] == 13.0
        assert row(each, "law.force").locator(".num").input_value() == "13"
    other.reload()
    other.wait_for_function("run && space.scene")
    assert plotted(other)["commanded"] == 13.0
    other.wait_for_function("map.m === null || map.stale === 'law.force'")  # the map knows the run that is shown
    other.close()
    assert faults == []
    row(page, "law.force").locator(".num").fill("14")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert plotted(page)["commanded"] == 14.0


def test_a_page_whose_server_has_stopped_says_so(browser, lab):
    """One sentence; what is shown stays and its replay goes on."""
    page, faults = opened_page(browser, lab)
    lab.close()
    page.get_by_role("alert").filter(has_text="What is shown stays").wait_for()
    page.keyboard.press("ArrowRight")
    assert page.evaluate("state.time") > 0.0
    page.close()
    assert faults == []


def test_a_thousand_changes_and_an_idle_page_leave_the_last_value(page, lab):
    """As fast as they can be said; then nothing for a while; then the page answers as before."""
    page.evaluate("""() => { for (let k = 0; k < 3600; k++)
        change({ do: "set", key: "law.force", index: null, shown: 5 + (k % 100) / 10 }); }""")
    settled(page, lab)
    assert lab.run.scenario.law.force == pytest.approx(14.9)
    assert plotted(page)["commanded"] == pytest.approx(14.9)
    page.wait_for_timeout(3_000)  # longer than the pings of the socket
    row(page, "law.force").locator(".num").fill("6")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert plotted(page)["commanded"] == 6.0


def test_what_is_no_request_of_the_page_changes_nothing(page, lab):
    """Wrong kinds, wrong keys, wrong values, no JSON: no traceback, no other run, and the page goes on."""
    before = lab.run
    for message in ("{", "[]", '"x"', '{"do": "set"}', '{"do": "set", "key": "law.force", "shown": "wide"}',
                    '{"do": "set", "key": "law.kind", "shown": "os:system"}', '{"do": "open", "name": "/etc/passwd"}',
                    '{"do": "columns", "names": 3}', '{"do": "window", "range": ["a", null]}',
                    '{"do": "point", "u": null}', '{"do": "analyse", "at": "x"}', '{"do": "boundary"}'):  # fmt: skip
        page.evaluate("text => socket.send(text)", message)
    settled(page, lab)
    assert lab.run.scenario == before.scenario
    assert page.evaluate("socket.readyState") == 1


def test_a_curve_of_many_points_covers_what_its_line_would(page):
    """In every column of pixels from its least to its greatest value; with dashes in some columns and not in others."""
    drawn = """([count, dashes]) => {
      const g = Object.assign(document.createElement('canvas'), {width: 100, height: 50}).getContext('2d');
      const time = Float32Array.from({length: count}, (_, i) => 100 * i / count);
      const zigzag = time.map((_, i) => (i % 2 ? 10 : 40));
      Plot.prototype.curve(g, time, zigzag, '#f00', 1, dashes, t => t, v => v);
      const d = g.getImageData(0, 0, 100, 50).data, seen = (x, y) => d[4 * (100 * y + x) + 3] > 100;
      return [...Array(100).keys()].map(x => [...Array(50).keys()].filter(y => seen(x, y)).length);
    }"""
    for count in (200, 1000):
        heights = page.evaluate(drawn, [count, []])
        assert min(heights[1:]) >= 30
        assert max(heights) <= 32
    dashed = page.evaluate(drawn, [1000, [5, 4]])
    assert [height >= 30 for height in dashed[:18]] == 2 * (5 * [True] + 4 * [False])
    assert max(page.evaluate(drawn, [5, []])) < 30, "a line through few points is no bar"


def test_pictures_wait_for_the_run_where_they_are_slow(page, lab):
    """While a slider moves they come late and coarse; once it rests a good one shows the newest instant."""
    settled(page, lab)
    page.wait_for_function("!space.waits")
    page.evaluate("""() => {
      const paint = space.paint;
      window.painted = [];
      space.paint = coarse => { painted.push(coarse); return paint.call(space, coarse); };
      space.cost = 1000;
      space.moved();
      draw_space();
    }""")
    page.wait_for_function("painted.length && !painted.some(coarse => !coarse)")
    page.evaluate("space.answered()")
    page.wait_for_function("painted.at(-1) === false && !space.waits")
    assert page.evaluate(COLOURS) > 20


def test_the_picture_comes_back_after_the_graphics_processor_was_lost(page, lab):
    """As browsers take it away when it hangs or the computer sleeps: the same view is there again."""
    settled(page, lab)
    views = page.evaluate("space.views")
    page.evaluate("() => { window.lost = space.gl.getExtension('WEBGL_lose_context'); lost.loseContext(); }")
    page.wait_for_function("space.gl.isContextLost()")
    page.evaluate("lost.restoreContext()")
    page.wait_for_function("!space.gl.isContextLost() && space.drawing.size.length && !space.waits")
    assert page.evaluate(COLOURS) > 20
    assert page.evaluate("space.views") == views


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_curves_controls_and_space_are_seen_at_every_size(scheme, browser, lab):
    """Nothing reaches beyond the window, the plot of the force is the largest, and its colours fit the paper."""
    page, faults = opened_page(browser, lab, color_scheme=scheme)
    for width, height in in_browser.PICTURED:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(500)
        assert_all_is_seen(page, width, height)
    assert page.evaluate("dark") == (scheme == "dark")
    names = page.evaluate("""[...document.querySelectorAll('button, input, select, canvas[role]')]
        .filter(e => e.checkVisibility()).map(e => e.ariaLabel || e.title || e.textContent.trim()
        || e.labels?.[0]?.textContent || '')""")
    assert all(names), "something has no name that is read aloud"
    page.close()
    assert faults == []


def assert_all_is_seen(page, width, height):
    """Check where the parts of a page are in a window of this size, px."""
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = {name: page.locator(name).first.bounding_box() for name in ("#plots", "#left", "#space", "#tabs", "footer")}
    for box in boxes.values():
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= width + 1
        assert box["y"] + box["height"] <= height + 1
    heights = page.evaluate("[...document.querySelectorAll('.plot')].map(e => e.offsetHeight)")
    assert heights[0] == max(heights)
    assert heights[0] > 0.2 * height


def test_the_first_page_offers_the_scenarios_that_ship(browser, tmp_path):
    """Without a name: all of them, with pictures that the page draws; a click opens one, with its sliders."""
    lab = cl.lab(port=8421, show=False)
    try:
        page, faults = opened_page(browser, lab)
        cards = page.locator(".card")
        cards.first.wait_for()
        assert cards.count() == len(cl.shipped_scenarios())
        drawn = """() => { const c = document.querySelector('.card canvas'), g = c.getContext('2d');
            return c.width > 1 && g.getImageData(0, 0, c.width, c.height).data.some(x => x) }"""
        page.wait_for_function(drawn)
        page.locator(".card", has_text="planar2 slide").click()
        page.wait_for_function("document.title.startsWith('planar2_slide')")
        settled(page, lab)
        assert lab.run.scenario.name == "planar2_slide"
        assert not page.locator("#cards").is_visible()
        assert plotted(page)["commanded"] == pytest.approx(lab.run.scenario.law.force)
        page.close()
        assert faults == []
    finally:
        lab.close()


# Their scenes are those of another scenario: an arm on a plane.
ALIKE = (
    "joint_friction", "panda_slide", "panda_touchdown", "panda_wipe", "payload_mismatch", "wam_edge",
    "wam_hybrid_friction", "wam_liftoff", "wam_slide_friction", "wam_slide_unstabilised", "wam_stick_slip",
    "wam_touchdown",
)  # fmt: skip
SHARED = [name for name in cl.shipped_scenarios() if name not in budget(ALIKE, ())]


@pytest.mark.parametrize("name", SHARED)
def test_the_shared_page_opens_from_disk_without_network(name, offline, tmp_path):
    """Of every kind of scene, offline: small, asks for nothing, throws nothing, shows tip and forces, and moves."""
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
