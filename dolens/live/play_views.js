// Draws what the server sends: section, spots, ray fans, MTF.  Colours are those of a light page;
// the filter "night" turns them on a dark one.
"use strict";
const views = (function () {
  const SVG = "http://www.w3.org/2000/svg";
  const byId = (id) => document.getElementById(id);

  function shape(parent, name, attributes) {
    const made = document.createElementNS(SVG, name);
    for (const key in attributes) made.setAttribute(key, attributes[key]);
    parent.append(made);
    return made;
  }
  const path = (points) => "M" + points.map((p) => p.join(" ")).join("L");

  // 1, 2 or 5 times a power of ten, not below a number.
  function rounded(number) {
    const power = 10 ** Math.floor(Math.log10(number));
    return [1, 2, 5, 10].map((s) => s * power).find((s) => s >= 0.999 * number);
  }
  const short = (number) => String(Number(number.toPrecision(3)));
  const length = (um) => (um >= 1000 ? `${short(um / 1000)} mm` : `${short(um)} µm`);

  // ---- section.  The window onto it changes only where it must, so that the lens moves in it.
  let frame = null;
  function fitted(section, anew) {
    let [left, right, high] = [Infinity, -Infinity, 0];
    const look = ([z, y]) => {
      left = Math.min(left, z); right = Math.max(right, z); high = Math.max(high, Math.abs(y));
    };
    section.glasses.forEach((g) => g.forEach(look));
    section.surfaces.forEach((s) => s.points.forEach(look));
    section.stop.concat([section.sensor]).forEach((line) => line.forEach(look));
    section.rays.forEach((rays) => rays.forEach((ray) => ray.forEach(look)));
    const fits = frame && left > frame.left && right < frame.right && high < frame.high &&
      right - left > 0.6 * (frame.right - frame.left);
    if (fits && !anew) return;
    const margin = 0.06 * (right - left);
    frame = { left: left - margin, right: right + margin, high: 1.1 * high };
  }
  function section(found, colours, anew) {
    const svg = byId("section");
    fitted(found, anew);
    const { left, right, high } = frame;
    svg.setAttribute("viewBox", `${left} ${-high} ${right - left} ${2 * high}`);
    svg.replaceChildren();
    const flip = (points) => points.map(([z, y]) => [z, -y]);
    shape(svg, "path", { class: "axis", d: path([[left, 0], [right, 0]]) });
    found.glasses.forEach((g) => shape(svg, "path", { class: "glass", d: path(flip(g)) + "Z" }));
    found.rays.forEach((rays, i) => rays.forEach((ray) => shape(svg, "path", {
      class: "ray", d: path(flip(ray)), stroke: colours[i] })));
    found.surfaces.forEach((s) => shape(svg, "path", {
      class: s.mirror ? "surface mirror" : "surface", d: path(flip(s.points)),
      "data-surface": s.number }));
    found.stop.forEach((line) => shape(svg, "path", { class: "stop", d: path(flip(line)) }));
    shape(svg, "path", { class: "sensor", d: path(flip(found.sensor)) });
    choose(chosen);
  }
  // The surface whose values are being changed is marked.
  let chosen = null;
  function choose(number) {
    chosen = number;
    byId("section").querySelectorAll(".surface").forEach((s) => {
      s.classList.toggle("chosen", s.dataset.surface === String(number));
    });
  }

  // ---- canvases, sharp on every screen
  function canvas(id, height) {
    const element = byId(id), ratio = window.devicePixelRatio || 1;
    const width = element.parentElement.clientWidth;
    if (element.width !== Math.round(width * ratio) ||
        element.height !== Math.round(height * ratio)) {
      element.width = Math.round(width * ratio);
      element.height = Math.round(height * ratio);
      element.style.height = height + "px";
    }
    const pen = element.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    return { pen, width };
  }
  function cells(width, count) {
    const columns = Math.max(1, Math.min(count, Math.floor(width / 72)));
    return { columns, side: width / columns, rows: Math.ceil(count / columns) };
  }

  function spots(found, where) {
    let far = found.airy;
    found.points.flat(2).forEach(([x, y]) => { far = Math.max(far, Math.abs(x), Math.abs(y)); });
    const box = rounded(2 * far), count = found.points.length;
    const plan = cells(byId("spots").parentElement.clientWidth, count);
    const tall = plan.side + 32;
    const { pen } = canvas("spots", plan.rows * tall);
    found.points.forEach((clouds, i) => {
      const left = (i % plan.columns) * plan.side, top = Math.floor(i / plan.columns) * tall;
      const half = 0.5 * plan.side - 3, scale = (2 * half) / box;
      const [cx, cy] = [left + 0.5 * plan.side, top + 0.5 * plan.side];
      pen.strokeStyle = "#d8d8d8";
      pen.strokeRect(cx - half, cy - half, 2 * half, 2 * half);
      const dark = found.rms[i] === null;
      clouds.forEach((cloud, w) => {
        pen.fillStyle = where.shades[w];
        cloud.forEach(([x, y]) => pen.fillRect(cx + x * scale - 0.6, cy - y * scale - 0.6, 1.3, 1.3));
      });
      pen.strokeStyle = "#222";
      pen.beginPath();
      pen.arc(cx, cy, Math.max(found.airy * scale, 0.5), 0, 2 * Math.PI);
      if (!dark) pen.stroke();
      pen.fillStyle = "#44525c";
      pen.textAlign = "center";
      pen.fillText(where.fields[i], cx, top + plan.side + 11);
      pen.fillText(dark ? "no light" : `RMS ${length(found.rms[i])}`, cx, top + plan.side + 25);
    });
    byId("spots-said").textContent =
      `Boxes are ${length(box)} wide; circles are Airy's. ${where.wavelengths.join(", ")}.`;
  }

  function fans(found, where) {
    let far = 1e-6;
    found.flat(3).forEach((e) => { if (e !== null) far = Math.max(far, Math.abs(e)); });
    const reach = rounded(far), plan = cells(byId("fans").parentElement.clientWidth, found.length);
    const tall = 0.8 * plan.side + 18;
    const { pen } = canvas("fans", plan.rows * tall);
    found.forEach((waves, i) => {
      const left = (i % plan.columns) * plan.side, top = Math.floor(i / plan.columns) * tall;
      const half = 0.25 * plan.side - 3, middle = top + 0.4 * plan.side;
      [0, 1].forEach((way) => {
        const cx = left + (0.25 + 0.5 * way) * plan.side;
        pen.strokeStyle = "#d8d8d8";
        pen.strokeRect(cx - half, top + 2, 2 * half, 0.8 * plan.side - 4);
        pen.beginPath();
        pen.moveTo(cx - half, middle); pen.lineTo(cx + half, middle);
        pen.stroke();
        waves.forEach((ways, w) => {
          pen.strokeStyle = where.shades[w];
          pen.beginPath();
          let on = false;
          ways[way].forEach((e, p) => {
            if (e === null) { on = false; return; }
            const x = cx - half + (2 * half * p) / (ways[way].length - 1);
            const y = middle - (e / reach) * (0.4 * plan.side - 4);
            if (on) pen.lineTo(x, y); else pen.moveTo(x, y);
            on = true;
          });
          pen.stroke();
        });
      });
      pen.fillStyle = "#44525c";
      pen.textAlign = "center";
      pen.fillText(where.fields[i], left + 0.5 * plan.side, top + 0.8 * plan.side + 11);
    });
    byId("fans-said").textContent = `Along y at the left, along x at the right, over the beam; ` +
      `± ${length(reach)}.`;
  }

  function mtf(found, colours) {
    const svg = byId("mtf"), width = svg.parentElement.clientWidth, height = 0.62 * width;
    const [left, top, right, bottom] = [26, 6, width - 12, height - 20];
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.replaceChildren();
    const end = found.frequencies[found.frequencies.length - 1];
    const at = (f, m) => [left + ((right - left) * f) / end, bottom - (bottom - top) * m];
    [0, 0.25, 0.5, 0.75, 1].forEach((share) => {
      shape(svg, "path", { class: "grid", d: path([at(0, share), at(end, share)]) });
      shape(svg, "path", { class: "grid", d: path([at(share * end, 0), at(share * end, 1)]) });
      const [, y] = at(0, share), [x] = at(share * end, 0);
      shape(svg, "text", { class: "tick", x: left - 13, y: y + 4 }).textContent = share;
      shape(svg, "text", { class: "tick", x, y: bottom + 14 }).textContent = short(share * end);
    });
    found.curves.forEach((ways, i) => ways.forEach((curve, way) => {
      if (curve[0] === null) return;
      const points = curve.map((m, q) => at(found.frequencies[q], m));
      shape(svg, "path", { class: way ? "curve sagittal" : "curve", d: path(points),
        stroke: colours[i] });
    }));
  }

  function legend(where, rms) {
    byId("fields").replaceChildren(...where.fields.map((label, i) => {
      const entry = document.createElement("li"), key = document.createElementNS(SVG, "svg");
      key.setAttribute("viewBox", "0 0 20 8");
      shape(key, "path", { d: "M0 4H20", stroke: where.colours[i], "stroke-width": 3 });
      entry.append(key, label + (rms[i] === null ? " (no ray passes)" : ""));
      return entry;
    }));
  }

  function numbers(rows) {
    byId("numbers").replaceChildren(...rows.flatMap(([name, value]) => {
      const term = document.createElement("dt"), number = document.createElement("dd");
      term.textContent = name;
      number.textContent = value;
      return [term, number];
    }));
  }

  return { section, choose, spots, fans, mtf, legend, numbers };
})();
