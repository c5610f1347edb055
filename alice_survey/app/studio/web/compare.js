/* The Compare tab: another survey next to this one or swiped over it, and what has changed. */

import {attempt, button, el, field, get, on, say, send, table} from "./core.js";
import {showSteps} from "./job_progress.js";
import {missing} from "./missing.js";
import {BLUE, RED} from "./palette.js";
import {fixed, number, withSigma} from "./words.js";
import {boundsOf, comparedMaps} from "./compare_maps.js";

const NEAR_M = 0.5;

export function tab(studio) {
  const maps = comparedMaps(studio, (share) => { swipe.value = String(Math.round(100 * share)); });
  let other = null;
  let results = [];
  let job = null;  /* that runs in this survey */
  let looked = false;

  /* ---- The other survey ---- */

  const near = el("select", {});
  const path = el("input", {type: "text", autocomplete: "off", spellcheck: "false"});
  near.addEventListener("change", () => { path.value = near.value; });
  const choose = button("Open", () => attempt(async () => {
    if (!path.value.trim()) throw new Error("Name the folder of another survey first");
    other = await send("/api/compare/open", {path: path.value.trim()});
    say(other.name + " is open to look at; nothing of it is changed");
    kinds();
    render();
    const about = other.layers.find((layer) => layer.name === kind.value);
    if (about) studio.map.leaflet.fitBounds(boundsOf(about), {animate: false, padding: [24, 24]});
    show();
  }), {class: "primary"});

  const kind = el("select", {});
  const modes = {swipe: "Swipe", beside: "Side by side", off: "This survey alone"};
  let mode = "swipe";
  const radios = Object.entries(modes).map(([value, text]) => {
    const input = el("input", {type: "radio", name: "compare-mode", value, checked: value === mode});
    input.addEventListener("change", () => {
      mode = value;
      render();
      show();
    });
    return el("label", {class: "option"}, input, text);
  });
  const swipe = el("input", {type: "range", min: "0", max: "100", step: "1", value: "50"});
  swipe.addEventListener("input", () => maps.setShare(Number(swipe.value) / 100));
  const swipeField = field("Where the two meet, %", swipe, "Left of it this survey, right of it the other; arrow keys move it");
  kind.addEventListener("change", () => {
    render();
    show();
  });

  /* Both show the same raster. */
  function kinds() {
    const both = other.layers.filter((layer) => studio.map.layers.has(layer.name));
    const all = both.length ? both : other.layers;
    kind.replaceChildren(...all.map((layer) => el("option", {value: layer.name}, layer.title)));
  }

  function show() {
    const about = other?.layers.find((layer) => layer.name === kind.value);
    if (about && studio.map.layers.has(about.name) && mode !== "off") studio.map.show(about.name, true);
    maps.show(about, mode, other?.name);
    maps.setShare(Number(swipe.value) / 100);
  }

  async function look() {
    looked = true;
    await load();
    if (!studio.mayWrite()) return;
    const found = await send("/api/compare/near");
    [alone.hidden, nearField.hidden] = [found.surveys.length > 0, !found.surveys.length];
    alone.textContent = "No other survey is in " + found.folder + ": type the path of one that is elsewhere.";
    near.replaceChildren(el("option", {value: ""}, "Choose one"),
      ...found.surveys.map((one) => el("option", {value: one.path}, one.name)));
  }

  /* ---- What has changed ---- */

  const find = button("Find what has changed", () => attempt(async () => {
    await send("/api/run/start", {name: "evaluate", arguments: {against: other.path}});
    say("Heights are compared");
    job = {steps: []};
    render();
  }));
  const progress = el("div", {class: "run"});
  on("run", (data) => {
    if (data.job) {
      job = data.job;
      if (!panel.hidden) render();
    } else if (data.ended) {
      job = null;
      attempt(load);
    }
  });

  const which = el("select", {});
  which.addEventListener("change", render);
  const changes = el("div", {});

  async function load() {
    const found = await get("/api/compare/results");
    ({results} = found);
    const before = which.value;
    which.replaceChildren(...results.map((one) => el("option", {value: one.name}, one.name)));
    if (results.some((one) => one.name === before)) which.value = before;
    render();
  }

  function put(result) {
    ["difference", "significance", "change-gained", "change-lost"].forEach((name) => studio.map.remove(name));
    if (!result) return;
    result.layers.forEach((layer) => studio.map.put({...layer, group: "Change", shown: false}));
    [["change-gained", "Gained", BLUE, (r) => r.volume_l > 0, false],
      ["change-lost", "Lost", RED, (r) => r.volume_l < 0, true]].forEach(([name, title, colour, wanted, dashed]) => {
      const shapes = [];
      const texts = [];
      result.regions.filter(wanted).forEach((region) => region.outlines.forEach((ring) => {
        shapes.push(ring);
        texts.push(withSigma(region.volume_l, region.sigma_l, "l"));
      }));
      if (shapes.length) {
        studio.map.put({kind: "polygon", name, title, colour, shapes, texts, dashed, fill: 0.15, width: 2, group: "Change"});
      }
    });
  }

  function go(region) {
    const spot = leaflet.latLng(region.north_m, region.east_m);
    const bounds = region.outlines.length
      ? leaflet.latLngBounds(region.outlines.flat().map(([e, n]) => [n, e]))
      : leaflet.latLngBounds([[spot.lat - NEAR_M, spot.lng - NEAR_M], [spot.lat + NEAR_M, spot.lng + NEAR_M]]);
    studio.map.leaflet.fitBounds(bounds.pad(0.6), {animate: false});
  }

  let onMap = null;
  function changesOf() {
    const result = results.find((one) => one.name === which.value);
    if (result !== onMap) {
      onMap = result;
      put(result);
    }
    if (!result) return [el("p", {class: "note"}, "No comparison has been made yet.")];
    const lines = result.regions.map((region, n) => [
      button((n + 1) + (region.volume_l > 0 ? " gained" : " lost"), () => go(region)),
      fixed(region.area_m2, 3), withSigma(region.volume_l, region.sigma_l),
    ]);
    const still = result.unchanged;
    const facts = [
      ["Common ground", fixed(result.area_m2, 2, "m²")], ["Changed", fixed(result.changed_m2, 2, "m²")],
      ["Gained", withSigma(result.gained.volume_l, result.gained.sigma_l, "l")],
      ["Lost", withSigma(Math.abs(result.lost.volume_l), result.lost.sigma_l, "l")],
    ];
    if (still && still.robust_sigma_mm !== null) facts.push(["Unchanged ground differs by", fixed(still.robust_sigma_mm, 2, "mm")]);
    return [
      table("Against " + result.name, [], facts),
      lines.length ? table("Changed places", ["Place", "Area, m²", "Volume, l"], lines)
        : el("p", {class: "note"}, "No place has changed beyond chance."),
      el("p", {class: "note"}, "Difference and significance are in the list of layers of the map."),
    ];
  }

  const about = el("div", {});
  const alone = el("p", {class: "note", hidden: true});
  const nearField = field("Next to this one", near);
  const colours = el("p", {class: "note"});
  const looks = el("div", {}, el("fieldset", {class: "options"}, el("legend", {}, "Show"), radios),
    field("Raster", kind), colours, swipeField);
  const whichField = field("Comparison", which);
  const content = el("div", {},
    el("h2", {}, "Other survey"), alone, nearField, field("Folder", path, "It is only read"),
    el("p", {class: "buttons"}, choose), about,
    looks,
    el("h2", {}, "Change"), el("p", {class: "buttons"}, find), progress, whichField, changes);
  const lack = missing(studio, content, () => (studio.state.has.dem || studio.state.has.mosaic ? null
    : ["There is no model of this survey to compare yet: make it in Run, from a simulated dive or from pictures.", "run", "Open Run"]));
  const panel = el("div", {}, lack.element, content);

  function render() {
    const writes = studio.mayWrite();
    choose.disabled = !writes;
    find.disabled = !writes || !other || !other.comparable || Boolean(job);
    showSteps(progress, job || {steps: []});
    const scale = other?.layers.find((layer) => layer.name === kind.value)?.scale;
    colours.textContent = scale && mode !== "off"
      ? "Colours of the other run from " + [scale.low, scale.high].map((v) => number(v, "", 4)).join(" to ") + " (" + scale.label + "); those of this one are in the list of layers." : "";
    about.replaceChildren(...(other ? [el("p", {class: other.note ? "warn" : "note"}, other.note ? other.note : other.name + ", " + other.path)] : []));
    swipeField.hidden = !other || mode !== "swipe";
    looks.hidden = !other;
    whichField.hidden = results.length < 2;
    changes.replaceChildren(...changesOf());
  }

  return {
    name: "compare", title: "Compare", panel,
    enter() {
      if (!lack.show()) return;
      render();
      show();
      if (!looked) attempt(look);
    },
    leave() {
      maps.show(null, "off");
    },
  };
}
