"use strict";
// The pictures of a scene: two of them, A and B, in place, split by a line that can be dragged, or flipped.
// The pixels are those of comparison/page_images.py.

const BITS_LEFT_OUT = 3;
const palettes = JSON.parse(document.getElementById("palettes").textContent);

// Linear colour of every code: half-precision numbers without sign.
const linear = Float32Array.from({ length: 1 << (15 - BITS_LEFT_OUT) }, (_, code) => {
  const half = code << BITS_LEFT_OUT, exponent = half >> 10, mantissa = half & 1023;
  return exponent ? 2 ** (exponent - 15) * (1 + mantissa / 1024) : (2 ** -14 * mantissa) / 1024;
});

// Decode a picture into codes, one after another pixel by pixel.
async function decode(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (letter) => letter.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(inflated).arrayBuffer());
  const { width, height, channels, depth } = packed, size = width * height * channels;
  const codes = new Uint16Array(size), mask = depth === 1 ? 255 : 65535;
  for (let channel = 0; channel < channels; channel++) {
    for (let y = 0; y < height; y++) {
      for (let x = 0, code = 0; x < width; x++) {
        const at = (channel * height + y) * width + x;
        code = (code + planes[at] + (depth === 2 ? planes[size + at] << 8 : 0)) & mask;
        codes[(y * width + x) * channels + channel] = code;
      }
    }
  }
  return codes;
}

// The byte that a colour is shown as, for every code: exposure and the sRGB curve.
function toneCurve(stops) {
  return Uint8Array.from(linear, (value) => {
    const exposed = Math.min(1, value * 2 ** stops);
    return 255 * (exposed <= 0.0031308 ? 12.92 * exposed : 1.055 * exposed ** (1 / 2.4) - 0.055) + 0.5;
  });
}

function paint(canvas, packed, codes, kind, stops) {
  canvas.width = packed.width;
  canvas.height = packed.height;
  const context = canvas.getContext("2d"), pixels = context.createImageData(packed.width, packed.height);
  const count = packed.width * packed.height, curve = kind === "image" ? toneCurve(stops) : null;
  for (let i = 0; i < count; i++) {
    for (let channel = 0; channel < 3; channel++) {
      pixels.data[4 * i + channel] = curve ? curve[codes[3 * i + channel]] : palettes[kind][3 * codes[i] + channel];
    }
    pixels.data[4 * i + 3] = 255;
  }
  context.putImageData(pixels, 0, 0);
}

class Viewer {
  constructor(root) {
    this.find = (selector) => root.querySelector(selector);
    this.views = JSON.parse(this.find(".views").textContent);
    this.stage = this.find(".stage");
    this.decoded = new Map();
    this.split = 0.5; // of the stage's width
    this.flipping = false;
    this.flipped = false;
    this.zoom = 1; // 1 fits
    this.origin = [0, 0]; // of the picture on the stage, CSS pixels
    for (const select of [this.find(".a"), this.find(".b")]) {
      this.views.forEach((view, index) => select.add(new Option(view.title, index)));
    }
    [this.find(".a").value, this.find(".b").value] = this.first();
    this.listen();
    this.repaint();
  }

  // What is shown first: the last settings of the first and of the last label, or of the only one and the reference.
  first() {
    const labels = this.views.map((view) => view.label), own = labels.filter((label) => label !== null);
    const last = [own[0], own.at(-1)].map((label) => labels.lastIndexOf(label));
    if (!own.length) return [0, 0];
    return last[0] === last[1] && labels[0] === null ? [last[0], 0] : last;
  }

  listen() {
    for (const name of [".a", ".b", ".kind"]) this.find(name).addEventListener("change", () => this.repaint());
    this.find(".exposure").addEventListener("input", () => this.repaint());
    this.find(".flip").addEventListener("click", () => this.flip());
    this.find(".split").addEventListener("click", () => {
      this.flipping = this.flipped = false;
      this.place();
    });
    const centre = () => [this.stage.clientWidth / 2, this.stage.clientHeight / 2];
    this.find(".in").addEventListener("click", () => this.scale(1.5, centre()));
    this.find(".out").addEventListener("click", () => this.scale(1 / 1.5, centre()));
    this.find(".fit").addEventListener("click", () => this.scale(0, [0, 0]));
    this.stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      const box = this.stage.getBoundingClientRect();
      this.scale(1.2 ** -Math.sign(event.deltaY), [event.clientX - box.left, event.clientY - box.top]);
    }, { passive: false });
    this.stage.addEventListener("keydown", (event) => this.key(event));
    drag(this.find(".handle"), (dx, dy, x) => {
      const box = this.stage.getBoundingClientRect();
      this.moveSplit((x - box.left) / box.width - this.split);
    });
    drag(this.stage, (dx, dy) => this.move(dx, dy));
    new ResizeObserver(() => this.place()).observe(this.stage.parentElement);
  }

  key(event) {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (event.key === " ") this.flip();
    else if (step && !this.flipping) this.moveSplit(step);
    else return;
    event.preventDefault();
  }

  flip() {
    this.flipped = this.flipping && !this.flipped;
    if (!this.flipping) this.flipped = true; // from the split, A being known, to B
    this.flipping = true;
    this.place();
  }

  moveSplit(by) {
    this.split = Math.min(1, Math.max(0, this.split + by));
    this.place();
  }

  move(dx, dy) {
    this.origin = [this.origin[0] + dx, this.origin[1] + dy];
    this.place();
  }

  // Zoom by a factor about a point of the stage; 0 fits again.
  scale(factor, about) {
    const old = this.zoom;
    this.zoom = factor ? Math.min(64, Math.max(1, old * factor)) : 1;
    this.origin = this.origin.map((from, axis) => about[axis] - ((about[axis] - from) * this.zoom) / old);
    this.place();
  }

  // The picture that a selection shows: images have no errors against themselves.
  shown(selection) {
    const view = this.views[this.find(selection).value], kind = this.find(".kind").value;
    return view.maps[kind] ? [view, kind, view.maps[kind]] : [view, "image", view.image];
  }

  async repaint() {
    const turn = (this.turn = (this.turn || 0) + 1), stops = Number(this.find(".exposure").value);
    this.find("output").textContent = `${stops > 0 ? "+" : ""}${stops} EV`;
    const wanted = [this.shown(".a"), this.shown(".b")];
    for (const [, , packed] of wanted) {
      if (!this.decoded.has(packed)) this.decoded.set(packed, decode(packed));
    }
    const codes = await Promise.all(wanted.map(([, , packed]) => this.decoded.get(packed)));
    if (turn !== this.turn) return; // something else was asked for meanwhile
    ["under", "over"].forEach((name, i) => paint(this.find(`.${name}`), wanted[i][2], codes[i], wanted[i][1], stops));
    this.titles = wanted.map(([view, kind]) => (kind === "image" ? view.title : `${view.title}: ${kind}`));
    this.place();
    this.stage.dataset.painted = turn;
  }

  // Put canvases, line and names where they belong.
  place() {
    const under = this.find(".under"), over = this.find(".over"), handle = this.find(".handle");
    const width = this.stage.parentElement.clientWidth, fit = Math.min(width / under.width, 640 / under.height);
    this.stage.style.width = `${under.width * fit}px`;
    this.stage.style.height = `${under.height * fit}px`;
    const size = [under.width * fit, under.height * fit];
    this.origin = this.origin.map((from, axis) => Math.min(0, Math.max(from, size[axis] * (1 - this.zoom))));
    for (const canvas of [under, over]) {
      canvas.style.transform = `translate(${this.origin[0]}px, ${this.origin[1]}px) scale(${fit * this.zoom})`;
    }
    const line = this.flipping ? (this.flipped ? 0 : size[0]) : this.split * size[0];
    const cut = Math.min(over.width, Math.max(0, (line - this.origin[0]) / (fit * this.zoom)));
    over.style.clipPath = `inset(0 0 0 ${cut}px)`;
    handle.style.left = `${line}px`;
    handle.setAttribute("aria-valuenow", Math.round(100 * this.split));
    this.stage.classList.toggle("flipping", this.flipping);
    this.find(".flip").setAttribute("aria-pressed", this.flipping);
    this.find(".split").setAttribute("aria-pressed", !this.flipping);
    const [a, b] = this.titles || ["", ""];
    this.find(".badge.left").textContent = this.flipping && this.flipped ? "" : a;
    this.find(".badge.right").textContent = this.flipping && !this.flipped ? "" : b;
  }
}

// Call `move` with the pointer's steps, and where it is, while it is held down on an element.
function drag(element, move) {
  element.addEventListener("pointerdown", (event) => {
    if (event.target !== element && event.target.tagName !== "CANVAS") return;
    element.setPointerCapture(event.pointerId);
    let [x, y] = [event.clientX, event.clientY];
    const step = (next) => {
      move(next.clientX - x, next.clientY - y, next.clientX);
      [x, y] = [next.clientX, next.clientY];
    };
    element.addEventListener("pointermove", step);
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, () => element.removeEventListener("pointermove", step), { once: true });
    }
  });
}

for (const root of document.querySelectorAll(".viewer")) new Viewer(root);
