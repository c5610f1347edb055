/* Colours of what is drawn on maps and charts, which the colour-blind tell apart
   (Okabe and Ito, Color Universal Design, 2008), and those that the page of a plan has too. */

export const BLUE = "#0072b2";
export const SKY = "#56b4e9";
export const GREEN = "#009e73";
export const ORANGE = "#e69f00";
export const RED = "#d55e00";
export const PINK = "#cc79a7";
export const GREY = "#6b6b6b";
export const INK = "#16232b";  /* rims and signs on pictures, with WHITE */
export const WHITE = "#fff";

/* Kinds of lines and shapes of a plan. */
export const PLAN = {
  survey: "#1b4f72", cross: "#6c3483", closing: "#117a65", fill: "#b9770e", tie: "#c0392b",
  way: "#7f8c8d", home: "#1e8449", footprint: "#2e86c1", mark: "#8e44ad", allowed: "#566573",
  area: "#c8553d", no_go: "#b03a2e", corridor: "#117a65", missed: "#d35400",
};

/* From few to many, light to dark. */
export const COUNTS = ["#f7fcf0", "#ddf1d9", "#bfe6c4", "#93d3c0", "#60bbc8", "#3597c1", "#1474b0",
  "#084c8d"];
