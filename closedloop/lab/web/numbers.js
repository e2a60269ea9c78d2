"use strict";
// Arrays from the page's data, and the little algebra that drawing needs. Matrices are by columns, as WebGL has them.

// A message of `closedloop.lab.drawn`: its header is JSON, in which arrays are named by where they begin.
function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true), begin = 4 + length;
  const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
  return JSON.parse(text, begin < buffer.byteLength ? (key, v) => {
    if (v && v.$f) return new Float32Array(buffer, begin + 4 * v.$f[0], v.$f[1]);
    if (v && v.$u) return new Uint32Array(buffer, begin + 4 * v.$u[0], v.$u[1]);
    return v;
  } : undefined);
}
const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

const $ = (id) => document.getElementById(id);
// A new element with properties, and children that are elements or text.
function make(tag, given = {}, ...children) {
  const found = Object.assign(document.createElement(tag), given);
  found.append(...children);
  return found;
}

// Colours of curves, which are made for white paper, as they are seen on dark paper.
const ON_DARK = { "#0072B2": "#4fb0ea", "#009E73": "#2fc796", "#D55E00": "#ff8a3d", "#56B4E9": "#b5e0ff", "#8A8A8A": "#a5adb5", "#7B61C4": "#a48cf0" };
let dark = false;
const tint = (colour) => (dark && ON_DARK[colour]) || colour;
const rgb = (colour) => `rgb(${colour.map((c) => Math.round(255 * c))})`;
// A colour that the style sheet names, as a canvas takes it.
const inks = new Map();
function ink(name) {
  if (!inks.has(name)) {
    const probe = document.body.appendChild(make("i"));
    probe.style.color = `var(${name})`;
    inks.set(name, getComputedStyle(probe).color);
    probe.remove();
  }
  return inks.get(name);
}
const small_print = () => `${innerWidth >= 2000 ? 13 : 11}px system-ui, sans-serif`; // in a canvas
// A text that fits into a width: without the section of its key, where it is too long with it.
const fitted = (g, text, width) => (g.measureText(text).width > width ? text.slice(text.indexOf(".") + 1) : text);
const short = (v, digits = 4) => (Number.isFinite(v) ? String(Number(v.toPrecision(digits))) : "-");

// Round values between low and high, about so many, but not more than a dozen.
function ticks(low, high, wanted) {
  wanted = Math.min(wanted, 12);
  const raw = (high - low) / wanted, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-12) + 1e-300 && found.length < 30; k++) found.push(Number((k * step).toPrecision(12)) || 0);
  return found.length < 2 && wanted < 16 ? ticks(low, high, 2 * wanted) : found; // one value alone shows no scale
}
// The labels of ticks: with as many digits as tell them apart, none cut off.
function labels(found) {
  if (found.length < 2) return found.map((v) => short(v));
  const most = Math.max(...found.map(Math.abs)), apart = Math.min(...found.slice(1).map((v, k) => Math.abs(v - found[k])));
  const digits = Math.min(Math.max(4, 1 + Math.floor(Math.log10(most / apart) + 1e-9) + 1), 12);
  return found.map((v) => {
    const plain = short(Math.abs(v) < 1e-9 * most ? 0 : v, digits);
    return plain.replace(/[-.]/g, "").length <= 7 ? plain : Number(v.toPrecision(digits)).toExponential().replace("e+", "e");
  });
}
// Of ticks along so many px those whose numbers have room one above the other: all, or the first and the last.
const few = (found, height) => (found.length > 2 && 13 * found.length > height ? [found[0], found[found.length - 1]] : found);
function logTicks(low, high) {
  const found = [];
  for (let p = Math.floor(Math.log10(low)); p <= Math.ceil(Math.log10(high)); p++) {
    for (const k of high / low > 100 ? [1] : [1, 2, 5]) found.push(k * 10 ** p);
  }
  return found.filter((v) => v >= low * (1 - 1e-9) && v <= high * (1 + 1e-9));
}

// The sizes of canvases on the page. They are not read again at each drawing: that would have the page laid out each time.
const sizes = new WeakMap();
const watched = new ResizeObserver((entries) => {
  let changed = false;
  for (const { target } of entries) {
    const was = sizes.get(target), now = [target.clientWidth, target.clientHeight];
    changed ||= was?.join() !== now.join();
    sizes.set(target, now);
  }
  if (changed) document.dispatchEvent(new Event("resized"));
});

// The pixels of a canvas for its place on the page; returns its context in CSS pixels, its width and height.
function sized(canvas) {
  if (!sizes.get(canvas)?.[0]) {
    sizes.set(canvas, [canvas.clientWidth, canvas.clientHeight]);
    watched.observe(canvas);
  }
  const dpr = window.devicePixelRatio || 1, [w, h] = sizes.get(canvas);
  const [pw, ph] = [Math.max(1, Math.round(w * dpr)), Math.max(1, Math.round(h * dpr))];
  const g = canvas.getContext("2d");
  if (canvas.width !== pw || canvas.height !== ph) [canvas.width, canvas.height] = [pw, ph];
  g.setTransform(dpr, 0, 0, dpr, 0, 0);
  g.clearRect(0, 0, w, h);
  return [g, w, h];
}

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const plus = (a, b, k = 1) => [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => a.map((x) => x / (norm(a) || 1));

function times(a, b) {
  const c = new Float32Array(16);
  for (let i = 0; i < 4; i++) {
    for (let j = 0; j < 4; j++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + i] * b[4 * j + k];
      c[4 * j + i] = sum;
    }
  }
  return c;
}

function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2);
  const k = 1 / (near - far);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * k, -1, 0, 0, 2 * far * near * k, 0]);
}

function lookAt(eye, at, up) {
  const z = unit(minus(eye, at));
  const x = unit(cross(up, z));
  const y = cross(z, x);
  return new Float32Array([
    x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1,
  ]);
}

// A rotation by the quaternion (w, x, y, z), then a displacement.
function place(w, x, y, z, px, py, pz) {
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
    px, py, pz, 1,
  ]);
}

// Axes whose third points along d, scaled, at p.
function along(p, d, across, length) {
  const z = unit(d);
  const x = unit(cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z));
  const y = cross(z, x);
  const [a, b, c] = [x, y, z].map((e, i) => e.map((v) => v * (i < 2 ? across : length)));
  return new Float32Array([...a, 0, ...b, 0, ...c, 0, ...p, 1]);
}
