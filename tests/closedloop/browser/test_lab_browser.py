"""The lab's page in a browser without a screen: what is dragged there is what runs."""

import contextlib
import shlex
import socket
import threading
import time

import numpy as np
import pytest
from lab_page import plotted, row, settled

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures.motion import tip_errors
from closedloop.lab import mapping
from closedloop.serve.session import Watch
from closedloop.studies.analysis.stability import Stability
from validation.speed import lab as in_browser
from validation.speed.lab import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(in_browser.why_not()), reason=in_browser.why_not())]


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
        if k == 20:
            time.sleep(1.2)  # a hand that rests does not end the drag
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
    for _ in range(200):  # however slow the computer is
        if lab.run.scenario.law.force == 10.0:
            break
        page.wait_for_timeout(50)
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
    wait_until(page, "state.playing && state.time > 0.1")
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


def test_a_drag_in_space_pulls_at_what_is_below_the_pointer(page, lab):
    """With `pull` pressed a drag at the tip is a force for 0.2 s, along the drag; one beside the arm turns the view."""
    page.evaluate("seek(2.0)")
    wait_until(page, "space.frame && !space.waits && space.scene && counts !== null")
    box, shown = page.locator("#view").bounding_box(), "JSON.stringify([space.view().turn, space.view().rise])"
    x, y = page.evaluate(
        """() => { const v = space.view(), c = space.canvas, cam = space.camera(v, c.clientWidth / c.clientHeight);
        const at = [...space.frame.arrows[0].tail, 1];
        const [x, y, k] = [0, 1, 3].map((r) => at.reduce((s, e, j) => s + cam[4 * j + r] * e, 0));
        return [0.5 * (x / k + 1) * c.clientWidth, 0.5 * (1 - y / k) * c.clientHeight]; }"""
    )
    before = page.evaluate(shown)
    page.keyboard.press("f")
    page.mouse.move(box["x"] + x - 2, box["y"] + y + 6)
    page.mouse.down()
    page.mouse.move(box["x"] + x + 58, box["y"] + y + 6, steps=4)
    page.mouse.up()
    settled(page, lab)
    (pulled,) = lab.run.scenario.external_force
    assert (pulled.link, pulled.start, pulled.duration) == (None, 2.0, 0.2)
    right = np.array(page.evaluate("space.screen(space.view())[0]"))
    assert right @ pulled.force > 0.99 * np.linalg.norm(pulled.force) > 0.99
    assert page.evaluate(shown) == before
    page.mouse.move(box["x"] + 8, box["y"] + box["height"] - 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 60, box["y"] + box["height"] - 200)
    page.mouse.up()
    assert page.evaluate(shown) != before
    assert len(lab.run.scenario.external_force) == 1


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


def test_a_pin_is_drawn_in_the_unit_of_the_axis(page, lab):
    """A pin of −35 µm stands at −0.035 below an axis in mm; the pin is named; labels of ticks tell them apart."""
    page.keyboard.press("p")
    page.locator("#unpin").wait_for()
    lab.changed("friction.kind", "coulomb")
    lab.changed("law.kp", [90.0, 90.0, 40.0, 30.0])
    settled(page, lab)
    titles = page.evaluate("run.panels.map((p) => p.title)")
    assert "tip error [mm]" in titles
    along = 1e3 * tip_errors(lab.pins.held[0].run)[0].min()
    assert along == pytest.approx(-0.035, abs=1e-3)
    drawn = page.evaluate("Math.min(...plots.plots.get('tip').pinned()[0].values)")
    assert drawn == pytest.approx(along, rel=1e-5)
    assert "pin 1" in page.locator(".plot.first .names").inner_text()
    assert page.evaluate("labels([10.0002, 10.0004, 10.0006])") == ["10.0002", "10.0004", "10.0006"]
    assert page.evaluate("labels([0, 1e6, 2e6])") == ["0", "1000000", "2000000"]
    assert page.evaluate("labels([0, 1e-9, 2e-9])") == ["0", "1e-9", "2e-9"]


def test_the_page_works_below_a_path_of_a_proxy(browser, lab):
    """A proxy that serves the lab at /proxy/8000/, as Jupyter's does: page and socket open, a slider moves the run."""
    listening = socket.create_server(("127.0.0.1", 0))

    def pipe(source, sink):
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)

    def serve():
        with contextlib.suppress(OSError):
            while True:
                client, _ = listening.accept()
                asked = client.recv(65536)
                assert asked.startswith(b"GET /proxy/8000/")
                behind = socket.create_connection(("127.0.0.1", lab.server.port))
                behind.sendall(asked.replace(b"/proxy/8000/", b"/", 1))
                for ends in ((client, behind), (behind, client)):
                    threading.Thread(target=pipe, args=ends, daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    page = browser.new_page()
    token = lab.url.partition("=")[2]
    page.goto(f"http://127.0.0.1:{listening.getsockname()[1]}/proxy/8000/?token={token}")
    page.get_by_text("steps in").wait_for(timeout=60_000)
    row(page, "law.force").locator(".num").fill("12")
    page.keyboard.press("Enter")
    settled(page, lab)
    assert page.url.endswith(f"/proxy/8000/{token}")
    assert plotted(page)["commanded"] == 12.0
    page.close()
    listening.close()


def test_the_page_is_timed_from_the_pointer_to_the_plot(page, lab):
    """Each movement gives one time, the last no shorter than its run alone takes; the frame comes after the drawing."""
    page.evaluate(in_browser.WATCH)
    first, drawn, shown = in_browser.page_latencies(page, "law.force", 3)
    assert first.shape == drawn.shape == shown.shape == (3,)
    assert np.all(first <= drawn)
    assert drawn[-1] > lab.run.wall_seconds
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
    monkeypatch.setattr(mapping, "CELLS", 16)
    lab.changed("time.duration", 0.2)
    settled(page, lab)
    page.locator("#tabs select").nth(0).select_option("law.force")
    page.locator("#tabs select").nth(1).select_option("law.kp J2")
    page.locator("#tabs select").nth(2).select_option("peak_contact_force")
    page.locator("#compute").click()
    wait_until(page, "map.m?.complete", 300.0)
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
    wait_until(page, "map.m")
    monkeypatch.setattr(mapping, "AT_MOST", 600.0)
    monkeypatch.setattr(mapping, "POINTS", 8)
    monkeypatch.setattr(mapping, "CELLS", 12)
    for key, value in short.items():
        lab.changed(key, value)
    settled(page, lab)
    wait_until(page, "map.m.complete && map.canvas.classList.contains('late')")
    assert "another reference.start" in page.locator("#pane").inner_text()
    assert page.locator("#tabs select").nth(0).input_value() == "law.kp, all"
    assert page.locator("#tabs select").nth(1).input_value() == "law.kd, all"
    page.evaluate("map.line = null")
    page.locator("#compute").click()
    wait_until(page, "map.line?.x && map.m.complete", 300.0)
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
    wait_until(page, "map.m && map.under")
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


def test_a_served_run_is_shown_while_it_grows(browser):
    """Curves, clock and arm go on with the simulation that another program drives; at the end the whole run replays."""
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    faults = []
    with cl.serve("planar2_slide", lock_step=True) as served:
        watch, page = Watch(served.session, port=8421), browser.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(watch.url)
        wait_until(page, "run && space.scene && frames")
        arm = socket.create_connection(("127.0.0.1", served.port), 10.0).makefile("rwb")

        def drive(steps):
            arm.write(steps * b'{"do": "step"}\n')
            arm.flush()
            for _ in range(steps):
                arm.readline()
            return page.evaluate("Array.from(frameAt(state.time).places.at(-2))")

        before = drive(100)
        wait_until(page, "state.time > 0.09 && run.panels[0].name === 'force'")
        drive(1500)
        wait_until(page, "state.time > 1.5")
        assert page.evaluate("Array.from(frameAt(state.time).places.at(-2))") != before
        assert page.locator("#left").is_hidden()  # nothing is moved from here
        run = served.close()
        watch.finish(run, "it is over")
        page.get_by_text("it is over").wait_for()
        assert page.evaluate("[run.begin, frames.time.length, document.querySelectorAll('.tile').length > 3]") == [
            0, 200, True
        ]  # fmt: skip
        page.close()
    assert faults == []
