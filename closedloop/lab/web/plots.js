"use strict";
// Curves against time, one window and one cursor for all. A click goes to an instant, a drag enlarges.

const LEFT = 52, RIGHT = 10, BELOW = 18, MODE = 7, NAMES = 8, DENSE = 1.5;
const MODES = ["rgb(140 150 160 / 0.35)", "rgb(0 114 178 / 0.45)", "rgb(230 159 0 / 0.75)"];
const EVENT = {
  impact: "#E69F00", touchdown: "#0072B2", liftoff: "#56B4E9", stick: "#D55E00", slip: "#009E73", reversal: "#CC79A7",
};

class Plots {
  constructor(parent, tell) {
    this.parent = parent;
    this.tell = tell; // { seek, window, close }
    this.plots = new Map();
    this.pins = [];
    this.hidden = new Set();
    this.window = null;
    this.range = [0, 1];
    this.run = null;
  }

  // Show another run; its panels keep their places.
  show(run) {
    this.run = run;
    this.range = this.window ?? [run.begin, Math.max(run.total ?? run.end, run.begin + 1e-9)];
    const names = run.panels.map((p) => p.name);
    for (const [name, plot] of this.plots) if (!names.includes(name)) { plot.box.remove(); this.plots.delete(name); }
    run.panels.forEach((panel, k) => {
      let plot = this.plots.get(panel.name);
      if (!plot) this.plots.set(panel.name, (plot = new Plot(this, panel.name)));
      if (this.parent.children[k] !== plot.box) this.parent.insertBefore(plot.box, this.parent.children[k] ?? null);
      plot.box.classList.toggle("first", k === 0);
      plot.take(panel, k === 0);
    });
    this.draw();
  }

  draw() {
    for (const plot of this.plots.values()) plot.draw();
    this.cursor(this.now ?? 0, null);
    for (const plot of this.plots.values()) plot.fit_names();
  }

  cursor(now, held) {
    this.now = now;
    for (const plot of this.plots.values()) plot.cursor(now, held);
  }

  enlarge(from, to) {
    const run = this.run, end = run.total ?? run.end;
    const [a, b] = [Math.max(Math.min(from, to), run.begin), Math.min(Math.max(from, to), end)];
    this.window = b - a < 2 * run.step || (a <= run.begin && b >= end) ? null : [a, b];
    this.range = this.window ?? [run.begin, end];
    this.draw();
    this.tell.window(this.window);
  }
}

class Plot {
  constructor(all, name) {
    this.all = all;
    this.name = name;
    this.names = make("div", { className: "names" });
    this.base = make("canvas");
    this.over = make("canvas", { className: "over" });
    this.over.setAttribute("role", "img");
    this.area = make("div", { className: "area" }, this.base, this.over);
    this.box = make("div", { className: "plot" }, this.names, this.area);
    this.hover = null;
    this.listen();
  }

  take(panel, first) {
    const names = panel.traces.map((t) => t.label).join("\n") + panel.title + (first ? this.all.pins.map((p) => p.name).join() : "");
    this.panel = panel;
    this.first = first;
    if (names !== this.labels) this.name_all(names);
  }

  name_all(labels) {
    this.labels = labels;
    const names = this.panel.traces.filter((t) => !t.limit).map((t) => t.label); // panda_joint1, panda_joint2: joint1 ...
    const shared = names.length > 1 ? names[0].slice(0, names[0].lastIndexOf("_") + 1) : "";
    this.shared = shared && names.every((n) => n.startsWith(shared)) ? shared.length : 0;
    this.spans = this.panel.traces.map((t) => {
      const span = make("button", { title: `${t.label}; click: hide or show it` });
      span.onclick = () => {
        const key = `${this.name} ${t.label}`;
        if (!this.all.hidden.delete(key)) this.all.hidden.add(key);
        this.all.draw();
      };
      return span;
    });
    const dashed = this.name === "links"; // the friction of a contact has its colour, with dashes
    this.listed = this.spans.filter((span, k) => this.panel.traces[k].label !== "-limit" && !(dashed && this.panel.traces[k].limit));
    this.more = make("span");
    this.fits = "";
    this.modes_ = this.first && this.all.run.modes ? make("span", { className: "modes", title: "the stripe below: what the tip does" }) : null;
    this.names.replaceChildren(make("b", { textContent: this.panel.title + (dashed ? ", friction dashed" : "") }), ...this.listed, this.more,
      ...(this.first ? this.all.pins : []).map((p) => Object.assign(make("span", { textContent: p.name, title: "a pinned run: its curves" }), { style: `color:${tint(p.colour)}` })), this.modes_ ?? "");
    if (this.all.tell.extra(this.name)) {
      const close = make("button", { className: "close", textContent: "close", title: "show this column no longer" });
      close.onclick = () => this.all.tell.close(this.name);
      this.names.append(close);
    }
  }

  // Show as many names as there is room for, and how many more there are.
  fit_names() {
    const key = `${sizes.get(this.base)?.[0]} ${this.labels}`, all = this.listed.length;
    if (key === this.fits) return;
    this.fits = key;
    for (let count = Math.min(all, NAMES); count > 0; count--) {
      this.listed.forEach((span, k) => { span.hidden = k >= count; });
      this.more.textContent = count < all ? `and ${all - count} more` : "";
      if (this.names.scrollHeight <= this.names.clientHeight + 1) break;
    }
  }

  listen() {
    const c = this.over;
    let from = null, moved = false, scrub = false;
    c.addEventListener("pointerdown", (e) => {
      c.setPointerCapture(e.pointerId);
      [from, moved, scrub] = [e.offsetX, false, e.offsetY > c.clientHeight - BELOW];
      if (scrub) this.all.tell.seek(this.instant(e.offsetX));
    });
    c.addEventListener("pointermove", (e) => {
      this.hover = this.instant(e.offsetX);
      if (from !== null && scrub) this.all.tell.seek(this.hover);
      if (from !== null && !scrub && Math.abs(e.offsetX - from) > 5) moved = true;
      this.drag = moved ? [from, e.offsetX] : null;
      this.all.cursor(this.now, this.hover);
    });
    c.addEventListener("pointerup", (e) => {
      if (from === null) return;
      if (moved) this.all.enlarge(this.instant(from), this.instant(e.offsetX));
      else if (!scrub) this.all.tell.seek(this.instant(e.offsetX));
      [from, this.drag] = [null, null];
    });
    c.addEventListener("pointerleave", () => { this.hover = null; this.all.cursor(this.now, null); });
    c.addEventListener("dblclick", () => this.all.enlarge(-Infinity, Infinity));
    c.addEventListener("wheel", (e) => {
      if (!e.ctrlKey && !e.metaKey) return;
      e.preventDefault();
      const [a, b] = this.all.range, at = this.instant(e.offsetX), k = Math.exp(0.002 * e.deltaY);
      this.all.enlarge(at + (a - at) * k, at + (b - at) * k);
    }, { passive: false });
  }

  instant(x) {
    const [a, b] = this.all.range;
    return a + Math.min(Math.max((x - LEFT) / (this.over.clientWidth - LEFT - RIGHT), 0), 1) * (b - a);
  }

  seen() { return this.panel.traces.filter((t) => !this.all.hidden.has(`${this.name} ${t.label}`)); }

  // The least and greatest value in the window; a limit that is far away is left out, except where it is the subject.
  span(pinned) {
    let [low, high] = [Infinity, -Infinity];
    const [a, b] = this.all.range;
    const over = (time, values) => {
      for (let i = 0; i < values.length; i++) {
        const v = values[i];
        if (Number.isFinite(v) && time[i] >= a && time[i] <= b) { if (v < low) low = v; if (v > high) high = v; }
      }
    };
    for (const t of this.seen()) if (!t.limit) over(this.panel.time, t.values);
    for (const p of pinned) over(p.time, p.values);
    const [l, h] = [low, high];
    for (const t of this.seen()) if (t.limit) over(this.panel.time, t.values);
    if (this.name === "torque" && h > l && Math.max(Math.abs(l), Math.abs(h)) < 40) [low, high] = [l, h];
    if (this.panel.band && h - l < 8 * this.panel.band) [low, high] = [low - 1.5 * this.panel.band, high + 1.5 * this.panel.band];
    if (!(low < high)) {
      const k = 0.05 * Math.abs(low) || 1;
      low = Number.isFinite(low) ? low - k : -1;
      high = low + 2 * k;
    }
    const margin = 0.07 * (high - low);
    return [low - margin, high + margin];
  }

  // The curves of the pinned runs, in the unit of this panel.
  pinned() {
    return this.all.pins.map((p) => ({ colour: p.colour, ...p.panels[this.name] })).filter((p) => p.time)
      .map((p) => ({ ...p, values: p.values.map((v) => (v * this.panel.factor) / p.factor) }));
  }

  draw() {
    const [g, w, h] = sized(this.base);
    if (!this.panel || w < 80) return;
    const [a, b] = this.all.range, run = this.all.run, strip = this.first && run.modes ? MODE : 0;
    const [x0, y0, width, height] = [LEFT, 4, w - LEFT - RIGHT, h - 4 - BELOW - strip];
    const pinned = this.pinned();
    const [low, high] = this.span(pinned);
    this.largest = Math.max(Math.abs(low), Math.abs(high));
    const x = (t) => x0 + (width * (t - a)) / (b - a);
    const y = (v) => y0 + height * (1 - (v - low) / (high - low));
    this.x = x;
    g.font = small_print();
    g.fillStyle = ink("--faint");
    g.strokeStyle = ink("--line");
    g.lineWidth = 1;
    const line = (xa, ya, xb, yb) => { g.beginPath(); g.moveTo(xa, ya); g.lineTo(xb, yb); g.stroke(); };
    g.textAlign = "right";
    const [levels, instants] = [few(ticks(low, high, Math.max(2, height / 34)), height), ticks(a, b, Math.max(3, width / 90))];
    labels(levels).forEach((text, k) => { line(x0, y(levels[k]), x0 + width, y(levels[k])); g.fillText(text, x0 - 6, y(levels[k]) + 4, x0 - 8); });
    g.textAlign = "center";
    labels(instants).forEach((text, k) => {
      const t = instants[k];
      line(x(t), y0, x(t), y0 + height);
      g.textAlign = x(t) > x0 + width - 14 ? "right" : "center";
      g.fillText(`${text}${this.first ? " s" : ""}`, g.textAlign === "right" ? w - 1 : x(t), h - 4);
    });
    g.save();
    g.beginPath();
    g.rect(x0, y0 - 3, width, height + 6);
    g.clip();
    const asked = this.panel.traces.find((t) => t.limit), time = this.panel.time;
    if (this.panel.band && asked) this.between(g, time, asked.values, (v) => v - this.panel.band, (v) => v + this.panel.band, x, y);
    if (this.name === "friction" && asked) this.between(g, time, asked.values, () => 0, (v) => v, x, y);
    for (const m of run.marks) {
      g.strokeStyle = tint(EVENT[m.kind] ?? "#8A8A8A");
      g.globalAlpha = this.first ? 0.55 : 0.3;
      if (m.time >= a && m.time <= b) line(x(m.time), this.first ? y0 : y0 + height - 8, x(m.time), y0 + height);
    }
    g.globalAlpha = 1;
    for (const p of pinned) this.curve(g, p.time, p.values, tint(p.colour), 1.2, [], x, y);
    for (const t of this.seen()) this.curve(g, time, t.values, tint(t.colour), this.first && t.label === "f" ? 2 : 1.4, t.limit ? [5, 4] : [], x, y);
    g.restore();
    if (strip) {
      this.modes(g, x, [x0, x0 + width], h - BELOW - strip + 1);
      const seen = [...new Set(run.modes.mode)].sort();
      if (this.modes_ && this.modes_.dataset.seen !== seen.join()) {
        this.modes_.replaceChildren(...seen.map((m) => make("span", { textContent: run.modes.names[m], style: `border-bottom: 3px solid ${MODES[m]}` })));
        this.modes_.dataset.seen = seen.join();
      }
    }
    this.over.setAttribute("aria-label", `${this.panel.title}, from ${short(low)} to ${short(high)}, against time`);
  }

  // A line through the points. Where there are more of them than columns of pixels, a column is a bar from its least to
  // its greatest value: without a graphics processor a line to and fro takes several times as long.
  curve(g, time, values, colour, width, dashes, x, y) {
    const count = values.length, dense = count > DENSE * (x(time[count - 1]) - x(time[0])), [dash, gap] = dashes;
    g.strokeStyle = g.fillStyle = colour;
    g.lineWidth = width;
    g.lineJoin = "round";
    g.setLineDash(dashes);
    g.beginPath();
    let last = null; // the point before
    for (let i = 0, end; i < count; i = end) {
      end = i + 1;
      if (!Number.isFinite(values[i])) { last = null; continue; }
      const at = x(time[i]), column = Math.floor(at), first = y(values[i]);
      let value = first, [low, high] = [value, value];
      for (; dense && end < count && Number.isFinite(values[end]) && Math.floor(x(time[end])) === column; end++) {
        value = y(values[end]);
        [low, high] = [Math.min(low, value), Math.max(high, value)];
      }
      if (!dense) {
        if (last) g.lineTo(at, first); else g.moveTo(at, first);
      } else {
        if (last && last[0] === column - 1) [low, high] = [Math.min(low, last[1]), Math.max(high, last[1])];
        else if (last) g.lineTo(column, first); // over columns without a point
        if (!gap || column % (dash + gap) < dash) g.fillRect(column, low - width / 2, Math.max(width, 1), high - low + width);
        g.moveTo(column + 1, value);
      }
      last = [column, value];
    }
    g.stroke();
    g.setLineDash([]);
  }

  between(g, time, values, under, above, x, y) {
    g.fillStyle = ink("--band");
    g.beginPath();
    for (let i = 0; i < values.length; i++) g.lineTo(x(time[i]), y(above(values[i])));
    for (let i = values.length - 1; i >= 0; i--) g.lineTo(x(time[i]), y(under(values[i])));
    g.fill();
  }

  modes(g, x, [from, to], top) {
    const { time, mode } = this.all.run.modes, end = this.all.run.end;
    for (let i = 0; i < time.length; i++) {
      const [u, v] = [Math.max(x(time[i]), from), Math.min(x(i + 1 < time.length ? time[i + 1] : end), to)];
      g.fillStyle = MODES[mode[i]];
      if (v > u) g.fillRect(u, top, Math.max(v - u, 0.6), MODE - 2);
    }
  }

  // The cursor, and the values at it: of the pointer while it is here, else of the replay's instant.
  cursor(now, hover) {
    this.now = now;
    if (!this.x || !this.panel) return;
    this.say(hover ?? now);
    const drawn = [now, hover, this.drag, ...this.all.range, sizes.get(this.over), devicePixelRatio, dark].join();
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    const [g, w, h] = sized(this.over);
    const inside = (t) => this.x(t) >= LEFT - 1 && this.x(t) <= w - RIGHT + 1;
    const line = (t) => { g.beginPath(); g.moveTo(this.x(t), 4); g.lineTo(this.x(t), h - BELOW); g.stroke(); };
    g.strokeStyle = ink("--ink");
    if (inside(now)) line(now);
    if (hover !== null && hover !== undefined) { g.strokeStyle = ink("--faint"); g.setLineDash([3, 3]); line(hover); g.setLineDash([]); }
    if (this.drag) {
      g.fillStyle = "rgb(79 176 234 / 0.2)";
      g.fillRect(Math.min(...this.drag), 4, Math.abs(this.drag[1] - this.drag[0]), h - BELOW - 4);
    }
  }

  say(at) {
    const time = this.panel.time;
    let [k, high] = [0, time.length - 1];
    while (k < high) { const m = (k + high + 1) >> 1; if (time[m] <= at) k = m; else high = m - 1; }
    this.panel.traces.forEach((t, i) => {
      const span = this.spans[i];
      const text = this.name.startsWith("torque") && t.limit ? "limit" : `${t.limit ? t.label : t.label.slice(this.shared)} ${short(Math.abs(t.values[k]) < 1e-6 * this.largest ? 0 : t.values[k], innerWidth > 1100 ? 4 : 3)}`;
      if (span.textContent !== text) span.textContent = text;
      span.style.color = tint(t.colour);
      span.classList.toggle("off", this.all.hidden.has(`${this.name} ${t.label}`));
    });
  }
}
