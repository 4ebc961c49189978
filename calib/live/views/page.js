"use strict";
const $ = id => document.getElementById(id);
const PLOT_INTERVAL = 200;  // ms between two pictures of the histories
const SAY_INTERVAL = 3000;  // ms between two texts for screen readers
const TRAIL = 2;  // s of a contact's path that its trail shows
const RANGES = [1, 1 / 3, 1 / 10];  // full colour, as shares of the calibrated range
const SERIES = 6;  // colours of lines, in page.css
let scene = null, last = null, paused = false, ink = {};

// --- texts, numbers and elements ---------------------------------------------------------------------------------

function setText(id, text) {  // unchanged text is left alone, so that nothing is read out twice
  if ($(id).textContent !== text) $(id).textContent = text;
}
function element(name, attributes = {}, text = "") {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}
function shape(name, attributes = {}, text = "") {  // of the drawing over the map
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  return made;
}
const mm = metres => 1e3 * metres;
const sum = values => values.reduce((total, value) => total + (value || 0), 0);
function fixed(value, digits) { return value.toFixed(digits).replace("-", "−"); }
function withError(value, error) { return `${fixed(value, 1)} ± ${fixed(error, error < 100 ? 1 : 0)}`; }
function plain(value, digits = 2) { return String(Number(value.toPrecision(digits))); }
function floats(text) { return new Float32Array(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer); }
function readColours() {  // of the page, light or dark
  const style = getComputedStyle(document.documentElement), read = name => style.getPropertyValue("--" + name).trim();
  for (const name of ["ink", "quiet", "line", "edge", "mark"]) ink[name] = read(name);
  for (const name of ["low", "high"]) ink[name] = read(name).split(/\s+/).map(Number);
  ink.series = Array.from({ length: SERIES }, (_, k) => read(`series-${k}`));
}

// --- the sheet: a grid of colours, and over it outlines, electrodes and contacts in millimetres, y upwards -------

function pitch() {
  return [0, 1].map(k => (scene.high[k] - scene.low[k]) / ([scene.columns, scene.rows][k] - 1 || 1));
}
function path(points, closed = false) {
  const corners = points.map(([x, y]) => `${mm(x).toFixed(2)} ${(-mm(y)).toFixed(2)}`);
  return `M${corners.join("L")}${closed ? "Z" : ""}`;
}
function viewBox() {  // the sheet and a margin for numbers of electrodes, mm
  const [low, high] = scene.bounds, margin = 0.05 * Math.max(high[0] - low[0], high[1] - low[1]);
  const box = [low[0] - margin, -high[1] - margin, high[0] - low[0] + 2 * margin, high[1] - low[1] + 2 * margin];
  return box.map(mm);
}
function layOut() {  // the proportions are those of the skin
  const [left, top, width, height] = viewBox(), [dx, dy] = pitch(), style = $("map").style;
  $("marks").setAttribute("viewBox", [left, top, width, height].map(x => x.toFixed(3)).join(" "));
  $("sheet").style.setProperty("--aspect", width / height);
  style.left = `${100 * (mm(scene.low[0] - dx / 2) - left) / width}%`;
  style.top = `${100 * (mm(-scene.high[1] - dy / 2) - top) / height}%`;
  style.width = `${100 * mm(dx * scene.columns) / width}%`;
  style.height = `${100 * mm(dy * scene.rows) / height}%`;
  for (const id of ["map", "layer-mean", "layer-deviation"])
    [$(id).width, $(id).height] = [scene.columns, scene.rows];
  for (const id of ["layer-mean", "layer-deviation"])
    $(id).style.aspectRatio = (dx * scene.columns) / (dy * scene.rows);
  new ResizeObserver(() => $("marks").style.setProperty("--unit", width / $("marks").clientWidth)).observe($("marks"));
}
function drawSkin() {  // what does not move
  const pads = scene.outlines.map((outline, k) => {
    const drawn = shape("path", { class: "pad", d: path(outline, true) });
    drawn.append(shape("title", {}, scene.pads[k]));
    return drawn;
  });
  const outlines = scene.electrode_outlines.map(corners =>
    shape("path", { class: "electrode-outline", d: path(corners, true) }));
  const electrodes = scene.electrodes.flatMap(([x, y], k) => [
    shape("path", { class: "electrode", d: `M${mm(x)} ${-mm(y)}h0` }),
    shape("text", { x: mm(x), y: -mm(y), dx: ".45em", dy: "-.35em", class: "number" }, String(k)),
  ]);
  const rim = shape("path", { class: "rim", d: path(scene.rim, true) });
  $("marks").replaceChildren(rim, ...pads, ...outlines, ...electrodes, shape("g", { id: "moving" }));
}
function colour(share) {  // uniform steps of lightness
  const s = Math.min(Math.max(share, 0), 1);
  return ink.low.map((low, k) => low + (ink.high[k] - low) * s);
}
let largestChange = 0;  // S; where the calibration does not tell the range
function fullColour() {
  const share = Number($("range").value);
  if ($("which").value === "map") return share * scene.full_pressure;
  return share * (scene.full_change || largestChange || 1e-30);
}
function paint(canvas, share) {  // the colours of all cells of the sheet, by their shares of full colour
  const image = new ImageData(scene.columns, scene.rows);
  for (let row = 0; row < scene.rows; row++) for (let column = 0; column < scene.columns; column++) {
    const cell = row * scene.columns + column, at = 4 * ((scene.rows - 1 - row) * scene.columns + column);
    if (scene.cells[cell]) image.data.set([...colour(share(cell)), 255], at);
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
}
function drawMap(result) {  // force per area, or how much the sheet's conductivity has changed
  const force = $("which").value === "map", values = floats(result[force ? "map" : "image"]);
  if (!force) largestChange = values.reduce((most, value) => Math.max(most, Math.abs(value)), largestChange);
  const full = fullColour();
  paint($("map"), cell => (force ? values[cell] / scene.cells[cell] : Math.abs(values[cell])) / full);
  tellScale(full, force);
}
function quantity(value, force) { return force ? `${plain(value / 1e3)} kPa` : `${value.toExponential(1)} S`; }
function tellScale(full, force) {
  setText("middle", quantity(full / 2, force));
  setText("full", `${quantity(full, force)} and more`);
  const share = Number($("range").value), part = share === 1 ? "" : `${plain(100 * share)} % of `;
  const fixed = `fixed: ${part}the range of the calibration's presses`;
  const about = force || scene.full_change ? fixed : `${part}the largest so far`;
  setText("scale", `${force ? "force per area" : "change of conductivity"}; scale ${about}` +
    `; ellipses hold a contact with 90 %` + ($("smooth").checked ? "; smoothed display" : ""));
  $("bar").setAttribute("aria-label", `colour scale from 0 to ${quantity(full, force)}`);
  $("map").className = $("smooth").checked ? "smooth" : "";
}
let layer = null;  // what contacts have told of the contact layer, and whether it is drawn
function drawLayer() {  // mean and standard deviation of the logarithm of its gain
  if (!layer || layer.drawn) return;
  const mean = floats(layer.mean), deviation = floats(layer.deviation);
  const { contacts, full_mean: high, full_deviation: most } = layer;
  $("layer").hidden = false;
  paint($("layer-mean"), cell => (mean[cell] + high) / (2 * high));
  paint($("layer-deviation"), cell => deviation[cell] / most);
  setText("layer-title", `log gain of the contact layer, learned from ${contacts} contact${contacts === 1 ? "" : "s"}`);
  setText("layer-low", `≤ −${plain(high)}`);
  setText("layer-high", `≥ ${plain(high)}`);
  setText("layer-most", `≥ ${plain(most)}`);
  const range = values => {
    const there = values.filter((_, cell) => scene.cells[cell]);
    return [Math.min, Math.max].map(end => fixed(there.reduce((a, b) => end(a, b)), 2)).join(" to ");
  };
  $("layer-mean").setAttribute("aria-label", `mean of the log gain of the contact layer, ${range(mean)}`);
  $("layer-deviation").setAttribute("aria-label", `standard deviation of the log gain, ${range(deviation)}`);
  layer.drawn = true;
}
function ellipseOf([[a, b], [, c]]) {  // of 90 %: its half axes (m), and the angle (rad) from x to the longer one
  const mean = (a + c) / 2, half = Math.hypot((a - c) / 2, b);
  const axis = variance => scene.radius * Math.sqrt(Math.max(variance, 0));
  return { longer: axis(mean + half), shorter: axis(mean - half), angle: Math.atan2(2 * b, a - c) / 2 };
}
function drawContact(contact) {
  const [x, y] = contact.position, { longer, shorter, angle } = ellipseOf(contact.covariance);
  const kind = contact.sure ? "contact" : "contact guess";
  const turn = `rotate(${-angle * 180 / Math.PI} ${mm(x)} ${-mm(y)})`;
  const parts = [
    shape("ellipse", { class: kind, cx: mm(x), cy: -mm(y), rx: mm(longer), ry: mm(shorter), transform: turn }),
    shape("path", { class: "dot", d: `M${mm(x)} ${-mm(y)}h0` }),
  ];
  if (contact.number === undefined) return parts;
  const [dx, dy] = contact.half;
  if (dx || dy) parts.push(shape("path", { class: "edge", d: path([[x - dx, y - dy], [x + dx, y + dy]]) }));
  return [...parts, label(`${contact.number}: ${contact.force.toFixed(1)} N`, x, y)];
}
function label(text, x, y) {  // on the side where there is room
  const right = x > (scene.bounds[0][0] + 3 * scene.bounds[1][0]) / 4;
  return shape("text", { class: "value", x: mm(x), y: -mm(y), dx: right ? "-1em" : "1em", dy: "-.7em",
    "text-anchor": right ? "end" : "start" }, text);
}
let trails = new Map();  // number of a contact that is followed: its last places
function keepTrails(result) {
  const now = result.host_ns / 1e9;
  for (const contact of result.contacts.filter(contact => contact.number !== undefined))
    trails.set(contact.number, [...(trails.get(contact.number) || []), [now, ...contact.position]]);
  for (const [number, trail] of trails) {
    const rest = trail.filter(row => now - TRAIL < row[0] && row[0] <= now);
    if (rest.length) trails.set(number, rest); else trails.delete(number);
  }
}
function drawMarks(result) {
  const places = [...trails.values()].map(trail => trail.map(([, x, y]) => [x, y]));
  const parts = places.map(points => shape("path", { class: "trail", d: path(points) }));
  parts.push(...result.contacts.flatMap(drawContact));
  if (!result.contacts.some(contact => contact.number !== undefined)) result.centre.forEach((c, pad) => {
    if (c[0] === null) return;
    if (!result.contacts.length) parts.push(shape("path", { class: "dot", d: `M${mm(c[0])} ${-mm(c[1])}h0` }));
    parts.push(label(`${result.force[pad].toFixed(1)} N`, ...c));
  });
  $("moving").replaceChildren(...parts);
  const sheet = `sheet with ${scene.pads.length} pads and ${scene.electrodes.length} electrodes`;
  $("marks").setAttribute("aria-label", `${sheet}; ${spoken(result)}`);
}

// --- tables ------------------------------------------------------------------------------------------------------

function rowOf(name, note, cells, bad) {
  const row = element("tr"), head = element("th", { scope: "row" }, name);
  if (note) head.append(element("small", { class: bad ? "bad" : "quiet" }, note));
  row.append(head, ...cells.map(text => element("td", {}, text)));
  return row;
}
function halfWidth(result, pad) {  // of the interval of 90 %
  return scene.rows ? result.half_width[pad] : (result.high[pad] - result.low[pad]) / 2;
}
function tablePads(result) {
  $("pads").replaceChildren(...scene.pads.map((name, pad) => {
    const force = result.force[pad], known = force !== null, centre = scene.rows ? result.centre[pad] : [null];
    const doubtful = result.faults && result.faults.length ? "doubtful" : "out of range";
    const note = result.valid[pad] ? "" : known ? doubtful : scene.rows ? "no pressure" : "no reading";
    const place = centre[0] === null ? "" : centre.map(x => mm(x).toFixed(0)).join(", ");
    const cells = [known ? fixed(force, 2) : "–", known ? `± ${halfWidth(result, pad).toFixed(2)}` : "–"];
    return rowOf(name, note, scene.rows ? [...cells, place] : cells, !result.valid[pad]);
  }));
  setText("total", fixed(sum(result.force), 2));
}
function tableContacts(result) {
  $("found").hidden = result.contacts_age === null;
  if (result.contacts.length) $("contact-force").hidden = result.contacts[0].number === undefined;
  $("contacts").replaceChildren(...result.contacts.map((contact, k) => {
    const place = [0, 1].map(i => withError(mm(contact.position[i]), mm(contact.standard_error[i])));
    const followed = contact.number !== undefined;
    const force = followed ? [withError(contact.force, contact.force_error)] : [];
    const name = String(followed ? contact.number : k + 1), note = contact.sure ? "" : "not round: a guess";
    return rowOf(name, note, [...place, ...force], false);
  }));
}
const KINDS = { none: "nothing", one: "one contact", two: "two contacts", edge: "an edge", more: "more contacts" };
function kindsOf(kinds) {  // what touches the skin, the most probable first
  if (kinds.unlike) return "what touches the skin: unlike all that the network was trained on";
  const told = Object.keys(KINDS).filter(kind => kinds[kind] >= 0.05).sort((a, b) => kinds[b] - kinds[a]);
  return `what touches the skin: ${told.map(kind => `${KINDS[kind]} ${(100 * kinds[kind]).toFixed(0)} %`).join(", ")}`;
}
function tellKinds(result) {
  $("kinds").hidden = !result.kinds;
  if (result.kinds) setText("kinds", kindsOf(result.kinds));
}
let worst = 0;  // ms, of the recent results
function tellPace(result) {
  worst = Math.max(0.99 * worst, result.latency_ms);
  const latency = `latency ${result.latency_ms.toFixed(1)} ms (recent worst ${worst.toFixed(1)})`;
  const counts = [latency, `frame ${result.number}`, `${result.dropped} skipped`];
  if (result.unsearched) counts.push(`contacts of ${result.unsearched} not fitted`);
  if (result.missing) counts.push(`${result.missing} ${scene.rows ? "readings" : "channels"} missing`);
  setText("pace", counts.join(", "));
}

// --- words for screen readers ------------------------------------------------------------------------------------

function spoken(result) {
  const total = `total ${sum(result.force).toFixed(0)} N`;
  const at = position => position.map(x => mm(x).toFixed(0)).join(", ");
  const found = (result.contacts || []).map(contact => {
    const about = contact.number === undefined ? "" : `${contact.number}: ${contact.force.toFixed(0)} N `;
    return `${about}at ${at(contact.position)} mm`;
  });
  const isLoaded = pad => result.force[pad] > 2 * halfWidth(result, pad);
  const told = scene.pads.map((name, pad) => isLoaded(pad) ? `${name} ${result.force[pad].toFixed(0)} N` : "");
  const loaded = told.filter(Boolean);
  if (!found.length && !loaded.length) return "no contact";
  const count = found.length ? [`${found.length} ${found.length === 1 ? "contact" : "contacts"}`, ...found] : [];
  return [...count, ...loaded, total].join("; ");
}
function say() { if (last && !paused && $("say").checked) setText("said", spoken(last)); }

// --- results and controls ----------------------------------------------------------------------------------------

function show() {  // the newest result
  if (!last || paused) return;
  if (scene.rows) { drawMap(last); drawMarks(last); tableContacts(last); tellKinds(last); }
  tablePads(last); tellPace(last);
}
function refresh() {
  if (!last) return;
  readColours();
  if (scene.rows) { drawMap(last); drawMarks(last); }
  if (layer) { layer.drawn = false; drawLayer(); }
  drawHistories();
}
function receive(event) {
  const news = JSON.parse(event.data);
  setText("state", [paused ? "paused" : "", news.about.state, news.about.health].filter(Boolean).join("; "));
  $("simulated").hidden = !news.about.simulated && !scene.simulated;
  if (news.layer) layer = news.layer;
  if (!paused) drawLayer();
  if (!news.result) return;
  if (scene.rows) keepTrails(news.result);
  keepHistories(news.result, news.about.lost || 0);
  if (!paused) { last = news.result; show(); }
}
function pause() {
  paused = !paused;
  $("pause").setAttribute("aria-pressed", paused);
  setText("state", paused ? "paused" : "running");
}
function offerRanges() {
  const force = $("which").value === "map", chosen = $("range").value || "1";
  const full = force ? scene.full_pressure : scene.full_change;
  $("range").replaceChildren(...RANGES.map(share => element("option", { value: share },
    full ? quantity(share * full, force) : `${plain(100 * share)} % of the largest`)));
  $("range").value = chosen;
}
function begin(found) {
  scene = found;
  setText("title", `${scene.skin}: ${scene.rows ? "force map" : "force"}`);
  document.title = `${scene.skin} live`;
  setText("view-title", scene.rows ? "Force map" : "Force");
  for (const id of ["fourth", "maps", "sum", "sheet", "pads-history"]) $(id).hidden = !scene.rows;
  $("alone").hidden = Boolean(scene.rows);
  if (!scene.rows) { setText("forces-title", "Force, N"); setText("first", "sensor"); }
  if (scene.rows) { scene.cells = floats(scene.areas); offerRanges(); layOut(); drawSkin(); }
  const results = new EventSource("/results");
  results.onmessage = receive;
  results.onerror = () => setText("state", "jaxeit live has stopped, or cannot be reached");
  setInterval(() => { if (last && !paused) drawHistories(); }, PLOT_INTERVAL);
  setInterval(say, SAY_INTERVAL);
}
$("pause").onclick = pause;
$("tare").onclick = () => fetch("/tare", { method: "POST" });
$("which").onchange = () => { offerRanges(); refresh(); };
$("smooth").onchange = $("range").onchange = refresh;
document.addEventListener("keydown", event => {  // a control that has the focus keeps its own space bar
  if (event.code !== "Space" || event.target.closest("button, input, select")) return;
  event.preventDefault();
  pause();
});
matchMedia("(prefers-color-scheme: dark)").onchange = refresh;
readColours();
fetch("/scene").then(reply => reply.json()).then(begin);
