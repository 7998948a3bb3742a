// Who answers the widget of a page: a server, a grid of answers, or the page itself for calibrated pinholes.

// A model as a notebook's: one question at a time, the latest next.
function modelOf(values, ask) {
  let drawAgain = () => {}, busy = false, again = false;
  async function answer() {
    if (busy) { again = true; return; }
    busy = true;
    const { asked } = values.controls;
    try { values.answer = { ...await ask(values.controls, values), asked }; } catch (error) { values.answer = { error: String(error), asked }; }
    busy = false;
    drawAgain();
    if (again) { again = false; answer(); }
  }
  return {
    get: (name) => values[name], set: (name, value) => { values[name] = value; },
    on: (_, call) => { drawAgain = call; }, save_changes: answer,
  };
}

const asksServer = () => async (controls) => {
  const headers = { "Content-Type": "application/json" };
  let reply;
  try { reply = await fetch("answer", { method: "POST", headers, body: JSON.stringify(controls) }); }
  catch { throw "the server has ended: start `pat explore` again"; }
  return reply.json();
};

const asksGrid = ({ columns, rows, answers }) => async (controls, { cameras, answer }) => {
  if (controls.clicked) return answer; // the grid is alpha's
  const [h, w] = cameras[0].hw, [x, y] = controls.x;
  const cell = (v, n, size) => Math.min(n - 1, Math.max(0, Math.floor(((v + 0.5) / size) * n)));
  return answers[`${cell(x, columns, w)},${cell(y, rows, h)}`];
};

const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const times = (M, v) => M.map((row) => dot(row, v));
const product = (A, B) => A.map((row) => B[0].map((_, j) => dot(row, B.map((r) => r[j]))));
const transposed = (M) => M[0].map((_, j) => M.map((row) => row[j]));
const inverseOf = ([[a, b, c], [d, e, f], [g, h, i]]) => {
  const cofactors = [[e * i - f * h, c * h - b * i, b * f - c * e], [f * g - d * i, a * i - c * g, c * d - a * f],
    [d * h - e * g, b * g - a * h, a * e - b * d]];
  const det = a * cofactors[0][0] + b * cofactors[1][0] + c * cofactors[2][0];
  return cofactors.map((row) => row.map((v) => v / det));
};
const RADIUS = 5, SHARPNESS = 30, FLAT = 1e-4; // as in pixel.py

// The same numbers as pixel.py gives for the field of `pat fuse` and weights by windows, of the images as shown.
function asksPinholes(rig) {
  const guides = {};
  async function guide({ name, src, hw }) {
    if (guides[name]) return guides[name];
    const image = new Image();
    image.src = src;
    await image.decode();
    const [width, height] = [image.naturalWidth, image.naturalHeight];
    const canvas = Object.assign(document.createElement("canvas"), { width, height }), context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, width, height), luma = new Float32Array(width * height);
    for (let i = 0; i < luma.length; i++)
      luma[i] = (0.299 * data[4 * i] + 0.587 * data[4 * i + 1] + 0.114 * data[4 * i + 2]) / 255;
    return (guides[name] = { luma, width, height, hw });
  }
  function value({ luma, width, height, hw }, [x, y]) { // bilinear; beyond the border its nearest value
    const u = Math.min(width - 1, Math.max(0, (x + 0.5) * width / hw[1] - 0.5));
    const v = Math.min(height - 1, Math.max(0, (y + 0.5) * height / hw[0] - 0.5));
    const i = Math.floor(u), j = Math.floor(v), a = u - i, b = v - j;
    const at = (row, column) => luma[Math.min(height - 1, row) * width + Math.min(width - 1, column)];
    return (1 - b) * ((1 - a) * at(j, i) + a * at(j, i + 1)) + b * ((1 - a) * at(j + 1, i) + a * at(j + 1, i + 1));
  }
  function feature(image, [x, y], J) {
    const found = [];
    for (let v = -RADIUS; v <= RADIUS; v++)
      for (let u = -RADIUS; u <= RADIUS; u++)
        found.push(value(image, [x + J[0][0] * u + J[0][1] * v, y + J[1][0] * u + J[1][1] * v]));
    const mean = found.reduce((a, b) => a + b) / found.length, centred = found.map((f) => f - mean);
    const length = Math.sqrt(dot(centred, centred));
    return length > FLAT ? centred.map((f) => f / length) : centred.map(() => 0);
  }
  const turned = (degrees) => { // Rodrigues
    const angle = Math.hypot(...degrees) * Math.PI / 180;
    if (!angle) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const [x, y, z] = degrees.map((v) => v * Math.PI / 180 / angle), c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
    return [[c + x * x * d, x * y * d - z * s, x * z * d + y * s], [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
      [z * x * d - y * s, z * y * d + x * s, c + z * z * d]];
  };
  function moved({ errors, baseline }) {
    const own = rig.cameras[rig.alpha], found = {};
    for (const [name, camera] of Object.entries(rig.cameras)) {
      const given = [errors[name] ?? {}, ...(name === rig.alpha ? [] : [errors["all betas"] ?? {}])];
      const sums = (...keys) => keys.map((key) => given.reduce((sum, one) => sum + (one[key] ?? 0), 0));
      const focal = given.reduce((all, one) => all * (one.focal ?? 1), 1);
      const step = times(transposed(own.R), sums("right", "down", "forward")), shift = sums("cx", "cy");
      const centre = own.centre.map((c, i) => c + baseline * (camera.centre[i] - c) + step[i]);
      const K = camera.K.map((row, i) => row.map((v, j) => (i < 2 ? (j < 2 ? v * focal : v + shift[i]) : v)));
      found[name] = { ...camera, K, R: product(turned(sums("rx", "ry", "rz")), camera.R), centre };
    }
    return found;
  }
  function pairOf(a, b) { // a pixel x of a at depth z is at M x + p / z of b, homogeneous
    const R = product(b.R, transposed(a.R)), Ki = inverseOf(a.K);
    const p = times(b.K, times(b.R, a.centre.map((c, i) => c - b.centre[i])));
    return { M: product(b.K, product(R, Ki)), p };
  }
  const transfer = ({ M, p }, [x, y], w) => times(M, [x, y, 1]).map((v, i) => v + w * p[i]);
  const flat = ([x, y, z]) => [x / z, y / z];

  // Segment between the depths, its part in the image, a sample a pixel; Liang and Barsky's clipping.
  function samplesOf(pair, x, [near, far], [h, w]) {
    const ends = [1 / near, 1 / far].map((inverse) => transfer(pair, x, inverse));
    if (ends.some((end) => end[2] <= 0)) return [];
    const [a, b] = ends.map(flat), d = [b[0] - a[0], b[1] - a[1]];
    let [from, to] = [0, 1];
    for (const [start, step, high] of [[a[0], d[0], w - 0.5], [a[1], d[1], h - 0.5]]) {
      if (step === 0) { if (start < -0.5 || start > high) return []; continue; }
      const cuts = [(-0.5 - start) / step, (high - start) / step].sort((p, q) => p - q);
      [from, to] = [Math.max(from, cuts[0]), Math.min(to, cuts[1])];
    }
    if (from > to) return [];
    const count = Math.ceil((to - from) * Math.hypot(...d)) + 1;
    return Array.from({ length: count }, (_, i) => {
      const s = count === 1 ? from : from + (to - from) * i / (count - 1);
      return [a[0] + s * d[0], a[1] + s * d[1]];
    });
  }
  function depthOf({ M, p }, x, [u, v]) { // least squares of (M x + w p) cross (u, v, 1)
    const m = times(M, [...x, 1]), lines = [[m[0] - u * m[2], p[0] - u * p[2]], [m[1] - v * m[2], p[1] - v * p[2]]];
    const w = -lines.reduce((s, [c, q]) => s + c * q, 0) / lines.reduce((s, [, q]) => s + q * q, 0);
    return w > 0 ? Number((1 / w).toPrecision(4)) : null;
  }
  async function report(camera, alpha, pair, x, depths) {
    const samples = samplesOf(pair, x, depths, camera.hw);
    if (!samples.length)
      return { problem: "no part of the segment lies in this image: the views do not overlap here" };
    const middle = (1 / depths[0] + 1 / depths[1]) / 2, at = (dx, dy) => flat(transfer(pair, [x[0] + dx, x[1] + dy], middle));
    const [r, l, d, u] = [at(0.5, 0), at(-0.5, 0), at(0, 0.5), at(0, -0.5)];
    const J = [[r[0] - l[0], d[0] - u[0]], [r[1] - l[1], d[1] - u[1]]];
    const own = feature(await guide(alpha), x, [[1, 0], [0, 1]]), image = await guide(camera);
    const scores = samples.map((sample) => SHARPNESS * dot(own, feature(image, sample, J)));
    const top = Math.max(...scores), powers = scores.map((s) => Math.exp(s - top)), total = powers.reduce((a, b) => a + b);
    const weights = powers.map((p) => p / total), best = weights.indexOf(Math.max(...weights));
    const known = samples.map((sample) => depthOf(pair, x, sample));
    const epipole = pair.p[2] > 0 ? flat(pair.p) : null;
    return { samples, weights, depths: known, match: samples[best], depth: known[best], peak: weights[best], epipole };
  }
  async function inspect(cameras, shown, alpha, x, depths) {
    const betas = {}, own = shown.find(({ name }) => name === alpha);
    for (const camera of shown)
      if (camera.name !== alpha)
        betas[camera.name] = await report(camera, own, pairOf(cameras[alpha], cameras[camera.name]), x, depths);
    return betas;
  }
  // The maps of answers.py, kept until what they depend on changes.
  let kept = {};
  const MAPS = {
    "length, px": ({ samples: s }) => Math.hypot(...s[0].map((v, i) => v - s.at(-1)[i])),
    "betas that see it": () => 1,
    "entropy of weights": ({ weights: w }) => (w.length < 2 ? 0 : -w.reduce((sum, p) => sum + (p && p * Math.log(p)), 0) / Math.log(w.length)),
  };
  async function mapOf({ map, errors, baseline }, cameras, shown, depths) {
    const key = JSON.stringify([map, errors, baseline, depths]), [h, w] = cameras[rig.alpha].hw;
    if (map === "none" || kept.key === key) return map === "none" ? null : kept.map;
    const columns = 24, rows = Math.max(1, Math.round(columns * h / w)), values = [];
    for (let i = 0; i < columns * rows; i++) {
      if (i % columns === 0) await new Promise((go) => setTimeout(go)); // lets the page draw
      const x = [((i % columns) + 0.5) * w / columns - 0.5, (Math.floor(i / columns) + 0.5) * h / rows - 0.5].map(Math.round);
      let found;
      if (map === "depth range seen") found = shown.filter(({ name }) => name !== rig.alpha).map(({ name, hw }) => {
        const pair = pairOf(cameras[rig.alpha], cameras[name]);
        const seen = Array.from({ length: 33 }, (_, k) => transfer(pair, x, 1 / depths[0] + (1 / depths[1] - 1 / depths[0]) * k / 32));
        return seen.filter((p) => p[2] > 0 && flat(p).every((v, a) => v >= -0.5 && v <= hw[1 - a] - 0.5)).length / 33;
      });
      else found = Object.values(await inspect(cameras, shown, rig.alpha, x, depths)).filter(({ problem }) => !problem).map(MAPS[map]);
      const sum = found.reduce((a, b) => a + b, 0), count = map === "betas that see it";
      values.push(count ? sum : found.length ? Number((sum / found.length).toPrecision(4)) : null);
    }
    kept = { key, map: { columns, rows, values } };
    return kept.map;
  }
  return async (controls, { cameras: shown }) => {
    const cameras = moved(controls), own = cameras[rig.alpha], depths = [controls.near ?? rig.near, controls.far ?? rig.far];
    if (!(depths[0] > 0 && depths[0] <= depths[1])) return { error: `near must be at most far, got ${depths.join(" and ")}` };
    const rounded = (v, size) => Math.min(size - 1, Math.max(0, Math.round(v)));
    const inside = ([x, y], [h, w]) => [rounded(x, w), rounded(y, h)];
    let x = inside(controls.x, own.hw), backwards = [];
    if (controls.clicked) {
      const [name, ...at] = controls.clicked;
      const pair = [name, rig.alpha].map((n) => shown.find((camera) => camera.name === n));
      const back = (await inspect(cameras, pair, name, inside(at, cameras[name].hw), depths))[rig.alpha];
      if (back.problem) return { error: `no pixel of ${rig.alpha} can match this one of ${name}` };
      [x, backwards] = [inside(back.match, own.hw), back.samples];
    }
    const betas = await inspect(cameras, shown, rig.alpha, x, depths);
    let [sum, inverse] = [0, 0];
    for (const { problem, weights, depths: known, peak } of Object.values(betas))
      if (!problem) weights.forEach((w, i) => { if (known[i] != null) { sum += peak * w; inverse += peak * w / known[i]; } });
    const pins = [];
    for (const at of controls.pins) {
      const there = await inspect(cameras, shown, rig.alpha, inside(at, own.hw), depths);
      pins.push({ x: inside(at, own.hw), betas: Object.fromEntries(Object.entries(there).filter(([, one]) => !one.problem)) });
    }
    const top = Object.entries(cameras).map(([name, { centre, R, K }]) => {
      const at = times(own.R, centre.map((c, i) => c - own.centre[i])), ahead = times(own.R, R[2]);
      const pixel = name === rig.alpha ? x : betas[name]?.match;
      const ray = pixel && times(own.R, times(transposed(R), times(inverseOf(K), [...pixel, 1]))), long = ray && Math.hypot(...ray);
      return { name, at: [at[0], at[2]], ahead: [ahead[0], ahead[2]], ray: ray ? [ray[0] / long, ray[2] / long] : null };
    });
    const map = await mapOf(controls, cameras, shown, depths);
    return { map, x, depth: inverse > 0 ? Number((sum / inverse).toPrecision(4)) : null, betas, pins, backwards, top, rig: "" };
  };
}
