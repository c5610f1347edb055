/* Files that are dropped on a part of the page. */

/* `taken(files)` gets them, while `active()`; the element is marked while they are over it. */
export function fileDrop(element, taken, active = () => true) {
  const over = (on) => element.classList.toggle("drop-here", on);
  element.addEventListener("dragover", (event) => {
    if (!active() || !event.dataTransfer.types.includes("Files")) return;
    event.preventDefault();
    over(true);
  });
  element.addEventListener("dragleave", () => over(false));
  element.addEventListener("drop", (event) => {
    over(false);
    if (!active() || !event.dataTransfer.files.length) return;
    event.preventDefault();
    taken(event.dataTransfer.files);
  });
}
