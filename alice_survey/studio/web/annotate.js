/* The Annotate tab: labels, annotations on the mosaic, their areas, and other tools' files. */

import {attempt, button, download, el, field, get, on, save as saveFile, say, send, table} from "./core.js";
import {BLUE} from "./palette.js";
import {counted, csv, number, withSigma} from "./words.js";
import {annotationsOn, drawing} from "./annotate_map.js";
import {shownPictures} from "./annotate_pictures.js";

const MOST_ROWS = 100;
const KINDS = {point: "Point", polyline: "Line", polygon: "Polygon", rectangle: "Rectangle"};

export function tab(studio) {
  let token = "";
  let labels = [];
  let annotations = new Map();
  let colours = [];
  let formats = [];
  let pixel = 0;
  let marks = new Map();
  let label = "";
  let chosen = null;
  let tool = null;
  let loaded = false;
  const hidden = new Set();
  const past = [];
  const future = [];
  const unit = studio.state.unit;
  const square = unit + "²";
  const drawn = annotationsOn(studio, choose);

  /* ---- What the server has ---- */

  async function load() {
    const all = await get("/api/annotations");
    ({token, labels, colours, formats, pixel} = all);
    annotations = new Map(all.annotations.map((one) => [one.id, one]));
    if (!labels.some((one) => one.id === label)) label = labels[0]?.id || "";
    loaded = true;
    await measure();
    render();
  }

  async function measure() {
    marks = new Map();
    cover.replaceChildren();
    if (!annotations.size || !studio.state.has.mosaic) return;
    const found = await attempt(() => get("/api/annotations/table", quadrat.value ? {quadrat: quadrat.value} : {}));
    if (!found) return;
    found.marks.forEach((mark) => marks.set(mark.id, mark));
    cover.replaceChildren(coverTable(found), ...found.not_counted.map((line) => el("p", {class: "warn"}, "Not counted: " + line)));
  }

  /* Each change knows the way back. */
  function changeOf(put, gone, newLabels) {
    const before = {put: [], delete: [], labels: newLabels ? labels : null};
    put.forEach((one) => {
      if (annotations.has(one.id)) before.put.push(annotations.get(one.id));
      else before.delete.push(one.id);
    });
    gone.forEach((id) => before.put.push(annotations.get(id)));
    return [{put, delete: gone, labels: newLabels || null}, before];
  }

  async function write(change) {
    const answer = await send("/api/annotations/change", {token, ...change});
    ({token} = answer);
    if (change.labels) labels = change.labels;
    change.delete.forEach((id) => annotations.delete(id));
    change.put.forEach((one) => annotations.set(one.id, one));
    if (chosen && !annotations.has(chosen)) chosen = null;
    await measure();
    render();
  }

  /* One change after the other: each needs the token that the one before returned. */
  let waiting = Promise.resolve();
  const inTurn = (work) => { waiting = waiting.then(() => attempt(work)); return waiting; };

  function apply(put, gone = [], newLabels = null) {
    return inTurn(async () => {
      const [change, before] = changeOf(put, gone, newLabels);
      await write(change);
      past.push([change, before]);
      future.length = 0;
      render();
    });
  }

  const step = (from, to, which) => inTurn(async () => {
    const pair = from.pop();
    if (!pair) return;
    try {
      await write(pair[which]);
    } catch (fault) {
      from.push(pair);
      throw fault;
    }
    to.push(pair);
    say(which ? "Taken back" : "Done again");
    render();
  });
  const undo = () => step(past, future, 1);
  const redo = () => step(future, past, 0);

  on("annotations", (data) => {
    inTurn(async () => {
      if (!loaded || data.token === token) return;
      past.length = 0;
      future.length = 0;
      await load();
      say("The annotations were changed by another page: these are the new ones");
    });
  });

  /* ---- Labels ---- */

  const labelList = el("div", {role: "radiogroup", "aria-label": "Label of what is drawn next"});
  const name = el("input", {type: "text", maxlength: 200, autocomplete: "off"});
  const aphia = el("input", {type: "text", inputmode: "numeric", autocomplete: "off"});
  const colour = el("input", {type: "color", value: BLUE});
  const addLabel = el("form", {onsubmit(event) {
    event.preventDefault();
    const id = name.value.trim().split(/\s*>\s*/).filter(Boolean).join(" > ");
    if (!id) return say("A label needs a name", "error");
    if (labels.some((one) => one.id === id)) return say("There is a label " + id + " already", "error");
    const digits = aphia.value.trim();
    if (digits && !/^[1-9][0-9]*$/.test(digits)) return say("An AphiaID is a whole number", "error");
    const made = {id, aphia_id: digits ? Number(digits) : null, colour: colour.value, code: codeOf(id)};
    label = id;
    name.value = "";
    aphia.value = "";
    return apply([], [], [...labels, made]).then(() => { colour.value = colours[labels.length % colours.length]; });
  }}, field("Name", name, "Parts of a tree with > between: Porifera > Axinella"),
  el("div", {class: "row"}, field("AphiaID", aphia), field("Colour", colour)),
  el("button", {type: "submit"}, "Add the label"));

  function codeOf(id) {
    const taken = new Set(labels.map((one) => one.code));
    const word = id.split(" > ").pop().replace(/[^\p{L}\p{N}]/gu, "").toUpperCase() || "X";
    const tries = [word[0], ...[...word.slice(1)].map((c) => word[0] + c), ...Array.from({length: 99}, (_, n) => word[0] + (n + 1))];
    return tries.find((code) => !taken.has(code)) || "";
  }

  function labelRows() {
    const counts = new Map();
    annotations.forEach((one) => counts.set(one.label, (counts.get(one.label) || 0) + 1));
    return labels.map((one) => {
      const radio = el("input", {type: "radio", name: "annotate-label", value: one.id, checked: one.id === label});
      radio.addEventListener("change", () => { label = one.id; });
      const shown = el("input", {type: "checkbox", checked: !hidden.has(one.id), "aria-label": "Show " + one.id});
      shown.addEventListener("change", () => {
        if (shown.checked) hidden.delete(one.id);
        else hidden.add(one.id);
        redraw();
      });
      const count = counts.get(one.id) || 0;
      const gone = button("×", () => apply([], [], labels.filter((other) => other !== one)), {
        "aria-label": "Remove the label " + one.id, disabled: count > 0, title: count ? "It is in use" : "Remove",
      });
      return el("div", {style: {display: "flex", alignItems: "center", gap: "8px", margin: "4px 0"}},
        shown, el("label", {style: {display: "flex", alignItems: "center", gap: "8px", flex: "1", minWidth: "0"}},
          radio, el("span", {class: "swatch", style: {background: one.colour}}), el("b", {}, one.code),
          el("span", {style: {overflowWrap: "anywhere"}}, one.id + " (" + count + ")")), gone);
    });
  }

  /* ---- Tools ---- */

  const tools = Object.entries(KINDS).map(([kind, text]) => {
    const made = button(text, () => take(kind), {"aria-pressed": "false", "data-kind": kind});
    return made;
  });
  const finish = button("Finish", () => tool?.finish(), {disabled: true});

  function take(kind) {
    const same = tool && tool.kind === kind;
    studio.map.release();
    if (same) return;
    if (!label) {
      say("Add a label first: what is drawn carries it", "warn");
      return;
    }
    tool = drawing(studio, kind, (shape) => {
      const id = Array.from(crypto.getRandomValues(new Uint8Array(6)), (v) => v.toString(16).padStart(2, "0")).join("");
      chosen = id;
      apply([{
        id, label, shape, image: null, author: author.value.trim(),
        time_utc: new Date().toISOString().replace(/\.\d+/, ""), note: "", attributes: {},
      }]);
    }, () => {
      tool = null;
      press();
    });
    tool.kind = kind;
    choose(null);
    studio.map.take(tool);
    press();
    say("Click on the map, or move it with the arrow keys and take its middle with Enter; Escape ends");
  }

  function press() {
    tools.forEach((one) => one.setAttribute("aria-pressed", String(tool?.kind === one.dataset.kind)));
    finish.disabled = !["polygon", "polyline"].includes(tool?.kind);
  }

  /* ---- One annotation ---- */

  const card = el("section", {"aria-label": "Chosen annotation"});
  const pictures = el("div", {});

  function choose(id, keep = false) {
    chosen = id;
    if (!keep) pictures.replaceChildren();
    redraw();
    render();
  }

  function edited(shape, at) {
    const one = annotations.get(chosen);
    if (!one) return;
    apply([{...one, shape}]).then(() => drawn.focus(at));
  }

  function cardOf() {
    const one = annotations.get(chosen);
    if (!one) return [];
    const mark = marks.get(one.id);
    const choice = el("select", {}, labels.map((other) => el("option", {value: other.id}, other.id)));
    choice.value = one.label;
    choice.addEventListener("change", () => apply([{...one, label: choice.value}]));
    const note = el("input", {type: "text", value: one.note, maxlength: 1000});
    note.addEventListener("change", () => apply([{...one, note: note.value}]));
    const facts = [["Where", one.image || "on the mosaic"], ["Shape", one.shape.kind]];
    if (mark && mark.area !== null) facts.push(["Area", withSigma(mark.area, mark.sigma, square)]);
    if (mark && mark.length !== null) facts.push(["Length", number(mark.length, unit, 4)]);
    if (one.author) facts.push(["By", one.author]);
    if (one.time_utc) facts.push(["Made", one.time_utc]);
    Object.entries(one.attributes).forEach(([key, value]) => facts.push([key, String(value)]));
    return [
      el("h2", {}, "Chosen"), field("Label", choice), field("Note", note), table("What is known of it", [], facts),
      el("p", {class: "buttons"},
        button("Show in pictures", () => attempt(async () => pictures.replaceChildren(...await shownPictures(one))), {disabled: !studio.state.has.dem}),
        button("Go there", () => go(one)),
        button("Delete", () => apply([], [one.id])),
        button("Close", () => choose(null))),
    ];
  }

  const shapeOf = (one) => (one.image === null ? one.shape : marks.get(one.id)?.shape || null);

  function go(one) {
    const shape = shapeOf(one);
    if (!shape) return;
    const places = shape.points.map(([e, n]) => [n, e]);
    const reach = shape.radius || 20 * pixel;
    const box = leaflet.latLngBounds(places).extend([places[0][0] + reach, places[0][1] + reach])
      .extend([places[0][0] - reach, places[0][1] - reach]);
    studio.map.leaflet.fitBounds(box.pad(0.5), {animate: false});
  }

  /* ---- Tables ---- */

  const words = el("input", {type: "search", autocomplete: "off"});
  words.addEventListener("input", () => rows.replaceChildren(...rowsOf()));
  const rows = el("div", {});
  const cover = el("div", {});
  const quadrat = el("input", {type: "number", min: "0", step: "any"});
  quadrat.addEventListener("change", () => inTurn(measure));

  function wanted() {
    const text = words.value.trim().toLowerCase();
    return [...annotations.values()].filter((one) => !hidden.has(one.label)
      && (!text || [one.label, one.note, one.author, one.image || ""].some((of) => of.toLowerCase().includes(text))));
  }

  function rowsOf() {
    const found = wanted();
    const of = new Map(labels.map((one) => [one.id, one]));
    const shown = found.slice(0, MOST_ROWS);
    if (!shown.length) return [el("p", {class: "note"}, annotations.size ? "None of these." : "Nothing is annotated yet.")];
    const lines = shown.map((one) => {
      const mark = marks.get(one.id);
      const size = mark && mark.area !== null ? withSigma(mark.area, mark.sigma)
        : mark && mark.length !== null ? number(mark.length, unit, 4) : "";
      const name = button(of.get(one.label).code + " " + one.label.split(" > ").pop(), () => { choose(one.id); go(one); }, {
        "aria-pressed": String(one.id === chosen), title: one.label,
      });
      return [name, one.image === null ? one.shape.kind : one.shape.kind + ", picture", size];
    });
    const more = found.length > shown.length ? el("p", {class: "note"}, "The first " + MOST_ROWS + " of " + found.length + ".") : null;
    return [table(found.length + " annotations", ["Label", "Shape", "Area, " + square], lines), more].filter(Boolean);
  }

  function coverTable(found) {
    const side = found.rows[0]?.side;
    const lines = found.rows.map((row) => [
      ...(side ? [row.quadrat] : []), row.label, String(row.count), withSigma(row.area, row.sigma),
      withSigma(100 * row.cover, 100 * row.cover_sigma, "%"),
    ]);
    const save = () => {
      const keys = Object.keys(found.rows[0]);
      download("cover.csv", csv(keys, found.rows.map((row) => keys.map((key) => row[key]))), "text/csv");
    };
    return el("div", {}, el("div", {style: {overflowX: "auto"}, tabindex: "0", role: "region", "aria-label": "What labels cover"},
      table("Of " + number(found.known, square) + " known ground", [...(side ? ["Quadrat"] : []), "Label", "Count", "Area, " + square, "Cover"], lines)),
    el("p", {class: "buttons"}, button("Export CSV", save)));
  }

  /* ---- Files ---- */

  const format = el("select", {});
  const file = el("input", {type: "file", accept: ".json,.csv"});
  const bring = button("Import", () => inTurn(async () => {
    const [one] = file.files;
    if (!one) throw new Error("Choose a file first");
    const answer = await send("/api/annotations/import", one, {params: {format: format.value, token}});
    past.length = 0;
    future.length = 0;
    await load();
    say(answer.text);
    file.value = "";
  }));
  const save = el("p", {class: "buttons"});

  /* ---- The panel ---- */

  const author = el("input", {type: "text", maxlength: 200, autocomplete: "name", value: localStorage.getItem("alice-survey author") || ""});
  author.addEventListener("change", () => localStorage.setItem("alice-survey author", author.value.trim()));
  const back = button("Undo", undo);
  const forth = button("Redo", redo);
  const note = el("p", {class: "note"});
  const panel = el("div", {},
    note,
    el("h2", {}, "Labels"), labelList, el("details", {}, el("summary", {}, "Add a label"), addLabel),
    el("h2", {}, "Draw"), el("p", {class: "buttons"}, tools, finish, back, forth),
    el("details", {}, el("summary", {}, "Your name"), field("Goes with what you draw", author)),
    card, pictures,
    el("h2", {}, "Annotations"), field("Filter", words, "Labels, notes, names, pictures"), rows,
    el("h2", {}, "Cover"), field("Quadrats of side, " + unit, quadrat, "Empty: the whole mosaic"), cover,
    el("details", {}, el("summary", {}, "Files of other tools"), field("Tool", format), field("File", file), el("p", {class: "buttons"}, bring),
      el("h3", {}, "Save for"), save));

  function redraw() {
    const numbers = new Map(labels.map((one, n) => [one.id, n]));
    const all = [...annotations.values()].filter((one) => !hidden.has(one.label)).map((one) => ({
      annotation: one, label: labels[numbers.get(one.label)], number: numbers.get(one.label), shape: shapeOf(one),
    })).filter((mark) => mark.shape);
    drawn.draw(all, chosen);
    const one = annotations.get(chosen);
    drawn.edit(one && one.image === null && studio.mayWrite() ? one.shape : null, pixel || 0.001, edited);
  }

  function render() {
    note.textContent = studio.state.has.mosaic ? "" : "There is no mosaic to annotate yet.";
    const focused = document.activeElement?.value;
    labelList.replaceChildren(...labelRows());
    if (!labels.length) labelList.append(el("p", {class: "note"}, "No labels yet: add one, or import a species list."));
    card.replaceChildren(...cardOf());
    rows.replaceChildren(...rowsOf());
    format.replaceChildren(...formats.map((one) => el("option", {value: one.name}, one.title)));
    save.replaceChildren(...[...formats, {name: "geojson", title: "GeoJSON"}].map((one) => button(one.title, () => attempt(() => saveFile("/api/annotations/export/" + one.name, "annotations")), {"data-export": one.name, disabled: !annotations.size})));
    back.disabled = !past.length;
    forth.disabled = !future.length;
    const writes = studio.mayWrite();
    [...tools, bring, ...addLabel.querySelectorAll("button")].forEach((one) => { one.disabled = !writes; });
    if (focused) labelList.querySelector(`input[type=radio][value="${CSS.escape(focused)}"]`)?.focus();
    redraw();
  }

  return {
    name: "annotate", title: "Annotate", panel,
    enter() {
      drawn.show(true);
      if (!loaded) inTurn(load);
      else redraw();
    },
    leave() {
      drawn.show(false);
    },
    keys: {
      "Ctrl+z": undo, "Ctrl+y": redo,
      Delete: () => { if (chosen) apply([], [chosen]); },
    },
  };
}
