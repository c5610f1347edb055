/* A job that runs, as bars of its steps: made once and changed in place. */

import {el} from "./core.js";
import {duration} from "./words.js";

let made = 0;

export function showSteps(place, job) {
  job.steps.forEach((step, i) => {
    let bar = place.children[i];
    if (!bar) {
      made += 1;
      bar = el("div", {class: "step"}, el("span", {id: "step-" + made}),
        el("progress", {"aria-labelledby": "step-" + made}));
      place.append(bar);
    }
    const count = step.done === null ? "" : step.total
      ? ` ${step.done} of ${step.total}` : ` ${step.done}`;
    const left = step.remaining_s === null
      ? `, for ${duration(step.elapsed_s)}` : `, about ${duration(step.remaining_s)} left`;
    bar.firstChild.textContent = step.step + count + left;
    const meter = bar.lastChild;
    if (step.total) {
      meter.max = step.total;
      meter.value = step.done;
    } else {
      meter.removeAttribute("value");
    }
  });
  while (place.children.length > job.steps.length) place.lastChild.remove();
}
