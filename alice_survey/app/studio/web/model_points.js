/* The dense cloud: the nodes of its COPC file as the server decodes them. */

import {bytes} from "./core.js";
import {boxAbout, partOf, startDetail} from "./model_detail.js";

/* Points at least this far apart on the screen are enough, and are drawn a little larger, so that no gaps show. */
const MOST_PX = 3;
const LARGER = 1.35;
const LARGEST_PX = 40;
const PICK_PX = 6;
const POINT_BYTES = 19;

const VERTEX = `
  attribute vec3 tint;
  uniform float size, pixels, least;
  varying vec3 colour;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    colour = tint;
    gl_PointSize = clamp(size * pixels / -seen.z, least, max(least, ${LARGEST_PX.toFixed(1)}));
    gl_Position = projectionMatrix * seen;
  }`;
const FRAGMENT = `
  varying vec3 colour;
  void main() {
    vec2 off = gl_PointCoord - 0.5;
    if (dot(off, off) > 0.25) discard;
    gl_FragColor = vec4(colour, 1.0);
  }`;

/* The box of all points, about an offset. */
export const boxOf = ({low, high}, offset) => boxAbout(
  low.map((least, i) => (least + high[i]) / 2 - offset[i]), low.map((least, i) => (high[i] - least) / 2),
);

/* The points that /api/model/points describes, about an offset; see `startDetail`. `pick` gives the point next to a ray, with
   its sigma. */
export function startPoints(scene, about, offset, heard) {
  const size = LARGER * (about.cell || about.spacing / 2 ** Math.max(...about.nodes.map(([level]) => level)));
  const uniforms = {size: {value: size}, pixels: {value: 1}, least: {value: 1}};
  const material = new three.ShaderMaterial({uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT});
  const {half, centre} = about;
  const whole = boxOf(about, offset);
  const parts = new Map();
  about.nodes.forEach(([level, x, y, z, count], number) => {
    const edge = half / 2 ** level;
    const middle = [x, y, z].map((key, i) => centre[i] - half + edge * (2 * key + 1));
    const part = partOf({
      depth: level, number, count, middle, error: about.spacing / 2 ** level, isEmpty: !count, bytes: POINT_BYTES * count,
      box: boxAbout(middle.map((value, i) => value - offset[i]), [edge, edge, edge]).intersect(whole),
    });
    parts.set([level, x, y, z].join(), part);
    parts.get([level - 1, x >> 1, y >> 1, z >> 1].join())?.children.push(part);
  });

  async function load({number, count, middle}) {
    const data = await bytes("/api/model/points/" + number + "?v=" + about.version);
    const geometry = new three.BufferGeometry();
    geometry.setAttribute("position", new three.BufferAttribute(new Float32Array(data, 0, 3 * count), 3));
    geometry.setAttribute("tint", new three.BufferAttribute(new Uint8Array(data, 16 * count, 3 * count), 3, true));
    const model = new three.Points(geometry, material);
    model.frustumCulled = false;
    model.position.set(...middle);
    model.userData.sigmas = new Float32Array(data, 12 * count, count);
    return {model};
  }

  const detail = startDetail(scene, parts.get("0,0,0,0"), {
    adds: true, mostPx: MOST_PX, load, drop: (model) => model.geometry.dispose(), ...heard,
  });
  const {group} = detail;
  group.rotation.x = -Math.PI / 2;
  group.position.set(-offset[0], -offset[2], offset[1]);

  function update() {
    detail.update();
    uniforms.pixels.value = detail.pixelsAtOne();
    uniforms.least.value = LARGER * MOST_PX * detail.coarser();
  }

  /* Of the points within some pixels of the ray, those of the surface in front, and of these the one nearest to the ray. */
  function pick(ray) {
    const {origin, direction} = ray.clone().applyMatrix4(group.matrixWorld.clone().invert());
    const perLength = PICK_PX / detail.pixelsAtOne();
    const near = [];
    detail.shown().forEach(({model}) => {
      const from = origin.clone().sub(model.position);
      const places = model.geometry.attributes.position.array;
      for (let at = 0; at < places.length; at += 3) {
        const [x, y, z] = [places[at] - from.x, places[at + 1] - from.y, places[at + 2] - from.z];
        const along = x * direction.x + y * direction.y + z * direction.z;
        const reach = Math.max(size / 2, along * perLength);
        const aside = x * x + y * y + z * z - along * along;
        if (along > 0 && aside < reach * reach) near.push({model, at, along, aside, reach});
      }
    });
    if (!near.length) return null;
    const first = near.reduce((one, other) => (other.along < one.along ? other : one));
    const best = near.filter(({along}) => along < first.along + 2 * first.reach)
      .reduce((one, other) => (other.aside < one.aside ? other : one));
    const point = new three.Vector3().fromArray(best.model.geometry.attributes.position.array, best.at);
    return {point: point.add(best.model.position).applyMatrix4(group.matrixWorld), sigma: best.model.userData.sigmas[best.at / 3]};
  }

  return {...detail, update, pick};
}
