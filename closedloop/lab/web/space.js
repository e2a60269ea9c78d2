"use strict";
// The arm, the surface, the paths and the forces, drawn with WebGL 2. Drag turns, the wheel zooms, Shift and drag shifts.

const VERTEX = `#version 300 es
in vec3 at; uniform mat4 model, camera; out vec3 world;
void main() { vec4 p = model * vec4(at, 1.0); world = p.xyz; gl_Position = camera * p; }`;
const FRAGMENT = `#version 300 es
precision highp float; in vec3 world; uniform vec4 colour; uniform float lit; out vec4 seen;
void main() {
  vec3 n = normalize(cross(dFdx(world), dFdy(world)));
  float light = 0.45 + 0.4 * abs(dot(n, normalize(vec3(0.4, -0.5, 0.8)))) + 0.15 * abs(n.x);
  seen = vec4(colour.rgb * mix(1.0, light, lit), colour.a);
}`;

class Space {
  constructor(canvas, data) {
    this.canvas = canvas;
    this.data = data;
    this.hidden = new Set();
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: true }));
    if (!gl) return;
    this.program = this.compile();
    this.shapes = data.shapes.map((s) => ({ ...s, mesh: this.mesh(floats(s.vertices), whole(s.faces)) }));
    const k = data.size;
    this.shaft = this.round(1, 1);
    this.head = this.round(1, 0);
    this.surface = this.mesh(floats(data.surface.vertices), whole(data.surface.faces));
    this.paths = data.paths.map((p) => ({ ...p, mesh: this.tube(floats(p.points), 0.0025 * k) }));
    this.turn = -0.5;
    this.rise = 0.4;
    this.far = 2.6 * data.radius;
    this.centre = data.centre;
    this.listen();
  }

  compile() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "at");
    gl.linkProgram(program);
    this.at = Object.fromEntries(["model", "camera", "colour", "lit"].map((n) => [n, gl.getUniformLocation(program, n)]));
    return program;
  }

  mesh(vertices, faces) {
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    return { array, count: faces.length };
  }

  // A cone of height 1 along z, from radius a to radius b.
  round(a, b, sides = 20) {
    const v = [], f = [];
    for (let i = 0; i < sides; i++) {
      const [c, s] = [Math.cos((2 * Math.PI * i) / sides), Math.sin((2 * Math.PI * i) / sides)];
      v.push(a * c, a * s, 0, b * c, b * s, 1);
      const j = (i + 1) % sides;
      f.push(2 * i, 2 * j, 2 * i + 1, 2 * j, 2 * j + 1, 2 * i + 1, 2 * i, 2 * j, 2 * sides);
    }
    v.push(0, 0, 0);
    return this.mesh(new Float32Array(v), new Uint32Array(f));
  }

  tube(points, radius) {
    const v = [], f = [];
    for (let i = 0; 3 * i + 5 < points.length; i++) {
      const p = points.slice(3 * i, 3 * i + 3), q = points.slice(3 * i + 3, 3 * i + 6);
      if (norm(minus(q, p)) < 1e-12) continue;
      const m = along(p, minus(q, p), radius, 1);
      const first = v.length / 3;
      for (const end of [p, q]) {
        for (let k = 0; k < 3; k++) {
          const [c, s] = [Math.cos(2.1 * k), Math.sin(2.1 * k)];
          v.push(...[0, 1, 2].map((e) => end[e] + c * m[e] + s * m[4 + e]));
        }
      }
      for (let k = 0; k < 3; k++) {
        const l = (k + 1) % 3;
        f.push(first + k, first + l, first + 3 + k, first + l, first + 3 + l, first + 3 + k);
      }
    }
    return this.mesh(new Float32Array(v), new Uint32Array(f));
  }

  listen() {
    const c = this.canvas;
    const held = new Map();
    let spread = 0;
    c.addEventListener("pointerdown", (e) => { held.set(e.pointerId, e); c.setPointerCapture(e.pointerId); spread = 0; });
    for (const end of ["pointerup", "pointercancel"]) c.addEventListener(end, (e) => held.delete(e.pointerId));
    c.addEventListener("pointermove", (e) => {
      const last = held.get(e.pointerId);
      if (!last) return;
      const [dx, dy] = [e.clientX - last.clientX, e.clientY - last.clientY];
      held.set(e.pointerId, e);
      if (held.size === 2) {
        const [a, b] = [...held.values()];
        const now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) this.far *= spread / now;
        spread = now;
      } else if (e.shiftKey || e.buttons === 2) {
        const [x, y] = this.screen();
        const k = this.far / c.clientHeight;
        this.centre = plus(plus(this.centre, x, -dx * k), y, dy * k);
      } else {
        this.turn -= 0.008 * dx;
        this.rise = Math.min(1.5, Math.max(-1.5, this.rise + 0.008 * dy));
      }
      this.draw();
    });
    c.addEventListener("contextmenu", (e) => e.preventDefault());
    c.addEventListener("wheel", (e) => { e.preventDefault(); this.far *= Math.exp(0.001 * e.deltaY); this.draw(); }, { passive: false });
  }

  eye() {
    const r = Math.cos(this.rise);
    return plus(this.centre, [r * Math.cos(this.turn), r * Math.sin(this.turn), Math.sin(this.rise)], this.far);
  }

  screen() {
    const z = unit(minus(this.eye(), this.centre));
    const x = unit(cross([0, 0, 1], z));
    return [x, cross(z, x)];
  }

  // Show an instant: the joints' places and the forces, between the two frames around it.
  show(frame) {
    this.frame = frame;
    this.draw();
  }

  draw() {
    const gl = this.gl;
    if (!gl || !this.frame) return;
    const c = this.canvas, dpr = window.devicePixelRatio || 1;
    const [w, h] = [Math.max(1, Math.round(c.clientWidth * dpr)), Math.max(1, Math.round(c.clientHeight * dpr))];
    if (c.width !== w || c.height !== h) [c.width, c.height] = [w, h];
    gl.viewport(0, 0, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    const far = this.far / Math.min(1, w / h);
    const eye = plus(this.centre, minus(this.eye(), this.centre), far / this.far);
    const camera = times(perspective(0.7, w / h, 0.01 * far, 20 * far), lookAt(eye, this.centre, [0, 0, 1]));
    gl.uniformMatrix4fv(this.at.camera, false, camera);
    const still = place(1, 0, 0, 0, 0, 0, 0);
    for (const s of this.shapes.filter((s) => !this.hidden.has(s.kind))) this.put(s.mesh, this.frame.places[s.joint], [...s.colour, 1], 1);
    for (const p of this.paths.filter((p) => !this.hidden.has(p.name))) this.put(p.mesh, still, [...p.colour, 1], 0);
    this.arrows(1);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.disable(gl.DEPTH_TEST);
    this.arrows(0.35); // through the arm, where that hides them
    gl.enable(gl.DEPTH_TEST);
    this.put(this.surface, this.frame.places[this.data.surface.joint], [0.6, 0.66, 0.72, 0.55], 1);
    gl.disable(gl.BLEND);
  }

  // Hide what is called so, or show it again; return whether it is hidden now.
  toggle(name) {
    if (!this.hidden.delete(name)) this.hidden.add(name);
    return this.hidden.has(name);
  }

  arrows(opacity) {
    this.frame.arrows.forEach((a, i) => {
      const { kind, colour } = this.data.arrows[i];
      if (!this.hidden.has(kind)) this.arrow(a.tail, a.force, [...colour, opacity]);
    });
  }

  arrow(tail, force, colour) {
    const k = this.data.size;
    const d = force.map((x) => x * this.data.metres_per_newton);
    const length = norm(d);
    if (!(length > 2e-3 * k)) return;
    const head = Math.min(0.035 * k, 0.5 * length);
    const neck = plus(tail, d, 1 - head / length);
    this.put(this.shaft, along(tail, d, 0.006 * k, length - head), colour, 1);
    this.put(this.head, along(neck, d, 0.015 * k, head), colour, 1);
  }

  put(mesh, model, colour, lit) {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.at.model, false, model);
    gl.uniform4fv(this.at.colour, colour);
    gl.uniform1f(this.at.lit, lit);
    gl.bindVertexArray(mesh.array);
    gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_INT, 0);
  }
}
