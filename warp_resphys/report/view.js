"use strict";
// Shows the bodies of one trial in WebGL 2. What it shows lies in the page, written by view.py, which says what is what.
(() => {
const VERTEX = `#version 300 es
in vec3 place; in float paint;
uniform mat4 camera; uniform float nearer, size;
out vec3 seen; out float shade;
void main() {
  gl_Position = camera * vec4(place, 1.0);
  gl_Position.z -= nearer * gl_Position.w;
  gl_PointSize = size;
  seen = place; shade = paint;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen; in float shade;
uniform sampler2D colours; uniform vec4 tone; uniform vec3 light; uniform int kind; uniform bool painted;
out vec4 colour;
void main() {
  vec3 base = painted ? texture(colours, vec2(clamp(shade, 0.0, 1.0), 0.5)).rgb : tone.rgb;
  if (kind == 1) {  // a surface, its normal from the screen
    vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
    base *= 0.72 + 0.3 * abs(dot(normal, light));
  } else if (kind >= 2) {  // a dot or a ring
    float away = length(gl_PointCoord - 0.5) * 2.0;
    if (away > 1.0 || (kind == 3 && away < 0.6)) discard;
  }
  colour = vec4(base, tone.a);
}`;
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const decoded = (text, Kind) => new Kind(bytes(text).buffer);
const rgb = (text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

class View {
  constructor(figure) {
    this.figure = figure;
    this.canvas = figure.querySelector("canvas");
    const data = JSON.parse(figure.querySelector(".view-data").textContent);
    this.data = data;
    this.gl = this.canvas.getContext("webgl2", {antialias: true, alpha: false, preserveDrawingBuffer: true});
    if (!this.gl) throw new Error("This browser has no WebGL 2, which the view in space needs.");
    this.rest = decoded(data.rest, Float32Array);
    this.modes = decoded(data.modes, Int16Array);
    this.weights = decoded(data.weights, Float32Array);
    this.errors = data.errors === null ? null : bytes(data.errors);
    this.obstacles = decoded(data.obstacles, Float32Array);
    this.owners = decoded(data.owners, Uint32Array);
    this.poses = decoded(data.poses, Float32Array);
    this.around = new Float32Array(this.obstacles.length);
    this.measured = decoded(data.measured, Float32Array);
    this.simulated = decoded(data.simulated, Float32Array);
    this.place = new Float32Array(this.rest.length);
    this.prepare();
    this.time = data.times[0];
    this.playing = false;
    this.controls();
    this.reset();
    new ResizeObserver(() => this.ask()).observe(this.canvas);
    this.canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.prepare();
      this.ask();
    });
    dark.addEventListener("change", () => this.ask());
  }

  // Programs, textures and what does not change.
  prepare() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place");
    gl.bindAttribLocation(program, 1, "paint");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no shader");
    gl.useProgram(program);
    const names = ["camera", "nearer", "size", "tone", "light", "kind", "painted"];
    this.at = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    const map = new Uint8Array(this.data.colours.flatMap((tone) => [...rgb(tone).map((part) => 255 * part), 255]));
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, map.length / 4, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, map);
    for (const [which, how] of [["MIN_FILTER", "LINEAR"], ["MAG_FILTER", "LINEAR"], ["WRAP_S", "CLAMP_TO_EDGE"]]) {
      gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${which}`], gl[how]);
    }
    this.places = gl.createBuffer();
    this.paints = gl.createBuffer();
    this.indices = {};
    for (const name of ["faces", "edges", "sharp", "sides"]) {
      const index = decoded(this.data[name], Uint32Array);
      this.indices[name] = {buffer: gl.createBuffer(), count: index.length};
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices[name].buffer);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
    }
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  controls() {
    const find = (name) => this.figure.querySelector(name);
    this.button = find(".play");
    this.slider = find(".time");
    this.clock = find(".clock");
    this.speed = find(".speed");
    this.boxes = [...this.figure.querySelectorAll(".models input")];
    this.means = [...this.figure.querySelectorAll(".models output")];
    this.switches = Object.fromEntries([...this.figure.querySelectorAll(".shown input")].map((box) => [box.name, box]));
    this.legend = find(".legend");
    this.button.addEventListener("click", () => this.play(!this.playing));
    this.slider.addEventListener("input", () => this.seek(this.data.times.at(-1) * this.slider.value / 1000));
    find(".home").addEventListener("click", () => this.reset());
    for (const box of this.figure.querySelectorAll("input[type=checkbox]")) {
      box.addEventListener("change", () => this.ask());
    }
    const canvas = this.canvas, fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      const before = [...fingers.values()];
      const [x, y] = fingers.get(event.pointerId), dx = event.clientX - x, dy = event.clientY - y;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      if (fingers.size === 1 && !event.shiftKey && !(event.buttons & 6)) this.turn(0.008 * dx, 0.008 * dy);
      else this.move(dx / fingers.size, dy / fingers.size);
      if (fingers.size === 2) {
        const span = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]);
        this.zoom(span(before) / Math.max(span([...fingers.values()]), 1));
      }
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;  // The page scrolls until the view is chosen.
      event.preventDefault();
      this.zoom(Math.exp(0.0015 * event.deltaY));
    }, {passive: false});
    const keys = {
      ArrowLeft: () => this.turn(-0.1, 0), ArrowRight: () => this.turn(0.1, 0),
      ArrowUp: () => this.turn(0, -0.1), ArrowDown: () => this.turn(0, 0.1),
      "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1.1),
      " ": () => this.play(!this.playing), "0": () => this.reset(), Home: () => this.seek(0),
      ",": () => this.step(-1), ".": () => this.step(1),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  reset() {
    this.axes = this.data.axes.map((row) => [...row]);
    this.focus = [...this.data.centre];
    this.near = 1.0;
    this.ask();
  }

  turn(sideways, over) {  // about what is up, and about what is to the right
    const spin = (vector, axis, angle) => {
      const cos = Math.cos(angle), sin = Math.sin(angle), dot = axis.reduce((sum, a, k) => sum + a * vector[k], 0);
      return vector.map((each, k) => each * cos + dot * axis[k] * (1 - cos)
        + sin * (axis[(k + 1) % 3] * vector[(k + 2) % 3] - axis[(k + 2) % 3] * vector[(k + 1) % 3]));
    };
    this.axes = this.axes.map((row) => spin(row, this.data.up, -sideways));
    const right = this.axes[0];
    this.axes = this.axes.map((row) => spin(row, right, -over));
    this.ask();
  }

  move(dx, dy) {  // in pixels of the page
    const scale = this.half() * 2 / this.canvas.clientHeight;
    this.focus = this.focus.map((each, k) => each - scale * (dx * this.axes[0][k] - dy * this.axes[1][k]));
    this.ask();
  }

  zoom(factor) {
    this.near = Math.min(Math.max(this.near * factor, 0.02), 5.0);
    this.ask();
  }

  half() {  // Half the height of what is seen [m]; wide enough for a narrow page.
    const aspect = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1);
    return this.near * Math.max(this.data.half[1], this.data.half[0] / aspect);
  }

  play(on) {
    if (this.data.times.length < 2) return;
    if (on && this.time >= this.data.times.at(-1)) this.time = this.data.times[0];
    this.playing = on;
    this.button.setAttribute("aria-label", on ? "Pause" : "Play");
    this.button.classList.toggle("on", on);
    this.last = performance.now();
    this.ask();
  }

  seek(time) {
    this.time = Math.min(Math.max(time, this.data.times[0]), this.data.times.at(-1));
    this.ask();
  }

  step(frames) {
    this.play(false);
    const next = Math.min(Math.max(Math.round(this.frame()) + frames, 0), this.data.times.length - 1);
    this.seek(this.data.times[next]);
  }

  frame() {  // As a real number: between two frames what is shown is linear in time.
    const times = this.data.times;
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= this.time) low = middle; else high = middle;
    }
    const share = (this.time - times[low]) / (times[high] - times[low]);
    return high === low ? low : low + Math.min(Math.max(share, 0.0), 1.0);
  }

  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => {
      this.asked = false;
      if (this.playing) {
        const since = Math.min(Math.max(now - this.last, 0), 100);  // A hidden page draws nothing; it goes on from there.
        this.time += since * 1e-3 * Number(this.speed.value);
        if (this.time >= this.data.times.at(-1)) this.time = this.data.times[0];
        this.last = now;
      }
      this.draw();
      if (this.playing) this.ask();
    });
  }

  // The vertices of a model's body, or false where it has diverged.
  body(model, frame) {
    const {place, rest, modes, weights} = this, frames = this.data.times.length, count = this.data.scales.length;
    const low = Math.floor(frame), high = Math.min(low + 1, frames - 1), share = frame - low;
    const row = (at) => (model * frames + at) * count;
    if (!Number.isFinite(weights[row(low)]) || (share > 0 && !Number.isFinite(weights[row(high)]))) return false;
    place.set(rest);
    for (let mode = 0; mode < count; mode++) {
      const before = weights[row(low) + mode];
      const weight = share > 0 ? (1 - share) * before + share * weights[row(high) + mode] : before;
      const factor = weight * this.data.scales[mode], start = mode * place.length;
      if (factor !== 0.0) for (let at = 0; at < place.length; at++) place[at] += factor * modes[start + at];
    }
    return true;
  }

  between(values, start, size, frame) {  // of frames that lie one after another, each of this size
    const low = Math.floor(frame), high = Math.min(low + 1, this.data.times.length - 1), share = frame - low;
    const out = new Float32Array(size);
    for (let at = 0; at < size; at++) {
      const before = values[start + low * size + at];
      out[at] = share > 0 ? (1 - share) * before + share * values[start + high * size + at] : before;
    }
    return out;
  }

  placed(frame) {  // The corners of the obstacles: their poses are a position and a rotation by rows.
    const {obstacles, owners, around} = this, size = 12 * (1 + owners.at(-1)), moves = this.poses.length > size;
    const poses = moves ? this.between(this.poses, 0, size, frame) : this.poses;
    for (let at = 0; at < owners.length; at++) {
      const own = 12 * owners[at];
      for (let axis = 0; axis < 3; axis++) {
        const row = own + 3 + 3 * axis;
        around[3 * at + axis] = poses[own + axis] + poses[row] * obstacles[3 * at]
          + poses[row + 1] * obstacles[3 * at + 1] + poses[row + 2] * obstacles[3 * at + 2];
      }
    }
    return around;
  }

  draw() {
    const {gl, canvas, data} = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    const paper = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).slice(0, 3).map((part) => part / 255);
    gl.clearColor(...paper, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.look(width / height);
    const frame = this.frame(), ticked = this.boxes.flatMap((box, model) => (box.checked ? [model] : []));
    const front = ticked.at(-1), tone = (model) => rgb(dark.matches ? data.models[model].dark : data.models[model].light);
    const outline = rgb(data.outline), dot = Math.max(0.02 * height, 7), coloured = this.switches.errors.checked;
    if (this.switches.rest.checked) {
      this.load(this.rest);
      this.lines("sharp", [...outline, 1], 0.0);
    }
    if (this.obstacles.length) {
      this.load(this.placed(frame));
      this.surface(rgb(data.solid), 1.0, false, 0.0, "sides");
    }
    if (front !== undefined && this.body(front, frame)) {
      const painted = coloured && this.paint(front, frame);
      this.load(this.place);
      this.surface(tone(front).map((each) => 0.45 + 0.55 * each), 1.0, painted, 0.0);
      const rim = painted ? [0.85, 0.87, 0.9] : [0.1, 0.13, 0.16];
      this.lines("edges", [...rim, 0.28], 0.0004);
      this.lines("sharp", [...rim, 0.8], 0.0005);
    }
    for (const model of ticked.slice(0, -1)) {
      if (!this.body(model, frame)) continue;
      this.load(this.place);
      this.lines("sharp", [...tone(model), 0.9], -0.0005);
      this.surface(tone(model), 0.22, false, -0.02);
    }
    this.markers(ticked, frame, tone, dot, coloured);
    this.said(frame, front, coloured);
    this.frames = (this.frames || 0) + 1;
    this.figure.dataset.drawn = String(this.frames);
  }

  look(aspect) {  // A parallel projection of the view's axes.
    const half = this.half(), deep = 4.0 * Math.max(...this.data.half) * Math.max(this.near, 1.0);
    const scales = [1 / (half * aspect), 1 / half, -1 / deep], camera = new Float32Array(16);
    this.axes.forEach((row, k) => {
      row.forEach((each, j) => { camera[4 * j + k] = scales[k] * each; });
      camera[12 + k] = -scales[k] * row.reduce((sum, each, j) => sum + each * this.focus[j], 0);
    });
    camera[15] = 1;
    this.gl.uniformMatrix4fv(this.at.camera, false, camera);
    const light = [0.3, 0.5, 0.81], lit = [0, 1, 2].map((j) => this.axes.reduce((sum, row, k) => sum + light[k] * row[j], 0));
    this.gl.uniform3fv(this.at.light, lit);
  }

  load(places, paints = null) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.places);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    if (paints === null) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.paints);
    gl.bufferData(gl.ARRAY_BUFFER, paints, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 1, gl.FLOAT, false, 0, 0);
  }

  style(kind, tone, painted, nearer, size = 1) {
    const gl = this.gl, clear = tone[3] < 1;
    gl.uniform1i(this.at.kind, kind);
    gl.uniform4fv(this.at.tone, tone);
    gl.uniform1i(this.at.painted, painted ? 1 : 0);
    gl.uniform1f(this.at.nearer, nearer);
    gl.uniform1f(this.at.size, size);
    if (!painted) gl.disableVertexAttribArray(1);
    if (clear) gl.enable(gl.BLEND); else gl.disable(gl.BLEND);
    gl.depthMask(!clear);
  }

  surface(tone, opacity, painted, nearer, name = "faces") {
    this.style(1, [...tone, opacity], painted, nearer);
    this.indexed(name, this.gl.TRIANGLES);
  }

  lines(name, tone, nearer) {
    this.style(0, tone, false, nearer);
    this.indexed(name, this.gl.LINES);
  }

  indexed(name, how) {
    const gl = this.gl, {buffer, count} = this.indices[name];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.drawElements(how, count, gl.UNSIGNED_INT, 0);
  }

  // Loads how far each vertex is from the target over the largest distance of the model; false where that is not known.
  paint(model, frame) {
    if (this.errors === null || !(this.data.models[model].largest > 0.0)) return false;
    const size = this.rest.length / 3, shares = this.between(this.errors, model * this.data.times.length * size, size, frame);
    this.load(this.place, shares.map((each) => each / 255));
    return true;
  }

  markers(ticked, frame, tone, dot, coloured) {
    const gl = this.gl, size = 3 * this.data.markers;
    if (!size) return;
    const measured = this.between(this.measured, 0, size, frame), front = ticked.at(-1);
    for (const model of ticked) {
      const places = this.between(this.simulated, model * this.data.times.length * size, size, frame);
      const largest = this.data.models[model].largest, painted = coloured && this.errors === null && model === front;
      const paints = Float32Array.from({length: size / 3}, (_, k) => 1e3 * Math.hypot(
        ...[0, 1, 2].map((axis) => places[3 * k + axis] - measured[3 * k + axis])) / largest);
      if (this.switches.markers.checked && model === front) {  // from where they were measured to where they should be
        const ends = new Float32Array(2 * size);
        for (let k = 0; k < size / 3; k++) {
          ends.set(measured.subarray(3 * k, 3 * k + 3), 6 * k);
          ends.set(places.subarray(3 * k, 3 * k + 3), 6 * k + 3);
        }
        this.load(ends);
        this.style(0, [...rgb(this.data.ink[dark.matches ? "dark" : "light"]), 1], false, 0.5);
        gl.drawArrays(gl.LINES, 0, 2 * size / 3);
      }
      this.load(places, paints);
      this.style(painted ? 2 : 3, [...tone(model), 1], painted, 0.5, 1.7 * dot);
      gl.drawArrays(gl.POINTS, 0, size / 3);
    }
    if (!this.switches.markers.checked) return;
    this.load(measured);
    this.style(2, [...rgb(this.data.seen), 1], false, 0.6, dot);
    gl.drawArrays(gl.POINTS, 0, size / 3);
  }

  said(frame, front, coloured) {
    const times = this.data.times, end = times.at(-1), at = Math.round(frame);
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    if (document.activeElement !== this.slider || this.playing) this.slider.value = end > 0 ? 1000 * this.time / end : 0;
    this.slider.setAttribute("aria-valuetext", `${this.time.toFixed(2)} of ${end.toFixed(2)} seconds`);
    this.means.forEach((output, model) => {
      const mean = this.data.models[model].means[at];
      output.textContent = mean === null ? "" : `${mean < 0.0995 ? mean.toPrecision(2) : mean.toFixed(2)} mm`;
    });
    const largest = front === undefined ? 0 : this.data.models[front].largest;
    this.legend.hidden = !(coloured && largest > 0);
    if (!this.legend.hidden) this.legend.querySelector(".most").textContent = `${Number(largest.toPrecision(2))} mm`;
  }
}

for (const figure of document.querySelectorAll("figure.view")) {
  try {
    figure.view = new View(figure);
    figure.classList.add("ready");
  } catch (error) {
    const failed = figure.querySelector(".failed");
    failed.textContent = `${error.message} The pictures show the same motion.`;
    failed.hidden = false;
    console.warn(error);
  }
}
})();
