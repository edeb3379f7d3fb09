// The page: reads its own data, plays it, and listens to the person. Nothing is loaded from anywhere.
"use strict";

const byId = (id) => document.getElementById(id);
const keyOf = ({ key }) => (key.length > 1 ? key : key.toLowerCase());  // a letter is the same with Shift or Caps Lock
const RECORDED = "recorded";
const LEAST_SHAPE = 0.8;      // width / height of the image on a tall screen: more height would show what nobody recorded
const ORBIT_SECONDS = 16;     // of one swing
const FLIGHT = 0.5;           // parts of the distance to what is looked at, in a second
const KEYS_OF_FLIGHT = {
  a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0], w: [0, 0, 1], s: [0, 0, -1],
};
const KEYS_OF_ORBIT = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

class Player {
  constructor(header, raw) {
    this.header = header;
    this.renderer = new Renderer(byId("image"), header, raw);
    this.camera = new FreeCamera(header);
    this.photos = new Photos(header, raw, () => this.change());
    this.time = 0;
    this.mode = "color";
    this.wipe = 0.5;
    this.held = new Set();   // keys
    this.pace = new Pace();
    this.wanted = true;      // something changed since the last image
    const code = new Blob([byId("worker").textContent], { type: "text/javascript" });
    this.worker = new Worker(URL.createObjectURL(code));
    this.worker.postMessage({ header, raw });
    this.worker.onerror = (event) => fail(`the sorting of Gaussians failed: ${event.message}`);
    this.worker.onmessage = ({ data }) => this.draw(data);
    this.fillPage();
    this.listen();
    this.begin();
    this.last = performance.now();
    requestAnimationFrame((now) => this.tick(now));
  }

  // Names come from files and are only ever set as text.
  fillPage() {
    const { header } = this, { models, cameras, recorded } = header;
    document.title = byId("name").textContent = byId("heading").textContent = header.name;
    for (const [held, label] of [[true, "held-out cameras"], [false, "training cameras"]]) {
      const group = document.createElement("optgroup");
      group.label = label;
      cameras.forEach((camera, i) => { if (camera.held_out === held) group.appendChild(new Option(camera.name, i)); });
      if (group.children.length) byId("camera").appendChild(group);
    }
    for (const line of header.about) byId("facts").appendChild(document.createElement("li")).textContent = line;
    for (const side of ["left", "right"]) {
      models.forEach(({ name }, i) => byId(side).appendChild(new Option(name, i)));
      if (Object.keys(recorded).length) byId(side).appendChild(new Option(RECORDED, RECORDED));
    }
    byId("sides").hidden = byId("left").length < 2;
    byId("time").max = header.duration;
    byId("time").step = header.duration / 1000 || 1;
    for (const id of ["play", "time", "speed"]) byId(id).disabled = header.seconds.length < 2;
    const scale = byId("scale").getContext("2d");
    for (let i = 0; i < 256; i++) {
      scale.fillStyle = `#${header.palette.slice(6 * i, 6 * i + 6)}`;
      scale.fillRect(i, 0, 1, 1);
    }
    [byId("nearest").textContent, byId("farthest").textContent] = header.depth_range.map((depth) => depth.toPrecision(3));
  }

  listen() {
    const on = (id, name, act) => byId(id).addEventListener(name, act);
    const pressed = (id, to) => byId(id).setAttribute(id === "orbit" ? "aria-pressed" : "aria-expanded", to);
    this.acts = {
      play: () => this.play(!this.playing),
      orbit: () => this.swing(!this.swinging),
      link: () => this.share(),
      save: () => this.save(),
      full: () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()),
      about: () => { pressed("about", !(byId("notes").hidden = !byId("notes").hidden)); this.acts.more(false); },
      more: (on) => pressed("more", byId("rest").classList.toggle("open", on)),
    };
    for (const [id, act] of Object.entries(this.acts)) on(id, "click", () => act());
    listen(byId("image"), this.camera, () => { this.swing(false); this.change(); });
    on("time", "input", () => { this.play(false); this.goTo(Number(byId("time").value)); });
    on("mode", "change", () => this.setMode(byId("mode").value));
    on("camera", "change", () => this.standAt(byId("camera").value));
    for (const id of ["left", "right", "wipe"]) on(id, "input", () => this.change());
    addEventListener("resize", () => this.change());
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", (event) => this.held.delete(keyOf(event)));
    addEventListener("blur", () => this.held.clear());
  }

  // As the link says, or at the held-out camera nearest to home where there is something to compare, else at home.
  begin() {
    const { header } = this, given = new URLSearchParams(location.hash.slice(1)), number = (name) => Number(given.get(name)) || 0;
    const far = header.cameras.map(({ held_out: held, name, ...camera }) => {
      this.camera.place(camera);
      return held && header.recorded[name] ? Math.hypot(...plus(this.camera.centre, this.camera.home.centre, -1)) : Infinity;
    });
    const compared = Math.min(...far) < Infinity ? far.indexOf(Math.min(...far)) : -1;
    byId("left").value = given.get("left") || (header.models.length > 1 || compared < 0 ? 0 : RECORDED);
    byId("right").value = given.get("right") || header.models.length - 1;
    for (const side of ["left", "right"]) if (byId(side).selectedIndex < 0) byId(side).selectedIndex = 0;
    byId("wipe").value = given.get("wipe") || 0.5;
    this.standAt(given.get("camera") || (compared < 0 ? "home" : String(compared)));
    const pose = (given.get("pose") || "").split(",").map(Number);
    if (pose.length === 15 && pose.every(Number.isFinite)) {
      const [centre, focus] = [pose.slice(0, 3), pose.slice(3, 6)], axes = [6, 9, 12].map((at) => pose.slice(at, at + 3));
      Object.assign(this.camera, { centre, focus, axes });
      this.camera.keepInside(true);
    }
    this.setMode(MODES.includes(given.get("mode")) ? given.get("mode") : "color");
    this.goTo(number("time"));
  }

  // The address of this page as it is seen now; set, and copied where the browser allows it.
  share() {
    const { camera } = this, values = ["left", "right", "wipe", "camera", "mode"].map((id) => [id, byId(id).value]);
    if (camera.moved) {
      values.push(["pose", [...camera.centre, ...camera.focus, ...camera.axes.flat()].map((v) => +v.toFixed(5)).join(",")]);
    }
    location.hash = new URLSearchParams([...values, ["time", this.time.toFixed(3)]]);
    if (navigator.clipboard) navigator.clipboard.writeText(location.href).catch(() => {});
  }

  key(event) {
    const { tagName, type } = event.target, key = keyOf(event);
    if (event.ctrlKey || event.metaKey || event.altKey || tagName === "SELECT") return;
    if ((type === "range" && key.startsWith("Arrow")) || (tagName === "BUTTON" && key === " ")) return;
    const modes = [...byId("mode").options].map((option) => option.value);
    const acts = {
      " ": this.acts.play, o: this.acts.orbit, f: this.acts.full, h: () => this.standAt("home"),
      ".": () => this.step(1), ",": () => this.step(-1),
      c: () => this.setMode(modes[(modes.indexOf(this.mode) + 1) % modes.length]),
    };
    if (!acts[key] && !KEYS_OF_FLIGHT[key] && !KEYS_OF_ORBIT[key]) return;
    event.preventDefault();
    if (acts[key]) return acts[key]();
    this.swing(false);
    this.held.add(key);
  }

  change() { this.wanted = true; this.sharp = false; this.touched = performance.now(); }

  play(on) {
    this.playing = on && this.header.duration > 0;
    byId("play").textContent = this.playing ? "❚❚" : "►";
    byId("play").setAttribute("aria-label", this.playing ? "pause" : "play");
    this.change();
  }

  swing(on) {
    this.swinging = on;
    this.phase = 0;
    byId("orbit").setAttribute("aria-pressed", on);
  }

  standAt(value) {
    const { cameras, home } = this.header;
    this.swing(false);
    this.camera.place(cameras[value] || home);
    this.change();
  }

  goTo(time) { this.time = clamp(time, [0, this.header.duration]); this.change(); }

  step(frames) {
    this.play(false);
    this.goTo(this.header.seconds[clamp(this.frame() + frames, [0, this.header.seconds.length - 1])]);
  }

  frame() {
    const apart = this.header.seconds.map((seconds) => Math.abs(seconds - this.time));
    return apart.indexOf(Math.min(...apart));
  }

  setMode(mode) {
    this.mode = byId("mode").value = mode;
    byId("legend").hidden = mode !== "depth";
    this.change();
  }

  tick(now) {
    const passed = clamp((now - this.last) / 1000, [0, 0.25]), moving = this.playing || this.swinging || this.held.size > 0;
    this.last = now;
    if (this.playing) {
      const next = this.time + passed * Number(byId("speed").value);
      this.time = next > this.header.duration ? 0 : next;
    }
    if (this.swinging) this.camera.swing(this.phase += (2 * Math.PI * passed) / ORBIT_SECONDS);
    for (const key of this.held) {
      const turn = KEYS_OF_ORBIT[key];
      if (turn) this.camera.orbit(...turn.map((part) => part * passed));
      else this.camera.fly(KEYS_OF_FLIGHT[key].map((part) => part * passed * FLIGHT));
    }
    if (moving) this.change();
    const quiet = !moving && now - this.touched > 300;
    if ((this.wanted || (quiet && !this.sharp)) && !this.busy && !this.waiting) {
      this.showControls();
      this.sharp = quiet;
      this.sort(this.screenView(quiet ? 1 : this.pace.coarse), this.sides());
    }
    requestAnimationFrame((next) => this.tick(next));
  }

  // What is shown on the left of the wipe and on its right; the recording only where it was made.
  sides() {
    const at = this.camera.standing, image = at && this.photos.at(at, this.time);
    const chosen = ["left", "right"].map((id) => byId(id).value).filter((what) => what !== RECORDED || image);
    const shown = [...new Set(chosen.length ? chosen : [this.header.models.length - 1])];
    const { clientWidth: width } = byId("wipe"), share = Number(byId("wipe").value);
    const until = width > 44 ? (22 + share * (width - 44)) / width : share;  // where the middle of its knob stands
    return shown.map((what, i) => ({
      what: what === RECORDED ? { image, size: [at.width, at.height] } : Number(what), until: i + 1 < shown.length ? until : 1,
    }));
  }

  showControls() {
    const { header, camera } = this, sides = this.sides(), at = camera.standing;
    byId("time").value = this.time;
    byId("clock").firstChild.data = `${this.time.toFixed(2)} s`;
    byId("clock").lastChild.textContent = ` · frame ${header.frames[this.frame()]}`;
    byId("camera").value = at ? header.cameras.indexOf(at) : "home";
    byId("wipe").hidden = sides.length < 2;
    byId("stage").style.setProperty("--edge", camera.edge);
    const said = sides.map(({ what }) => {
      if (typeof what !== "number") return "recorded";
      const { name, scores } = header.models[what], score = scores[at ? at.name : ""];
      return score === undefined ? name : `${name}\n${score.toFixed(1)} dB ${at ? "at this camera" : "held out"}`;
    });
    byId("leftside").textContent = said.length > 1 || header.models.length > 1 || at ? said[0] : "";
    byId("rightside").textContent = said[1] || "";
  }

  // The view for the stage, with as many pixels as the screen has, or fewer by `coarse` each way.
  screenView(coarse) {
    const { clientWidth, clientHeight } = byId("stage"), { width, height } = this.camera.camera;
    const most = Math.max(width / height, LEAST_SHAPE), ratio = devicePixelRatio / coarse;
    const tall = Math.min(clientHeight, clientWidth / LEAST_SHAPE), wide = Math.min(clientWidth, tall * most);
    byId("stage").style.setProperty("--wide", `${wide}px`);
    byId("stage").style.setProperty("--tall", `${tall}px`);
    return this.camera.view(Math.max(Math.round(wide * ratio), 1), Math.max(Math.round(tall * ratio), 1));
  }

  sort(view, sides) {
    this.busy = true;
    this.wanted = false;
    this.asked = { view, sides, time: this.time, mode: this.mode, start: performance.now() };
    const shown = sides.map(({ what }) => what).filter((what) => typeof what === "number");
    this.worker.postMessage({ shown, forward: view.rotation.slice(6, 9), offset: view.translation[2], time: this.time });
    this.asked.shown = shown;
  }

  draw(orders) {
    const { view, sides, shown, time, mode, start } = this.asked, { gl } = this.renderer;
    shown.forEach((place, i) => this.renderer.models[place].setOrder(orders[i]));
    this.renderer.draw(view, time, mode, sides);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits until it is drawn
    this.busy = false;
    if (this.waiting) this.waiting();
    else this.pace.note(view.size[0] * view.size[1], (performance.now() - start) / 1000, this.screenView(1).size);
    this.waiting = null;
  }

  // The image of a camera of the recording at a time, in the camera's own size, as the address of a PNG; `what` is the
  // number of a model, or "recorded".
  async image(name, time, mode = "color", what = this.header.models.length - 1) {
    const camera = this.header.cameras.find((other) => other.name === name);
    if (!camera) throw new Error(`no camera '${name}'`);
    const free = new FreeCamera(this.header);
    free.place(camera);
    const shown = what === RECORDED ? { image: await this.photos.ready(camera, time), size: [camera.width, camera.height] } : what;
    return this.still(free.view(camera.width, camera.height), time, mode, [{ what: shown, until: 1 }]);
  }

  async still(view, time, mode, sides) {
    this.play(false);
    while (this.busy) await new Promise((resolve) => setTimeout(resolve, 1));
    const before = [this.time, this.mode];
    [this.time, this.mode] = [time, mode];
    await new Promise((resolve) => { this.waiting = resolve; this.sort(view, sides); });
    const address = byId("image").toDataURL("image/png");
    [this.time, this.mode] = before;
    this.change();
    return address;
  }

  async save() {
    const link = document.createElement("a");
    link.href = await this.still(this.screenView(1), this.time, this.mode, this.sides());
    link.download = `${this.header.name.replace(/[^\w.-]+/g, "_")}_${this.time.toFixed(2)}s.png`;
    link.click();
  }
}

// The recorded images of one camera after the other: all of it are decoded when one is asked for.
class Photos {
  constructor(header, raw, changed) { Object.assign(this, { header, raw, changed, decoded: [] }); }

  load(camera) {
    if (this.camera === camera) return this.loaded;
    const kept = this.header.recorded[camera.name] || [], blob = ([, at, length]) => new Blob([this.raw.slice(at, at + length)]);
    Object.assign(this, { camera, decoded: [] });
    this.loaded = Promise.all(kept.map((entry) => createImageBitmap(blob(entry)))).then((images) => {
      if (this.camera === camera) this.decoded = images.map((image, i) => ({ image, time: kept[i][0] }));
      this.changed();
    });
    return this.loaded;
  }

  // The image nearest in time; none before it is there.
  at(camera, time) {
    this.load(camera);
    const apart = this.decoded.map((photo) => Math.abs(photo.time - time));
    return apart.length ? this.decoded[apart.indexOf(Math.min(...apart))].image : null;
  }

  async ready(camera, time) {
    await this.load(camera);
    return this.at(camera, time);
  }
}

function fail(message) {
  byId("message").textContent = message;
  byId("message").hidden = false;
}

async function start() {
  clearInterval(loading);
  const header = JSON.parse(byId("header").textContent);
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser cannot unpack the data: open the page in a Chrome, Firefox, Safari or Edge of 2023 or later");
  }
  byId("clock").append("", Object.assign(document.createElement("span"), { className: "frame" }));
  await new Promise((resolve) => setTimeout(resolve));  // show what stands there so far
  const text = atob(byId("data").textContent.trim()), bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  byId("data").remove();
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const player = new Player(header, await new Response(stream).arrayBuffer());
  byId("message").hidden = true;
  if (!location.hash && !matchMedia("(prefers-reduced-motion: reduce)").matches) player.play(true);
  return player;
}

// For whoever drives the page from outside: `await d2` is the player.
window.d2 = start();
window.d2.catch((error) => fail(error.message));
