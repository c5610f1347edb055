/* Durations, sizes and times as people say them, and the style of the Run tab. */

import {el, number} from "./core.js";

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 90) return `${whole} s`;
  const minutes = Math.round(whole / 60);
  if (minutes < 90) return `${minutes} min`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

export const gigabytes = (megabytes) => (megabytes < 1000
  ? number(megabytes, "MB", 2) : number(megabytes / 1000, "GB", 2));

export function ago(utc) {
  const seconds = (Date.now() - new Date(utc).getTime()) / 1000;
  if (seconds < 60) return "just now";
  if (seconds < 24 * 3600) return duration(seconds) + " ago";
  return new Date(utc).toLocaleDateString("en-GB", {day: "numeric", month: "short", year: "numeric"});
}

let isStyled = false;
export function styled() {
  if (isStyled) return;
  isStyled = true;
  document.head.append(el("link", {rel: "stylesheet", href: "/app/run.css"}));
}
