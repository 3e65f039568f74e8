// The robot's motions, only for drawing: decisions rest on the server's simulation.

const STRIDE = 0.05; // [m] between two looks at the walls

export const wrap = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/** Where the centre of the footprint is. */
export function centre(robot, [x, y, theta]) {
  const [ahead, left] = robot.footprint.offset;
  const [c, s] = [Math.cos(theta), Math.sin(theta)];
  return [x + c * ahead - s * left, y + s * ahead + c * left];
}

/** The pose after an action; a move to where the robot does not fit is stopped there, or not made at all. */
export function after(robot, pose, action, fits) {
  const { translate, rotate } = robot.actions[action];
  const [x, y, theta] = pose;
  const [c, s] = [Math.cos(theta), Math.sin(theta)];
  const pieces = Math.max(1, Math.ceil(Math.abs(translate) / STRIDE));
  let far = translate;
  for (let i = 1; i <= pieces && translate; i++) {
    const d = (translate * i) / pieces;
    if (!fits(centre(robot, [x + d * c, y + d * s, theta]), robot.footprint.radius)) {
      far = robot.on_contact === "stop" ? (translate * (i - 1)) / pieces : 0;
      break;
    }
  }
  return [x + far * c, y + far * s, wrap(theta + rotate)];
}

/** The poses of a decision's certified continuation, from x_t on. */
export function continuation(robot, item, fits) {
  const { pose, decision } = item;
  if (!decision?.witness) return [];
  const first = robot.actions[decision.action].terminal ? decision.completion_action : decision.action;
  const poses = [pose, decision.next_poses[first]];
  for (const action of decision.witness) {
    if (robot.actions[action].terminal) continue;
    poses.push(after(robot, poses.at(-1), action, fits));
  }
  return poses;
}
