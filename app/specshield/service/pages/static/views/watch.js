// One robot: its floor, the decision at the step that is shown, and charts of the steps so far.

import { ask } from "../lib/api.js";
import { Chart } from "../lib/chart.js";
import { el, onceAFrame, percent } from "../lib/dom.js";
import { Floor } from "../lib/floor.js";
import { Learned } from "../lib/learned.js";
import { Mark } from "../lib/mark.js";
import { patiently } from "../lib/patience.js";
import { measure, ruleOf, sameFloor } from "../lib/rules.js";
import { Panel } from "./panel.js";
import { Replay } from "./replay.js";

export class Watch {
  /** session, map: as the API shows them. */
  constructor(session, map) {
    this.session = session;
    this.items = [];
    this.floor = new Floor(map, `Floor with robot ${session.id}`);
    this.mark = new Mark(this.floor, session);
    this.panel = new Panel(session);
    this.charts = [
      [new Chart("Robustness ahead", measure(session.spec)), (d) => d.robustness[taken(d)]],
      [new Chart("Feasible mass", percent), (d) => d.feasible_mass],
      [new Chart("Slack kept", (steps) => `${steps} ${steps === 1 ? "step" : "steps"}`), (d) => d.slack, true],
    ];
    this.draw = onceAFrame(() => this.show());
    this.replay = new Replay(this.draw);
    this.learned = new Learned(this.floor, session, this.mark, this.draw);
    this.places = new Map(); // of each rule that was shown, its regions and which of them it avoids, once they are told
    const left = el("div", { class: "stack" }, this.floor.frame, this.learned.key, this.replay.element);
    this.charted = el("section", { class: "card charts", "aria-label": "Over time" });
    this.charted.append(...this.charts.map(([chart]) => chart.element));
    this.side = el("div", { class: "stack side" }, this.panel.element);
    this.element = el("div", { class: "watch" }, left, this.side, this.charted);
  }

  async load(signal) {
    this.signal = signal;
    this.of = this.session.rules.at(-1); // the rule whose regions are drawn
    this.places.set(this.of, this.judged(this.session.spec));
    this.floor.regions(...(await this.places.get(this.of)));
    await this.floor.load(signal);
  }

  /** The regions of a rule, and those that it avoids. */
  async judged({ formula, regions, signals }) {
    const body = { formula, regions, signals, map_id: this.session.map_id };
    const told = await ask("v1/specs/validate", { json: body, signal: this.signal }).catch(() => ({ avoided: [] }));
    return [regions ?? {}, told.avoided];
  }

  /** The same of an earlier rule, which its policy knows; no regions where that was deleted. */
  async earlier({ policy_ids: [id] }) {
    const path = `v1/policies/${encodeURIComponent(id)}`;
    const found = patiently(() => ask(path, { signal: this.signal }), this.signal);
    return found.then(({ spec }) => this.judged(spec), () => [{}, []]);
  }

  /** Draws the regions of the rule that an item was decided under; of the present one where that is on another floor. */
  async under(item) {
    const rule = sameFloor(this.session, item) ? ruleOf(this.session, item) : this.session.rules.at(-1);
    if (rule === this.of) return;
    this.of = rule;
    if (!this.places.has(rule)) this.places.set(rule, this.earlier(rule));
    const places = await this.places.get(rule);
    if (rule === this.of && !this.signal.aborted) this.floor.regions(...places);
  }

  /** item: {t, pose, logits, decision}, as in a trajectory. */
  push(item) {
    this.items[item.t] = item;
    this.replay.extend(item.t);
    if (item.decision) this.learned.heard(item, this.signal);
    this.draw();
  }

  show() {
    const t = this.replay.t;
    const known = this.items.slice(0, t + 1).filter(Boolean);
    const item = known.at(-1);
    if (!item) return;
    this.learned.show(known.findLast((each) => each.decision));
    this.mark.show(known);
    this.panel.show(item);
    this.under(item);
    const decided = this.items.filter((each) => each?.decision);
    const { origin, horizon } = this.session.rules.at(-1);
    const last = Math.max(origin + horizon, this.items.length - 1);
    for (const [chart, value, hidesZero] of this.charts) {
      const values = decided.map((each) => [each.t, value(each.decision)]);
      const known = values.filter(([, v]) => v !== null && v !== undefined && Math.abs(v) < 1e6);
      chart.show(hidesZero && known.every(([, v]) => v === 0) ? [] : known, last, item.t);
    }
    this.charted.hidden = this.charts.every(([chart]) => chart.element.hidden);
  }
}

/** The action that the robot executes: what was drawn, and in place of `end` what completes the rule. */
function taken(decision) {
  return decision.next_poses.length && decision.robustness[decision.action] !== null
    ? decision.action
    : (decision.completion_action ?? decision.action);
}
