/* Views of pictures as taken, each about a pixel, with crosses for what is expected and picked.
   Pixels count from 0 at the middle of the first one, as in picks.csv. */

import {attempt, button, el, get} from "./core.js";
import {number} from "./words.js";

const CLOSE = 2;  /* zoom at which a pixel has four of the screen's */
const place = (x, y) => [-(y + 0.5), x + 0.5];
export const addressOf = (name) => "/api/pictures/" + name.split("/").map(encodeURIComponent).join(
  "/");

/* A cross of lines with a gap in its middle, so that the pixel under it is seen. */
function cross(kind) {
  const dark = {stroke: "#000", "stroke-width": 4, "stroke-opacity": 0.55, fill: "none"};
  const light = {stroke: kind === "picked" ? "#ffd400" : "#4cc9ff", "stroke-width": 2,
    fill: "none"};
  const paths = kind === "picked"
    ? "M-16 0h12M4 0h12M0-16v12M0 4v12" : "M-12-12l7 7M12-12l-7 7M-12 12l7-7M12 12l-7-7";
  return el("svg", {viewBox: "-20 -20 40 40", width: 40, height: 40, "aria-hidden": "true",
    class: "cross " + kind},
    el("path", {d: paths, ...dark}), el("path", {d: paths, ...light}));
}

class PictureView {
  /* `seen` is a picture that sees the spot: name, and where it is expected (x, y), or that it is
     shown `whole`. `changed(view)` is called where a person picks, `used()` where one takes or
     drops a pick that stays, `chosen(view)` where the view has the focus. */
  constructor(seen, {changed, used, chosen}) {
    this.name = seen.name;
    this.seen = seen;
    this.pick = null;
    this.use = true;
    this.onPick = changed;
    this.box = el("div", {
      class: "picture-view", tabindex: "0", role: "application",
      "aria-label": "Picture " + seen.name + ": click to pick; arrow keys move the pick by a "
        + "pixel, with Shift by a tenth; Enter picks the middle; + and - zoom",
      onkeydown: (event) => this.key(event), onfocus: () => chosen(this),
    });
    const about = seen.off_nadir_deg === undefined
      ? "" : number(seen.off_nadir_deg, "", 2) + "° off the normal";
    this.text = el("p", {class: "note"}, "not picked");
    this.check = el("input", {type: "checkbox", checked: true, onchange: () => {
      this.use = this.check.checked;
      used();
    }});
    this.choice = el("label", {class: "use", hidden: true}, this.check, "Use this pick");
    this.card = el("section", {class: "picture-card", "aria-label": seen.name},
      this.box, el("h2", {}, seen.name), el("p", {}, about), this.text, this.choice);
  }

  /* Once it is on the page. */
  async open() {
    const about = await attempt(() => get(addressOf(this.name) + "/about"));
    if (!about || !this.card.isConnected) return;
    const map = new leaflet.Map(this.box, {
      crs: leaflet.CRS.Simple, attributionControl: false, zoomControl: false, zoomSnap: 0.5,
        keyboard: false,
      scrollWheelZoom: true, doubleClickZoom: false, fadeAnimation: false, zoomAnimation: false,
        maxZoom: 6,
      minZoom: Math.log2(160 / Math.max(about.width, about.height)),
    });
    map.createPane("pictures").style.zIndex = 200;
    this.map = map;
    this.size = [about.width, about.height];
    const {seen} = this;
    map.setView(place(seen.x, seen.y), seen.whole ? Math.log2(
      this.box.clientWidth / about.width) : CLOSE);
    new Pyramid({
      west: 0, north: 0, pixel: 1, width: about.width, height: about.height, tile: about.tile,
        levels: about.levels,
      address: addressOf(this.name) + "/tile/{}.webp?v=" + about.token,
    }, "pictures").addTo(map);
    this.crosses = seen.whole ? [] : [[cross("expected"), place(seen.x, seen.y)]];
    map.on("move zoom resize", () => this.settle());
    map.on("click", ({latlng}) => {
      this.box.focus({preventScroll: true});
      this.byHand(latlng.lng - 0.5, -latlng.lat - 0.5);
    });
    this.draw();
    this.box.dataset.ready = "";
  }

  byHand(x, y) {
    const [wide, high] = this.size || [0, 0];
    if (x < -0.5 || y < -0.5 || x > wide - 0.5 || y > high - 0.5) return;
    this.set({x, y, matched_to: "", sigma_px: null});
    this.onPick(this);
  }

  /* A pick that was found or loaded; null takes it away. */
  set(pick) {
    this.pick = pick;
    this.use = true;
    this.check.checked = true;
    this.choice.hidden = !pick;
    this.draw();
  }

  draw() {
    if (!this.map) return;
    this.crosses = this.crosses.filter(([drawn]) => !drawn.classList.contains("picked")
      || drawn.remove());
    this.crosses.forEach(([drawn]) => drawn.toggleAttribute("hidden", Boolean(this.pick)));
    if (this.pick) this.crosses.push([cross("picked"), place(this.pick.x, this.pick.y)]);
    this.settle();
    if (!this.pick) return;
    this.box.dataset.x = this.pick.x;
    this.box.dataset.y = this.pick.y;
  }

  /* Put the crosses where the map has moved to. */
  settle() {
    this.crosses.forEach(([drawn, at]) => {
      const {x, y} = this.map.latLngToContainerPoint(at);
      drawn.style.transform = "translate(" + (x - 20) + "px," + (y - 20) + "px)";
      if (!drawn.isConnected) this.box.append(drawn);
    });
  }

  key(event) {
    if (!this.map || event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 0.1 : 1;
    const move = {ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step],
      ArrowDown: [0, step]}[event.key];
    const middle = this.map.getCenter();
    if (move && this.pick) {
      this.byHand(this.pick.x + move[0], this.pick.y + move[1]);
      this.map.panInside(place(this.pick.x, this.pick.y), {padding: [30, 30], animate: false});
    } else if (move) this.map.panBy(move.map((one) => 40 * Math.sign(one)), {animate: false});
    else if (event.key === "Enter") this.byHand(middle.lng - 0.5, -middle.lat - 0.5);
    else if (event.key === "+" || event.key === "=") this.map.zoomIn(1, {animate: false});
    else if (event.key === "-") this.map.zoomOut(1, {animate: false});
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  say(text, level = "note") {
    this.text.className = level;
    this.text.textContent = text;
  }
  close() {
    this.map?.remove();
    this.map = null;
    this.card.remove();
  }
}

/* The wall of views over the map. */
export class Wall {
  constructor({changed, used, refine}) {
    this.views = [];
    this.active = null;
    this.acts = {changed, used, chosen: (view) => this.choose(view)};
    this.title = el("strong", {}, "");
    this.refineButton =
      button("Find it in all others", () => refine(this.active), {disabled: true});
    this.more = button("More pictures", () => this.showMore(), {hidden: true});
    this.light = el("input", {type: "range", min: "0.4", max: "3", step: "0.05", value: "1",
      oninput: () => this.lit()});
    this.list = el("div", {class: "views", tabindex: "0", role: "region",
      "aria-label": "Pictures that show it"});
    this.root = el("div", {class: "wall", hidden: true, role: "region", "aria-label": "Pictures"},
      el("div", {class: "bar-top"}, this.title, this.refineButton,
        el("label", {}, "Brightness", this.light), this.more,
        button("Back to the map", () => this.hide())),
      this.list);
    document.querySelector(".map-side").append(this.root);
  }

  show(title, pictures, first = 6) {
    this.clear();
    this.title.textContent = title;
    this.root.hidden = false;
    this.root.scrollIntoView({block: "nearest"});
    this.waiting = pictures.slice();
    this.showMore(first);
  }

  showMore(count = 6) {
    const some = this.waiting.splice(0, count).map((seen) => new PictureView(seen, this.acts));
    this.views.push(...some);
    this.list.append(...some.map((view) => view.card));
    some.forEach((view) => view.open().then(() => this.lit()));
    this.more.hidden = !this.waiting.length;
    this.more.textContent = "More pictures (" + this.waiting.length + ")";
  }

  of(name) { return this.views.find((view) => view.name === name); }

  /* A view of this picture, put at the end where it is not there. */
  need(seen) {
    const known = this.of(seen.name);
    if (known) return known;
    this.waiting = this.waiting.filter((one) => one.name !== seen.name);
    this.waiting.unshift(seen);
    this.showMore(1);
    return this.of(seen.name);
  }

  choose(view) {
    this.active = view;
    this.views.forEach((one) => one.card.classList.toggle("active", one === view));
    this.refineButton.disabled = !view.pick || Boolean(view.pick.matched_to);
  }

  lit() {
    this.list.querySelectorAll(".leaflet-pictures-pane").forEach((pane) => {
      pane.style.filter = "brightness(" + this.light.value + ")";
    });
  }

  hide() {
    const held = this.root.contains(document.activeElement);
    this.root.hidden = true;
    if (held) document.getElementById("map-canvas").focus({preventScroll: true});
  }
  clear() {
    this.views.forEach((view) => view.close());
    this.views = [];
    this.active = null;
    this.refineButton.disabled = true;
  }
}
