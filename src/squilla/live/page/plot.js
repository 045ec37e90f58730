// Spectra as lines, drawn by hand: crisp axes, a marker for the band, a hair where the mouse is.

const EDGE = { left: 48, right: 10, top: 10, bottom: 34 };

/** Return round steps that divide a range into about `count` parts. */
export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((each) => each >= rough);
  const found = [];
  for (let at = Math.ceil(low / step - 1e-9); at * step <= high + 1e-9 * step; at++) found.push(at * step);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), step };
}

/** Write a number short: for axes and lists. */
export function short(value, digits = 4) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) return value.toExponential(2).replace("e+", "e");
  return String(Number(value.toPrecision(digits)));
}

export class Plot {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {object} told - called back: `hover(nm|null)`, `choose(nm)`.
   */
  constructor(canvas, told) {
    this.canvas = canvas;
    this.told = told;
    this.lines = [];
    this.wavelength = [0, 1];
    this.colours = [];
    this.marker = null;
    this.hair = null;
    new ResizeObserver(() => this.resize()).observe(canvas);
    const at = (event) => this.nanometres(event.offsetX);
    canvas.addEventListener("pointermove", (event) => {
      this.hair = at(event);
      this.told.hover(this.hair);
      if (event.buttons & 1) this.told.choose(this.hair);
      this.draw();
    });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.told.choose(at(event));
    });
    canvas.addEventListener("pointerleave", () => {
      this.hair = null;
      this.told.hover(null);
      this.draw();
    });
  }

  resize() {
    const ratio = devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    Object.assign(this, { width, height, ratio });
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.draw();
  }

  get span() {
    const first = this.wavelength[0], last = this.wavelength.at(-1);
    return last > first ? [first, last] : [first - 1, first + 1];
  }

  x(nm) {
    const [first, last] = this.span;
    return EDGE.left + (nm - first) / (last - first) * (this.width - EDGE.left - EDGE.right);
  }

  nanometres(x) {
    const [first, last] = this.span;
    const share = (x - EDGE.left) / (this.width - EDGE.left - EDGE.right);
    return first + Math.min(Math.max(share, 0), 1) * (last - first);
  }

  y(value) {
    const [low, high] = this.range;
    return this.height - EDGE.bottom - (value - low) / (high - low) * (this.height - EDGE.top - EDGE.bottom);
  }

  /** Find the range of all lines; zero belongs to it unless they lie far above. */
  measure() {
    let low = Infinity, high = -Infinity;
    for (const { values, spread } of this.lines) {
      for (let at = 0; at < values.length; at++) {
        const around = spread ? spread[at] : 0;
        if (values[at] - around < low) low = values[at] - around;
        if (values[at] + around > high) high = values[at] + around;
      }
    }
    if (!(high >= low)) return [0, 1];
    if (low > 0 && low < 0.7 * high) low = 0;
    if (high === low) [low, high] = [low - 0.5, high + 0.5];
    const air = 0.04 * (high - low);
    return [low === 0 ? 0 : low - air, high + air];
  }

  /** Draw all; `pen` and size may be those of another canvas, for export. */
  draw(pen = this.context ??= this.canvas.getContext("2d"), ratio = this.ratio) {
    if (!this.width) return;
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    this.range = this.measure();
    const { width, height } = this, base = height - EDGE.bottom;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (pen !== this.context) {
      pen.fillStyle = colour("--sheet");
      pen.fillRect(0, 0, width, height);
    }
    pen.font = "400 11px Inter, system-ui, sans-serif";
    pen.lineJoin = "round";
    this.axes(pen, colour, base);
    pen.save();
    pen.beginPath();
    pen.rect(EDGE.left, 0, width - EDGE.left - EDGE.right + 1, base);
    pen.clip();
    for (const line of this.lines) this.line(pen, line);
    pen.restore();
    if (this.marker !== null) this.upright(pen, this.marker, colour("--accent"), base, true);
    if (this.hair !== null && pen === this.context) this.upright(pen, this.hair, colour("--faint"), base, false);
  }

  axes(pen, colour, base) {
    const { width } = this, right = width - EDGE.right;
    pen.fillStyle = colour("--soft");
    pen.strokeStyle = colour("--line");
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    const [low, high] = this.range;
    if (this.lines.length) {
      const upright = ticks(low, high, (base - EDGE.top) / 44);
      pen.beginPath();
      for (const value of upright.found) {
        const y = Math.round(this.y(value)) + 0.5;
        pen.moveTo(EDGE.left, y);
        pen.lineTo(right, y);
        const big = Math.max(Math.abs(low), Math.abs(high));
        const text = big >= 1e5 || big < 1e-3 ? short(value, 3) : value.toFixed(upright.digits);
        pen.fillText(value === 0 ? "0" : text, EDGE.left - 8, y);
      }
      pen.stroke();
    }
    // What the eye sees at each wavelength, as the foot of the plot.
    const count = this.wavelength.length;
    for (let at = 0; at < this.colours.length; at++) {
      const from = this.x(this.wavelength[Math.max(at - 1, 0)]);
      const to = this.x(this.wavelength[Math.min(at + 1, count - 1)]);
      pen.fillStyle = this.colours[at];
      pen.fillRect((this.x(this.wavelength[at]) + from) / 2, base, (to - from) / 2 + 0.6, 3);
    }
    const [first, last] = this.span, level = ticks(first, last, (right - EDGE.left) / 72);
    pen.fillStyle = colour("--soft");
    pen.textAlign = "center";
    for (const nm of level.found) {
      if (this.x(nm) > right - 26) continue; // there stands the unit
      pen.fillText(nm.toFixed(level.digits), this.x(nm), base + 16);
    }
    pen.textAlign = "right";
    pen.fillText("nm", right, base + 16);
  }

  line(pen, { values, spread, colour, dashed, active, wavelength = this.wavelength }) {
    const walk = (offset, backwards) => {
      let down = false;
      for (let step = 0; step < values.length; step++) {
        const at = backwards ? values.length - 1 - step : step;
        const value = values[at] + (offset ? offset * spread[at] : 0);
        if (!Number.isFinite(value)) {
          down = down && backwards;
          continue;
        }
        if (down || backwards) pen.lineTo(this.x(wavelength[at]), this.y(value));
        else pen.moveTo(this.x(wavelength[at]), this.y(value));
        down = true;
      }
    };
    if (spread) {
      pen.beginPath();
      walk(1, false);
      walk(-1, true);
      pen.closePath();
      pen.globalAlpha = 0.16;
      pen.fillStyle = colour;
      pen.fill();
      pen.globalAlpha = 1;
    }
    pen.beginPath();
    walk(0, false);
    pen.strokeStyle = colour;
    pen.lineWidth = active ? 2.25 : 1.5;
    pen.setLineDash(dashed ? [5, 4] : []);
    pen.stroke();
    pen.setLineDash([]);
  }

  upright(pen, nm, colour, base, handle) {
    const x = Math.round(this.x(nm)) + 0.5;
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = handle ? 1.5 : 1;
    pen.beginPath();
    pen.moveTo(x, handle ? 5 : EDGE.top);
    pen.lineTo(x, base);
    pen.stroke();
    if (!handle) return;
    pen.beginPath();
    pen.arc(x, 5, 4, 0, 7);
    pen.fill();
  }
}
