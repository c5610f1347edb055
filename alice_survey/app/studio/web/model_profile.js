/* Heights along a measured line with the band of one sigma, linked to the map. */

import {BLUE, WHITE} from "./palette.js";
import {profileChart} from "./profile_chart.js";
import {countUpTo} from "./way.js";
import {number, withSigma} from "./words.js";

const REACH_PX = 25;

export function measuredProfile(map, unit) {
  const spot = leaflet.circleMarker(
    [0, 0], {radius: 6, color: WHITE, weight: 2, fillColor: BLUE, fillOpacity: 1,
    interactive: false});
  let found = null;
  const chart = profileChart("Place along the profile", {describe, pointed, high: 170});

  function nearest(length) {
    const next = Math.min(found.along.length - 1, countUpTo(found.along, length));
    const before = Math.max(0, next - 1);
    return length - found.along[before] < found.along[next] - length ? before : next;
  }

  function describe(length) {
    const i = nearest(length);
    return number(found.along[i], unit, 4) + " along: " + (found.height[i] === null
      ? "no height is known" : withSigma(found.height[i], found.sigma[i], unit));
  }

  function pointed(length) {
    if (length === null || !found) {
      spot.remove();
      return;
    }
    const [east, north] = found.places[nearest(length)];
    spot.setLatLng([north, east]).addTo(map.leaflet);
  }

  /* The other way round: what of the line is nearest to the pointer on the map. */
  map.leaflet.on("mousemove", (event) => {
    if (!found) return;
    const pointer = map.leaflet.latLngToContainerPoint(event.latlng);
    let [best, least] = [null, REACH_PX];
    found.places.forEach(([east, north], i) => {
      const away = map.leaflet.latLngToContainerPoint([north, east]).distanceTo(pointer);
      if (away < least) [least, best] = [away, i];
    });
    if (best !== null) chart.move(found.along[best]);
  });

  function clear() {
    found = null;
    chart.clear();
  }

  function show(profile) {
    found = profile;
    chart.show({
      lines: [{kind: "vehicle", xs: found.along, ys: found.height, sigmas: found.sigma}],
      caption: "along the line, " + unit + "; height ± sigma, " + unit,
        rules: found.corners.slice(1, -1),
    });
    chart.move(0);
  }

  return {element: chart.element, show, clear};
}
