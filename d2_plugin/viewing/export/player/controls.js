// The camera that a person moves: turn around a point, shift, come nearer, fly. It stays where the recording's cameras
// were, with a margin: nothing else was seen. OpenCV axes: right, down, forward.
"use strict";

const EDGE = 0.08;  // of the room that there is: nearer to its end the image fades

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const clamp = (value, [least, most]) => Math.min(Math.max(value, least), most);

// `vector` turned about the unit `axis` (Rodrigues).
function turned(vector, axis, angle) {
  const along = dot(axis, vector), sideways = cross(axis, vector), c = Math.cos(angle), s = Math.sin(angle);
  return vector.map((value, k) => c * value + s * sideways[k] + (1 - c) * along * axis[k]);
}

function lookAt(centre, target, up) {
  const forward = unit(plus(target, centre, -1)), right = unit(cross(forward, up));
  return [right, cross(forward, right), forward];
}

class FreeCamera {
  // header: `focus` is what the cameras look at, `home` a camera in front of it, `limits` azimuth and elevation (radians,
  // azimuth 0 at home; null where cameras stand all around) and distance from the focus.
  constructor({ up, focus, home, limits }) {
    Object.assign(this, { up, home, limits, middle: focus });
    this.place(home);
    home.centre = this.centre;
    const flat = plus(this.centre, focus, -1);
    this.ahead = unit(plus(flat, up, -dot(flat, up)));
    this.east = cross(up, this.ahead);
    this.start = this.polar();
  }

  // Stand where a camera of the recording stood, or at home.
  place(camera) {
    this.camera = camera;
    this.axes = [0, 1, 2].map((row) => camera.rotation.slice(3 * row, 3 * row + 3));
    this.centre = [0, 1, 2].map((k) => -[0, 1, 2].reduce((sum, row) => sum + this.axes[row][k] * camera.translation[row], 0));
    this.focusAhead(Math.max(dot(plus(this.middle, this.centre, -1), this.axes[2]), 1e-3));
    this.moved = false;
  }

  focusAhead(distance) { this.focus = plus(this.centre, this.axes[2], distance); }

  get distance() { return Math.hypot(...plus(this.focus, this.centre, -1)); }

  // The camera of the recording that this one stands at.
  get standing() { return this.moved || this.camera === this.home ? null : this.camera; }

  // What `Renderer.draw` takes, for an image of this size: filled, so that nothing is seen beside the recorded image.
  view(width, height) {
    const { camera, axes, centre } = this, scale = Math.max(width / camera.width, height / camera.height);
    const principal = [
      width / 2 + scale * (camera.principal[0] - camera.width / 2),
      height / 2 + scale * (camera.principal[1] - camera.height / 2),
    ];
    const focal = camera.focal.map((value) => scale * value);
    const translation = this.moved ? axes.map((axis) => -dot(axis, centre)) : camera.translation;
    return { rotation: axes.flat(), translation, centre, focal, principal, size: [width, height], scale };
  }

  polar() {
    const offset = plus(this.centre, this.middle, -1), distance = Math.hypot(...offset);
    return {
      azimuth: Math.atan2(dot(offset, this.east), dot(offset, this.ahead)),
      elevation: Math.asin(clamp(dot(offset, this.up) / distance, [-1, 1])), distance,
    };
  }

  // Stand at polar coordinates about what the cameras look at, and look there (`aim`) or go on looking as before.
  standAt({ azimuth, elevation, distance }, aim) {
    const level = plus(this.ahead.map((v) => v * Math.cos(azimuth)), this.east, Math.sin(azimuth)), apart = this.distance;
    const towards = plus(level.map((v) => v * Math.cos(elevation)), this.up, Math.sin(elevation));
    this.centre = plus(this.middle, towards, distance);
    if (aim) this.axes = lookAt(this.centre, this.focus, this.up);
    else this.focusAhead(apart);
  }

  keepInside(aim) {
    this.moved = true;
    const at = this.polar(), inside = { ...at };
    for (const [name, ends] of Object.entries(this.limits)) if (ends) inside[name] = clamp(at[name], ends);
    if (Object.keys(at).some((name) => at[name] !== inside[name])) this.standAt(inside, aim);
  }

  // 0 inside, 1 at an end of the room.
  get edge() {
    if (!this.moved) return 0;
    const at = this.polar(), near = ([name, ends]) => {
      const room = ends ? Math.min(at[name] - ends[0], ends[1] - at[name]) / (ends[1] - ends[0]) : EDGE;
      return 1 - room / EDGE;
    };
    return clamp(Math.max(...Object.entries(this.limits).map(near)), [0, 1]);
  }

  // Angles in radians, about what is up and about the image's horizontal.
  orbit(right, down) {
    const steep = Math.acos(clamp(-dot(this.axes[2], this.up), [-1, 1]));
    const tilt = clamp(steep - down, [0.05, Math.PI - 0.05]) - steep, level = this.axes[0];
    const turn = (vector) => turned(turned(vector, level, tilt), this.up, right);
    this.axes = this.axes.map(turn);
    this.centre = plus(this.focus, turn(plus(this.centre, this.focus, -1)));
    this.keepInside(true);
  }

  // An orbit by itself: to and fro as far as the cameras stood, or all around; `phase` in radians.
  swing(phase) {
    const most = this.limits.azimuth;
    this.focus = this.middle;
    this.standAt({ ...this.start, azimuth: most ? 0.8 * most[1] * Math.sin(phase) : phase }, true);
    this.moved = true;
  }

  // Move by (right, down, forward) in parts of the distance to what is looked at.
  fly(by) {
    const size = this.distance, step = by.reduce((sum, part, k) => plus(sum, this.axes[k], part * size), [0, 0, 0]);
    this.centre = plus(this.centre, step);
    this.focus = plus(this.focus, step);
    this.keepInside(false);
  }

  // Distance to the focus times `factor`.
  approach(factor) {
    this.centre = plus(this.focus, plus(this.centre, this.focus, -1), factor);
    this.keepInside(true);
  }
}

// Mouse, touch and wheel on an element move the camera; `changed` is called after each movement.
function listen(element, camera, changed) {
  const fingers = new Map();
  const shift = (dx, dy) => {
    const focal = camera.view(element.clientWidth, element.clientHeight).focal[0];
    camera.fly([-dx / focal, -dy / focal, 0]);
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    element.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  element.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
    if (fingers.size === 2) {
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
      camera.approach(Math.max(apart(before), 1) / Math.max(apart(event), 1));
      shift(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) {
      shift(dx, dy);
    } else {
      camera.orbit(-dx * 0.005, dy * 0.005);
    }
    fingers.set(event.pointerId, event);
    changed();
  });
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.approach(Math.exp(Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.001));
    changed();
  }, { passive: false });
}
