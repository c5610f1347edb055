/* What a plan comes to: totals, warnings, settings and why; or why there is none,
   and the setting that would help. */

import {button, el, table} from "./core.js";
import {keyFigures, totalRows} from "./plan_words.js";

/* `apply(changes)` takes a suggestion. */
export function resultsPanel(apply) {
  const key = el("dl", {class: "plan-key plan-totals"});
  const totals = el("div", {class: "plan-totals"});
  const refused = el("div", {hidden: true});
  const warnings = el("ul", {class: "warn", hidden: true});
  const rows = el("div");
  const rowsBox = el("details", {hidden: true}, el("summary", {}, "Settings and why"), rows);

  function show(preview) {
    refused.hidden = preview.ok;
    if (!preview.ok) {
      refuse(preview);
      return;
    }
    key.replaceChildren(...keyFigures(preview.totals).map(
      ([name, text]) => el("div", {}, el("dt", {}, name), el("dd", {}, text))));
    totals.replaceChildren(table("Totals", [], totalRows(preview.totals)));
    warnings.hidden = !preview.warnings.length;
    warnings.replaceChildren(...preview.warnings.map((text) => el("li", {}, text)));
    rowsBox.hidden = !preview.rows.length;
    rows.replaceChildren(table("Settings and why", ["setting", "value", "why"], preview.rows));
  }

  function refuse({error, suggestion}) {
    const words = suggestion && Object.entries(suggestion).flatMap(([section, values]) =>
      Object.entries(values).map(([key, value]) => section + "." + key + " = " + value));
    refused.replaceChildren(
      el("p", {class: "error"}, "No plan: " + error),
      el("p", {class: "note"}, "The map shows the last plan."),
      ...(words ? [el("div", {class: "plan-ways"},
        button("Set " + words.join(", "), () => apply(suggestion)))] : []),
    );
  }

  const totalsBox = el("details", {}, el("summary", {}, "All figures"), totals);
  return {key, top: el("div", {}, refused, warnings),
    below: el("div", {}, totalsBox, rowsBox), show};
}
