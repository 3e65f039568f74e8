// A map: regions are drawn on it, a rule is written, and a policy is asked for.

import { ask } from "../lib/api.js";
import { called, el, pair } from "../lib/dom.js";
import { Floor } from "../lib/floor.js";
import { makeForm } from "../edit/make.js";
import { Regions } from "../edit/regions.js";
import { Rule } from "../edit/rule.js";

export async function show(place, { id, signal }) {
  const map = await ask(`v1/maps/${encodeURIComponent(id)}`, { signal });
  const robots = (await ask("v1/robots", { signal })).items;
  const floor = new Floor(map, `Floor ${called(map)}`);
  const draft = restored(map.id);
  const rooms = Object.keys(map.rooms);
  let drawn = null; // what the constructors below call before it is there
  const keep = (formula) => sessionStorage.setItem(`draft-${map.id}`, JSON.stringify({ ...draft, formula }));
  const rule = new Rule(draft.formula, map, draft.regions, draft.signals, keep, (answer) => {
    form?.allow(answer !== null);
    if (drawn) {
      drawn.avoided = answer?.avoided ?? [];
      drawn.redraw(false);
    }
  });
  const regions = new Regions(floor, draft.regions, draft.signals, rooms, (name, renamed) => {
    if (renamed) rule.renamed(...renamed);
    rule.show(renamed ? renamed[1] : name);
    rule.changed();
  });
  drawn = regions;
  const spec = () => ({ map_id: map.id, spec: { formula: rule.text, regions: draft.regions, signals: draft.signals } });
  const form = makeForm(robots, spec);
  place.append(
    el("h1", {}, called(map)),
    el(
      "div",
      { class: "watch" },
      el("div", { class: "stack" }, floor.frame, regions.element),
      el("div", { class: "stack" }, rule.element, form.element, about(map, rooms)),
    ),
  );
  await floor.load(signal);
}

/** The draft that this tab keeps of a map. Its regions and signals inherit nothing, so that any name can be one. */
function restored(id) {
  let kept = null;
  try {
    kept = JSON.parse(sessionStorage.getItem(`draft-${id}`));
  } catch {
    // a draft that cannot be read is none
  }
  const [regions, signals] = [kept?.regions, kept?.signals].map((named) => Object.assign(Object.create(null), named));
  return { formula: kept?.formula ?? "", regions, signals };
}

function about(map, rooms) {
  const [x0, y0, x1, y1] = map.bounds.map((value) => value.toFixed(2));
  return el(
    "section",
    { class: "card", "aria-label": "About this map" },
    el("h2", {}, "Map"),
    el(
      "dl",
      { class: "numbers" },
      pair("x", `${x0} to ${x1} m`),
      pair("y", `${y0} to ${y1} m`),
      pair("Cells", `${map.width} × ${map.height}, ${map.resolution} m`),
      rooms.length ? pair("Rooms, names for rules", rooms.join(", ")) : null,
    ),
    el("p", { class: "id" }, map.id),
  );
}
