// What the picture shows: which planes are fetched, how they are combined, in what contrast.

import { Store } from "./connection.js";
import { MAPS, paintColour, paintPlane, palette, quantile, sample } from "./maps.js";

const DEGREES = 180 / Math.PI;
const AHEAD = 3; // bands fetched before they are asked for, on either side

/** What there is to see; `key` on the keyboard. */
export const MODES = {
  colour: { label: "Colour", key: "c", title: "As the CIE 1931 observer sees it" },
  three: { label: "Three bands", key: "t", title: "Any three bands as red, green and blue" },
  band: { label: "Band", key: "b", title: "One band" },
  ratio: { label: "Ratio", key: "r", title: "One band divided by another" },
  angle: { label: "Similarity", key: "s", title: "Spectral angle of every pixel to the selected spectrum" },
  layer: { label: "Maps", key: "m", title: "Maps that the file holds beside the cube" },
};

export class Show {
  /**
   * @param {Connection} connection
   * @param {View} view
   * @param {object} told - `shown(show)` after every painting, `failed(error)`, `waiting(flag)`.
   */
  constructor(connection, view, told) {
    Object.assign(this, { connection, view, told });
    this.store = new Store();
    this.mode = "colour";
    this.band = 0;
    this.maps = { band: "grey", ratio: "viridis", angle: "viridis", layer: "viridis" };
    this.auto = true;
    this.low = 0;
    this.high = 1;
    this.gamma = 2.2;
    this.white = null;
    this.target = null;
    this.whole = this.fine = null;
  }

  /** Show another cube. */
  open(number, about) {
    const near = (nm) => nearest(about.wavelength, nm);
    const same = this.about?.wavelength?.join() === about.wavelength.join();
    Object.assign(this, { number, about, whole: null, fine: null });
    if (!same) {
      this.band = near(about.wavelength.length ? 600 : 0);
      this.three = [650, 550, 500].map(near);
      this.ratio = [near(700), near(550)];
      this.white = this.target = null;
    }
    if (!about.layers.some(({ name }) => name === this.layer)) this.layer = about.layers[0]?.name;
    if (this.mode === "layer" && !this.layer) this.mode = "colour";
    this.view.measure(about.rows, about.columns);
    this.refresh();
  }

  get isColour() {
    return this.mode === "colour" || this.mode === "three";
  }

  get layerAbout() {
    return this.about.layers.find(({ name }) => name === this.layer);
  }

  /** Whether moving along the wavelengths changes the picture. */
  get followsBand() {
    return this.mode === "band" || this.mode === "ratio" || (this.mode === "layer" && this.layerAbout.spectral);
  }

  /** Return the pictures that the mode is made of. */
  wanted() {
    const band = (at) => ({ kind: "band", band: at });
    switch (this.mode) {
      case "colour": return [this.white ? { kind: "colour", white: this.white.values } : { kind: "colour" }];
      case "three": return this.three.map(band);
      case "band": return [band(this.band)];
      case "ratio": return this.ratio.map(band);
      case "angle": return this.target ? [{ kind: "angle", spectrum: this.target.values }] : [];
      default: return [{ kind: "layer", layer: this.layer, band: this.layerAbout.spectral ? this.band : 0 }];
    }
  }

  key(ask) {
    const more = ask.spectrum ? this.target.key : ask.white ? this.white.key : "";
    return [this.number, ask.kind, ask.band ?? "", ask.layer ?? "", more].join();
  }

  message(ask) {
    return { ask: "picture", source: this.number, ...ask };
  }

  /** Fetch what is missing and paint; of several calls in a row only the last one counts. */
  async refresh() {
    if (!this.about || this.about.error) return;
    if (this.about.live) {
      this.told.watch();
      return;
    }
    const asks = this.wanted();
    const found = asks.map((ask) => this.store.get(this.key(ask)));
    if (asks.length && found.every(Boolean)) {
      this.paint(found);
      this.look();
      return;
    }
    if (!asks.length) {
      this.told.failed(new Error("Select a point or a region first; every pixel is then compared with it."));
      return;
    }
    if (this.fetching) {
      this.again = true;
      return;
    }
    this.fetching = this.fetchAndPaint(asks);
    await this.fetching;
    this.fetching = null;
    if (this.again) {
      this.again = false;
      this.refresh();
    } else {
      this.look();
    }
  }

  async fetchAndPaint(asks) {
    const slow = setTimeout(() => this.told.waiting(true), 150);
    try {
      const pictures = await Promise.all(asks.map((ask) => this.fetch(ask)));
      if (asks.map((ask) => this.key(ask)).join() === this.wanted().map((ask) => this.key(ask)).join()) {
        this.paint(pictures);
      }
    } catch (error) {
      this.told.failed(error);
    } finally {
      clearTimeout(slow);
      this.told.waiting(false);
    }
  }

  /** Wait until what was asked for is painted; return the mode of what is. */
  async painted() {
    while (this.fetching) await this.fetching;
    return this.shows;
  }

  async fetch(ask) {
    const key = this.key(ask), found = this.store.get(key);
    if (found) return found;
    const picture = unfold(await this.connection.ask(this.message(ask)), ask.kind);
    this.store.set(key, picture);
    return picture;
  }

  /** Fetch the neighbours of the band while nobody waits. */
  async look() {
    if (!this.followsBand || this.about.by_need || this.looking) return;
    this.looking = true;
    try {
      for (let step = 1; step <= AHEAD; step++) {
        for (const at of [this.band + step, this.band - step]) {
          if (this.fetching || at < 0 || at >= this.about.wavelength.length) continue;
          const ask = this.mode === "layer" ? { kind: "layer", layer: this.layer, band: at } : { kind: "band", band: at };
          if (!this.store.get(this.key(ask))) await this.fetch(ask);
        }
      }
    } catch {
      // Whoever really wants the band will be told.
    } finally {
      this.looking = false;
    }
  }

  /** Combine pictures, in the order of `wanted`, to what is shown. */
  combine(pictures) {
    const [{ planes, width, height, stride, window }] = pictures;
    const shape = { width, height, stride, window };
    if (this.mode === "three") return { ...shape, planes: pictures.map((each) => each.planes[0]) };
    if (this.mode === "ratio") return { ...shape, planes: [divide(planes[0], pictures[1].planes[0])] };
    return { ...shape, planes };
  }

  paint(pictures) {
    const whole = this.combine(pictures), { planes } = whole;
    const owner = pictures.length > 1 ? {} : pictures[0];
    this.sorted = owner.sorted ??= sample(this.mode === "colour" ? [luminance(planes)] : planes);
    Object.assign(this, { whole, fine: null, shows: this.mode });
    if (this.auto) this.fitContrast();
    this.repaint();
    this.sharpen();
  }

  /** Where the whole picture leaves pixels out and one looks closely, fetch the part in view. */
  sharpen() {
    clearTimeout(this.soon);
    if (!this.whole || this.whole.stride === 1 || this.about.live) return;
    this.soon = setTimeout(async () => {
      const window = this.view.visible(), wanted = this.wanted(), whole = this.whole;
      const [top, left, bottom, right] = window;
      const longest = Math.max(bottom - top, right - left);
      if (longest * 1.5 > Math.max(this.about.rows, this.about.columns)) return;
      try {
        const answers = await Promise.all(wanted.map((ask) => this.connection.ask({ ...this.message(ask), window })));
        if (this.whole !== whole) return;
        this.fine = this.combine(answers.map((answer, at) => unfold(answer, wanted[at].kind)));
        this.repaint();
      } catch (error) {
        this.told.failed(error);
      }
    }, 150);
  }

  fitContrast() {
    const flag = this.mode === "layer" && this.layerAbout.truth;
    if (flag) [this.low, this.high] = [0, 1];
    else if (this.isColour) [this.low, this.high] = [0, quantile(this.sorted, 0.99) || 1];
    else if (this.mode === "angle") [this.low, this.high] = [0, quantile(this.sorted, 0.98) || 1];
    else [this.low, this.high] = [quantile(this.sorted, 0.005), quantile(this.sorted, 0.995)];
    if (!(this.high > this.low)) this.high = this.low + (Math.abs(this.low) * 1e-3 || 1);
  }

  repaint() {
    if (!this.whole) return;
    const { low, high } = this, gamma = this.mode === "colour" ? "srgb" : this.gamma;
    const painter = ({ planes }) => (pixels) => {
      if (this.isColour) paintColour(planes, pixels, low, high, gamma);
      else paintPlane(planes[0], pixels, low, high, this.colours);
    };
    this.view.show(this.whole, painter(this.whole));
    this.view.showPart(this.fine, this.fine && painter(this.fine));
    this.told.shown(this);
  }

  /** The map of numbers to colours; small angles are the bright ones. */
  get colours() {
    return palette(this.maps[this.mode] ?? "grey", this.mode === "angle");
  }

  /** Return the numbers under a pixel of the cube. */
  values([row, column]) {
    const inside = ({ window: [top, left, bottom, right] }) => row >= top && row < bottom && column >= left && column < right;
    const shown = [this.fine, this.whole].find((each) => each && inside(each));
    if (!shown) return [];
    const { planes, stride, width, window: [top, left] } = shown;
    const at = Math.floor((row - top) / stride) * width + Math.floor((column - left) / stride);
    return planes.map((plane) => plane[at]);
  }
}

export { MAPS };

/** Return the place of the nearest wavelength. */
export function nearest(wavelength, nm) {
  let best = 0;
  wavelength.forEach((each, at) => {
    if (Math.abs(each - nm) < Math.abs(wavelength[best] - nm)) best = at;
  });
  return best;
}

/** Turn an answer into planes. */
export function unfold({ header, values }, kind) {
  const [count, height, width] = header.shape, size = height * width;
  if (kind === "angle") for (let at = 0; at < size; at++) values[at] *= DEGREES;
  const planes = Array.from({ length: count }, (_, at) => values.subarray(at * size, (at + 1) * size));
  return { planes, width, height, stride: header.stride, window: header.window, bytes: values.byteLength };
}

function divide(one, other) {
  const ratio = new Float32Array(one.length);
  for (let at = 0; at < ratio.length; at++) ratio[at] = other[at] > 0 ? one[at] / other[at] : NaN;
  return ratio;
}

function luminance([red, green, blue]) {
  const sum = new Float32Array(red.length);
  for (let at = 0; at < sum.length; at++) sum[at] = 0.2126 * red[at] + 0.7152 * green[at] + 0.0722 * blue[at];
  return sum;
}
