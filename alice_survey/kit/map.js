/* The map of pages and of the studio, part 2 of 2: what lies over the pictures, and the
   controls. */

const RIMMED = 20;

/* Metres east and north stand where Leaflet has longitude and latitude. `data.room()`, if there
   is one, returns what Leaflet is to leave free where all is shown. Returns Leaflet's map and
   what changes it: `put` and `remove` a layer that is described as in `data.layers`, `show` one,
   `fit` all, `moreAt` a place in the line below the map, `take` clicks for a tool and `release`. */
function startMap(data, root) {
  const box = document.getElementById("map-canvas");
  const readout = document.getElementById("map-readout");
  root.hidden = false;
  root.parentElement.classList.add("lives");

  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const map = new leaflet.Map(box, {
    crs: leaflet.CRS.Simple, attributionControl: false, zoomControl: false,
    zoomSnap: 0.25, wheelPxPerZoomLevel: 90, scrollWheelZoom: false, zoomAnimation: !still,
    fadeAnimation: false, renderer: leaflet.canvas({tolerance: 6, padding: 0.3}),
  });
  map.createPane("under").style.zIndex = 150;
  map.createPane("pictures").style.zIndex = 200;
  map.createPane("over").style.zIndex = 300;
  const layers = new Map();
  let whole = null;
  const fit = (animate) => map.fitBounds(whole, {padding: [24, 24], ...data.room?.(), animate});

  /* What the map holds: west, south, east and north limits. */
  function extend([west, south, east, north]) {
    whole = leaflet.latLngBounds([south, west], [north, east]);
    const span = Math.max(east - west, north - south) || 1;
    const pixels = [...layers.values()].filter((layer) => layer.about)
      .map((layer) => layer.about.pixel);
    map.setMaxZoom(Math.log2(16 / Math.min(span / 500, ...pixels)));
    map.setMinZoom(Math.log2(60 / span));
  }

  /* A page that scrolls must not stop at its map: the wheel zooms only what was chosen. */
  box.addEventListener("focusin", () => map.scrollWheelZoom.enable());
  box.addEventListener("focusout", () => map.scrollWheelZoom.disable());

  /* Take a layer, instead of another of its name. */
  function put(about) {
    remove(about.name);
    const pane = about.base ? "pictures" : "over";
    const layer = about.kind === "picture" ? new Pyramid(about, pane) : shapesOf(about);
    layers.set(about.name, layer);
    return layer;
  }
  function remove(name) {
    layers.get(name)?.remove();
    layers.delete(name);
  }

  function shapesOf(about) {
    const places = (shape) => shape.map(([e, n]) => [n, e]);
    const group = leaflet.featureGroup();
    const dashes = about.dashed ? {dashArray: "7 5"} : {};
    /* A light rim keeps a shape readable on dark ground; many outlines would drown in it. */
    const rimmed = about.kind === "line" || (about.kind === "polygon"
      && about.shapes.length <= RIMMED);
    about.shapes.forEach((shape, index) => {
      const many = about.kind === "polygon" ? leaflet.polygon : leaflet.polyline;
      if (rimmed) {
        group.addLayer(many(places(shape), {
          color: "#fff", weight: 5, opacity: 0.75, fill: false, interactive: false,
        }));
      }
      const drawn = about.kind === "point"
        ? leaflet.circleMarker(places(shape)[0], {
          radius: 5, color: "#fff", weight: 1.5, fillColor: about.colour, fillOpacity: 1,
        })
        : many(places(shape), {
          color: about.colour,
          weight: about.width || (about.kind === "line" ? 2.6 : rimmed ? 1.8 : 1),
          fillOpacity: about.fill ?? 0.03, ...dashes,
        });
      drawn.survey = {title: about.title, text: about.texts[index] || ""};
      drawn.on("click", (event) => { if (!tool) describe(drawn, event.latlng); });
      group.addLayer(drawn);
    });
    group.kind = about.kind;
    return group;
  }

  function describe(shape, at) {
    const content = document.createElement("div");
    const title = document.createElement("b");
    title.textContent = shape.survey.title;
    const text = document.createElement("p");
    text.textContent = shape.survey.text;
    content.append(title, text);
    leaflet.popup({minWidth: 110, maxWidth: 260, className: "described"}).setLatLng(at)
      .setContent(content).openOn(map);
  }

  /* What a pointer would choose, for those who have none: the shape nearest to the middle. */
  function describeMiddle() {
    const middle = map.containerPointToLayerPoint(map.getSize().divideBy(2));
    /** @type {any[]} */
    let best = null;
    let least = 60;
    layers.forEach((group) => {
      if (!group.kind || !map.hasLayer(group)) return;
      group.eachLayer((shape) => {
        if (!shape.survey) return;
        const spot = shape.getLatLng
          ? map.latLngToLayerPoint(shape.getLatLng()) : shape.closestLayerPoint(middle);
        const away = spot ? spot.distanceTo(middle) : Infinity;
        if (away < least) {
          least = away;
          best = [shape, map.layerPointToLatLng(spot)];
        }
      });
    });
    if (best) describe(...best);
    else readout.textContent = "Nothing within 60 px of the middle";
  }

  function show(name, on) {
    const layer = layers.get(name);
    if (on) layer.addTo(map);
    else layer.remove();
    ["polygon", "line", "point"].forEach((kind) => layers.forEach((group) => {
      if (group.kind === kind && map.hasLayer(group)) group.bringToFront();
    }));
    const legend = document.getElementById("legend-" + name);
    if (legend) legend.hidden = !on;
    note();
    map.fire("layerschanged");
  }

  /* Where the map stands, for the reader and for tests. */
  function note() {
    const centre = map.getCenter();
    box.dataset.east = centre.lng;
    box.dataset.north = centre.lat;
    box.dataset.zoom = map.getZoom();
    layers.forEach((layer) => {
      if (layer.about && layer.about.base && map.hasLayer(layer)) {
        box.dataset.base = layer.about.name;
        box.dataset.level = layer.level;
      }
    });
  }

  /* Places that are clicked, or that Enter takes from the middle, go to the tool in hand, if any:
     its `click`, its `move`, its `text` for the line below the map, its `end`, and its `keys`. */
  let tool = null;
  function take(taken) {
    release();
    tool = taken;
    map.closePopup();
    box.dataset.tool = taken.name || "";
    readCentre();
  }
  function release() {
    const ended = tool;
    tool = null;
    delete box.dataset.tool;
    if (ended && ended.end) ended.end();
    readCentre();
  }

  /* What others add for a place, each a function of it. */
  const more = [];
  const decimals = () => Math.min(4, Math.max(0, Math.ceil(Math.log10(2 ** map.getZoom()))));
  function read(word, place) {
    const [e, n] = [place.lng, place.lat].map((v) => v.toFixed(decimals()).replace("-", "−"));
    let text = word + e + " " + data.unit + " " + data.axes[0] + ", " + n + " " + data.unit + " "
      + data.axes[1];
    if (tool && tool.text) text += tool.text(place);
    readout.textContent = text + more.map((add) => add(place)).join("");
  }
  const readCentre = () => read("Middle: ", map.getCenter());

  const bar = root.querySelector(".bar");
  function drawBar() {
    const longest = 130 / 2 ** map.getZoom();
    const power = 10 ** Math.floor(Math.log10(longest));
    const length = [5, 2, 1].map((step) => step * power)
      .find((step) => step <= longest * (1 + 1e-9));
    bar.style.width = length * 2 ** map.getZoom() + "px";
    bar.firstChild.textContent = lengthText(length, data.unit);
  }

  function click(place) {
    if (!tool) return;
    tool.click(place);
    read("", place);
  }
  map.on("moveend zoomend", () => {
    note();
    readCentre();
    drawBar();
  });
  map.on("mousemove", (event) => {
    read("", event.latlng);
    if (tool && tool.move) tool.move(event.latlng);
  });
  map.on("click", (event) => click(event.latlng));
  map.on("mouseout", readCentre);
  map.on("tilelost", () => {
    readout.textContent = "A part of the picture did not come: load this page again";
  });
  data.layers.forEach(put);
  extend(data.extent);
  fit(false);

  root.querySelectorAll("input").forEach((input) => {
    if (input.checked) show(input.value, true);
    input.addEventListener("change", () => {
      if (input.type === "radio") {
        root.querySelectorAll("input[type=radio]").forEach((other) => {
          if (other !== input) show(other.value, false);
        });
      }
      show(input.value, input.checked);
    });
  });
  const acts = {in: () => map.zoomIn(1), out: () => map.zoomOut(1), all: () => fit(!still)};
  root.querySelectorAll("button[data-act]").forEach((button) => {
    button.addEventListener("click", acts[button.dataset.act]);
  });
  box.addEventListener("keydown", (event) => {
    if (event.target !== box || event.ctrlKey || event.metaKey || event.altKey) return;
    const act = tool?.keys?.[event.key] || {
      0: acts.all, Enter: tool ? () => click(map.getCenter()) : describeMiddle,
      Escape: tool ? release : null,
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
  new ResizeObserver(() => map.invalidateSize({pan: false})).observe(box);
  root.dataset.ready = "";
  return {
    leaflet: map, layers, put, remove, show, extend, fit: (animate = !still) => fit(animate), take,
      release,
    data, moreAt: (add) => more.push(add), refresh: readCentre,
  };
}

/* 0.02 m reads as 2 cm. */
function lengthText(length, unit, digits = 2) {
  const places = (value) => Number(value.toPrecision(digits)).toString();
  if (unit !== "m" || length >= 1) return places(length) + " " + unit;
  return length >= 0.01 ? places(length * 100) + " cm" : places(length * 1000) + " mm";
}

if (document.getElementById("map-data")) {
  startMap(JSON.parse(document.getElementById("map-data").textContent),
    document.getElementById("map"));
}
