/* What the theme adds once a page is loaded: tables that scroll are reached by the keyboard, and
   copy buttons are no landmarks. */
new MutationObserver(() => {
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((one) => { one.tabIndex = 0; });
  document.querySelectorAll(".md-code__nav").forEach((one) => one.setAttribute("role", "none"));
}).observe(document.body, {childList: true, subtree: true});
