// What runs and what has run: stages as they come, results to look at, to compare and to keep.

import { ask, complain, make, said, send } from "./ask.js";

const fits = document.getElementById("fits"), list = document.getElementById("list"), compare = document.getElementById("compare");
const shown = document.getElementById("shown"), frame = document.getElementById("frame"), text = document.getElementById("shown-text");
const jobs = new Map(), ticked = new Set();
const NAMES = { "close-loop": "What the model lacks", identify: "Fit", compare: "Comparison", export: "Export", "check-data": "Check" };
const hearers = [];

export const hear = (hearer) => hearers.push(hearer);
export const busy = () => [...jobs.values()].some((job) => job.task !== "check-data" && ["running", "cancelling"].includes(job.status));

export function take(job) {
  const before = jobs.get(job.id);
  jobs.set(job.id, job);
  for (const hearer of hearers) hearer(job, before);
  if (job.task === "check-data") return;
  fits.hidden = false;
  const fresh = card(job), old = document.getElementById(`job-${job.id}`);
  const focused = old?.contains(document.activeElement) ? document.activeElement.dataset.key : null;
  const open = [...(old?.querySelectorAll("details") ?? [])].map((one) => one.open);
  if (old) old.replaceWith(fresh); else list.prepend(fresh);
  fresh.querySelectorAll("details").forEach((one, k) => { one.open = open[k] ?? one.open; });
  if (focused) fresh.querySelector(`[data-key="${focused}"]`)?.focus();
  const stages = fresh.querySelector(".stages");
  if (stages) stages.scrollTop = stages.scrollHeight;
  if (before && before.status !== job.status && job.status === "done") said(look)(job);
}

function card(job) {
  const running = ["running", "cancelling"].includes(job.status), fit = ["close-loop", "identify"].includes(job.task);
  const state = { running: `running, ${job.seconds.toFixed(0)} s`, cancelling: "being cancelled", done: `done in ${job.seconds.toFixed(0)} s` }[job.status] ?? job.status;
  const button = (key, words, work) => make("button", { type: "button", "data-key": key, onclick: said(work), "aria-label": `${words}: run ${job.number}` }, words);
  return make("li", { id: `job-${job.id}` },
    make("div", { class: "head" },
      fit && job.status === "done" ? make("input", { type: "checkbox", "data-key": "tick", checked: ticked.has(job.id), "aria-label": `Compare run ${job.number}`, onchange: (event) => tick(job.id, event.target.checked) }) : null,
      make("b", {}, `${job.number}. ${NAMES[job.task]}: ${job.title}`),
      make("span", { class: `state ${job.status}`, role: "status" }, state)),
    running ? make("progress", { "aria-label": `Progress of run ${job.number}`, max: 1, value: job.fraction || null }) : null,
    job.stages.length ? make("details", { open: running }, make("summary", {}, job.stages.length === 1 ? "1 stage" : `${job.stages.length} stages`),
      make("ol", { class: "stages" }, ...job.stages.map((one) => make("li", {}, make("span", {}, `${one.at.toFixed(1)} s`), one.what)))) : null,
    job.error ? make("div", { class: "error" }, job.error) : null,
    job.notes.length ? make("details", {}, make("summary", {}, job.notes.length === 1 ? "1 note" : `${job.notes.length} notes`), ...job.notes.map((one) => make("p", { class: "note" }, one))) : null,
    make("div", { class: "row" },
      running ? button("cancel", "Cancel", async () => take(await send("cancel", [job.id]))) : null,
      job.status === "done" || (!running && job.files.length) ? button("look", "Show", () => look(job)) : null,
      fit && job.status === "done" ? button("export", "Export as FMU", async () => take(await send("export", [job.id]))) : null,
      job.command ? button("again", "Copy the command", () => navigator.clipboard.writeText(job.command)) : null));
}

function tick(id, on) {
  if (on) ticked.add(id); else ticked.delete(id);
  compare.disabled = ticked.size < 2;
}

compare.addEventListener("click", said(async () => take(await send("compare", [...ticked].sort((a, b) => a - b)))));

async function look(job) {
  const found = await ask(`text?job=${job.id}`), page = job.files.find((name) => name.endsWith(".html"));
  shown.hidden = false;
  document.getElementById("shown-title").textContent = `${NAMES[job.task]} ${job.number}: ${job.title}`;
  text.hidden = Boolean(page);
  text.textContent = found.text;
  frame.hidden = !page;
  if (page) frame.src = `result/${job.id}/${page}`;
  const kept = job.files.map((name) => make("a", { href: `result/${job.id}/${name}?keep`, download: name.split("/").pop() }, name));
  document.getElementById("shown-files").replaceChildren(...(kept.length ? [make("span", { class: "soft" }, "Keep:"), ...kept] : []));
  shown.scrollIntoView({ block: "start" });
  shown.focus({ preventScroll: true });
}

export function listen() {
  const events = new EventSource("events");
  events.onmessage = (event) => take(JSON.parse(event.data));
  events.onerror = () => { if (events.readyState === EventSource.CLOSED) complain("sysid open has ended; start it again"); };
}
