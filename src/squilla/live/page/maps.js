// Colours for numbers: perceptually even maps, the contrast, and the painting of planes.
//
// viridis, cividis and magma (CC0) at every fifth of their 256 steps, linear in between: within one
// part in 255, cividis four.

const TABLES = {
  viridis: `440154 46085c 471063 481769 481d6f 482475 472a7a 46307e 453781 433d84 414287 3f4889 3d4e8a
    3a538b 38598c 355e8d 33638d 31688e 2e6d8e 2c718e 2a768e 297b8e 27808e 25848e 23898e 218e8d
    20928c 1f978b 1e9c89 1fa188 21a585 24aa83 28ae80 2eb37c 35b779 3dbc74 46c06f 50c46a 5ac864
    65cb5e 70cf57 7cd250 89d548 95d840 a2da37 b0dd2f bddf26 cae11f d8e219 e5e419 f1e51d fde725`,
  cividis: `00224e 002656 002a5f 002d68 003070 083370 163770 203a6f 273e6e 2e416d 34456c 3a486c 3f4c6c
    444f6c 49536c 4e566c 535a6d 575d6d 5c616e 60646f 656870 696b71 6d6f72 727274 767676 7a7a78
    7e7d78 838179 888578 8d8878 928c78 969077 9b9476 a09875 a59c74 aaa073 afa471 b5a86f baac6d
    bfb06b c4b468 c9b965 cfbd62 d4c15f dac65b dfca57 e5cf52 ead34c f0d846 f6dd3f fce236 fee838`,
  magma: `000004 02020b 050416 090720 0e0b2b 140e36 1a1042 21114e 29115a 311165 390f6e 420f75 4a1079
    52137c 5a167e 621980 6a1c81 721f81 792282 812581 892881 912b81 992d80 a1307e aa337d b2357b
    ba3878 c23b75 ca3e72 d2426f d9466b e04c67 e75263 ec5860 f1605d f4695c f7725c f97b5d fb8560
    fc8e64 fd9869 fea16e feaa74 feb47b febd82 fec68a fecf92 fed89a fde2a3 fdebac fcf4b6 fcfdbf`,
};
const STEPS = 256;
const palettes = new Map();

/** Names of all maps. */
export const MAPS = ["grey", ...Object.keys(TABLES)];

/** Return a map as 256 opaque pixels, little endian ABGR. */
export function palette(name, reversed = false) {
  const key = `${name}${reversed}`;
  if (!palettes.has(key)) {
    const points = name === "grey"
      ? [[0, 0, 0], [255, 255, 255]]
      : TABLES[name].split(/\s+/).map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
    const pixels = new Uint32Array(STEPS);
    for (let step = 0; step < STEPS; step++) {
      const place = (reversed ? STEPS - 1 - step : step) / (STEPS - 1) * (points.length - 1);
      const left = Math.min(Math.floor(place), points.length - 2);
      const [red, green, blue] = points[left].map(
        (value, channel) => Math.round(value + (place - left) * (points[left + 1][channel] - value)),
      );
      pixels[step] = (255 << 24) | (blue << 16) | (green << 8) | red;
    }
    palettes.set(key, pixels);
  }
  return palettes.get(key);
}

const curves = new Map();

/** Return the curve from linear light to what a screen wants: sRGB, or a plain gamma. */
function curve(gamma) {
  if (!curves.has(gamma)) {
    const table = new Uint8Array(4096);
    for (let step = 0; step < table.length; step++) {
      const x = step / (table.length - 1);
      const shown = gamma === "srgb"
        ? (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055)
        : x ** (1 / gamma);
      table[step] = Math.round(255 * shown);
    }
    curves.set(gamma, table);
  }
  return curves.get(gamma);
}

/** Paint one plane of numbers into 32-bit pixels; what is no number stays clear. */
export function paintPlane(values, pixels, low, high, colours) {
  const scale = (STEPS - 1) / Math.max(high - low, 1e-30);
  for (let at = 0; at < pixels.length; at++) {
    const place = (values[at] - low) * scale + 0.5;
    pixels[at] = place !== place ? 0 : colours[place < 0 ? 0 : place > 255 ? 255 : place | 0];
  }
}

/** Paint three planes as red, green and blue. */
export function paintColour(planes, pixels, low, high, gamma) {
  const table = curve(gamma), last = table.length - 1;
  const scale = last / Math.max(high - low, 1e-30);
  const [red, green, blue] = planes;
  const shown = (value) => {
    const place = (value - low) * scale;
    return table[place > 0 ? (place > last ? last : place | 0) : 0];
  };
  for (let at = 0; at < pixels.length; at++) {
    const r = red[at], g = green[at], b = blue[at], sum = r + g + b;
    pixels[at] = sum !== sum ? 0 : (255 << 24) | (shown(b) << 16) | (shown(g) << 8) | shown(r);
  }
}

/** Return a few thousand finite numbers of some planes, in order. */
export function sample(planes, most = 6144) {
  const total = planes.reduce((sum, plane) => sum + plane.length, 0);
  // An odd stride, so that it does not keep to a few columns of the picture.
  const stride = Math.max(1, Math.floor(total / most)) | 1;
  const taken = new Float32Array(Math.ceil(total / stride) + planes.length);
  let count = 0;
  for (const plane of planes) {
    for (let at = 0; at < plane.length; at += stride) {
      if (Number.isFinite(plane[at])) taken[count++] = plane[at];
    }
  }
  return taken.subarray(0, count).sort();
}

/** Return the value below which a share of sorted numbers lies. */
export function quantile(sorted, share) {
  if (!sorted.length) return share;
  return sorted[Math.min(sorted.length - 1, Math.max(0, Math.round(share * (sorted.length - 1))))];
}
