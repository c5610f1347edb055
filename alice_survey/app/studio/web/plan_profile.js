/* Sea floor and vehicle along the way of a plan, whose pointer shows the place on the map. */

import {profileChart} from "./profile_chart.js";
import {growing, profileAt} from "./way.js";
import {fixed} from "./words.js";

/* `pointed(place)` is called with the place of the pointer, or with null. */
export function planProfile(pointed) {
  let [held, routes, along] = [null, [], []];
  const chart = profileChart("Place along the way", {
    describe,
    pointed: (length) =>
      pointed(length === null || !held ? null : profileAt(held, routes, along, length).place),
  });

  function describe(length) {
    const {dive, floor, vehicle} = profileAt(held, routes, along, length);
    return fixed(length, 0, "m") + " along, dive " + dive
      + (Number.isFinite(vehicle) ? ": camera at " + fixed(vehicle, 2, "m") : "")
      + (Number.isFinite(floor - vehicle) ? ", " + fixed(floor - vehicle, 2, "m")
        + " over the sea floor at " + fixed(floor, 2, "m") : "");
  }

  function show(profile, newRoutes) {
    [held, routes] = [profile && profile.s_m.length > 1 ? profile : null, newRoutes];
    if (!held) {
      chart.clear();
      return;
    }
    along = growing(held.s_m);
    chart.show({
      lines: [{kind: "floor", xs: along, ys: held.floor_depth_m, ground: true},
        {kind: "vehicle", xs: along, ys: held.vehicle_depth_m}],
      downwards: true, caption: "along the way, m; depth, m",
      rules: along.filter((_, i) => i && held.dive[i] !== held.dive[i - 1]),
    });
  }
  return {element: chart.element, show};
}
