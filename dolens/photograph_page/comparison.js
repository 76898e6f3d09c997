// Several pictures of one thing: a slider between any two of them, and a magnifier that shows one
// place in all.  `comparison(element)` fills an element, and `show` gives it the pictures.
"use strict";

function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made) made[name] = value; else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function comparison(root) {
  const SIZE = 144, ZOOMS = [4, 8, 16]; // pixels of a magnifier, and of it to one of a picture
  let pictures = [], sides = [0, 1], share = 0.5, place = [0, 0], zoom = 8, width = 1, height = 1;

  const images = [element("img", { alt: "", draggable: false }), element("img", { alt: "", draggable: false })];
  const names = ["first", "second"].map((side) => element("span", { className: `side ${side}` }));
  const line = element("div", { className: "line" }), frame = element("div", { className: "frame" });
  const stage = element("div", { className: "stage" }, ...images, line, frame, ...names);
  const range = element("input", { type: "range", min: 0, max: 1000, value: 500, "aria-label": "Slider between the two pictures" });
  const choices = ["left", "right"].map(() => element("div", { role: "group" }));
  const bar = element("div", { className: "bar" });
  const magnifier = element("div", { className: "magnifier", tabIndex: 0, role: "group",
    "aria-label": "Magnifier: arrow keys move it, with Shift by ten pixels" });
  const zooms = element("div", { role: "group", "aria-label": "Magnification" });
  const where = element("span");
  bar.append(...choices.map((group, side) => element("div", { className: "bar" }, element("span", {}, ["left", "right"][side]), group)));
  root.classList.add("comparison");
  root.replaceChildren(bar, stage, range,
    element("div", { className: "bar" }, element("span", {}, "magnifier"), zooms, where), magnifier);

  for (const times of ZOOMS) {
    zooms.append(element("button", { type: "button", onclick: () => { zoom = times; draw(); } }, `${times}×`));
  }

  function pressed(group, chosen) {
    [...group.children].forEach((button, n) => button.setAttribute("aria-pressed", n === chosen));
  }

  function choose(side, number) {
    // The same picture on both sides compares nothing: the sides change places.
    if (sides[1 - side] === number) sides[1 - side] = sides[side];
    sides[side] = number;
    lay();
  }

  // Puts the two pictures on top of each other, as large as the page allows.
  function lay() {
    const shown = sides.map((n) => pictures[n]);
    images[0].src = shown[1].src; // below, to the right of the line
    images[1].src = shown[0].src;
    images[0].alt = shown[1].label;
    images[1].alt = shown[0].label;
    names.forEach((name, side) => { name.textContent = shown[side].label; });
    choices.forEach((group, side) => pressed(group, sides[side]));
    const room = root.clientWidth || width;
    const most = Math.max(Math.min(room, 0.72 * window.innerHeight * width / height), 64);
    const times = most >= width ? Math.max(1, Math.floor(most / width)) : most / width;
    stage.classList.toggle("enlarged", times > 1);
    stage.style.width = `${times * width}px`;
    stage.style.aspectRatio = `${width} / ${height}`;
    draw();
  }

  function draw() {
    images[1].style.clipPath = `inset(0 ${100 * (1 - share)}% 0 0)`;
    line.style.left = `${100 * share}%`;
    range.value = 1000 * share;
    range.setAttribute("aria-valuetext", `${Math.round(100 * share)} % ${pictures[sides[0]]?.label ?? ""}`);
    pressed(zooms, ZOOMS.indexOf(zoom));
    const side = Math.min(SIZE / zoom, width, height);
    const [x, y] = [[place[0], width], [place[1], height]].map(([at, size]) =>
      Math.round(Math.min(Math.max(at - side / 2, 0), size - side)));
    Object.assign(frame.style, { left: `${100 * x / width}%`, top: `${100 * y / height}%`,
      width: `${100 * side / width}%`, height: `${100 * side / height}%` });
    const middle = [x, y].map((at) => Math.floor(at + side / 2));
    where.textContent = `about column ${middle[0]}, row ${middle[1]}`;
    for (const { image, canvas, value } of pictures) {
      if (!image.complete || !image.naturalWidth) continue;
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.imageSmoothingEnabled = false;
      context.clearRect(0, 0, SIZE, SIZE);
      context.drawImage(image, x, y, side, side, 0, 0, SIZE, SIZE);
      const at = Math.floor((middle[0] - x + 0.5) * SIZE / side);
      value.textContent = [...context.getImageData(at, at, 1, 1).data.slice(0, 3)].join(" ");
    }
  }

  // Shows pictures of one size, [{label, src}]; sides and place stay where they were.
  async function show(given) {
    const made = given.map(({ label, src }) => {
      const canvas = element("canvas", { width: SIZE, height: SIZE, role: "img", "aria-label": `${label}, magnified` });
      return { label, src, canvas, image: element("img", { src, alt: "" }), value: element("span") };
    });
    await Promise.all(made.map(({ image }) => image.decode().catch(() => {})));
    const same = made.map((p) => p.label).join() === pictures.map((p) => p.label).join();
    const first = made[0].image, resized = first.naturalWidth !== width || first.naturalHeight !== height;
    [width, height] = [first.naturalWidth || 1, first.naturalHeight || 1];
    pictures = made;
    if (!same) {
      sides = made.length > 2 ? [1, 2] : [0, made.length - 1]; // before and after: the truth is the first of three
      choices.forEach((group, side) => group.replaceChildren(...made.map((p, n) =>
        element("button", { type: "button", onclick: () => choose(side, n) }, p.label))));
    }
    if (resized) place = [width / 2, height / 2];
    magnifier.replaceChildren(...made.map(({ canvas, label, value }) =>
      element("figure", {}, canvas, element("figcaption", {}, `${label} `, value))));
    lay();
    root.dataset.shown = Number(root.dataset.shown ?? 0) + 1;
  }

  function follow(event) {
    const box = stage.getBoundingClientRect();
    const [u, v] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]
      .map((at) => Math.min(Math.max(at, 0), 1));
    if (event.buttons) share = u;
    place = [u * width, v * height];
    draw();
  }

  stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); follow(event); });
  stage.addEventListener("pointermove", follow);
  range.addEventListener("input", () => { share = range.value / 1000; draw(); });
  magnifier.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    const far = event.shiftKey ? 10 : 1;
    place = [[place[0], step[0], width], [place[1], step[1], height]].map(([at, by, size]) =>
      Math.min(Math.max(at + far * by, 0), size - 1));
    draw();
    event.preventDefault();
  });
  window.addEventListener("resize", () => { if (pictures.length) lay(); });
  return { show };
}
