/* The studio's shell: the one map, its list of layers, and the tabs. */

import {baseMap} from "./base_map.js";
import {attempt, el, get, mayWrite, say} from "./core.js";

const state = await attempt(() => get("/api/state"));
if (!state) throw new Error("without a state nothing is shown");
document.title = state.name + " – alice-survey";
document.getElementById("title").textContent = state.name;

const held = await attempt(() => get("/api/map"));
const mapData = {
  unit: state.unit, axes: state.axes, extent: [-50, -50, 50, 50], layers: [],
  ...held,
};
const described = mapData.layers;
mapData.layers = [];
const core = startMap(mapData, document.getElementById("map"));

/* ---- The map with its list of layers ---- */

const list = document.getElementById("layer-list");
const under = baseMap(core.leaflet);
list.after(el("div", {}, under.control));
under.at(state.datum);

function legendOf(about) {
  const {scale} = about;
  const {colours} = scale;
  const bars = el("svg", {viewBox: "0 0 " + colours.length + " 1", preserveAspectRatio: "none",
    "aria-hidden": "true"},
    colours.map((fill, i) => el("rect", {x: i, width: 1.02, height: 1, fill})));
  const ends = [scale.low, (scale.low + scale.high) / 2, scale.high];
  return el("div", {class: "legend", id: "legend-" + about.name, hidden: true},
    el("p", {}, scale.label), bars,
    el("div", {class: "values"},
      ends.map((value) =>
      el("span", {}, Number(value.toPrecision(4)).toString().replace("-", "−")))));
}

function groupOf(name) {
  let group = list.querySelector(`fieldset[data-group="${CSS.escape(name)}"]`);
  if (!group) {
    group = el("fieldset", {"data-group": name}, el("legend", {}, name));
    list.append(group);
  }
  return group;
}

/* A layer that is described as in kit/map.js; with a title it is listed. */
function put(about) {
  const before = list.querySelector(`input[value="${CSS.escape(about.name)}"]`);
  const shown = before ? before.checked : about.shown !== false;
  remove(about.name, true);
  const layer = core.put(about);
  if (about.title) {
    const radio = about.kind === "picture" && about.base;
    const input = el(
      "input", {type: radio ? "radio" : "checkbox", name: radio ? "base" : null, value: about.name,
      checked: shown});
    input.addEventListener("change", () => {
      if (radio) list.querySelectorAll("input[type=radio]")
        .forEach((other) => core.show(other.value, other === input));
      else core.show(about.name, input.checked);
    });
    const key = about.colour
      ? el("span", {class: "swatch", style: {background: about.colour}}) : null;
    const choice = el("div", {class: "choice", "data-layer": about.name}, el(
      "label", {}, input, key, about.title),
      about.about ? el("small", {}, about.about) : null, about.scale ? legendOf(about) : null);
    const old = list.querySelector(`[data-layer="${CSS.escape(about.name)}"]`);
    if (old) old.replaceWith(choice);
    else groupOf(about.group || "Overlays").append(choice);
  }
  core.show(about.name, shown);
  return layer;
}

function remove(name, kept = false) {
  core.remove(name);
  if (kept) return;
  const choice = list.querySelector(`[data-layer="${CSS.escape(name)}"]`);
  const group = choice?.closest("fieldset");
  choice?.remove();
  if (group && !group.querySelector("input")) group.remove();
}

function show(name, on) {
  const input = list.querySelector(`input[value="${CSS.escape(name)}"]`);
  if (input && input.checked !== on) input.click();
  else if (core.layers.has(name)) core.show(name, on);
}

const map = {...core, put, remove, show};
const isLine = (about) => ["flown", "plan", "footprints"].includes(about.name);
described.forEach(
  (about) => put({...about, shown: about.shown && !(state.has.mosaic && isLine(about))}));
/* The list is open where there is room for it, until it is closed by hand. */
const layersKey = "alice-survey layers";
const layers = document.getElementById("layers");
const isWide = () => window.innerWidth > 900;
layers.open = (sessionStorage.getItem(layersKey) || (isWide() ? "open" : "closed")) === "open";
layers.firstElementChild.addEventListener("click", () => sessionStorage.setItem(
  layersKey, layers.open ? "closed" : "open"));
mapData.room = () => (layers.open && list.firstChild && isWide() ? {paddingTopLeft: [56, 24],
  paddingBottomRight: [layers.offsetWidth + 32, 40]} : {});
core.fit(false);

/* ---- Tabs ---- */

const studio = {map, state, open, refresh, mayWrite, datumIs: under.at};
const tabs = new Map();
const bar = document.getElementById("tabs");
const panel = document.getElementById("panel");
let current = null;

/* Read the state anew, after a stage was made. */
async function refresh() {
  Object.assign(state, await get("/api/state"));
  under.at(state.datum);
  const now = await get("/api/map");
  mapData.extent = now.extent;
  core.extend(now.extent);
  now.layers.forEach(put);
}

function open(name, args) {
  const tab = tabs.get(name) || [...tabs.values()][0];
  if (!tab) return;
  if (current === tab) {
    tab.enter?.(args);
    return;
  }
  map.release();
  current?.leave?.();
  if (current) say("");
  current = tab;
  bar.querySelectorAll("[role=tab]").forEach((button) => {
    const chosen = button.dataset.tab === tab.name;
    button.setAttribute("aria-selected", String(chosen));
    button.tabIndex = chosen ? 0 : -1;
  });
  tabs.forEach((other) => { other.panel.hidden = other !== tab; });
  document.body.dataset.tab = tab.name;
  window.history.replaceState(null, "", "#" + tab.name);
  tab.enter?.(args);
}

async function begin() {
  const modules = await Promise.all(state.tabs.map((name) => import("./" + name + ".js")));
  modules.forEach((module) => {
    const tab = module.tab(studio);
    tabs.set(tab.name, tab);
    bar.append(el("button", {
      type: "button", role: "tab", id: "tab-" + tab.name, "data-tab": tab.name,
        "aria-controls": "panel-" + tab.name,
      "aria-selected": "false", tabindex: "-1", onclick: () => open(tab.name),
    }, tab.title));
    tab.panel.id = "panel-" + tab.name;
    tab.panel.hidden = true;
    tab.panel.setAttribute("role", "tabpanel");
    tab.panel.setAttribute("aria-labelledby", "tab-" + tab.name);
    tab.panel.tabIndex = 0;
    panel.append(tab.panel);
  });
  bar.addEventListener("keydown", (event) => {
    const buttons = [...bar.querySelectorAll("[role=tab]")];
    const at = buttons.indexOf(document.activeElement);
    const to = {ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: buttons.length - 1}[event.key];
    if (at < 0 || to === undefined) return;
    event.preventDefault();
    const next = buttons[(to + buttons.length) % buttons.length];
    next.focus();
    next.click();
  });
  document.addEventListener("keydown", (event) => {
    const withCtrl = event.ctrlKey || event.metaKey;
    const typing = event.target.closest(
      withCtrl ? "input:not([type=range], [type=checkbox], [type=radio]), textarea"
      : "input, textarea, select, [role=application]");
    if (event.altKey || (typing && event.target.id !== "map-canvas")) return;
    const name = (withCtrl ? "Ctrl+" : "") + (event.shiftKey && event.key.length > 1
      ? "Shift+" : "") + event.key;
    const act = current?.keys?.[name];
    if (!act) return;
    event.preventDefault();
    act(event);
  });
  const empty = !state.stages.length && !state.has.survey;
  const first = state.log ? "follow" : state.has.dem || state.has.mosaic ? "model" : empty
    ? "run" : "plan";
  open(tabs.has(window.location.hash.slice(1)) ? window.location.hash.slice(1) : first);
  window.addEventListener("hashchange", () => open(window.location.hash.slice(1)));
  if (!mayWrite()) say("Opened without its token: this page looks, and changes nothing.", "warn");
  document.body.dataset.ready = "";
}

await attempt(begin);
