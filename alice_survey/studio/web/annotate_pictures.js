/* The pictures that show an annotation, each cut around its projected outline. */

import {el, get} from "./core.js";
import {INK, WHITE} from "./palette.js";
import {number} from "./words.js";
import {isArea} from "./annotate_map.js";

export async function shownPictures(one) {
  const found = await get("/api/annotations/" + one.id + "/pictures");
  if (!found.pictures.length) return [el("p", {class: "note"}, "No registered picture shows it.")];
  const head = el("h3", {}, found.pictures.length + " pictures show it best");
  return [head, ...found.pictures.map((shown) => figure(one, shown))];
}

function figure(one, shown) {
  const [left, top, width, height] = shown.crop;
  const query = new URLSearchParams({image: shown.image, x: left, y: top, width, height});
  const text = shown.image + ", the outline is known to " + number(shown.sigma_px, "px", 2);
  const picture = el("img", {
    src: "/api/annotations/crop?" + query, alt: "Part of " + text, loading: "lazy",
    style: {display: "block", width: "100%", aspectRatio: width + " / " + height},
  });
  const thick = Math.max(width, height) / 160;
  const lines = shown.rings.map((ring) => {
    const points = ring.filter((p) => p[0] !== null).map(([x, y]) => [x - left, y - top]);
    if (one.shape.kind === "point") {
      return [3, 1.4].map((size, n) => el("circle", {cx: points[0][0], cy: points[0][1], r: size * thick * 1.5, fill: n ? WHITE : INK}));
    }
    const tag = isArea(one.shape) ? "polygon" : "polyline";
    const all = points.map((p) => p.join(",")).join(" ");
    return [[INK, 2.4], [WHITE, 1]].map(([stroke, wide]) => el(tag, {points: all, fill: "none", stroke, "stroke-width": wide * thick}));
  });
  const over = el("svg", {
    viewBox: "0 0 " + width + " " + height, "aria-hidden": "true",
    style: {position: "absolute", inset: "0", width: "100%", height: "100%"},
  }, lines);
  return el("figure", {style: {margin: "0 0 12px"}},
    el("div", {style: {position: "relative", overflow: "hidden"}}, picture, over), el("figcaption", {}, text));
}
