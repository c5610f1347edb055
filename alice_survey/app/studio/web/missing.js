/* What a tab shows while the workspace lacks what it needs: one sentence, and the way there. */

import {button, el} from "./core.js";

/* `needed()` returns [text, tab, title of the button], or null where all is there; the content
   is hidden meanwhile. Returns the element and `show()`, which tells whether the tab can work. */
export function missing(studio, content, needed) {
  const element = el("div", {class: "missing", hidden: true});
  function show() {
    const lack = needed();
    content.hidden = Boolean(lack);
    element.hidden = !lack;
    if (!lack) return true;
    const [text, tab, title] = lack;
    element.replaceChildren(el("p", {}, text), el(
      "div", {class: "buttons"}, button(title, () => studio.open(tab), {class: "primary"})));
    return false;
  }
  return {element, show};
}
