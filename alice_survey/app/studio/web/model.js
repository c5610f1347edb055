/* The tab Model: values under the pointer, measures with their sigmas, the mesh, the files. */

import {
  asToken, attempt, button, el, field, get, missing, save, say, send, sendNewest, table,
} from "./core.js";
import {RED} from "./palette.js";
import {counted, number, withSigma} from "./words.js";
import {drawingTool} from "./drawing.js";
import {meshPart} from "./model_mesh.js";
import {profileChart} from "./profile_chart.js";

const ASK_MS = 120;
/* What each tool draws, how many places end it, and the figure that stands for the measure. */
const TOOLS = {
  length: {title: "Length", key: "l", kind: "line", ends: 2, main: "length"},
  profile: {title: "Profile", key: "p", kind: "line", main: "surface_length"},
  area: {title: "Area", key: "a", kind: "polygon", main: "surface_area"},
  volume: {title: "Volume", key: "v", kind: "polygon", main: "volume"},
  rugosity: {title: "Rugosity", key: "r", kind: "polygon", main: "rugosity"},
};
const LAYERS = ["measured-line", "measured-polygon"];

export function tab(studio) {
  const {map, state} = studio;
  const kept = "alice-survey measures " + state.workspace;
  let measures = JSON.parse(sessionStorage.getItem(kept) || "[]");
  let chosen = null;
  let active = false;

  /* ---- Values of the rasters under the pointer, or in the middle of the map ---- */

  const under = el("div", {class: "under"});
  let asking = null;
  let wanted = null;

  function valueOf({value, unit}) {
    if (!Array.isArray(value)) return Number.isInteger(value)
      ? value + " " + unit : number(value, unit, unit === state.unit ? 5 : 3);
    return el("span", {title: value.join(", ")},
      el("span", {class: "swatch", style: {background: "rgb(" + value.join(",") + ")"}}), " ",
      value.join(" "));
  }

  async function ask() {
    const place = wanted;
    const found = await get("/api/model/value", {east: place.lng, north: place.lat})
      .catch((fault) => ({fault}));
    asking = null;
    if (!active) return;
    if (found.fault) {
      under.replaceChildren(el("p", {class: "error"}, found.fault.message));
      return;
    }
    const at = map.data.axes.map((axis, i) => number([place.lng, place.lat][i], state.unit, 6) + " "
      + axis).join(", ");
    under.replaceChildren(
      el("p", {}, found.values.length ? "At " + at : "No raster knows anything at " + at + "."),
      el("dl", {}, found.values.map(
        (row) => el("div", {}, el("dt", {}, row.title.replace(" of height", "")),
        el("dd", {}, valueOf(row))))));
    if (wanted !== place) later();
  }

  function later() {
    if (asking === null) asking = setTimeout(ask, ASK_MS);
  }

  map.moreAt((place) => {
    if (active) {
      wanted = place;
      later();
    }
    return "";
  });

  /* ---- Drawing ---- */

  const drawing = drawingTool(studio, "model");
  const toolButtons = Object.entries(TOOLS).map(([name, tool]) =>
    button(tool.title, () => begin(name), {
    "aria-pressed": "false", "data-tool": name,
      title: tool.title + " (" + tool.key.toUpperCase() + ")",
  }));

  const level = el("input", {type: "number", step: "any"});
  const forVolume = el("div", {hidden: true}, field("Height of the volume's plane, " + state.unit,
    level, "Empty: a plane that is fitted to the polygon's rim."));

  let inHand = null;
  function begin(name) {
    if (inHand === name) {
      map.release();
      return;
    }
    const tool = TOOLS[name];
    drawing.begin({
      kind: tool.kind, colour: RED, most: tool.ends, ended: () => held(null),
      done: (points) => measure(name, {
        kind: tool.kind, click: 2 ** -map.leaflet.getZoom(), places: points.map(([n, e]) => [e, n]),
        ...(name === "volume" ? {base: level.value ? level.valueAsNumber : "rim"} : {}),
      }),
    });
    held(name);
  }

  function held(name) {
    inHand = name;
    toolButtons.forEach((one) => one.setAttribute(
      "aria-pressed", String(one.dataset.tool === name)));
    if (!name) return;
    forVolume.hidden = name !== "volume";
  }

  async function measure(name, asked) {
    say("Measuring …");
    const found = await attempt(() => send("/api/model/measure", asked));
    if (!found) return;
    const tool = TOOLS[name];
    const same = measures.filter((one) => one.tool === name).length + 1;
    const made = {
      id: Math.max(0, ...measures.map((one) => one.id)) + 1, name: tool.title + " " + same,
      tool: name, kind: asked.kind, places: asked.places, ...found,
    };
    measures.push(made);
    chosen = made.id;
    changed();
    const main = found.figures.find((one) => one.name === tool.main);
    say(made.name + ": " + valueText(main));
  }

  /* ---- Results ---- */

  const results = el("div", {});
  const details = el("div", {});

  function mainOf(one) {
    return one.figures.find((figure) => figure.name === TOOLS[one.tool].main) || one.figures[0];
  }

  function changed() {
    sessionStorage.setItem(kept, JSON.stringify(measures));
    drawMeasures();
    showResults();
    showChosen();
  }

  function drawMeasures() {
    [["line", "Measured lines"], ["polygon", "Measured areas"]].forEach(([kind, title]) => {
      const some = measures.filter((one) => (one.kind === "polygon") === (kind === "polygon"));
      const name = "measured-" + kind;
      if (!some.length) map.remove(name);
      else map.put({kind, name, title, colour: RED, fill: 0.12, width: 3, group: "Measures",
        shapes: some.map((one) => one.places.map(([east, north]) => [east, north])),
        texts: some.map((one) => one.name + ": " + valueText(mainOf(one)))});
    });
  }

  const valueText = ({value, sigma, unit}) => withSigma(value, sigma, unit);

  function showResults() {
    if (!measures.length) {
      results.replaceChildren(el("p", {class: "note"}, "Nothing is measured yet."));
      return;
    }
    const rows = measures.map((one) => {
      const name = el("input", {value: one.name, maxlength: 200,
        "aria-label": "Name of " + one.name});
      name.addEventListener("change", () => {
        one.name = name.value.trim() || one.name;
        changed();
      });
      const cells = [name, valueText(mainOf(one)),
        [button("Show", () => { chosen = one.id; changed(); lookAt(one); },
          {"aria-label": "Show " + one.name}), " ",
          button("×", () => drop(one), {"aria-label": "Delete " + one.name})]];
      return {cells, "data-measure": one.id, "aria-current": one.id === chosen ? "true" : null};
    });
    results.replaceChildren(
      el("div", {class: "measures"}, table("Measures", ["Name", "Result", "Actions"], rows)),
      el("div", {class: "buttons"}, button("Export CSV", () => attempt(() => exported("csv"))),
        button("Export GeoJSON", () => attempt(() => exported("geojson"))),
        button("Delete all", () => { measures = []; chosen = null; changed(); })),
    );
  }

  function drop(one) {
    measures = measures.filter((other) => other !== one);
    if (chosen === one.id) chosen = null;
    changed();
  }

  function lookAt(one) {
    const bounds = leaflet.latLngBounds(one.places.map(([east, north]) => [north, east]));
    map.leaflet.fitBounds(bounds.pad(0.4), {animate: false});
  }

  async function showChosen() {
    const one = measures.find((other) => other.id === chosen);
    if (!one) {
      details.replaceChildren();
      return;
    }
    const profile = el("div", {});
    details.replaceChildren(
      table(one.name, ["Figure", "Value ± sigma"],
        one.figures.map((figure) => [figure.title, valueText(figure)])),
      ...one.notes.map((note) => el("p", {class: "note"}, note)),
      profile);
    if (one.kind === "polygon") return;
    const places = one.places.map(([east, north]) => [east, north]);
    const found = await attempt(() => sendNewest("/api/model/profile", {places}));
    if (found) profile.append(profileChart("Heights along the line with one sigma", {
      lines: [{kind: "vehicle", xs: found.along, ys: found.height, sigmas: found.sigma}],
      caption: "along the line, " + state.unit + "; height ± sigma, " + state.unit,
      rules: found.corners.slice(1, -1), high: 170,
    }));
  }

  async function exported(form) {
    await save("/api/model/export", "measures." + form, {
      form,
      measures: measures.map(({name, kind, places, figures, notes}) => (
        {name, kind, places, figures, notes})),
    });
    say(counted(measures.length, "measure") + " written to measures." + form);
  }

  /* ---- The files ---- */

  const links = el("ul", {});
  function fillFiles() {
    links.replaceChildren(...Object.entries(state.files).map(
      ([path, text]) => el("li", {}, el("a", {href: "/files/" + path}, text))));
  }
  const files = el("details", {}, el("summary", {}, "Files"), links, el("p", {class: "note"},
    "A GIS reads rasters from here part by part, without a copy: in QGIS add a raster layer with "
      + "the protocol HTTP(S) and the address "
    + window.location.origin + "/files/mosaic/mosaic.tif" + asToken()));

  const mesh = meshPart(
    studio, {colour: RED, measured: (points) => measure("length",
    {kind: "points", places: points})});

  const content = el("div", {},
    el("h2", {}, "Look and measure"),
    el("div", {class: "buttons", role: "group", "aria-label": "Measure on the map"}, toolButtons),
    drawing.element, forVolume, under, results, details, mesh.element);
  const lack = missing(studio, content, () => (state.has.dem ? null
    : ["There is no model of the sea floor to look at yet: make it in Run, from a simulated dive "
      + "or from pictures.", "run", "Open Run"]));
  const panel = el("div", {class: "model"}, lack.element, content, files);

  return {
    name: "model", title: "Model", panel,
    enter() {
      active = true;
      fillFiles();
      if (!lack.show()) return;
      mesh.enter();
      changed();
      map.refresh();
    },
    leave() {
      active = false;
      LAYERS.forEach((name) => map.remove(name));
      mesh.leave();
    },
    keys: Object.fromEntries(Object.entries(TOOLS).map(
      ([name, tool]) => [tool.key, () => state.has.dem && begin(name)])),
  };
}
