// The page: reads its own data, plays it, and listens to the person. Nothing is loaded from anywhere.
"use strict";

const byId = (id) => document.getElementById(id);

class Player {
  constructor(header, raw) {
    this.header = header;
    this.scene = new Scene(header, raw);
    this.renderer = new Renderer(byId("image"), this.scene);
    this.camera = new FreeCamera(header);
    this.time = 0;
    this.mode = "color";
    this.speed = 1;
    this.playing = false;
    this.busy = false;       // the worker sorts
    this.wanted = true;      // something changed since the last image
    this.pace = new Pace();
    this.coarse = 2;         // pixels of the screen per pixel of the image, while something moves
    this.drawnSharp = false; // the last image has all pixels of the screen
    this.images = 0;       // drawn so far
    this.waiting = null;
    this.startWorker(raw);
    this.fillPage();
    this.listen();
    this.camera.place(header.cameras[0]);
    this.last = performance.now();
    requestAnimationFrame((now) => this.tick(now));
  }

  startWorker(raw) {
    const code = new Blob([byId("worker").textContent], { type: "text/javascript" });
    this.worker = new Worker(URL.createObjectURL(code));
    this.worker.postMessage({ header: this.header, raw });
    this.worker.onerror = (event) => fail(`the sorting of Gaussians failed: ${event.message}`);
    this.worker.onmessage = ({ data }) => this.draw(data);
  }

  // Names come from files and are only ever set as text.
  fillPage() {
    const { header } = this, still = header.seconds.length < 2;
    document.title = header.name;
    byId("name").textContent = header.name;
    for (const [held, label] of [[false, "training cameras"], [true, "held-out cameras"]]) {
      const cameras = header.cameras.map((camera, i) => [camera, i]).filter(([camera]) => camera.held_out === held);
      if (!cameras.length) continue;
      const group = byId("camera").appendChild(document.createElement("optgroup"));
      group.label = label;
      for (const [camera, i] of cameras) group.appendChild(new Option(camera.name, i));
    }
    for (const line of header.about) byId("facts").appendChild(document.createElement("li")).textContent = line;
    byId("time").max = header.duration;
    byId("time").step = header.duration / 1000 || 1;
    for (const id of ["play", "time", "speed"]) byId(id).disabled = still;
    const scale = byId("scale").getContext("2d"), colors = header.palette;
    for (let i = 0; i < 256; i++) {
      scale.fillStyle = `#${colors.slice(6 * i, 6 * i + 6)}`;
      scale.fillRect(i, 0, 1, 1);
    }
    byId("nearest").textContent = header.depth_range[0].toPrecision(3);
    byId("farthest").textContent = header.depth_range[1].toPrecision(3);
    this.showTime();
  }

  listen() {
    const on = (id, name, act) => byId(id).addEventListener(name, act);
    listen(byId("image"), this.camera, () => this.change());
    on("play", "click", () => this.play(!this.playing));
    on("time", "input", () => { this.play(false); this.goTo(Number(byId("time").value)); });
    on("speed", "change", () => { this.speed = Number(byId("speed").value); });
    on("mode", "change", () => this.setMode(byId("mode").value));
    on("camera", "change", () => { this.camera.place(this.header.cameras[byId("camera").value]); this.change(); });
    on("back", "click", () => { this.camera.place(this.camera.camera); this.change(); });
    on("save", "click", () => this.save());
    on("about", "click", () => { byId("notes").hidden = !byId("notes").hidden; });
    addEventListener("resize", () => this.change());
    addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.key === " ") return;
    const acts = {
      " ": () => this.play(!this.playing),
      ".": () => this.step(1), ",": () => this.step(-1),
      d: () => this.setMode(this.mode === "depth" ? "color" : "depth"),
    };
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }

  change() { this.wanted = true; this.drawnSharp = false; this.touched = performance.now(); }

  play(on) {
    this.playing = on && this.header.duration > 0;
    byId("play").textContent = this.playing ? "❚❚" : "►";
    byId("play").setAttribute("aria-label", this.playing ? "pause" : "play");
    this.change();
  }

  goTo(time) { this.time = Math.min(Math.max(time, 0), this.header.duration); this.showTime(); this.change(); }

  step(frames) {
    this.play(false);
    const place = Math.min(Math.max(this.frame() + frames, 0), this.header.seconds.length - 1);
    this.goTo(this.header.seconds[place]);
  }

  frame() {
    const apart = this.header.seconds.map((seconds) => Math.abs(seconds - this.time));
    return apart.indexOf(Math.min(...apart));
  }

  showTime() {
    byId("time").value = this.time;
    byId("clock").textContent = `${this.time.toFixed(2)} s · frame ${this.header.frames[this.frame()]}`;
  }

  setMode(mode) {
    this.mode = mode;
    byId("mode").value = mode;
    byId("legend").hidden = mode !== "depth";
    this.change();
  }

  tick(now) {
    const passed = Math.min(Math.max((now - this.last) / 1000, 0), 0.25);
    this.last = now;
    if (this.playing) {
      const { duration } = this.header, next = this.time + passed * this.speed;
      this.time = next > duration ? 0 : next;
      this.showTime();
      this.wanted = true;
    }
    const quiet = !this.playing && now - (this.touched || 0) > 300;
    const due = this.wanted || (quiet && !this.drawnSharp);
    if (due && !this.busy && !this.waiting) {
      this.drawnSharp = quiet || this.coarse === 1;
      this.sort(this.screenView(quiet ? 1 : this.coarse));
    }
    requestAnimationFrame((next) => this.tick(next));
  }

  screenView(coarse) {
    const { clientWidth, clientHeight } = byId("stage"), ratio = devicePixelRatio / coarse;
    return this.camera.view(Math.max(Math.round(clientWidth * ratio), 1), Math.max(Math.round(clientHeight * ratio), 1));
  }

  sort(view) {
    this.busy = true;
    this.wanted = false;
    this.asked = { view, time: this.time, mode: this.mode, start: performance.now() };
    this.worker.postMessage({ forward: view.rotation.slice(6, 9), offset: view.translation[2], time: this.time });
  }

  draw({ order, count }) {
    const { view, time, mode, start } = this.asked;
    this.renderer.setOrder(order, count);
    this.renderer.draw(view, time, mode);
    this.images++;
    this.busy = false;
    if (this.waiting) {
      this.renderer.gl.finish();
      this.waiting();
      this.waiting = null;
    } else {
      this.adapt(view.size[0] * view.size[1], start);
    }
  }

  // A machine without a graphics card draws fewer pixels while something moves; at rest it draws all.
  adapt(pixels, start) {
    this.renderer.gl.readPixels(0, 0, 1, 1, this.renderer.gl.RGBA, this.renderer.gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.pace.note(pixels, (performance.now() - start) / 1000);
    const { size } = this.screenView(1);
    this.coarse = this.pace.coarse(size[0] * size[1], this.coarse);
  }

  // The image of a camera of the recording at a time, in the camera's own size, as the address of a PNG.
  async image(name, time, mode = "color") {
    const camera = this.header.cameras.find((other) => other.name === name);
    if (!camera) throw new Error(`no camera '${name}'`);
    const free = new FreeCamera(this.header);
    free.place(camera);
    return this.still(free.view(camera.width, camera.height), time, mode);
  }

  async still(view, time, mode) {
    this.play(false);
    while (this.busy) await new Promise((resolve) => setTimeout(resolve, 1));
    const before = [this.time, this.mode];
    [this.time, this.mode] = [time, mode];
    await new Promise((resolve) => { this.waiting = resolve; this.sort(view); });
    const address = byId("image").toDataURL("image/png");
    [this.time, this.mode] = before;
    this.change();
    return address;
  }

  async save() {
    const link = document.createElement("a");
    link.href = await this.still(this.screenView(1), this.time, this.mode);
    link.download = `${this.header.name.replace(/[^\w.-]+/g, "_")}_${this.time.toFixed(2)}s.png`;
    link.click();
  }
}

function fail(message) {
  byId("message").textContent = message;
  byId("message").hidden = false;
}

async function start() {
  const header = JSON.parse(byId("header").textContent);
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser cannot unpack the data: open the page in a Chrome, Firefox, Safari or Edge of 2023 or later");
  }
  const text = atob(byId("data").textContent.trim()), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  byId("data").remove();
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const player = new Player(header, await new Response(stream).arrayBuffer());
  byId("message").hidden = true;
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) player.play(true);
  return player;
}

// For whoever drives the page from outside: `await d2` is the player.
window.d2 = start();
window.d2.catch((error) => fail(error.message));
