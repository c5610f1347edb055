/* The Run tab: what is made, what is left and what it takes; the job that runs, its log, its
   end. */

import {attempt, button, el, field, get, mayWrite, on, say, send, table} from "./core.js";
import {showSteps} from "./job_progress.js";
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
  done: ["✓", "good", "done"],
  failed: ["✗", "bad", "failed"],
  stopped: ["■", "look", "stopped"],
  killed: ["✗", "bad", "ended without a word"],
};
const LONG_S = 20;
const LOUD_EVERY_S = 60;
const SILENT_MS = 6000;

const secondsOf = ({started_utc: start, ended_utc: end}) =>
  (new Date(end).getTime() - new Date(start).getTime()) / 1000;

export function tab(studio) {
  const job = el("section", {class: "job", "aria-label": "Running now", hidden: true});
  const last = el("section", {class: "job", "aria-label": "Last run", hidden: true});
  const begin = el("section", {"aria-label": "Start"});
  const stages = el("div", {class: "stages"});
  const log = logView();
  const history = historyView();
  const options = optionsView();
  const more = moreView();
  const work = el("div", {}, job, last, begin, el("h2", {}, "Stages"), stages, options.element,
    more.element, log.element, history.element);
  const first = el("div", {hidden: true});
  const panel = el("div", {class: "run"}, first, work);
  let known = null;
  let running = null;
  let heardAt = 0;
  let finished = 0;
  let spoken = {stage: "", at: 0};
  let timer = null;
  let opened = false;
  let failed = null;

  async function load() {
    const found = await attempt(() => get("/api/run"));
    if (!found) return;
    known = found;
    heardAt = Date.now();
    show();
  }

  function show() {
    running = known.job;
    failed = known.last && known.last.state === "failed" ? known.last : null;
    first.hidden = !known.new || Boolean(running);
    work.hidden = !first.hidden;
    wide(!first.hidden && opened);
    if (!first.hidden && !first.firstChild) first.append(
      startPage(studio, {started: load, disk: known.disk, others: known.others}));
    if (!first.hidden) showLast(first.querySelector(".start-last"));
    if (work.hidden) return;
    showJob();
    showLast(last);
    showBegin();
    showStages();
    more.show(known, running);
  }

  /* The start page takes the room of the map, which has nothing to show yet. */
  function wide(on) {
    if (document.body.classList.contains("first-start") === on) return;
    document.body.classList.toggle("first-start", on);
    window.dispatchEvent(new Event("resize"));
  }

  /* ---- The job that runs ---- */

  function showJob() {
    job.hidden = !running && !known?.elsewhere;
    if (job.hidden) return;
    if (!running) {
      const what = known.elsewhere.stage ? `: it makes ${known.elsewhere.stage}` : "";
      job.replaceChildren(el("h2", {}, "Another command is working here"),
        el("p", {}, `A terminal or another program works in this survey${what}. Nothing else can `
          + `start until it ends; it can be stopped only there.`));
      return;
    }
    if (job.dataset.number !== String(running.number)) {
      job.dataset.number = running.number;
      job.replaceChildren(el("h2", {}, running.title), el("p", {class: "what"}), el(
        "div", {class: "bars"}),
        el("p", {class: "warn", hidden: true}),
        el("div", {class: "buttons"}, button("Stop", stop,
          {class: "stop", disabled: !mayWrite()})));
    }
    const stopping = running.state === "stopping";
    const stage = running.stage_title ? `${running.stage_title}, ` : "";
    job.querySelector(".what").textContent = stopping
      ? "stopping: what is made so far is kept" : `${stage}running for `
        + `${duration(running.elapsed_s)}`;
    showSteps(job.querySelector(".bars"), running);
    const warned = job.querySelector(".warn");
    warned.hidden = !running.warned;
    warned.textContent = running.warned
      ? `${counted(running.warned, "warning")}; the last: ${running.warnings.at(-1)}` : "";
    job.querySelector(".stop").disabled = stopping || !mayWrite();
    speak();
  }

  /* Screen readers hear a stage begin, and once a minute how long it still takes. */
  function speak() {
    const step = running.steps.find((one) => one.remaining_s !== null);
    const isNew = running.stage_title !== spoken.stage;
    if (!isNew && (Date.now() - spoken.at < 1000 * LOUD_EVERY_S || !step)) return;
    if (isNew && running.stage_title) say(`${running.stage_title} begins`);
    else if (step) say(
      `${running.stage_title}: ${step.step}, about ${duration(step.remaining_s)} left`);
    spoken = {stage: running.stage_title, at: Date.now()};
  }

  async function stop() {
    await attempt(async () => {
      await send("/api/run/stop");
      say("Stopping: the same command goes on from there later.");
    });
  }

  async function start(name, args = {}) {
    const begun = await attempt(() => send("/api/run/start", {name, arguments: args}));
    if (!begun) return;
    running = begun.job;
    finished = 0;
    spoken = {stage: "", at: Date.now()};
    say(`${running.title}: started`);
    log.follow(running);
    await load();
    job.querySelector(".stop")?.focus();
  }

  /* ---- How the last one ended ---- */

  function showLast(place) {
    const ended = known.last;
    place.hidden = !ended || Boolean(running) || Boolean(known.elsewhere);
    if (place.hidden) return;
    const [icon, colour, words] = ENDS[ended.state] || ENDS.killed;
    const again = {done: null, stopped: "Go on", failed: "Try again", killed: "Start again"}[
      ended.state];
    const ways = (ended.ways || []).map((way) => el("li", {}, el("code", {}, way.command), " ",
      way.name ? button(way.title, () => start(way.name), {disabled: !mayWrite()}) : null));
    place.replaceChildren(...[
      el("h2", {}, el("span", {class: "icon " + colour, "aria-hidden": "true"}, icon),
        ` ${ended.title}: ${words}`),
      el("p", {}, `${ago(ended.ended_utc)}, after `
        + `${duration(secondsOf(ended))}`),
      ended.line ? el("p",
        {class: ["failed", "killed"].includes(ended.state) ? "line error" : "line"},
        ended.line) : null,
      ways.length ? el("div", {}, el("p", {}, "The way on:"), el("ul", {}, ways)) : null,
      el("div", {class: "buttons"},
        again && ended.name !== "import-images"
          ? button(again, () => repeat(ended), {disabled: !mayWrite()}) : null,
        button("Show its log", () => log.show(ended)),
        ended.state === "done" && ended.finished.includes("report")
          ? button("Open the report", report) : null),
    ].filter(Boolean));
  }

  const repeat = (ended) => start(ended.name, ended.arguments || {});

  /* ---- What is left ---- */

  function costText(cost) {
    return cost ? `About ${duration(cost.time_s)} on ${counted(known.cores, "core")}, `
      + `${gigabytes(cost.disk_mb)} of disk` : "";
  }

  function showBegin() {
    const free = el("small", {}, `${number(known.disk.free_gb, "GB", 3)} of the disk are free`);
    if (known.fault) {
      begin.replaceChildren(el("p", {class: "error line"}, known.fault),
        known.ways.length
          ? el("ul", {}, known.ways.map((way) => el("li", {}, el("code", {}, way.command)))) : null,
        el("p", {}, "The stages are shown once that is settled."));
      return;
    }
    const wanted = known.commands.filter(
      (one) => (known.imported ? ["reconstruct", "report"] : ["run"]).includes(one.name));
    const all = wanted.find((one) => one.left.length);
    const left = all ? all.left : [];
    const tight = all?.cost && all.cost.disk_mb / 1000 > 0.9 * known.disk.free_gb;
    const made = known.stages.find((one) => one.name === "report");
    begin.replaceChildren(...[
      left.length ? el("p", {}, costText(all.cost)
        || "What it takes is known once there is a plan or pictures.", el("br"), free)
        : el("p", {}, "All stages are up to date. ", free),
      tight ? el("p", {class: "error"},
        "That is more than there is room for: free some of the disk first.") : null,
      el("div", {class: "buttons"},
        left.length ? button(all.title, () => start(all.name, options.of(all.name)), {
          class: "primary", disabled: Boolean(running) || Boolean(known.elsewhere)
          || !mayWrite()}) : null,
        made && made.made_utc ? button("Open the report", report) : null),
    ].filter(Boolean));
  }

  function showStages() {
    const groups = known.commands.filter((one) => one.name !== "run").map((command) => {
      const own = known.stages.filter((stage) => stage.command === command.name);
      if (!own.length) return null;
      const busy = Boolean(running) || Boolean(known.elsewhere);
      const begun = own.some((stage) => stage.state === "interrupted");
      const word = command.left.length && !command.after.length ? begun ? "Go on" : "Start" : null;
      const after = known.commands.filter((one) => one.name !== "run" && one.left.some(
        (name) => command.after.includes(name)));
      return el("section", {class: "group", "aria-label": command.title},
        el("div", {class: "head"}, el("h3", {}, command.title),
          word ? button(word, () => start(command.name, options.of(command.name)),
            {"aria-label": `${word}: ${command.title}`, disabled: busy || !mayWrite()}) : null),
        after.length ? el("small", {}, "after: " + after.map((one) => one.title).join(", ")) : null,
        command.cost ? el("small", {}, costText(command.cost)) : null,
        el("ul", {}, own.map(row)));
    }).filter(Boolean);
    const rest = known.stages.filter((stage) => !known.commands.some(
      (one) => one.name === stage.command));
    if (rest.length) groups.unshift(
      el("section", {class: "group", "aria-label": "Pictures"},
      el("div", {class: "head"}, el("h3", {}, "Imported pictures")), el("ul", {}, rest.map(row))));
    stages.replaceChildren(...groups);
  }

  function row(stage) {
    const working = running && running.stage === stage.folder
      && !running.finished.includes(stage.folder);
    const [icon, colour, words] = STATES[working ? "working" : stage.state] || STATES.missing;
    const why = stage.why && !working ? ` (${stage.why})` : "";
    const took = stage.took_s === null
      ? "" : `; took ${duration(stage.took_s)}${stage.made_utc ? ", " + ago(stage.made_utc) : ""}`;
    const broken = failed && failed.name === stage.command && stage.state !== "up to date"
      && !running && failed.stage === stage.folder;
    const open = stage.products.filter((one) => /\.(html|json|csv|txt|pdf|png)$/.test(one.path)
      || !one.path.includes("."));
    return el("li", {"data-stage": stage.name, "data-state": working ? "working" : stage.state},
      el("span", {class: "icon " + colour, "aria-hidden": "true"}, icon),
      el("div", {}, el("strong", {}, stage.name), ` ${words}${why}${took}`,
        broken ? el("p", {class: "error line"}, failed.line) : null,
        el("small", {}, stage.about),
        open.length ? el("small", {}, open.map(
          (one, i) => [i ? ", " : "", one.path === "report/report.html"
          ? el("a", {href: "#run", onclick: (event) => { event.preventDefault(); report(); }},
            one.about)
          : el("a", {href: "/files/" + one.path + (one.path.includes(".") ? "" : "/"),
            target: "_blank", rel: "noopener"}, one.about)])) : null));
  }

  /* ---- The report, inside ---- */

  function report() {
    const frame = el(
      "iframe", {src: "/files/report/report.html", sandbox: "allow-scripts",
      title: "Report of the survey"});
    const close = button("Close the report", () => sheet.close(), {class: "primary"});
    const sheet = el("dialog", {class: "report", "aria-label": "Report of the survey"},
      el("div", {class: "buttons"}, close,
        el("a", {href: "/files/report/report.html", target: "_blank", rel: "noopener"},
          "in a page of its own"),
        el("a", {href: "/files/report/report.pdf", target: "_blank", rel: "noopener"}, "PDF")),
          frame);
    sheet.addEventListener("close", () => sheet.remove());
    document.body.append(sheet);
    sheet.showModal();
  }

  /* ---- Options, and further commands ---- */

  function optionsView() {
    const threads = el("input", {type: "number", min: 1, max: 256, step: 1, placeholder: "all"});
    const scale = el(
      "input", {type: "number", min: 1, max: 16, step: 1, placeholder: "as in the settings"});
    const given = (input) => (input.value && input.checkValidity() ? Number(input.value) : null);
    const takes = {run: ["threads", "scale"], image: ["threads", "scale"], plan: [], fly: []};
    return {
      element: el("details", {}, el("summary", {}, "Options"),
        field("Cores to use", threads, "fewer need less memory"),
        field("Resolution of rendered pictures divided by", scale, "4 renders 16 times faster")),
      of(name) {
        const values = {threads: given(threads), scale: given(scale)};
        return Object.fromEntries((takes[name] || ["threads"]).filter((key) => values[key] !== null)
          .map((key) => [key, values[key]]));
      },
    };
  }

  function moreView() {
    const rows = [
      ["quality", "Judge the pictures: sharpness, exposure, overlap", "image"],
      ["control", "Find coded markers in the pictures", "image"],
      ["plan check", "Check what the flown dive has seen", "fly"],
      ["plan revisit", "Plan a dive over what the model lacks", "dense"],
      ["plan export", "Write the plan for vehicles again", "plan"],
    ];
    const list = el("div", {class: "buttons column"});
    return {
      element: el("details", {}, el("summary", {}, "Further commands"), list),
      show(state, busy) {
        const made = (name) => state.stages.some((stage) => stage.name === name && stage.made_utc);
        list.replaceChildren(...rows.filter((one) => made(one[2])).map(([name, title]) =>
          button(title, () => start(name),
            {disabled: Boolean(busy) || Boolean(state.elsewhere) || !mayWrite()})));
        this.element.hidden = !list.firstChild;
      },
    };
  }

  /* ---- Events ---- */

  on("run", (data) => {
    heardAt = Date.now();
    if (data.job) {
      running = data.job;
      if (!known) return;
      const grown = running.finished.length !== finished || !known.job;
      const moved = known.job?.stage !== running.stage;
      finished = running.finished.length;
      known.job = running;
      if (opened) showJob();
      if (opened && moved) showStages();
      if (opened && grown) load();
      log.follow(running);
      return;
    }
    if (data.ended) end(data.last);
  });

  async function end(ended) {
    running = null;
    finished = 0;
    const [icon, , words] = ENDS[ended.state] || ENDS.killed;
    const lasted = secondsOf(ended);
    say(`${ended.title}: ${words}${ended.state === "done" ? "" : ". " + ended.line}`,
      {done: "note", stopped: "warn"}[ended.state] || "error");
    if (lasted > LONG_S && !document.hasFocus()) notice(`${icon} ${words}: ${ended.title}`);
    log.follow({number: ended.number});
    await attempt(() => studio.refresh());
    await load();
    await history.show();
  }

  function notice(text) {
    const title = document.title;
    document.title = text;
    window.addEventListener("focus", () => { document.title = title; }, {once: true});
  }

  /* Commands of a terminal, and what was missed while this page slept. */
  async function watch() {
    if (document.hidden || Date.now() - heardAt < SILENT_MS) return;
    heardAt = Date.now();
    const now = await attempt(() => get("/api/run/job"));
    if (!now || !known) return;
    const same = (key) => JSON.stringify(now[key]) === JSON.stringify(known[key]);
    if (now.job?.number !== known.job?.number || !same("elsewhere")) load();
  }

  return {
    name: "run",
    title: "Run",
    panel,
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

/* ---- The log: fetched while it is open ---- */

const KEPT_LINES = 2000;

function logView() {
  const lines = el("ol", {class: "log", tabindex: "0", "aria-label": "Log"});
  const title = el("p", {});
  const element = el("details", {}, el("summary", {}, "Log"), title, lines);
  let job = null;
  let had = 0;
  let busy = false;

  async function more() {
    if (!element.open || job === null || busy) return;
    busy = true;
    const asked = job;
    const found = await attempt(() => get("/api/run/log", {job: asked, after: had}));
    busy = false;
    if (!found || asked !== job) return;
    const atEnd = lines.scrollTop + lines.clientHeight >= lines.scrollHeight - 8;
    const texts = found.lines.length || had || !found.output
      ? found.lines : [{kind: "note", text: found.output, time_utc: ""}];
    lines.append(...texts.map(
      (line) => el("li", {class: line.kind},
      line.time_utc ? el("time", {datetime: line.time_utc}, new Date(line.time_utc)
      .toLocaleTimeString("en-GB")) : null, " ", line.text)));
    while (lines.children.length > KEPT_LINES) lines.firstChild.remove();
    had = found.total;
    if (atEnd) lines.scrollTop = lines.scrollHeight;
  }

  function take(number) {
    if (number === job) return;
    job = number;
    had = 0;
    lines.replaceChildren();
    title.textContent = `of run ${number}`;
  }

  element.addEventListener("toggle", async () => {
    if (element.open && job === null) {
      const found = await attempt(() => get("/api/run"));
      const shown = found && (found.job || found.last);
      if (!shown) {
        title.textContent = "Nothing has run yet.";
        return;
      }
      take(shown.number);
    }
    more();
  });
  return {
    element,
    follow(running) {
      take(running.number);
      more();
    },
    async show(ended) {
      take(ended.number);
      element.open = true;
      await more();
      lines.focus();
      element.scrollIntoView({block: "end"});
    },
  };
}

function historyView() {
  const place = el("div", {});
  const element = el("details", {}, el("summary", {}, "Earlier runs"), place);
  async function show() {
    if (!element.open) return;
    const found = await attempt(() => get("/api/run/history"));
    if (!found) return;
    if (!found.jobs.length) {
      place.replaceChildren(el("p", {}, "None yet: runs that the studio starts are listed here."));
      return;
    }
    place.replaceChildren(
      table("Runs that the studio has started, the last first", ["what", "how it ended", "when"],
      found.jobs.map((one) => {
      const [icon, colour, words] = ENDS[one.state] || ENDS.killed;
      return [one.title, [el("span", {class: "icon " + colour, "aria-hidden": "true"}, icon),
        " " + words], ago(one.ended_utc)];
    })));
  }
  element.addEventListener("toggle", show);
  return {element, show};
}
