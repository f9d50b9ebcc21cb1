// Viewer of a scene: pictures A and B in the same place, split by a draggable line, or flipped.

const HIGHEST = 640; // CSS pixels, maximum height of a stage outside full screen
const FURTHEST = 64; // maximum zoom

class Viewer {
  constructor(root) {
    this.root = root;
    this.find = (selector) => root.querySelector(selector);
    const { views, exposure, metric } = JSON.parse(this.find(".views").textContent);
    Object.assign(this, { views, exposure, metric, stage: this.find(".stage") });
    this.decoded = new Map(); // packed picture -> codes
    this.painted = new Map(); // index of a view, kind and exposure -> canvas
    this.split = 0.5; // position of the line, fraction of the stage's width
    this.flipping = false;
    this.flipped = false;
    this.picking = false; // the user selects an inset
    this.zoom = 1; // 1: fit
    this.origin = [0, 0]; // CSS pixels, position of the picture on the stage
    for (const select of [this.find(".a"), this.find(".b")]) {
      views.forEach((view, index) => select.add(new Option(view.title, index)));
    }
    [this.find(".a").value, this.find(".b").value] = this.first();
    this.tiles = new Tiles(this, this.find(".tiles"));
    this.listen();
    root.classList.add("live");
    this.say("");
    this.repaint();
  }

  // Initial A and B: the last settings of the first and of the last label; with a single label, B is the reference.
  first() {
    const labels = this.views.map((view) => view.label), own = labels.filter((label) => label !== null);
    const last = [own[0], own.at(-1)].map((label) => labels.lastIndexOf(label));
    if (!own.length) return [0, 0];
    return last[0] === last[1] && labels[0] === null ? [last[0], 0] : last;
  }

  listen() {
    for (const name of [".a", ".b", ".kind"]) this.find(name).addEventListener("change", () => this.repaint());
    this.find(".exposure").addEventListener("input", () => this.repaint());
    const centre = () => [this.stage.clientWidth / 2, this.stage.clientHeight / 2];
    this.actions = {
      flip: () => this.flip(),
      split: () => this.setSplit(),
      in: () => this.scale(1.5, centre()),
      out: () => this.scale(1 / 1.5, centre()),
      fit: () => this.scale(0, [0, 0]),
      all: () => this.toggleTiles(),
      inset: () => this.toggleInset(),
      full: () => this.toggleFull(),
    };
    for (const [name, act] of Object.entries(this.actions)) this.find(`button.${name}`).addEventListener("click", act);
    this.stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.stage.addEventListener("pointermove", (event) => this.hover(event));
    this.stage.addEventListener("pointerleave", () => this.say(""));
    this.find(".handle").addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      this.moveSplit(step);
    });
    drag(this.find(".handle"), ({ x }) => this.moveSplit((x - this.stage.getBoundingClientRect().left) / this.stage.clientWidth - this.split));
    drag(this.stage, (step) => (this.picking ? this.pick(step) : this.move(step.dx, step.dy)), () => this.picked());
    const sizes = new ResizeObserver(() => this.place());
    for (const element of [this.root, this.find(".tiles")]) sizes.observe(element);
  }

  // --- Selection of pictures ---

  get kind() {
    return this.find(".kind").value;
  }

  get stops() {
    return Number(this.find(".exposure").value);
  }

  // Indices of the visible views.
  visible() {
    const [a, b] = [".a", ".b"].map((name) => Number(this.find(name).value));
    return this.flipping ? [this.flipped ? b : a] : [a, b];
  }

  // Show a single picture.
  show(index) {
    if (!this.views[index]) return;
    this.find(".a").value = index;
    [this.flipping, this.flipped] = [true, false];
    this.repaint();
  }

  // Show a picture to the right of the line.
  showBeside(index) {
    if (!this.views[index]) return;
    this.find(".b").value = index;
    this.flipping = this.flipped = false;
    this.repaint();
  }

  // Adopt the view of another viewer where this scene has the same pictures.
  adopt(other) {
    for (const name of [".a", ".b"]) {
      const title = other.views[other.find(name).value].title;
      const index = this.views.findIndex((view) => view.title === title);
      if (index >= 0) this.find(name).value = index;
    }
    for (const name of [".kind", ".exposure"]) this.find(name).value = other.find(name).value;
    if (!this.kind) this.find(".kind").value = "image";
    [this.flipping, this.flipped, this.split] = [other.flipping, other.flipped, other.split];
    this.tiles.are_shown = other.tiles.are_shown;
    this.repaint();
  }

  flip() {
    this.flipped = this.flipping ? !this.flipped : true; // from split, show B first
    this.flipping = true;
    this.place();
  }

  setSplit() {
    this.flipping = this.flipped = false;
    this.place();
  }

  moveSplit(by) {
    this.split = Math.min(1, Math.max(0, this.split + by));
    this.place();
  }

  changeExposure(by) {
    this.find(".exposure").value = this.stops + by;
    this.repaint();
  }

  nextKind() {
    const select = this.find(".kind");
    select.selectedIndex = (select.selectedIndex + 1) % select.length;
    this.repaint();
  }

  toggleTiles() {
    this.tiles.are_shown = !this.tiles.are_shown;
    this.place();
  }

  toggleFull(on = !this.root.classList.contains("full")) {
    this.root.classList.toggle("full", on);
    document.documentElement.classList.toggle("covered", on);
    if (on && !document.fullscreenElement) document.documentElement.requestFullscreen?.().catch(() => {});
    if (!on && document.fullscreenElement) document.exitFullscreen();
    this.place();
  }

  // --- Zoom and visible region ---

  wheel(event) {
    if (!event.ctrlKey && !event.metaKey && !this.root.classList.contains("full")) {
      this.say("Hold Ctrl to zoom with the wheel.");
      return; // the page scrolls
    }
    event.preventDefault();
    const box = this.stage.getBoundingClientRect();
    this.scale(1.2 ** -Math.sign(event.deltaY), [event.clientX - box.left, event.clientY - box.top]);
  }

  move(dx, dy) {
    this.origin = [this.origin[0] + dx, this.origin[1] + dy];
    this.place();
  }

  // Zoom by a factor about a point of the stage; 0: fit.
  scale(factor, about) {
    const old = this.zoom;
    this.zoom = factor ? Math.min(FURTHEST, Math.max(1, old * factor)) : 1;
    this.origin = this.origin.map((from, axis) => about[axis] - ((about[axis] - from) * this.zoom) / old);
    this.place();
  }

  // CSS pixels per pixel of the picture at zoom 1.
  get fit() {
    const { width, height } = this.views[0].image, isFull = this.root.classList.contains("full");
    const others = this.find(".controls").offsetHeight + this.find(".tiles").offsetHeight + 80;
    const highest = isFull ? window.innerHeight - others : HIGHEST;
    const bar = this.find(".bar"), beside = bar.hidden ? 0 : bar.offsetWidth + 8;
    return Math.min((this.find(".screen").clientWidth - beside) / width, Math.max(200, highest) / height);
  }

  // Visible region of the picture: [x, y, width, height] in its pixels.
  region() {
    const { width, height } = this.views[0].image, pixel = this.fit * this.zoom;
    return [-this.origin[0] / pixel, -this.origin[1] / pixel, width / this.zoom, height / this.zoom];
  }

  // Pixel of the picture at a position of the window.
  pixelAt({ x, y }) {
    const box = this.stage.getBoundingClientRect(), pixel = this.fit * this.zoom, { width, height } = this.views[0].image;
    const inside = (value, size) => Math.min(size - 1, Math.max(0, Math.floor(value / pixel)));
    return [inside(x - box.left - this.origin[0], width), inside(y - box.top - this.origin[1], height)];
  }

  // --- Insets ---

  toggleInset() {
    this.picking = !this.picking && !this.tiles.inset;
    this.tiles.inset = null;
    this.say(this.picking ? "Drag a rectangle on the picture." : "");
    this.place();
  }

  pick({ from, x, y }) {
    const [a, b] = [this.pixelAt(from), this.pixelAt({ x, y })];
    const low = a.map((one, axis) => Math.min(one, b[axis]));
    this.tiles.inset = [...low, ...a.map((one, axis) => Math.abs(one - b[axis]) + 1)];
    this.place();
  }

  picked() {
    if (this.tiles.inset) this.picking = false;
    this.place();
  }

  // --- Numbers under the pointer ---

  say(text) {
    this.find(".readout").textContent = text || this.find(".readout").dataset.help;
  }

  async hover(event) {
    const [x, y] = this.pixelAt(event), parts = [];
    for (const index of new Set(this.visible())) {
      const view = this.views[index], at = y * view.image.width + x, codes = await this.codes(view.image);
      const radiance = [0, 1, 2].map((channel) => Number((linear[codes[3 * at + channel]] / this.exposure).toPrecision(2)));
      const map = view.maps[this.kind], error = map && maps[this.kind].number((await this.codes(map))[at]);
      parts.push(`${view.title} ${radiance.join(" ")}${map ? ` (${maps[this.kind].text(error)})` : ""}`);
    }
    this.say(`x ${x}, y ${y}: ${parts.join(" | ")}`);
  }

  // --- Painting ---

  codes(packed) {
    if (!this.decoded.has(packed)) this.decoded.set(packed, decode(packed));
    return this.decoded.get(packed);
  }

  // Kind of map shown for a view; the reference has no error maps and appears as an image.
  kindOf(view) {
    return view.maps[this.kind] ? this.kind : "image";
  }

  // Return the painted picture of a view.
  async picture(index) {
    const view = this.views[index], kind = this.kindOf(view), key = `${kind} ${this.stops}`, old = this.painted.get(index);
    if (old?.key === key) return old.canvas;
    const packed = kind === "image" ? view.image : view.maps[kind];
    const canvas = paint(packed, await this.codes(packed), kind, this.stops);
    this.painted.set(index, { key, canvas });
    return canvas;
  }

  async repaint() {
    const turn = (this.turn = (this.turn || 0) + 1), { stops, kind } = this;
    this.find(".of-exposure").hidden = kind === "flip";
    this.find(".of-exposure output").textContent = `${stops > 0 ? "+" : ""}${stops} EV`;
    this.find(".bar").hidden = kind === "image";
    if (kind !== "image") {
      paintScale(this.find(".bar canvas"), kind);
      maps[kind].ends(stops).forEach((text, i) => (this.root.querySelectorAll(".bar output")[i].textContent = text));
    }
    const indices = [".a", ".b"].map((name) => Number(this.find(name).value));
    const pictures = await Promise.all(indices.map((index) => this.picture(index)));
    if (turn !== this.turn) return; // superseded by a later request
    ["under", "over"].forEach((name, i) => {
      const canvas = this.find(`.${name}`);
      Object.assign(canvas, { width: pictures[i].width, height: pictures[i].height });
      canvas.getContext("2d").drawImage(pictures[i], 0, 0);
    });
    this.names = indices.map((index) => {
      const view = this.views[index], kind = this.kindOf(view);
      const title = kind === "image" ? view.title : `${view.title}: ${kind}`;
      return [title, view.error];
    });
    this.place();
    this.stage.dataset.painted = turn;
  }

  // Position canvases, line, frame and names.
  place() {
    if (!this.names) return;
    const under = this.find(".under"), over = this.find(".over"), handle = this.find(".handle"), { fit } = this;
    const size = [under.width * fit, under.height * fit], pixel = fit * this.zoom;
    Object.assign(this.stage.style, { width: `${size[0]}px`, height: `${size[1]}px` });
    this.origin = this.origin.map((from, axis) => Math.min(0, Math.max(from, size[axis] * (1 - this.zoom))));
    for (const canvas of [under, over]) {
      canvas.style.transform = `translate(${this.origin[0]}px, ${this.origin[1]}px) scale(${pixel})`;
    }
    const line = this.flipping ? (this.flipped ? 0 : size[0]) : this.split * size[0];
    over.style.clipPath = `inset(0 0 0 ${Math.min(over.width, Math.max(0, (line - this.origin[0]) / pixel))}px)`;
    handle.style.left = `${line}px`;
    handle.setAttribute("aria-valuenow", Math.round(100 * this.split));
    for (const [name, on] of Object.entries({ flipping: this.flipping, picking: this.picking, zoomed: this.zoom > 1 })) {
      this.stage.classList.toggle(name, on);
    }
    const pressed = { flip: this.flipping, split: !this.flipping, all: this.tiles.are_shown,
      inset: this.picking || Boolean(this.tiles.inset), full: this.root.classList.contains("full") };
    for (const [name, on] of Object.entries(pressed)) this.find(`button.${name}`).setAttribute("aria-pressed", on);
    this.frame(pixel);
    const [left, right] = [!this.flipping || !this.flipped, !this.flipping || this.flipped];
    this.label(".badge.left", left ? this.names[0] : ["", ""]);
    this.label(".badge.right", right ? this.names[1] : ["", ""]);
    this.tiles.draw();
  }

  frame(pixel) {
    const frame = this.find(".frame"), { inset } = this.tiles;
    frame.hidden = !inset;
    if (!inset) return;
    const [left, top] = [0, 1].map((axis) => this.origin[axis] + inset[axis] * pixel);
    Object.assign(frame.style, { left: `${left}px`, top: `${top}px`, width: `${inset[2] * pixel}px`, height: `${inset[3] * pixel}px` });
  }

  label(selector, [title, error]) {
    this.find(`${selector} b`).textContent = title;
    this.find(`${selector} span`).textContent = error;
    this.find(`${selector} span`).dataset.metric = this.metric;
  }
}
