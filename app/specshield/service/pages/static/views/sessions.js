// All robots: the sessions that are under way or over, by the floor that they are on.

import { all } from "../lib/api.js";
import { called, el, say, short } from "../lib/dom.js";

const EVERY = 2000; // [ms] between two looks at the list
const MOST = 64; // robots on one picture

export async function show(place, { signal }) {
  const maps = new Map((await all("v1/maps", { signal })).map((map) => [map.id, map]));
  const list = el("div", { class: "stack" });
  place.append(el("h1", {}, "Robots"), list);
  let before = "";
  while (!signal.aborted) {
    if (!document.hidden) {
      const sessions = (await all("v1/sessions", { signal })).reverse();
      const now = JSON.stringify(sessions.map(({ expires_at: _, ...rest }) => rest));
      if (now !== before) list.replaceChildren(...(sessions.length ? floors(sessions, maps) : [nobody()]));
      if (before && now.length > before.length) say(`${sessions.length} robots`);
      before = now;
    }
    await new Promise((done) => setTimeout(done, EVERY));
  }
}

function floors(sessions, maps) {
  const groups = Map.groupBy(sessions, (session) => session.map_id);
  return [...groups].map(([id, group]) => {
    const name = maps.has(id) ? called(maps.get(id)) : short(id);
    const ids = group.slice(0, MOST).map((session) => session.id);
    const together = el("a", { href: `#/floor?sessions=${ids.join(",")}` }, `Show ${ids.length} on one floor`);
    return el(
      "section",
      { class: "card", "aria-label": `Floor ${name}` },
      el("div", { class: "row spread" }, el("h2", {}, name), together),
      el("div", { class: "scroll" }, table(group)),
    );
  });
}

function table(sessions) {
  const heads = ["Robot", "Rule", "Step", "The rule is", "The robot is"].map((name) => el("th", { scope: "col" }, name));
  const rows = sessions.map((session) =>
    el(
      "tr",
      {},
      el("th", { scope: "row" }, el("a", { href: `#/sessions/${session.id}`, title: session.id }, short(session.id))),
      el("td", {}, el("code", {}, session.spec.formula)),
      el("td", { class: "number" }, step(session)),
      el("td", {}, el("span", { class: `badge ${session.spec_status}` }, session.spec_status)),
      el("td", {}, session.finished ? "over" : session.main_task_done ? "completing the rule" : "under way"),
    ),
  );
  return el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), el("tbody", {}, rows));
}

/** How far a robot is in its rule; a session that was only told where its robot was has no step. */
function step({ next_t: t, horizon, finished }) {
  if (t > horizon) return `${t}, the rule had ${horizon}`;
  return finished && t === 0 ? "none decided" : `${t} of ${horizon}`;
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
