// The lines of the chosen channels: the server sends the extremes of each column of pixels of what is shown.

import { ask, said } from "./ask.js";

const place = document.getElementById("plot"), told = document.getElementById("plot-told");
const LIGHT = ["#2f77b4", "#d1641f", "#2c8a57", "#a8479c", "#a07c00", "#5b63c4"];
const DARK = ["#6cb4ec", "#f0915a", "#6cc793", "#dc8ad0", "#d6b44a", "#a3a9f2"];  // at least 6:1 on the dark paper
const dark = matchMedia("(prefers-color-scheme: dark)");
const colour = (k) => (dark.matches ? DARK : LIGHT)[k % LIGHT.length];
const HIGH = 124, GAP = 12, LEFT = 66, RIGHT = 8, TOP = 6, BOTTOM = 40;
let now = null, whole = null, span = null, waiting = null, drawn = null;

function part(name, attributes, ...inside) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...inside);
  return element;
}

// Round values between two ends, about so many of them: steps of 1, 2 or 5 times a power of ten.
function ticks(low, high, many) {
  const rough = (high - low) / many, size = 10 ** Math.floor(Math.log10(rough)), share = rough / size;
  const step = size * (share > 5 ? 10 : share > 2 ? 5 : share > 1 ? 2 : 1), found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step && found.length < 50; k++) found.push(k * step);
  return { step, values: found };
}

function written(value, step) {
  if (Math.abs(value) < step / 1e6) return "0";
  const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Math.abs(value) >= 1e6 || places > 5 ? value.toExponential(2).replace(/\.?0+e/, "e") : value.toFixed(places);
}

// One path for a channel; the pen is lifted where nothing was recorded.
function line(one, x, y) {
  let path = "", down = false;
  for (let k = 0; k < one.t.length; k++) {
    down = one.y[k] != null && (path += `${down ? "L" : "M"}${x(one.t[k]).toFixed(1)} ${y(one.y[k]).toFixed(1)}`, true);
  }
  return path;
}

function picture(lines) {
  const wide = Math.max(place.clientWidth, 200), n = lines.length, high = TOP + n * HIGH + (n - 1) * GAP + BOTTOM;
  const [from, to] = span ?? whole ?? [0, 1], x = (t) => LEFT + (t - from) / (to - from || 1) * (wide - LEFT - RIGHT);
  const svg = part("svg", { width: wide, height: high, viewBox: `0 0 ${wide} ${high}`, class: "lines" });
  const clock = ticks(from, to, wide / 110);
  lines.forEach((one, k) => {
    const top = TOP + k * (HIGH + GAP), foot = top + HIGH, values = one.y.filter((value) => value != null);
    let low = values.reduce((a, b) => Math.min(a, b), Infinity), peak = values.reduce((a, b) => Math.max(a, b), -Infinity);
    if (!(peak >= low)) [low, peak] = [0, 1];
    const room = (peak - low) * 0.05 || Math.abs(peak) * 0.05 || 1;
    [low, peak] = [low - room, peak + room];
    const y = (value) => foot - (value - low) / (peak - low) * HIGH, marks = ticks(low, peak, 4), grid = part("g", { class: "grid" });
    for (const t of clock.values) grid.append(part("line", { x1: x(t), x2: x(t), y1: top, y2: foot }));
    for (const value of marks.values) {
      grid.append(part("line", { x1: LEFT, x2: wide - RIGHT, y1: y(value), y2: y(value) }));
      svg.append(part("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, written(value, marks.step)));
    }
    svg.prepend(grid);
    svg.append(part("text", { x: -(top + HIGH / 2), y: 13, transform: "rotate(-90)", "text-anchor": "middle", class: "label" }, now.channels[k].label));
    const clip = part("clipPath", { id: `part-${k}` }, part("rect", { x: LEFT, y: top, width: wide - LEFT - RIGHT, height: HIGH }));
    svg.append(clip, part("path", { d: line(one, x, y), stroke: colour(k), "clip-path": `url(#part-${k})` }));
  });
  const foot = high - BOTTOM;
  for (const t of clock.values) svg.append(part("text", { x: x(t), y: foot + 16, "text-anchor": "middle" }, written(t, clock.step)));
  svg.append(part("text", { x: (LEFT + wide - RIGHT) / 2, y: high - 6, "text-anchor": "middle" }, now.clock || now.step ? "time [s]" : "row"));
  svg.append(part("rect", { class: "chosen", x: 0, y: TOP, width: 0, height: foot - TOP }), part("line", { class: "here", x1: -9, x2: -9, y1: TOP, y2: foot }));
  svg.append(part("text", { class: "reading", x: wide - RIGHT - 4, y: TOP + 12, "text-anchor": "end" }));
  place.replaceChildren(svg);
  drawn = { lines, from, to, wide };
}

const timeAt = (event) => {
  const at = (event.clientX - place.getBoundingClientRect().left - LEFT) / (drawn.wide - LEFT - RIGHT);
  return drawn.from + Math.min(Math.max(at, 0), 1) * (drawn.to - drawn.from);
};
const pixel = (t) => LEFT + (t - drawn.from) / (drawn.to - drawn.from || 1) * (drawn.wide - LEFT - RIGHT);
let begun = null;

place.addEventListener("pointerdown", (event) => {
  if (!drawn || event.button || event.pointerType === "touch") return;
  begun = timeAt(event);
  place.setPointerCapture(event.pointerId);
});
place.addEventListener("pointermove", (event) => {
  if (!drawn) return;
  const t = timeAt(event), here = place.querySelector(".here"), chosen = place.querySelector(".chosen");
  here.setAttribute("x1", pixel(t)); here.setAttribute("x2", pixel(t));
  const values = drawn.lines.map((one) => {
    let low = 0, high = one.t.length - 1;
    while (high - low > 1) { const middle = (low + high) >> 1; if (one.t[middle] <= t) low = middle; else high = middle; }
    const near = Math.abs(one.t[high] - t) < Math.abs(one.t[low] - t) ? high : low;
    return one.y[near] == null ? "-" : Number(one.y[near].toPrecision(5)).toString();
  });
  place.querySelector(".reading").textContent = `${values.join(", ")} at ${Number(t.toPrecision(6))}`;
  if (begun != null) { chosen.setAttribute("x", Math.min(pixel(begun), pixel(t))); chosen.setAttribute("width", Math.abs(pixel(t) - pixel(begun))); }
});
place.addEventListener("pointerup", said(async (event) => {
  if (begun == null) return;
  const ends = [begun, timeAt(event)].sort((a, b) => a - b);
  begun = null;
  if (pixel(ends[1]) - pixel(ends[0]) < 6) { place.querySelector(".chosen").setAttribute("width", 0); return; }
  span = ends;
  await draw();
}));
place.addEventListener("pointerleave", () => {
  if (!drawn || begun != null) return;
  place.querySelector(".reading").textContent = "";
  place.querySelector(".here").setAttribute("x1", -9); place.querySelector(".here").setAttribute("x2", -9);
});
dark.addEventListener("change", said(draw));
place.addEventListener("dblclick", said(async () => { span = null; await draw(); }));

// what: { name, clock, unit, step, channels: [{ title, label }] }
export async function show(what) {
  const other = !now || now.name !== what.name || now.clock !== what.clock || now.unit !== what.unit || now.step !== what.step;
  now = what;
  if (other) whole = span = null;
  await draw();
}

async function draw() {
  if (!now || !now.channels.length) {
    place.replaceChildren();
    drawn = null;
    told.textContent = "No channel is ticked.";
    return;
  }
  waiting?.abort();
  waiting = new AbortController();
  const query = new URLSearchParams({ name: now.name, clock: now.clock, unit: now.unit, step: now.step, pixels: Math.max(place.clientWidth, 200) });
  for (const one of now.channels) query.append("title", one.title);
  if (span) { query.set("from", span[0]); query.set("to", span[1]); }
  const lines = await ask(`lines?${query}`, { signal: waiting.signal });
  const ends = lines.flatMap((one) => [one.t[0], one.t[one.t.length - 1]]).filter((value) => value != null);
  if (!whole && ends.length) whole = [Math.min(...ends), Math.max(...ends)];
  picture(lines);
  const rows = Math.max(...lines.map((one) => one.rows)), [low, high] = span ?? whole ?? [0, 0];
  told.textContent = `${lines.map((one, k) => now.channels[k].label).join(", ")}: ${rows.toLocaleString("en")} rows from ${low.toPrecision(5)} to ${high.toPrecision(5)}. Drag to look closer, double-click for all.`;
}

document.getElementById("plot-keys").addEventListener("click", said(async (event) => {
  const move = event.target.dataset.move;
  if (!move || !whole) return;
  const [low, high] = span ?? whole, length = high - low, middle = (low + high) / 2;
  if (move === "in") span = [middle - length / 4, middle + length / 4];
  if (move === "out") span = [middle - length, middle + length];
  if (move === "left") span = [low - length / 2, high - length / 2];
  if (move === "right") span = [low + length / 2, high + length / 2];
  if (move === "whole" || !span) span = null;
  else if (span[1] - span[0] >= whole[1] - whole[0]) span = null;
  else {
    const over = Math.max(whole[0] - span[0], 0) - Math.max(span[1] - whole[1], 0);
    span = [span[0] + over, span[1] + over];
  }
  await draw();
}));

let width = 0;
new ResizeObserver(() => {
  if (now && Math.abs(place.clientWidth - width) > 40) { width = place.clientWidth; said(draw)(); }
}).observe(place);
