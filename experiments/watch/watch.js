// The page of a run: asks every second what is new, and shows the step at the scrubber.
"use strict";

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7a5195", "#5d6b77"];
const state = { frames: [], version: "", newest: true, chosen: -1, timer: null, photograph: "", made: new Map(), asked: false };

function drawn(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}
const line = (points, style, extra = {}) =>
  drawn("polyline", { points: points.map(([z, y]) => `${z},${-y}`).join(" "), class: style, ...extra });
const number = (value, digits = 4) => {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-3 || size >= 1e6) ? value.toExponential(digits - 1) : String(Number(value.toPrecision(digits)));
  return text.replaceAll("-", "\u2212");
};
const said = (text) => element("p", {}, text);

// ---------------------------------------------------------------- what is drawn

function section(found) {
  if (typeof found === "string") return said(`No section: ${found}`);
  const [z, y, width, height] = found.box;
  const picture = drawn("svg", { viewBox: `${z} ${y} ${width} ${height}`, role: "img", "aria-label": "Section of the lens with rays" });
  picture.append(line([[z, 0], [z + width, 0]], "axis"));
  for (const outline of found.glass) picture.append(drawn("polygon", { points: outline.map(([a, b]) => `${a},${-b}`).join(" "), class: "glass" }));
  for (const field of found.fields) for (const ray of field.rays) picture.append(line(ray, "ray", { stroke: field.colour }));
  for (const curve of found.surfaces) picture.append(line(curve, "surface"));
  for (const bar of found.stop) picture.append(line(bar, "stop"));
  picture.append(line(found.sensor, "sensor"));
  return picture;
}

function legend(entries) {
  return entries.map(([colour, text]) => element("span", {},
    drawn("svg", { viewBox: "0 0 16 10" }, drawn("rect", { width: 16, height: 10, rx: 2, fill: colour })), text));
}

function spots(found) {
  if (typeof found === "string") return [said(`No spots: ${found}`)];
  const fields = new Map();
  for (const spot of found.spots) fields.set(spot.field, [...(fields.get(spot.field) ?? []), spot]);
  const reach = 1.1 * Math.max(1e-3, ...found.spots.flatMap((spot) => spot.points.map(([x, y]) => Math.max(Math.abs(x), Math.abs(y)))));
  return [...fields].map(([field, some]) => {
    const size = 2 * reach, radius = size / 90;
    const picture = drawn("svg", { viewBox: `${-reach} ${-reach} ${size} ${size}`, role: "img", "aria-label": `Spots of field ${field}` },
      drawn("rect", { x: -reach, y: -reach, width: size, height: size, fill: "none", class: "rule" }));
    for (const spot of some) for (const [x, y] of spot.points) picture.append(drawn("circle", { cx: x, cy: -y, r: radius, fill: spot.colour, class: "dot" }));
    const radii = some.map((spot) => `${spot.wavelength} ${number(spot.rms, 3)}`).join(", ");
    return element("figure", {}, picture, element("figcaption", {}, `${field}: ${radii} µm`));
  });
}

function plot({ title, unit, log, series }, step) {
  const W = 420, H = 200, left = 54, bottom = 22, scale = log ? Math.log10 : (v) => v;
  const every = series.flatMap((s) => s.points);
  const x0 = Math.min(...every.map((p) => p[0])), x1 = Math.max(...every.map((p) => p[0]), x0 + 1);
  let y0 = Math.min(...every.map((p) => scale(p[1]))), y1 = Math.max(...every.map((p) => scale(p[1])));
  if (y1 - y0 < 1e-9) { y0 -= 0.5; y1 += 0.5; }
  const x = (v) => left + (W - left - 8) * (v - x0) / (x1 - x0), y = (v) => 8 + (H - bottom - 8) * (y1 - scale(v)) / (y1 - y0);
  const picture = drawn("svg", { viewBox: `0 0 ${W} ${H}`, class: "plot", role: "img", "aria-label": `${title} against steps` });
  for (const share of [0, 0.5, 1]) {
    const value = log ? 10 ** (y0 + share * (y1 - y0)) : y0 + share * (y1 - y0), at = y(value);
    picture.append(drawn("line", { x1: left, x2: W - 8, y1: at, y2: at, class: "rule" }),
      drawn("text", { x: left - 5, y: at + 4, "text-anchor": "end" }, number(value, 3)));
    picture.append(drawn("text", { x: x(x0 + share * (x1 - x0)), y: H - 5, "text-anchor": ["start", "middle", "end"][2 * share] }, number(Math.round(x0 + share * (x1 - x0)), 6)));
  }
  series.forEach((s, n) => picture.append(drawn("polyline", { class: "curve", stroke: COLOURS[n % COLOURS.length], points: s.points.map(([a, b]) => `${x(a)},${y(b)}`).join(" ") })));
  if (step !== undefined && step >= x0) picture.append(drawn("line", { x1: x(Math.min(step, x1)), x2: x(Math.min(step, x1)), y1: 8, y2: H - bottom, class: "cursor" }));
  const value = (s) => { const before = s.points.filter((p) => step === undefined || p[0] <= step); return number((before[before.length - 1] ?? s.points[0])[1], 4); };
  return element("figure", {}, element("figcaption", {}, `${title}${unit ? `, ${unit}` : ""}`), picture,
    element("p", { className: "legend" }, ...legend(series.map((s, n) => [COLOURS[n % COLOURS.length], `${s.name} ${value(s)}`]))));
}

// ---------------------------------------------------------------- the chosen step

let compared = null;

function photographs(frames, chosen) {
  // Photographs are recorded after validations: the last ones up to the chosen step.
  const frame = frames.slice(0, chosen + 1).reverse().find((f) => Object.keys(f.pictures).length);
  $("photographs").hidden = !frame;
  if (!frame) return;
  const { PSF, ...others } = frame.pictures;
  const names = Object.keys(others);
  if (!names.includes(state.photograph)) state.photograph = names[0];
  compared ??= comparison($("comparison"));
  const key = `${frame.step} ${state.photograph}`;
  if ($("photographs").dataset.shown === key) return;
  $("photographs").dataset.shown = key;
  $("photographs").querySelector("h2").textContent = `Photographs after step ${frame.step}: ${state.photograph}`;
  $("photographs").querySelector(".thumbnails").replaceChildren(...names.map((name) =>
    element("button", { type: "button", ariaPressed: name === state.photograph, onclick: () => { state.photograph = name; show(); } },
      element("img", { src: `picture/${Object.values(others[name]).at(-1)}`, alt: "" }), name)));
  compared.show(Object.entries(others[state.photograph]).map(([label, file]) => ({ label, src: `picture/${file}` })));
  $("psf").hidden = !PSF;
  if (PSF) $("psf").src = `picture/${PSF.PSF}`;
}

async function show() {
  const number_ = state.newest ? state.frames.length - 1 : state.chosen;
  const frame = state.frames[number_];
  $("scrubber").hidden = state.frames.length < 1;
  plots(frame?.step);
  if (!frame) return;
  state.chosen = number_;
  $("frame").max = state.frames.length - 1;
  $("frame").value = number_;
  $("newest").setAttribute("aria-pressed", state.newest);
  $("where").textContent = `step ${frame.step}, ${frame.seconds.toFixed(1)} s (${number_ + 1} of ${state.frames.length})`;
  $("frame").setAttribute("aria-valuetext", $("where").textContent);
  photographs(state.frames, number_);
  await draw(number_);
}

// One frame is asked for at a time: the one at the scrubber when the answer to the last is there.
async function draw(number_) {
  const frame = state.frames[number_], key = `${frame.step} ${frame.seconds}`;
  document.body.classList.toggle("waiting", !state.made.has(key));
  if (!state.made.has(key)) {
    if (state.asked) return;
    state.asked = true;
    const answer = await fetch(`frame/${number_}`).catch(() => null); // `look` says that it is gone
    state.asked = false;
    if (!answer?.ok) return;
    if (state.made.size > 400) state.made.clear();
    state.made.set(key, await answer.json());
    if (state.chosen !== number_) {
      await draw(state.chosen);
      return;
    }
  }
  document.body.classList.remove("waiting");
  fill(state.made.get(key), frame);
}

function fill(found, frame) {
  $("forms").hidden = !found.forms;
  $("section").hidden = Boolean(found.forms);
  $("spots").hidden = !found.spots;
  $("variables").hidden = !found.variables?.length;
  if (found.forms) {
    $("forms").querySelector(".grid").replaceChildren(...found.forms.map((form, n) =>
      element("figure", {}, section(form.section), element("figcaption", {},
        `${n + 1}: mean RMS spot ${number(form.merit)} µm; of the fields ${form.spots.map((s) => number(s, 3)).join(", ")}; ${form.way}`))));
  } else {
    $("section").querySelector(".drawing").replaceChildren(section(found.section));
    $("section").querySelector(".legend").replaceChildren(...legend((found.section.fields ?? []).map((f) => [f.colour, f.rays.length ? f.label : `${f.label} (no ray passes)`])));
    if (found.spots) $("spots").querySelector(".grid").replaceChildren(...spots(found.spots));
    const colours = new Map((found.spots?.spots ?? []).map((s) => [s.wavelength, s.colour]));
    $("spots").querySelector(".legend").replaceChildren(...legend([...colours].map(([w, c]) => [c, w])), "RMS radii; all at one scale");
    $("variables").querySelector("tbody").replaceChildren(...(found.variables ?? []).map((v) =>
      element("tr", { className: v.at ? "at" : "" }, element("th", { scope: "row" }, v.label + (v.at ? " (at its bound)" : "")),
        element("td", {}, `${number(v.value, 6)} ${v.unit}`), element("td", {}, number(v.low)), element("td", {}, number(v.high)))));
  }
  document.body.dataset.step = frame.step;
}

function plots(step) {
  const found = state.plots ?? [];
  $("plots").hidden = !found.length;
  $("plots").querySelector(".grid").replaceChildren(...found.map((p) => plot(p, step)));
}

// ---------------------------------------------------------------- what is new

function tell(found) {
  $("name").textContent = found.experiment ? `${found.experiment}: ${found.name}` : found.name;
  document.title = $("name").textContent;
  $("status").textContent = found.status;
  $("status").className = found.status;
  $("detail").textContent = found.detail;
  $("note").textContent = found.note ?? "";
  $("problems").replaceChildren(...found.problems.map((text) => element("li", {}, text)));
  const numbers = Object.entries(found.metrics);
  $("results").hidden = !numbers.length && !found.figures.length;
  $("results").querySelector("details").hidden = !numbers.length;
  $("results").querySelector("tbody").replaceChildren(...numbers.map(([name, value]) =>
    element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, number(value, 6)))));
  const figures = $("results").querySelector(".figures");
  if (figures.dataset.shown !== found.figures.join()) {
    figures.dataset.shown = found.figures.join();
    figures.replaceChildren(...found.figures.map((name) => element("img", { src: `figure/${encodeURIComponent(name)}`, alt: name, loading: "lazy" })));
  }
}

async function look() {
  let wait = 1000;
  try {
    const answer = await fetch(`state?seen=${encodeURIComponent(state.version)}`);
    if (answer.status === 200) {
      const found = await answer.json();
      if (!state.newest && state.frames[state.chosen]) {
        // Frames that were dropped in between have moved the others.
        const step = state.frames[state.chosen].step;
        const place = found.frames.findIndex((f) => f.step >= step);
        state.chosen = place < 0 ? found.frames.length - 1 : place;
      }
      Object.assign(state, { frames: found.frames, plots: found.plots, version: found.version });
      tell(found);
      await show();
    }
  } catch {
    $("detail").textContent = "the server does not answer; dolens watch starts it again";
    wait = 3000;
  }
  setTimeout(look, wait);
}

function go(number_) {
  state.newest = number_ >= state.frames.length - 1;
  state.chosen = Math.max(0, Math.min(number_, state.frames.length - 1));
  show();
}

function play(on) {
  clearInterval(state.timer);
  state.timer = null;
  if (on) {
    if (state.chosen >= state.frames.length - 1) go(0);
    const last = state.frames.length - 1, every = Math.max(60, Math.min(400, 12000 / Math.max(last, 1)));
    let busy = false;
    state.timer = setInterval(async () => {
      if (busy) return;
      if (state.chosen >= state.frames.length - 1) return play(false);
      busy = true;
      state.newest = false;
      state.chosen += 1;
      await show();
      busy = false;
    }, every);
  }
  $("play").textContent = on ? "❚❚ pause" : "▶ play";
  $("play").setAttribute("aria-pressed", Boolean(on));
}

$("frame").addEventListener("input", () => { play(false); go(Number($("frame").value)); });
$("play").addEventListener("click", () => play(!state.timer));
$("newest").addEventListener("click", () => { play(false); go(state.frames.length - 1); });
document.addEventListener("keydown", (event) => {
  if (event.target.closest("input, button, .magnifier") || event.ctrlKey || event.metaKey || event.altKey) return;
  const to = { ArrowLeft: state.chosen - 1, ArrowRight: state.chosen + 1, Home: 0, End: state.frames.length - 1 }[event.key];
  if (to !== undefined) { play(false); go(to); event.preventDefault(); }
  if (event.key === " ") { play(!state.timer); event.preventDefault(); }
});
look();
