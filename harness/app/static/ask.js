// What is asked of the server, and how its refusals are shown.

const problem = document.getElementById("problem");
problem.querySelector("button").addEventListener("click", () => { problem.hidden = true; });

export function complain(text) {
  problem.querySelector("span").textContent = text;
  problem.hidden = false;
  problem.scrollIntoView({ block: "nearest" });
}

export function quiet() { problem.hidden = true; }

export async function ask(address, options = {}) {
  let answer;
  try {
    answer = await fetch(address, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Error("sysid open has ended; start it again");
  }
  const found = answer.headers.get("content-type")?.includes("json") ? await answer.json() : { error: await answer.text() };
  if (!answer.ok) throw new Error(found.error);
  return found;
}

export const send = (address, content) => ask(address, { method: "POST", body: JSON.stringify(content) });

// An event handler whose refusal is shown.
export const said = (work) => async (...given) => {
  try { return await work(...given); } catch (error) { if (error.name !== "AbortError") complain(error.message); }
};

export function make(name, attributes = {}, ...inside) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value != null) element.setAttribute(key, value);
  }
  element.append(...inside.filter((one) => one != null));
  return element;
}

export const option = (value, text, chosen = false) => make("option", { value, selected: chosen }, text);
