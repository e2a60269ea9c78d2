"use strict";
// The tabs beside the curves: map, analysis, compare, events, scenario. One is seen at a time.

class Tabs {
  constructor(list, pane, tabs) {
    this.list = list;
    this.pane = pane;
    this.tabs = tabs; // name -> { title, element, shown() }
    for (const [name, tab] of Object.entries(tabs)) {
      const button = make("button", { textContent: tab.title, id: `tab-${name}` });
      button.setAttribute("role", "tab");
      button.onclick = () => { this.used = true; this.open(name); };
      list.append(button);
      tab.button = button;
    }
    list.addEventListener("keydown", (e) => {
      const names = Object.keys(tabs).filter((n) => !tabs[n].button.hidden), k = names.indexOf(this.name);
      const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
      if (!step) return;
      e.stopPropagation();
      this.used = true;
      const next = names[(k + step + names.length) % names.length];
      this.open(next);
      tabs[next].button.focus();
    });
  }

  open(name) {
    this.name = name;
    for (const [each, tab] of Object.entries(this.tabs)) {
      tab.button.setAttribute("aria-selected", each === name);
      tab.button.tabIndex = each === name ? 0 : -1;
    }
    this.pane.replaceChildren(this.tabs[name].element);
    this.pane.setAttribute("aria-labelledby", `tab-${name}`);
    this.tabs[name].shown?.();
  }
}

// Curves over a logarithmic frequency, with the value at the pointer.
function bode(canvas, m, which, title, marks) {
  const [g, w, h] = sized(canvas), values = m[which];
  if (w < 60 || !values?.length) return;
  const [a, b] = [m.frequency[0], m.frequency[m.frequency.length - 1]];
  let [low, high] = [Infinity, -Infinity];
  for (const v of values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  if (which === "gain") low = Math.max(low, high - 120);
  const pad = 0.06 * (high - low || 1);
  [low, high] = [low - pad, high + pad];
  const x = (f) => 44 + ((w - 54) * Math.log(f / a)) / Math.log(b / a), top = 20, y = (v) => top + (h - 20 - top) * (1 - (v - low) / (high - low));
  g.font = small_print();
  const line = (xa, ya, xb, yb) => { g.beginPath(); g.moveTo(xa, ya); g.lineTo(xb, yb); g.stroke(); };
  g.strokeStyle = ink("--line");
  g.fillStyle = ink("--faint");
  g.textAlign = "right";
  const levels = few(ticks(low, high, h / 36), h);
  labels(levels).forEach((text, k) => { line(44, y(levels[k]), w - 10, y(levels[k])); g.fillText(text, 40, y(levels[k]) + 4, 38); });
  g.textAlign = "center";
  for (const f of logTicks(a, b)) { line(x(f), top, x(f), h - 20); g.fillText(short(f), x(f), h - 7); }
  g.textAlign = "right";
  g.fillText("Hz", w - 1, h - 7);
  g.fillText(title, w - 10, 13);
  g.strokeStyle = ink("--faint");
  g.setLineDash([4, 4]);
  for (const v of marks.levels) if (v > low && v < high) line(44, y(v), w - 10, y(v));
  g.strokeStyle = ink("--bad");
  for (const f of marks.frequencies) if (f > a && f < b) line(x(f), top, x(f), h - 20);
  g.setLineDash([]);
  g.save();
  g.beginPath();
  g.rect(44, 0, w - 54, h - 20);
  g.clip();
  g.strokeStyle = ink("--accent");
  g.lineWidth = 1.8;
  g.beginPath();
  values.forEach((v, i) => g.lineTo(x(m.frequency[i]), y(v)));
  g.stroke();
  g.restore();
}

class Analysis {
  constructor(send, instant) {
    this.said = make("p");
    this.charts = ["gain", "phase"].map((which) => Object.assign(make("canvas", { className: "chart", tabIndex: 0 }), { which }));
    this.charts.forEach((c) => { c.setAttribute("role", "img"); c.setAttribute("aria-label", `Bode's diagram: ${c.which} over frequency`); });
    this.poles = make("div");
    const here = make("button", { textContent: "at this instant", title: "analyse the loop at the replay's instant" });
    here.onclick = () => send({ do: "analyse", at: instant() });
    const half = make("button", { textContent: "at half of the run" });
    half.onclick = () => send({ do: "analyse", at: null });
    this.element = make("div", {}, make("div", { className: "bar" }, here, half), this.said, ...this.charts, this.poles);
  }

  show(m) {
    this.m = m;
    this.shown();
  }

  shown() {
    const m = this.m, there = Boolean(m && !m.line);
    this.said.textContent = m?.line || m?.sentence || "The loop is analysed when the sliders rest.";
    this.charts.forEach((c) => { c.hidden = !there; c.style.height = "150px"; });
    this.poles.replaceChildren();
    if (!there) return;
    const { gain_at, phase_at, cut } = m.margins;
    bode(this.charts[0], m, "gain", `|L| [dB], cut at ${cut.startsWith("torque") ? "" : "the "}${cut}`, { levels: [0], frequencies: [gain_at, phase_at] });
    bode(this.charts[1], m, "phase", "phase [deg]", { levels: [-180, 180], frequencies: [gain_at, phase_at] });
    this.poles.append(table(["pole [1/s]", "frequency [Hz]", "damping", "part"], m.poles.map((p) => [p.s, p.frequency, p.damping, p.part])));
  }
}

function table(heads, rows, act) {
  const head = make("tr", {}, ...heads.map((h) => (h instanceof Node ? h : make("th", { textContent: h }))));
  const body = make("tbody", {}, ...rows.map((cells, k) => {
    const row = make("tr", {}, ...cells.map((c) => (c instanceof Node ? c : make("td", { textContent: c }))));
    if (act) {
      row.tabIndex = 0;
      row.onclick = () => act(k);
      row.onkeydown = (e) => { if (e.key === "Enter") act(k); };
    }
    return row;
  }));
  return make("table", {}, make("thead", {}, head), body);
}

class Compare {
  constructor() { this.element = make("div"); }

  show(m) {
    if (!m.columns.length) {
      this.element.replaceChildren(make("p", { className: "hint", textContent: "Pin a run (key p) to compare the next ones with it: its curves stay, and its values stand here and beside those of the strip." }));
      return;
    }
    const heads = ["", ...m.columns.map((c) => Object.assign(make("th", { textContent: c.name }), { style: `color:${tint(c.colour)}` })), "now"];
    const cells = m.rows.map(([name, ...values]) => [name, ...values.map(([text, better]) => {
      const cell = make("td", { textContent: text });
      if (better !== null) cell.style.color = better ? "var(--good)" : "var(--bad)";
      return cell;
    })]);
    this.element.replaceChildren(table(heads, cells), make("p", { className: "hint", textContent: "In brackets: the pin minus the run of now; green where the pin is better." }));
  }
}

class Events {
  constructor(seek) {
    this.seek = seek;
    this.element = make("div");
  }

  show(run) {
    this.marks = run.marks;
    const kind = (m) => { // in the colour of its line in the curves
      const cell = make("td", {}, make("i", { className: "swatch" }), m.kind.replace("_", " "));
      cell.firstChild.style.background = tint(EVENT[m.kind] ?? "#8A8A8A");
      return cell;
    };
    const rows = run.marks.map((m) => [m.time.toFixed(4), kind(m), m.of, m.place.map((x) => Number(x.toFixed(3))).join("  ")]);
    const more = run.events > run.marks.length ? make("p", { className: "hint", textContent: `the first ${run.marks.length} of ${run.events} events` }) : "";
    this.element.replaceChildren(...(rows.length
      ? [table(["time [s]", "event", "of", "where [m]"], rows, (k) => this.seek(this.marks[k].time)), more]
      : [make("p", { className: "hint", textContent: "No event in this run: no contact began or ended, stuck or slipped, or the integrator is time stepping, which locates no events." })]));
  }
}

class Words {
  constructor(live) {
    this.command = make("pre", { id: "command" });
    this.scenario = make("pre", { id: "scenario" });
    this.note = make("p", { className: "hint" });
    this.copy = make("button", { textContent: "copy command" });
    this.copy.onclick = () => this.copied();
    this.element = make("div", {}, make("p", { textContent: "The command that repeats this run to the last bit:" }), this.command, this.copy, this.note, this.scenario);
  }

  show(m) {
    if (m.command !== undefined) this.command.textContent = m.command;
    if (m.scenario !== undefined) this.scenario.textContent = m.scenario;
    if (m.note !== undefined) this.note.textContent = m.note;
  }

  // A page that does not come from this computer has no clipboard: the text is selected instead, for Ctrl-C.
  async copied() {
    let said = "copied";
    try {
      await navigator.clipboard.writeText(this.command.textContent);
    } catch {
      getSelection().selectAllChildren(this.command);
      said = "selected: press Ctrl-C";
    }
    this.copy.textContent = said;
    setTimeout(() => { this.copy.textContent = "copy command"; }, 1500);
  }
}
