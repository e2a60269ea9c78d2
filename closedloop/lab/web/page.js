"use strict";
// The page: with data inside it shows a run, without it follows a server. One instant is the replay's, which the buttons,
// the slider, the curves and the clock move.

const COLUMN = "column ";
const state = { time: 0, begin: 0, end: 1, step: 1e-3, playing: false, speed: 1 };
const embedded = $("data").textContent.split("\n").filter(Boolean);
let socket = null, frames = null, counts = null, still = null, run = null, late = 0, pulled = 0;

// What one press of the pointer changes is one step of undo: messages say which it is, until a key is pressed.
let press = null, presses = 0;
document.addEventListener("pointerdown", () => { press = ++presses; }, true);
document.addEventListener("keydown", () => { press = null; }, true);

function send(message) { if (socket?.readyState === 1) socket.send(JSON.stringify({ ...message, t: state.time, press })); }

function change(message) {
  space.moved();
  clearTimeout(late);
  late = setTimeout(() => { $("plots").classList.add("late"); say("computing ...; what is shown is the run before"); }, 400);
  send(message);
}

const space = new Space($("view"), $("labels"), ({ joint, at, force, first, last }) => {
  if (state.playing) seek(state.time);
  if (first) pulled = state.time; // it stays the instant of this pull
  change({ do: "pull", joint, at, force, start: pulled, first: Boolean(first), last: Boolean(last) });
  draw_space();
});
const plots = new Plots($("plots"), {
  seek, window: (range) => send({ do: "window", range }),
  extra: (name) => name.startsWith(COLUMN), close: (name) => show_columns(extras.filter((n) => COLUMN + n !== name)),
});
const controls = new Controls($("groups"), $("doc"), change);
controls.busy = () => performance.now() - (space.calm ?? -1e9) < 600;
const map = new MapTab(send, change);
const analysis = new Analysis(send, () => state.time), compare = new Compare(), events = new Events(seek), words = new Words();
const gallery = new Gallery($("cards"), send);
const tabs = new Tabs(document.querySelector("[role=tablist]"), $("pane"), {
  map: { title: "map", element: map.element, shown: () => map.shown() },
  analysis: { title: "analysis", element: analysis.element, shown: () => analysis.shown() },
  compare: { title: "compare", element: compare.element },
  events: { title: "events", element: events.element },
  scenario: { title: "scenario", element: words.element },
});
let extras = [], panels = [];
$("nospace").hidden = Boolean(space.gl);

const on = {
  hello(m) {
    document.body.classList.toggle("still", !m.live);
    document.querySelector("h1").textContent = m.title;
    document.title = m.title;
    $("about").textContent = $("about").title = m.about;
    words.show(m);
    for (const name of ["map", "analysis", "compare"]) tabs.tabs[name].button.hidden = !m.live;
    if (!tabs.name || (!m.live && ["map", "analysis", "compare"].includes(tabs.name))) tabs.open(m.live ? "map" : "events");
    if (m.fresh) { tabs.used = false; plots.window = null; plots.hidden.clear(); Object.assign(state, { time: 0, playing: false }); still = frames = null; map.m = map.line = map.point = null; map.canvas.hidden = true; tabs.open("map"); }
  },
  run(m) {
    run = m;
    clearTimeout(late);
    $("plots").classList.remove("late");
    Object.assign(state, { begin: m.begin, end: m.end, step: m.step });
    const wanted = state.kept ?? state.time; // of a part of a run there may be no such instant yet
    state.kept = m.partial ? wanted : null;
    state.time = m.follow ? m.end : Math.min(Math.max(wanted, m.begin), Math.max(m.end, m.begin));
    panels = m.panels;
    if (!socket) m.panels = pick(m.panels);
    plots.now = state.time;
    plots.show(m);
    show_stopped(m);
    if (!m.partial) space.answered();
    $("time").max = m.end;
    $("time").min = m.begin;
    $("event").disabled = !m.marks.length;
    events.show(m);
    offer_columns(m.columns);
    if (m.line) say(m.line, m.loud);
    show_instant(false);
    map.here(m.point, m.stale);
    send({ do: "shown", n: m.n });
    document.dispatchEvent(new CustomEvent("drawn", { detail: { n: m.n, partial: m.partial } }));
  },
  frame(m) { if (m.robot === space.about?.robot) { still = m; frames = null; draw_space(); } },
  strip(m) {
    $("strip").replaceChildren(...m.tiles.map(tile));
    const red = m.tiles.filter((t) => t.good === false && t.why); // why, beside the tiles
    $("why").hidden = !red.length;
    $("why").replaceChildren(...red.map((t) => make("span", { title: t.why }, make("b", { textContent: t.name }), ` ${t.why}`)));
  },
  robot(m) {
    space.robot(m);
    counts = m.joints;
    frames = null;
  },
  space(m) {
    space.space(m);
    frames = m.frames;
    legend(m);
    draw_space();
  },
  controls(m) {
    controls.show(m);
    $("undo").disabled = !m.undo;
    $("redo").disabled = !m.redo;
    $("again").disabled = !m.changed;
    words.show(m);
  },
  fault(m) {
    clearTimeout(late);
    $("plots").classList.remove("late");
    controls.fault(m.key, m.line);
    if (m.line) space.answered();
    if (m.line) say(`not run: ${m.line}`, true);
  },
  status(m) { say(m.line, m.loud); },
  pins(m) {
    plots.pins = m.pins;
    $("unpin").hidden = !m.pins.length;
    if (run) plots.show(run);
  },
  map_keys(m) { map.keys(m); },
  map(m) { map.show(m); },
  map_said(m) { map.say(m.line, m.refused); },
  boundary(m) { map.boundary(m); },
  tab(m) { if (tabs.name === "map" && !map.m && !tabs.used) tabs.open(m.name); }, // no map begins by itself
  point(m) { map.here(m.at, m.stale); },
  analysis(m) { analysis.show(m); },
  compare(m) { compare.show(m); },
  gallery(m) { gallery.list(m); if (m.front) { gallery.asked = true; gallery.parent.hidden = false; } },
  picture(m) { gallery.picture(m); },
  goodbye(m) { gone(m.line); },
};

function say(line, loud = false) {
  $("status").textContent = $("status").title = line;
  $("status").classList.toggle("loud", Boolean(loud));
}

function gone(line) {
  $("gone").textContent = line;
  $("gone").hidden = false;
  clearTimeout(late);
}

function show_stopped(m) {
  $("stopped").hidden = !m.stopped;
  $("stopped").textContent = m.stopped;
}

function tile(t) {
  const kind = t.good === true ? "good" : t.good === false ? "bad" : "";
  const found = make(Number.isFinite(t.at) && t.at !== null ? "button" : "div", { className: `tile ${kind}`, title: t.hint },
    make("small", { textContent: t.name }), make("b", { textContent: t.text }), make("i", { textContent: t.unit ? ` ${t.unit}` : "" }));
  if (t.change) found.append(make("i", { className: t.better === undefined ? "" : t.better ? "good" : "bad", textContent: ` ${t.change}`, title: `against ${t.against}: ${t.better === undefined ? "equal" : t.better ? "better" : "worse"}` }));
  found.setAttribute("role", "listitem");
  if (found.tagName === "BUTTON") found.onclick = () => seek(t.at);
  return found;
}

function legend(m) {
  const arrows = m.arrows.filter((a) => m.kinds.includes(a.kind)), marks = space.about.shapes.filter((s) => s.kind).map((s) => [s.kind, s.colour]);
  const rows = new Map([...arrows.map((a) => [a.kind, a.colour]), ...marks, ...m.paths.map((p) => [p.name, p.colour])]);
  $("legend").replaceChildren(...[...rows].map(([name, colour]) => {
    const swatch = make("i"), row = make("button", { title: "click: hide or show it" }, swatch, space.about.meanings[name] ?? name);
    swatch.style.background = tint_rgb(colour);
    row.classList.toggle("off", space.hidden.has(name));
    row.onclick = () => { row.classList.toggle("off", space.toggle(name)); draw_space(); };
    return row;
  }), make("span", { id: "scale" }), m.passing ? make("span", { className: "passing", textContent: m.passing.text.split(":")[0], title: m.passing.text }) : "");
  space.covered = [$("legend").offsetHeight + 4, $("legend").offsetLeft + $("legend").offsetWidth];
}

// The scene between the two frames around an instant: places of joints, and forces.
function instant(f, joints, arrows, time, begin, end) {
  const count = f.time.length;
  let k = Math.min(Math.max(Math.floor(((time - begin) / (end - begin || 1)) * (count - 1)), 0), Math.max(count - 2, 0));
  while (k > 0 && f.time[k] > time) k--;
  while (k + 2 < count && f.time[k + 1] <= time) k++;
  const next = Math.min(k + 1, count - 1), gap = f.time[next] - f.time[k];
  const u = gap > 0 ? Math.min(Math.max((time - f.time[k]) / gap, 0), 1) : 0;
  const mix = (array, width, from, to) => {
    const a = array.subarray(width * k + from, width * k + to), b = array.subarray(width * next + from, width * next + to);
    return Array.from(a, (x, i) => x + u * (b[i] - x));
  };
  const places = [];
  for (let j = 0; j < joints; j++) {
    const p = mix(f.places, 7 * joints, 7 * j, 7 * j + 7), q = p.slice(0, 4), size = Math.hypot(...q) || 1;
    places.push(place(...q.map((x) => x / size), ...p.slice(4)));
  }
  const part = (array, i) => mix(array, 3 * arrows, 3 * i, 3 * i + 3);
  return { places, arrows: Array.from({ length: arrows }, (_, i) => ({ tail: part(f.tails, i), force: part(f.forces, i) })) };
}

function frameAt(time) { return instant(frames ?? still, counts, space.scene.arrows.length, time, state.begin, state.end); }

function draw_space() {
  if (!space.scene || !(frames ?? still) || counts === null) return;
  if (space.waits) space.again = true;
  space.show(frameAt(state.time));
  if ($("scale")) $("scale").textContent = `10 N = ${short(10 * space.scale(space.view()), 2)} m`;
}

function show_instant(all = true) {
  $("time").value = state.time;
  $("time").setAttribute("aria-valuetext", `${state.time.toFixed(3)} s`);
  $("now").textContent = `${state.time.toFixed(3)} s`;
  $("play").textContent = state.playing ? "pause" : "play";
  if (!all) return;
  plots.cursor(state.time, null);
  draw_space();
}

function seek(time) {
  state.playing = false;
  state.kept = null;
  state.time = Math.min(Math.max(time, state.begin), state.end);
  show_instant();
}

function play() {
  if (!state.playing && state.time >= state.end) state.time = state.begin;
  state.playing = !state.playing;
  if (state.playing && frames === null) send({ do: "frames" });
  show_instant();
}

function next_event(forward = true) {
  const times = (run?.marks ?? []).map((m) => m.time).filter((t) => (forward ? t > state.time + 1e-9 : t < state.time - 1e-9));
  if (run?.marks.length) seek(times.length ? (forward ? Math.min(...times) : Math.max(...times)) : run.marks[forward ? 0 : run.marks.length - 1].time);
}

let last = performance.now();
function tick(now) {
  if (state.playing) {
    state.time += ((now - last) / 1000) * state.speed;
    if (state.time >= state.end) {
      state.playing = $("loop").checked;
      state.time = state.playing && state.end > state.begin ? state.begin + ((state.time - state.begin) % (state.end - state.begin)) : state.end;
    }
    show_instant();
  }
  last = now;
  requestAnimationFrame(tick);
}

// Columns that may be drawn besides: in a page without a server they are in it and wait to be chosen.
function offer_columns(names) {
  const key = names.join() + extras.join();
  if (offer_columns.key === key) return;
  offer_columns.key = key;
  $("more").firstElementChild.hidden = !names.length;
  $("columns").replaceChildren(new Option("choose ...", ""), ...names.filter((n) => !extras.includes(n)).map((n) => new Option(n, n)));
}
function pick(all) { return all.filter((p) => !p.name.startsWith(COLUMN) || extras.includes(p.name.slice(COLUMN.length))); }
function show_columns(names) {
  extras = names;
  if (socket) send({ do: "columns", names });
  else { run.panels = pick(panels); plots.show(run); offer_columns(run.columns); show_instant(false); }
}

$("columns").onchange = () => { if ($("columns").value) show_columns([...extras, $("columns").value]); };
$("play").onclick = play;
$("back").onclick = () => seek(state.time - state.step);
$("on").onclick = () => seek(state.time + state.step);
$("event").onclick = () => next_event();
$("time").oninput = () => seek(Number($("time").value));
for (const s of [0.01, 0.03, 0.1, 0.3, 1, 2, 4]) $("speed").appendChild(new Option(`${s}x`, s, s === 1, s === 1));
$("speed").onchange = () => { state.speed = Number($("speed").value); };
for (const [id, word] of [["undo", "undo"], ["redo", "redo"], ["again", "begin again"]]) $(id).onclick = () => { if (!$(id).disabled) change({ do: word }); };
for (const word of ["pin", "unpin"]) $(word).onclick = () => send({ do: word });
$("save").onclick = () => send({ do: "save" });
$("share").onclick = () => send({ do: "share" });
$("gallery").onclick = () => gallery.open();
$("search").oninput = () => controls.find($("search").value);
const whole = () => { space.whole = !space.whole; $("whole").setAttribute("aria-pressed", space.whole); draw_space(); };
const clear = () => { space.clear = !space.clear; $("clear").setAttribute("aria-pressed", space.clear); draw_space(); };
const fit = () => { if (space.scene) { space.fit(); draw_space(); } };
const pull = () => { space.pulls = !space.pulls; $("pull").setAttribute("aria-pressed", space.pulls); };
[$("whole").onclick, $("clear").onclick, $("fit").onclick, $("pull").onclick] = [whole, clear, fit, pull];
$("view").addEventListener("dblclick", fit);

document.addEventListener("keydown", (e) => {
  if (e.key === "Escape") { if (!$("cards").hidden && !gallery.close.hidden) gallery.hide(); else e.target.blur?.(); return; }
  const words_in = e.target.matches?.("input:not([type=range], [type=checkbox]), select, textarea");
  if ((e.ctrlKey || e.metaKey) && e.key.toLowerCase() === "z" && !words_in) { e.preventDefault(); $(e.shiftKey ? "redo" : "undo").click(); return; }
  if (words_in || e.ctrlKey || e.metaKey || e.altKey || !$("cards").hidden) return;
  const slides = e.target.matches?.("input[type=range], [role=tab]") && e.target !== $("time");
  if (e.key === " " && e.target.matches?.("button, summary, input[type=checkbox]")) return;
  const step = state.step * (e.shiftKey ? 100 : 1);
  const act = {
    " ": play, ArrowLeft: () => seek(state.time - step), ArrowRight: () => seek(state.time + step), Home: () => seek(state.begin),
    End: () => seek(state.end), e: () => next_event(), E: () => next_event(false), a: whole, t: clear, 0: fit, f: () => { if (socket) pull(); }, p: () => $("pin").click(),
    P: () => $("unpin").click(), "/": () => $("search").focus(),
  }[e.key];
  if (!act || (slides && /^(Arrow|Home|End)/.test(e.key))) return;
  e.preventDefault();
  act();
});

function theme() {
  const given = document.documentElement.dataset.theme, was = dark;
  dark = given ? given === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  if (was !== dark) { inks.clear(); redraw(); }
}
function redraw() {
  if (run) plots.draw();
  draw_space();
  if (tabs.name) tabs.tabs[tabs.name].shown?.();
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", theme);
theme();
new ResizeObserver(redraw).observe($("middle"));
document.addEventListener("resized", redraw);
new ResizeObserver(redraw).observe($("side"));

// Of messages that come faster than they are drawn only the newest run is.
function follow() {
  socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/#.*/, ""));
  socket.binaryType = "arraybuffer";
  let waiting = null;
  const draw = () => { const m = waiting; waiting = null; if (m) on.run(m); };
  socket.onmessage = (e) => {
    const m = decode(e.data);
    if (m.kind !== "run") { on[m.kind]?.(m); return; }
    if (waiting === null) queueMicrotask(draw);
    waiting = m;
  };
  socket.onclose = () => { if ($("gone").hidden) gone("The program that computes the runs has stopped. What is shown stays; start it again and open its new address to go on."); };
}
if (embedded.length) for (const line of embedded) { const m = decode(bytesOf(line)); on[m.kind]?.(m); }
else follow();
requestAnimationFrame(tick);
