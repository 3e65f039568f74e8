// One episode of a simulated robot, driven step by step by the API, as a robot's program does it.

import { ask } from "../lib/api.js";
import { passes } from "../lib/patience.js";

const path = (session) => `v1/sessions/${encodeURIComponent(session.id)}`;

export class Episode {
  /** session: as the API shows it. model: logits for a pose. taken: called with each item {t, pose, ...}. */
  constructor(session, world, model, taken) {
    Object.assign(this, { session, world, model, taken, t: 0, ended: false, settled: false, over: false });
  }

  async step() {
    if (this.over) return;
    if (!this.settled) await this.decide();
    if (this.settled) await this.close();
  }

  /** Decides a step. A step without an answer may have been decided, so it is sent again without changes. */
  async decide() {
    const { session, world, t } = this;
    this.sent ??= this.next();
    const { body, pose, seen } = this.sent;
    let decision;
    try {
      decision = await ask(`${path(session)}/steps`, { json: body });
    } catch (error) {
      if (!passes(error)) this.sent = null; // it was refused, and nothing was decided
      throw error;
    }
    this.sent = null;
    for (const obstacle of seen) obstacle.told = true;
    this.taken({ t, pose, logits: body.logits, decision });
    const ends = session.terminal_actions.includes(decision.action);
    if (ends) this.ended = true;
    const action = ends ? decision.completion_action : decision.action;
    const pushed = world.pose !== pose; // meanwhile, so that the action would begin at another pose
    if (action !== null && !pushed) world.execute(decision.next_poses[action]);
    this.t += 1;
    this.settled = decision.spec_status === "satisfied" || t >= session.horizon || decision.finished || (ends && action === null);
  }

  /** The request for step t: what the robot sees and what its model wants now. */
  next() {
    const { pose } = this.world;
    const seen = this.world.seen();
    const occupied = seen.flatMap((obstacle) => this.world.points(obstacle));
    const logits = this.ended ? null : this.model(pose);
    const body = { t: this.t, poses: [pose], logits, main_task_done: this.ended, explain: true, ...(seen.length && { occupied }) };
    return { body, pose, seen };
  }

  async close() {
    const told = await ask(`${path(this.session)}/close`, { json: {} });
    this.over = true;
    this.taken({ finished: true, spec_status: told.spec_status });
  }
}

/** Ends a session that nobody drives any more, where the server can be reached; also while the page is left. */
export function abandon(session) {
  ask(`${path(session)}/close`, { json: {}, keepalive: true }).catch(() => {});
}
