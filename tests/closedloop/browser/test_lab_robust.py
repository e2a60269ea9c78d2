"""The lab's page in a browser: tabs, reload, a stopped server, many changes, sizes of the window, slow pictures."""

import pytest
from lab_page import COLOURS, opened_page, plotted, row, settled

from validation.speed import lab as in_browser
from validation.speed.lab import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(in_browser.why_not()), reason=in_browser.why_not())]


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
    wait_until(other, "run && space.scene")
    assert plotted(other)["commanded"] == 13.0
    wait_until(other, "map.m === null || map.stale === 'law.force'")  # the map knows the run that is shown
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
    wait_until(page, "!space.waits")
    page.evaluate("""() => {
      const paint = space.paint;
      window.painted = [];
      space.paint = coarse => { painted.push(coarse); return paint.call(space, coarse); };
      space.cost = 1000;
      space.moved();
      draw_space();
    }""")
    wait_until(page, "painted.length && !painted.some(coarse => !coarse)")
    page.evaluate("space.answered()")
    wait_until(page, "painted.at(-1) === false && !space.waits")
    assert page.evaluate(COLOURS) > 20


def test_the_picture_comes_back_after_the_graphics_processor_was_lost(page, lab):
    """As browsers take it away when it hangs or the computer sleeps: the same view is there again."""
    settled(page, lab)
    views = page.evaluate("space.views")
    page.evaluate("() => { window.lost = space.gl.getExtension('WEBGL_lose_context'); lost.loseContext(); }")
    wait_until(page, "space.gl.isContextLost()")
    page.evaluate("lost.restoreContext()")
    wait_until(page, "!space.gl.isContextLost() && space.drawing.size.length && !space.waits")
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
