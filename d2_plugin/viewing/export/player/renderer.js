// Draws the scene with WebGL 2: splats into sums of colour (or depth) and alpha, then those to the screen.
"use strict";

const MODES = ["color", "depth", "opacity"];
const WIDTH = 4096;  // texels in a row of the data textures

class Renderer {
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2: open the page in a recent Chrome, Firefox, Safari or Edge");
    this.gl = gl;
    this.canvas = canvas;
    this.scene = scene;
    this.exact = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.splats = program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.finish = program(gl, FINISH_VERTEX, FINISH_FRAGMENT);
    this.uploadColors();
    this.uploadPalette();
    this.motion = scene.lines ? this.uploadLines(scene.lines) : texture(gl);
    this.states = new Map();
    this.target = { width: 0, height: 0, frame: gl.createFramebuffer(), sums: texture(gl) };
    this.order = texture(gl);
    this.drawn = 0;
    this.indexQuads();
  }

  // Four corners and two triangles for each Gaussian: an instance for each is slow, most of all without a graphics card.
  indexQuads() {
    const { gl, scene } = this, indices = new Uint32Array(6 * scene.count), corners = [0, 1, 2, 2, 1, 3];
    for (let i = 0; i < indices.length; i++) indices[i] = 4 * Math.floor(i / 6) + corners[i % 6];
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, WIDTH, Math.max(Math.ceil(scene.count / WIDTH), 1));
  }

  uploadColors() {
    const { gl, scene } = this, { degree, time_degree: waves } = scene.header, terms = (degree + 1) ** 2 * (waves + 1);
    const base = scene.array("colors"), more = scene.has("harmonics") ? scene.array("harmonics") : null;
    const texels = blank(scene.count * terms);
    for (let i = 0; i < scene.count; i++) {
      for (let term = 0; term < terms; term++) {
        for (let k = 0; k < 3; k++) {
          const value = term === 0 ? base[3 * i + k] : more[3 * ((terms - 1) * i + term - 1) + k];
          texels[4 * (i * terms + term) + k] = value;
        }
      }
    }
    this.colors = texture(gl);
    fill(gl, this.colors, texels, terms > 1 ? gl.RGBA16F : gl.RGBA32F);
  }

  uploadPalette() {
    const { gl } = this, hex = this.scene.header.palette, bytes = new Uint8Array(1024).fill(255);
    for (let i = 0; i < 256; i++) {
      for (let k = 0; k < 3; k++) bytes[4 * i + k] = parseInt(hex.slice(6 * i + 2 * k, 6 * i + 2 * k + 2), 16);
    }
    this.palette = texture(gl);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  }

  uploadLines({ velocities, anchors, times, sigmas }) {
    const texels = blank(2 * this.scene.count);
    for (let i = 0; i < this.scene.count; i++) {
      texels.set(velocities.subarray(3 * i, 3 * i + 3), 8 * i);
      texels[8 * i + 3] = anchors[i];
      texels[8 * i + 4] = times[i];
      texels[8 * i + 5] = sigmas[i];
    }
    const made = texture(this.gl);
    fill(this.gl, made, texels, this.gl.RGBA32F);
    return made;
  }

  // The texture of a key's state; those of two keys are kept.
  state(key) {
    key = Math.min(key, this.scene.keyTimes.length - 1);
    if (!this.states.has(key)) {
      for (const [other, made] of this.states) {
        if (other === key - 1 || other === key + 1) continue;
        this.gl.deleteTexture(made);
        this.states.delete(other);
      }
      const { positions, shapes, opacities } = this.scene.state(key), texels = blank(3 * this.scene.count);
      for (let i = 0; i < this.scene.count; i++) {
        texels.set(positions.subarray(3 * i, 3 * i + 3), 12 * i);
        texels[12 * i + 3] = opacities[i];
        texels.set(shapes.subarray(6 * i, 6 * i + 6), 12 * i + 4);
      }
      const made = texture(this.gl);
      fill(this.gl, made, texels, this.gl.RGBA32F);
      this.states.set(key, made);
    }
    return this.states.get(key);
  }

  // Rows from the farthest to the nearest, as the worker sends them: whole rows of texels.
  setOrder(order, count) {
    const { gl } = this;
    this.drawn = count;
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, order.length / WIDTH, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
  }

  // view: rotation [9] row-major, translation [3], centre [3], focal, principal, size, all in pixels of the image.
  draw(view, time, mode) {
    const { gl, scene } = this, [width, height] = view.size;
    this.fit(width, height);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { key, share } = scene.place(time), from = this.state(key), to = this.state(key + 1);
    const { order, motion, colors } = this;
    const set = this.use(this.splats, { order, stateFrom: from, stateTo: to, motion, colors });
    this.splatSettings(set, view, time, share, mode);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * this.drawn, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.finishSettings(this.use(this.finish, { sums: this.target.sums, palette: this.palette }), view, mode);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  splatSettings(set, view, time, share, mode) {
    const { header } = this.scene, { gl } = this, { raster } = header;
    set.float({ share, time, cut: header.marginal_cut, duration: Math.max(header.duration, 1e-12) });
    set.float({ near: raster.near, blur: raster.blur, alphaMin: raster.alpha_min, alphaMax: raster.alpha_max });
    set.float({ fovClamp: Math.min(raster.fov_clamp, 1e6), depthUnit: header.depth_range[1] });
    set.whole({ lines: this.scene.lines ? 1 : 0, asDepth: mode === "depth" ? 1 : 0 });
    set.whole({ degree: header.degree, timeDegree: header.time_degree });
    gl.uniformMatrix3fv(set.place("rotation"), true, view.rotation);
    gl.uniform3fv(set.place("translation"), view.translation);
    gl.uniform3fv(set.place("centre"), view.centre);
    set.pair(view);
  }

  finishSettings(set, view, mode) {
    const { header } = this.scene, { gl } = this;
    set.whole({ mode: MODES.indexOf(mode), hasSky: header.background ? 1 : 0 });
    set.float({ depthUnit: header.depth_range[1] });
    gl.uniform2fv(set.place("depthRange"), header.depth_range);
    gl.uniformMatrix3fv(set.place("rotation"), true, view.rotation);
    if (header.background) gl.uniform3fv(set.place("sky"), header.background.flat());
    set.pair(view);
  }

  use(made, textures) {
    const { gl } = this;
    gl.useProgram(made);
    const place = (name) => gl.getUniformLocation(made, name);
    Object.entries(textures).forEach(([name, source], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, source);
      gl.uniform1i(place(name), unit);
    });
    const each = (set) => (values) => Object.entries(values).forEach(([name, value]) => set(place(name), value));
    const pair = ({ focal, principal, size }) => each(gl.uniform2fv.bind(gl))({ focal, principal, size });
    return { place, float: each(gl.uniform1f.bind(gl)), whole: each(gl.uniform1i.bind(gl)), pair };
  }

  // Makes canvas and sums as large as the image. Half floats: bytes would be rounded once for every Gaussian.
  fit(width, height) {
    const { gl, canvas, target } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    if (target.width === width && target.height === height) return;
    [target.width, target.height] = [width, height];
    gl.bindTexture(gl.TEXTURE_2D, target.sums);
    const [inside, type] = this.exact ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, gl.RGBA, type, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.sums, 0);
  }
}

function blank(texels) { return new Float32Array(4 * WIDTH * Math.max(Math.ceil(texels / WIDTH), 1)); }

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return made;
}

function fill(gl, made, texels, inside) {
  const height = texels.length / (4 * WIDTH);
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("this graphics card cannot hold so many Gaussians");
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, WIDTH, height, 0, gl.RGBA, gl.FLOAT, texels);
}

function program(gl, ...sources) {
  const made = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, sources[i]);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}
