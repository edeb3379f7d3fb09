// The camera that a person moves: turn around a point, shift, come nearer. OpenCV axes: right, down, forward.
"use strict";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// `vector` turned about the unit `axis` (Rodrigues).
function turned(vector, axis, angle) {
  const along = dot(axis, vector), sideways = cross(axis, vector), c = Math.cos(angle), s = Math.sin(angle);
  return vector.map((value, k) => c * value + s * sideways[k] + (1 - c) * along * axis[k]);
}

class FreeCamera {
  constructor(header) {
    this.up = header.up;
    this.focusAll = header.focus;
  }

  // Stand where a camera of the recording stood.
  place(camera) {
    this.camera = camera;
    this.axes = [0, 1, 2].map((row) => camera.rotation.slice(3 * row, 3 * row + 3));
    this.centre = [0, 1, 2].map((k) => -[0, 1, 2].reduce((sum, row) => sum + this.axes[row][k] * camera.translation[row], 0));
    const ahead = dot(plus(this.focusAll, this.centre, -1), this.axes[2]);
    this.focus = plus(this.centre, this.axes[2], Math.max(ahead, 1e-3));
    this.moved = false;
  }

  get distance() { return Math.hypot(...plus(this.focus, this.centre, -1)); }

  // What `Renderer.draw` takes, for an image of this size: the whole image of the camera fits into it.
  view(width, height) {
    const { camera, axes, centre } = this, scale = Math.min(width / camera.width, height / camera.height);
    const principal = [
      width / 2 + scale * (camera.principal[0] - camera.width / 2),
      height / 2 + scale * (camera.principal[1] - camera.height / 2),
    ];
    const focal = camera.focal.map((value) => scale * value);
    const translation = this.moved ? axes.map((axis) => -dot(axis, centre)) : camera.translation;
    return { rotation: axes.flat(), translation, centre, focal, principal, size: [width, height] };
  }

  // Angles in radians, about what is up and about the image's horizontal.
  orbit(right, down) {
    const forward = this.axes[2], steep = Math.acos(Math.min(Math.max(-dot(forward, this.up), -1), 1));
    const tilt = Math.min(Math.max(steep - down, 0.05), Math.PI - 0.05) - steep;
    const level = this.axes[0];
    const turn = (vector) => turned(turned(vector, level, tilt), this.up, right);
    this.axes = this.axes.map(turn);
    this.centre = plus(this.focus, turn(plus(this.centre, this.focus, -1)));
    this.moved = true;
  }

  // Pixels of an image with this focal length: what is at the focus follows the pointer.
  shift(right, down, focal) {
    const step = this.distance / focal, by = plus(this.axes[0].map((v) => -v * right * step), this.axes[1], -down * step);
    this.centre = plus(this.centre, by);
    this.focus = plus(this.focus, by);
    this.moved = true;
  }

  // Distance to the focus times `factor`.
  approach(factor) {
    this.centre = plus(this.focus, plus(this.centre, this.focus, -1), factor);
    this.moved = true;
  }
}

// Mouse, touch and wheel on an element move the camera; `changed` is called after each movement.
function listen(element, camera, changed) {
  const fingers = new Map();
  const focal = () => camera.view(element.clientWidth, element.clientHeight).focal[0];
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
      camera.shift(dx / 2, dy / 2, focal());
    } else if (event.buttons & 2 || event.shiftKey) {
      camera.shift(dx, dy, focal());
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
