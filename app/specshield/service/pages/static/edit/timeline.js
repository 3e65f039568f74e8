// The windows of a rule, one under the other, from step 0 to its horizon.

import { el } from "../lib/dom.js";

const SAID = { F: "at some step", G: "at every step", U: "until, within" };

/** answer: of /v1/specs/validate. */
export function timeline({ windows, horizon, avoided }) {
  const rows = windows.map((window) => row(window, Math.max(1, horizon), avoided));
  return el("ol", { class: "timeline", "aria-label": `Windows, steps 0 to ${horizon}` }, rows);
}

/** Whether a formula has this name in it, and not as a part of a longer one. */
const names = (formula, name) => new RegExp(`(?<!\\w)${name.replace(/[()]/g, "\\$&")}(?!\\w)`).test(formula);

function row({ operator, formula, begin, end, depth }, horizon, avoided) {
  const bar = el("i", { class: `bar ${operator}` });
  bar.style.left = `${(100 * begin) / horizon}%`;
  bar.style.width = `${Math.max(0.8, (100 * (end - begin)) / horizon)}%`;
  if (avoided.some((name) => names(formula, name)) && operator === "G") bar.classList.add("avoid");
  const text = el("span", { class: "of" }, el("code", {}, formula), el("small", {}, ` ${depth ? "may look at steps" : SAID[operator]} ${begin} to ${end}`));
  if (depth) text.style.paddingLeft = `${depth}rem`;
  return el("li", {}, text, el("span", { class: "track" }, bar));
}
