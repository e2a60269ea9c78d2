"use strict";
// The scenarios that ship, each with a picture that the page draws.

class Gallery {
  constructor(parent, send) {
    this.parent = parent;
    this.send = send;
    this.cards = new Map();
    this.close = make("button", { textContent: "close", title: "Esc" });
    this.close.onclick = () => this.hide();
    this.grid = make("div", { className: "grid" });
    parent.append(make("header", {}, make("h1", { textContent: "Scenarios" }), make("p", { className: "hint", textContent: "Each is a whole experiment. Choose one: its sliders, curves and forces open." }), this.close), this.grid);
  }

  open() {
    this.parent.hidden = false;
    this.close.focus();
    if (!this.asked) this.send({ do: "gallery" });
    this.asked = true;
  }

  hide() { this.parent.hidden = true; }

  // All names and descriptions; the pictures follow, one by one.
  list(m) {
    this.close.hidden = !m.open;
    this.grid.replaceChildren(...m.cards.map((card) => {
      const canvas = make("canvas"), button = make("button", { className: "card", title: card.about }, canvas, make("b", { textContent: card.name.replace(/_/g, " ") }), make("span", { textContent: card.about }));
      button.onclick = () => { this.hide(); this.send({ do: "open", name: card.name }); };
      this.cards.set(card.name, canvas);
      return button;
    }));
  }

  picture(m) {
    const canvas = this.cards.get(m.name);
    if (!canvas) return;
    const scratch = (this.scratch ??= make("canvas", { width: 400, height: 250 }));
    const space = (this.space ??= new Space(scratch, make("div")));
    if (!space.gl) return;
    const [g, w, h] = sized(canvas);
    space.robot(m.robot);
    space.space(m.space);
    space.whole = m.space.arrows.length === 0 || m.whole;
    space.frame = instant(m.space.frames, m.robot.joints, m.space.arrows.length, 0, 0, 0);
    const v = space.view();
    space.part(0, 0, scratch.width, scratch.height, space.camera(v, scratch.width / scratch.height), v, true);
    g.drawImage(scratch, 0, 0, w, h);
  }
}
