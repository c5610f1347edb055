/* The Run tab: what is made, what is left and what it takes; the job that runs, its log, its
   end. */

import {attempt, button, el, get, mayWrite, on, say, send} from "./core.js";
import {startPage} from "./start.js";
import {ago, counted, duration, gigabytes, number} from "./words.js";

const STATES = {
  "up to date": ["✓", "good", "made"],
  stale: ["↻", "look", "out of date"],
  interrupted: ["◐", "look", "begun: goes on where it stopped"],
  missing: ["○", "soft", "not made yet"],
  working: ["▶", "blue", "working now"],
};
const ENDS = {
  done: ["✓", "good", "done", null],
  failed: ["✗", "bad", "failed", "Try again"],
  stopped: ["■", "look", "stopped", "Go on"],
  killed: ["✗", "bad", "ended without a word", "Start again"],
};
const FURTHER = [
  ["quality", "Judge the pictures: sharpness, exposure, overlap", "image"],
  ["control", "Find coded markers in the pictures", "image"],
  ["plan check", "Check what the flown dive has seen", "fly"],
  ["plan revisit", "Plan a dive over what the model lacks", "dense"],
  ["plan export", "Write the plan for vehicles again", "plan"],
];
const SILENT_MS = 6000;
const SHOWN = /\.(html|json|csv|txt|pdf|png)$/;

const iconOf = (icon, colour) => el("span", {class: "icon " + colour, "aria-hidden": "true"}, icon);
const link = (path, text) => el("a", {href: "/files/" + path, target: "_blank", rel: "noopener"},
  text);
const report = () => link("report/report.html", "Open the report");

export function tab(studio) {
  const job = el("section", {class: "job", "aria-label": "Running now", hidden: true});
  const last = el("section", {class: "job", "aria-label": "Last run", hidden: true});
  const begin = el("section", {"aria-label": "Start"});
  const stages = el("div", {class: "stages"});
  const log = logView();
  const further = el("div", {class: "buttons column"});
  const more = el("details", {}, el("summary", {}, "Further commands"), further);
  const work = el("div", {}, begin, el("h2", {}, "Stages"), stages, more, log.element);
  const first = el("div", {hidden: true});
  const panel = el("div", {class: "run"}, job, last, first, work);
  let [known, running, heardAt, spoken, timer, opened] = [null, null, 0, "", null, false];

  const command = (text, name, args = {}, attributes = {}) => button(text, () => start(name, args),
    {disabled: Boolean(running) || known.elsewhere || !mayWrite(), ...attributes});

  async function load() {
    const found = await attempt(() => get("/api/run"));
    if (!found) return;
    known = found;
    heardAt = Date.now();
    show();
  }

  function show() {
    running = known.job;
    const isNew = known.new && !running;
    if (isNew && !first.firstChild) first.append(
      startPage(studio, {started: load, disk: known.disk, others: known.others}));
    [first.hidden, work.hidden] = [!isNew, isNew];
    wide(isNew && opened);
    showJob();
    showLast();
    if (isNew) return;
    showBegin();
    showStages();
    const made = (name) => known.stages.some((stage) => stage.name === name && stage.made_utc);
    const offered = FURTHER.filter(([, , stage]) => made(stage));
    further.replaceChildren(...offered.map(([name, title]) => command(title, name)));
    more.hidden = !offered.length;
  }

  /* The start page takes the room of the map, which has nothing to show yet. */
  function wide(on) {
    if (document.body.classList.contains("first-start") === on) return;
    document.body.classList.toggle("first-start", on);
    window.dispatchEvent(new Event("resize"));
  }

  /* ---- The job that runs ---- */

  function showJob() {
    job.hidden = !running && !known.elsewhere;
    if (job.hidden) return;
    if (!running) {
      job.dataset.number = "";
      job.replaceChildren(el("h2", {}, "Another command is working here"),
        el("p", {}, "A terminal or another program works in this survey. Nothing else can start "
          + "until it ends; it can be stopped only there."));
      return;
    }
    if (job.dataset.number !== String(running.number)) {
      job.dataset.number = running.number;
      job.replaceChildren(el("h2", {}, running.title), el("p", {class: "what"}),
        el("div", {class: "bars"}), el("p", {class: "warn"}),
        el("div", {class: "buttons"}, button("Stop", stop, {class: "stop"})));
    }
    const stopping = running.state === "stopping";
    const stage = running.stage_title ? `${running.stage_title}, ` : "";
    job.querySelector(".what").textContent = stopping
      ? "stopping: what is made so far is kept"
      : `${stage}running for ${duration(running.elapsed_s)}`;
    job.querySelector(".bars").replaceChildren(...running.steps.map(stepBar));
    job.querySelector(".warn").textContent = running.warned
      ? `${counted(running.warned, "warning")}; the last: ${running.warnings.at(-1)}` : "";
    job.querySelector(".stop").disabled = stopping || !mayWrite();
    if (running.stage_title && running.stage_title !== spoken) say(`${running.stage_title} begins`);
    spoken = running.stage_title;
  }

  function stepBar({step, done, total, elapsed_s, remaining_s}) {
    const count = done === null ? "" : total ? ` ${done} of ${total}` : ` ${done}`;
    const left = remaining_s === null
      ? `, for ${duration(elapsed_s)}` : `, about ${duration(remaining_s)} left`;
    return el("div", {class: "step"}, el("span", {}, step + count + left),
      el("progress", {"aria-label": step, max: total || null, value: total ? done : null}));
  }

  const stop = () => attempt(async () => {
    await send("/api/run/stop");
    say("Stopping: the same command goes on from there later.");
  });

  async function start(name, args) {
    const begun = await attempt(() => send("/api/run/start", {name, arguments: args}));
    if (!begun) return;
    say(`${begun.job.title}: started`);
    log.follow(begun.job.number);
    await load();
    job.querySelector(".stop")?.focus();
  }

  /* ---- How the last one ended ---- */

  function showLast() {
    const ended = known.last;
    last.hidden = !ended || Boolean(running) || known.elsewhere;
    if (last.hidden) return;
    const [icon, colour, words, again] = ENDS[ended.state] || ENDS.killed;
    const ways = (ended.ways || []).map((way) => el("li", {}, el("code", {}, way.command), " ",
      way.name ? command(way.title, way.name) : null));
    const lasted = (Date.parse(ended.ended_utc) - Date.parse(ended.started_utc)) / 1000;
    last.replaceChildren(
      el("h2", {}, iconOf(icon, colour), ` ${ended.title}: ${words}`),
      el("p", {}, `${ago(ended.ended_utc)}, after ${duration(lasted)}`),
      el("p", {class: colour === "bad" ? "line error" : "line"}, ended.line),
      ways.length ? el("div", {}, el("p", {}, "The way on:"), el("ul", {}, ways)) : "",
      el("div", {class: "buttons"},
        again && ended.name !== "import-images"
          ? command(again, ended.name, ended.arguments || {}) : null,
        button("Show its log", () => log.show(ended.number)),
        ended.state === "done" && ended.finished.includes("report") ? report() : null));
  }

  /* ---- What is left ---- */

  const costText = (cost) => (cost ? `About ${duration(cost.time_s)} on ${
    counted(known.cores, "core")}, ${gigabytes(cost.disk_mb)} of disk` : "");

  function showBegin() {
    if (known.fault) {
      begin.replaceChildren(el("p", {class: "error line"}, known.fault),
        el("ul", {}, known.ways.map((way) => el("li", {}, el("code", {}, way.command)))),
        el("p", {}, "The stages are shown once that is settled."));
      return;
    }
    const names = known.imported ? ["reconstruct", "report"] : ["run"];
    const all = known.commands.find((one) => names.includes(one.name) && one.left.length);
    const tight = all?.cost && all.cost.disk_mb / 1000 > 0.9 * known.disk.free_gb;
    const made = known.stages.some((one) => one.name === "report" && one.made_utc);
    const costs = all ? costText(all.cost)
      || "What it takes is known once there is a plan or pictures." : "All stages are up to date.";
    begin.replaceChildren(
      el("p", {}, costs, el("br"),
        el("small", {}, `${number(known.disk.free_gb, "GB", 3)} of the disk are free`)),
      tight ? el("p", {class: "error"},
        "That is more than there is room for: free some of the disk first.") : "",
      el("div", {class: "buttons"},
        all ? command(all.title, all.name, {}, {class: "primary"}) : null, made ? report() : null));
  }

  function showStages() {
    const commands = known.commands.filter((one) => one.name !== "run");
    const groups = commands.map((one) => {
      const own = known.stages.filter((stage) => stage.command === one.name);
      if (!own.length) return "";
      const begun = own.some((stage) => stage.state === "interrupted");
      const word = begun ? "Go on" : "Start";
      const after = commands.filter((other) =>
        other.left.some((name) => one.after.includes(name))).map((other) => other.title);
      return group(one.title, own,
        one.left.length && !one.after.length ? command(word, one.name, {},
          {"aria-label": `${word}: ${one.title}`}) : null,
        [after.length ? "after: " + after.join(", ") : "", costText(one.cost)]);
    });
    const rest = known.stages.filter((stage) =>
      !known.commands.some((one) => one.name === stage.command));
    stages.replaceChildren(rest.length ? group("Imported pictures", rest) : "", ...groups);
  }

  const group = (title, own, act = null, notes = []) =>
    el("section", {class: "group", "aria-label": title},
      el("div", {class: "head"}, el("h3", {}, title), act),
      notes.filter(Boolean).map((text) => el("small", {}, text)), el("ul", {}, own.map(row)));

  function row(stage) {
    const working = running && running.stage === stage.folder
      && !running.finished.includes(stage.folder);
    const state = working ? "working" : stage.state;
    const [icon, colour, words] = STATES[state] || STATES.missing;
    const why = stage.why && !working ? ` (${stage.why})` : "";
    const took = stage.took_s === null
      ? "" : `; took ${duration(stage.took_s)}${stage.made_utc ? ", " + ago(stage.made_utc) : ""}`;
    const ended = running ? null : known.last;
    const broken = ended?.state === "failed" && ended.stage === stage.folder
      && stage.state !== "up to date";
    const open = stage.products.filter(({path}) => SHOWN.test(path));
    return el("li", {"data-stage": stage.name, "data-state": state}, iconOf(icon, colour),
      el("div", {}, el("strong", {}, stage.name), ` ${words}${why}${took}`,
        broken ? el("p", {class: "error line"}, ended.line) : null,
        el("small", {}, stage.about),
        el("small", {}, open.map(({path, about}, i) => [i ? ", " : "", link(path, about)]))));
  }

  /* ---- Events ---- */

  on("run", (data) => {
    heardAt = Date.now();
    if (data.ended) end(data.last);
    if (!data.job || !known) return;
    const before = known.job;
    known.job = running = data.job;
    log.follow(running.number);
    if (!opened) return;
    showJob();
    if (before?.finished.length !== running.finished.length) load();
    else if (before.stage !== running.stage) showStages();
  });

  async function end(ended) {
    const [, , words] = ENDS[ended.state] || ENDS.killed;
    say(`${ended.title}: ${words}${ended.state === "done" ? "" : ". " + ended.line}`,
      {done: "note", stopped: "warn"}[ended.state] || "error");
    log.follow(ended.number);
    await attempt(() => studio.refresh());
    await load();
  }

  /* Commands of a terminal, and what was missed while this page slept. */
  async function watch() {
    if (document.hidden || Date.now() - heardAt < SILENT_MS) return;
    heardAt = Date.now();
    const now = await attempt(() => get("/api/run/job"));
    if (now && known && (now.job?.number !== known.job?.number
      || now.elsewhere !== known.elsewhere)) load();
  }

  return {
    name: "run", title: "Run", panel,
    enter() {
      opened = true;
      timer = timer || setInterval(watch, 2000);
      load();
    },
    leave() {
      opened = false;
      wide(false);
      clearInterval(timer);
      timer = null;
    },
  };
}

/* The log of the last job, fetched while it is open. */
function logView() {
  const lines = el("ol", {class: "log", tabindex: "0", "aria-label": "Log"});
  const element = el("details", {}, el("summary", {}, "Log"), lines);
  let [job, had, busy] = [null, 0, false];

  async function more() {
    if (!element.open || busy) return;
    busy = true;
    const found = await attempt(async () => {
      if (job === null) {
        const {job: runs, last} = await get("/api/run/job");
        job = (runs || last)?.number ?? null;
      }
      return job === null ? null : {job, ...await get("/api/run/log", {job, after: had})};
    });
    busy = false;
    if (!found || found.job !== job) return;
    const atEnd = lines.scrollTop + lines.clientHeight >= lines.scrollHeight - 8;
    const texts = found.lines.length || had || !found.output
      ? found.lines : [{kind: "note", text: found.output, time_utc: ""}];
    lines.append(...texts.map(({kind, text, time_utc}) => el("li", {class: kind},
      time_utc ? el("time", {datetime: time_utc}, new Date(time_utc).toLocaleTimeString("en-GB"))
        : null, " ", text)));
    had = found.total;
    if (atEnd) lines.scrollTop = lines.scrollHeight;
  }

  function follow(number) {
    if (number !== job) {
      [job, had] = [number, 0];
      lines.replaceChildren();
    }
    more();
  }

  element.addEventListener("toggle", more);
  return {
    element,
    follow,
    show(number) {
      element.open = true;
      follow(number);
      lines.focus();
      element.scrollIntoView({block: "end"});
    },
  };
}
