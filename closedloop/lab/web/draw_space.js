"use strict";
// Triangles with WebGL 2: meshes, arrows and tubes, in one program.

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

class Drawing {
  constructor(canvas) {
    this.gl = canvas.getContext("webgl2", { antialias: false });
    if (!this.gl) return;
    this.program = this.compile();
    this.behind = this.gl.createFramebuffer();
    this.kept = [this.gl.createRenderbuffer(), this.gl.createRenderbuffer()]; // of colours and of depths
    this.size = [];
    this.shaft = this.round(1, 1);
    this.head = this.round(1, 0);
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

  // Begin a picture of so many pixels, each of so many samples, which is drawn behind the canvas: the page shows what is drawn on a canvas in the
  // same frame, and would wait for it.
  picture(w, h, wanted) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.behind);
    if (this.size.join() === [w, h, wanted].join()) return;
    this.size = [w, h, wanted];
    const samples = Math.min(wanted, gl.getParameter(gl.MAX_SAMPLES)), forms = [gl.RGBA8, gl.DEPTH_COMPONENT24];
    this.kept.forEach((buffer, k) => {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, forms[k], w, h);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, [gl.COLOR_ATTACHMENT0, gl.DEPTH_ATTACHMENT][k], gl.RENDERBUFFER, buffer);
    });
  }

  // Call `then` with the time that the picture took, ms, once it is drawn; the page goes on meanwhile.
  finished(then) {
    const gl = this.gl, began = performance.now(), fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      const took = performance.now() - began;
      if (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED && took < 2000) { setTimeout(look, 4); return; }
      gl.deleteSync(fence);
      then(took);
    };
    look();
  }

  // Put the picture on the canvas. It is cleared first: a browser may do so itself later, as it has shown what was there.
  present() {
    const gl = this.gl, [w, h] = this.size;
    if (gl.canvas.width !== w || gl.canvas.height !== h) [gl.canvas.width, gl.canvas.height] = [w, h];
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.behind);
    gl.blitFramebuffer(0, 0, w, h, 0, 0, w, h, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }

  mesh(vertices, faces) {
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = [gl.createBuffer(), gl.createBuffer()];
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[1]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    return { array, buffers, count: faces.length };
  }

  // Give back the memory of a mesh.
  free(mesh) {
    if (!mesh) return;
    this.gl.deleteVertexArray(mesh.array);
    for (const buffer of mesh.buffers) this.gl.deleteBuffer(buffer);
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

  // Begin a part of the canvas, in pixels, seen through a camera.
  begin(x, y, w, h, camera) {
    const gl = this.gl;
    gl.enable(gl.SCISSOR_TEST);
    gl.viewport(x, y, w, h);
    gl.scissor(x, y, w, h);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(this.at.camera, false, camera);
  }

  // What is drawn from here on is seen through, on top of all else where `over`.
  blend(on, over = false) {
    const gl = this.gl;
    (on ? gl.enable : gl.disable).call(gl, gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    (over ? gl.disable : gl.enable).call(gl, gl.DEPTH_TEST);
    gl.depthMask(!on);
  }

  // An arrow along d, m, from a tail, in a view of radius k.
  arrow(tail, d, k, colour) {
    const length = norm(d);
    if (!(length > 0.01 * k)) return;
    const thin = Math.min(1, length / (0.26 * k)) * k, head = 0.13 * thin; // a short arrow is thin as well
    this.put(this.shaft, along(tail, d, 0.02 * thin, length - head), colour, 1);
    this.put(this.head, along(plus(tail, d, 1 - head / length), d, 0.05 * thin, head), colour, 1);
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
