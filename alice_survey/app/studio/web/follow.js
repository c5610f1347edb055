/* Follow a dive: figures to read on deck, the map of what is seen, holes, and a plan that flies
   them again. */

import {attempt, button, el, field, get, missing, on, say, send, table} from "./core.js";
import {BLUE, GREEN, GREY, INK, ORANGE, PINK, RED, SKY} from "./palette.js";
import {clock, counted, number, share} from "./words.js";

const LEGEND = [[GREEN, "at the requested overlap"], [SKY, "in stereo"], [ORANGE, "in a picture"],
  ["#3c3c3c3c", "not yet"]];  /* as the coverage's own */
const KEPT = 6000;

export function tab(studio) {
  const {map} = studio;
  let state = null;
  let heardAt = 0;
  let fixes = [];
  let overlay = null;
  let drawn = {};
  let wasSilent = false;
  let isHere = false;
  let centred = false;
  let fetching = false;

  /* ---- The panel ---- */

  const now = el("p", {class: "now"}, "Loading …");
  const figure = (name, title) => {
    const value = el("dd", {"data-figure": name}, "–");
    return {box: el("div", {}, el("dt", {}, title), value), value};
  };
  const figures = {
    finish: figure("finish", "To the surface"),
    spare: figure("spare", "To spare"),
    overlap: figure("overlap", "At the overlap"),
    holes: figure("holes", "Holes behind it"),
    lines: figure("lines", "Lines left"),
    fix: figure("fix", "Last fix"),
  };
  const big = el("dl", {class: "big"}, Object.values(figures).map((one) => one.box));
  const put = (name, text, small, bad = false) => {
    const {box, value} = figures[name];
    value.replaceChildren(text, el("small", {}, small || "\u00a0"));
    box.classList.toggle("bad", bad);
  };

  const holeTable = el("div", {});
  const proposalText = el("p", {}, "");
  const format = el("select", {});
  const fetchIt = button("Download missions", download, {class: "primary", disabled: true});
  const more = el("div", {});
  const logs = el("select", {});
  const stop = button("Stop", () => change("/api/follow/end", {}), {hidden: true});
  const choose = el("details", {}, el("summary", {}, "Choose a log"),
    field("Navigation CSV of this workspace", logs),
    el("div", {class: "buttons"}, button("Follow it", open), stop),
    el("p", {class: "note"}, "For a file elsewhere: alice-survey studio --log nav.csv."));

  /* Files may come while the page is open. */
  ["pointerenter", "focusin"].forEach((event) => choose.addEventListener(event,
    () => get("/api/follow/state").then(fillChoices, () => null)));

  const live = el("div", {hidden: true}, big,
    el("ul", {class: "legend-row", "aria-label": "Colours of the coverage"},
      LEGEND.map(([colour, text]) => el("li", {},
      el("span", {class: "swatch", style: {background: colour}}), text))),
    el("h3", {}, "A plan over the holes"), proposalText,
    field("Format", format),
    el("div", {class: "buttons"}, fetchIt),
    holeTable,
    el("details", {}, el("summary", {}, "Time, energy, log"), more));
  const content = el("div", {}, el("h2", {}, "Follow a dive"), now, live, choose);
  const lack = missing(studio, content, () => (studio.state.has.plan || state?.following ? null
    : ["A dive is followed along its plan, and there is none yet: draw it in Plan, and save it.",
      "plan", "Open Plan"]));
  const panel = el("div", {}, lack.element, content);

  /* ---- What the server says ---- */

  async function change(path, body) {
    return attempt(async () => {
      const answer = await send(path, body);
      await take(await get("/api/follow/state"));
      return answer;
    });
  }

  async function open() {
    if (!logs.value) say("No navigation CSV lies in this workspace", "warn");
    else if (await change("/api/follow/open", {log: logs.value})) choose.open = false;
  }

  function download() {
    el("a", {href: "/api/follow/export?" + new URLSearchParams(format.value
      ? {format: format.value} : {}), download: ""}).click();
  }

  on("follow", (heard) => { if (isHere) attempt(() => take(heard)); });

  async function take(heard) {
    heardAt = performance.now();
    const source = state && state.source;
    state = {...(state || {}), ...heard};
    if (heard.logs) fillChoices(heard);
    lack.show();
    [live.hidden, stop.hidden] = [!state.following, !state.following];
    choose.open = choose.open || !state.following;
    if (!state.following) {
      forget();
      now.className = state.fault ? "now bad" : "now";
      now.textContent = state.fault || "No dive is followed: choose its log";
      return;
    }
    if (source !== state.source) forget();
    showFigures();
    showCoverage();
    await catchUp();
  }

  function fillChoices(heard) {
    const chosen = logs.value;
    if ([...logs.options].map((option) => option.value).join("\n") !== heard.logs.join("\n")) {
      logs.replaceChildren(...heard.logs.map((name) => el("option", {value: name}, name)));
      if (heard.logs.includes(chosen)) logs.value = chosen;
    }
    if (!format.children.length) {
      format.append(el("option", {value: ""}, "all formats"),
        ...heard.formats.map((name) => el("option", {value: name}, name)));
    }
  }

  function forget() {
    fixes = [];
    drawn = {};
    centred = false;
    overlay?.remove();
    overlay = null;
    ["left", "done", "track", "holes", "proposal", "vehicle"].forEach(
      (name) => map.remove("follow-" + name));
  }

  /* Fixes, lines and holes are asked for where the log was read again. */
  async function catchUp() {
    if (fetching || !state.fix) return;
    fetching = true;
    try {
      if (drawn.version !== state.version) {
        const last = fixes.length ? {after: fixes[fixes.length - 1][0]} : {};
        const {version} = state;
        const dive = await get("/api/follow/dive", last);
        fixes.push(...dive.fixes);
        if (fixes.length > KEPT) fixes = fixes.filter((_, i) => i % 2 || i > KEPT / 2);
        if (dive.fixes.length) showTrack();
        showLines(dive.lines);
        showHoles(dive.holes);
        drawn.version = version;
      }
      const proposalKey = JSON.stringify(state.proposal);
      if (drawn.proposal !== proposalKey) {
        showProposal(state.proposal);
        drawn.proposal = proposalKey;
      }
    } finally {
      fetching = false;
    }
  }

  /* ---- Figures ---- */

  function showFigures() {
    if (!state.fix) {
      tick();
      return;
    }
    const {finish, spare, coverage, holes, lines, pictures} = state;
    put("finish", clock(finish.time_s), number(finish.energy_wh, "Wh", 3));
    const tight = (spare.time_s !== null && spare.time_s < 0)
      || (spare.energy_wh !== null && spare.energy_wh < 0);
    put("spare", spare.time_s === null ? number(spare.energy_wh, "", 3) : clock(spare.time_s),
      spare.time_s === null ? "Wh; no limit of time is set" : number(spare.energy_wh, "Wh", 3),
        tight);
    put("overlap", share(coverage.at_overlap, 1),
      "then " + share(coverage.expected_at_overlap, 1) + "; seen " + share(coverage.seen, 1));
    put("holes", holes.count ? holes.area_m2.toFixed(holes.area_m2 < 99.5 ? 1 : 0) + " m²" : "none",
      holes.count ? counted(holes.count, "hole") + ", unseen " + holes.unseen_m2.toFixed(1)
        + " m²" : "nothing is missed", holes.area_m2 >= 0.05);
    put("lines", lines.left + " of " + (lines.left + lines.done),
      "dive " + state.dive.number + " of " + state.dive.of);
    const left = Object.entries(state.left_out).filter(([, count]) => count);
    more.replaceChildren(table("So far", [], [
      ["Under water", clock(state.elapsed_s)],
      ["Pace, true over planned", number(state.pace, "", 3)],
      ["Pictures that count", number(pictures, "", 6)],
      ["Gaps of the log", String(state.gaps)],
      ...left.map(([why, count]) => ["Left out: " + why, String(count)]),
    ]), el("p", {class: "note"}, state.source));
    tick();
  }

  /* Every second: how old the last fix is. */
  function tick() {
    if (!state || !state.following) return;
    const {fix} = state;
    if (state.fault && !fix) {
      now.className = "now bad";
      now.textContent = state.fault;
      return;
    }
    if (!fix || state.silent_s === null) {
      now.className = "now";
      now.textContent = "Waiting for the first position: " + state.source;
      put("fix", "–", "none yet");
      return;
    }
    const age = state.silent_s + (performance.now() - heardAt) / 1000;
    const silent = age > state.patience_s;
    now.className = silent ? "now bad" : state.proposal || state.holes.count ? "now" : "now good";
    now.textContent = silent ? "No news for " + (age < 100
      ? Math.round(age) + " s" : clock(age) + " min") + "; it was " + state.phase
      : state.phase[0].toUpperCase() + state.phase.slice(1);
    put("fix", silent ? Math.round(age) + " s ago" : "now",
      number(fix.depth_m, "m deep", 3) + ", " + number(fix.altitude_m, "m up", 3), silent);
    if (silent !== wasSilent) {
      wasSilent = silent;
      say(silent ? "No news from the vehicle" : "News from the vehicle again",
        silent ? "warn" : "note");
    }
  }
  setInterval(() => { if (isHere) tick(); }, 1000);

  /* ---- The map ---- */

  function showCoverage() {
    const [south, west, north, east] = state.bounds;
    const address = "/api/follow/coverage?v=" + state.version;
    if (overlay) {
      if (drawn.coverage !== address) overlay.setUrl(address);
    } else {
      overlay = leaflet.imageOverlay(address, [[south, west], [north, east]], {
        pane: "over", className: "follow-coverage"});
      if (isHere) overlay.addTo(map.leaflet);
    }
    drawn.coverage = address;
  }

  const flat = (ne) => [ne[1], ne[0]];
  function shapes(name, kind, title, colour, list, others = {}) {
    if (!list.length) {
      map.remove(name);
      return;
    }
    map.put({kind, name, title, colour, shapes: list, texts: [], group: "Dive", shown: true,
      fill: 0.35, ...others});
  }

  function showLines(lines) {
    const ends = (wanted) => lines.filter(wanted).map((line) =>
      [flat(line.start_ne), flat(line.end_ne)]);
    shapes("follow-done", "line", "Lines done", GREY, ends((line) => line.state === "done"),
      {width: 1.5});
    shapes("follow-left", "line", "Lines left", BLUE, ends((line) => line.state !== "done"),
      {dashed: true});
  }

  function showTrack() {
    shapes("follow-track", "line", "Track", INK, [fixes.map((fix) => [fix[2], fix[1]])],
      {width: 1.6});
    const [, n, e] = fixes.at(-1);
    shapes("follow-vehicle", "point", "Vehicle", BLUE, [[[e, n]]]);
    if (centred) return;
    centred = true;
    map.fit();
  }

  function showHoles(holes) {
    const outlines = holes.flatMap((hole) => hole.rings_ne.map((ring) => ring.map(flat)));
    shapes("follow-holes", "polygon", "Holes", RED, outlines);
    holeTable.replaceChildren(holes.length ? table(
      "Holes, worst first", ["hole", "m²", "unseen m²", "north, east m"],
      holes.slice(0, 6).map((hole, i) => [
        el("button", {type: "button", onclick: () => map.leaflet.panTo(
          [hole.north_m, hole.east_m])}, "Hole " + (i + 1)),
        hole.area_m2.toFixed(2), hole.unseen_m2.toFixed(2),
          hole.north_m.toFixed(1) + ", " + hole.east_m.toFixed(1)])) : "");
  }

  function showProposal(proposal) {
    fetchIt.disabled = !proposal;
    shapes("follow-proposal", "line", "Lines over the holes", PINK,
      proposal ? proposal.lines.map((line) => [flat(line.start_ne), flat(line.end_ne)]) : [],
        {width: 5});
    if (proposal) {
      proposalText.textContent = counted(proposal.lines.length, "line takes", "lines take") + " "
        + clock(proposal.time_s) + " min and " + number(proposal.energy_wh, "Wh", 2)
        + " from home to home: then " + share(proposal.holes_share, 1)
          + " of the holes is at the overlap. It is a plan of its own, to fly after this dive.";
    } else {
      proposalText.textContent = state.holes.count
        ? "No lines can reach the holes." : "No holes so far: nothing to close.";
    }
  }

  return {
    name: "follow",
    title: "Follow",
    panel,
    enter() {
      isHere = true;
      overlay?.addTo(map.leaflet);
      lack.show();
      attempt(async () => take(await get("/api/follow/state")));
    },
    leave() {
      isHere = false;
      forget();
    },
  };
}
