// The spectra of the selection, the pins and the references; how alike they are; the table of them.

import { short } from "./plot.js";

const MOST = 8;

/** Return a spectrum on other wavelengths, linearly; NaN outside its own. */
export function resample(values, wavelength, onto) {
  let right = 1;
  return Float64Array.from(onto, (nm) => {
    if (nm < wavelength[0] - 1e-6 || nm > wavelength.at(-1) + 1e-6) return NaN;
    while (right < wavelength.length - 1 && wavelength[right] < nm) right++;
    const share = (nm - wavelength[right - 1]) / (wavelength[right] - wavelength[right - 1]);
    return values[right - 1] + share * (values[right] - values[right - 1]);
  });
}

const largest = (values) => values.reduce((most, value) => (value > most ? value : most), -Infinity);

/**
 * Judge a spectrum against a reference on the same wavelengths.
 *
 * mse: mean squared error, the maximum of the reference being 1, where both are known; with
 * `scaled` each is first divided by its own maximum. sam: angle between them, degrees.
 */
export function compare(spectrum, reference, scaled) {
  const known = [];
  for (let at = 0; at < spectrum.length; at++) {
    if (Number.isFinite(spectrum[at]) && Number.isFinite(reference[at])) known.push(at);
  }
  if (known.length < 2) return { mse: NaN, sam: NaN };
  const peak = largest(known.map((at) => reference[at]));
  const own = scaled ? largest(known.map((at) => spectrum[at])) : peak;
  let error = 0, dot = 0, one = 0, other = 0;
  for (const at of known) {
    const x = spectrum[at], r = reference[at];
    error += (x / own - r / peak) ** 2;
    dot += x * r;
    one += x * x;
    other += r * r;
  }
  const norm = Math.sqrt(one * other);
  const cosine = norm > 0 ? dot / norm : 0;
  return {
    mse: error / known.length,
    sam: Math.acos(Math.min(Math.max(cosine, -1), 1)) * 180 / Math.PI,
  };
}

/** Name a region: a point by its place, a rectangle by its size. */
export function named([top, left, bottom, right]) {
  return bottom - top === 1 && right - left === 1
    ? `x ${left}, y ${top}`
    : `${right - left} × ${bottom - top} px`;
}

export class Spectra {
  constructor() {
    this.selection = null;
    this.pins = [];
    this.references = [];
    this.active = null;
    this.scaled = false;
    this.wavelength = [];
  }

  /** All spectra with places: the selection, if it is none of the pins, and the pins. */
  get placed() {
    return this.selection ? [this.selection, ...this.pins] : this.pins;
  }

  select(region) {
    if (!this.selection) this.selection = { colour: "--ink" };
    Object.assign(this.selection, { region });
    this.active = this.selection;
    return this.selection;
  }

  pin() {
    if (!this.selection || this.pins.length >= MOST) return false;
    const taken = new Set(this.pins.map(({ number }) => number));
    const number = Array.from({ length: MOST }, (_, at) => at + 1).find((each) => !taken.has(each));
    this.pins.push(Object.assign(this.selection, { number, colour: `--pin-${number - 1}` }));
    this.active = this.pins.at(-1);
    this.selection = null;
    return true;
  }

  remove(item) {
    if (item === this.selection) this.selection = null;
    this.pins = this.pins.filter((each) => each !== item);
    if (this.active === item) this.active = this.selection ?? this.pins.at(-1) ?? null;
  }

  /** Add references; a few are shown at once, of a library only those that one chooses. */
  add(references) {
    const few = references.length <= 4;
    for (const each of references) {
      const colour = ["--soft", "--pin-5", "--pin-4", "--pin-6", "--pin-3"][this.references.length % 5];
      each.shown ??= few;
      this.references.push(Object.assign(each, { colour }));
    }
  }

  /** Return a reference on the wavelengths of the cube. */
  onGrid(reference) {
    if (reference.source !== undefined) return reference.mean ?? null;
    if (reference.grid !== this.wavelength) {
      reference.grid = this.wavelength;
      reference.resampled = resample(reference.values, reference.wavelength, this.wavelength);
    }
    return reference.resampled;
  }

  /** Return what the plot draws. */
  lines(colour) {
    const scale = (values) => (this.scaled ? 1 / Math.max(largest(values), 1e-30) : 1);
    const times = (values, factor) => (factor === 1 ? values : values.map((each) => each * factor));
    const lines = [];
    for (const reference of this.references) {
      const values = reference.shown && this.onGrid(reference);
      if (!values) continue;
      const factor = scale(values.filter(Number.isFinite));
      lines.push({ values: times(values, factor), colour: colour(reference.colour), dashed: true });
    }
    for (const item of this.placed) {
      if (!item.mean) continue;
      const factor = scale(item.mean), around = item.pixels > 1 ? item.spread : item.uncertainty;
      lines.push({
        values: times(item.mean, factor),
        spread: around ? times(around, factor) : null,
        colour: colour(item.colour),
        active: item === this.active,
      });
    }
    return lines;
  }

  /** Write all spectra as CSV: wavelength, mean and spread of each place, references. */
  csv() {
    const columns = [["wavelength nm", this.wavelength]];
    for (const item of this.placed) {
      if (!item.mean) continue;
      const [top, left, bottom, right] = item.measured;
      const place = item.pixels > 1 ? `x ${left}-${right - 1} y ${top}-${bottom - 1}` : `x ${left} y ${top}`;
      const name = item.number ? `pin ${item.number} (${place})` : `selection (${place})`;
      columns.push([name, item.mean]);
      if (item.pixels > 1) columns.push([`${name} standard deviation`, item.spread]);
    }
    for (const reference of this.references) {
      const values = reference.shown && this.onGrid(reference);
      if (values) columns.push([reference.name.replaceAll(/[",;\t\n]/g, " "), values]);
    }
    const cell = (value) => (Number.isFinite(value) ? String(Number(value.toPrecision(9))) : "");
    const rows = this.wavelength.map((_, at) => columns.map(([, values]) => cell(values[at])).join(","));
    return [columns.map(([name]) => name).join(","), ...rows, ""].join("\n");
  }
}

/** Make an element. */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "colour") made.style.setProperty("--chip", `var(${value})`);
    else if (name.startsWith("aria-")) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

function icon(name) {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg"), use = document.createElementNS(space, "use");
  use.setAttribute("href", `#i-${name}`);
  svg.append(use);
  return svg;
}

/** Fill the table of places; `told` has `activate(item)`, `pin()`, `remove(item)`. */
export function fillPlaces(body, spectra, band, told) {
  const full = spectra.pins.length >= MOST;
  body.replaceChildren(...spectra.placed.map((item) => {
    const chip = element("span", { className: "chip", colour: item.colour, ariaHidden: "true" }, String(item.number ?? ""));
    const name = element("button", { className: "name", onclick: () => told.activate(item) }, chip, element("span", {}, named(item.region)));
    const tools = [];
    if (!item.number) {
      tools.push(element("button", {
        className: "icon", "aria-label": "Pin", disabled: full, onclick: () => told.pin(),
        title: full ? `${MOST} pins are all there is room for` : "Keep this spectrum (P)",
      }, icon("pin")));
    }
    tools.push(element("button", {
      className: "icon", "aria-label": `Remove ${named(item.region)}`, title: "Remove", onclick: () => told.remove(item),
    }, icon("close")));
    const row = element("tr", { "aria-selected": item === spectra.active },
      element("td", {}, name),
      element("td", { className: "number" }, item.mean ? short(item.mean[band]) : "…"),
      element("td", {}, ...tools));
    row.addEventListener("click", (event) => {
      if (!event.target.closest("button")) told.activate(item);
    });
    return row;
  }));
}

/** Fill the table of references, those that are most like the active spectrum first. */
export function fillReferences(body, spectra, toggle) {
  const rows = spectra.references.map((reference) => {
    const values = spectra.onGrid(reference), mean = spectra.active?.mean;
    const judged = values && mean ? compare(mean, values, spectra.scaled) : { mse: NaN, sam: NaN };
    return { reference, ...judged };
  });
  rows.sort((a, b) => (a.sam || 1e9) - (b.sam || 1e9));
  body.replaceChildren(...rows.map(({ reference, mse, sam }) => {
    const box = element("input", { type: "checkbox", checked: reference.shown, onchange: () => toggle(reference) });
    return element("tr", {},
      element("td", {}, element("label", { className: "name" }, box,
        element("span", { className: "dash", colour: reference.colour }), element("span", { title: reference.name }, reference.name))),
      element("td", { className: "number" }, Number.isFinite(mse) ? short(mse, 3) : "–"),
      element("td", { className: "number" }, Number.isFinite(sam) ? `${sam.toFixed(2)}°` : "–"));
  }));
}
