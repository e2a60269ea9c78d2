"""The lab's page in a browser: opened, waited for, read."""

from validation.speed.lab import wait_until

# How many colours the picture in space has.
COLOURS = """() => {
  const g = Object.assign(document.createElement('canvas'), {width: 300, height: 300}).getContext('2d');
  space.drawing.present();
  g.drawImage(space.canvas, 0, 0);
  return new Set(new Uint32Array(g.getImageData(0, 0, 300, 300).data.buffer)).size;
}"""


def opened_page(browser, lab, **settings):
    """Return a page of the lab that shows a run, and the list of what is thrown in it, or forbidden by its policy."""
    page, faults = browser.new_page(**({"viewport": {"width": 1440, "height": 900}} | settings)), []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda said: faults.append(said.text) if said.type == "error" else None)
    page.set_default_timeout(60_000)
    page.goto(lab.url)
    page.get_by_text("steps in").wait_for()
    wait_until(page, "space.scene && run && map.x.options.length")
    return page, faults


def settled(page, lab):
    """Wait until the page shows the newest run, with all that follows it."""
    page.wait_for_timeout(300)
    assert lab.wait(120.0)
    wait_until(page, f"run.n >= {lab._count}")
    page.wait_for_timeout(100)


def plotted(page):
    """Return the largest value of each trace in the plot of the force, from what the page draws."""
    script = "() => run.panels[0].traces.map(t => [t.label, Math.max(...t.values)])"
    return dict(page.evaluate(script))


def row(page, key):
    """Return the row of a key; of a list that of all its numbers."""
    return page.locator(f'.row[data-key="{key}"]').first
