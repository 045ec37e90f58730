// The contrast: what numbers there are, in the colours they are shown in, between two handles.

import { short } from "./plot.js";
import { quantile } from "./maps.js";

const STEPS = 1000;
const $ = (id) => document.getElementById(id);

export class Contrast {
  constructor(show) {
    this.show = show;
    this.canvas = $("histogram");
    for (const [id, which] of [["range-low", "low"], ["range-high", "high"]]) {
      $(id).addEventListener("input", (event) => this.set(which, Number(event.target.value)));
    }
    $("auto").onclick = () => this.fit();
  }

  /** Move one end; the two never cross. */
  set(which, step) {
    const { show } = this, [from, to] = this.domain, gap = (to - from) / 200;
    const value = from + step / STEPS * (to - from);
    show.auto = false;
    show[which] = which === "low" ? Math.min(value, show.high - gap) : Math.max(value, show.low + gap);
    show.repaint();
  }

  /** Fit the contrast to every picture again, or keep the present one for all. */
  fit() {
    this.show.auto = !this.show.auto;
    if (this.show.auto && this.show.whole) {
      this.show.fitContrast();
      this.show.repaint();
    }
    this.draw();
  }

  /** Numbers between which the handles move. */
  get domain() {
    const { sorted, low, high } = this.show;
    const from = Math.min(quantile(sorted, 0), low), to = Math.max(quantile(sorted, 0.9995), high);
    return to > from ? [from, to] : [from, from + 1];
  }

  draw() {
    const { show, canvas } = this;
    $("auto").setAttribute("aria-pressed", show.auto);
    if (!show.whole || !canvas.clientWidth) return;
    const [from, to] = this.domain, { low, high, sorted } = show;
    const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const bins = new Float64Array(Math.floor(width / 2));
    for (const value of sorted) {
      const bin = Math.floor((value - from) / (to - from) * bins.length);
      if (bin >= 0) bins[Math.min(bin, bins.length - 1)]++;
    }
    const most = Math.max(...bins.map(Math.sqrt), 1e-9);
    const soft = getComputedStyle(canvas).getPropertyValue("--faint");
    const table = new Uint8Array(show.isColour ? 0 : show.colours.buffer);
    bins.forEach((count, bin) => {
      const value = from + (bin + 0.5) / bins.length * (to - from);
      const step = Math.round(Math.min(Math.max((value - low) / (high - low), 0), 1) * 255) * 4;
      const tall = Math.sqrt(count) / most * (height - 6);
      pen.fillStyle = soft;
      pen.globalAlpha = value < low || value > high ? 0.35 : 0.8;
      pen.fillRect(bin * 2, height - 5 - tall, 1.5, tall);
      pen.globalAlpha = 1;
      pen.fillStyle = show.isColour
        ? `hsl(0 0% ${step / 4 / 255 * 100}%)`
        : `rgb(${table[step]} ${table[step + 1]} ${table[step + 2]})`;
      pen.fillRect(bin * 2, height - 4, 2.5, 4);
    });
    $("range-low").value = (low - from) / (to - from) * STEPS;
    $("range-high").value = (high - from) / (to - from) * STEPS;
    const unit = show.mode === "angle" ? "°" : "";
    for (const [id, value] of [["low", low], ["high", high]]) {
      $(id).value = short(value, 3) + unit;
      $(`range-${id}`).setAttribute("aria-valuetext", short(value, 3) + unit);
    }
  }
}
