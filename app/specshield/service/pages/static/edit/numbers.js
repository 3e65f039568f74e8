// Fields in which the numbers of a region can be typed.

import { el } from "../lib/dom.js";

/** Fields for the numbers of a region. changed: called after a change. tell: called with what is wrong, or "". */
export function numbers(region, changed, tell) {
  const input = (label, holder, key) => number(label, holder, key, changed, tell);
  if (region.type === "circle") return [input("x", region.center, 0), input("y", region.center, 1), input("r", region, "radius")];
  if (region.type === "rectangle")
    return [input("x", region.min, 0), input("to", region.max, 0), input("y", region.min, 1), input("to", region.max, 1)];
  return [corners(region, changed, tell)];
}

function number(label, holder, key, changed, tell) {
  const field = el("input", { type: "number", step: "any", value: holder[key], onchange: take });
  function take() {
    if (field.value === "") {
      field.value = holder[key];
      return tell(`A number is needed here: it is ${holder[key]}, as before.`);
    }
    holder[key] = Number(field.value);
    tell("");
    changed();
  }
  return el("label", {}, `${label} `, field);
}

/** The corners of a polygon as one line of text. */
function corners(region, changed, tell) {
  const value = region.vertices.map((corner) => corner.join(", ")).join("; ");
  const field = el("input", { class: "corners", value, spellcheck: "false", autocomplete: "off", onchange: take });
  function take() {
    try {
      region.vertices = read(field.value);
    } catch (error) {
      field.setAttribute("aria-invalid", "true");
      return tell(`${error.message} The polygon is as before.`);
    }
    field.removeAttribute("aria-invalid");
    tell("");
    changed();
  }
  return el("label", {}, "Corners ", field);
}

/** The corners that a text spells: `x, y; x, y; x, y`. Throws an Error that says which of them is wrong. */
export function read(text) {
  const parts = text.split(";").map((part) => part.trim());
  if (parts.at(-1) === "") parts.pop();
  const found = parts.map((part, i) => {
    const pair = part.split(/\s*,\s*|\s+/);
    const corner = pair.map(Number);
    if (pair.length === 2 && !pair.includes("") && corner.every(Number.isFinite)) return corner;
    throw new Error(`Corner ${i + 1} is "${part}"; write two numbers, x and y in metres, as in 1, 2; 3.5, 2; 3, 4.`);
  });
  if (found.length >= 3) return found;
  throw new Error(`A polygon has at least 3 corners, and here ${found.length === 1 ? "is 1" : `are ${found.length}`}; write x, y; x, y; x, y.`);
}
