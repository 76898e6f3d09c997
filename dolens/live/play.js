// Sliders for a lens.  What the user does goes to the server over a websocket; while it works on one
// change, newer ones are joined, so that the picture follows the hand and never lags behind it.
"use strict";
(function () {
  const byId = (id) => document.getElementById(id);
  const controls = new Map(); // key → { control, slider, number, tick }
  let socket = null, count = 0, awaited = null, held = null, dragged = null;
  let values = {}, where = null, seen = null, late = null, anew = true, sent = 0, changes = [];

  // ---- the server
  function connect() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    socket = new WebSocket(address);
    socket.addEventListener("message", (event) => receive(JSON.parse(event.data)));
    socket.addEventListener("close", (event) => {
      awaited = held = null;
      document.body.classList.add("stale");
      if (event.code === 4001) {
        say("The lens is open in another window now; reload to bring it back here.", true);
      } else {
        say("The server has ended, or does not answer; trying again …", true);
        setTimeout(connect, 1000);
      }
    });
  }
  function send(message) {
    if (!socket || socket.readyState !== WebSocket.OPEN) return null;
    socket.send(JSON.stringify({ ...message, id: ++count }));
    return count;
  }
  // One change is on its way at a time; what the hand does meanwhile is held back and joined.
  function change(some, done) {
    held = { do: "change", changes: { ...(held ? held.changes : {}), ...some }, done };
    if (awaited === null) release();
  }
  function release() {
    if (!held) return;
    const message = held;
    held = null;
    if (!byId("said").classList.contains("problem")) say("", false);
    awaited = { id: send(message), done: message.done };
    sent = performance.now();
    if (awaited.id === null) awaited = null;
  }
  function answered(message) {
    if (!awaited || message.id !== awaited.id) return null;
    const { done } = awaited;
    awaited = null;
    changes = [...changes.filter((time) => time > performance.now() - 1000), performance.now()];
    byId("speed").textContent = `Section and spots after ${Math.round(performance.now() - sent)} ms` +
      (changes.length > 2 ? `, ${changes.length} changes in a second.` : ".");
    release();
    return done;
  }

  function receive(message) {
    if (message.is === "lens") build(message);
    if (message.is === "seen") {
      document.body.classList.remove("stale");
      const done = answered(message);
      if (done === null && message.id !== undefined) anew = true; // undo, reset, …
      show(message, anew || done === true);
      anew = false;
    }
    if (message.is === "mtf") {
      late = message;
      views.mtf(message, where.colours);
      views.fans(message.fans, where);
    }
    if (message.is === "picture") picture(message);
    if (message.is === "problem") {
      say(message.text, true);
      const dragging = answered(message) === false;
      if (!dragging) put(values, null); // what the hand left goes back
      document.body.classList.toggle("stale", dragging);
    }
    if (message.is === "optimized") {
      byId("optimize").disabled = false;
      say(message.text, message.failed);
    }
    if (message.is === "saved") download(message);
  }
  function say(text, problem) {
    byId("said").textContent = text;
    byId("said").classList.toggle("problem", Boolean(problem));
  }

  // ---- what is shown
  function show(message, fit) {
    if (byId("said").classList.contains("problem") || !seen) say("", false);
    seen = message;
    where = message.where;
    values = message.values;
    put(values, dragged);
    byId("undo").disabled = !message.undo;
    byId("redo").disabled = !message.redo;
    views.section(message.section, where.colours, fit);
    views.spots(message.spots, where);
    views.legend(where, message.spots.rms);
    views.numbers(message.numbers);
    document.body.dataset.shown = String(Number(document.body.dataset.shown || 0) + 1);
  }
  function picture(message) {
    const image = byId("picture");
    if (message.jpeg) image.src = "data:image/jpeg;base64," + message.jpeg;
    image.classList.toggle("old", !message.jpeg);
    byId("picture-said").textContent = message.problem ? `Not made: ${message.problem}` : message.size;
  }
  function download(message) {
    const bytes = Uint8Array.from(atob(message.data), (c) => c.charCodeAt(0));
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([bytes]));
    link.download = message.name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    const lost = message.changes.length ? `: ${message.changes.join("; ")}` : ", nothing lost";
    say(`${message.name}: saved${lost}`, false);
  }

  // ---- controls
  const fromFile = (control, number) =>
    control.kind === "curvature" ? (number === 0 ? Infinity : 1 / number) : number;
  const written = (number) => (Number.isFinite(number) ? String(Number(number.toPrecision(6))) : "");

  function put(all, except) {
    for (const [key, { control, slider, number }] of controls) {
      if (key === except || !(key in all)) continue;
      if (control.kind === "glass") { number.value = all[key]; continue; }
      if (all[key] < Number(slider.min)) slider.min = all[key];
      if (all[key] > Number(slider.max)) slider.max = all[key];
      slider.value = all[key];
      number.value = written(fromFile(control, all[key]));
    }
  }
  function build(message) {
    const form = byId("controls"), groups = new Map();
    const ticked = new Set([...controls].filter(([, c]) => c.tick && c.tick.checked).map(([k]) => k));
    form.querySelectorAll("details").forEach((group) => group.remove());
    controls.clear();
    for (const control of message.controls) {
      const name = control.group;
      if (!groups.has(name)) groups.set(name, group(form, name, groups.size < 5));
      let parent = groups.get(name);
      if (control.rare) {
        const rare = `${name}, more`;
        if (!groups.has(rare)) groups.set(rare, group(parent, "more", false));
        parent = groups.get(rare);
      }
      controls.set(control.key, row(parent, control, ticked.has(control.key)));
    }
    for (const [name, rare] of groups) { // below what is changed more often
      if (name.endsWith(", more")) rare.parentElement.append(rare);
    }
    const glasses = byId("glasses");
    if (!glasses.children.length) {
      glasses.replaceChildren(...message.glasses.map((name) => new Option(name, name)));
    }
    byId("focus").checked = message.focus;
    document.querySelectorAll("[name=part]").forEach((radio) => {
      radio.checked = radio.value === message.part;
    });
  }
  function group(parent, name, open) {
    const made = document.createElement("details"), heading = document.createElement("summary");
    heading.textContent = name;
    made.open = open;
    made.append(heading);
    parent.append(made);
    const number = /^Surface (\d+)$/.exec(name);
    if (number) {
      made.addEventListener("focusin", () => views.choose(number[1]));
      made.addEventListener("focusout", () => views.choose(null));
    }
    return made;
  }
  function element(name, attributes) {
    return Object.assign(document.createElement(name), attributes);
  }
  function row(parent, control, ticked) {
    const { key, label, unit, kind } = control, full = `${control.group}: ${label}`;
    const made = element("div", { className: kind === "glass" ? "control word" : "control" });
    const tick = control.varies
      ? element("input", { type: "checkbox", checked: ticked, title: `let Optimize change ${full}` })
      : element("span", {});
    const caption = element("label", { textContent: label });
    if (unit) caption.append(" ", element("small", { textContent: unit }));
    const number = element("input", kind === "glass"
      ? { type: "text" } : { type: "number", step: "any" });
    number.id = key;
    caption.htmlFor = key;
    made.append(tick, caption);
    if (kind === "glass") {
      number.setAttribute("list", "glasses");
      made.append(number);
      number.addEventListener("change", () => change({ [key]: number.value }, true));
      parent.append(made);
      return { control, number };
    }
    const slider = element("input", { type: "range", min: control.low, max: control.high, step: "any" });
    slider.setAttribute("aria-label", full);
    if (control.varies) tick.setAttribute("aria-label", `let Optimize change ${full}`);
    slider.addEventListener("input", () => {
      dragged = key;
      number.value = written(fromFile(control, Number(slider.value)));
      change({ [key]: Number(slider.value) }, false);
    });
    slider.addEventListener("change", () => {
      change({ [key]: Number(slider.value) }, true);
      dragged = null;
    });
    number.addEventListener("change", () => {
      const given = Number(number.value);
      if (kind !== "curvature") change({ [key]: given }, true);
      else if (number.value === "") change({ [key]: 0 }, true); // a plane
      else change({ [key.replace("curvature", "radius")]: given }, true);
    });
    made.append(slider, number);
    parent.append(made);
    return { control, slider, number, tick };
  }

  // ---- buttons and keys
  for (const name of ["undo", "redo", "reset", "refocus"]) {
    byId(name).addEventListener("click", () => send({ do: name }));
  }
  byId("focus").addEventListener("change", (event) => send({ do: "focus", on: event.target.checked }));
  byId("save").addEventListener("click", () => send({ do: "save", suffix: byId("suffix").value }));
  byId("parts").addEventListener("change", (event) => send({ do: "part", part: event.target.value }));
  byId("optimize").addEventListener("click", () => {
    const variables = [...controls].filter(([, c]) => c.tick && c.tick.checked).map(([key]) => key);
    if (send({ do: "optimize", variables, efl: byId("efl").checked }) === null) return;
    byId("optimize").disabled = true;
    say("optimizing …", false);
  });
  byId("controls").addEventListener("submit", (event) => event.preventDefault());
  document.addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.altKey) return;
    const key = event.key.toLowerCase();
    const wanted = key === "y" || (key === "z" && event.shiftKey) ? "redo" : key === "z" ? "undo" : "";
    if (!wanted) return;
    event.preventDefault();
    send({ do: wanted });
  });
  window.addEventListener("resize", () => {
    if (!seen) return;
    views.spots(seen.spots, where);
    if (late) { views.mtf(late, where.colours); views.fans(late.fans, where); }
  });
  connect();
})();
