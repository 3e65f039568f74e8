// The regions of a rule: drawn on a floor, named, and changed by their numbers.

import { button, el } from "../lib/dom.js";
import { Drawing } from "./drawing.js";
import { unfit } from "./names.js";
import { numbers } from "./numbers.js";

export class Regions {
  /** regions, signals: by name. changed: called when the regions have changed. rooms: names of the map's rooms. */
  constructor(floor, regions, signals, rooms, changed) {
    Object.assign(this, { floor, regions, signals, rooms, changed });
    this.drawing = new Drawing(floor, (region) => this.add(region));
    this.list = el("ul", { class: "regions" }, Object.keys(regions).map((name) => this.row(name)));
    this.element = el("section", { class: "card", "aria-label": "Regions" }, el("h2", {}, "Regions"), this.drawing.elements, this.list);
    this.redraw(false);
  }

  add(region) {
    const taken = [...this.taken(), ...this.rooms];
    let n = 1;
    while (taken.includes(`Region${n}`)) n++;
    const name = `Region${n}`;
    this.regions[name] = region;
    const row = this.row(name);
    this.list.append(row);
    this.redraw(false);
    this.changed(name);
    row.querySelector("input").focus();
    row.querySelector("input").select();
  }

  /** The names that no further region can have. It may have the name of a room, which it then replaces. */
  taken() {
    return [...Object.keys(this.regions), ...Object.keys(this.signals)];
  }

  row(name) {
    const wrong = el("p", { class: "wrong", role: "alert" });
    const tell = (text) => (wrong.textContent = text);
    const field = el("input", { value: name, "aria-label": "Name of the region", class: "name", spellcheck: "false", onchange: () => named() });
    const away = button("Remove", () => this.remove(name, row), { "aria-label": `Remove ${name}` });
    const row = el("li", {}, field, el("span", { class: "numbers" }, numbers(this.regions[name], () => this.redraw(), tell)), away, wrong);
    const named = () => {
      const to = field.value.trim();
      const why = to === name ? "" : unfit(to, this.taken(), "region or signal");
      field.setAttribute("aria-invalid", String(why !== ""));
      tell(why && `"${to}" ${why}. The region is still called ${name}.`);
      if (why) return;
      field.value = to;
      if (to === name) return;
      this.rename(name, to);
      away.setAttribute("aria-label", `Remove ${to}`);
      name = to;
    };
    return row;
  }

  redraw(told = true) {
    this.floor.regions(this.regions, this.avoided);
    if (told) this.changed();
  }

  rename(from, to) {
    const entries = Object.entries(this.regions).map(([name, region]) => [name === from ? to : name, region]);
    for (const name of Object.keys(this.regions)) delete this.regions[name];
    for (const [name, region] of entries) this.regions[name] = region;
    this.redraw(false);
    this.changed(null, [from, to]);
  }

  remove(name, row) {
    delete this.regions[name];
    row.remove();
    this.redraw();
    this.drawing.tools[0].focus();
  }
}
