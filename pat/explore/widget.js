const STYLE = `
.pat { font: 13px system-ui, sans-serif; color: light-dark(#1c2127, #e8eaed); background: light-dark(#fff, #1d2125);
  padding: 8px; color-scheme: light dark }
.pat .views { display: flex; flex-wrap: wrap; gap: 8px } .pat figure { flex: 1 1 300px; margin: 0; max-width: 640px }
.pat canvas { width: 100%; display: block } .pat .controls { display: flex; flex-wrap: wrap; gap: 12px; margin-top: 8px }
.pat label { display: flex; flex-direction: column } .pat figcaption { min-height: 1.4em }`;

const metres = (d) => (d == null ? "no depth" : `${d} m`);

function write(context, text) {
  const { canvas } = context, size = canvas.width / 32;
  context.font = `${size}px system-ui`;
  const lines = [""];
  for (const word of text.split(" ")) {
    if (context.measureText(`${lines.at(-1)} ${word}`).width > 0.92 * canvas.width) lines.push("");
    lines.push(`${lines.pop()} ${word}`);
  }
  context.fillStyle = "#000b";
  context.fillRect(0, 0, canvas.width, (lines.length + 0.6) * 1.3 * size);
  context.fillStyle = "#ffd54a";
  lines.forEach((line, i) => context.fillText(line, 0.03 * canvas.width, (i + 1) * 1.3 * size));
}

function cross(context, [x, y], colour) {
  const r = context.canvas.width / 50;
  context.strokeStyle = colour;
  context.lineWidth = context.canvas.width / 300;
  context.beginPath();
  for (const [dx, dy] of [[r, 0], [0, r]]) { context.moveTo(x - dx, y - dy); context.lineTo(x + dx, y + dy); }
  context.stroke();
}

function drawBeta(context, beta) {
  if (beta.problem) { write(context, beta.problem); return beta.problem; }
  const unit = context.canvas.width / 400, top = Math.max(...beta.weights);
  context.strokeStyle = context.fillStyle = "#e69f00";
  context.lineWidth = unit;
  context.beginPath();
  for (const [x, y] of beta.samples) context.lineTo(x, y);
  context.stroke();
  context.globalAlpha = 0.7;
  beta.samples.forEach(([x, y], i) => {
    context.beginPath();
    context.arc(x, y, unit * (0.8 + 4 * beta.weights[i] / top), 0, 7);
    context.fill();
  });
  context.globalAlpha = 1;
  cross(context, beta.match, "#0bf");
  const off = beta.off == null ? "no clear match near the line" : `${beta.off} px off the line`;
  return `match (${beta.match.map((v) => v.toFixed(1)).join(", ")}), ${metres(beta.depth)}, ` +
    `${beta.samples.length} samples, ${off}`;
}

function slider(name, value, [low, high, step], changed) {
  const label = document.createElement("label"), input = document.createElement("input");
  const text = document.createElement("span");
  Object.assign(input, { type: "range", min: low, max: high, step, value });
  const show = () => { text.textContent = `${name} ${Number(input.value).toPrecision(3)}`; };
  input.dataset.control = name.split(" ")[0];
  input.addEventListener("input", () => { show(); changed(Number(input.value)); });
  label.append(text, input);
  show();
  return label;
}

function render({ model, el }) {
  const root = document.createElement("div"), views = document.createElement("div");
  const style = document.createElement("style");
  root.className = "pat"; views.className = "views"; style.textContent = STYLE;
  root.append(style, views);
  el.append(root);
  let waiting = null;
  const change = (part) => {
    if (!waiting) requestAnimationFrame(() => { model.set("controls", waiting); model.save_changes(); waiting = null; });
    waiting = { ...(waiting ?? model.get("controls")), ...part };
  };
  const cameras = model.get("cameras").length ? model.get("cameras") : [{ name: "", hw: [240, 640], src: "" }];
  const parts = cameras.map(({ name, hw, src, alpha }) => {
    const figure = document.createElement("figure"), canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption"), image = new Image();
    [canvas.height, canvas.width] = hw;
    canvas.dataset.camera = name;
    figure.append(canvas, caption);
    views.append(figure);
    let held = false;
    const point = (event) => change({ x: [
      (event.offsetX / canvas.clientWidth) * hw[1] - 0.5, (event.offsetY / canvas.clientHeight) * hw[0] - 0.5] });
    if (alpha) {
      canvas.addEventListener("click", (event) => { held = !held; point(event); });
      canvas.addEventListener("pointermove", (event) => { if (!held) point(event); });
    }
    image.onload = () => draw();
    image.src = src;
    return { name, alpha, canvas, caption, image };
  });
  function draw() {
    const answer = model.get("answer");
    for (const { name, alpha, canvas, caption, image } of parts) {
      const context = canvas.getContext("2d");
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, canvas.width, canvas.height);
      if (image.complete && image.naturalWidth) context.drawImage(image, 0, 0, canvas.width, canvas.height);
      if (answer.error) { write(context, answer.error); caption.textContent = answer.error; continue; }
      context.translate(0.5, 0.5); // the centre of the first pixel is (0, 0)
      if (alpha) cross(context, answer.x, "#0bf");
      const text = alpha ? `pixel (${answer.x}), ${metres(answer.depth)}` : drawBeta(context, answer.betas[name]);
      caption.textContent = `${name}: ${text}`;
    }
  }
  const bar = document.createElement("div"), controls = model.get("controls");
  bar.className = "controls";
  for (const [name, text, range] of model.get("ranges"))
    bar.append(slider(text, controls[name] ?? range[3], range, (value) => change({ [name]: value })));
  const copy = document.createElement("button");
  copy.textContent = "copy code";
  copy.addEventListener("click", async () => {
    const { code } = model.get("answer");
    try { await navigator.clipboard.writeText(code); copy.textContent = "copied"; } catch { copy.textContent = code; }
  });
  bar.append(copy);
  root.append(bar);
  model.on("change:answer", draw);
  draw();
}

export default { render };
