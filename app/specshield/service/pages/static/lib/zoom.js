// Chooses the part of a floor that is seen, by wheel, two fingers, buttons and keys. At first all of it is seen.

import { button, el } from "./dom.js";

const STEP = 1.4; // factor for each press of a button or key; chosen by hand
const MOST = 40; // the largest factor, unless a narrow floor needs more to be as wide as its frame
const NARROWEST = 3; // the largest ratio of a frame's sides, however narrow the floor is
const FINE = 1.0015; // factor for each pixel of the wheel
const SLIPPED = 4; // [px] that the pointer may move during a click
const UNIT = [5, 7]; // [px] the least and the most that `--unit`, a hundredth of the picture, becomes on the screen

export class Zoom {
  /** svg: the picture; bounds: [x0, y0, wide, high] of all of it, in its own units. */
  constructor(svg, bounds) {
    const [x0, y0, wide, high] = bounds;
    Object.assign(this, { svg, bounds, times: 1, middle: [x0 + wide / 2, y0 + high / 2] });
    this.ratio = Math.min(NARROWEST, Math.max(1 / NARROWEST, wide / high)); // of the frame, wide to high
    this.whole = [Math.max(wide, high * this.ratio), Math.max(high, wide / this.ratio)]; // the frame, when all is seen
    this.most = Math.max(MOST, this.whole[0] / wide, this.whole[1] / high);
    this.fingers = new Map();
    const press = (name, sign, work) => button(sign, work, { "aria-label": name, title: name });
    this.buttons = el(
      "div",
      { class: "zoom", role: "group", "aria-label": "Zoom" },
      press("Closer", "+", () => this.by(STEP)),
      press("Farther", "−", () => this.by(1 / STEP)),
      (this.all = press("All of the floor", "⤢", () => this.by(0))),
    );
    svg.setAttribute("tabindex", "0");
    svg.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    svg.addEventListener("pointerdown", (event) => this.fingers.set(event.pointerId, this.down(event)));
    svg.addEventListener("pointermove", (event) => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, (event) => this.fingers.delete(event.pointerId));
    svg.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.show()).observe(svg);
    this.show();
  }

  /** Closer by a factor, 0 for all of the floor; `at` stays where it is on the screen. */
  by(factor, at = this.middle) {
    const times = factor && Math.min(this.most, Math.max(1, this.times * factor));
    const kept = this.times / (times || 1);
    this.middle = this.middle.map((m, k) => at[k] + (m - at[k]) * kept);
    this.times = times || 1;
    this.show();
  }

  moved(dx, dy) {
    this.middle = [this.middle[0] + dx, this.middle[1] + dy];
    this.show();
  }

  show() {
    const [x0, y0, wide, high] = this.bounds;
    const [w, h] = this.whole.map((side) => side / this.times);
    const within = (value, low, size, seen) =>
      seen >= size ? low + size / 2 : Math.min(low + size - seen / 2, Math.max(low + seen / 2, value));
    this.middle = [within(this.middle[0], x0, wide, w), within(this.middle[1], y0, high, h)];
    this.svg.setAttribute("viewBox", `${this.middle[0] - w / 2} ${this.middle[1] - h / 2} ${w} ${h}`);
    const { width, height } = this.svg.getBoundingClientRect();
    const pixels = Math.min(width / this.whole[0], height / this.whole[1]) || 1; // of a unit of the picture, when all is seen
    const unit = Math.min(UNIT[1], Math.max(UNIT[0], (pixels * Math.max(...this.whole)) / 100));
    this.svg.style.setProperty("--unit", `${unit / pixels / this.times}px`);
    this.svg.classList.toggle("closer", this.times > 1);
    this.all.disabled = this.times === 1;
  }

  /** How wide and how high a part of the picture is seen. */
  seen() {
    return [0, 1].map((k) => Math.min(this.bounds[2 + k], this.whole[k] / this.times));
  }

  /** A point of the screen in the units of the picture. */
  point({ clientX, clientY }) {
    const { x, y } = new DOMPoint(clientX, clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [x, y];
  }

  wheel(event) {
    const factor = FINE ** -(event.deltaY * (event.deltaMode ? 20 : 1));
    if (factor < 1 && this.times === 1) return; // all is seen: the page scrolls
    event.preventDefault();
    this.by(factor, this.point(event));
  }

  down({ clientX, clientY }) {
    return { clientX, clientY, slipped: 0 };
  }

  /** Two fingers zoom; one finger or the mouse moves what is seen, where it does not draw. */
  drag(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    if (!event.buttons) return this.fingers.delete(event.pointerId); // it was let go outside the picture
    const slipped = before.slipped + Math.hypot(event.clientX - before.clientX, event.clientY - before.clientY);
    const [was, is] = [this.point(before), this.point(event)];
    const other = [...this.fingers].find(([id]) => id !== event.pointerId)?.[1];
    this.fingers.set(event.pointerId, { ...this.down(event), slipped });
    if (other) {
      const fixed = this.point(other);
      const far = (p) => Math.hypot(p[0] - fixed[0], p[1] - fixed[1]);
      if (far(was) > 0) this.by(far(is) / far(was), fixed);
    } else if (this.times > 1 && slipped > SLIPPED && !this.svg.classList.contains("drawing")) this.moved(was[0] - is[0], was[1] - is[1]);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const far = this.whole[0] / this.times / 10;
    const moves = { ArrowLeft: [-far, 0], ArrowRight: [far, 0], ArrowUp: [0, -far], ArrowDown: [0, far] };
    const zooms = { "+": STEP, "=": STEP, "-": 1 / STEP, 0: 0 };
    if (event.key in zooms) this.by(zooms[event.key]);
    else if (event.key in moves && this.times > 1) this.moved(...moves[event.key]);
    else return;
    event.preventDefault();
  }
}
