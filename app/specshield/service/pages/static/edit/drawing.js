// Drawing on a floor: a circle, a rectangle or a polygon, with the mouse, a finger or the keyboard.

import { button, el, svg } from "../lib/dom.js";

const SMALLEST = 0.05; // [m]; less is a click that slipped
const PLACED = 8; // of what is seen, from the middle of a shape that a key places to its edge
const TOOLS = { circle: "Circle", rectangle: "Rectangle", polygon: "Polygon" };
const KEYS = "Enter places one in the middle of what is seen, Escape leaves it.";
const HINTS = {
  circle: `Press at the centre, pull to the edge. ${KEYS}`,
  rectangle: `Press at a corner, pull to the opposite one. ${KEYS}`,
  polygon: "Click each corner; a double click or Enter closes it, Escape forgets it. Before the first corner, Enter places a triangle in the middle of what is seen.",
};
const round = (value) => Math.round(value * 100) / 100;
const point = (p) => p.map(round);
const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

export class Drawing {
  /** drawn: called with each region that is drawn. */
  constructor(floor, drawn) {
    Object.assign(this, { floor, drawn, tool: null, corners: [], stroke: null });
    this.draft = svg("g", { class: "region draft" });
    floor.layers.marks.append(this.draft);
    this.tools = Object.entries(TOOLS).map(([tool, name]) => button(name, () => this.press(tool), { "aria-pressed": "false", "data-tool": tool }));
    this.hint = el("p", { class: "hint", role: "status" });
    this.elements = [el("div", { class: "row", role: "group", "aria-label": "Draw" }, this.tools), this.hint];
    this.listen();
    this.choose(null);
  }

  /** A tool's button: what is chosen already is left; else the keys go to the floor. */
  press(tool) {
    this.choose(this.tool === tool ? null : tool);
    if (this.tool) this.floor.element.focus();
  }

  choose(tool) {
    this.tool = tool;
    this.corners = [];
    this.forget();
    for (const each of this.tools) each.setAttribute("aria-pressed", String(each.dataset.tool === tool));
    this.floor.element.classList.toggle("drawing", tool !== null);
    this.hint.textContent = HINTS[tool] ?? "Choose a shape, then draw on the floor. Its numbers can be changed below.";
  }

  /** Back to the button of the tool that was chosen. */
  leave() {
    const chosen = this.tools.find((each) => each.dataset.tool === this.tool);
    this.choose(null);
    chosen?.focus();
  }

  listen() {
    const { element } = this.floor;
    element.addEventListener("pointerdown", (event) => this.begin(event));
    element.addEventListener("pointermove", (event) => this.sketch(event));
    element.addEventListener("pointerup", (event) => this.end(event));
    element.addEventListener("pointercancel", (event) => event.pointerId === this.stroke?.id && this.forget());
    element.addEventListener("dblclick", () => this.corners.length && this.close());
    element.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || !this.tool) return;
      event.preventDefault();
      if (this.corners.length) this.close();
      else this.place();
    });
    for (const each of [element, this.elements[0]])
      each.addEventListener("keydown", (event) => event.key === "Escape" && this.tool && this.leave());
  }

  /** One pointer draws. A second finger means something else: what the first has begun is forgotten. */
  begin(event) {
    if (!this.tool || event.button) return;
    event.preventDefault();
    if (this.stroke || !event.isPrimary) return this.forget();
    this.floor.element.setPointerCapture(event.pointerId);
    this.stroke = { id: event.pointerId, from: this.floor.point(event) };
  }

  sketch(event) {
    if (!this.tool) return;
    const to = this.floor.point(event);
    if (this.tool === "polygon" && this.corners.length && event.isPrimary) return this.outline([...this.corners, to]);
    if (event.pointerId !== this.stroke?.id || this.tool === "polygon") return;
    const region = spanned(this.tool, this.stroke.from, to);
    this.draft.replaceChildren(...(region ? [this.floor.shape(region)] : []));
  }

  end(event) {
    if (event.pointerId !== this.stroke?.id) return;
    const { from } = this.stroke;
    this.stroke = null;
    const to = this.floor.point(event);
    if (this.tool === "polygon") this.corner(to);
    else this.finish(spanned(this.tool, from, to));
  }

  /** Forgets what a pointer has begun; the corners that are set stay. */
  forget() {
    this.stroke = null;
    this.outline(this.corners);
  }

  corner(at) {
    const last = this.corners.at(-1);
    if (!last || apart(last, at) > SMALLEST) this.corners.push(at);
    this.outline(this.corners);
  }

  outline(points) {
    this.draft.replaceChildren(...(points.length ? [svg("polyline", { points: this.floor.line(points) })] : []));
  }

  close() {
    const vertices = this.corners.map(point);
    if (vertices.length >= 3) return this.finish({ type: "polygon", vertices });
    this.leave();
    this.hint.textContent = "A polygon has at least 3 corners; the one begun had fewer and is forgotten.";
  }

  /** A shape in the middle of what is seen, for those who draw with keys; its numbers can be typed. */
  place() {
    const { middle: [x, y], side } = this.floor.seen();
    const far = Math.max(SMALLEST, side / PLACED);
    if (this.tool === "polygon") {
      const vertices = [[x - far, y - far], [x + far, y - far], [x, y + far]].map(point);
      this.finish({ type: "polygon", vertices });
    } else if (this.tool === "circle") this.finish(spanned("circle", [x, y], [x + far, y]));
    else this.finish(spanned("rectangle", [x - far, y - far], [x + far, y + far]));
  }

  finish(region) {
    this.choose(null);
    if (region) this.drawn(region);
  }
}

/** The circle or rectangle between two points; null where it is too small. */
function spanned(tool, from, to) {
  const far = apart(from, to);
  if (tool === "circle") return far < SMALLEST ? null : { type: "circle", center: point(from), radius: round(far) };
  const [min, max] = [Math.min, Math.max].map((pick) => point([pick(from[0], to[0]), pick(from[1], to[1])]));
  return max[0] - min[0] < SMALLEST || max[1] - min[1] < SMALLEST ? null : { type: "rectangle", min, max };
}
