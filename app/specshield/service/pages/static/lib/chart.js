// Draws a number over time as a line, and marks the step that is shown.

import { el, svg } from "./dom.js";

const [WIDE, HIGH] = [300, 70];

export class Chart {
  /** name: of the number. told: writes a value. zero: whether zero is always in the picture. */
  constructor(name, told, zero = true) {
    this.told = told;
    this.zero = zero;
    this.value = el("span");
    this.line = svg("polyline", { class: "line" });
    this.base = svg("line", { class: "base", x1: 0, x2: WIDE });
    this.now = svg("line", { class: "now", y1: 0, y2: HIGH });
    this.plot = svg(
      "svg",
      { viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", role: "img", "aria-label": name },
      this.base, this.line, this.now,
    );
    this.element = el("figure", { class: "chart" }, el("figcaption", {}, name, this.value), this.plot);
  }

  /** values: [t, value] of each step that has one. last: the right end of the time axis. t: the step shown. */
  show(values, last, t) {
    this.element.hidden = values.length === 0;
    if (!values.length) return;
    const seen = values.map(([, value]) => value);
    const low = Math.min(...seen, this.zero ? 0 : Infinity);
    const high = Math.max(...seen, this.zero ? 0 : -Infinity);
    const room = high - low || 1;
    const x = (step) => ((WIDE * step) / Math.max(1, last)).toFixed(1);
    const y = (value) => (4 + ((HIGH - 8) * (high - value)) / room).toFixed(1);
    this.line.setAttribute("points", values.map(([step, value]) => `${x(step)},${y(value)}`).join(" "));
    for (const end of ["y1", "y2"]) this.base.setAttribute(end, y(0));
    for (const end of ["x1", "x2"]) this.now.setAttribute(end, x(t));
    const here = values.find(([step]) => step === t);
    this.value.textContent = here ? this.told(here[1]) : "–";
  }
}
