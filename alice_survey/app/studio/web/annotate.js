/* The Annotate tab: labels, annotations on the mosaic, their areas, and other tools' files. */

import {attempt, button, el, field, get, on, save as saveFile, say, send, table} from "./core.js";
import {BLUE} from "./palette.js";
import {Wall} from "./picture_views.js";
import {canRedo, canUndo, current, record, redo, startHistory, undo} from "./undo.js";
import {vertexHandles} from "./vertices.js";
import {counted, number, withSigma} from "./words.js";
import {annotationsOn} from "./annotate_map.js";
import {isArea, targetOf} from "./annotate_shapes.js";
import {annotationTable, coverTable, surfaceCells, warnings} from "./annotate_tables.js";
import {drawingTool} from "./drawing.js";
import {missing} from "./missing.js";
import {startOwnSaves} from "./own_saves.js";
import {pictureDrawing, pictureEditing} from "./picture_drawing.js";

const NOTHING = {labels: [], annotations: new Map()};
const KINDS = {point: "Point", polyline: "Line", polygon: "Polygon", rectangle: "Rectangle"};

export function tab(studio) {
  const unit = studio.state.unit;
  const square = unit + "²";
  let token = "";
  let history = startHistory(NOTHING);
  let stored = NOTHING;  /* what the server has */
  let colours = [];
  let formats = [];
  let marks = new Map();
  let surfaces = new Map();  /* rows of the server, with the annotation that each is `of` */
  let surfaceRows = null;
  let asked = 0;
  let lost = [];
  let label = "";
  let chosen = null;
  let tool = null;
  let pixel = 0;
  let [loaded, entered] = [false, false];
  const hidden = new Set();
  const saves = startOwnSaves();
  const drawn = annotationsOn(studio, choose);
  const drawing = drawingTool(studio, "annotate");
  const handles = vertexHandles(studio.map.leaflet, "annotate", {
    unit, changed: (next, tag) => (next ? put(next, tag) : remove(chosen)), moving: redraw,
    left: () => { choose(null); document.getElementById("map-canvas").focus(); },
  });
  const now = () => current(history);

  /* ---- What the server has ---- */

  async function load() {
    const all = await get("/api/annotations");
    ({token, colours, formats, pixel} = all);
    stored = {labels: all.labels, annotations: new Map(all.annotations.map((one) => [one.id, one]))};
    history = startHistory(stored);
    loaded = true;
    await measure();
    render();
  }

  async function measure() {
    marks = new Map();
    lost = [];
    asked += 1;
    cover.replaceChildren();
    surfaces = new Map([...surfaces].filter(([id, row]) => stored.annotations.get(id) === row.of));
    surfaceRows = null;
    progress.textContent = "";
    if (!stored.annotations.size || !studio.state.has.mosaic) return;
    const found = await attempt(() => get("/api/annotations/table", sideNow()));
    if (!found) return;
    found.marks.forEach((mark) => marks.set(mark.id, mark));
    lost = found.not_counted;
    showCover(found.rows, found.known);
    if (studio.state.has.dem) measureSurfaces(found.known);
  }

  const sideNow = () => (quadrat.value ? {quadrat: quadrat.value} : {});

  /* Measured by the server a while at a time, which edits meanwhile end. */
  async function measureSurfaces(known) {
    const own = asked;
    const of = stored.annotations;
    for (;;) {
      const found = await attempt(() => get("/api/annotations/surfaces", sideNow()));
      if (own !== asked) return;
      progress.textContent = found && !found.each ? "Measuring surfaces: " + found.done.toLocaleString("en") + " of " + found.total.toLocaleString("en") : "";
      if (!found) return;
      if (found.each) {
        surfaceRows = found.each;
        surfaces = new Map(found.each.map((row) => [row.id, {...row, of: of.get(row.id)}]));
        showCover(found.rows, known, found.without_surface);
        rows.replaceChildren(...rowsOf());
        renderCard();
        return;
      }
    }
  }

  function showCover(rowsOfLabels, known, without = []) {
    cover.replaceChildren(coverTable(rowsOfLabels, known, unit), ...warnings("Not counted", lost), ...warnings("Without a surface", without));
  }

  /* One request after the other: each needs the token that the one before returned. */
  let waiting = Promise.resolve();
  const inTurn = (work) => { waiting = waiting.then(() => attempt(work)); return waiting; };

  function edit(state, tag = "") {
    history = record(history, {...now(), ...state}, tag, Date.now());
    return store();
  }
  const put = (one, tag) => edit({annotations: new Map(now().annotations).set(one.id, one)}, tag);
  function remove(id) {
    const annotations = new Map(now().annotations);
    annotations.delete(id);
    return edit({annotations});
  }

  /* Shown at once, and written when it is its turn; where that fails, what the server has is shown. */
  function store() {
    render();
    return inTurn(async () => {
      const next = now();
      if (next === stored) return;
      try {
        ({token} = await saves.save(send("/api/annotations/change", {token, ...changeBetween(stored, next)})));
      } catch (fault) {
        await load();
        throw fault;
      }
      stored = next;
      await measure();
      render();
    });
  }

  function step(way, text) {
    history = way(history);
    say(text);
    return store();
  }

  on("annotations", async (data) => {
    if (await saves.isOwn(data.token)) return;
    inTurn(async () => {
      if (!loaded || data.token === token) return;
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
    const {labels} = now();
    if (labels.some((one) => one.id === id)) return say("There is a label " + id + " already", "error");
    const digits = aphia.value.trim();
    if (digits && !/^[1-9][0-9]*$/.test(digits)) return say("An AphiaID is a whole number", "error");
    const made = {id, aphia_id: digits ? Number(digits) : null, colour: colour.value, code: codeOf(id)};
    label = id;
    name.value = "";
    aphia.value = "";
    colour.value = colours[(labels.length + 1) % colours.length];
    return edit({labels: [...labels, made]});
  }}, field("Name", name, "Parts of a tree with > between: Porifera > Axinella"),
  el("div", {class: "row"}, field("AphiaID", aphia), field("Colour", colour)),
  el("button", {type: "submit"}, "Add the label"));

  function codeOf(id) {
    const taken = new Set(now().labels.map((one) => one.code));
    const word = id.split(" > ").pop().replace(/[^\p{L}\p{N}]/gu, "").toUpperCase() || "X";
    const tries = [word[0], ...[...word.slice(1)].map((c) => word[0] + c), ...Array.from({length: 99}, (_, n) => word[0] + (n + 1))];
    return tries.find((code) => !taken.has(code)) || "";
  }

  function labelRows() {
    const counts = new Map();
    const {labels} = now();
    now().annotations.forEach((one) => counts.set(one.label, (counts.get(one.label) || 0) + 1));
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
      const gone = button("×", () => edit({labels: labels.filter((other) => other !== one)}), {
        "aria-label": "Delete the label " + one.id, disabled: count > 0, title: count ? "It is in use" : "Delete",
      });
      return el("div", {class: "option"},
        shown, el("label", {class: "option"},
          radio, el("span", {class: "swatch", style: {background: one.colour}}), el("b", {}, one.code),
          el("span", {}, one.id + " (" + count + ")")), gone);
    });
  }

  /* ---- Tools ---- */

  const tools = Object.entries(KINDS).map(([kind, text]) => {
    const made = button(text, () => take(kind), {"aria-pressed": "false", "data-kind": kind});
    return made;
  });

  function putNew(image, kind, points) {
    const id = Array.from(crypto.getRandomValues(new Uint8Array(6)), (v) => v.toString(16).padStart(2, "0")).join("");
    chosen = id;
    return put({
      id, label, shape: {kind, points, holes: [], radius: null}, image,
      author: author.value.trim(), time_utc: new Date().toISOString().replace(/\.\d+/, ""), note: "", attributes: {},
    });
  }

  function hasLabel() {
    if (!label) say("Add a label first: what is drawn carries it", "warn");
    return Boolean(label);
  }

  const colourOf = (one) => now().labels.find(({id}) => id === one.label).colour;
  const colourNow = () => colourOf({label});

  /* In the pictures that show the middle of the map. */
  let inPictures = null;
  const kindInPictures = el("select", {}, Object.entries(KINDS).map(([kind, text]) => el("option", {value: kind}, text)));
  kindInPictures.value = "polygon";
  const toPictures = button("Show the pictures of the map's middle", () => attempt(drawInPictures));
  async function drawInPictures() {
    if (!hasLabel()) return;
    studio.map.release();
    const {lat, lng} = studio.map.leaflet.getCenter();
    const {pictures, total} = await get("/api/pictures/seeing", {n: lat, e: lng, count: 40});
    if (!pictures.length) throw new Error("no picture shows the middle of the map");
    inPictures = inPictures || pictureDrawing({
      done: async (image, kind, points) => {
        say(KINDS[kind] + " drawn in " + image);
        await putNew(image, kind, points);
        sayIfLost(chosen);
      },
    });
    hideWalls();
    inPictures.begin(counted(total, "picture shows", "pictures show") + " the middle of the map", pictures, {kind: kindInPictures.value, colour: colourNow()});
  }

  function sayIfLost(id) {
    const line = lost.find((text) => text.includes(id));
    if (line) say("It is kept, and not on the mosaic: " + line.slice(line.indexOf(": ") + 2), "warn");
  }

  /* One that was drawn in a picture is edited in that picture. */
  let editing = null;
  async function editInPicture(one) {
    hideWalls();
    editing = editing || pictureEditing({
      now: () => now().annotations.get(chosen),
      changed: async (next, tag) => {
        await (next ? put(next, tag) : remove(chosen));
        if (next) sayIfLost(next.id);
      },
    });
    editing.begin(one, colourOf(one));
  }

  function hideWalls() {
    wall?.hide();
    inPictures?.hide();
    editing?.hide();
  }

  function take(kind) {
    const isSame = tool === kind;
    studio.map.release();
    if (isSame) return;
    if (!hasLabel()) return;
    choose(null);
    drawing.begin({
      kind: kind === "polyline" ? "line" : kind, colour: colourNow(), again: true,
      done: (points) => putNew(null, kind, points.map(([n, e]) => [e, n])),
      ended() {
        tool = null;
        press();
      },
    });
    tool = kind;
    press();
  }

  function press() {
    tools.forEach((one) => one.setAttribute("aria-pressed", String(tool === one.dataset.kind)));
    redraw();
  }

  /* ---- One annotation ---- */

  const card = el("section", {"aria-label": "Chosen annotation"});
  let wall = null;

  function choose(id) {
    chosen = id;
    hideWalls();
    redraw();
    render();
  }

  async function showPictures(one) {
    const {pictures} = await get("/api/annotations/" + one.id + "/pictures");
    if (!pictures.length) throw new Error("no registered picture shows it");
    hideWalls();
    wall = wall || new Wall();
    wall.show(counted(pictures.length, "picture that shows it best", "pictures that show it best"), pictures.map(({image, rings, sigma_px}) => ({
      name: image, rings, closed: isArea(one.shape), x: 0, y: 0, about: "outline known to " + number(sigma_px, "px", 2),
    })));
  }

  function cardOf() {
    const one = now().annotations.get(chosen);
    if (!one) return [];
    const mark = marks.get(one.id);
    const choice = el("select", {}, now().labels.map((other) => el("option", {value: other.id}, other.id)));
    choice.value = one.label;
    choice.addEventListener("change", () => put({...one, label: choice.value}));
    const note = el("input", {type: "text", value: one.note, maxlength: 1000});
    note.addEventListener("change", () => put({...one, note: note.value}));
    const facts = [["Where", one.image || "on the mosaic"], ["Shape", one.shape.kind]];
    if (mark && mark.area !== null) facts.push(["Area in plan", withSigma(mark.area, mark.sigma, square)], ...surfaceFacts(one));
    if (mark && mark.length !== null) facts.push(["Length", number(mark.length, unit, 4)]);
    if (one.author) facts.push(["By", one.author]);
    if (one.time_utc) facts.push(["Made", one.time_utc]);
    Object.entries(one.attributes).forEach(([key, value]) => facts.push([key, String(value)]));
    return [
      el("h2", {}, "Chosen"), field("Label", choice), field("Note", note), table("What is known of it", [], facts),
      el("p", {class: "buttons"},
        one.image === null ? "" : button("Edit in its picture", () => editInPicture(one), {disabled: !studio.mayWrite()}),
        button("Show in pictures", () => attempt(() => showPictures(one)), {disabled: !studio.state.has.dem}),
        button("Go there", () => go(one)),
        button("Delete", () => remove(one.id)),
        button("Close", () => choose(null))),
    ];
  }

  function surfaceFacts(one) {
    if (!studio.state.has.dem) return [];
    const row = surfaces.get(one.id);
    if (!row && !surfaceRows) return [["Area of the surface", "is being measured …"]];
    const [size, rugosity] = surfaceCells(row, square);
    return size ? [["Area of the surface", size], ["Rugosity", rugosity]] : [["Area of the surface", "unknown"]];
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
  const progress = el("p", {class: "note", role: "status"});
  const quadrat = el("input", {type: "number", min: "0", step: "any"});
  quadrat.addEventListener("change", () => inTurn(measure));

  function wanted() {
    const text = words.value.trim().toLowerCase();
    return [...now().annotations.values()].filter((one) => !hidden.has(one.label)
      && (!text || [one.label, one.note, one.author, one.image || ""].some((of) => of.toLowerCase().includes(text))));
  }

  function rowsOf() {
    const found = wanted();
    const of = new Map(now().labels.map((one) => [one.id, one]));
    if (!found.length) return [el("p", {class: "note"}, now().annotations.size ? "None of these." : "Nothing is annotated yet.")];
    return annotationTable(found, {
      unit, rows: surfaceRows?.filter((row) => found.some(({id}) => id === row.id)),
      mark: (one) => marks.get(one.id), surface: (one) => surfaces.get(one.id),
      name: (one) => button(of.get(one.label).code + " " + one.label.split(" > ").pop(), () => { choose(one.id); go(one); }, {
        "aria-pressed": String(one.id === chosen), title: one.label,
      }),
    });
  }

  /* ---- Files ---- */

  const format = el("select", {});
  const file = el("input", {type: "file", accept: ".json,.csv"});
  const bring = button("Import", () => inTurn(async () => {
    const [one] = file.files;
    if (!one) throw new Error("Choose a file first");
    const answer = await send("/api/annotations/import", one, {params: {format: format.value, token}});
    await load();
    say(answer.text);
    file.value = "";
  }));
  const save = el("p", {class: "buttons"});

  /* ---- The panel ---- */

  const author = el("input", {type: "text", maxlength: 200, autocomplete: "name", value: localStorage.getItem("alice-survey author") || ""});
  author.addEventListener("change", () => localStorage.setItem("alice-survey author", author.value.trim()));
  const back = button("Undo", () => step(undo, "Undone"), {title: "Ctrl+Z"});
  const forth = button("Redo", () => step(redo, "Done again"), {title: "Ctrl+Shift+Z"});
  const content = el("div", {},
    el("h2", {}, "Labels"), labelList, el("details", {}, el("summary", {}, "Add a label"), addLabel),
    el("h2", {}, "Draw"), el("p", {class: "buttons"}, tools, back, forth), drawing.element,
    el("details", {}, el("summary", {}, "Draw in pictures"), field("Shape", kindInPictures), el("p", {class: "buttons"}, toPictures)),
    el("details", {}, el("summary", {}, "Your name"), field("Goes with what you draw", author)),
    card,
    el("h2", {}, "Annotations"), field("Filter", words, "Labels, notes, names, pictures"), progress, rows,
    el("h2", {}, "Cover"), field("Quadrats of side, " + unit, quadrat, "Empty: the whole mosaic"), cover,
    el("details", {}, el("summary", {}, "Files of other tools"), field("Tool", format), field("File", file), el("p", {class: "buttons"}, bring),
      el("h3", {}, "Export for"), save));
  const lack = missing(studio, content, () => (studio.state.has.mosaic ? null
    : ["There is no mosaic to annotate yet: make it in Run, from a simulated dive or from pictures.", "run", "Open Run"]));
  const panel = el("div", {}, lack.element, content);

  /* With one annotation as it is while it is dragged. */
  function redraw(moved = null) {
    const {labels, annotations} = now();
    const numbers = new Map(labels.map((one, n) => [one.id, n]));
    const as = (one) => (moved && one.id === moved.id ? moved : one);
    const all = [...annotations.values()].map(as).filter((one) => !hidden.has(one.label)).map((one) => ({
      annotation: one, label: labels[numbers.get(one.label)], number: numbers.get(one.label), shape: shapeOf(one),
    })).filter((mark) => mark.shape);
    drawn.draw(all, chosen);
    const one = annotations.has(chosen) && as(annotations.get(chosen));
    handles.show(entered && one && one.image === null && !tool && studio.mayWrite() ? targetOf(one) : null);
  }

  function renderCard() {
    const focused = card.contains(document.activeElement) ? document.activeElement.textContent : null;
    card.replaceChildren(...cardOf());
    if (focused) [...card.querySelectorAll("button")].find((one) => one.textContent === focused)?.focus({preventScroll: true});
  }

  function render() {
    const {labels, annotations} = now();
    if (!labels.some((one) => one.id === label)) label = labels[0]?.id || "";
    if (!annotations.has(chosen)) chosen = null;
    const focused = document.activeElement?.value;
    labelList.replaceChildren(...labelRows());
    if (!labels.length) labelList.append(el("p", {class: "note"}, "No labels yet: add one, or import a species list."));
    renderCard();
    rows.replaceChildren(...rowsOf());
    format.replaceChildren(...formats.map((one) => el("option", {value: one.name}, one.title)));
    save.replaceChildren(...[...formats, {name: "geojson", title: "GeoJSON"}].map((one) => button(one.title, () => attempt(() => saveFile("/api/annotations/export/" + one.name, "annotations")), {"data-export": one.name, disabled: !annotations.size})));
    [back.disabled, forth.disabled] = [!canUndo(history), !canRedo(history)];
    const writes = studio.mayWrite();
    [...tools, toPictures, bring, ...addLabel.querySelectorAll("button")].forEach((one) => { one.disabled = !writes; });
    if (focused) labelList.querySelector(`input[type=radio][value="${CSS.escape(focused)}"]`)?.focus();
    redraw();
    editing?.refresh();
  }

  return {
    name: "annotate", title: "Annotate", panel,
    enter() {
      entered = true;
      if (!lack.show()) return;
      drawn.show(true);
      if (!loaded) inTurn(load);
      else redraw();
    },
    leave() {
      entered = false;
      drawn.show(false);
      handles.show(null);
      hideWalls();
    },
    keys: {
      "Ctrl+z": () => step(undo, "Undone"), "Ctrl+y": () => step(redo, "Done again"), "Ctrl+Z": () => step(redo, "Done again"),
      Delete: () => chosen && remove(chosen),
    },
  };
}

/* What to put, delete and name for the second state to follow on the first. */
function changeBetween(from, to) {
  return {
    put: [...to.annotations.values()].filter((one) => from.annotations.get(one.id) !== one),
    delete: [...from.annotations.keys()].filter((id) => !to.annotations.has(id)),
    labels: from.labels === to.labels ? null : to.labels,
  };
}
