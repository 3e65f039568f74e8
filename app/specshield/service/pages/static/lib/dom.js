// Elements, and how numbers are written.

const SVG = "http://www.w3.org/2000/svg";

function made(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

export const el = (tag, attributes = {}, ...children) => made(document.createElement(tag), attributes, children);
export const svg = (tag, attributes = {}, ...children) =>
  made(document.createElementNS(SVG, tag), attributes, children);

/** Says a text to people who use a screen reader. */
export function say(text) {
  document.getElementById("said").textContent = text;
}

/** An error as the page shows it. */
export const problem = (error) => el("p", { class: "problem", role: "alert" }, error.told?.() ?? error.message);

/** A share as text; only none and all of it are 0 % and 100 %, up to rounding errors of sums. */
export function percent(share) {
  if (share > 0 && share < 0.001) return "<0.1 %";
  if (share >= 0.995 && share < 1 - 1e-9) return share > 0.999 ? ">99.9 %" : `${(100 * share).toFixed(1)} %`;
  return `${(100 * share).toFixed(share > 0.0995 ? 0 : 1)} %`;
}

/** A number as text, with a unit if there is one. */
export function amount(value, unit = "") {
  if (value === null || value === undefined) return "–";
  if (Math.abs(value) > 1e6) return value > 0 ? "∞" : "−∞";
  return `${value < 0 ? "−" : ""}${Math.abs(value).toFixed(2)}${unit}`;
}

export const metres = (value) => amount(value, " m");

/** Both ends of a long id, since the ids of a fleet often differ only in the last letters. */
export const short = (id) => (id.length > 24 ? `${id.slice(0, 11)}…${id.slice(-11)}` : id);

/** The name of a thing, or else its short id. */
export const called = (thing) => thing.name ?? short(thing.id);

export const button = (text, onclick, more = {}) => el("button", { type: "button", onclick, ...more }, text);

/** A row of a description list. */
export const pair = (name, ...value) => [el("dt", {}, name), el("dd", {}, ...value)];

/**
 * Gives `parent` one child for each item, in order. A child stays as long as its item, so that it keeps the focus.
 * key: returns the key of an item. make: makes its child. fill: writes into a child what may have changed.
 */
export function keep(parent, items, { key, make, fill }) {
  const before = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  const now = items.map((item) => {
    const child = before.get(key(item)) ?? make(item);
    child.dataset.key = key(item);
    fill(child, item);
    return child;
  });
  const stay = new Set(now);
  for (const child of [...parent.children]) if (!stay.has(child)) child.remove();
  now.forEach((child, i) => child !== parent.children[i] && parent.insertBefore(child, parent.children[i] ?? null));
}

/** Writes a text into an element if the element has another one. */
export function write(element, text) {
  if (element.textContent !== String(text)) element.textContent = text;
}

/** A function that calls `work` once, `wait` milliseconds after the last of its own calls. */
export function later(work, wait) {
  let timer = 0;
  return (...given) => {
    clearTimeout(timer);
    timer = setTimeout(() => work(...given), wait);
  };
}

/** A function that calls `draw` at most once for each frame of the screen. */
export function onceAFrame(draw) {
  let asked = false;
  return () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      draw();
    });
  };
}
