// All robots: the sessions that are under way or over, by the floor that they are on.

import { all } from "../lib/api.js";
import { called, el, keep, say, short, write } from "../lib/dom.js";
import { again } from "../lib/patience.js";
import { within } from "../lib/rules.js";

const EVERY = 2000; // [ms] between two looks at the list
const MOST = 64; // robots on one picture

export async function show(place, { signal }) {
  const names = new Map(); // of the floors that were seen
  const list = el("div", { class: "stack" });
  let [before, count] = ["", Infinity];
  const look = async (signal) => {
    const sessions = (await all("v1/sessions", { signal })).reverse();
    const unknown = sessions.filter(({ map_id }) => !names.has(map_id));
    const maps = unknown.length ? await all("v1/maps", { signal }) : [];
    for (const { map_id: id } of unknown) names.set(id, called(maps.find((map) => map.id === id) ?? { id })); // it may be deleted
    const now = JSON.stringify(sessions.map(({ expires_at: _, ...rest }) => rest));
    if (now !== before) paint(list, sessions, names);
    if (sessions.length > count) say(`${sessions.length} robots`);
    [before, count] = [now, sessions.length];
  };
  await look(signal);
  place.append(el("h1", {}, "Robots"), list);
  again(look, EVERY, place, signal);
}

function paint(list, sessions, names) {
  if (!sessions.length) return list.replaceChildren(nobody());
  const floors = [...Map.groupBy(sessions, (session) => session.map_id)];
  keep(list, floors, { key: ([id]) => id, make: ([id]) => floor(names.get(id)), fill: fillFloor });
}

function floor(name) {
  return el(
    "section",
    { class: "card", "aria-label": `Floor ${name}` },
    el("div", { class: "row spread" }, el("h2", {}, name), el("a", { class: "together" })),
    el("div", { class: "scroll" }, table()),
  );
}

function fillFloor(section, [, sessions]) {
  const ids = sessions.slice(0, MOST).map((session) => session.id);
  const together = section.querySelector(".together");
  together.href = `#/floor?sessions=${ids.join(",")}`;
  write(together, `Show ${ids.length} on one floor`);
  keep(section.querySelector("tbody"), sessions, { key: (session) => session.id, make: row, fill: fillRow });
}

function table() {
  const heads = ["Robot", "Rule", "Step", "The rule is", "The robot is"].map((name) => el("th", { scope: "col" }, name));
  return el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), el("tbody"));
}

function row({ id }) {
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("a", { href: `#/sessions/${id}`, title: id }, short(id))),
    el("td", {}, el("code")),
    el("td", { class: "number" }),
    el("td", {}, el("span")),
    el("td"),
  );
}

function fillRow(row, session) {
  const [, rule, steps, status, robot] = row.children;
  write(rule.firstChild, session.spec.formula);
  write(steps, step(session));
  status.firstChild.className = `badge ${session.spec_status}`;
  write(status.firstChild, session.spec_status);
  write(robot, session.finished ? "over" : session.main_task_done ? "completing the rule" : "under way");
}

/** How far a robot is in its rule; a session that was only told where its robot was has no step. */
function step({ next_t: t, rules, finished }) {
  return finished && t === 0 ? "none decided" : `${t}${within(t, rules.at(-1))}`;
}

function nobody() {
  return el(
    "section",
    { class: "card" },
    el("h2", {}, "No robot is here yet"),
    el("p", {}, "A robot appears here as soon as its program begins a session. To see one without a robot:"),
    el(
      "ol",
      {},
      el("li", {}, el("a", { href: "#/maps" }, "take a map"), ", draw a region and write a rule,"),
      el("li", {}, "make a policy for it, or take ", el("a", { href: "#/policies/case2" }, "one that is there"), ","),
      el("li", {}, "try it with a simulated robot."),
    ),
  );
}
