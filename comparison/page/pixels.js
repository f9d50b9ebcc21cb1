// Decode and colour the images of comparison/page_images.py.

const BITS_LEFT_OUT = 3;
const palettes = JSON.parse(document.getElementById("palettes").textContent);

// Number of every colour code, an unsigned half-precision number.
const linear = Float32Array.from({ length: 1 << (15 - BITS_LEFT_OUT) }, (_, code) => {
  const half = code << BITS_LEFT_OUT, exponent = half >> 10, mantissa = half & 1023;
  return exponent ? 2 ** (exponent - 15) * (1 + mantissa / 1024) : (2 ** -14 * mantissa) / 1024;
});

// Decode a picture into an array of codes, pixel by pixel.
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

const percent = (value) => `${Number((100 * value).toPrecision(2))}%`;
const logarithmic = (value, [low, high]) => Math.log(value / low) / Math.log(high / low);
const sRGB = (value) => (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);

// Error maps: number of a code, position on the colour scale (0 to 1), labels at its top, middle and bottom, at an
// exposure in stops (ignored by FLIP), and the number as text.
const { range, stored, whitest } = palettes.scales;
const maps = {
  relative: {
    number: (code) => stored[0] * (stored[1] / stored[0]) ** (code / 255),
    place: (error, stops) => logarithmic(error * 2 ** stops, range),
    ends: (stops) => [percent(range[1] / 2 ** stops), "", percent(range[0] / 2 ** stops)],
    text: percent,
  },
  signed: {
    number: (code) => ((code - 127.5) / 127.5) * Math.abs((code - 127.5) / 127.5),
    place: (error, stops) => 0.5 + 0.5 * error * 2 ** stops,
    ends: (stops) => [`+${percent(2 ** -stops)}`, "0", `−${percent(2 ** -stops)}`],
    text: (error) => (error < 0 ? "−" : "+") + percent(Math.abs(error)),
  },
  distance: {
    number: (code) => linear[code],
    place: (distance, stops) => distance * 2 ** stops,
    ends: (stops) => [`${percent(whitest / 2 ** stops)} of white`, "", "0"],
    text: (distance) => `${percent(whitest * distance)} of white`,
  },
  flip: { number: (code) => code / 255, place: (value) => value, ends: () => ["1", "", "0"], text: (value) => value.toFixed(2) },
};

// Colour (three bytes) of every code.
function colours(kind, stops) {
  const map = maps[kind], count = kind === "distance" ? linear.length : 256, found = new Uint8Array(3 * count);
  for (let code = 0; code < count; code++) {
    const place = Math.min(1, Math.max(0, map.place(map.number(code), stops)));
    found.set(palettes[kind].slice(3 * Math.round(255 * place), 3 * Math.round(255 * place) + 3), 3 * code);
  }
  return found;
}

// Paint a picture of a kind ("image", or a map) in a new canvas.
function paint(packed, codes, kind, stops) {
  const canvas = Object.assign(document.createElement("canvas"), { width: packed.width, height: packed.height });
  const context = canvas.getContext("2d"), pixels = context.createImageData(packed.width, packed.height);
  const count = packed.width * packed.height, isImage = kind === "image";
  const shown = isImage ? Uint8Array.from(linear, (value) => 255 * sRGB(Math.min(1, value * 2 ** stops)) + 0.5)
    : colours(kind, stops);
  for (let i = 0; i < count; i++) {
    for (let channel = 0; channel < 3; channel++) {
      pixels.data[4 * i + channel] = isImage ? shown[codes[3 * i + channel]] : shown[3 * codes[i] + channel];
    }
    pixels.data[4 * i + 3] = 255;
  }
  context.putImageData(pixels, 0, 0);
  return canvas;
}

// Paint the colour scale of a kind, the highest value on top.
function paintScale(canvas, kind) {
  Object.assign(canvas, { width: 1, height: 256 });
  const context = canvas.getContext("2d"), pixels = context.createImageData(1, 256);
  for (let i = 0; i < 256; i++) {
    pixels.data.set([...palettes[kind].slice(3 * (255 - i), 3 * (255 - i) + 3), 255], 4 * i);
  }
  context.putImageData(pixels, 0, 0);
}
