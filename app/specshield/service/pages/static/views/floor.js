// Several robots on one floor: #/floor?sessions=a,b,c

import { ask } from "../lib/api.js";
import { called, el, onceAFrame, short } from "../lib/dom.js";
import { Floor } from "../lib/floor.js";
import { follow } from "../lib/live.js";
import { Mark } from "../lib/mark.js";
import { Replay } from "./replay.js";

const AT_ONCE = 3; // trajectories that are read at once: a browser has six connections to a server

export async function show(place, { query, signal }) {
  const ids = (query.get("sessions") ?? "").split(",").filter(Boolean);
  const found = await Promise.allSettled(ids.map((id) => ask(`v1/sessions/${encodeURIComponent(id)}`, { signal })));
  const sessions = found.filter(({ value }) => value).map(({ value }) => value);
  if (!sessions.length) {
    place.append(el("h1", {}, "No such robots"), el("p", {}, "These sessions are gone: ", ids.join(", ")));
    return;
  }
  const [{ map_id }] = sessions;
  const map = await ask(`v1/maps/${map_id}`, { signal });
  const robots = sessions.filter((session) => session.map_id === map_id);
  const floor = new Floor(map, `Floor with ${robots.length} robots`);
  floor.regions(Object.assign({}, ...robots.map((session) => session.spec.regions)), await avoided(robots, signal));
  const all = robots.map((session, i) => {
    return { session, items: [], mark: new Mark(floor, session.robot, session.id, i), row: row(session, i) };
  });
  const draw = onceAFrame(() => all.forEach((each) => shown(each, replay.t)));
  const replay = new Replay(draw);
  const heads = ["Robot", "Step", "Mode", "Feasible", "Rule"].map((name) => el("th", { scope: "col" }, name));
  const list = el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), el("tbody", {}, all.map((each) => each.row)));
  draw();
  place.append(
    el("h1", {}, `${robots.length === 1 ? "One robot" : `${robots.length} robots`} on ${called(map)}`),
    el(
      "div",
      { class: "watch" },
      el("div", { class: "stack" }, floor.frame, replay.element),
      el("section", { class: "card scroll", "aria-label": "Robots" }, list),
    ),
  );
  const waiting = [...all]; // each is shown as soon as its way is read, a few at a time
  const read = async () => {
    for (let each; (each = waiting.shift()); ) {
      await load(each, signal);
      replay.extend(each.items.length - 1);
      draw();
    }
  };
  await Promise.all([floor.load(signal).then(draw), ...Array.from({ length: AT_ONCE }, read)]);
  const by = new Map(all.map((each) => [each.session.id, each]));
  const after = new Map(all.filter((each) => !each.session.finished).map((each) => [each.session.id, each.items.length - 1]));
  follow(after, (item) => {
    const each = by.get(item.session);
    if (item.finished) each.session.spec_status = item.spec_status;
    else {
      each.items[item.t] = item;
      replay.extend(item.t);
    }
    draw();
  }, signal).catch((error) => place.append(el("p", { class: "problem", role: "alert" }, error.message)));
}

async function load(each, signal) {
  const told = await ask(`v1/sessions/${encodeURIComponent(each.session.id)}/trajectory`, { signal });
  each.items = told.items;
}

async function avoided(robots, signal) {
  const rules = new Map(robots.map(({ spec, map_id }) => [spec.formula, { ...spec, map_id }]));
  const told = [...rules.values()].slice(0, 8).map((body) => ask("v1/specs/validate", { json: body, signal }));
  return (await Promise.allSettled(told)).flatMap(({ value }) => value?.avoided ?? []);
}

function row(session, i) {
  const name = el("a", { href: `#/sessions/${session.id}`, title: session.id }, short(session.id));
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("i", { class: `dot color-${i % 8}` }), name),
    ...["", "", "", ""].map(() => el("td", { class: "number" })),
  );
}

function shown({ session, items, mark, row }, t) {
  const known = items.slice(0, t + 1).filter(Boolean);
  const item = known.at(-1);
  row.children[1].textContent = item ? item.t : "is read …";
  if (!item) return;
  mark.show(known);
  const { decision } = item;
  const mass = decision?.feasible_mass;
  const without = items.some((each) => each?.decision) ? "over" : "not shielded";
  const status = t >= items.length - 1 ? (decision?.spec_status === "pending" ? session.spec_status : decision?.spec_status ?? session.spec_status) : (decision?.spec_status ?? "pending");
  const cells = [item.t, decision?.mode ?? without, mass === null || mass === undefined ? "–" : `${(100 * mass).toFixed(0)} %`];
  cells.forEach((text, k) => (row.children[k + 1].textContent = text));
  row.children[4].replaceChildren(el("span", { class: `badge ${status}` }, status));
}
