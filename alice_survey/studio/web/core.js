/* What every tab uses: requests to the server, its events, elements, messages, numbers. */

const key = "alice-survey token";
const given = new URLSearchParams(window.location.search).get("token");
if (given) {
  sessionStorage.setItem(key, given);
  window.history.replaceState(null, "", window.location.pathname + window.location.hash);
}

/* Whether this page may change anything: it was opened by the address with the token. */
export const mayWrite = () => Boolean(sessionStorage.getItem(key));

async function answered(response) {
  const text = await response.text();
  let values = null;
  try {
    values = JSON.parse(text);
  } catch {
    values = {error: text.trim()};
  }
  if (response.ok) return values;
  const fault = new Error(values.error || "the studio answered " + response.status);
  fault.status = response.status;
  throw fault;
}

async function asked(address, options) {
  try {
    return await fetch(address, options);
  } catch (fault) {
    if (fault.name === "AbortError") throw fault;
    throw new Error("the studio does not answer: start it again with 'alice-survey studio'");
  }
}

const addressOf = (path, params) => {
  const query = new URLSearchParams(params || {}).toString();
  return query ? path + "?" + query : path;
};

export async function get(path, params, options) {
  return answered(await asked(addressOf(path, params), options));
}

/* A body that is a Blob or bytes goes as it is, anything else as JSON. */
export async function send(path, body = {}, options = {}) {
  const raw = body instanceof Blob || body instanceof ArrayBuffer;
  return answered(await asked(addressOf(path, options.params), {
    method: "POST",
    body: raw ? body : JSON.stringify(body),
    signal: options.signal,
    headers: {
      "Content-Type": raw ? "application/octet-stream" : "application/json",
      "X-Studio-Token": sessionStorage.getItem(key) || "",
    },
  }));
}

/* Events of the server: `on("run", (data) => ...)`; returns a function that ends it. */
let source = null;
export function on(name, listener) {
  source = source || new EventSource("/api/events");
  const heard = (event) => listener(JSON.parse(event.data));
  source.addEventListener(name, heard);
  return () => source.removeEventListener(name, heard);
}

/* An element: el("button", {type: "button", class: "primary", onclick: fn, disabled: true}, "Save").
   Children are elements, texts, or lists of them; null and false are left out. */
export function el(tag, attributes = {}, ...children) {
  const svg = ["svg", "path", "line", "polyline", "polygon", "circle", "rect", "g", "text"].includes(tag);
  const made = svg
    ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  Object.entries(attributes || {}).forEach(([name, value]) => {
    if (value === null || value === undefined || value === false) return;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked") made[name] = value;
    else if (name === "style") Object.assign(made.style, value);
    else made.setAttribute(name, value === true ? "" : value);
  });
  made.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return made;
}

export const button = (text, onclick, attributes = {}) => el("button", {type: "button", onclick, ...attributes}, text);

/* A labelled control: field("Altitude", el("input", {type: "number"}), "m over the floor"). */
let fields = 0;
export function field(label, control, hint) {
  fields += 1;
  control.id = control.id || "field-" + fields;
  const about = hint ? el("small", {id: control.id + "-hint"}, hint) : null;
  if (about) control.setAttribute("aria-describedby", about.id);
  return el("div", {class: "field"}, el("label", {for: control.id}, label), control, about);
}

/* A table of figures: rows of texts or elements; the first cell of a row heads it. */
export function table(caption, header, rows) {
  const head = header.length ? el("thead", {}, el("tr", {}, header.map((text) => el("th", {scope: "col"}, text)))) : null;
  return el("table", {class: "figures"}, el("caption", {}, caption), head, el("tbody", {}, rows.map((row) => el("tr", {},
    row.map((cell, i) => (i ? el("td", {}, cell) : el("th", {scope: "row"}, cell)))))));
}

/* A line for everybody, screen readers too; it stays until the next one. */
export function say(text, level = "note") {
  const line = document.getElementById("status");
  line.className = level;
  line.textContent = text;
}

/* Run something that may fail; a failure is said in its own line. */
export async function attempt(work) {
  try {
    return await work();
  } catch (fault) {
    if (fault.name !== "AbortError") say(fault.message, "error");
    return undefined;
  }
}

const MINUS = "−";
export function number(value, unit = "", digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "unknown";
  const size = Math.abs(value);
  const places = size === 0 ? 0 : Math.min(9, Math.max(0, digits - 1 - Math.floor(Math.log10(size))));
  const text = value.toLocaleString("en", {maximumFractionDigits: places, minimumFractionDigits: Math.min(places, 6)});
  return text.replace("-", MINUS) + (unit ? " " + unit : "");
}

/* A value to the second digit of its sigma: 1.2345 ± 0.0012 m. */
export function withSigma(value, sigma, unit = "") {
  if (!(sigma > 0) || value === null) return number(value, unit, 4);
  const places = Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(sigma))));
  return value.toFixed(places).replace("-", MINUS) + " ± " + sigma.toFixed(places) + (unit ? " " + unit : "");
}

export function download(name, content, type = "text/plain") {
  const link = el("a", {href: URL.createObjectURL(new Blob([content], {type})), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
