// One model of this page, decoded. Runs in the page and in the worker; see coded.py and page.py for what is stored.
"use strict";

class Scene {
  // header: the table of the page; model: one of its models; raw: ArrayBuffer of all coded arrays behind each other.
  constructor(header, model, raw) {
    Object.assign(this, { header, model, raw, count: model.count });
    this.entries = new Map(model.arrays.map((entry) => [entry.name, entry]));
    this.keyTimes = model.keys ? model.keys : [0];
    this.base = { positions: this.array("positions"), shapes: this.shapes("shapes"), opacities: this.array("opacities") };
    this.lines = model.motion === "lines" ? this.decodeLines() : null;
    this.kept = new Map(this.has("positions_0") ? [] : [[0, this.base]]);
  }

  has(name) { return this.entries.has(name); }

  // Float32Array [rows * columns] of one array; each block of rows has its own range in each column.
  array(name) {
    const { rows, columns, bits, offset } = this.entries.get(name);
    const block = this.header.block, blocks = Math.ceil(rows / block);
    const ranges = new Float32Array(this.raw.slice(offset, offset + blocks * columns * 8));
    const bytes = new Uint8Array(this.raw, offset + blocks * columns * 8);
    const values = new Float32Array(rows * columns), kinds = bits > 8 ? 2 : 1, steps = 2 ** bits - 1;
    for (let column = 0; column < columns; column++) {
      const high = column * kinds * rows, low = high + rows;
      for (let row = 0; row < rows; row++) {
        const range = 2 * (Math.floor(row / block) * columns + column);
        const code = kinds === 2 ? bytes[high + row] * 256 + bytes[low + row] : bytes[high + row];
        values[row * columns + column] = ranges[range] + (code * (ranges[range + 1] - ranges[range])) / steps;
      }
    }
    return values;
  }

  // Cholesky factors [rows * 6] from the logarithm of a size and six entries relative to it.
  shapes(name) {
    const coded = this.array(name), rows = coded.length / 7, factors = new Float32Array(rows * 6);
    for (let row = 0; row < rows; row++) {
      const size = Math.exp(coded[7 * row]);
      for (let k = 0; k < 6; k++) factors[6 * row + k] = size * coded[7 * row + 1 + k];
    }
    return factors;
  }

  // Straight lines: for each Gaussian velocity, the time at which it is at its position, mean time and sigma.
  decodeLines() {
    const reach = this.array("reaches"), fading = this.array("fading"), count = this.count;
    const { duration, marginal_reach: cut } = this.header;
    const velocities = new Float32Array(count * 3), anchors = new Float32Array(count);
    const times = new Float32Array(count), sigmas = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      times[i] = fading[2 * i];
      sigmas[i] = Math.exp(fading[2 * i + 1]);
      anchors[i] = Math.min(Math.max(times[i], 0), duration);
      const span = Math.min(cut * sigmas[i], duration);
      for (let k = 0; k < 3; k++) velocities[3 * i + k] = span > 0 ? reach[3 * i + k] / span : 0;
    }
    return { velocities, anchors, times, sigmas };
  }

  // The key before `time` and how far it is to the next one, 0..1.
  place(time) {
    const times = this.keyTimes;
    let key = 0;
    while (key < times.length - 2 && time >= times[key + 1]) key++;
    const span = times.length > 1 ? times[key + 1] - times[key] : 0;
    return { key, share: span > 0 ? Math.min(Math.max((time - times[key]) / span, 0), 1) : 0 };
  }

  // All Gaussians at a key. Two keys are kept: those that are being played.
  state(key) {
    key = Math.min(key, this.keyTimes.length - 1);
    if (!this.kept.has(key)) {
      const state = {
        positions: this.base.positions.slice(), shapes: this.base.shapes.slice(), opacities: this.base.opacities.slice(),
      };
      state.positions.set(this.array(`positions_${key}`));
      if (this.has(`shapes_${key}`)) {
        state.shapes.set(this.shapes(`shapes_${key}`));
        state.opacities.set(this.array(`opacities_${key}`));
      }
      for (const other of this.kept.keys()) if (other !== key - 1 && other !== key + 1) this.kept.delete(other);
      this.kept.set(key, state);
    }
    return this.kept.get(key);
  }
}
