"""Chromium without a screen, and the lab's page in it."""

import pytest
from lab_page import opened_page

import closedloop as cl
from closedloop.lab import mapping, server
from validation.speed import lab as in_browser


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
    monkeypatch.setattr(mapping, "AT_MOST", 1.0)
    monkeypatch.setattr(server, "PING", 1.0)
    opened = cl.lab("wam_slide", port=8411, show=False)
    opened.folder = tmp_path
    assert opened.run is not None
    assert opened.wait(600.0)
    yield opened
    opened.close()


@pytest.fixture
def page(browser, lab):
    """The lab's page; at the end nothing must have been thrown in it."""
    opened, faults = opened_page(browser, lab)
    yield opened
    opened.close()
    assert faults == []
