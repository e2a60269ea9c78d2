"use strict";
// Curves against time on a canvas each, with one cursor for all. A click or a drag goes to that instant.

class Plot {
  constructor(parent, panel, marks, seek) {
    this.panel = { ...panel, time: floats(panel.time), traces: panel.traces.map((t) => ({ ...t, values: floats(t.values) })) };
    this.marks = marks;
    const box = parent.appendChild(document.createElement("div"));
    box.className = "plot";
    this.names = box.appendChild(document.createElement("div"));
    this.names.className = "names";
    this.canvas = box.appendChild(document.createElement("canvas"));
    const go = (e) => { if (e.buttons) seek(this.instant(e.offsetX)); };
    this.canvas.addEventListener("pointerdown", (e) => { this.canvas.setPointerCapture(e.pointerId); go(e); });
    this.canvas.addEventListener("pointermove", go);
    this.span();
  }

  span() {
    let [low, high] = [Infinity, -Infinity];
    for (const t of this.panel.traces) {
      for (const v of t.values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
    }
    if (!(low < high)) {
      const k = 0.05 * Math.abs(low) || 1;
      low = Number.isFinite(low) ? low - k : 0;
      high = low + 2 * k;
    }
    const margin = 0.06 * (high - low);
    [this.low, this.high] = [low - margin, high + margin];
    this.end = this.panel.time[this.panel.time.length - 1] || 1;
  }

  box() {
    return [52, 6, this.canvas.clientWidth - 62, this.canvas.clientHeight - 26];
  }

  instant(x) {
    const [left, , width] = this.box();
    return Math.min(Math.max((x - left) / width, 0), 1) * this.end;
  }

  draw(now) {
    const c = this.canvas, dpr = window.devicePixelRatio || 1;
    [c.width, c.height] = [Math.round(c.clientWidth * dpr), Math.round(c.clientHeight * dpr)];
    const g = c.getContext("2d");
    g.scale(dpr, dpr);
    const style = getComputedStyle(document.documentElement);
    const [left, top, width, height] = this.box();
    const x = (t) => left + (width * t) / this.end;
    const y = (v) => top + height * (1 - (v - this.low) / (this.high - this.low));
    g.font = "11px system-ui, sans-serif";
    g.fillStyle = style.getPropertyValue("--faint");
    g.strokeStyle = style.getPropertyValue("--line");
    g.lineWidth = 1;
    for (const v of ticks(this.low, this.high, 5)) this.line(g, left, y(v), left + width, y(v), label(v), left - 6, y(v) + 4, "right");
    for (const t of ticks(0, this.end, 8)) this.line(g, x(t), top, x(t), top + height, label(t), x(t), top + height + 14, "center");
    g.save();
    g.beginPath();
    g.rect(left, top, width, height);
    g.clip();
    for (const trace of this.panel.traces) {
      g.strokeStyle = trace.colour;
      g.lineWidth = 1.3;
      g.setLineDash(trace.limit ? [5, 4] : []);
      g.beginPath();
      trace.values.forEach((v, i) => g.lineTo(x(this.panel.time[i]), y(v)));
      g.stroke();
    }
    g.setLineDash([]);
    g.strokeStyle = "#B8A500";
    for (const m of this.marks) this.line(g, x(m.time), top + height - 12, x(m.time), top + height);
    g.strokeStyle = style.getPropertyValue("--ink");
    this.line(g, x(now), top, x(now), top + height);
    g.restore();
    this.say(now);
  }

  line(g, x0, y0, x1, y1, text, tx, ty, align) {
    g.beginPath();
    g.moveTo(x0, y0);
    g.lineTo(x1, y1);
    g.stroke();
    if (text !== undefined) { g.textAlign = align; g.fillText(text, tx, ty); }
  }

  say(now) {
    const times = this.panel.time;
    let k = 0;
    while (k + 1 < times.length && times[k + 1] <= now) k++;
    this.names.replaceChildren(Object.assign(document.createElement("b"), { textContent: `${this.panel.title}  ` }));
    for (const t of this.panel.traces) {
      const value = Number(t.values[k]).toPrecision(4);
      const name = this.names.appendChild(Object.assign(document.createElement("span"), { textContent: `${t.label} ${value}` }));
      name.style.color = t.colour;
      this.names.append(" ");
    }
  }
}

function ticks(low, high, wanted) {
  const raw = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-12) && found.length < 20; k++) found.push(k * step || 0);
  return found;
}

const label = (v) => String(Number(v.toPrecision(4)));
