"use strict";
// The robot, the surface, the paths and the forces in space. Drag turns, the wheel zooms, Shift and drag shifts, Ctrl and
// drag pulls at what is below the pointer.
// Two views: of the contact, with the whole arm as an inset, and of the whole arm.

// A picture that takes longer, ms, was drawn without a graphics processor: the runs need the processor more.
const SLOW = 15;
// While a slider is moved such pictures take no larger part of the time than one over this.
const SHARE = 20;
const ANGLE = 0.7, SAMPLES = 4, RED = [0.85, 0.15, 0.1], SEEN_THROUGH = 0.3;
const LIFT = 0.2; // of white in all shapes, on dark paper
// The longest usual arrow, and the longest of all, as shares of the view's radius.
const USUAL = 0.6, MOST = 1.1;
const PULL = [0.48, 0.38, 0.77]; // as forces from outside, `closedloop.figures.scene.scene.ARROWS`
const SHOWN = { "contact force": "f", friction: "friction", "commanded force": "commanded", "external force": "outside" };

class Space {
  constructor(canvas, labels, pull) {
    Object.assign(this, { canvas, labels, pull, pulls: false, held: null });
    this.hidden = new Set();
    this.drawing = new Drawing(canvas);
    this.gl = this.drawing.gl;
    this.whole = false;
    this.clear = true;
    this.covered = [0, 0]; // px, height and right end of the legend
    this.views = null;
    if (this.gl) this.listen();
    canvas.addEventListener("webglcontextlost", (e) => e.preventDefault()); // the browser gives another one later
    canvas.addEventListener("webglcontextrestored", () => this.begin_again());
  }

  // All that was drawn with has been lost with the graphics processor: make it again.
  begin_again() {
    const { views, about, scene } = this;
    this.drawing = new Drawing(this.canvas);
    this.waits = false;
    if (about) this.robot(about);
    this.views = views;
    if (scene) this.space(scene);
    this.draw();
  }

  // Show another robot.
  robot(message) {
    if (!this.gl) return;
    for (const s of this.shapes ?? []) this.drawing.free(s.mesh);
    this.about = message;
    this.shapes = message.shapes.map((s) => ({ ...s, mesh: this.drawing.mesh(s.vertices, s.faces) }));
    this.views = null;
  }

  // Show another run of it. The views stay where they are, unless the robot is another.
  space(message) {
    if (!this.gl) return;
    const d = this.drawing, scene = this.scene;
    d.free(this.surface);
    for (const p of this.paths ?? []) d.free(p.mesh);
    this.scene = message;
    this.surface = message.surface.faces.length ? d.mesh(message.surface.vertices, message.surface.faces) : null;
    const same = scene && norm(minus(scene.near.centre, message.near.centre)) < 0.5 * message.near.radius;
    if (!this.views || !same) this.fit();
    const thick = 0.012 * message.near.radius;
    this.paths = message.paths.map((p) => ({ ...p, mesh: d.tube(p.points, p.name === "desired path" ? 0.7 * thick : thick) }));
    this.red = new Set(message.passing?.joints ?? []);
  }

  // The views as they are at first: of the contact from where the surface is seen, of all from the front.
  fit() {
    const { near, whole, normal: n } = this.scene;
    const side = unit(Math.abs(n[2]) > 0.9 ? [0.75, -0.65, 0] : cross(n, [0, 0, 1]));
    const from = unit(plus(plus([0, 0, 0.35], side, 0.9), n, Math.abs(n[2]) > 0.9 ? 0.12 : 0.6));
    const at = (v, d) => ({ turn: Math.atan2(d[1], d[0]), rise: Math.asin(d[2]), far: 3.1 * v.radius, centre: Array.from(v.centre), radius: v.radius });
    this.views = [at(near, from), at(whole, unit([0.85, -0.55, 0.4]))];
  }

  view() { return this.views[this.whole ? 1 : 0]; }

  listen() {
    const c = this.canvas, held = new Map();
    let spread = 0;
    c.addEventListener("pointerdown", (e) => {
      held.set(e.pointerId, e);
      c.setPointerCapture(e.pointerId);
      spread = 0;
      this.held = (this.pulls || e.ctrlKey || e.metaKey) && held.size === 1 ? this.below(e) : null;
    });
    for (const end of ["pointerup", "pointercancel"]) c.addEventListener(end, (e) => { held.delete(e.pointerId); this.let_go(); });
    c.addEventListener("pointermove", (e) => {
      const last = held.get(e.pointerId);
      if (!last || !this.views) return;
      const [dx, dy] = [e.clientX - last.clientX, e.clientY - last.clientY], v = this.view();
      held.set(e.pointerId, e);
      if (this.held) { this.drag(e); return; }
      if (held.size === 2) {
        const [a, b] = [...held.values()];
        const now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) v.far *= spread / now;
        spread = now;
      } else if (e.shiftKey || e.buttons === 2) {
        const [x, y] = this.screen(v), k = v.far / c.clientHeight;
        v.centre = plus(plus(v.centre, x, -dx * k), y, dy * k);
      } else {
        v.turn -= 0.008 * dx;
        v.rise = Math.min(1.5, Math.max(-1.5, v.rise + 0.008 * dy));
      }
      this.draw();
    });
    c.addEventListener("contextmenu", (e) => e.preventDefault());
    c.addEventListener("wheel", (e) => { e.preventDefault(); if (this.views) { this.view().far *= Math.exp(0.001 * e.deltaY); this.draw(); } }, { passive: false });
  }

  // The point of the robot below the pointer, with its joint, in that joint's axes and in those of the base; null: none.
  below(e) {
    const { eye, way } = this.ray(e), at = { t: Infinity };
    for (const s of this.frame ? this.shapes : []) {
      if (s.kind || !s.joint) continue;
      const m = this.frame.places[s.joint], turn = (d) => [0, 4, 8].map((k) => m[k] * d[0] + m[k + 1] * d[1] + m[k + 2] * d[2]);
      const from = turn(minus(eye, [m[12], m[13], m[14]])), d = turn(way), t = nearest_hit(s.vertices, s.faces, from, d);
      if (t < at.t) Object.assign(at, { t, joint: s.joint, at: plus(from, d, t), place: plus(eye, way, t) });
    }
    return at.t < Infinity ? at : null;
  }

  // Where a pointer looks from, and the way, base axes.
  ray(e) {
    const box = this.canvas.getBoundingClientRect(), v = this.view(), aspect = box.width / box.height;
    const eye = this.eye(v, v.far / Math.min(1, aspect)), k = Math.tan(ANGLE / 2), [x, y] = this.screen(v);
    const [right, up] = [(2 * (e.clientX - box.left)) / box.width - 1, 1 - (2 * (e.clientY - box.top)) / box.height];
    return { eye, way: plus(plus(unit(minus(v.centre, eye)), x, k * aspect * right), y, k * up) };
  }

  // The pull goes from the point that is held to the pointer, as far from the eye; its arrow has the scale of all others.
  drag(e) {
    const { eye, way } = this.ray(e), v = this.view(), ahead = unit(minus(v.centre, eye)), held = this.held;
    const to = plus(eye, way, dot(minus(held.place, eye), ahead) / dot(way, ahead)), k = this.scale(v);
    const first = !held.force;
    held.force = minus(to, held.place).map((d) => d / k);
    this.pull({ ...held, first });
  }

  let_go() {
    if (this.held?.force) this.pull({ ...this.held, last: true });
    this.held = null;
  }

  eye(v, far = v.far) {
    const r = Math.cos(v.rise);
    return plus(v.centre, [r * Math.cos(v.turn), r * Math.sin(v.turn), Math.sin(v.rise)], far);
  }

  screen(v) {
    const z = unit(minus(this.eye(v), v.centre)), x = unit(cross([0, 0, 1], z));
    return [x, cross(z, x)];
  }

  camera(v, aspect) {
    const far = v.far / Math.min(1, aspect);
    return times(perspective(ANGLE, aspect, 0.02 * far, 30 * far), lookAt(this.eye(v, far), v.centre, [0, 0, 1]));
  }

  // Metres for a newton in a view, round.
  scale(v) {
    const raw = (USUAL * v.radius) / (this.scene.usual || 1), power = 10 ** Math.floor(Math.log10(raw));
    return [5, 2, 1].map((k) => k * power).find((k) => k <= raw * (1 + 1e-9));
  }

  // Show an instant, as soon as the page has time for it.
  show(frame) {
    this.frame = frame;
    this.draw();
  }

  // Without a graphics processor a picture takes a tenth of a second: the next waits until the last is done.
  draw() {
    if (!this.gl || !this.frame || !this.scene || this.waits) return;
    this.waits = true;
    this.asked = performance.now();
    this.wait();
  }

  // Where pictures are slow they wait until the run asked for is there and the slider rests, but no longer than 0.7 s,
  // or so long that they take a small part of the time: then a coarse one is drawn, in a third of the time, and the next
  // once the slider rests.
  wait() {
    const now = performance.now(), slow = this.calm && this.cost > SLOW, rest = slow ? this.calm + 200 - now : 0;
    const left = slow ? Math.min(rest, this.asked + Math.max(700, SHARE * (this.coarse ?? 0)) - now) : 0;
    if (left > 1) { setTimeout(() => this.wait(), Math.min(left, 200)); return; }
    const coarse = rest > 1;
    requestAnimationFrame(() => {
      const texts = this.paint(coarse), drawing = this.drawing;
      drawing.finished((took) => {
        if (coarse) this.coarse = took; else this.cost = took;
        requestAnimationFrame(() => {
          if (drawing !== this.drawing) return; // lost meanwhile
          drawing.present();
          this.labels.replaceChildren(...texts);
          this.waits = false;
          if (coarse || this.again) { this.again = false; this.draw(); }
        });
      });
    });
  }

  // A slider is being moved, and a run is asked for, which may take a while; or it is there.
  moved() { this.calm = performance.now() + 2000; }
  answered() { this.calm = performance.now(); }

  // Draw the frame, coarsely or well; return its texts.
  paint(coarse) {
    const c = this.canvas, dpr = Math.min(window.devicePixelRatio || 1, 2);
    const [w, h] = [Math.max(1, Math.round(c.clientWidth * dpr)), Math.max(1, Math.round(c.clientHeight * dpr))];
    const v = this.view(), camera = this.camera(v, w / h);
    this.drawing.picture(w, h, coarse ? 0 : SAMPLES);
    this.part(0, 0, w, h, camera, v, true);
    const inset = $("inset");
    if (inset) inset.hidden = true;
    if (!this.whole && w > 300 * dpr && h > 220 * dpr) {
      const size = Math.round(0.3 * Math.min(w, h)), other = this.views[1];
      if (inset) Object.assign(inset, { hidden: false }).style.cssText = `width:${size / dpr}px;height:${size / dpr}px`;
      this.part(8 * dpr, h - size - 8 * dpr, size, size, this.camera(other, 1), other, false);
    }
    return this.texts(camera, v);
  }

  part(x, y, w, h, camera, v, arrows) {
    const d = this.drawing, still = place(1, 0, 0, 0, 0, 0, 0), f = this.frame;
    d.begin(x, y, w, h, camera);
    const through = [];
    for (const s of this.shapes.filter((s) => !this.hidden.has(s.kind))) {
      const colour = (this.red.has(s.joint) ? RED : s.colour).map((c) => (dark ? LIFT + (1 - LIFT) * c : c));
      if (s.opacity || (this.clear && arrows && this.about.clear.includes(s.joint))) through.push([s, colour]);
      else d.put(s.mesh, f.places[s.joint], [...colour, 1], 1);
    }
    for (const p of this.paths.filter((p) => !this.hidden.has(p.name))) d.put(p.mesh, still, [...p.colour, 1], 0);
    if (arrows) this.arrows(v, 1);
    d.blend(true);
    for (const [s, colour] of through) d.put(s.mesh, f.places[s.joint], [...colour, s.opacity ?? SEEN_THROUGH], 1);
    const ground = this.scene.passing?.surface ? [0.8, 0.45, 0.4, 0.5] : dark ? [0.45, 0.5, 0.55, 0.5] : [0.6, 0.66, 0.72, 0.5];
    if (this.surface) d.put(this.surface, f.places[this.about.ground], ground, 1);
    d.blend(true, true);
    if (arrows) this.arrows(v, 0.3); // through the arm, where that hides them
    d.blend(false);
  }

  // Call with each arrow to be drawn, that of a pull under way the last, and its vector, m, which is cut short if need be.
  each_arrow(v, act) {
    const k = this.scale(v), most = MOST * v.radius;
    const found = this.frame.arrows.map((a, i) => ({ ...a, ...this.scene.arrows[i] }));
    if (this.held?.force) found.push({ kind: "pull", name: "pull pull", colour: PULL, tail: this.held.place, force: this.held.force });
    for (const a of found) {
      const length = k * norm(a.force);
      if (!this.hidden.has(a.kind) && length > 0) act(a, a.force.map((x) => (x * Math.min(length, most)) / norm(a.force)));
    }
  }

  arrows(v, opacity) {
    this.each_arrow(v, (a, d) => this.drawing.arrow(a.tail, d, v.radius, [...a.colour, opacity]));
  }

  // The names and sizes of the forces, to be put beside their arrows where there is room.
  texts(camera, v) {
    const spans = [], taken = [];
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.each_arrow(v, (a, d) => {
      const name = SHOWN[a.kind] ?? `${a.name.slice(a.kind.length + 1)}:`;
      if (norm(d) < 0.04 * v.radius) return;
      const [x, y, , k] = [0, 1, 2, 3].map((r) => [...plus(a.tail, d), 1].reduce((sum, e, j) => sum + camera[4 * j + r] * e, 0));
      if (k <= 0) return;
      const text = `${name} ${short(norm(a.force), 3)} N`, wide = 8 * text.length + 14;
      let [left, top] = [(50 * (x / k + 1) * w) / 100, (50 * (1 - y / k) * h) / 100];
      if (left + wide > w) left -= wide + 7; // beside the arrow on its other side
      if (left < this.covered[1]) top = Math.min(top, h - this.covered[0] - 9); // above the legend
      if (taken.some(([l, t, r]) => Math.abs(t - top) < 13 && left < r && l < left + wide)) return; // one on another is unreadable
      taken.push([left, top, left + wide]);
      const span = make("span", { textContent: text.trim() });
      span.style.cssText = `left:${left}px;top:${top}px;color:${tint_rgb(a.colour)}`;
      spans.push(span);
    });
    return spans;
  }

  // Hide what is called so, or show it again; return whether it is hidden now.
  toggle(name) {
    if (!this.hidden.delete(name)) this.hidden.add(name);
    return this.hidden.has(name);
  }
}

const tint_rgb = (colour) => rgb(dark ? colour.map((c) => 0.35 + 0.65 * c) : colour.map((c) => 0.85 * c));

// How far along a ray, from `o` along `d`, the nearest triangle is: Moeller and Trumbore.
function nearest_hit(vertices, faces, o, d) {
  const corner = (k) => [vertices[3 * k], vertices[3 * k + 1], vertices[3 * k + 2]];
  let nearest = Infinity;
  for (let k = 0; k < faces.length; k += 3) {
    const a = corner(faces[k]), u = minus(corner(faces[k + 1]), a), v = minus(corner(faces[k + 2]), a), p = cross(d, v), det = dot(u, p);
    if (!det) continue;
    const s = minus(o, a), q = cross(s, u), x = dot(s, p) / det, y = dot(d, q) / det, t = dot(v, q) / det;
    if (x >= 0 && y >= 0 && x + y <= 1 && t > 0 && t < nearest) nearest = t;
  }
  return nearest;
}
