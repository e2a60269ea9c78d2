"use strict";
// The replay: one instant, which the buttons, the slider, the plots and the clock move, and which all of them show.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const end = data.end, step = data.step;
const frames = { time: floats(data.frames.time), places: floats(data.frames.places), tails: floats(data.frames.tails), forces: floats(data.frames.forces) };
const state = { time: 0, playing: false, speed: 1 };

const space = new Space($("view"), data);
$("nospace").hidden = Boolean(space.gl);
document.querySelector("h1").textContent = data.title;
$("about").textContent = data.about;
$("stopped").hidden = !data.stopped;
$("stopped").textContent = data.stopped;
$("verdicts").textContent = data.verdicts.join("; ");
$("command").textContent = data.command;
$("scenario").textContent = data.scenario;
const marks = data.shapes.filter((s) => s.kind).map((s) => [s.kind, s.colour]);
const arrows = data.arrows.filter((a) => data.kinds.includes(a.kind));
for (const [name, colour] of new Map([...arrows.map((a) => [a.kind, a.colour]), ...marks, ...data.paths.map((p) => [p.name, p.colour])])) {
  const row = $("legend").appendChild(document.createElement("button"));
  row.title = "click: hide or show it";
  row.appendChild(document.createElement("i")).style.background = `rgb(${colour.map((c) => Math.round(255 * c))})`;
  row.append(data.meanings[name] ?? name);
  row.onclick = () => { row.classList.toggle("off", space.toggle(name)); space.draw(); };
}
$("legend").appendChild(document.createElement("span")).textContent = `10 N = ${Number((10 * data.metres_per_newton).toPrecision(2))} m`;
const plots = data.panels.map((p) => new Plot($("plots"), p, data.marks, seek));
for (const s of [0.01, 0.03, 0.1, 0.3, 1, 2, 4]) $("speed").appendChild(new Option(`${s}x`, s, s === 1, s === 1));
$("time").max = end;

function frameAt(time) {
  const count = frames.time.length, joints = data.joints;
  let k = Math.min(Math.max(Math.floor((time / (end || 1)) * (count - 1)), 0), Math.max(count - 2, 0));
  const next = Math.min(k + 1, count - 1);
  const gap = frames.time[next] - frames.time[k];
  const u = gap > 0 ? Math.min(Math.max((time - frames.time[k]) / gap, 0), 1) : 0;
  const mix = (array, width, at) => {
    const a = array.subarray(width * k + at[0], width * k + at[1]), b = array.subarray(width * next + at[0], width * next + at[1]);
    return Array.from(a, (x, i) => x + u * (b[i] - x));
  };
  const places = [];
  for (let j = 0; j < joints; j++) {
    const p = mix(frames.places, 7 * joints, [7 * j, 7 * j + 7]);
    const q = p.slice(0, 4), size = Math.hypot(...q) || 1;
    places.push(place(...q.map((x) => x / size), ...p.slice(4)));
  }
  const part = (array, i) => mix(array, 3 * data.arrows.length, [3 * i, 3 * i + 3]);
  const arrows = data.arrows.map((a, i) => ({ tail: part(frames.tails, i), force: part(frames.forces, i) }));
  return { places, arrows };
}

function show() {
  $("time").value = state.time;
  $("now").textContent = `${state.time.toFixed(3)} s`;
  $("play").textContent = state.playing ? "pause" : "play";
  space.show(frameAt(state.time));
  for (const plot of plots) plot.draw(state.time);
}

function seek(time) {
  state.playing = false;
  state.time = Math.min(Math.max(time, 0), end);
  show();
}

function play() {
  if (!state.playing && state.time >= end) state.time = 0;
  state.playing = !state.playing;
  last = performance.now();
  show();
}

function nextEvent() {
  const later = data.marks.map((m) => m.time).filter((t) => t > state.time + 1e-9);
  if (data.marks.length) seek(later.length ? Math.min(...later) : Math.min(...data.marks.map((m) => m.time)));
}

let last = performance.now();
function tick(now) {
  if (state.playing) {
    state.time += ((now - last) / 1000) * state.speed;
    if (state.time >= end) {
      state.playing = $("loop").checked;
      state.time = state.playing && end > 0 ? state.time % end : end;
    }
    show();
  }
  last = now;
  requestAnimationFrame(tick);
}

$("play").onclick = play;
$("back").onclick = () => seek(state.time - step);
$("on").onclick = () => seek(state.time + step);
$("event").onclick = nextEvent;
$("event").disabled = !data.marks.length;
$("time").oninput = () => seek(Number($("time").value));
$("speed").onchange = () => { state.speed = Number($("speed").value); };
document.addEventListener("keydown", (e) => {
  if (["INPUT", "SELECT"].includes(e.target.tagName) && e.target.type !== "range") return;
  const act = { " ": play, ArrowLeft: () => seek(state.time - step), ArrowRight: () => seek(state.time + step), e: nextEvent }[e.key];
  if (act) { e.preventDefault(); act(); }
});
new ResizeObserver(show).observe(document.body);
show();
requestAnimationFrame(tick);
