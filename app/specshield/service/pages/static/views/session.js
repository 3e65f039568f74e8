// One session, live and from its beginning.

import { ask } from "../lib/api.js";
import { el, pair, problem, say } from "../lib/dom.js";
import { follow } from "../lib/live.js";
import { State } from "./state.js";
import { Watch } from "./watch.js";

export async function show(place, { id, signal }) {
  const path = `v1/sessions/${encodeURIComponent(id)}`;
  const session = await ask(path, { signal });
  const map = await ask(`v1/maps/${session.map_id}`, { signal });
  const watch = new Watch(session, map);
  const state = new State();
  place.append(el("div", { class: "row spread" }, el("h1", {}, session.id), state.element), watch.element);
  watch.side.append(about(session));
  await watch.load(signal);
  state.say("the steps are read …");
  const { items } = await ask(`${path}/trajectory`, { signal });
  for (const item of items) watch.push(item);
  const decided = items.findLast((item) => item.decision)?.t;
  if (session.finished && decided !== undefined) watch.replay.go(decided); // what follows was not decided
  watch.show();
  if (session.finished) state.over(`over, the rule is ${session.spec_status}`);
  else listen(place, watch, state, items, signal);
}

async function listen(place, watch, state, items, signal) {
  const { id, created_at } = watch.session;
  const last = items.findLast((item) => item.decision)?.t ?? -1;
  const take = (item) => {
    const another = item.anew || item.rule >= watch.session.rules.length; // session of this id, or rule
    if (another) return dispatchEvent(new Event("hashchange"));
    state.heard();
    if (!item.finished) return watch.push(item);
    state.over(item.erased ? "erased: the server no longer has this session" : `over, the rule is ${item.spec_status}`);
    say(item.erased ? "The session was erased." : `The session is over: the rule is ${item.spec_status}.`);
  };
  try {
    await follow(new Map([[id, last]]), new Map([[id, created_at]]), take, (connected) => state.live(connected), signal);
  } catch (error) {
    state.over("no longer followed");
    place.append(problem(error));
  }
}

function about(session) {
  const policies = session.policy_ids.map((id) => el("a", { href: `#/policies/${id}` }, id.slice(0, 8)));
  return el(
    "section",
    { class: "card", "aria-label": "About this session" },
    el("h2", {}, "Rule"),
    el("p", {}, el("code", {}, session.spec.formula)),
    el(
      "dl",
      { class: "numbers" },
      pair("Policy", ...policies),
      pair("Robot", session.robot.name),
      pair("Threshold", String(session.threshold)),
      pair("Stored until", new Date(session.expires_at).toLocaleString()),
    ),
    el("p", {}, el("a", { href: "#/floor?sessions=" + session.id }, "Show it with others on one floor")),
  );
}
