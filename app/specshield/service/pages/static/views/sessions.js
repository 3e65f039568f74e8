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
  const asked = el("input", {
    type: "search",
    placeholder: "Find robots",
    "aria-label": "Find robots by name, floor, rule or state",
    oninput: () => say(`${paint(list, sessions, names, asked)} of ${sessions.length} robots`),
  });
  let [sessions, before] = [[], ""];
  const look = async (signal) => {
    const [count, found] = [sessions.length, (await all("v1/sessions", { signal })).reverse()];
    const unknown = found.filter(({ map_id }) => !names.has(map_id));
    const maps = unknown.length ? await all("v1/maps", { signal }) : [];
    for (const { map_id: id } of unknown) names.set(id, called(maps.find((map) => map.id === id) ?? { id })); // it may be deleted
    const now = JSON.stringify(found.map(({ expires_at: _, ...rest }) => rest));
    sessions = found;
    if (now !== before) paint(list, sessions, names, asked);
    if (before && sessions.length > count) say(`${sessions.length} robots`);
    before = now;
  };
  await look(signal);
  place.append(el("div", { class: "row spread" }, el("h1", {}, "Robots"), asked), list);
  again(look, EVERY, place, signal);
}

/** Shows the robots that have each of the words that are `asked` for, and returns how many these are. */
function paint(list, sessions, names, asked) {
  asked.hidden = !sessions.length;
  const words = asked.value.toLowerCase().split(/\s+/);
  const found = sessions.filter((session) => {
    const told = [session.id, names.get(session.map_id), session.spec.formula, session.spec_status, state(session)];
    const text = told.join(" ").toLowerCase();
    return words.every((word) => text.includes(word));
  });
  const floors = [...Map.groupBy(found, (session) => session.map_id)];
  if (!sessions.length) list.replaceChildren(nobody());
  else if (!found.length) list.replaceChildren(el("p", {}, `None of ${sessions.length} robots has these words in its name, floor, rule or state.`));
  else keep(list, floors, { key: ([id]) => id, make: ([id]) => floor(names.get(id)), fill: fillFloor });
  return found.length;
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
  write(together, ids.length === 1 ? "Show it on one floor" : `Show ${ids.length} on one floor`);
  keep(section.querySelector("tbody"), sessions, { key: (session) => session.id, make: row, fill: fillRow });
}

function table() {
  const heads = ["Robot", "Rule", "Step", "The rule is", "The robot is"].map((name) => el("th", { scope: "col" }, name));
  return el("table", { class: "list robots" }, el("thead", {}, el("tr", {}, heads)), el("tbody"));
}

function row({ id }) {
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("a", { href: `#/sessions/${id}`, title: id }, short(id))),
    el("td", {}, el("code")),
    el("td", { class: "number", "data-head": "Step" }),
    el("td", { "data-head": "The rule is" }, el("span")),
    el("td", { "data-head": "The robot is" }),
  );
}

function fillRow(row, session) {
  const [, rule, steps, status, robot] = row.children;
  write(rule.firstChild, session.spec.formula);
  write(steps, step(session));
  status.firstChild.className = `badge ${session.spec_status}`;
  write(status.firstChild, session.spec_status);
  write(robot, state(session));
}

const state = ({ finished, main_task_done: done }) => (finished ? "over" : done ? "completing the rule" : "under way");

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
