// The worker: which Gaussians are to be drawn at a time, from the farthest to the nearest.
"use strict";

let models = [];

onmessage = ({ data }) => {
  if (data.header) {
    models = data.header.models.map((model) => {
      const scene = new Scene(data.header, model, data.raw), fresh = () => new Uint32Array(scene.count);
      const depths = new Float32Array(scene.count);
      return { scene, depths, rows: fresh(), keys: new Uint32Array(depths.buffer), spareRows: fresh(), spareKeys: fresh() };
    });
    return;
  }
  const orders = data.shown.map((place) => farToNear(models[place], gather(models[place], data)));
  postMessage(orders, orders.map(({ order }) => order.buffer));
};

// Writes the rows that are seen and their depths; returns their number. forward, offset: depth = forward . x + offset.
function gather({ scene, rows, depths }, { forward: [fx, fy, fz], offset, time }) {
  const { key, share } = scene.place(time), { near, alpha_min: least } = scene.model.raster;
  const from = scene.state(key), to = scene.state(key + 1), lines = scene.lines;
  const p = from.positions, q = to.positions, cut = scene.header.marginal_cut;
  let found = 0;
  for (let i = 0; i < scene.count; i++) {
    let opacity = from.opacities[i] + share * (to.opacities[i] - from.opacities[i]);
    let x = p[3 * i] + share * (q[3 * i] - p[3 * i]);
    let y = p[3 * i + 1] + share * (q[3 * i + 1] - p[3 * i + 1]);
    let z = p[3 * i + 2] + share * (q[3 * i + 2] - p[3 * i + 2]);
    if (lines !== null) {
      const late = (time - lines.times[i]) / lines.sigmas[i], factor = Math.exp(-0.5 * late * late);
      if (factor <= cut) continue;
      const passed = time - lines.anchors[i];
      opacity *= factor;
      x += passed * lines.velocities[3 * i];
      y += passed * lines.velocities[3 * i + 1];
      z += passed * lines.velocities[3 * i + 2];
    }
    const depth = fx * x + fy * y + fz * z + offset;
    if (opacity < least || depth <= near) continue;
    rows[found] = i;
    depths[found++] = depth;
  }
  return found;
}

// Radix sort by the bits of the depth, which for positive floats are in the order of the depths; 16 bits at a time.
function farToNear({ rows, keys, spareRows, spareKeys }, count) {
  const order = new Uint32Array(4096 * Math.max(Math.ceil(count / 4096), 1));  // whole rows of texels
  pass(rows, keys, spareRows, spareKeys, count, 0);
  pass(spareRows, spareKeys, order, keys, count, 16);
  return { order, count };
}

function pass(fromRows, fromKeys, toRows, toKeys, count, shift) {
  const places = new Uint32Array(65537);
  for (let i = 0; i < count; i++) places[65536 - ((fromKeys[i] >>> shift) & 65535)]++;
  for (let i = 0; i < 65536; i++) places[i + 1] += places[i];
  for (let i = 0; i < count; i++) {
    const place = places[65535 - ((fromKeys[i] >>> shift) & 65535)]++;
    toRows[place] = fromRows[i];
    toKeys[place] = fromKeys[i];
  }
}
