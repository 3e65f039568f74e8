// Several robots on one floor: #/floor?sessions=a,b,c

import { ask } from "../lib/api.js";
import { called, el, onceAFrame, percent, problem, short } from "../lib/dom.js";
import { bare, Floor } from "../lib/floor.js";
import { EVERY, Learned } from "../lib/learned.js";
import { follow } from "../lib/live.js";
import { Mark } from "../lib/mark.js";
import { passes } from "../lib/patience.js";
import { Replay } from "./replay.js";
import { State } from "./state.js";

const JUDGED = 8; // rules of which is asked what they avoid
const HEADS = ["Step", "Mode", "Feasible", "Rule"]; // of the columns beside the robots
const AT_ONCE = 3; // trajectories that are read at once: a browser has six connections to a server

export async function show(place, { query, signal }) {
  const ids = (query.get("sessions") ?? "").split(",").filter(Boolean);
  const found = await Promise.allSettled(ids.map((id) => ask(`v1/sessions/${encodeURIComponent(id)}`, { signal })));
  const away = found.find(({ reason }) => reason && (signal.aborted || passes(reason)));
  if (away) throw away.reason;
  const sessions = found.filter(({ value }) => value).map(({ value }) => value);
  const gone = ids.flatMap((id, i) => (found[i].value ? [] : [missing(id, found[i].reason)]));
  if (!sessions.length) {
    const none = ids.length ? "None of the robots in the address can be shown." : "The address names no robot.";
    place.append(el("h1", {}, "No such robots"), el("p", {}, none), unseen(gone));
    return;
  }
  const [{ map_id }] = sessions;
  const map = await ask(`v1/maps/${map_id}`, { signal });
  const robots = sessions.filter((session) => session.map_id === map_id);
  const elsewhere = sessions.filter((session) => session.map_id !== map_id).map(({ id }) => `${id} is on another floor.`);
  const floor = new Floor(map, `Floor with ${robots.length} robots`);
  floor.regions(...(await places(robots, signal)));
  const state = new State();
  const draw = onceAFrame(() => all.forEach((each) => shown(each, replay.t)));
  const all = robots.map((session, i) => {
    const mark = new Mark(floor, session, i);
    const learned = new Learned(floor, session, mark, draw, short(session.id), EVERY * robots.length);
    return { session, items: [], mark, learned, row: row(session, i) };
  });
  const hear = ({ learned, items }) => {
    const item = items.findLast((each) => each?.decision);
    if (item && floor.occupancy) learned.heard(item, signal);
  };
  const replay = new Replay(draw);
  const heads = ["Robot", ...HEADS].map((name) => el("th", { scope: "col" }, name));
  const list = el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), el("tbody", {}, all.map((each) => each.row)));
  draw();
  place.append(
    el(
      "div",
      { class: "row spread" },
      el("h1", {}, `${robots.length === 1 ? "One robot" : `${robots.length} robots`} on ${called(map)}`),
      state.element,
    ),
    unseen([...gone, ...elsewhere]),
    el(
      "div",
      { class: "watch" },
      el("div", { class: "stack" }, floor.frame, ...all.map(({ learned }) => learned.key), replay.element),
      el("section", { class: "card scroll", "aria-label": "Robots" }, list),
    ),
  );
  const waiting = [...all]; // each is shown as soon as its way is read, a few at a time
  const read = async () => {
    for (let each; (each = waiting.shift()); ) {
      await load(each, signal);
      hear(each);
      replay.extend(each.items.length - 1);
      draw();
    }
  };
  const loaded = floor.load(signal).then(() => {
    all.forEach(hear);
    draw();
  });
  await Promise.all([loaded, ...Array.from({ length: AT_ONCE }, read)]);
  const by = new Map(all.map((each) => [each.session.id, each]));
  const after = new Map(all.filter((each) => !each.session.finished).map((each) => [each.session.id, each.items.length - 1]));
  const created = new Map(all.map(({ session }) => [session.id, session.created_at]));
  const take = (item) => {
    const each = by.get(item.session);
    if (item.rule >= each.session.rules.length) return dispatchEvent(new Event("hashchange")); // another rule, or floor
    state.heard();
    if (item.finished) Object.assign(each.session, { finished: true, spec_status: item.spec_status ?? each.session.spec_status, erased: item.erased });
    else {
      each.items[item.t] = item;
      hear(each);
      replay.extend(item.t);
    }
    draw();
  };
  follow(after, created, take, (connected) => state.live(connected), signal).then(
    () => signal.aborted || state.over("over"),
    (error) => {
      state.over("no longer followed");
      place.append(problem(error));
    },
  );
}

/** Why a session is not shown, in one sentence. */
const missing = (id, reason) => (reason.status === 404 ? `${id} is gone.` : `${id}: ${reason.message}.`);

/** The robots that were asked for and are not on the picture. */
function unseen(sentences) {
  const lines = sentences.map((text) => el("li", {}, text));
  return lines.length ? el("div", { class: "unshown" }, "Not shown:", el("ul", { class: "warnings" }, lines)) : "";
}

async function load(each, signal) {
  const told = await ask(`v1/sessions/${encodeURIComponent(each.session.id)}/trajectory`, { signal });
  each.items = told.items;
}

/** The regions of all rules by name, and the names of those to avoid. A name that another robot's rule has for
 *  another place already goes with its own robot's. */
async function places(robots, signal) {
  const rules = [...Map.groupBy(robots, ({ spec }) => JSON.stringify(spec)).values()].map(([first]) => first);
  const asked = rules.slice(0, JUDGED).map(({ spec, map_id }) => ask("v1/specs/validate", { json: { ...spec, map_id }, signal }));
  const told = await Promise.allSettled(asked);
  const [regions, names, avoided] = [Object.create(null), new Map(), []];
  rules.forEach(({ id, spec }, i) => {
    const bad = (told[i]?.value?.avoided ?? []).map(bare);
    for (const [name, region] of Object.entries(spec.regions)) {
      const place = JSON.stringify([name, region]);
      if (!names.has(place)) names.set(place, name in regions ? `${name} (${short(id)})` : name);
      regions[names.get(place)] = region;
      if (bad.includes(name)) avoided.push(names.get(place));
    }
  });
  return [regions, avoided];
}

function row(session, i) {
  const name = el("a", { href: `#/sessions/${session.id}`, title: session.id }, short(session.id));
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("i", { class: `dot color-${i % 8}` }), name),
    ...HEADS.map((name) => el("td", { class: "number", "data-head": name })),
  );
}

function shown({ session, items, mark, learned, row }, t) {
  const known = items.slice(0, t + 1).filter(Boolean);
  const item = known.at(-1);
  row.children[1].textContent = item ? item.t : "is read …";
  if (!item) return;
  learned.show(known.findLast((each) => each.decision));
  mark.show(known);
  const { decision } = item;
  const mass = decision?.feasible_mass;
  const without = items.some((each) => each?.decision) ? "over" : items.length > 1 ? "not shielded" : "–";
  const newest = t >= items.length - 1;
  const status = newest ? (decision?.spec_status === "pending" ? session.spec_status : decision?.spec_status ?? session.spec_status) : (decision?.spec_status ?? "pending");
  const mode = decision && !(newest && session.finished) ? decision.mode : without;
  const cells = [item.t, mode, mass === null || mass === undefined ? "–" : percent(mass)];
  cells.forEach((text, k) => (row.children[k + 1].textContent = text));
  const told = session.erased ? "erased" : status;
  row.children[4].replaceChildren(el("span", { class: `badge ${told}` }, told));
}
