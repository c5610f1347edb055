/* Playback of a dive on the map: play, pause, scrub, at several speeds. */

import {attempt, button, el, field} from "./core.js";
import {countUpTo, stateAt} from "./way.js";
import {clock, paceText} from "./words.js";

const SPEEDS = [1, 10, 30, 100];
const STILL_MS = 1000;  /* between steps where motion is to be reduced */
const WAY_POINTS = 1500;

/* `ask()` returns the dive as POST /api/plan/play does; `mark(place, heading, way)` shows it. */
export function playback({ask, mark}) {
  const still = window.matchMedia("(prefers-reduced-motion: reduce)");
  const toggle = button("Play", () => (running ? pause() : play()));
  const scrub = el("input", {type: "range", min: 0, max: 1, step: "any", value: 0, disabled: true});
  const speed = el("select", {}, SPEEDS.map(
    (times) => el("option", {value: times}, paceText(times))));
  const readout = el("p", {class: "note"},
    "The vehicle on its way, as planned, or as flown where it was.");
  speed.selectedIndex = 2;
  let [dive, time, running, before] = [null, 0, false, 0];

  async function load() {
    dive = dive || await attempt(ask);
    if (!dive || !dive.t_s.length) return false;
    [scrub.min, scrub.max, scrub.disabled] = [dive.t_s[0], dive.t_s[dive.t_s.length - 1], false];
    return true;
  }

  async function play() {
    toggle.disabled = true;
    const loaded = await load();
    toggle.disabled = false;
    if (!loaded) return;
    if (time >= Number(scrub.max)) time = Number(scrub.min);
    running = true;
    toggle.textContent = "Pause";
    before = performance.now();
    next();
  }

  function pause() {
    running = false;
    toggle.textContent = "Play";
  }

  function next() {
    if (still.matches) setTimeout(() => step(performance.now()), STILL_MS);
    else requestAnimationFrame(step);
  }

  function step(now) {
    if (!running) return;
    time = Math.min(Number(scrub.max), time + (now - before) / 1000 * Number(speed.value));
    before = now;
    show();
    if (time >= Number(scrub.max)) pause();
    else next();
  }

  function show() {
    const state = stateAt(dive, time);
    const taken = countUpTo(dive.pictures_s, time);
    const text = clock(time) + " of " + clock(Number(scrub.max)) + ", " + dive.what + ": depth "
      + state.depth.toFixed(2)
      + " m" + (Number.isNaN(state.altitude)
        ? "" : ", altitude " + state.altitude.toFixed(2) + " m") + ", heading "
        + Math.round(state.heading) % 360 + "°, "
      + taken.toLocaleString("en") + " of " + dive.pictures_s.length.toLocaleString("en")
        + " pictures";
    scrub.value = time;
    scrub.setAttribute("aria-valuetext", clock(time));
    readout.textContent = text;
    const every = Math.max(1, Math.ceil((state.index + 1) / WAY_POINTS));
    const way = [];
    for (let i = 0; i <= state.index; i += every) way.push([dive.n[i], dive.e[i]]);
    mark([state.n, state.e], state.heading, [...way, [state.n, state.e]]);
  }

  scrub.addEventListener("input", () => {
    time = Number(scrub.value);
    show();
  });

  /* Forget the dive: the plan is another one. */
  function forget() {
    pause();
    if (dive) mark(null);
    [dive, time, scrub.disabled, scrub.value] = [null, 0, true, 0];
  }

  const element = el("div", {}, el("div", {class: "buttons"}, toggle), field("Time", scrub), field(
    "Speed", speed), readout);
  return {element, forget, pause};
}
