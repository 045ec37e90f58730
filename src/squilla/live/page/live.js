// The live camera: what is watched, what comes back with every frame, and the wishes to the camera.

import { short } from "./plot.js";
import { unfold } from "./show.js";
import { element } from "./spectra.js";

const WATCH = 0; // no question has this number: an answer to it is a refusal to watch

/** Where the time of a frame goes. */
const STAGES = [
  ["frame", "Read", "Until the camera had a frame"],
  ["measure", "Measure", "Correct the frame, find the disparity, align the sub-images"],
  ["decode", "Decode", "Reconstruct what is shown"],
  ["send", "Send", "To this page"],
  ["page", "Page", "Until this page had painted it"],
];

const ms = (value) => (value === undefined ? "–" : `${Math.round(value)} ms`);

const $ = (id) => document.getElementById(id);

export class Live {
  /** @param {object} parts - connection, show, spectra, warn, `arrived(item)`. */
  constructor(parts) {
    Object.assign(this, parts);
    this.on = false;
    this.wanted = [];
    this.answers = new Map();
    this.times = [];
    for (const name of ["exposure", "gain"]) {
      $(name).addEventListener("change", () => this.wish(name, Number($(name).value)));
    }
    for (const [id, name] of [["automatic", "automatic"], ["freeze", "frozen"], ["record", "recording"]]) {
      $(id).onclick = () => this.wish(name, $(id).getAttribute("aria-pressed") !== "true");
    }
    $("step").onclick = () => this.wish("step", true);
  }

  open(about) {
    if (this.on && !about.live) this.connection.tell({ ask: "watch", source: 0, wanted: [] });
    this.on = Boolean(about.live);
    $("live").hidden = !this.on;
    if (!this.on) return;
    $("exposure").disabled = $("automatic").disabled = !about.exposures;
    $("gain").parentElement.hidden = !about.gains;
    for (const [name, limits] of [["exposure", about.exposures], ["gain", about.gains]]) {
      $(name).title = limits ? `${short(limits[0])} to ${short(limits[1])}` : "Taken with the frames";
    }
    $("record").disabled = !about.records;
    $("record").title = about.records ? "Record frames" : "Start with --record and a place to write";
  }

  /** Tell the server what is on the page; it is answered again for every frame. */
  watch() {
    if (!this.on) return;
    const { show, spectra } = this;
    this.pictures = show.wanted().map((ask) => show.message(ask));
    this.places = spectra.placed.slice();
    this.wanted = [...this.pictures];
    if (this.places.length) {
      this.wanted.push({ ask: "spectra", source: show.number, regions: this.places.map(({ region }) => region) });
    }
    this.round = (this.round ?? 0) + 1;
    const first = this.round * 16;
    this.wanted = this.wanted.map((ask, at) => ({ ...ask, id: first + at }));
    this.answers.clear();
    this.connection.tell({ ask: "watch", id: WATCH, source: show.number, wanted: this.wanted });
  }

  /** The camera has shown nothing yet, or nothing that can be measured: say so, and try again. */
  refused(sentence) {
    if (!this.on) return;
    this.trouble(sentence);
    setTimeout(() => this.watch(), 1000);
  }

  /** Say what is wrong, or with `mild` what one should know. */
  trouble(sentence, mild = false) {
    $("trouble").hidden = !sentence;
    $("trouble").className = mild ? "hint" : "bad";
    if ($("trouble").textContent !== (sentence ?? "")) $("trouble").textContent = sentence ?? "";
  }

  frame(header, values) {
    if (!this.on) return;
    if (!header.last) {
      if (header.error) this.warn(header.error, true);
      else if (header.id >= this.round * 16) this.answers.set(header.id - this.round * 16, { header, values });
      return;
    }
    this.connection.tell({ ask: "acknowledge", frame: header.frame });
    this.status(header.status);
    const pictures = this.pictures.map((ask, at) => this.answers.get(at) && unfold(this.answers.get(at), ask.kind));
    if (pictures.length && pictures.every(Boolean)) {
      this.show.paint(pictures);
      this.shown();
    }
    const spectra = this.answers.get(this.pictures.length);
    if (spectra) this.take(spectra);
    this.answers.clear();
    $("live").dataset.frame = header.frame;
  }

  take({ header, values }) {
    const [, count, bands] = header.shape;
    this.places.forEach((item, at) => Object.assign(item, {
      measured: item.region,
      mean: values.slice(at * bands, (at + 1) * bands),
      spread: values.slice((count + at) * bands, (count + at + 1) * bands),
      pixels: header.pixels[at],
    }));
    this.arrived(this.spectra.active);
  }

  /** Count the pictures that were really shown in the last seconds. */
  shown() {
    const now = performance.now();
    this.times = [...this.times.filter((each) => now - each < 3000), now];
  }

  async wish(name, value) {
    try {
      const { header } = await this.connection.ask({ ask: "control", source: this.show.number, name, value });
      this.stand(header.control);
    } catch (error) {
      this.warn(error.message, true);
    }
  }

  /** Show how the switches stand. */
  stand({ exposure, gain, automatic, frozen, recording, recorded, missed }) {
    for (const [name, value] of [["exposure", exposure], ["gain", gain]]) {
      if (document.activeElement !== $(name)) $(name).value = value === null ? "" : short(value, 4);
    }
    $("automatic").setAttribute("aria-pressed", automatic);
    $("freeze").setAttribute("aria-pressed", frozen);
    $("record").setAttribute("aria-pressed", recording);
    $("recorded").textContent = recorded || missed ? `${recorded} recorded${missed ? `, ${missed} missed` : ""}` : "";
  }

  status(told) {
    this.stand(told);
    const [first, last] = [this.times[0], this.times.at(-1)];
    const shown = this.times.length > 1 ? (this.times.length - 1) / (last - first) * 1000 : null;
    const facts = [
      ["Shown", shown === null ? "–" : `${shown.toFixed(1)} /s`],
      ["Measured", told.rate === null ? "–" : `${told.rate.toFixed(1)} /s`],
      ["Dropped", String(told.dropped)],
      ["Incomplete", String(told.incomplete)],
      ["Saturated", `${(100 * told.saturated).toFixed(told.saturated > 0.1 ? 0 : 2)} %`, told.saturated > 0.01],
      ["Alignment", told.alignment.toFixed(2), told.alignment < 0.1],
      ["Distance", `${Math.round(told.distance)} mm`],
      ["SNR", `${told.snr.toFixed(1)} dB`],
      ...STAGES.map(([name, label, title]) => [label, ms(told.stages[name]), false, title]),
    ];
    $("facts").replaceChildren(...facts.map(([name, value, bad, title = ""]) => element("div", { title },
      element("dt", {}, name), element("dd", { className: bad ? "bad" : "" }, value))));
    this.trouble(told.error ?? told.record_error ?? told.notice, !(told.error ?? told.record_error));
  }
}
