/* The Plan tab: draw a survey, see it re-planned, save it. */

import {PAGE, attempt, button, el, field, get, on, say, send, sendNewest, table} from "./core.js";
import {AS_IN_FILE, withChange, withChanges} from "./plan_changes.js";
import {drawing} from "./plan_draw.js";
import {latest} from "./plan_latest.js";
import {settingsPanel} from "./plan_settings.js";
import {noShapes, paths, withImported} from "./plan_shapes.js";
import {shown} from "./plan_show.js";
import {keyFigures, summaryOf} from "./plan_words.js";
import {profileChart} from "./profile_chart.js";
import {canRedo, canUndo, current, record, redo, same, startHistory, undo} from "./undo.js";

const QUIET_MS = 900;  /* after which the figures are said */
const ROLES = {survey: "area to survey", no_go: "no-go zones", allowed: "allowed area"};
const EMPTY = "Draw the area to survey on the map, or import a file with it.";

export function tab(studio) {
  let [file, history, preview, fitted, quiet] = [null, startHistory(AS_IN_FILE), null, false, null];
  const body = () => current(history);
  const isDirty = () => !same(body(), AS_IN_FILE);

  /* ---- Parts ---- */

  const view = shown(studio);
  const draw = drawing(studio, {changed: reshaped, moving: (shapes) => plan({...body(), shapes})});
  const results = resultsPanel(
    (changes) => edit({...body(), changes: withChanges(body().changes, file, changes)}));
  const controls = el("div");
  const exports = el("ul");
  const back = button("Undo", () => step(undo), {title: "Ctrl+Z"});
  const forth = button("Redo", () => step(redo), {title: "Ctrl+Shift+Z"});
  const keep = button("Save", save, {class: "primary"});
  const note = el("p", {class: "note"});
  const dropped = el(
    "input", {type: "file", onchange: () => { importFile(dropped.files[0]); dropped.value = ""; }});
  const role = el("select", {}, Object.entries(ROLES).map(
    ([value, text]) => el("option", {value}, text)));
  let settings = null;

  const content = el("div", {hidden: true},
    el("div", {class: "plan-top"}, el("div", {class: "buttons"}, back, forth, keep),
      results.key, note),
    results.top,
    el("h2", {}, "Area"), draw.panel,
    el("details", {}, el("summary", {}, "Import a file"), field("It is the", role),
      field("File", dropped,
        "GeoJSON, KML, GeoPackage, zipped shapefile, WKT and others")),
    el("h2", {}, "How to fly"), controls,
    results.below,
    el("details", {}, el("summary", {}, "Export"), exports));
  const waiting = el("p", {class: "note"}, "Planning …");
  const wait = (on) => { waiting.hidden = !on; };
  on("compiling", (text) => { waiting.textContent = text || "Planning …"; });
  const panel = el("div", {}, waiting, content);

  /* ---- Planning in the background ---- */

  const planning = latest({
    ask: (state) => sendNewest("/api/plan/preview", {...state, page: PAGE}),
    shown: settled,
    failed: (fault) => say(fault.message, "error"),
    busy(on) {
      view.dim(on);
      wait(on && !preview);
    },
  });

  function lay(state) {
    draw.update(shapesOf(state));
    const {latitude_deg, longitude_deg} = {...file.datum, ...state.changes.area};
    studio.datumIs([latitude_deg, longitude_deg]);
  }

  function plan(state, wait) {
    clearTimeout(quiet);
    lay(state);
    if (hasArea(state)) planning.request(state, wait);
    else planning.stop();
  }

  function settled(answer) {
    if (answer.ok) {
      preview = answer;
      view.show(answer);
      if (!fitted) view.fit(shapesOf(body()));
      fitted = true;
    }
    results.show(answer);
    settings.set(body().changes, answer.ok ? answer : preview);
    panel.dataset.plans = Number(panel.dataset.plans || 0) + 1;
    quiet = setTimeout(() => say(summaryOf(answer), answer.ok ? "note" : "warn"), QUIET_MS);
  }

  /* ---- Edits ---- */

  /* Of a new survey nothing is planned before something is drawn. */
  const hasArea = (state) => Boolean(file.token) || ["survey", "corridors"].some((kind) =>
    shapesOf(state)[kind].length);
  const shapesOf = (state) => ({...noShapes(), ...(state.shapes || file.shapes)});

  function reshaped(shapes, tag = "") {
    edit({...body(), shapes}, tag);
  }

  function setting(values, tag) {
    const changes = values.reduce((all, [section, key, value]) => withChange(
      all, file, section, key, value), body().changes);
    edit({...body(), changes}, tag);
  }

  function edit(state, tag = "") {
    history = record(history, state, tag, Date.now());
    buttons();
    settings.set(state.changes, preview);
    plan(state);
  }

  function step(way) {
    if (!file) return;
    history = way(history);
    buttons();
    settings.set(body().changes, preview);
    plan(body());
  }

  function buttons() {
    [back.disabled, forth.disabled] = [!canUndo(history), !canRedo(history)];
    keep.disabled = !studio.mayWrite() || !file || !hasArea(body());
    note.textContent = !hasArea(body()) ? EMPTY : isDirty() ? "Not saved." : "As in survey.toml.";
  }

  /* ---- The file ---- */

  async function load() {
    file = await get("/api/plan");
    dropped.accept = file.suffixes.join(",");
    settings = settingsPanel(file, setting);
    controls.replaceChildren(settings.element);
    exports.replaceChildren(...(file.formats || []).map((name) => el("li", {}, el("a", {
      href: "/api/plan/export?format=" + encodeURIComponent(name), download: "",
    }, name))));
    if (file.stage !== "up to date") exports.replaceChildren(el("li", {}, "Save the plan first."));
  }

  async function restart(state = AS_IN_FILE) {
    await load();
    history = startHistory(AS_IN_FILE);
    if (!same(state, AS_IN_FILE)) history = record(history, state);
    buttons();
    settings.set(body().changes, file.saved);
    lay(body());
    if (isDirty() || !file.saved) plan(body(), 0);
    else settled(file.saved);
    if (file.error) say(file.error, "error");
    panel.dataset.read = file.token || "new";
  }

  async function save() {
    keep.disabled = true;
    say("Saving: the plan is made with all its files");
    try {
      const {changes, shapes} = body();
      const {saved} = await send("/api/plan/save", {
        changes, shapes, token: file.token, page: PAGE});
      await restart();
      await studio.refresh();
      view.alone();
      clearTimeout(quiet);
      if (saved.ok) say("Saved: survey.toml, and the plan in plan/");
      else say("Saved survey.toml, but there is no plan of it: " + saved.error, "error");
    } catch (fault) {
      if (fault.status === 409) conflict(fault);
      else say(fault.message, "error");
    }
    buttons();
  }

  /* Another page saved. */
  on("plan", ({page}) => {
    if (!file || page === PAGE) return;
    if (isDirty()) say("survey.toml was changed by another page; what is changed here is kept",
      "warn");
    else attempt(() => restart());
  });

  function conflict(fault) {
    const mine = body();
    const title = "Changed by somebody else";
    const box = el("dialog", {"aria-label": title, onclose: () => box.remove()},
      el("h2", {}, title), el("p", {}, fault.message),
      el("div", {class: "buttons"},
        button("Load theirs", () => { box.close(); attempt(() => restart()); }, {class: "primary"}),
        button("Keep mine on top of theirs", () => { box.close(); attempt(() => restart(mine)); }),
        button("Cancel", () => box.close())));
    document.body.append(box);
    box.showModal();
    say(fault.message, "warn");
  }

  /* ---- Import ---- */

  function importFile(taken) {
    if (!taken) return;
    attempt(async () => {
      const about = {name: taken.name, role: role.value};
      const found = await send("/api/plan/import", taken, about);
      const shapes = {...noShapes(), ...Object.fromEntries(
        Object.keys(noShapes()).map((kind) => [kind, found[kind] || []]))};
      fitted = false;
      edit({changes: withChanges(body().changes, file, moved(found.datum)),
        shapes: withImported(shapesOf(body()), shapes)});
      say([paths(shapes).length + " shapes from " + taken.name, ...found.warnings].join("; "),
        found.warnings.length ? "warn" : "note");
    });
  }

  /* The middle of a file is the datum of a new survey. */
  const moved = (datum) => (same(datum, file.datum) ? {} : {area: datum});

  /* ---- The page ---- */

  window.addEventListener("beforeunload", (event) => { if (isDirty()) event.preventDefault(); });

  async function enter() {
    view.enter();
    draw.enter();
    if (!file) await start();
  }

  async function start() {
    wait(true);
    await attempt(() => restart());
    content.hidden = !file;
    if (!file || file.saved || !hasArea(body())) wait(false);
  }

  function leave() {
    draw.leave();
    view.leave();
    view.dim(false);
  }

  const keys = {"Ctrl+z": () => step(undo), "Ctrl+Z": () => step(redo), "Ctrl+y": () => step(redo)};
  return {name: "plan", title: "Plan", panel, enter, leave, keys};
}

/* What a plan comes to: figures, warnings, settings and why, depths; or why there is none, and the
   setting that would help. `apply(changes)` takes a suggestion. */
function resultsPanel(apply) {
  const key = el("dl", {class: "plan-key"});
  const [top, below] = [el("div"), el("div")];
  const opened = new Set(["Depth along the way"]);
  const folded = (name, title, content) => el("details", {open: opened.has(name),
    ontoggle: (event) => (event.target.open ? opened.add(name) : opened.delete(name))},
    el("summary", {}, title), content);

  function show(preview) {
    if (!preview.ok) {
      refuse(preview);
      return;
    }
    const {totals, warnings, rows, profile} = preview;
    key.replaceChildren(...keyFigures(totals).map(
      ([name, text]) => el("div", {}, el("dt", {}, name), el("dd", {}, text))));
    top.replaceChildren(warnings.length ? el("ul", {class: "warn"},
      warnings.map((text) => el("li", {}, text))) : "");
    below.replaceChildren(
      folded("rows", "Settings and why",
        table("Settings and why", ["setting", "value", "why"], rows)),
      folded("Depth along the way", "Depth along the way",
        profileChart("Depth of the sea floor and of the camera along the way", {
          lines: [{kind: "floor", xs: profile.s_m, ys: profile.floor_depth_m, ground: true},
            {kind: "vehicle", xs: profile.s_m, ys: profile.vehicle_depth_m}],
          downwards: true, caption: "along the way, m; depth, m",
          rules: profile.s_m.filter((_, i) => i && profile.dive[i] !== profile.dive[i - 1]),
        })));
  }

  function refuse({error, suggestion}) {
    const words = suggestion && Object.entries(suggestion).flatMap(([section, values]) =>
      Object.entries(values).map(([name, value]) => section + "." + name + " = " + value));
    top.replaceChildren(
      el("p", {class: "error"}, "No plan: " + error),
      el("p", {class: "note"}, "The map shows the last plan."),
      words ? el("div", {class: "plan-ways"},
        button("Set " + words.join(", "), () => apply(suggestion))) : "");
  }

  return {key, top, below, show};
}
