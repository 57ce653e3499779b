// The steps: log, channels, model, run.

import { ask, complain, make, option, quiet, said, send } from "./ask.js";
import { show } from "./plot.js";
import { busy, hear, listen, take } from "./runs.js";

const at = (id) => document.getElementById(id);
const state = { session: null, log: null, content: null, columns: [], ports: [], matched: {}, stated: {}, model: "", check: null };
const SHOWN = 4, PHYSICAL = "output-error";
let openings = 0; // of logs: what was asked for last is shown, whatever is read first
let begun;
const session = new Promise((resolve) => { begun = resolve; });

const number = (value) => (value == null ? "" : Number(value.toPrecision(4)).toString());
const isToml = () => Boolean(state.content?.described);

// ---- the log ----------------------------------------------------------------------------------------------------

async function upload(file, after) {
  quiet();
  const log = !isModel(file.name);
  if (log) {
    openings += 1;
    at("facts").replaceChildren(make("p", { class: "soft" }, `reading ${file.name} ...`));
  }
  try {
    await session;
    const found = await ask(`upload?name=${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
    Object.assign(state.session, { logs: found.logs, models: found.models });
    fillPicks();
    await after(found.name);
  } catch (error) {
    if (log) at("facts").replaceChildren();
    throw error;
  }
}

const isModel = (name) => /\.(urdf|fmu|eqs)$/i.test(name);
const dropped = said(async (file) => upload(file, isModel(file.name) ? chooseModel : openLog));

function fillPicks() {
  const { logs, models, catalogue } = state.session;
  at("pick").replaceChildren(option("", "-- choose --"), ...logs.map((name) => option(name, name.replace(/^uploaded\/\d+\//, ""), name === state.log)));
  at("pick-field").hidden = !logs.length;
  const groups = [make("optgroup", { label: "Catalogue" }, ...catalogue.map((one) => option(one.id, one.id, one.id === state.model)))];
  if (models.length) groups.push(make("optgroup", { label: "Files" }, ...models.map((name) => option(name, name.replace(/^uploaded\/\d+\//, ""), name === state.model))));
  at("model-pick").replaceChildren(option("", isToml() ? "the one that the data set names" : "none (linear, from the data)"), ...groups);
  const others = logs.filter((name) => name !== state.log && !name.endsWith(".toml"));
  const before = at("validation").value;
  at("validation").replaceChildren(option("", "the last third of this log"), ...others.map((name) => option(name, name.replace(/^uploaded\/\d+\//, ""), name === before)));
}

async function openLog(name) {
  quiet();
  if (!name) return;
  openings += 1;
  const turn = openings;
  at("facts").replaceChildren(make("p", { class: "soft" }, `reading ${name} ...`));
  const content = await ask(`log?name=${encodeURIComponent(name)}`).catch((error) => { at("facts").replaceChildren(); throw error; });
  if (turn !== openings) return;
  Object.assign(state, { log: name, content, check: null });
  fillPicks();
  at("facts").replaceChildren(...content.facts.map((fact) => make("p", {}, fact)));
  const clock = content.clock;
  const titled = (channel) => ({ ...channel, title: channel.column, use: "", port: "", given: "", shown: false });
  state.columns = content.channels.map(titled);
  if (clock) state.columns.unshift({ ...titled({ column: clock, name: clock, unit: "", note: "" }), use: "time" });
  state.columns.filter((one) => one.use !== "time" && !one.note.includes(":")).slice(0, SHOWN).forEach((one) => { one.shown = true; });
  for (const id of ["channels", "model", "run"]) at(id).hidden = false;
  at("step").value = "";
  if (isToml()) { state.model = ""; state.ports = []; }
  await match();
}

// ---- the model --------------------------------------------------------------------------------------------------

const chooseModel = async (name) => {
  quiet();
  state.model = name;
  at("trusted").checked = false;
  fillPicks();
  await match();
};

let matching = 0;
async function match() {
  const isFmu = /\.fmu$/i.test(state.model);
  at("trust").hidden = !isFmu;
  const query = new URLSearchParams({ name: state.model, log: state.log ?? "" });
  let found = { ports: [], matched: {} };
  const mine = ++matching;
  at("table").inert = true;
  at("go").disabled = true;
  if (state.model) at("model-told").textContent = `reading ${state.model.split("/").pop()} ...`;
  try { if (state.model) found = await ask(`model?${query}`); } catch (error) { state.model = ""; fillPicks(); at("trust").hidden = true; complain(error.message); }
  if (mine !== matching) return;
  at("table").inert = false;
  state.ports = found.ports; state.matched = found.matched ?? {}; state.stated = found.stated ?? {};
  fillIdentifiers();
  const known = state.session.catalogue.find((one) => one.id === state.model);
  at("model-told").textContent = isToml() && !state.model ? (state.content.model ? `The data set names ${state.content.model}.` : "")
    : state.model ? (known?.summary ?? "") : "Inputs and outputs are those that you choose above.";
  for (const one of state.columns) {
    if (one.use === "time") continue;
    const port = state.matched[one.title], told = state.ports.find((p) => p.name === port);
    if (state.ports.length) { one.use = told?.use ?? ""; one.port = told?.name ?? ""; if (told) one.shown = true; }
    else one.port = "";
  }
  fillTable();
  changed();
}

function fillUndriven() {
  const taken = new Set(state.columns.map((one) => one.port));
  const open = isToml() ? [] : state.ports.filter((one) => one.use === "input" && !taken.has(one.name));
  const before = new Set([...at("undriven").querySelectorAll("input:checked")].map((one) => one.value));
  at("undriven").hidden = !open.length;
  at("undriven").replaceChildren(at("undriven").querySelector("legend"), ...open.map((one) => make("div", {},
    make("input", { type: "checkbox", id: `undriven-${one.name}`, value: one.name, checked: before.has(one.name), onchange: () => changed() }),
    make("label", { for: `undriven-${one.name}` }, `nothing drove ${one.name} [${one.unit}]`))));
}

// ---- the channels -----------------------------------------------------------------------------------------------

function uses(one) {
  const found = [option("", "not used", !one.use), option("time", "time", one.use === "time")];
  if (!state.ports.length) return [...found, option("input", "input", one.use === "input"), option("output", "output", one.use === "output")];
  return [...found, ...state.ports.map((port) => option(`${port.use}:${port.name}`, `${port.use} ${port.name} [${port.unit}]`, one.use === port.use && one.port === port.name))];
}

const holed = () => state.columns.some((one) => one.empty);

function tableRows() {
  const holes = holed();
  return state.columns.map((one, k) => {
    const name = `Column ${one.title}`;
    const choose = make("select", { "aria-label": `${name} is`, onchange: (event) => use(k, event.target.value) }, ...uses(one));
    const own = one.unit || state.stated[one.title]?.[one.port];
    const asked = one.use === "time" ? !state.content.clock_stated : one.use && !own;
    const unit = make("input", { class: "unit", value: one.given, placeholder: own || (asked ? "unit?" : one.use === "time" ? (/[\[(]([^\])]+)[\])]\s*$/.exec(one.title)?.[1] ?? "in title") : ""), "aria-label": `Unit of ${name}`, autocomplete: "off", spellcheck: "false",
      onchange: (event) => { one.given = event.target.value.trim(); changed(); } });
    const tick = make("input", { type: "checkbox", checked: one.shown, "aria-label": `Plot ${name}`, disabled: one.use === "time", onchange: (event) => { one.shown = event.target.checked; redraw(); } });
    const size = one.minimum == null ? "" : `${number(one.minimum)} to ${number(one.maximum)}`;
    return make("tr", {}, make("td", { class: "name" }, one.title, one.note ? make("small", {}, one.note) : null),
      isToml() ? null : make("td", {}, choose), isToml() ? make("td", {}, one.unit) : make("td", {}, unit), make("td", { class: size ? "n" : "n none", "data-label": "range" }, size),
      make("td", { class: one.mean == null ? "n none" : "n", "data-label": "mean" }, one.mean == null ? "" : `${number(Math.abs(one.mean) < 1e-9 * one.deviation ? 0 : one.mean)} ± ${number(one.deviation)}`),
      holes ? make("td", { class: "n", "data-label": "empty" }, String(one.empty ?? 0)) : null, make("td", { class: "n", "data-label": "plot" }, tick));
  });
}

function fillTable() {
  const rows = tableRows(), holes = holed();
  const titles = ["column", ...(isToml() ? [] : ["is"]), "unit", "range", "mean ± deviation", ...(holes ? ["empty"] : []), "plot"];
  at("table").replaceChildren(make("table", {}, make("thead", {}, make("tr", {}, ...titles.map((title) => make("th", { scope: "col" }, title)))), make("tbody", {}, ...rows)));
  at("channels-help").hidden = isToml();
}

function use(k, value) {
  const [kind, port = ""] = value.split(/:(.*)/s), one = state.columns[k];
  for (const other of state.columns) {
    if (other !== one && ((kind === "time" && other.use === "time") || (port && other.port === port))) { other.use = ""; other.port = ""; }
  }
  Object.assign(one, { use: kind, port, shown: kind === "time" ? false : one.shown || Boolean(kind) });
  const rows = [...at("table").querySelectorAll("tbody tr")];
  tableRows().forEach((fresh, row) => {
    if (row !== k) { rows[row].replaceWith(fresh); return; }
    const cells = [...fresh.cells]; // a select that is replaced takes the second letter of a word for the first of another
    [...rows[k].cells].forEach((cell, place) => { if (!cell.querySelector("select")) cell.replaceWith(cells[place]); });
  });
  changed();
}

const clock = () => state.columns.find((one) => one.use === "time");
const step = () => at("step").value.trim();

function redraw() {
  const time = clock();
  said(show)({ name: state.log, clock: time?.title ?? "", unit: time?.given ?? "", step: step(),
    channels: state.columns.filter((one) => one.shown && one.use !== "time").slice(0, 6).map((one) => ({ title: one.title, label: one.unit || one.given ? `${one.name} [${one.given || one.unit}]` : one.name })) });
}

// ---- what is run ------------------------------------------------------------------------------------------------

function choice(task) {
  const time = clock(), chosen = time && time.title !== state.content.clock;
  return {
    task, log: state.log, model: state.model, trusted: at("trusted").checked,
    columns: isToml() ? [] : state.columns.filter((one) => one.use).map((one) => ({ title: one.title, use: one.use, port: one.use === "time" ? (chosen ? "chosen" : "") : one.port, unit: one.given })),
    sample_time: step() && !Number.isNaN(Number(step())) ? Number(step()) : null,
    validation: isToml() ? "" : at("validation").value,
    undriven: [...at("undriven").querySelectorAll("input:checked")].map((one) => one.value),
    identifier: task === "identify" ? at("identifier").value : "",
    options: task === "identify" ? at("options").value.split(/[\s,]+(?=[\w.-]+=)/).map((one) => one.trim()).filter(Boolean) : [],
  };
}

const task = () => document.querySelector("input[name=task]:checked").value;
const ready = () => state.log && (isToml() || state.columns.some((one) => one.use === "output"));
let later = null, checked = "";

function changed() {
  fillUndriven();
  redraw();
  at("clock-row").hidden = isToml() || Boolean(clock()) || state.content.length != null;
  at("identifier-field").hidden = at("options-field").hidden = task() !== "identify";
  at("validation").parentElement.hidden = isToml();
  at("command-told").hidden = !state.log?.startsWith("uploaded/") && !state.model.startsWith("uploaded/");
  at("go").disabled = !ready() || busy();
  at("command").textContent = ready() ? "" : "Choose an output first.";
  at("copy").disabled = !ready();
  if (!ready()) return;
  said(tell)();
  clearTimeout(later);
  later = setTimeout(said(check), 700);
}

let told = 0;
async function tell() {
  const mine = ++told;
  try {
    const found = await send("command", choice(task()));
    if (mine === told) at("command").replaceChildren(...found.command.split(" ").flatMap((word) => [make("span", {}, word), " "]));
  } catch (error) {
    if (mine === told) at("command").textContent = error.message;
  }
}

async function check() {
  const wanted = choice("check-data"), key = JSON.stringify(wanted);
  if (key === checked) return;
  checked = key;
  at("odd").replaceChildren(make("p", { class: "soft" }, "looking at every channel ..."));
  const job = await send("run", wanted);
  state.check = job.id;
  take(job);
}

async function checkedData(job) {
  if (job.id !== state.check || job.status === "running" || job.status === "cancelling") return;
  if (job.status === "cancelled") return;
  if (job.status === "failed") { at("odd").replaceChildren(make("p", { class: "error" }, job.error)); return; }
  const found = JSON.parse((await ask(`text?job=${job.id}`)).text), items = found.oddities.map((one) => make("li", {}, one.text, one.used ? " (left out of fits)" : one.fault ? "" : " (worth knowing)"));
  const known = [...state.content.facts, ...found.oddities.map((one) => one.text)];
  const notes = found.warnings.filter((one) => !known.some((fact) => one.endsWith(`: ${fact}`))).map((one) => make("p", { class: "note" }, one));
  const marked = found.oddities.some((one) => one.count) && job.files.length ? make("a", { href: `result/${job.id}/${job.files[0]}`, target: "_blank", rel: "noopener" }, "Pictures with the odd rows marked") : null;
  at("odd").replaceChildren(items.length ? make("ul", {}, ...items) : make("p", { class: "done" }, "Nothing odd was found."), ...notes, ...(marked ? [marked] : []));
}

async function go() {
  quiet();
  at("go").disabled = true;
  try { take(await send("run", choice(task()))); } finally { at("go").disabled = !ready() || busy(); }
  at("fits").scrollIntoView({ block: "nearest" });
}

// Without a model the usual one is taken; for a physical one that is named, the one that fits its parameters.
function fillIdentifiers() {
  const ids = (state.session.identifiers ?? []).map((one) => one.id), before = at("identifier").value;
  const named = [state.model || state.content?.model].filter((one) => one && one !== "linear")[0];
  const chosen = ids.includes(before) && before !== PHYSICAL ? before : named && ids.includes(PHYSICAL) ? PHYSICAL : "";
  at("identifier").replaceChildren(...(named ? [] : [option("", "the usual one for such data", !chosen)]), ...ids.map((id) => option(id, id, id === chosen)));
}

async function parts() {
  const { catalogue, identifiers } = await ask("parts");
  state.session.catalogue = catalogue;
  state.session.identifiers = identifiers;
  fillIdentifiers();
  fillPicks();
}

// ---- the beginning ----------------------------------------------------------------------------------------------

async function begin() {
  state.session = { catalogue: [], ...await ask("session") };
  begun();
  const { opened, file, logs, jobs } = state.session;
  at("opened").textContent = opened ?? "nothing opened yet";
  fillPicks();
  hear(said(checkedData));
  hear(() => { if (state.log) at("go").disabled = !ready() || busy(); });
  jobs.forEach(take);
  listen();
  const first = file && logs.includes(file) ? file : logs.length === 1 ? logs[0] : "";
  if (first && !openings) await said(openLog)(first);
  await parts(); // after the first picture: the machine may have few cores
}

at("upload").addEventListener("change", (event) => { if (event.target.files[0]) dropped(event.target.files[0]); event.target.value = ""; });
at("model-upload").addEventListener("change", (event) => { if (event.target.files[0]) dropped(event.target.files[0]); event.target.value = ""; });
for (const id of ["upload", "model-upload"]) {
  const label = document.querySelector(`label[for=${id}]`);
  at(id).addEventListener("focus", () => label.classList.toggle("focused", at(id).matches(":focus-visible")));
  at(id).addEventListener("blur", () => label.classList.remove("focused"));
}
at("take").addEventListener("click", () => dropped(new File([at("equations").value], "typed.eqs", { type: "text/plain" })));
at("pick").addEventListener("change", said((event) => openLog(event.target.value)));
at("model-pick").addEventListener("change", said((event) => chooseModel(event.target.value)));
at("go").addEventListener("click", said(go));
at("copy").addEventListener("click", said(async () => { await navigator.clipboard.writeText(at("command").textContent.trim()); at("copy").textContent = "Copied"; setTimeout(() => { at("copy").textContent = "Copy"; }, 1500); }));
for (const id of ["validation", "identifier", "options", "step", "trusted"]) at(id).addEventListener("change", () => changed());
document.querySelectorAll("input[name=task]").forEach((one) => one.addEventListener("change", () => changed()));
for (const kind of ["dragover", "drop", "dragleave"]) {
  window.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("over", kind === "dragover");
    if (kind === "drop" && event.dataTransfer.files[0]) dropped(event.dataTransfer.files[0]);
  });
}
said(begin)();
