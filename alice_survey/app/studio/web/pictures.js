/* Pictures: a spot picked in the pictures as taken, lengths with sigma, control, scale. */

import {
  PAGE, attempt, button, el, field, get, missing, on, say, send, sendNewest, table,
} from "./core.js";
import {ORANGE} from "./palette.js";
import {counted, number, withSigma} from "./words.js";
import {controlForm, controlRows, mm} from "./picture_control.js";
import {Wall, addressOf} from "./picture_views.js";

const BAD_PX = 2;
const shownBy = (count) => counted(count, "picture shows the spot", "pictures show the spot");

export function tab(studio) {
  let held = {token: "", points: [], control: null, unit: studio.state.unit};
  let control = {token: "", rows: []};
  let chosen = [];
  let wall = null;
  let checking = 0;

  const name = el("input", {type: "text", value: "", maxlength: "100", autocomplete: "off"});
  const sigma = el("input", {type: "number", min: "0.01", max: "20", step: "any", value: "0.3"});
  const spotText = el("p", {class: "note", "aria-live": "polite"}, "No spot yet.");
  const save = button("Save the point", () => attempt(savePoint), {
    class: "primary", disabled: true});
  const find = el("input", {type: "search", placeholder: "part of a name"});
  const list = el("div", {class: "list", role: "group", "aria-label": "Pictures"});
  const points = el("div", {class: "points"});
  const lengthText = el("p", {"aria-live": "polite"}, "Choose two points of the table.");
  const known = el("input", {type: "number", min: "0", step: "any"});
  const scaleBox = el("div", {hidden: true}, field("Its true length, m", known),
    button("Set the scale", () => attempt(setScale)));
  const controlBox = el("div", {});

  const content = el("div", {},
    el("h2", {}, "Pick a spot"),
    el("div", {class: "buttons"},
      button("Choose on the map", takeSpot, {class: "primary"}),
      button("Show pictures", () => { ready().root.hidden = false; })),
    el("details", {ontoggle: (event) => event.target.open && attempt(listPictures)},
      el("summary", {}, "Start from a picture"), field("Find", find), list),
    el("div", {class: "row"}, field("Name of the point", name),
      field("Sigma of a pick by eye, px", sigma)),
    spotText, el("div", {class: "buttons"}, save, button("Start another", clearSpot)),
    points,
    el("h2", {}, "Length"), lengthText, scaleBox,
    el("h2", {}, "Control"), controlBox,
  );
  const lack = missing(studio, content, () => (
    ["pictures", "sparse", "dem"].some((name) => studio.state.has[name]) ? null
    : ["There are no pictures to pick in yet: fly the plan or import your own in Run, then "
      + "reconstruct them.", "run", "Open Run"]));
  const panel = el("div", {class: "pictures"}, lack.element, content);
  find.addEventListener("input", () => attempt(listPictures));

  function ready() {
    wall = wall || new Wall(
      {changed: picked, used: () => attempt(look), refine: (view) => attempt(() => refine(view))});
    return wall;
  }

  /* ---- Which pictures ---- */

  function takeSpot() {
    ready().hide();
    say("Click the spot on the map, or press Enter for its middle.");
    studio.map.take({
      name: "spot",
      click: (place) => {
        studio.map.release();
        attempt(() => see({n: place.lat, e: place.lng}));
      },
      text: () => "; click the spot to pick",
    });
    document.getElementById("map-canvas").focus({preventScroll: true});
  }

  async function see(params) {
    say("Looking for the pictures that show it…");
    const found = await get("/api/pictures/seeing", {...params, count: 40});
    if (!found.pictures.length) throw new Error("no picture shows that spot");
    clearSpot();
    ready().show(shownBy(found.total), found.pictures);
    say("The spot is at " + number(found.place.n, held.unit, 5) + " north, "
      + number(found.place.e, held.unit, 5)
      + " east. Click it in a picture" + (found.hidden ? "; in " + found.hidden
        + " it is hidden." : "."));
    return found;
  }

  async function listPictures() {
    const wanted = find.value;
    const found = await get("/api/pictures", {find: wanted, count: 60});
    if (wanted !== find.value) return;  /* an answer that a later one has overtaken */
    list.replaceChildren(...found.pictures.map(
      (one) => button(one.name + (one.registered ? "" : " (not in the model)"),
      () => showOne(one.name), {disabled: !one.registered})));
    if (found.total > found.pictures.length) list.append(
      el("small", {}, "and " + (found.total - found.pictures.length) + " more"));
  }

  /* A picture whole; what is picked in it says which others show the spot. */
  async function showOne(image) {
    clearSpot();
    const about = await attempt(() => get(addressOf(image) + "/about"));
    if (!about) return;
    ready().show("Click the spot in the picture",
      [{name: image, x: about.width / 2, y: about.height / 2, whole: true}]);
  }

  /* ---- Picks ---- */

  const used = () => (wall ? wall.views.filter((view) => view.pick && view.use) : []);
  const asPick = (view) => ({
    image: view.name, point: name.value.trim() || "point", x: view.pick.x, y: view.pick.y,
    sigma_px: view.pick.sigma_px || Number(sigma.value) || 0.5,
    matched_to: used().some((one) => one.name === view.pick.matched_to) ? view.pick.matched_to : "",
  });

  function picked(view) {
    wall.choose(view);
    view.pick.sigma_px = Number(sigma.value) || 0.5;
    view.say("picked by eye");
    if (view.seen.whole) {
      const {x, y} = view.pick;
      attempt(async () => {
        const found = await get("/api/pictures/seeing", {image: view.name, x, y, count: 40});
        wall.title.textContent = shownBy(found.total);
        wall.waiting = found.pictures.filter((one) => !wall.of(one.name));
        view.seen = {...view.seen, whole: false};
        wall.showMore(5);
      });
    }
    attempt(look);
  }

  /* What the picks show: the spot, and how far each misses it. */
  async function look() {
    const views = used();
    save.disabled = !views.length;
    const mine = checking += 1;
    if (views.length < 2) {
      spotText.textContent = views.length
        ? "Picked in one picture; two are needed." : "No spot yet.";
      return;
    }
    const found = await sendNewest("/api/picks/position", {picks: views.map(asPick)});
    if (mine !== checking) return;
    const {position} = found;
    const [north, east, down] = position.sigma.map(mm);
    spotText.textContent = counted(position.views, "picture") + ", "
      + number(position.rms_px, "px", 2)
      + " rms; sigma north " + north + ", east " + east + ", down " + down
        + (held.unit === "m" ? " mm" : " thousandths");
    found.residuals.forEach((one) => {
      const view = wall.of(one.image);
      const size = one.residual ? Math.hypot(...one.residual) : null;
      const how = view.pick.matched_to ? "found, sigma " + number(view.pick.sigma_px, "px",
        2) : "picked by eye";
      if (one.left_out) view.say("BAD: " + number(size, "px", 2) + " off the others, left out",
        "error");
      else view.say(how + "; " + number(size, "px", 2) + " off"
        + (size > BAD_PX ? ": BAD, pick again" : ""), size > BAD_PX ? "error" : "note");
    });
  }

  async function refine(view) {
    if (!view?.pick) throw new Error("pick the spot in a picture first");
    say("Looking for it in the other pictures…");
    const pick = {...asPick(view), matched_to: ""};
    const wanted = [...wall.views, ...wall.waiting].map((one) => one.name)
      .filter((one) => one !== view.name);
    const found = await send("/api/picks/refine", {pick, images: wanted.slice(0, 20)});
    found.picks.slice(1).forEach((one) => {
      const target = wall.need({name: one.image, x: one.x, y: one.y});
      if (!target.pick || target.pick.matched_to) target.set(
        {x: one.x, y: one.y, sigma_px: one.sigma_px, matched_to: view.name});
    });
    found.refused.forEach((one) => wall.of(one.name)?.say("not found: " + one.why, "warn"));
    say("Found in " + counted(found.picks.length - 1, "picture") + ", not in "
      + found.refused.length + ".");
    await look();
  }

  function clearSpot() {
    wall?.clear();
    wall?.hide();
    checking += 1;
    spotText.textContent = "No spot yet.";
    save.disabled = true;
    name.value = freeName();
  }

  function freeName() {
    const names = new Set(held.points.map((point) => point.name));
    let number_ = 1;
    while (names.has("P" + number_)) number_ += 1;
    return "P" + number_;
  }

  /* Replace rows of a file by others. */
  async function change(path, table_, rows) {
    table_.token = (await send(path, {token: table_.token, page: PAGE, ...rows})).token;
    await load();
  }

  async function savePoint() {
    const point = name.value.trim();
    if (!point) throw new Error("give the point a name");
    await change("/api/picks/save", held, {points: [point], picks: used().map(asPick)});
    say("Saved " + point + " to picks.csv.");
  }

  async function removePoint(point) {
    chosen = chosen.filter((one) => one !== point);
    await change("/api/picks/save", held, {points: [point], picks: []});
    say("Took " + point + " out of picks.csv.");
  }

  function openPoint(point) {
    clearSpot();
    name.value = point.name;
    ready().show(point.name, point.picks.map((one) => ({name: one.image, x: one.x, y: one.y})),
      point.picks.length);
    point.picks.forEach((one) => wall.of(one.image).set({...one}));
    attempt(look);
    if (point.position) {
      attempt(async () => {
        const found = await get("/api/pictures/seeing", {
          n: point.position.n, e: point.position.e, count: 40});
        wall.waiting = found.pictures.filter((one) => !wall.of(one.name));
        wall.showMore(0);
      });
    }
  }

  /* ---- The table ---- */

  const worstOf = (point) => point.picks.reduce((worst, pick) => {
    const size = pick.residual ? Math.hypot(...pick.residual) : -1;
    return size > worst.size ? {size, image: pick.image} : worst;
  }, {size: -1, image: ""});

  function drawPoints() {
    if (!held.points.length) {
      points.replaceChildren(el("p", {class: "note"}, "No point is picked yet."));
      return;
    }
    const unit = held.unit === "m" ? "mm" : "1/1000";
    points.replaceChildren(
      table("Points", ["Point", "Views", "Sigma N, E, D, " + unit, "Worst, px", "Change"],
      held.points.map((point) => {
      const worst = worstOf(point);
      const bad = point.picks.some((pick) => pick.left_out) || worst.size > BAD_PX;
      const box = el("input", {type: "checkbox", "data-point": point.name,
        checked: chosen.includes(point.name),
        onchange: (event) => choose(point.name, event.target.checked)});
      return [
        el("label", {}, box, " " + point.name),
        point.position ? String(point.position.views) : String(point.picks.length),
        point.position ? point.position.sigma.map(mm)
          .join(", ") : el("span", {class: "warn"}, point.why || "no model yet"),
        el("span", {class: bad ? "error" : null},
          worst.size < 0 ? "" : number(worst.size, "", 2) + (bad ? " BAD: " + worst.image : "")),
        point.coded ? "marker" : [
          button("Open", () => openPoint(point), {"aria-label": "Open " + point.name}), " ",
          button("Delete", () => attempt(() => removePoint(point.name)),
            {"aria-label": "Delete " + point.name})],
      ];
    })));
    studio.map.put({
      kind: "point", name: "picked", title: "Picked points", colour: ORANGE, group: "Pictures",
      shapes: held.points.filter((point) => point.position)
        .map((point) => [[point.position.e, point.position.n]]),
      texts: held.points.filter((point) => point.position).map((point) => point.name),
    });
  }

  function choose(point, isOn) {
    chosen = chosen.filter((one) => one !== point);
    if (isOn) chosen = [...chosen, point].slice(-2);
    drawPoints();
    [...points.querySelectorAll("[data-point]")].find((box) => box.dataset.point === point)?.focus(
      {preventScroll: true});
    attempt(measure);
  }

  /* ---- Lengths and scale ---- */

  const picksOf = (point) => held.points.find((one) => one.name === point).picks.map(
    ({image, x, y, sigma_px, matched_to}) => ({image, point, x, y, sigma_px, matched_to}));

  async function measure() {
    scaleBox.hidden = true;
    if (chosen.length < 2) {
      lengthText.textContent = "Choose two points of the table.";
      return;
    }
    lengthText.textContent = "Measuring…";
    const found = await sendNewest("/api/picks/length", {
      first: picksOf(chosen[0]), second: picksOf(chosen[1])}).catch((fault) => {
      if (fault.name !== "AbortError") lengthText.textContent = "No length between these two.";
      throw fault;
    });
    const part = (value) => (found.unit === "m" ? mm(value) + " mm" : number(value, found.unit, 2));
    lengthText.replaceChildren(
      el("strong", {}, chosen.join(" to ") + ": " + withSigma(found.value, found.sigma,
      found.unit)),
      ". Of the sigma, picks " + part(found.sigma_picks) + ", poses " + part(found.sigma_poses)
        + ", scale " + part(found.sigma_scale) + ".");
    Object.assign(lengthText.dataset, {value: found.value, sigma: found.sigma});
    scaleBox.hidden = held.scaled_by_rig;
  }

  async function setScale() {
    const length_m = Number(known.value);
    if (!(length_m > 0)) throw new Error("give the true length in metres");
    const done = await send(
      "/api/scale", {first: picksOf(chosen[0]), second: picksOf(chosen[1]), length_m});
    say(done.line);
  }

  /* ---- Control ---- */

  async function saveControl(rows, names) {
    await change("/api/control/save", control, {rows, names});
    say("Saved to control.csv. Run the reconstruction for the model to use it.");
  }

  function drawControl() {
    controlBox.replaceChildren(
      controlRows(control.rows, held.control,
        (row) => attempt(() => saveControl([], [[row.kind, row.name]]))),
      controlForm(held.points.map((point) => point.name),
        (row) => attempt(() => saveControl([row], []))));
    if (control.rows.length) controlBox.append(el("p", {class: "note"},
      "Run the reconstruction again for the model to use what is saved here. ",
      button("Open Run", () => studio.open("run"))));
  }

  async function load() {
    [held, control] = await Promise.all([get("/api/picks"), get("/api/control")]);
    drawPoints();
    drawControl();
  }

  on("picks", ({file, page}) => {
    if (page === PAGE || panel.hidden || !file) return;
    say(file + " was changed by another page: loaded again.", "warn");
    attempt(load);
  });

  return {
    name: "pictures", title: "Pictures", panel,
    enter(args) {
      if (!lack.show()) return;
      attempt(async () => {
        await load();
        if (!name.value) name.value = freeName();
        if (args?.spot) await see(args.spot);
      });
    },
    leave() { wall?.hide(); },
  };
}
