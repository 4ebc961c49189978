"use strict";
const $ = id => document.getElementById(id);
const HISTORY = 60;  // s that the histories show
const HISTORY_STEP = 0.1;  // s between two points of a history
const MAX_GAP = 0.5;  // s without results that a line crosses
const PLOT_INTERVAL = 200;  // ms between two pictures of the histories
const SAY_INTERVAL = 3000;  // ms between two texts for screen readers
const TRAIL = 2;  // s of a contact's path that its trail shows
const RANGES = [1, 1 / 3, 1 / 10];  // full colour, as shares of the calibrated range
const SERIES = 6;  // colours of lines, in page.css
const MIN_SPAN = { N: 1, ms: 2, count: 1 };  // of the axis of a history, so that noise does not fill it
let scene = null, last = null, paused = false, ink = {};

// --- texts, numbers and elements ------------------------------------------------------------------------------------

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

// --- the sheet: a grid of colours, and over it outlines, electrodes and contacts in millimetres, y upwards -----------

function pitch() {
  return [0, 1].map(k => (scene.high[k] - scene.low[k]) / ([scene.columns, scene.rows][k] - 1 || 1));
}
function path(points, closed = false) {
  return points.map(([x, y], k) => `${k ? "L" : "M"}${mm(x).toFixed(2)} ${(-mm(y)).toFixed(2)}`).join("") + (closed ? "Z" : "");
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
  [$("map").width, $("map").height] = [scene.columns, scene.rows];
  new ResizeObserver(() => $("marks").style.setProperty("--unit", width / $("marks").clientWidth)).observe($("marks"));
}
function drawSkin() {  // what does not move
  const pads = scene.outlines.map((outline, k) => {
    const drawn = shape("path", { class: "pad", d: path(outline, true) });
    drawn.append(shape("title", {}, scene.pads[k]));
    return drawn;
  });
  const outlines = scene.electrode_outlines.map(outline => shape("path", { class: "electrode-outline", d: path(outline, true) }));
  const electrodes = scene.electrodes.flatMap(([x, y], k) => [
    shape("path", { class: "electrode", d: `M${mm(x)} ${-mm(y)}h0` }),
    shape("text", { x: mm(x), y: -mm(y), dx: ".45em", dy: "-.35em", class: "number" }, String(k)),
  ]);
  $("marks").replaceChildren(shape("path", { class: "rim", d: path(scene.rim, true) }), ...pads, ...outlines, ...electrodes,
    shape("g", { id: "moving" }));
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
function drawMap(result) {  // force per area, or how much the sheet's conductivity has changed
  const force = $("which").value === "map", values = floats(result[force ? "map" : "image"]), areas = scene.cells;
  if (!force && !scene.full_change) largestChange = values.reduce((most, v) => Math.max(most, Math.abs(v)), largestChange);
  const full = fullColour(), image = new ImageData(scene.columns, scene.rows);
  for (let row = 0; row < scene.rows; row++) for (let column = 0; column < scene.columns; column++) {
    const cell = row * scene.columns + column, at = 4 * ((scene.rows - 1 - row) * scene.columns + column);
    if (!areas[cell]) continue;  // outside of the sheet
    image.data.set([...colour((force ? values[cell] / areas[cell] : Math.abs(values[cell])) / full), 255], at);
  }
  $("map").getContext("2d").putImageData(image, 0, 0);
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
function ellipseOf([[a, b], [, c]]) {  // half axes (m), and angle (rad) from x to the longer one, of the ellipse of 90 %
  const mean = (a + c) / 2, half = Math.hypot((a - c) / 2, b);
  const axis = variance => scene.radius * Math.sqrt(Math.max(variance, 0));
  return { longer: axis(mean + half), shorter: axis(mean - half), angle: Math.atan2(2 * b, a - c) / 2 };
}
function drawContact(contact) {
  const [x, y] = contact.position, { longer, shorter, angle } = ellipseOf(contact.covariance);
  const parts = [
    shape("ellipse", { class: contact.sure ? "contact" : "contact guess", cx: mm(x), cy: -mm(y), rx: mm(longer), ry: mm(shorter),
      transform: `rotate(${-angle * 180 / Math.PI} ${mm(x)} ${-mm(y)})` }),
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
  const parts = [...trails.values()].map(trail => shape("path", { class: "trail", d: path(trail.map(row => row.slice(1))) }));
  parts.push(...result.contacts.flatMap(drawContact));
  if (!result.contacts.some(contact => contact.number !== undefined)) result.centre.forEach((c, pad) => {
    if (c[0] === null) return;
    if (!result.contacts.length) parts.push(shape("path", { class: "dot", d: `M${mm(c[0])} ${-mm(c[1])}h0` }));
    parts.push(label(`${result.force[pad].toFixed(1)} N`, ...c));
  });
  $("moving").replaceChildren(...parts);
  $("marks").setAttribute("aria-label", `sheet with ${scene.pads.length} pads and ${scene.electrodes.length} electrodes; ${spoken(result)}`);
}

// --- tables ---------------------------------------------------------------------------------------------------------

function rowOf(name, note, cells, bad) {
  const row = element("tr"), head = element("th", { scope: "row" }, name);
  if (note) head.append(element("small", { class: bad ? "bad" : "quiet" }, note));
  row.append(head, ...cells.map(text => element("td", {}, text)));
  return row;
}
function halfWidth(result, pad) { return scene.rows ? result.half_width[pad] : (result.high[pad] - result.low[pad]) / 2; }
function tablePads(result) {
  $("pads").replaceChildren(...scene.pads.map((name, pad) => {
    const force = result.force[pad], known = force !== null, centre = scene.rows ? result.centre[pad] : [null];
    const note = result.valid[pad] ? "" : known ? "out of range" : scene.rows ? "no pressure" : "no reading";
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
    return rowOf(String(followed ? contact.number : k + 1), contact.sure ? "" : "not round: a guess", [...place, ...force], false);
  }));
}
let worst = 0;  // ms, of the recent results
function tellPace(result) {
  worst = Math.max(0.99 * worst, result.latency_ms);
  const counts = [`latency ${result.latency_ms.toFixed(1)} ms (recent worst ${worst.toFixed(1)})`, `frame ${result.number}`,
    `${result.dropped} skipped`];
  if (result.unsearched) counts.push(`contacts of ${result.unsearched} not fitted`);
  if (result.missing) counts.push(`${result.missing} ${scene.rows ? "readings" : "channels"} missing`);
  setText("pace", counts.join(", "));
}

// --- histories ------------------------------------------------------------------------------------------------------

let lines = {}, stored = -Infinity;  // lines: of each history, name of a line: [time, value, low, high]
let counted = null, latest = 0;  // frames that were lost until the last point; largest latency since then, ms
function keepHistories(result, lost) {
  const now = result.host_ns / 1e9;
  latest = Math.max(latest, result.latency_ms);
  if (now < stored) lines = {};  // another run
  if (now < stored + HISTORY_STEP && now >= stored) return;
  stored = now;
  scene.pads.forEach((name, pad) => {
    const force = result.force[pad], half = force === null ? 0 : halfWidth(result, pad);
    keep("pads", name, scene.rows ? [now, force, force - half, force + half] : [now, force, result.low[pad], result.high[pad]]);
  });
  if (scene.rows && result.contacts_age !== null) keepContacts(result, now);
  keep("latency", "latency", [now, latest]);
  const gone = result.dropped + lost;
  keep("losses", "frames", [now, counted === null ? 0 : Math.max(0, gone - counted)]);
  keep("losses", scene.rows ? "readings of the frame" : "channels", [now, result.missing]);
  [counted, latest] = [gone, 0];
  for (const history of Object.values(lines)) for (const [name, points] of Object.entries(history)) {
    while (points.length && points[0][0] < now - HISTORY) points.shift();
    if (!points.length) delete history[name];
  }
}
function keepContacts(result, now) {
  const followed = result.contacts.filter(contact => contact.number !== undefined);
  lines.contacts ||= {};
  if (!followed.length && !Object.keys(lines.contacts).some(name => name !== "contacts")) keep("contacts", "contacts", [now, result.contacts.length]);
  else delete lines.contacts.contacts;
  for (const one of followed)
    keep("contacts", `contact ${one.number}`, [now, one.force, one.force - 1.645 * one.force_error, one.force + 1.645 * one.force_error]);
}
function keep(history, name, point) { ((lines[history] ||= {})[name] ||= []).push(point); }
function drawHistories() {
  const forces = Object.keys(lines.contacts || {}).some(name => name !== "contacts");
  $("contacts-history").hidden = !lines.contacts;
  setCaption("contacts-history", forces ? "force of the contacts, N" : "number of contacts");
  if (!scene.rows) plot($("curve"), lines.pads, "N", stored);
  else plot($("pads-history").lastElementChild, lines.pads, "N", stored);
  if (lines.contacts) plot($("contacts-history").lastElementChild, lines.contacts, forces ? "N" : "count", stored);
  plot($("latency-history").lastElementChild, lines.latency, "ms", stored);
  plot($("losses-history").lastElementChild, lines.losses, "count", stored);
}
function setCaption(id, text) {
  const caption = $(id).querySelector("figcaption");
  if (caption.firstChild?.nodeValue !== text) caption.replaceChildren(text);
}
function stepOf(span, unit) {  // between marks of an axis: 1, 2 or 5 times a power of ten, three to six of them
  const power = 10 ** Math.floor(Math.log10(span / 3));
  const step = [5, 2, 1].map(k => k * power).find(step => span / step >= 3) || power;
  return unit === "count" ? Math.max(1, Math.round(step)) : step;
}
function plot(canvas, history, unit, now) {  // lines over the last minute, each with its name where it ends
  const ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight, pen = canvas.getContext("2d");
  if (!width || !history) return;
  if (canvas.width !== Math.round(ratio * width)) canvas.width = Math.round(ratio * width);
  if (canvas.height !== Math.round(ratio * height)) canvas.height = Math.round(ratio * height);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const known = Object.entries(history).map(([name, points]) => [name, points.filter(point => point[1] !== null)]);
  const values = known.flatMap(([, points]) => points.map(point => point[1]));  // intervals may reach beyond the axes
  const low = Math.min(0, ...values), high = Math.max(low + MIN_SPAN[unit], ...values), pad = 0.06 * (high - low);
  const left = 44, right = width - 8, top = 6, bottom = height - 20;
  const u = t => right - (right - left) * (now - t) / HISTORY, v = f => bottom - (bottom - top) * (f - low) / (high + pad - low);
  drawAxes(pen, { left, right, bottom, u, v, low, high, now, unit });
  pen.save();
  pen.beginPath(); pen.rect(left, top, right - left, bottom - top + 1); pen.clip();
  known.forEach(([name, points], k) => drawLine(pen, points, ink.series[hue(name, k)], u, v));
  pen.restore();
  nameLines(canvas.previousElementSibling, known.map(([name, points], k) => [name, hue(name, k), points]), now);
  tellPlot(canvas, known);
}
function drawAxes(pen, { left, right, bottom, u, v, low, high, now, unit }) {
  pen.font = "12px system-ui, sans-serif";
  pen.fillStyle = ink.quiet; pen.strokeStyle = ink.line; pen.lineWidth = 1;
  const step = stepOf(high - low, unit);
  pen.textAlign = "right";
  for (let f = Math.ceil(low / step) * step; f <= high; f += step) {
    pen.beginPath(); pen.moveTo(left, v(f)); pen.lineTo(right, v(f)); pen.stroke();
    pen.fillText(String(Number(f.toPrecision(3))), left - 6, v(f) + 4);
  }
  for (let t = 0; t <= HISTORY; t += 20) {
    pen.textAlign = t ? t === HISTORY ? "left" : "center" : "right";
    pen.fillText(t ? `−${t} s` : "now", u(now - t), bottom + 15);
  }
}
function drawLine(pen, points, hue, u, v) {
  pen.fillStyle = pen.strokeStyle = hue;
  pen.lineWidth = 1.6;
  for (const run of runsOf(points)) {
    if (run[0].length > 2) {
      pen.globalAlpha = 0.2; trace(pen, [...run.map(p => [u(p[0]), v(p[3])]), ...run.map(p => [u(p[0]), v(p[2])]).reverse()]);
      pen.fill(); pen.globalAlpha = 1;
    }
    trace(pen, run.map(p => [u(p[0]), v(p[1])]));
    pen.stroke();
  }
}
function trace(pen, places) { pen.beginPath(); places.forEach((place, k) => pen[k ? "lineTo" : "moveTo"](...place)); }
function runsOf(points) {  // no line crosses a time without results
  const runs = [];
  points.forEach((point, k) => {
    if (!k || point[0] - points[k - 1][0] > MAX_GAP) runs.push([]);
    runs.at(-1).push(point);
  });
  return runs;
}
function hue(name, k) { return (Number(name.match(/^contact (\d+)$/)?.[1] ?? k)) % SERIES; }  // a contact keeps its colour
function nameLines(caption, lines, now) {  // names of the lines that go on, with their colours, behind the caption
  const alive = lines.length < 2 ? [] : lines.filter(([, , points]) => points.length && points.at(-1)[0] > now - MAX_GAP);
  const known = [...caption.querySelectorAll("span")].map(span => span.textContent);
  if (known.join("\n") === alive.map(([name]) => name).join("\n")) return;
  caption.querySelectorAll("span").forEach(span => span.remove());
  caption.append(...alive.map(([name, colour]) => element("span", { class: `series-${colour}` }, name)));
}
function tellPlot(canvas, known) {  // what the picture shows, for those who do not see it
  const texts = known.filter(([, points]) => points.length).map(([name, points]) =>
    `${name} ${plain(points.at(-1)[1])}, largest ${plain(points.reduce((most, point) => Math.max(most, point[1]), -Infinity))}`);
  canvas.setAttribute("aria-label", `${canvas.previousElementSibling.firstChild.nodeValue}, last minute: ${texts.join("; ")}`);
}

// --- words for screen readers -----------------------------------------------------------------------------------------

function spoken(result) {
  const total = `total ${sum(result.force).toFixed(0)} N`;
  const at = position => position.map(x => mm(x).toFixed(0)).join(", ");
  const found = (result.contacts || []).map(contact => (contact.number === undefined ? "" : `${contact.number}: ${contact.force.toFixed(0)} N `) +
    `at ${at(contact.position)} mm`);
  const loaded = scene.pads.flatMap((name, pad) => result.force[pad] > 2 * halfWidth(result, pad) ? [`${name} ${result.force[pad].toFixed(0)} N`] : []);
  if (!found.length && !loaded.length) return "no contact";
  const count = found.length ? [`${found.length} ${found.length === 1 ? "contact" : "contacts"}`, ...found] : [];
  return [...count, ...loaded, total].join("; ");
}
function say() { if (last && !paused && $("say").checked) setText("said", spoken(last)); }

// --- results and controls ---------------------------------------------------------------------------------------------

function show() {  // the newest result
  if (!last || paused) return;
  if (scene.rows) { drawMap(last); drawMarks(last); tableContacts(last); }
  tablePads(last); tellPace(last);
}
function refresh() { if (last) { readColours(); if (scene.rows) { drawMap(last); drawMarks(last); } drawHistories(); } }
function receive(event) {
  const news = JSON.parse(event.data);
  setText("state", [paused ? "paused" : "", news.about.state, news.about.health].filter(Boolean).join("; "));
  $("simulated").hidden = !news.about.simulated && !scene.simulated;
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
  const force = $("which").value === "map", chosen = $("range").value || "1", full = force ? scene.full_pressure : scene.full_change;
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
