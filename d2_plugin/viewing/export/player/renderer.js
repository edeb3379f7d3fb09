// Draws with WebGL 2: splats into sums of colour (or depth) and alpha, then those, or a recorded image, to the screen.
"use strict";

const MODES = ["color", "depth", "opacity", "recorded"];
const WIDTH = 4096;  // texels in a row of the data textures

// One model on the graphics card.
class Splats {
  constructor(gl, scene) {
    Object.assign(this, { gl, scene, states: new Map(), drawn: 0, order: texture(gl) });
    const { degree, time_degree: waves } = scene.model, terms = (degree + 1) ** 2 * (waves + 1), { lines, count } = scene;
    const more = terms > 1 ? [[scene.array("harmonics"), 3 * (terms - 1), 3]] : [];
    this.colors = this.upload(terms, terms > 1 ? gl.RGB16F : gl.RGB32F, [scene.array("colors"), 3, 0], ...more);
    this.motion = lines === null ? texture(gl) : this.upload(
      2, gl.RGBA32F, [lines.velocities, 3, 0], [lines.anchors, 1, 3], [lines.times, 1, 4], [lines.sigmas, 1, 5],
    );
    // Four corners and two triangles for each Gaussian: an instance for each is slow, most of all without a graphics card.
    const indices = new Uint32Array(6 * count), corners = [0, 1, 2, 2, 1, 3];
    for (let i = 0; i < indices.length; i++) indices[i] = 4 * Math.floor(i / 6) + corners[i % 6];
    this.quads = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.quads);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, WIDTH, Math.max(Math.ceil(count / WIDTH), 1));
  }

  // A texture with `per` texels for each Gaussian, from arrays: [values, how many a Gaussian has, their place in its row].
  upload(per, inside, ...parts) {
    const { gl } = this, { count } = this.scene, rgb = inside === gl.RGB16F || inside === gl.RGB32F, channels = rgb ? 3 : 4;
    const height = Math.max(Math.ceil((count * per) / WIDTH), 1), texels = new Float32Array(channels * WIDTH * height);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("this graphics card cannot hold so many Gaussians");
    for (const [values, columns, at] of parts) {
      for (let i = 0; i < count; i++) {
        for (let k = 0; k < columns; k++) texels[channels * per * i + at + k] = values[columns * i + k];
      }
    }
    const made = texture(gl);
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, WIDTH, height, 0, rgb ? gl.RGB : gl.RGBA, gl.FLOAT, texels);
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
      const { positions, shapes, opacities } = this.scene.state(key);
      this.states.set(key, this.upload(3, this.gl.RGBA32F, [positions, 3, 0], [opacities, 1, 3], [shapes, 6, 4]));
    }
    return this.states.get(key);
  }

  // Rows from the farthest to the nearest, as the worker sends them: whole rows of texels.
  setOrder({ order, count }) {
    const { gl } = this;
    this.drawn = count;
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, order.length / WIDTH, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
  }
}

class Renderer {
  constructor(canvas, header, raw) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2: open the page in a recent Chrome, Firefox, Safari or Edge");
    Object.assign(this, { gl, canvas, header });
    this.exact = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.splats = program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.finish = program(gl, FINISH_VERTEX, FINISH_FRAGMENT);
    this.models = header.models.map((model) => new Splats(gl, new Scene(header, model, raw)));
    const bytes = new Uint8Array(1024).fill(255), hex = header.palette;
    for (let i = 0; i < 768; i++) bytes[i + Math.floor(i / 3)] = parseInt(hex.slice(2 * i, 2 * i + 2), 16);
    this.palette = texture(gl);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    this.photo = texture(gl, gl.LINEAR);
    this.target = { width: 0, height: 0, frame: gl.createFramebuffer(), sums: texture(gl) };
  }

  // view: rotation [9] row-major, translation [3], centre [3], focal, principal, size, all in pixels of the image. sides:
  // what is drawn up to which share of the width, from left to right: {what: a model's number or a recorded image, until}.
  draw(view, time, mode, sides) {
    const { gl } = this, [width, height] = view.size;
    this.fit(width, height);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    let left = 0;
    for (const { what, until } of sides) {
      const right = Math.round(until * width);
      gl.scissor(left, 0, right - left, height);
      if (typeof what === "number") this.drawSplats(this.models[what], view, time, mode);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      this.drawScreen(what, view, mode);
      left = right;
    }
    gl.disable(gl.SCISSOR_TEST);
  }

  drawSplats(model, view, time, mode) {
    const { gl, header } = this, { scene } = model, { raster } = scene.model, { key, share } = scene.place(time);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { order, motion, colors } = model;
    const set = this.use(this.splats, { order, stateFrom: model.state(key), stateTo: model.state(key + 1), motion, colors });
    set.float({ share, time, cut: header.marginal_cut, duration: Math.max(header.duration, 1e-12) });
    // The blur of training is of the recording's pixels: what is thinner would be a hairline in an image of finer ones.
    const blur = raster.blur * Math.max(view.scale, 1) ** 2;
    set.float({ near: raster.near, blur, alphaMin: raster.alpha_min, alphaMax: raster.alpha_max });
    set.float({ fovClamp: raster.fov_clamp, depthUnit: header.depth_range[1] });
    set.whole({ lines: scene.lines ? 1 : 0, asDepth: mode === "depth" ? 1 : 0 });
    set.whole({ degree: scene.model.degree, timeDegree: scene.model.time_degree });
    gl.uniform3fv(set.place("translation"), view.translation);
    gl.uniform3fv(set.place("centre"), view.centre);
    set.view(view);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, model.quads);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * model.drawn, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
  }

  drawScreen(what, view, mode) {
    const { gl, header } = this, recorded = typeof what !== "number", sky = recorded ? null : header.models[what].background;
    const set = this.use(this.finish, { sums: this.target.sums, palette: this.palette, photo: this.photo });
    if (recorded) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, what.image);  // bound last
    set.whole({ mode: MODES.indexOf(recorded ? "recorded" : mode), hasSky: sky ? 1 : 0 });
    set.float({ depthUnit: header.depth_range[1], photoScale: view.scale });
    gl.uniform2fv(set.place("depthRange"), header.depth_range);
    if (recorded) gl.uniform2fv(set.place("photoSize"), what.size);
    if (sky) gl.uniform3fv(set.place("sky"), sky.flat());
    set.view(view);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
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
    const view = ({ focal, principal, size, rotation }) => {
      each(gl.uniform2fv.bind(gl))({ focal, principal, size });
      gl.uniformMatrix3fv(place("rotation"), true, rotation);
    };
    return { place, float: each(gl.uniform1f.bind(gl)), whole: each(gl.uniform1i.bind(gl)), view };
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

function texture(gl, filter = gl.NEAREST) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return made;
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
