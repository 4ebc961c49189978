"use strict";
// Histories of pads, contacts and health over the last minute.
const HISTORY = 60;  // s that the histories show
const HISTORY_STEP = 0.1;  // s between two points of a history
const MAX_GAP = 0.5;  // s without results that a line crosses
const MIN_SPAN = { N: 1, ms: 2, count: 1 };  // of the axis of a history, so that noise does not fill it
const COUNT = "contacts";  // name of the line that counts contacts which are not followed
const HALF_WIDTH = 1.645;  // standard errors, of half an interval of 90 %

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
    const interval = scene.rows ? [force - half, force + half] : [result.low[pad], result.high[pad]];
    keep("pads", name, [now, force, ...interval]);
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
  if (followed.length || haveForces()) delete lines.contacts[COUNT];
  else keep("contacts", COUNT, [now, result.contacts.length]);
  for (const one of followed) {
    const half = HALF_WIDTH * one.force_error;
    keep("contacts", `contact ${one.number}`, [now, one.force, one.force - half, one.force + half]);
  }
}
function haveForces() { return Object.keys(lines.contacts || {}).some(name => name !== COUNT); }  // of contacts
function keep(history, name, point) { ((lines[history] ||= {})[name] ||= []).push(point); }
function drawHistories() {
  const forces = haveForces();
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
  const pen = canvas.getContext("2d"), ratio = devicePixelRatio;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !history) return;
  if (canvas.width !== Math.round(ratio * width)) canvas.width = Math.round(ratio * width);
  if (canvas.height !== Math.round(ratio * height)) canvas.height = Math.round(ratio * height);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const known = Object.entries(history).map(([name, points]) => [name, points.filter(point => point[1] !== null)]);
  const values = known.flatMap(([, points]) => points.map(point => point[1]));  // intervals may reach beyond the axes
  const low = Math.min(0, ...values), high = Math.max(low + MIN_SPAN[unit], ...values), margin = 0.06 * (high - low);
  const left = 44, right = width - 8, top = 6, bottom = height - 20;
  const u = t => right - (right - left) * (now - t) / HISTORY;
  const v = f => bottom - (bottom - top) * (f - low) / (high + margin - low);
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
      const [upper, lower] = [3, 2].map(column => run.map(p => [u(p[0]), v(p[column])]));
      pen.globalAlpha = 0.2;
      trace(pen, [...upper, ...lower.reverse()]);
      pen.fill();
      pen.globalAlpha = 1;
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
function hue(name, k) {  // a contact keeps its colour
  return Number(name.match(/^contact (\d+)$/)?.[1] ?? k) % SERIES;
}
function nameLines(caption, lines, now) {  // names of the lines that go on, with their colours, behind the caption
  const goesOn = points => points.length && points.at(-1)[0] > now - MAX_GAP;
  const alive = lines.length < 2 ? [] : lines.filter(([, , points]) => goesOn(points));
  const known = [...caption.querySelectorAll("span")].map(span => span.textContent);
  if (known.join("\n") === alive.map(([name]) => name).join("\n")) return;
  caption.querySelectorAll("span").forEach(span => span.remove());
  caption.append(...alive.map(([name, colour]) => element("span", { class: `series-${colour}` }, name)));
}
function tellPlot(canvas, known) {  // what the picture shows, for those who do not see it
  const texts = known.filter(([, points]) => points.length).map(([name, points]) => {
    const largest = points.reduce((most, point) => Math.max(most, point[1]), -Infinity);
    return `${name} ${plain(points.at(-1)[1])}, largest ${plain(largest)}`;
  });
  const caption = canvas.previousElementSibling.firstChild.nodeValue;
  canvas.setAttribute("aria-label", `${caption}, last minute: ${texts.join("; ")}`);
}
