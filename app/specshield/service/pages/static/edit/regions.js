// Regions that are drawn on a floor: with the mouse or a finger, or by their numbers.

import { button, el, svg } from "../lib/dom.js";

const SMALLEST = 0.05; // [m]; less is a click that slipped
const TOOLS = { circle: "Circle", rectangle: "Rectangle", polygon: "Polygon" };
const round = (value) => Math.round(value * 100) / 100;
const point = (p) => p.map(round);

export class Regions {
  /** regions: by name; changed: called when they are others. taken: names that rooms have. */
  constructor(floor, regions, taken, changed) {
    Object.assign(this, { floor, regions, taken, changed, tool: null, corners: [] });
    this.draft = svg("g", { class: "region draft" });
    floor.layers.marks.append(this.draft);
    this.tools = Object.entries(TOOLS).map(([tool, name]) => button(name, () => this.choose(tool), { "aria-pressed": "false", "data-tool": tool }));
    this.hint = el("p", { class: "hint", role: "status" });
    this.list = el("ul", { class: "regions" });
    this.element = el(
      "section",
      { class: "card", "aria-label": "Regions" },
      el("h2", {}, "Regions"),
      el("div", { class: "row", role: "group", "aria-label": "Draw" }, this.tools),
      this.hint,
      this.list,
    );
    this.listen();
    this.show();
    this.choose(null);
  }

  choose(tool) {
    this.tool = this.tool === tool ? null : tool;
    this.corners = [];
    this.draft.replaceChildren();
    for (const each of this.tools) each.setAttribute("aria-pressed", String(each.dataset.tool === this.tool));
    this.floor.element.classList.toggle("drawing", this.tool !== null);
    this.hint.textContent = {
      circle: "Press at the centre, pull to the edge.",
      rectangle: "Press at a corner, pull to the opposite one.",
      polygon: "Click each corner; a double click or Enter closes it, Escape forgets it.",
    }[this.tool] ?? "Choose a shape, then draw on the floor. Its numbers can be changed below.";
  }

  listen() {
    const { element } = this.floor;
    element.addEventListener("pointerdown", (event) => {
      if (!this.tool || event.button) return;
      event.preventDefault();
      const from = this.floor.point(event);
      if (this.tool === "polygon") return this.corner(from);
      element.setPointerCapture(event.pointerId);
      const move = (now) => this.sketch(spanned(this.tool, from, this.floor.point(now)));
      const end = (now) => {
        element.removeEventListener("pointermove", move);
        this.add(spanned(this.tool, from, this.floor.point(now)));
      };
      element.addEventListener("pointermove", move);
      element.addEventListener("pointerup", end, { once: true });
    });
    element.addEventListener("pointermove", (event) => {
      if (this.corners.length) this.outline([...this.corners, this.floor.point(event)]);
    });
    element.addEventListener("dblclick", () => this.close());
    addEventListener("keydown", (event) => {
      if (!this.corners.length || !element.isConnected) return;
      if (event.key === "Enter") this.close();
      if (event.key === "Escape") this.choose(null);
    });
  }

  corner(at) {
    const last = this.corners.at(-1);
    if (!last || Math.hypot(at[0] - last[0], at[1] - last[1]) > SMALLEST) this.corners.push(at);
    this.outline(this.corners);
  }

  outline(points) {
    this.draft.replaceChildren(svg("polyline", { points: this.floor.line(points) }));
  }

  close() {
    if (this.tool !== "polygon") return;
    const vertices = this.corners.map(point);
    if (vertices.length >= 3) this.add({ type: "polygon", vertices });
    else this.choose(null);
  }

  sketch(region) {
    this.draft.replaceChildren(...(region ? [this.floor.shape(region)] : []));
  }

  add(region) {
    this.choose(null);
    if (!region) return;
    let n = 1;
    while (`Region${n}` in this.regions || this.taken.includes(`Region${n}`)) n++;
    this.regions[`Region${n}`] = region;
    this.show();
    this.changed(`Region${n}`);
    this.list.querySelector("li:last-child input")?.select();
  }

  show() {
    const rows = Object.entries(this.regions).map(([name, region]) => {
      const called = el("input", { value: name, "aria-label": "Name of the region", class: "name", maxlength: 64, onchange: (event) => this.rename(name, event.target) });
      const away = button("Remove", () => this.remove(name), { "aria-label": `Remove ${name}` });
      return el("li", {}, called, el("span", { class: "numbers" }, numbers(region, () => this.redraw())), away);
    });
    this.list.replaceChildren(...rows);
    this.redraw(false);
  }

  redraw(told = true) {
    this.floor.regions(this.regions, this.avoided);
    if (told) this.changed();
  }

  rename(from, input) {
    const to = input.value.trim();
    const free = /^[A-Za-z_]\w*$/.test(to) && !(to in this.regions) && !["x", "y", "theta"].includes(to);
    if (!free) {
      input.value = from;
      return;
    }
    const entries = Object.entries(this.regions).map(([name, region]) => [name === from ? to : name, region]);
    for (const name of Object.keys(this.regions)) delete this.regions[name];
    Object.assign(this.regions, Object.fromEntries(entries));
    this.show();
    this.changed(null, [from, to]);
  }

  remove(name) {
    delete this.regions[name];
    this.show();
    this.changed();
  }
}

/** The circle or rectangle between two points; null where it is too small. */
function spanned(tool, from, to) {
  const far = Math.hypot(to[0] - from[0], to[1] - from[1]);
  if (tool === "circle") return far < SMALLEST ? null : { type: "circle", center: point(from), radius: round(far) };
  const [min, max] = [Math.min, Math.max].map((pick) => point([pick(from[0], to[0]), pick(from[1], to[1])]));
  return max[0] - min[0] < SMALLEST || max[1] - min[1] < SMALLEST ? null : { type: "rectangle", min, max };
}

/** Inputs for the numbers of a region. */
function numbers(region, changed) {
  const input = (label, holder, key) =>
    el("label", {}, label, el("input", {
      type: "number", step: 0.05, value: holder[key],
      onchange: (event) => {
        if (event.target.value !== "") holder[key] = Number(event.target.value);
        changed();
      },
    }));
  if (region.type === "circle") return [input("x ", region.center, 0), input("y ", region.center, 1), input("r ", region, "radius")];
  if (region.type === "rectangle")
    return [input("x ", region.min, 0), input("to ", region.max, 0), input("y ", region.min, 1), input("to ", region.max, 1)];
  return [el("span", {}, `${region.vertices?.length ?? 0} corners`)];
}
