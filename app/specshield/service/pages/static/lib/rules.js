// The rules of a session: each step has the rule under which it was decided.

import { amount, metres } from "./dom.js";

/** The rule of an item of a trajectory, by default the present one. */
export const ruleOf = (session, item) => session.rules[item.rule] ?? session.rules.at(-1);

/** Whether an item was decided for the robot that the session has now, as far as the names of its actions tell. */
export const sameRobot = (session, item) => String(ruleOf(session, item).actions) === String(session.actions);

export const sameFloor = (session, item) => ruleOf(session, item).map_id === session.map_id;

/** A function that writes a rule's robustness: in metres, unless the rule has signals, whose units are unknown. */
export const measure = ({ signals }) => (Object.keys(signals ?? {}).length ? (value) => amount(value) : metres);

/** A text that says how far step t is in a rule. The rule's steps count from its origin, as in explanations. */
export function within(t, { origin, horizon }) {
  if (t - origin > horizon) return `, the rule ended at ${origin + horizon}`;
  return origin ? `, step ${t - origin} of ${horizon} of its rule` : ` of ${horizon}`;
}
