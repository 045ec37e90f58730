// The page: puts picture, plot and lists together and listens to hands and keys.

import { Connection } from "./connection.js";
import { Contrast } from "./contrast.js";
import { save, savePicture, savePlot } from "./export.js";
import { Live } from "./live.js";
import { Plot, short } from "./plot.js";
import { MAPS, MODES, nearest, Show } from "./show.js";
import { element, fillPlaces, fillReferences, Spectra } from "./spectra.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const root = document.documentElement;
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

/** Note how long something took, for the browser's own tools; the list is kept short. */
let noted = 0;
function note(name, start) {
  if (++noted % 1000 === 0) performance.clearMeasures();
  performance.measure(name, { start, end: performance.now() });
}

// --- parts -------------------------------------------------------------------------------------

const spectra = new Spectra();
let sources = [], number = 0, playing = null, show = null;

const view = new View($("picture"), {
  select: (region) => select(region),
  hover: (point) => readout(point),
  zoomed: () => {
    $("zoom").value = `${Math.round(view.scale * 100)} %`;
    show?.sharpen();
  },
});

const plot = new Plot($("plot"), {
  hover: (nm) => listPlaces(nm === null ? show.band : nearest(spectra.wavelength, nm)),
  choose: (nm) => { if (spectra.wavelength.length) setBand(nearest(spectra.wavelength, nm)); },
});

const connection = new Connection({
  hello: (header) => greet(header),
  frame: (header, values) => live.frame(header, values),
  refused: (sentence) => live.refused(sentence),
  lost: () => warn("The viewer does not answer; trying again. If it was ended, start it in the terminal."),
});

show = new Show(connection, view, {
  shown: () => shown(),
  failed: (error) => warn(error.message, true),
  waiting: (flag) => { $("waiting").hidden = !flag; },
  watch: () => live.watch(),
});

const contrast = new Contrast(show);
const live = new Live({ connection, show, spectra, arrived: (item) => arrived(item), warn });

// --- opening -----------------------------------------------------------------------------------

function greet(header) {
  warn("");
  const first = !sources.length;
  sources = header.sources;
  show.store.clear();
  $("tabs").replaceChildren(...sources.map((source, at) => element("button", {
    role: "tab", id: `tab-${at}`, className: source.error ? "broken" : "", onclick: () => open(at),
    title: Object.entries(source.facts ?? {}).map(([name, value]) => `${name}: ${value}`).join("\n"),
  }, source.title)));
  $("origin").textContent = `squilla ${header.hello}`;
  open(Math.min(number, sources.length - 1));
  if (first) addReferences(header.references);
}

function open(at) {
  number = at;
  const about = sources[at];
  [...$("tabs").children].forEach((tab, place) => {
    tab.setAttribute("aria-selected", place === at);
    tab.tabIndex = place === at ? 0 : -1;
  });
  document.title = `${about.title} – squilla`;
  live.open(about);
  if (about.error) {
    stop();
    Object.assign(show, { about, whole: null, fine: null });
    cover("This is no cube", about.error);
    return;
  }
  cover("Opening", about.by_need ? "It is larger than the memory set aside; what is shown is read by need." : "");
  const before = { rows: view.rows, columns: view.columns };
  spectra.wavelength = about.wavelength;
  Object.assign(plot, { wavelength: about.wavelength, colours: about.colours });
  $("slider").max = about.wavelength.length - 1;
  spectra.references = spectra.references.filter(({ source }) => source === undefined);
  sources.forEach((other, place) => {
    const fits = !other.error && !other.live && place !== at && other.rows === about.rows
      && other.columns === about.columns && other.wavelength.join() === about.wavelength.join();
    if (fits) spectra.add([{ name: other.title, source: place, shown: false }]);
  });
  if (before.rows !== about.rows || before.columns !== about.columns) {
    spectra.placed.slice().forEach((item) => spectra.remove(item));
  }
  show.open(at, about);
  if (!about.live) spectra.placed.forEach(fetchSpectrum);
  fillModes();
  setBand(show.band, false);
  drawPlot();
  listAll();
}

function cover(title, text) {
  $("cover").hidden = !title;
  $("cover-title").textContent = title;
  $("cover-text").textContent = text;
}

let calm = 0;
function warn(text, passing = false) {
  clearTimeout(calm);
  $("banner").hidden = !text;
  $("banner").textContent = text;
  if (text && passing) calm = setTimeout(() => warn(""), 6000);
}

// --- picture -----------------------------------------------------------------------------------

function shown() {
  if (!$("cover").hidden) {
    cover("");
    note("squilla first picture", 0);
  }
  contrast.draw();
}

function setMode(mode) {
  if (mode === "layer" && !show.layer) return;
  if (mode === "angle") aim();
  show.mode = mode;
  fillModes();
  show.refresh();
}

function fillModes() {
  const there = Object.entries(MODES).filter(([mode]) => mode !== "layer" || show.layer);
  $("modes").replaceChildren(...there.map(([mode, { label, key, title }]) => element("button", {
    role: "radio", "aria-checked": mode === show.mode, tabIndex: mode === show.mode ? 0 : -1,
    title: `${title} (${key.toUpperCase()})`, onclick: () => setMode(mode),
  }, label)));
  fillOptions();
}

/** Put the choices of the mode under the picture. */
function fillOptions() {
  const nm = (list, at, label) => {
    const input = element("input", { type: "number", step: "any", value: short(show.about.wavelength[list[at]], 5), "aria-label": label });
    input.addEventListener("change", () => {
      list[at] = nearest(show.about.wavelength, Number(input.value));
      input.value = short(show.about.wavelength[list[at]], 5);
      show.refresh();
    });
    return input;
  };
  const choice = (label, options, chosen, take) => {
    const box = element("select", { "aria-label": label, onchange: () => take(box.value) },
      ...options.map(([value, text]) => element("option", { value, selected: value === chosen }, text)));
    return box;
  };
  const maps = () => element("label", {}, "Map", choice("Colour map", MAPS.map((name) => [name, name]),
    show.maps[show.mode], (name) => { show.maps[show.mode] = name; show.repaint(); }));
  const options = {
    colour: () => [element("label", {}, "White", choice("What is shown as white", [
      ["equal", "equal energy"], ["selected", "selected spectrum"],
    ], show.white ? "selected" : "equal", (value) => setWhite(value === "selected")))],
    three: () => [
      nm(show.three, 0, "Red, nm"), nm(show.three, 1, "Green, nm"), nm(show.three, 2, "Blue, nm"), "nm",
      element("label", {}, "Gamma", choice("Gamma", [["1", "1"], ["2.2", "2.2"]], String(show.gamma),
        (value) => { show.gamma = Number(value); show.repaint(); })),
    ],
    band: () => [maps()],
    ratio: () => [nm(show.ratio, 0, "Above, nm"), "/", nm(show.ratio, 1, "Below, nm"), "nm", maps()],
    angle: () => [maps(), element("span", { className: "hint" }, "degrees")],
    layer: () => [choice("Map of the file", show.about.layers.map(({ name, label }) => [name, label]), show.layer,
      (name) => { show.layer = name; show.refresh(); }), maps()],
  };
  $("options").replaceChildren(...options[show.mode]());
}

function setWhite(selected) {
  if (selected && !spectra.active?.mean) {
    warn("Select something white first.", true);
    selected = false;
  }
  show.white = selected ? spectrumOf(spectra.active) : null;
  fillOptions();
  show.refresh();
}

function spectrumOf(item) {
  return { key: `${number}:${item.region.join("-")}`, values: Array.from(item.mean, (each) => (Number.isFinite(each) ? each : 0)) };
}

/** Let similarity be to the active spectrum. */
function aim() {
  const item = spectra.active?.mean ? spectra.active : null;
  show.target = item ? spectrumOf(item) : null;
}

function setBand(band, look = true) {
  const start = performance.now();
  const last = show.about.wavelength.length - 1;
  show.band = Math.min(Math.max(band, 0), last);
  const nm = show.about.wavelength[show.band];
  $("slider").value = show.band;
  $("slider").setAttribute("aria-valuetext", `${short(nm, 5)} nm`);
  $("wavelength").value = `${short(nm, 5)} nm`;
  plot.marker = nm;
  if (look) {
    if (show.mode === "ratio") {
      show.ratio[0] = show.band;
      fillOptions();
    } else if (!show.followsBand) {
      show.mode = "band";
      fillModes();
    }
    show.told.shown = () => {
      show.told.shown = shown;
      shown();
      note("squilla band", start);
    };
    show.refresh();
  }
  plot.draw();
  listPlaces();
}

function play(on = !playing) {
  clearInterval(playing);
  playing = null;
  if (on && show.about.wavelength.length > 1) {
    // About six seconds for all bands, never faster than the eye can follow.
    const pause = Math.max(40, 6000 / show.about.wavelength.length);
    playing = setInterval(() => setBand((show.band + 1) % show.about.wavelength.length), pause);
  }
  $("play").setAttribute("aria-pressed", Boolean(playing));
  $("play").querySelector("use").setAttribute("href", playing ? "#i-pause" : "#i-play");
}

const stop = () => play(false);

function readout(point) {
  const values = point ? show.values(point) : [];
  if (!values.length) {
    $("readout").value = "";
    return;
  }
  const unit = show.mode === "angle" ? "°" : "";
  $("readout").value = `x ${point[1]}  y ${point[0]}   ${values.map((each) => short(each) + unit).join("  ")}`;
}

function setTool(pan) {
  view.panning = pan;
  $("picture").classList.toggle("pan", pan);
  $("tool-pan").setAttribute("aria-pressed", pan);
  $("tool-select").setAttribute("aria-pressed", !pan);
}

// --- spectra -----------------------------------------------------------------------------------

function select(region) {
  const item = spectra.select(region);
  if (live.on) live.watch();
  else fetchSpectrum(item);
  mark();
  listPlaces();
}

/** Fetch the spectrum of a place; while it is under way the place may move on. */
async function fetchSpectrum(item) {
  const start = performance.now(), region = item.region;
  if (item.fetching) {
    item.again = true;
    return;
  }
  item.fetching = true;
  busy();
  try {
    const { header, values } = await connection.ask({ ask: "spectra", source: number, regions: [region] });
    const bands = spectra.wavelength.length;
    Object.assign(item, {
      measured: region, mean: values.slice(0, bands), spread: values.slice(bands, 2 * bands), pixels: header.pixels[0],
    });
    await uncertainty(item, region);
    arrived(item);
    note("squilla spectrum", start);
  } catch (error) {
    warn(error.message, true);
  }
  item.fetching = false;
  if (item.again) {
    item.again = false;
    fetchSpectrum(item);
  }
  busy();
}

function busy() {
  $("spectra").setAttribute("aria-busy", spectra.placed.some(({ fetching }) => fetching));
}

/** Fetch the standard deviation that the file states for a point, if it does. */
async function uncertainty(item, [top, left]) {
  item.uncertainty = null;
  const told = show.about.layers.find(({ name, spectral }) => spectral && /uncertainty|error|std|sigma/i.test(name));
  if (!told || item.pixels > 1) return;
  const { values } = await connection.ask({
    ask: "spectra", source: number, layer: told.name, regions: [[top, left, top + 1, left + 1]],
  });
  item.uncertainty = values.slice(0, spectra.wavelength.length);
}

function arrived(item) {
  drawPlot();
  listAll();
  if (item === spectra.active) {
    spectra.references.forEach(fetchOther);
    if (show.mode === "angle" && !live.on) {
      aim();
      show.refresh();
    }
  }
}

/** Fetch what another cube shows at the active place. */
async function fetchOther(reference) {
  if (reference.source === undefined || !reference.shown || !spectra.active || reference.fetching) return;
  reference.fetching = true;
  try {
    const { values } = await connection.ask({ ask: "spectra", source: reference.source, regions: [spectra.active.region] });
    reference.mean = values.slice(0, spectra.wavelength.length);
  } catch (error) {
    warn(error.message, true);
  }
  reference.fetching = false;
  drawPlot();
  listReferences();
}

function drawPlot() {
  const { quantity, unit } = sources[number];
  $("quantity").textContent = spectra.scaled ? "relative" : [quantity, unit].filter(Boolean).join(", ");
  plot.lines = spectra.lines(colour);
  $("plot-empty").hidden = plot.lines.length > 0;
  plot.draw();
}

function mark() {
  view.marks = spectra.placed.map((item) => ({
    region: item.region,
    colour: item.number ? colour(item.colour) : "#fff",
    label: item.number ? String(item.number) : "",
    active: item === spectra.active,
  }));
  view.draw();
}

function listPlaces(band = show.band) {
  $("at").textContent = spectra.placed.length ? `${short(spectra.wavelength[band], 5)} nm` : "";
  $("spectra").hidden = !spectra.placed.length;
  fillPlaces($("spectra").tBodies[0], spectra, band, { activate, pin, remove });
}

function listReferences() {
  $("reference-empty").hidden = spectra.references.length > 0;
  fillReferences($("references").tBodies[0], spectra, (reference) => {
    reference.shown = !reference.shown;
    reference.mean = null;
    fetchOther(reference);
    drawPlot();
  });
}

function listAll() {
  listPlaces();
  listReferences();
}

function activate(item) {
  spectra.active = item;
  mark();
  arrived(item);
}

function pin() {
  if (!spectra.pin()) return;
  mark();
  drawPlot();
  listAll();
  live.watch();
}

function remove(item) {
  spectra.remove(item);
  mark();
  drawPlot();
  listAll();
  live.watch();
}

function scaleToPeak(on = !spectra.scaled) {
  spectra.scaled = on;
  $("peak").setAttribute("aria-pressed", on);
  drawPlot();
  listReferences();
}

function addReferences(found) {
  if (!found.length) return;
  if (!spectra.references.some(({ source }) => source === undefined)) scaleToPeak(true);
  spectra.add(found);
  drawPlot();
  listReferences();
}

async function readReferences(file) {
  if (file.size > 1e6) {
    warn(`${file.name} is larger than 1 MB; a table of spectra was expected.`, true);
    return;
  }
  try {
    const answer = await connection.ask({ ask: "reference", name: file.name.slice(0, 200), text: await file.text() });
    addReferences(answer.header.references);
  } catch (error) {
    warn(error.message, true);
  }
}

// --- theme, export, help -----------------------------------------------------------------------

function setTheme(name) {
  root.dataset.theme = name;
  mark();
  if (sources.length) drawPlot();
  contrast.draw();
}

const stem = () => sources[number].title.replace(/\.[^.]+$/, "");
const exportSpectra = () => save(`${stem()}-spectra.csv`, new Blob([spectra.csv()], { type: "text/csv" }));
const exportPicture = async () => savePicture(`${stem()}-${await show.painted()}.png`, view.image.canvas);
const exportPlot = () => savePlot(`${stem()}-spectra.png`, plot);

function menu(on) {
  $("export-menu").hidden = !on;
  $("export").setAttribute("aria-expanded", on);
  if (on) $("export-menu").firstElementChild.focus();
}

// --- hands -------------------------------------------------------------------------------------

$("slider").addEventListener("input", (event) => setBand(Number(event.target.value)));
$("play").onclick = () => play();
$("tool-select").onclick = () => setTool(false);
$("tool-pan").onclick = () => setTool(true);
$("zoom-in").onclick = () => view.zoom(1.5);
$("zoom-out").onclick = () => view.zoom(1 / 1.5);
$("zoom-fit").onclick = () => view.fit();
$("peak").onclick = () => scaleToPeak();
$("theme").onclick = () => setTheme(root.dataset.theme === "dark" ? "light" : "dark");
$("help-open").onclick = () => $("help").showModal();
$("help-close").onclick = () => $("help").close();
$("export").onclick = () => menu($("export-menu").hidden);
$("export-csv").onclick = exportSpectra;
$("export-picture").onclick = exportPicture;
$("export-plot").onclick = exportPlot;
document.addEventListener("click", (event) => { if (!event.target.closest("#export")) menu(false); });
$("reference-file").addEventListener("change", (event) => {
  [...event.target.files].forEach(readReferences);
  event.target.value = "";
});
$("add-reference").addEventListener("keydown", (event) => {
  if (event.key === "Enter" || event.key === " ") {
    event.preventDefault();
    $("reference-file").click();
  }
});
$("lists").addEventListener("dragover", (event) => {
  event.preventDefault();
  $("lists").classList.add("drop");
});
$("lists").addEventListener("dragleave", () => $("lists").classList.remove("drop"));
$("lists").addEventListener("drop", (event) => {
  event.preventDefault();
  $("lists").classList.remove("drop");
  [...event.dataTransfer.files].forEach(readReferences);
});

/** In a group of choices the arrows move and choose, as in all programs. */
for (const group of ["modes", "tabs"]) {
  $(group).addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const all = [...$(group).children], at = all.indexOf(document.activeElement);
    const next = (at + step + all.length) % all.length;
    all[next].click();
    $(group).children[next].focus();
  });
}

const KEYS = {
  ...Object.fromEntries(Object.entries(MODES).map(([mode, { key }]) => [key, () => setMode(mode)])),
  "[": () => setBand(show.band - 1),
  "]": () => setBand(show.band + 1),
  "{": () => setBand(show.band - 10),
  "}": () => setBand(show.band + 10),
  " ": () => play(),
  a: () => contrast.fit(),
  p: pin,
  v: () => setTool(false),
  h: () => setTool(true),
  "+": () => view.zoom(1.5),
  "=": () => view.zoom(1.5),
  "-": () => view.zoom(1 / 1.5),
  0: () => view.fit(),
  n: () => scaleToPeak(),
  l: () => $("reference-file").click(),
  e: exportSpectra,
  i: exportPicture,
  d: () => $("theme").click(),
  f: () => { if (live.on) $("freeze").click(); },
  ".": () => { if (live.on) $("step").click(); },
  "?": () => $("help").showModal(),
  Delete: () => { if (spectra.pins.length) remove(spectra.pins.at(-1)); },
  Escape: () => menu(false),
};
KEYS.Backspace = KEYS.Delete;

document.addEventListener("keydown", (event) => {
  const { target, key } = event;
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open || !show.about || show.about.error) return;
  if (target.matches("select, input:not([type=range]):not([type=checkbox])")) return;
  if (key === "Enter" && target === $("picture")) {
    pin();
    return;
  }
  // A button or a box that has the focus keeps its own space bar.
  if (key === " " && target.matches("button, label, [type=checkbox]")) return;
  const act = KEYS[key.length === 1 ? key.toLowerCase() : key];
  if (!act) return;
  event.preventDefault();
  act();
});

const dark = matchMedia("(prefers-color-scheme: dark)");
dark.addEventListener("change", () => setTheme(dark.matches ? "dark" : "light"));
setTheme(dark.matches ? "dark" : "light");
