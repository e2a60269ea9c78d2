"use strict";
// Sliders, number boxes and choices, grouped by what they mean. Of a list with a number for each joint one slider moves all.

// A browser tells of a drag with its next frame, up to 16 ms late. So a slider that a mouse drags is set here, at once.
const HANDLE = 16, AT_ONCE = "onpointerrawupdate" in window ? "pointerrawupdate" : "pointermove";
function follow_pointer(range) {
  let held = null; // px, from the middle of the handle to the pointer
  const place = () => {
    const box = range.getBoundingClientRect(), low = Number(range.min), high = Number(range.max);
    const from = box.left + HANDLE / 2, width = box.width - HANDLE;
    return { middle: from + (width * (Number(range.value) - low)) / (high - low || 1), value: (x) => low + ((x - from) / width) * (high - low) };
  };
  const set = (x) => {
    const before = range.value;
    range.value = place().value(x); // the browser keeps it within its ends and on its steps
    if (range.value !== before) range.dispatchEvent(new Event("input", { bubbles: true }));
  };
  range.addEventListener("pointerdown", (e) => {
    if (e.button !== 0 || e.pointerType === "touch" || range.disabled) return;
    e.preventDefault();
    range.focus();
    range.setPointerCapture(e.pointerId);
    const off = e.clientX - place().middle;
    held = Math.abs(off) <= HANDLE / 2 ? off : 0;
    set(e.clientX - held);
  });
  range.addEventListener(AT_ONCE, (e) => { if (held !== null) set(e.clientX - held); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) range.addEventListener(end, () => { held = null; });
}

class Controls {
  constructor(parent, doc, send) {
    this.parent = parent;
    this.doc = doc;
    this.send = send;
    this.rows = new Map(); // id -> row
    this.open = new Set();
    this.shape = "";
  }

  show(message) {
    this.message = message;
    const shape = JSON.stringify(message.groups.map((g) => [g.name, g.rows.map((r) => [r.id, r.form, r.options])]));
    if (shape !== this.shape) this.build(message.groups);
    this.shape = shape;
    const told = this.told ?? new Map(), fresh = new Set();
    this.told = new Map(message.groups.flatMap((g) => g.rows.map((r) => [r.id, JSON.stringify(r)])));
    for (const group of message.groups) {
      for (const row of group.rows) if (message.forced || told.get(row.id) !== this.told.get(row.id)) fresh.add(row.key);
      for (const row of group.rows) if (fresh.has(row.key)) this.put(row); // what is as it was stays
      const changed = group.rows.filter((r) => r.changed).length;
      this.counts.get(group.name).textContent = changed ? ` ${changed} changed` : "";
    }
  }

  build(groups) {
    this.rows.clear();
    this.told = new Map();
    this.counts = new Map();
    const was = new Map([...this.parent.querySelectorAll("details")].map((d) => [d.dataset.name, d.open]));
    this.parent.replaceChildren(...groups.map((group, k) => {
      const count = make("span", { className: "count" });
      this.counts.set(group.name, count);
      const box = make("details", { open: was.get(group.name) ?? (group.open || k < 1) }, make("summary", {}, group.name, count));
      box.dataset.name = group.name;
      let list = null;
      group.rows.forEach((row) => {
        const whole = row.index === null ? [] : group.rows.filter((r) => r.key === row.key);
        if (whole[0] === row && whole.length > 1) {
          list = this.all(row, whole);
          box.append(list.box);
        }
        const made = this.row(row);
        if (row.index !== null && list?.key === row.key) {
          made.box.classList.add("joint");
          made.box.hidden = !this.open.has(row.key);
          list.joints.push(made.box);
        }
        this.rows.set(row.id, made);
        box.append(made.box);
      });
      return box;
    }));
    this.find(this.sought ?? "");
  }

  // The row of a whole list: its slider moves all joints by the same factor.
  all(first, rows) {
    const made = this.row({ ...first, label: `${first.name}`, id: `${first.key}*` }, true);
    made.first = first.id;
    const found = { box: made.box, key: first.key, joints: [] };
    const name = made.box.querySelector("label"), more = make("button", { className: "open", title: "all joints together; click: each by itself", textContent: `▸ ${first.name}, all` });
    more.setAttribute("aria-expanded", this.open.has(first.key));
    more.style.textAlign = "left";
    more.onclick = () => {
      if (!this.open.delete(first.key)) this.open.add(first.key);
      const open = this.open.has(first.key);
      more.setAttribute("aria-expanded", open);
      more.textContent = `${open ? "▾" : "▸"} ${first.name}, all`;
      for (const box of found.joints) box.hidden = !open;
    };
    if (this.open.has(first.key)) more.textContent = `▾ ${first.name}, all`;
    more.onfocus = more.onmouseenter = () => this.tell(made.given);
    made.range?.setAttribute("aria-label", `${first.name}, all joints`);
    name.replaceWith(more);
    this.rows.set(`${first.key}*`, made);
    made.of = rows.map((r) => r.id);
    return found;
  }

  row(given, together = false) {
    const id = given.id, key = `c-${id.replace(/[^\w]/g, "-")}${together ? "all" : ""}`;
    const made = { given, together };
    const label = make("label", { htmlFor: key, textContent: given.label });
    const reset = make("button", { className: "reset", textContent: "↺", title: `back to ${given.first}` });
    reset.setAttribute("aria-label", `${given.key}: back to ${given.first}`);
    reset.onclick = () => this.send({ do: "reset", key: given.key, index: together ? null : given.index });
    made.fault = make("p", { className: "fault", hidden: true });
    made.fault.setAttribute("role", "alert");
    const slider = ["linear", "log", "whole"].includes(given.form);
    const ask = (value) => this.send({ do: "set", key: given.key, index: given.index, shown: value, together });
    if (slider) {
      made.range = make("input", { type: "range", id: key });
      made.box_ = make("input", { className: "num", inputMode: "decimal" });
      made.box_.setAttribute("aria-label", `${given.label}, number`);
      follow_pointer(made.range);
      made.range.oninput = () => {
        made.range.setAttribute("aria-valuetext", made.box_.value = this.text(made.given, Number(made.range.value)));
        ask(Number(made.range.value));
      };
      made.box_.onchange = () => this.send({ do: "type", key: given.key, index: given.index, text: made.box_.value, together });
      made.unit = make("span", { className: "unit", textContent: given.unit, title: given.unit });
      made.box = make("div", { className: "row" }, label, made.range, made.box_, made.unit, reset, made.fault);
    } else if (given.form === "choice") {
      made.box_ = make("select", { id: key }, ...given.options.map((o) => new Option(o.includes(":") ? `${o.split(":")[1]} (${o.split(":")[0]})` : o.replace(/_/g, " "), o)));
      made.box_.onchange = () => ask(made.box_.value);
      made.box = make("div", { className: "row wide" }, label, made.box_, reset, made.fault);
    } else if (given.form === "flag") {
      made.box_ = make("input", { type: "checkbox", id: key });
      made.box_.onchange = () => ask(made.box_.checked);
      made.box = make("div", { className: "row wide" }, label, made.box_, reset, made.fault);
    } else {
      made.box_ = make("input", { className: "num", id: key, placeholder: "left out" });
      made.box_.onchange = () => ask(made.box_.value);
      made.box = make("div", { className: "row wide" }, label, made.box_, reset, made.fault);
    }
    made.box.dataset.key = given.key;
    made.box.onmouseenter = () => this.tell(made.given);
    made.box.addEventListener("focusin", () => this.tell(made.given));
    made.box.dataset.words = `${given.key} ${given.label} ${given.hint} ${given.unit}`.toLowerCase();
    return made;
  }

  text(given, shown) {
    return given.form === "log" ? short(10 ** shown, 3) : given.form === "whole" ? String(Math.round(shown)) : short(shown, 6);
  }

  put(row) {
    const whole = row.index === null ? null : this.rows.get(`${row.key}*`);
    for (const made of [this.rows.get(row.id), whole?.first === row.id ? whole : null]) {
      if (!made) continue;
      made.given = { ...row, label: made.given.label };
      const changed = made.of ? made.of.some((id) => this.message.groups.some((g) => g.rows.some((r) => r.id === id && r.changed))) : row.changed;
      made.box.classList.toggle("changed", changed);
      if (made.range) {
        const held = made.range === document.activeElement && this.busy?.() && !this.message.forced;
        Object.assign(made.range, { min: row.low, max: row.high, step: row.step });
        if (held) this.told.delete(row.id); // it is put right when it rests
        else {
          made.range.value = row.shown;
          if (made.box_ !== document.activeElement || this.message.forced) made.box_.value = short(row.own, 9);
        }
        made.range.setAttribute("aria-valuetext", `${made.box_.value} ${row.unit}`);
      } else if (row.form === "flag") made.box_.checked = row.shown;
      else if (made.box_ !== document.activeElement || row.form === "choice") made.box_.value = row.shown;
    }
  }

  // Say what is wrong with a key beside it, or that nothing is.
  fault(key, line) {
    for (const made of this.rows.values()) {
      if (!made.fault) continue;
      const here = line && made.given.key === key && (made.given.index === null || made.together || !this.rows.has(`${key}*`));
      made.fault.textContent = here ? line : "";
      made.fault.hidden = !here;
    }
  }

  tell(given) {
    const range = ["linear", "log", "whole"].includes(given.form) ? ` Began with ${given.first}${given.unit ? ` ${given.unit}` : ""}.` : given.first ? ` Began with ${given.first}.` : "";
    this.doc.replaceChildren(make("b", { textContent: given.key }), given.unit ? ` [${given.unit}] ` : " ", given.hint.replace(/\.?$/, "."), range);
  }

  find(words) {
    this.sought = words.trim().toLowerCase();
    for (const box of this.parent.querySelectorAll("details")) {
      let some = false;
      for (const row of box.querySelectorAll(".row")) {
        const hit = this.sought.split(/\s+/).every((word) => row.dataset.words.includes(word));
        const folded = row.classList.contains("joint") && !this.open.has(row.dataset.key);
        row.hidden = !hit || folded;
        some ||= hit;
      }
      box.hidden = !some;
      if (this.sought && some) box.open = true;
    }
  }
}
