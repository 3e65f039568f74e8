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

/** Told to those who hear the page. */
export function say(text) {
  document.getElementById("said").textContent = text;
}

export const percent = (share) =>
  share > 0 && share < 0.001 ? "<0.1 %" : `${(100 * share).toFixed(share > 0.0995 ? 0 : 1)} %`;

/** Metres, or whatever the rule counts in. */
export function metres(value) {
  if (value === null || value === undefined) return "–";
  if (Math.abs(value) > 1e6) return value > 0 ? "∞" : "−∞";
  return `${value < 0 ? "−" : ""}${Math.abs(value).toFixed(2)} m`;
}

export const short = (id) => (id.length > 24 ? `${id.slice(0, 8)}…` : id);

/** A named thing by its name. */
export const called = (thing) => thing.name ?? short(thing.id);

export const button = (text, onclick, more = {}) => el("button", { type: "button", onclick, ...more }, text);

/** A row of a description list. */
export const pair = (name, ...value) => [el("dt", {}, name), el("dd", {}, ...value)];

/** Calls `work` once after the last call, `wait` milliseconds later. */
export function later(work, wait) {
  let timer = 0;
  return (...given) => {
    clearTimeout(timer);
    timer = setTimeout(() => work(...given), wait);
  };
}

/** At most one call of `draw` for each picture on the screen. */
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
