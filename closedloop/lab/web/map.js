"use strict";
// A value of the run over two keys. A click or a drag goes to the runs below the pointer.

// Cividis, which colour-blind readers see as others do: at nine places from the least value to the greatest.
const CIVIDIS = [[0, 34, 78], [18, 53, 112], [59, 73, 108], [87, 93, 109], [112, 113, 115], [138, 134, 120], [165, 156, 116], [195, 179, 105], [254, 232, 56]];
function cividis(u) {
  const k = Math.min(Math.max(u, 0), 1) * (CIVIDIS.length - 1), i = Math.min(Math.floor(k), CIVIDIS.length - 2);
  return CIVIDIS[i].map((c, j) => Math.round(c + (k - i) * (CIVIDIS[i + 1][j] - c)));
}
const MAP = [58, 24, 64, 34]; // px left, above, right at least, below
const BAR = 21; // px from the map to the numbers beside its colours

class MapTab {
  constructor(send, change) {
    this.send = send;
    this.change = change;
    [this.x, this.y, this.value] = ["across", "up", "value"].map((name) => {
      const select = make("select", { title: name });
      select.setAttribute("aria-label", `map: ${name}`);
      return select;
    });
    this.start = make("button", { textContent: "compute", id: "compute" });
    this.start.onclick = () => {
      const running = this.running;
      if (!running) this.busy(true);
      this.send(running ? { do: "stop map" } : { do: "map", x: this.x.value, y: this.y.value, quantity: this.value.value });
    };
    this.said = make("p", { className: "hint", textContent: "A value of the run over two keys: choose them and press compute. A click or a drag in the map then loads its runs." });
    this.said.setAttribute("aria-live", "polite");
    this.canvas = make("canvas", { className: "chart", id: "map", tabIndex: 0, hidden: true });
    this.canvas.style.cursor = "crosshair";
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "map: not computed yet");
    this.element = make("div", { className: "fill" }, make("div", { className: "bar" }, this.x, this.y, this.value, this.start), this.canvas, this.said);
    this.listen();
  }

  keys(m) {
    for (const [select, chosen, names] of [[this.x, m.x, m.names], [this.y, m.y, m.names], [this.value, m.quantity, m.quantities]]) {
      const kept = select.value && names.includes(select.value) ? select.value : chosen;
      select.replaceChildren(...names.map((n) => new Option(n.replace(/^law\./, "").replaceAll("_", " "), n)));
      select.value = kept;
    }
  }

  show(m) {
    this.m = m;
    this.line = null;
    this.canvas.hidden = false;
    this.busy(!m.complete);
    this.said.textContent = m.line;
    this.shown();
  }

  busy(running) {
    this.running = running;
    this.start.textContent = running ? "stop" : "compute";
    if (this.m) this.m.complete = !running;
  }

  say(line, refused) {
    this.said.textContent = line;
    if (refused) this.busy(false);
  }

  boundary(m) {
    this.line = m;
    this.said.textContent = m.line;
    this.shown();
  }

  // Where the run of now is; `stale` is the key by which it differs from the runs of the map.
  here(point, stale) {
    const moved = JSON.stringify(this.point) !== JSON.stringify(stale ? null : point);
    this.point = stale ? null : point;
    this.canvas.classList.toggle("late", Boolean(this.m && stale));
    if (stale && !this.running) this.said.textContent = `These runs have another ${stale}: press compute.`;
    else if (this.stale && this.m) this.said.textContent = this.line?.line ?? this.m.line;
    this.stale = stale;
    if (this.m && moved) this.again();
  }

  listen() {
    const c = this.canvas;
    let down = false;
    const go = (e, last) => {
      const [u, v] = this.share(e.offsetX, e.offsetY);
      this.change({ do: "point", u, v, last });
    };
    c.addEventListener("pointerdown", (e) => { if (this.m && this.inside(e)) { down = true; c.setPointerCapture(e.pointerId); go(e, false); } });
    c.addEventListener("pointermove", (e) => { if (down) go(e, false); else this.tell(e); });
    c.addEventListener("pointerup", (e) => { if (down) { down = false; go(e, true); } });
    c.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
      if (!step || !this.m || !this.point) return;
      e.preventDefault();
      e.stopPropagation();
      const at = [this.m.x, this.m.y].map((axis, i) => Math.min(Math.max(this.along(axis, this.point[i]) + step[i] / axis.values.length, 0), 1));
      this.change({ do: "point", u: at[0], v: at[1], last: true });
    });
  }

  area() {
    const [l, t, r, b] = MAP;
    return [l, t, this.canvas.clientWidth - l - Math.max(r, this.beside ?? 0), this.canvas.clientHeight - t - b];
  }

  inside(e) { const [l, t, w, h] = this.area(); return e.offsetX >= l && e.offsetX <= l + w && e.offsetY >= t && e.offsetY <= t + h; }

  share(x, y) {
    const [l, t, w, h] = this.area(), clip = (u) => Math.min(Math.max(u, 0), 1);
    return [clip((x - l) / w), clip(1 - (y - t) / h)];
  }

  // Where a value is along an axis, 0 to 1: cells are equally wide, their values are those of their middles.
  along(axis, value) {
    const f = axis.log ? Math.log : (x) => x, n = axis.values.length, v = axis.values;
    if (n < 2) return 0.5;
    let k = 0;
    while (k < n - 2 && v[k + 1] <= value) k++;
    return (k + 0.5 + (f(value) - f(v[k])) / (f(v[k + 1]) - f(v[k]))) / n;
  }

  tell(e) {
    if (!this.m) return;
    const [u, v] = this.share(e.offsetX, e.offsetY), { x, y } = this.m;
    const [i, j] = [Math.min(Math.floor(u * x.values.length), x.values.length - 1), Math.min(Math.floor(v * y.values.length), y.values.length - 1)];
    const value = this.m.grid[j * x.values.length + i], state = this.m.state[j * x.values.length + i];
    this.canvas.title = `${x.label} = ${short(x.values[i])}, ${y.label} = ${short(y.values[j])}: ${Number.isFinite(value) ? `${this.m.quantity} ${short(value)} ${this.m.unit}` : state === 2 ? "refused or stopped" : "not computed yet"}${state === 1 ? "; the control is not good" : ""}`;
  }

  shown() {
    const [g, w, h] = sized(this.canvas), m = this.m;
    if (w < 60) return;
    g.font = small_print();
    g.fillStyle = ink("--faint");
    if (!m) return;
    let [low, high] = [Infinity, -Infinity];
    for (const v of m.grid) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
    const log = low > 0 && high > 100 * low, f = log ? Math.log : (x) => x;
    const digits = 3 + Math.max(0, Math.floor(Math.log10(Math.abs(high) / (high - low)))) || 3;
    const numbers = high > low ? (log ? logTicks(low, high) : ticks(low, high, h / 45)).map((v) => [v, short(v, digits)]) : [];
    this.beside = BAR + 4 + Math.max(0, ...numbers.map(([, text]) => g.measureText(text).width));
    const [l, t, width, height] = this.area(), [nx, ny] = [m.x.values.length, m.y.values.length];
    const colour = (v) => `rgb(${cividis(high > low ? (f(v) - f(low)) / (f(high) - f(low)) : 0.5)})`;
    const [cw, ch] = [width / nx, height / ny];
    const known = (i, j) => { // while it fills in, cells show the nearest that is known
      for (const step of [1, 2, 4, 8]) {
        const k = (j - (j % step)) * nx + i - (i % step);
        if (Number.isFinite(m.grid[k]) || (step === 1 && m.state[k] === 2)) return k;
      }
      return -1;
    };
    g.fillStyle = ink("--line");
    g.fillRect(l, t, width, height);
    for (let j = 0; j < ny; j++) {
      for (let i = 0; i < nx; i++) {
        const k = known(i, j);
        if (k < 0 || !Number.isFinite(m.grid[k])) continue;
        g.fillStyle = colour(m.grid[k]);
        g.fillRect(l + i * cw, t + height - (j + 1) * ch, cw + 0.6, ch + 0.6);
      }
    }
    this.frontier(g, l, t + height, cw, ch, nx, ny);
    g.fillStyle = ink("--faint");
    g.strokeStyle = ink("--faint");
    g.textAlign = "center";
    const range = (axis) => [axis.values[0], axis.values[axis.values.length - 1]];
    const marks = (axis, count) => (axis.log ? logTicks(...range(axis)) : ticks(...range(axis), count));
    const [across, up] = [marks(m.x, width / 60), marks(m.y, height / 40)], texts = [across, up].map(labels);
    across.forEach((v, k) => { const x = l + width * this.along(m.x, v); g.fillRect(x, t + height, 1, 4); g.fillText(texts[0][k], x, t + height + 15); });
    const title = `${m.quantity.replaceAll("_", " ")}${m.unit ? ` [${m.unit}]` : ""}`;
    g.fillText(title, Math.min(l + width / 2, w - g.measureText(title).width / 2), 13);
    g.fillText(fitted(g, m.x.label, w), Math.min(l + width / 2, w - g.measureText(fitted(g, m.x.label, w)).width / 2), h - 4);
    g.textAlign = "right";
    up.forEach((v, k) => { const y = t + height * (1 - this.along(m.y, v)); g.fillRect(l - 4, y, 4, 1); g.fillText(texts[1][k], l - 7, y + 4, l - 25); });
    g.save();
    g.translate(11, h / 2);
    g.rotate(-Math.PI / 2);
    g.textAlign = "center";
    g.fillText(fitted(g, m.y.label, h), 0, 0);
    g.restore();
    if (high > low) {
      for (let k = 0; k < height; k++) { g.fillStyle = `rgb(${cividis(1 - k / height)})`; g.fillRect(l + width + 8, t + k, 10, 1.5); }
      g.fillStyle = ink("--faint");
      g.textAlign = "left";
      for (const [v, text] of numbers) g.fillText(text, l + width + BAR, t + height * (1 - (f(v) - f(low)) / (f(high) - f(low))) + 4);
    }
    if (high === low) {
      g.fillStyle = "#fff";
      g.textAlign = "center";
      g.fillText(`${short(low)} ${m.unit} in every run`, l + width / 2, t + 16);
    }
    this.under = make("canvas", { width: this.canvas.width, height: this.canvas.height });
    this.under.getContext("2d").drawImage(this.canvas, 0, 0);
    this.overlay(g, l, t, width, height);
    this.canvas.setAttribute("aria-label", `map of ${m.quantity} over ${m.x.label} and ${m.y.label}; arrow keys move the run`);
  }

  // Draw the ring elsewhere. The cells are as they were: to draw them again takes as long as all curves.
  again() {
    const [g, w, h] = sized(this.canvas);
    if (this.under?.width !== this.canvas.width || this.under.height !== this.canvas.height) { this.shown(); return; }
    g.drawImage(this.under, 0, 0, w, h);
    this.overlay(g, ...this.area());
  }

  // The line between cells whose control is good and the others.
  frontier(g, left, bottom, cw, ch, nx, ny) {
    const { state } = this.m, bad = (i, j) => state[j * nx + i] > 0;
    g.beginPath();
    for (let j = 0; j < ny; j++) {
      for (let i = 0; i < nx; i++) {
        if (Number.isNaN(state[j * nx + i])) continue;
        const x = left + i * cw, y = bottom - j * ch;
        if (i + 1 < nx && !Number.isNaN(state[j * nx + i + 1]) && bad(i, j) !== bad(i + 1, j)) { g.moveTo(x + cw, y); g.lineTo(x + cw, y - ch); }
        if (j + 1 < ny && !Number.isNaN(state[(j + 1) * nx + i]) && bad(i, j) !== bad(i, j + 1)) { g.moveTo(x, y - ch); g.lineTo(x + cw, y - ch); }
      }
    }
    g.strokeStyle = "#ffffff";
    g.lineWidth = 1.6;
    g.setLineDash([3, 2]);
    g.stroke();
    g.setLineDash([]);
    g.lineWidth = 1;
  }

  overlay(g, l, t, width, height) {
    const m = this.m, at = (u, v) => [l + width * u, t + height * (1 - v)];
    g.save();
    g.beginPath();
    g.rect(l, t, width, height);
    g.clip();
    if (this.line?.x) {
      g.strokeStyle = "#ff5a36";
      g.lineWidth = 2.2;
      g.beginPath();
      this.line.x.forEach((x, i) => g.lineTo(...at(this.along(m.x, x), this.along(m.y, this.line.y[i]))));
      g.stroke();
    }
    if (this.point) {
      const [x, y] = at(this.along(m.x, this.point[0]), this.along(m.y, this.point[1]));
      for (const [colour, wide] of [["#ffffff", 4], ["#D55E00", 2]]) {
        g.strokeStyle = colour;
        g.lineWidth = wide;
        g.beginPath();
        g.arc(x, y, 6, 0, 7);
        g.moveTo(x - 11, y); g.lineTo(x - 6, y); g.moveTo(x + 6, y); g.lineTo(x + 11, y);
        g.moveTo(x, y - 11); g.lineTo(x, y - 6); g.moveTo(x, y + 6); g.lineTo(x, y + 11);
        g.stroke();
      }
    }
    g.restore();
  }
}
