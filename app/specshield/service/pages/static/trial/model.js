// Stand-ins for a foundation model: logits for each action, and no knowledge of the rule.

import { after } from "../lib/motion.js";

const NEAR = 0.6; // [m] from its goal the model ends its task
const AHEAD = 0.4; // [m] before the robot: where its heading leads
const SHARPNESS = 8; // logits for each metre nearer; chosen by hand, so that it errs now and then

/** Goes to a goal, round the walls that it knows. distance: of a point from the goal [m]. */
export function goalSeeker(robot, fits, distance) {
  return (pose) =>
    robot.actions.map((action, i) => {
      if (action.terminal) return distance(pose) < NEAR ? 3 : null;
      const [x, y, theta] = after(robot, pose, i, fits);
      const next = distance([x, y]);
      const ahead = distance([x + AHEAD * Math.cos(theta), y + AHEAD * Math.sin(theta)]);
      const far = Math.min(ahead, next + AHEAD) + 0.5 * next;
      const idle = action.translate === 0 && action.rotate === 0 ? 4 : 0;
      return Number.isFinite(far) ? -SHARPNESS * far - idle : -SHARPNESS * 100;
    });
}

/** Wanders: it likes some actions more than others, and others at each step. */
export function wanderer(robot) {
  return () => robot.actions.map((action) => (action.terminal ? null : 2 * Math.random() + (action.translate > 0 ? 1.5 : 0)));
}
