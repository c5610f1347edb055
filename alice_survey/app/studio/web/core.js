/* What every tab uses: requests to the server, its events, elements, messages. */

/* Names this page: what it saves is no news to it. */
export const PAGE = crypto.randomUUID();

const key = "alice-survey token";
const given = new URLSearchParams(window.location.search).get("token");
if (given) {
  sessionStorage.setItem(key, given);
  window.history.replaceState(null, "", window.location.pathname + window.location.hash);
}

/* Whether this page may change anything: it was opened by the address with the token. */
export const mayWrite = () => Boolean(sessionStorage.getItem(key));

export const asToken = () => (mayWrite() ? "?token=" + sessionStorage.getItem(key) : "");

async function asked(address, options) {
  let response = null;
  try {
    response = await fetch(address, options);
  } catch (fault) {
    if (fault.name === "AbortError") throw fault;
    throw new Error("the studio does not answer: start it again with 'alice-survey studio'");
  }
  if (response.ok) return response;
  const text = (await response.text()).trim();
  const line = text.startsWith("{") ? JSON.parse(text).error : text;
  throw Object.assign(new Error(line || "the studio answered " + response.status), {
    status: response.status});
}

const addressOf = (path, params) =>
  [path, new URLSearchParams(params || {}).toString()].filter(Boolean).join("?");

export async function get(path, params, options) {
  return (await asked(addressOf(path, params), options)).json();
}

export const bytes = async (path) => (await asked(path)).arrayBuffer();

/* A body that is a Blob goes as it is, anything else as JSON. */
function posted(body, headers = {}) {
  const raw = body instanceof Blob;
  return {
    method: "POST", body: raw ? body : JSON.stringify(body),
    headers: {...headers,
      "Content-Type": raw ? "application/octet-stream" : "application/json",
      "X-Studio-Token": sessionStorage.getItem(key) || "",
    },
  };
}

export const send = async (path, body = {}, params = {}) => (
  await asked(addressOf(path, params), posted(body))).json();

/* Send what stops an older request of this page to the same path: only the newest is of use. */
const onTheirWay = {};
let requests = 0;
export async function sendNewest(path, body) {
  onTheirWay[path]?.abort();
  const {signal} = onTheirWay[path] = new AbortController();
  const options = posted(body, {"X-Studio-Newest-Of": `${PAGE} ${++requests}`});
  return (await asked(path, {...options, signal})).json();
}

/* Save a file that the server makes. */
export async function save(path, name, body) {
  const response = await asked(path, posted(body));
  const link = el("a", {href: URL.createObjectURL(await response.blob()), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/* Events of the server: `on("run", (data) => ...)`. */
let source = null;
export function on(name, listener) {
  source = source || new EventSource("/api/events");
  source.addEventListener(name, (event) => listener(JSON.parse(event.data)));
}

/* An element: el("button", {type: "button", class: "primary", onclick: fn, disabled: true},
   "Save"). Children are elements, texts, or lists of them; null and false are left out. */
const SVG = new Set("svg path line polyline polygon circle rect g text".split(" "));
export function el(tag, attributes = {}, ...children) {
  const made = SVG.has(tag)
    ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  Object.entries(attributes || {}).forEach(([name, value]) => {
    if (value === null || value === undefined || value === false) return;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked") made[name] = value;
    else if (name === "style") Object.assign(made.style, value);
    else made.setAttribute(name, value === true ? "" : value);
  });
  made.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined
    && child !== false));
  return made;
}

export const button = (text, onclick, attributes = {}) =>
  el("button", {type: "button", onclick, ...attributes}, text);

/* A labelled control: field("Altitude", el("input", {type: "number"}), "m over the floor"). */
let fields = 0;
export function field(label, control, hint) {
  control.id ||= "field-" + ++fields;
  const about = hint ? el("small", {id: control.id + "-hint"}, hint) : null;
  if (about) control.setAttribute("aria-describedby", about.id);
  return el("div", {class: "field"}, el("label", {for: control.id}, label), control, about);
}

/* A table of figures: rows of texts or elements, or {cells, attributes of the row}; the first
   cell of a row heads it. */
export function table(caption, header, rows) {
  const head = header.length
    ? el("thead", {}, el("tr", {}, header.map((text) => el("th", {scope: "col"}, text)))) : null;
  return el("table", {class: "figures"}, el("caption", {}, caption), head,
    el("tbody", {}, rows.map((row) => {
    const {cells, ...attributes} = Array.isArray(row) ? {cells: row} : row;
    return el("tr", attributes,
      cells.map((cell, i) => (i ? el("td", {}, cell) : el("th", {scope: "row"}, cell))));
  })));
}

/* What a tab shows while the workspace lacks what it needs: one sentence, and the way there.
   `needed()` returns [text, tab, title of the button], or null where all is there; the content
   is hidden meanwhile. Returns the element and `show()`, which says whether the tab can work. */
export function missing(studio, content, needed) {
  const element = el("div", {class: "missing", hidden: true});
  function show() {
    const [text, tab, title] = needed() || [];
    [content.hidden, element.hidden] = [Boolean(text), !text];
    if (text) element.replaceChildren(el("p", {}, text), el("div", {class: "buttons"},
      button(title, () => studio.open(tab), {class: "primary"})));
    return !text;
  }
  return {element, show};
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
