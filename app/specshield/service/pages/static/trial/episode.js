// One episode of a simulated robot, step by step through the API, as any robot's program does it.

import { ask } from "../lib/api.js";

export class Episode {
  /** session: as the API shows it. model: logits for a pose. taken: called with each item {t, pose, ...}. */
  constructor(session, world, model, taken) {
    Object.assign(this, { session, world, model, taken, t: 0, ended: false, over: false });
  }

  async step() {
    if (this.over) return;
    const { session, world, t } = this;
    const pose = world.pose;
    const logits = this.ended ? null : this.model(pose);
    const occupied = world.seen();
    const body = { t, poses: [pose], logits, main_task_done: this.ended, explain: true, ...(occupied && { occupied }) };
    const path = `v1/sessions/${encodeURIComponent(session.id)}`;
    const decision = await ask(`${path}/steps`, { json: body });
    this.taken({ t, pose, logits, decision });
    const ends = session.terminal_actions.includes(decision.action);
    if (ends) this.ended = true;
    const action = ends ? decision.completion_action : decision.action;
    if (action !== null) world.execute(decision.next_poses[action]);
    this.t += 1;
    const settled = decision.spec_status === "satisfied" || t >= session.horizon || decision.finished;
    if (settled || (ends && action === null)) await this.close(path);
  }

  async close(path) {
    this.over = true;
    const told = await ask(`${path}/close`, { json: {} });
    this.taken({ finished: true, spec_status: told.spec_status });
  }
}
