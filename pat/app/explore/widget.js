const STYLE = `
.pat { font: 13px system-ui, sans-serif; color: light-dark(#1c2127, #e8eaed); background: light-dark(#fff, #1d2125);
  --line: light-dark(#cfd5dc, #434a52); --soft: light-dark(#5d6670, #a5aeb8); padding: 10px; color-scheme: light dark }
.pat .views { display: flex; flex-wrap: wrap; gap: 10px } .pat figure { flex: 1 1 340px; margin: 0; min-width: 0 }
.pat canvas { width: 100%; display: block; border-radius: 4px } .pat figcaption { min-height: 2.8em; margin-top: 4px }
.pat .sign { visibility: hidden; color: var(--soft) } .pat.busy .sign { visibility: visible; transition: visibility 0s .15s }
.pat .zoom { height: 150px; border-radius: 0; margin-top: 4px } .pat .profile { height: 56px; border-radius: 0; margin-top: 4px } .pat .top { width: 240px; height: 180px }
.pat .top { border: 1px solid var(--line); touch-action: none } .pat canvas[data-camera] { cursor: crosshair }
.pat .below, .pat .controls, .pat .buttons { display: flex; flex-wrap: wrap; gap: 12px; align-items: start }
.pat .below { margin-top: 6px } .pat .controls { flex: 1 1 300px } .pat .buttons { flex-basis: 100% }
.pat label { display: flex; flex-direction: column; gap: 2px; width: 180px; color: var(--soft) }
.pat select, .pat button { font: inherit; color: inherit; background: light-dark(#f3f5f7, #2a2f35);
  border: 1px solid var(--line); border-radius: 5px; padding: 3px 8px } .pat button { cursor: pointer }
.pat button:disabled { opacity: .4 } .pat :focus-visible { outline: 2px solid #0a84ff; outline-offset: 1px } .pat kbd { font: inherit; opacity: .6 }`;
const FIRST = "#e69f00", SECOND = "#cc79a7", MATCH = "#00bfff", BACK = "#ff6d3a", BAND = "#ffffff";
const PINS = ["#f0e442", "#009e73", "#d55e00", "#56b4e9", "#ff8fd0", "#b8e986"];
const MAP = [[68, 1, 84], [33, 145, 140], [253, 231, 37]];
const depthText = (d, unit) => (d == null ? "no depth" : `depth ${d} ${unit}`);
const make = (tag, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
};

function write(context, text) {
  const { canvas } = context, size = canvas.width / 32, lines = [""];
  context.font = `${size}px system-ui`;
  for (const word of text.split(" ")) {
    if (context.measureText(`${lines.at(-1)} ${word}`).width > 0.92 * canvas.width) lines.push("");
    lines.push(`${lines.pop()} ${word}`);
  }
  context.fillStyle = "#000b";
  context.fillRect(0, 0, canvas.width, (lines.length + 0.6) * 1.3 * size);
  context.fillStyle = "#ffd54a";
  lines.forEach((line, i) => context.fillText(line, 0.03 * canvas.width, (i + 1) * 1.3 * size));
}

// What is drawn over an image, once for the canvas and once for the SVG: lines, dots and crosses in its pixels.
function marks(camera, answer, unit = camera.hw[1] / 400) {
  const found = [], beta = answer.betas?.[camera.name], radius = 8 * unit;
  const cross = ([x, y], colour) => [[1, 0], [-1, 0], [0, 1], [0, -1]].forEach(([u, v]) => found.push(
    { line: [0.4 * radius, radius].map((r) => [x + r * u, y + r * v]), colour }));
  const field = (report, colour) => {
    if (!report || report.problem) return;
    const top = Math.max(...report.weights);
    found.push({ line: report.samples, colour });
    report.samples.forEach((at, i) => found.push({ dot: at, radius: unit * (0.6 + 4 * report.weights[i] / top), colour }));
  };
  (answer.pins ?? []).forEach((pin, i) => {
    const colour = PINS[i % PINS.length], there = camera.alpha ? { match: pin.x } : pin.betas[camera.name];
    if (there?.samples) found.push({ line: there.samples, colour });
    if (there) cross(there.match, colour);
  });
  if (camera.alpha) {
    if (answer.backwards?.length) found.push({ line: answer.backwards, colour: BACK });
    if (answer.x) cross(answer.x, MATCH);
    return found;
  }
  if (beta?.epipole) found.push({ line: Array.from({ length: 25 }, (_, i) => [Math.cos, Math.sin].map((f, k) =>
    beta.epipole[k] + radius * f(i * Math.PI / 12))), colour: BACK });
  if (beta?.band) found.push({ line: [...beta.band, beta.band[0]], colour: BAND });
  field(beta?.second, SECOND);
  field(beta, FIRST);
  if (beta?.match) cross(beta.match, MATCH);
  return found;
}

// A map of the whole image over it, from its least value (violet) to its largest (yellow); each lighter than the last.
function drawMap(context, [h, w], { columns, rows, values }) {
  const known = values.filter((v) => v != null), low = Math.min(...known), span = Math.max(...known) - low || 1;
  context.globalAlpha = 0.65;
  values.forEach((v, i) => {
    if (v == null) return;
    const s = 2 * (v - low) / span, [from, to] = s < 1 ? MAP : MAP.slice(1), t = s - (s >= 1);
    context.fillStyle = `rgb(${from.map((c, k) => c + t * (to[k] - c)).join()})`;
    const [x, y] = [i % columns, Math.floor(i / columns)].map((k, a) => k * (a ? h / rows : w / columns) - 0.5);
    context.fillRect(x, y, w / columns + 0.5, h / rows + 0.5);
  });
  context.globalAlpha = 1;
}

function mapText({ columns, rows, values }, name, [x, y], [h, w]) {
  const known = values.filter((v) => v != null), at = Math.floor((y + 0.5) / h * rows) * columns + Math.floor((x + 0.5) / w * columns);
  if (!known.length) return `; ${name}: none`;
  const [low, high, here] = [Math.min(...known), Math.max(...known), values[at]].map((v) => (v == null ? "none" : Number(v.toFixed(2))));
  return `; ${name}: ${low} to ${high}, here ${here}`;
}

function drawMarks(context, camera, answer, unit = camera.hw[1] / 400) {
  for (const { line, dot, radius, colour } of marks(camera, answer, unit)) {
    context.strokeStyle = context.fillStyle = colour;
    context.beginPath();
    if (line) {
      for (const [x, y] of line) context.lineTo(x, y);
      context.lineWidth = unit * 1.3;
      context.stroke();
    } else {
      context.globalAlpha = 0.7;
      context.arc(...dot, radius, 0, 7);
      context.fill();
      context.globalAlpha = 1;
    }
  }
}

// Part of an image around a point, `wide` of its pixels across a box (left, width) of a canvas, with what is drawn over it.
function drawPart(context, { camera, image }, answer, [x, y], wide, left, width) {
  if (!image.complete || !image.naturalWidth) return;
  const high = wide * context.canvas.height / width, [h, w] = camera.hw;
  const across = image.naturalWidth / w, down = image.naturalHeight / h, from = [x - wide / 2, y - high / 2];
  context.save();
  context.beginPath();
  context.rect(left, 0, width, context.canvas.height);
  context.clip();
  context.imageSmoothingEnabled = false;
  context.translate(left, 0);
  context.scale(width / wide, width / wide);
  context.translate(-from[0], -from[1]);
  context.drawImage(image, -0.5, -0.5, w, h);
  drawMarks(context, camera, answer, 2.5 * wide / width);
  context.restore();
}

const PATCH = 25; // pixels of alpha

// Alpha's patch and the match's side by side, then the segment enlarged.
function drawZoom(canvas, alpha, part, answer) {
  const context = canvas.getContext("2d"), width = (canvas.width = 2 * canvas.clientWidth || 600), beta = answer.betas?.[part.camera.name];
  const height = (canvas.height = 300), side = Math.min(height, width / 4);
  if (answer.error || !beta || beta.problem) return;
  drawPart(context, alpha, answer, answer.x, PATCH, 0, side);
  drawPart(context, part, answer, beta.match, PATCH, side + 6, side);
  const points = [...beta.samples, ...(beta.band ?? [])], rest = width - 2 * side - 12;
  const [low, high] = [Math.min, Math.max].map((f) => [0, 1].map((i) => f(...points.map((p) => p[i]))));
  const wide = 1.15 * Math.max(PATCH, high[0] - low[0], (high[1] - low[1]) * rest / height);
  drawPart(context, part, answer, low.map((v, i) => (v + high[i]) / 2), wide, 2 * side + 12, rest);
}

// Weights along the segment from one end to the other, the highest being 1.
function drawProfile(canvas, beta, unit) {
  const context = canvas.getContext("2d"), width = (canvas.width = 2 * canvas.clientWidth || 600);
  const height = (canvas.height = 112);
  [[beta?.second, SECOND], [beta, FIRST]].forEach(([report, colour]) => {
    if (!report || report.problem) return;
    const top = Math.max(...report.weights), last = Math.max(report.weights.length - 1, 1);
    context.strokeStyle = colour;
    context.lineWidth = 3;
    context.beginPath();
    report.weights.forEach((w, i) => context.lineTo(3 + i / last * (width - 6), height - 4 - (w / top) * (height - 34)));
    context.stroke();
  });
  if (!beta || beta.problem) return;
  context.font = "22px system-ui";
  context.fillStyle = getComputedStyle(canvas).color;
  const ends = [beta.depths[0], beta.depths.at(-1)].map((d) => (d == null ? "" : `${d} ${unit}`));
  context.fillText(ends[0], 0, 20);
  context.textAlign = "center";
  context.fillText("weight along the segment", width / 2, 20);
  context.textAlign = "right";
  context.fillText(ends[1], width, 20);
}

function betaText(beta, unit) {
  if (beta.problem) return beta.problem;
  const side = beta.band && Math.hypot(...beta.band[0].map((v, i) => v - beta.band[3][i])) / 2;
  const off = (beta.off == null ? "" : `, ${beta.off} px off the line`) + (side ? `, band ±${side.toFixed(2)} px` : "");
  const second = beta.second && (beta.second.problem ?? `${beta.second.samples.length} samples`);
  return `match (${beta.match.map((v) => v.toFixed(1)).join(", ")}), ${depthText(beta.depth, unit)}, ` +
    `${beta.samples.length} samples${off}` + (beta.epipole ? `, epipole (${beta.epipole.map((v) => v.toFixed(0)).join(", ")})` : "") + (second ? `; compared: ${second}` : "");
}

// Python that makes the same view, from the files if they are known.
function code(cameras, controls, defaults, x, files) {
  const python = (v) => (v === null ? "None" : typeof v === "number" ? String(Number(v.toPrecision(6))) : JSON.stringify(v));
  const kept = Object.keys(defaults).filter((n) => n !== "clicked" && python(controls[n]) !== python(defaults[n]));
  const changes = kept.map((n) => `, ${n}=${python(controls[n])}`).join("");
  const alpha = cameras.find((camera) => camera.alpha).name, names = Object.keys(files).filter((name) => name);
  const images = names.map((name) => `${python(name)}: read_view(rig, ${python(name)}, ${python(files[name])})`).join(", ");
  const head = files[""] ? `from arraygeom import Rig\nfrom pat.app.explore import explore\nfrom pat.fusion.views import read_view\n\n` +
    `rig = Rig.load(${python(files[""])})\nimages = ${names.length ? `{${images}}` : "None"}\n` : "from pat.app.explore import explore\n\n";
  return `${head}explore(rig, images, alpha=${python(alpha)}, x=(${x.map((v) => Math.round(v)).join(", ")})${changes})`;
}

function svg(cameras, answer) {
  const gap = 10, wide = 640, escaped = (text) => text.replace(/[&<"]/g, (c) => `&#${c.charCodeAt(0)};`);
  const parts = cameras.map((camera, i) => {
    const [h, w] = camera.hw, drawn = marks(camera, answer).map(({ line, dot, radius, colour }) => line
      ? `<polyline points="${line.map((p) => p.join()).join(" ")}" fill="none" stroke="${colour}" stroke-width="${w / 300}"/>`
      : `<circle cx="${dot[0]}" cy="${dot[1]}" r="${radius}" fill="${colour}" fill-opacity=".7"/>`).join("");
    return `<svg x="${i * (wide + gap)}" y="24" width="${wide}" height="${wide * h / w}" viewBox="-.5 -.5 ${w} ${h}">` +
      `<image x="-.5" y="-.5" width="${w}" height="${h}" preserveAspectRatio="none" href="${camera.src}"/>${drawn}</svg>` +
      `<text x="${i * (wide + gap)}" y="16" font-family="sans-serif" font-size="14">${escaped(camera.name)}</text>`;
  });
  const high = 24 + Math.max(...cameras.map(({ hw }) => wide * hw[0] / hw[1]));
  return `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${cameras.length * (wide + gap)} ${high}">${parts.join("")}</svg>`;
}

function download(name, text, type) {
  const link = make("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// The cameras from above; a beta that is dragged moves.
function topView(canvas, model, change) {
  canvas.width = 480;
  canvas.height = 360;
  let held = null, scale = 1;
  const isAlpha = (camera) => model.get("cameras").some(({ name, alpha }) => alpha && name === camera.name);
  const place = ([x, z]) => [240 + scale * x, 270 - scale * z];
  const draw = () => {
    const shown = model.get("answer").top ?? [], context = canvas.getContext("2d");
    canvas.style.display = shown.length ? "" : "none";
    if (!held) scale = 150 / (Math.max(...shown.map(({ at }) => Math.hypot(...at))) || 1);
    context.clearRect(0, 0, 480, 360);
    context.font = "22px system-ui";
    context.lineWidth = 3;
    for (const camera of shown) {
      const { name, at, ahead } = camera, [x, y] = place(at);
      context.strokeStyle = context.fillStyle = isAlpha(camera) ? MATCH : FIRST;
      const angle = Math.atan2(ahead[0], ahead[1]);
      context.beginPath();
      for (const side of [-0.35, 0.35]) {
        context.moveTo(x, y);
        context.lineTo(x + 60 * Math.sin(angle + side), y - 60 * Math.cos(angle + side));
      }
      context.stroke();
      if (camera.ray) { // of alpha's pixel, or of the match
        context.beginPath();
        context.setLineDash([9, 9]);
        context.moveTo(x, y);
        context.lineTo(x + 900 * camera.ray[0], y - 900 * camera.ray[1]);
        context.stroke();
        context.setLineDash([]);
      }
      context.beginPath();
      context.arc(x, y, 9, 0, 7);
      context.fill();
      context.fillStyle = getComputedStyle(canvas).color;
      context.fillText(name, x + 12, y + 26);
    }
  };
  const at = (event) => [2 * event.offsetX, 2 * event.offsetY];
  canvas.addEventListener("pointerdown", (event) => {
    const [x, y] = at(event), near = ([a, b]) => Math.hypot(a - x, b - y) < 30;
    const camera = (model.get("answer").top ?? []).find((one) => !isAlpha(one) && near(place(one.at)));
    held = camera && { name: camera.name, from: [x, y], before: model.get("controls").errors[camera.name] ?? {} };
    if (held) canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [x, y] = at(event);
    const step = { right: (x - held.from[0]) / scale, forward: (held.from[1] - y) / scale }, mine = { ...held.before };
    for (const [key, v] of Object.entries(step)) mine[key] = Number(((mine[key] ?? 0) + v).toFixed(4));
    change({ errors: { ...model.get("controls").errors, [held.name]: mine } });
  });
  canvas.addEventListener("pointerup", () => { held = null; draw(); });
  return draw;
}

function render({ model, el }) {
  const views = make("div", { className: "views" }), bar = make("div", { className: "controls" });
  const root = make("div", { className: "pat", tabIndex: 0 }, make("style", { textContent: STYLE }), views);
  let asked = 0;
  const first = model.get("controls");
  let waiting = null;
  const change = (part) => { // at most once a frame; alpha's pixel is that of the last answer if a beta was clicked
    if (!waiting) requestAnimationFrame(() => {
      model.set("controls", { ...waiting, asked: ++asked });
      model.save_changes();
      waiting = null;
      root.classList.add("busy");
    });
    const now = waiting ?? model.get("controls");
    waiting = { ...now, ...(now.clicked && model.get("answer").x ? { x: model.get("answer").x } : {}), clicked: null, ...part };
  };
  const cameras = model.get("cameras").length ? model.get("cameras") : [{ name: "", hw: [240, 640], src: "" }];
  const parts = cameras.map((camera) => {
    const { name, hw, src, alpha } = camera, canvas = make("canvas", { width: hw[1], height: hw[0] });
    const caption = make("figcaption"), profile = make("canvas", { className: "profile" }), image = new Image();
    const zoom = make("canvas", { className: "zoom", title: "alpha's patch, the match's, the segment" });
    canvas.dataset.camera = name;
    views.append(make("figure", {}, canvas, ...(alpha || !src ? [] : [zoom, profile]), caption));
    const pixel = (event) => [
      (event.offsetX / canvas.clientWidth) * hw[1] - 0.5, (event.offsetY / canvas.clientHeight) * hw[0] - 0.5];
    let held = false;
    canvas.addEventListener("click", (event) => {
      root.focus({ preventScroll: true });
      held = !held;
      change(alpha ? { x: pixel(event) } : { clicked: [name, ...pixel(event)] });
    });
    if (alpha) canvas.addEventListener("pointermove", (event) => { if (!held) change({ x: pixel(event) }); });
    image.onload = () => draw();
    image.src = src;
    return { camera, canvas, caption, profile, zoom, image };
  });
  const top = make("canvas", { className: "top", title: "from above: drag a camera" });
  const drawTop = topView(top, model, change);
  function draw() {
    const answer = model.get("answer");
    for (const part of parts) {
      const { camera, canvas, caption, profile, zoom, image } = part;
      const context = canvas.getContext("2d"), { name, alpha, unit, hw } = camera;
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, canvas.width, canvas.height);
      if (image.complete && image.naturalWidth) context.drawImage(image, 0, 0, canvas.width, canvas.height);
      const beta = answer.betas?.[name], problem = answer.error ?? beta?.problem;
      if (problem) write(context, problem);
      context.translate(0.5, 0.5); // the centre of the first pixel is (0, 0)
      const map = alpha && !answer.error && answer.map;
      if (map) drawMap(context, hw, map);
      if (!answer.error) drawMarks(context, camera, answer);
      if (!alpha) drawProfile(profile, beta, unit);
      if (!alpha && parts[0].camera.alpha) drawZoom(zoom, parts[0], part, answer);
      const text = answer.error ?? (alpha ? `pixel (${answer.x}), ${depthText(answer.depth, unit)}` : betaText(beta, unit)) +
        (map ? mapText(map, model.get("controls").map, answer.x, hw) : "");
      caption.textContent = `${name}${alpha ? " (alpha)" : ""}: ${text}`;
    }
    drawTop();
  }
  const inputs = model.get("choices").map(([name, text, options]) => {
    const select = make("select", {}, ...options.map((value) => make("option", { value, textContent: value })));
    select.value = first[name];
    select.addEventListener("change", () => change({ [name]: select.value }));
    bar.append(make("label", {}, text, select));
    return { show: (controls) => { select.value = controls[name]; }, input: select, name };
  });
  const value = (controls, name, each) => (each ? controls.errors[controls.camera]?.[name] : controls[name]);
  for (const [name, text, [min, max, step, usual], each] of model.get("ranges")) { // `each`: of the chosen camera
    const input = make("input", { type: "range", min, max, step }), label = make("span");
    const tell = (v) => { label.textContent = `${text}: ${Number(v.toPrecision(3))}`; };
    const show = (controls) => { input.value = value(controls, name, each) ?? usual; tell(value(controls, name, each) ?? usual); };
    input.addEventListener("input", () => {
      const now = Number(Number(input.value).toPrecision(6)), { errors, camera } = waiting ?? model.get("controls");
      change(each ? { errors: { ...errors, [camera]: { ...errors[camera], [name]: now } } } : { [name]: now });
      tell(now);
    });
    bar.append(make("label", {}, label, input));
    show(first);
    inputs.push({ show, input, name });
  }
  inputs.find(({ name }) => name === "camera")?.input.addEventListener("change", (event) => {
    const now = { ...model.get("controls"), camera: event.target.value };
    inputs.forEach(({ show }) => show(now));
  });
  for (const { input, name } of inputs) input.dataset.control = name;
  const acts = {
    c: ["copy code", async (button) => {
      const text = code(cameras, model.get("controls"), model.get("defaults"), model.get("answer").x ?? first.x, model.get("files"));
      try { await navigator.clipboard.writeText(text); button.textContent = "copied"; } catch { button.textContent = text; }
    }],
    s: ["save as SVG", () => download("fields.svg", svg(cameras, model.get("answer")), "image/svg+xml")],
    g: ["save the moved rig", () => download("rig_moved.yaml", model.get("answer").rig, "text/yaml")],
    p: ["pin the pixel", () => change({ pins: [...model.get("controls").pins, model.get("answer").x ?? first.x] })],
    u: ["unpin all", () => change({ pins: [] })],
    r: ["reset", () => {
      const usual = { ...model.get("defaults"), ...first, x: model.get("answer").x ?? first.x };
      change(usual);
      inputs.forEach(({ show }) => show(usual));
    }],
    d: ["light or dark", () => {
      const dark = getComputedStyle(root).colorScheme === "light dark"
        ? matchMedia("(prefers-color-scheme: dark)").matches : root.style.colorScheme === "dark";
      root.style.colorScheme = dark ? "light" : "dark";
      draw();
    }],
  };
  const buttons = Object.entries(acts).map(([key, [text, act]]) => {
    const button = make("button", { textContent: text, title: `key ${key}` });
    button.dataset.key = key;
    button.addEventListener("click", () => act(button));
    return button;
  });
  bar.append(make("div", { className: "buttons" }, ...buttons, make("kbd", { textContent: "arrows move the pixel" }), make("span", { className: "sign", textContent: "computing" })));
  root.addEventListener("keydown", (event) => {
    if (event.target.matches("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const [x, y] = model.get("answer").x ?? first.x, size = event.shiftKey ? 10 : 1;
    if (step) change({ x: [x + size * step[0], y + size * step[1]] });
    else if (event.key in acts) buttons.find((button) => button.dataset.key === event.key).click();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  root.append(make("div", { className: "below" }, top, bar));
  el.append(root);
  const showRig = () => { buttons[2].disabled = !model.get("answer").rig; };
  model.on("change:answer", () => {
    draw();
    showRig();
    if ((model.get("answer").asked ?? asked) === asked) root.classList.remove("busy");
  });
  new ResizeObserver(() => draw()).observe(views);
  draw();
  showRig();
}

export default { render };
