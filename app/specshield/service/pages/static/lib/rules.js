// The rules of a session: after a switch, each step has the one that it was decided under.

import { amount, metres } from "./dom.js";

/** The rule of an item of a trajectory. An item that tells none is of the present one. */
export const ruleOf = (session, item) => session.rules[item.rule] ?? session.rules.at(-1);

/** Whether an item was decided for the robot that the session has now, as far as the names of its actions tell. */
export const sameRobot = (session, item) => String(ruleOf(session, item).actions) === String(session.actions);

export const sameFloor = (session, item) => ruleOf(session, item).map_id === session.map_id;

/** How a rule's robustness is written: in metres, unless it may be that of a signal, whose unit nobody told. */
export const measure = ({ signals }) => (Object.keys(signals ?? {}).length ? (value) => amount(value) : metres);

/** How far step t is in a rule, whose own steps count from its origin, as those in explanations do. */
export function within(t, { origin, horizon }) {
  if (t - origin > horizon) return `, the rule ended at ${origin + horizon}`;
  return origin ? `, step ${t - origin} of ${horizon} of its rule` : ` of ${horizon}`;
}
