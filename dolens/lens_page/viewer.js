// Shows a lens in space: one turns it by dragging, and zooms by wheel, pinch or buttons.
// WebGL where there is any, and else a plain canvas with the same triangles.
(function () {
  "use strict";
  const root = document.getElementById("viewer");
  if (!root) return;
  const data = JSON.parse(document.getElementById("viewer-data").textContent);
  let canvas = root.querySelector("canvas");
  const shown = data.fields.map(() => true);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let cut = data.cut;

  function bytes(text) {
    return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  }
  function floats(text) {
    return new Float32Array(bytes(text).buffer);
  }

  // ---- the camera: rows are the screen's right, up and towards the viewer, in the lens's axes
  const reach = data.reach;
  let centre = data.centre;
  let turn, zoom, pan;
  function side() { turn = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]; zoom = 1; pan = [0, 0]; }
  function rotate(x, y) {
    // About the screen's up axis by x, and about its right axis by y.
    const [r, u, w] = turn;
    const cx = Math.cos(x), sx = Math.sin(x), cy = Math.cos(y), sy = Math.sin(y);
    const r1 = r.map((v, i) => cx * v + sx * w[i]);
    const w1 = w.map((v, i) => cx * v - sx * r[i]);
    const u2 = u.map((v, i) => cy * v - sy * w1[i]);
    const w2 = w1.map((v, i) => cy * v + sy * u[i]);
    turn = [r1, u2, w2];
  }
  function view(name) {
    side();
    if (name === "turned") { rotate(0.65, 0.0); rotate(0.0, 0.35); }
    if (name === "front") turn = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]];
    fit();
  }
  // What the view shows when it is chosen: half widths (mm) on the screen, and its middle.
  let frame = [1, 1];
  function fit() {
    const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const look = (points) => {
      for (let i = 0; i + 2 < points.length; i += 3) {
        for (let axis = 0; axis < 2; axis++) {
          const row = turn[axis];
          let at = 0;
          for (let k = 0; k < 3; k++) at += row[k] * (points[i + k] - data.centre[k]);
          low[axis] = Math.min(low[axis], at);
          high[axis] = Math.max(high[axis], at);
        }
      }
    };
    look(position);
    lines.forEach(({ points }) => look(points));
    frame = [0, 1].map((axis) => Math.max((high[axis] - low[axis]) / 2, 1e-9));
    const middle = [0, 1].map((axis) => (high[axis] + low[axis]) / 2);
    centre = data.centre.map((c, k) => c + turn[0][k] * middle[0] + turn[1][k] * middle[1]);
  }
  function scales(width, height) {
    return zoom * 0.46 * Math.min(width / frame[0], height / frame[1]);
  }

  // ---- geometry, once
  const solidKinds = { stop: 1, sensor: 1, block: 1, cap: 1, mirror: 1 };
  const parts = { glass: [], solid: [], cap: [] };
  const mesh = { position: [], normal: [], kind: [] };
  let count = 0;
  const kindNumber = { glass: 0, side: 1, stop: 2, sensor: 3, block: 4, cap: 5, mirror: 6 };
  for (const m of data.meshes) {
    const p = floats(m.positions), n = new Int8Array(bytes(m.normals).buffer);
    for (let i = 0; i < p.length; i++) { mesh.position.push(p[i]); mesh.normal.push(n[i] / 127); }
    for (let i = 0; i < p.length / 3; i++) mesh.kind.push(kindNumber[m.kind]);
    const list = m.kind === "cap" ? parts.cap : solidKinds[m.kind] ? parts.solid : parts.glass;
    const columns = m.closed ? m.around : m.around - 1;
    for (let r = 0; r + 1 < m.rings; r++) {
      for (let c = 0; c < columns; c++) {
        const next = (c + 1) % m.around;
        const a = count + r * m.around + c, b = count + r * m.around + next;
        const d = a + m.around, e = b + m.around;
        list.push(a, d, b, b, d, e);
      }
    }
    count += p.length / 3;
  }
  const position = new Float32Array(mesh.position), normal = new Float32Array(mesh.normal);
  const kinds = new Float32Array(mesh.kind);
  const glass = new Uint32Array(parts.glass), solid = new Uint32Array(parts.solid);
  const caps = new Uint32Array(parts.cap);
  const triangles = glass.length / 3;
  const middles = new Float32Array(glass.length);
  for (let t = 0; t < triangles; t++) {
    for (let axis = 0; axis < 3; axis++) {
      let sum = 0;
      for (let k = 0; k < 3; k++) sum += position[3 * glass[3 * t + k] + axis];
      middles[3 * t + axis] = sum / 3;
    }
  }
  const lines = [];
  data.rims.forEach((rim) => lines.push({ points: floats(rim), field: -1 }));
  data.fields.forEach((field, i) => {
    field.rays.forEach((ray) => lines.push({ points: floats(ray), field: i }));
  });

  view("turned");

  // Far triangles first: by buckets, since a lens has tens of thousands.
  const buckets = 2048, depthOf = new Uint16Array(triangles), starts = new Uint32Array(buckets + 1);
  const sorted = new Uint32Array(glass.length);
  function sortGlass() {
    const w = turn[2];
    starts.fill(0);
    for (let t = 0; t < triangles; t++) {
      let d = 0;
      for (let axis = 0; axis < 3; axis++) d += w[axis] * (middles[3 * t + axis] - centre[axis]);
      const at = Math.min(buckets - 1, Math.max(0, ((d / reach + 1.5) / 3) * buckets | 0));
      depthOf[t] = at;
      starts[at + 1]++;
    }
    for (let i = 0; i < buckets; i++) starts[i + 1] += starts[i];
    for (let t = 0; t < triangles; t++) {
      const at = 3 * starts[depthOf[t]]++;
      sorted[at] = glass[3 * t]; sorted[at + 1] = glass[3 * t + 1]; sorted[at + 2] = glass[3 * t + 2];
    }
  }

  function rgb(hex) {
    return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  }
  // The filter "night" of the page, for a background that is dark.
  function nightColour([r, g, b]) {
    const turned = [0.574 * r - 1.43 * g - 0.144 * b, -0.426 * r - 0.43 * g - 0.144 * b,
      -0.426 * r - 1.43 * g + 0.856 * b];
    return turned.map((c) => Math.min(Math.max(1 + c, 0), 1) ** 0.6);
  }
  function lineColour(field) {
    if (field >= 0) {
      const colour = rgb(data.fields[field].colour);
      return [...(dark.matches ? nightColour(colour) : colour), 0.95];
    }
    return dark.matches ? [0.75, 0.85, 0.92, 0.55] : [0.13, 0.2, 0.25, 0.55];
  }

  // ---- WebGL
  function program(gl, vertex, fragment) {
    const made = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([type, source]) => {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    gl.linkProgram(made);
    return gl.getProgramParameter(made, gl.LINK_STATUS) ? made : null;
  }
  const project = `
    uniform mat3 turn; uniform vec3 centre; uniform vec2 scale, pan; uniform float depth;
    vec4 seen(vec3 p) {
      vec3 q = turn * (p - centre);
      return vec4(q.xy * scale + pan, -q.z * depth, 1.0);
    }`;
  const cutAway = "uniform float cut; varying vec3 place;";
  const surfaceVertex = `attribute vec3 position, normal; attribute float kind; ${project}
    ${cutAway} varying vec3 facing; varying float what;
    void main() {
      gl_Position = seen(position); facing = turn * normal; what = kind; place = position;
    }`;
  const surfaceFragment = `precision mediump float; ${cutAway}
    varying vec3 facing; varying float what; uniform float night;
    void main() {
      if (cut > 0.5 && place.x < 0.0 && (what < 2.5 || what > 5.5 || (what > 3.5 && what < 4.5))) discard;
      vec3 n = normalize(facing);
      if (n.z < 0.0) n = -n;
      vec3 light = normalize(vec3(-0.4, 0.7, 0.65));
      float lit = 0.55 + 0.45 * max(dot(n, light), 0.0);
      vec3 half_way = normalize(light + vec3(0.0, 0.0, 1.0));
      float shine = pow(max(dot(n, half_way), 0.0), 60.0);
      float rim = pow(1.0 - n.z, 2.5);
      vec3 colour; float alpha;
      if (what < 0.5) {
        colour = mix(vec3(0.45, 0.66, 0.82), vec3(0.62, 0.82, 0.95), night);
        alpha = 0.13 + 0.45 * rim + 0.5 * shine;
        colour += 0.6 * shine;
      } else if (what < 1.5) {
        colour = mix(vec3(0.42, 0.56, 0.66), vec3(0.5, 0.65, 0.75), night) * lit;
        alpha = 0.22 + 0.25 * rim;
      } else if (what < 2.5) {
        colour = mix(vec3(0.20, 0.22, 0.25), vec3(0.42, 0.45, 0.5), night) * lit; alpha = 1.0;
      } else if (what < 3.5) {
        colour = mix(vec3(0.36, 0.40, 0.52), vec3(0.40, 0.45, 0.60), night) * lit; alpha = 1.0;
      } else if (what < 4.5) {
        colour = vec3(0.1) * lit; alpha = 1.0;
      } else if (what < 5.5) {
        colour = mix(vec3(0.72, 0.84, 0.92), vec3(0.25, 0.38, 0.48), night); alpha = 1.0;
      } else {
        colour = mix(vec3(0.66, 0.68, 0.70), vec3(0.62, 0.64, 0.66), night) * lit + 0.5 * shine;
        alpha = 1.0;
      }
      gl_FragColor = vec4(colour * alpha, alpha);
    }`;
  const lineVertex = `attribute vec3 here, other; attribute vec2 corner; ${project}
    ${cutAway} uniform vec2 size; uniform float width, lift;
    void main() {
      vec4 a = seen(here), b = seen(other);
      vec2 along = (b.xy - a.xy) * size * corner.y;
      float length_px = length(along);
      along = length_px > 1e-6 ? along / length_px : vec2(1.0, 0.0);
      a.xy += vec2(-along.y, along.x) * corner.x * width / size;
      a.z -= lift;
      gl_Position = a; place = here;
    }`;
  const lineFragment = `precision mediump float; ${cutAway} uniform vec4 colour;
    void main() {
      if (cut > 0.5 && place.x < -1e-4) discard;
      gl_FragColor = vec4(colour.rgb * colour.a, colour.a);
    }`;

  function webgl() {
    const gl = canvas.getContext("webgl", { antialias: true, alpha: true, premultipliedAlpha: true });
    if (!gl || !gl.getExtension("OES_element_index_uint")) return null;
    const surfaces = program(gl, surfaceVertex, surfaceFragment);
    const strokes = program(gl, lineVertex, lineFragment);
    if (!surfaces || !strokes) return null;
    function buffer(values, target) {
      const made = gl.createBuffer();
      gl.bindBuffer(target || gl.ARRAY_BUFFER, made);
      gl.bufferData(target || gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      return made;
    }
    const buffers = { position: buffer(position), normal: buffer(normal), kind: buffer(kinds) };
    const order = gl.createBuffer(), fixed = buffer(solid, gl.ELEMENT_ARRAY_BUFFER);
    const section = buffer(caps, gl.ELEMENT_ARRAY_BUFFER);
    // Every segment is a ribbon of two triangles; ranges say which belong to a field.
    const ribbon = [], ranges = new Map();
    [...lines].sort((p, q) => p.field - q.field).forEach(({ points, field }) => {
      const first = ribbon.length / 8;
      for (let i = 0; i + 5 < points.length; i += 3) {
        const p = Array.from(points.subarray(i, i + 3)), q = Array.from(points.subarray(i + 3, i + 6));
        const a = [...p, ...q, 1, 1], b = [...p, ...q, -1, 1];
        const c = [...q, ...p, 1, -1], d = [...q, ...p, -1, -1];
        ribbon.push(...a, ...b, ...c, ...b, ...c, ...d);
      }
      const range = ranges.get(field) || [first, 0];
      range[1] = ribbon.length / 8 - range[0];
      ranges.set(field, range);
    });
    const ribbons = buffer(new Float32Array(ribbon));
    function attribute(made, name, size, stride, offset) {
      const at = gl.getAttribLocation(made, name);
      if (at < 0) return;
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, stride, offset);
    }
    function camera(made, width, height, ratio) {
      const s = scales(width, height);
      const at = (name) => gl.getUniformLocation(made, name);
      const [r, u, w] = turn;
      gl.uniformMatrix3fv(at("turn"), false, [r[0], u[0], w[0], r[1], u[1], w[1], r[2], u[2], w[2]]);
      gl.uniform3fv(at("centre"), centre);
      gl.uniform2f(at("scale"), 2 * s / width, 2 * s / height);
      gl.uniform2f(at("pan"), 2 * pan[0] / width, -2 * pan[1] / height);
      gl.uniform1f(at("depth"), 0.4 / reach);
      gl.uniform1f(at("cut"), cut ? 1 : 0);
      gl.uniform1f(at("night"), dark.matches ? 1 : 0);
      gl.uniform2f(at("size"), width, height);
      return ratio;
    }
    return function (width, height) {
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(surfaces);
      camera(surfaces, width, height);
      for (const name of ["position", "normal", "kind"]) {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
        attribute(surfaces, name, name === "kind" ? 1 : 3, 0, 0);
      }
      gl.depthMask(true);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, fixed);
      gl.drawElements(gl.TRIANGLES, solid.length, gl.UNSIGNED_INT, 0);
      if (cut && caps.length) {
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, section);
        gl.drawElements(gl.TRIANGLES, caps.length, gl.UNSIGNED_INT, 0);
      }
      gl.useProgram(strokes);
      camera(strokes, width, height);
      gl.bindBuffer(gl.ARRAY_BUFFER, ribbons);
      attribute(strokes, "here", 3, 32, 0);
      attribute(strokes, "other", 3, 32, 12);
      attribute(strokes, "corner", 2, 32, 24);
      gl.depthMask(false);
      ranges.forEach(([first, number], field) => {
        if (field >= 0 && !shown[field]) return;
        gl.uniform4fv(gl.getUniformLocation(strokes, "colour"), lineColour(field));
        gl.uniform1f(gl.getUniformLocation(strokes, "width"), field >= 0 ? 1.5 : 1.1);
        gl.uniform1f(gl.getUniformLocation(strokes, "lift"), field >= 0 ? 0.002 : 0.003);
        gl.drawArrays(gl.TRIANGLES, first, number);
      });
      sortGlass();
      gl.useProgram(surfaces);
      for (const name of ["position", "normal", "kind"]) {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
        attribute(surfaces, name, name === "kind" ? 1 : 3, 0, 0);
      }
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, order);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, sorted, gl.DYNAMIC_DRAW);
      gl.drawElements(gl.TRIANGLES, sorted.length, gl.UNSIGNED_INT, 0);
      gl.depthMask(true);
    };
  }

  // ---- a plain canvas, where there is no WebGL
  function plain() {
    const context = canvas.getContext("2d");
    if (!context) return null;
    return function (width, height, ratio) {
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, width, height);
      const s = scales(width, height);
      const seen = (p, at) => {
        const q = [p[at] - centre[0], p[at + 1] - centre[1], p[at + 2] - centre[2]];
        const dot = (row) => row[0] * q[0] + row[1] * q[1] + row[2] * q[2];
        return [width / 2 + pan[0] + s * dot(turn[0]), height / 2 + pan[1] - s * dot(turn[1])];
      };
      const fill = (list, from, colour) => {
        context.beginPath();
        for (let k = 0; k < 3; k++) {
          const [x, y] = seen(position, 3 * list[from + k]);
          if (k) context.lineTo(x, y); else context.moveTo(x, y);
        }
        context.fillStyle = colour;
        context.fill();
      };
      for (let t = 0; t < solid.length; t += 3) {
        const what = kinds[solid[t]];
        fill(solid, t, what === 3 ? "#6b7590" : what === 6 ? "#b4b8bc" : "#3a3f46");
      }
      sortGlass();
      for (let t = 0; t < sorted.length; t += 3) {
        if (cut && position[3 * sorted[t]] < 0) continue;
        const n = Math.abs(turn[2][0] * normal[3 * sorted[t]] + turn[2][1] * normal[3 * sorted[t] + 1]
          + turn[2][2] * normal[3 * sorted[t] + 2]);
        fill(sorted, t, `rgba(110,165,205,${(0.05 + 0.2 * (1 - n) ** 2).toFixed(3)})`);
      }
      lines.forEach(({ points, field }) => {
        if (field >= 0 && !shown[field]) return;
        const [r, g, b, a] = lineColour(field);
        context.strokeStyle = `rgba(${r * 255 | 0},${g * 255 | 0},${b * 255 | 0},${a})`;
        context.lineWidth = field >= 0 ? 1.2 : 0.9;
        context.beginPath();
        let drawn = false;
        for (let i = 0; i < points.length; i += 3) {
          const [x, y] = seen(points, i), kept = !cut || points[i] >= -1e-4;
          if (kept && drawn) context.lineTo(x, y); else context.moveTo(x, y);
          drawn = kept;
        }
        context.stroke();
      });
    };
  }

  let paint = null;
  try { paint = webgl(); } catch (error) { paint = null; }
  root.dataset.renderer = paint ? "webgl" : "canvas";
  if (!paint) {
    // A canvas that has given out one kind of context gives out no other.
    const fresh = canvas.cloneNode(false);
    canvas.replaceWith(fresh);
    canvas = fresh;
    paint = plain();
  }
  let waiting = false;
  function draw() {
    waiting = false;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    if (!paint || !width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    paint(width, height, ratio);
    root.dataset.drawn = "yes";
  }
  function ask() {
    if (!waiting) { waiting = true; requestAnimationFrame(draw); }
  }

  // ---- hands
  const held = new Map();
  let gap = 0;
  const between = () => {
    const [a, b] = [...held.values()];
    return [Math.hypot(a[0] - b[0], a[1] - b[1]), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 2) gap = between();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 2) {
      const now = between();
      zoom = Math.min(40, Math.max(0.3, zoom * now[0] / Math.max(gap[0], 1)));
      pan = [pan[0] + now[1] - gap[1], pan[1] + now[2] - gap[2]];
      gap = now;
    } else if (event.shiftKey || event.buttons & 6) {
      pan = [pan[0] + dx, pan[1] + dy];
    } else {
      rotate(dx * 0.008, dy * 0.008);
    }
    ask();
  });
  const release = (event) => held.delete(event.pointerId);
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  function zoomBy(factor) { zoom = Math.min(40, Math.max(0.3, zoom * factor)); ask(); }
  canvas.addEventListener("wheel", (event) => {
    // The page scrolls until the lens has been touched.
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoomBy(Math.exp(-event.deltaY * 0.0015));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { view("turned"); ask(); });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
    if (step[event.key]) rotate(...step[event.key]);
    else if (event.key === "+" || event.key === "=") zoomBy(1.15);
    else if (event.key === "-") zoomBy(1 / 1.15);
    else return;
    event.preventDefault();
    ask();
  });
  root.querySelectorAll("[data-view]").forEach((button) => {
    button.addEventListener("click", () => { view(button.dataset.view); ask(); });
  });
  root.querySelectorAll("[data-zoom]").forEach((button) => {
    button.addEventListener("click", () => zoomBy(Number(button.dataset.zoom)));
  });
  root.querySelectorAll("[data-field]").forEach((box) => {
    box.addEventListener("change", () => { shown[Number(box.dataset.field)] = box.checked; ask(); });
  });
  const half = root.querySelector("[data-cut]");
  if (half) half.addEventListener("change", () => { cut = half.checked; ask(); });
  dark.addEventListener("change", ask);
  if (window.ResizeObserver) new ResizeObserver(ask).observe(canvas);
  draw();
})();
