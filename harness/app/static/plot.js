// The lines of the chosen channels: the server sends the extremes of each column of pixels of what is shown.

import { ask, said } from "./ask.js";

const place = document.getElementById("plot"), told = document.getElementById("plot-told");
const COLOURS = ["#2f77b4", "#d1641f", "#2c8a57", "#a8479c", "#a07c00", "#5b63c4"];
const HIGH = 130;
let script = null, now = null, whole = null, span = null, waiting = null, own = false;

function plotly() {
  script ??= new Promise((done, fail) => {
    const element = document.createElement("script");
    element.src = "plotly.js";
    element.onload = () => done(window.Plotly);
    element.onerror = () => fail(new Error("the plot's script cannot be loaded"));
    document.head.append(element);
  });
  return script;
}

// what: { name, clock, unit, step, channels: [{ title, label }] }
export async function show(what) {
  const other = !now || now.name !== what.name || now.clock !== what.clock || now.unit !== what.unit || now.step !== what.step;
  now = what;
  if (other) whole = span = null;
  await draw();
}

async function draw() {
  if (!now || !now.channels.length) {
    if (window.Plotly) window.Plotly.purge(place);
    told.textContent = "No channel is ticked.";
    return;
  }
  waiting?.abort();
  waiting = new AbortController();
  const query = new URLSearchParams({ name: now.name, clock: now.clock, unit: now.unit, step: now.step, pixels: Math.max(place.clientWidth, 200) });
  for (const one of now.channels) query.append("title", one.title);
  if (span) { query.set("from", span[0]); query.set("to", span[1]); }
  const [lines, library] = await Promise.all([ask(`lines?${query}`, { signal: waiting.signal }), plotly()]);
  const ends = lines.flatMap((one) => [one.t[0], one.t[one.t.length - 1]]).filter((value) => value != null);
  if (!whole && ends.length) whole = [Math.min(...ends), Math.max(...ends)];
  const style = getComputedStyle(document.body), ink = style.color, dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const grid = dark ? "#33404d" : "#e1e6eb", n = lines.length;
  const layout = {
    height: 60 + HIGH * n, margin: { l: 58, r: 8, t: 6, b: 40 }, showlegend: false, dragmode: "zoom", uirevision: now.name,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink, size: 12, family: style.fontFamily },
    xaxis: { range: span ?? whole, title: { text: now.clock || now.step ? "time [s]" : "row" }, gridcolor: grid, zeroline: false, anchor: `y${n > 1 ? n : ""}` },
  };
  lines.forEach((one, k) => {
    const gap = 0.06, high = (1 - gap * (n - 1)) / n, top = 1 - k * (high + gap);
    layout[`yaxis${k ? k + 1 : ""}`] = { domain: [Math.max(top - high, 0), top], fixedrange: true, gridcolor: grid, zeroline: false, nticks: 5, title: { text: now.channels[k].label, standoff: 4 } };
  });
  const traces = lines.map((one, k) => ({
    x: one.t, y: one.y, mode: "lines", line: { width: 1.2, color: COLOURS[k % COLOURS.length] }, name: now.channels[k].label,
    xaxis: "x", yaxis: `y${k ? k + 1 : ""}`, connectgaps: false, hovertemplate: "%{y:.5g} at %{x:.6g}<extra></extra>",
  }));
  own = true;
  await library.react(place, traces, layout, { responsive: true, displayModeBar: false, scrollZoom: false, doubleClick: false });
  own = false;
  if (!place.dataset.heard) {
    place.dataset.heard = "yes";
    place.on("plotly_relayout", (change) => {
      const from = change["xaxis.range[0]"], to = change["xaxis.range[1]"];
      if (!own && from != null && to != null) { span = [from, to]; said(draw)(); }
    });
    place.on("plotly_doubleclick", () => { span = null; said(draw)(); });
  }
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

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", said(draw));
let width = 0;
new ResizeObserver(() => {
  if (now && Math.abs(place.clientWidth - width) > 40) { width = place.clientWidth; said(draw)(); }
}).observe(place);
