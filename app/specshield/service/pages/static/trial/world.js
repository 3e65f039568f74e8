// The world of a simulated robot: it does what the server foresaw, unless something stands in the way.

import { centre, wrap } from "../lib/motion.js";

const SEES = 2.5; // [m] how far the robot's sensors reach
export const SIZE = 0.25; // [m] radius of an obstacle
const PUSH = 0.35; // [m]
const MOST_POINTS = 2000; // that a step takes of what is occupied

export class World {
  constructor(robot, occupancy, pose) {
    Object.assign(this, { robot, occupancy, pose, obstacles: [] });
  }

  touches(pose) {
    const at = centre(this.robot, pose);
    return this.obstacles.some(({ place: [x, y] }) => Math.hypot(at[0] - x, at[1] - y) < SIZE + this.robot.footprint.radius);
  }

  free(pose) {
    return this.occupancy.fits(centre(this.robot, pose), this.robot.footprint.radius + 0.02) && !this.touches(pose);
  }

  /** Moves towards `next`, as far as no obstacle stands there. */
  execute(next) {
    const from = this.pose;
    if (this.touches(from)) return void (this.pose = next);
    for (let i = 1; i <= 10; i++) {
      const part = i / 10;
      const turn = from[2] + wrap(next[2] - from[2]) * part;
      const at = [from[0] + (next[0] - from[0]) * part, from[1] + (next[1] - from[1]) * part, wrap(turn)];
      if (this.touches(at)) return;
      this.pose = i === 10 ? next : at;
    }
  }

  /** Moves the robot aside, to where it fits. Whether there was such a place. */
  push() {
    const [x, y, theta] = this.pose;
    const angles = Array.from({ length: 12 }, (_, i) => theta + Math.PI / 2 + (i * Math.PI) / 6);
    for (const far of [PUSH, PUSH / 2]) {
      for (const angle of angles) {
        const to = [x + far * Math.cos(angle), y + far * Math.sin(angle), wrap(theta + 0.3)];
        if (this.free(to)) return this.put(to);
      }
    }
    return false;
  }

  put(pose) {
    if (!this.free(pose)) return false;
    this.pose = pose;
    return true;
  }

  /** Whether there is room for an obstacle here. */
  drop(place) {
    const at = centre(this.robot, this.pose);
    const room = Math.hypot(at[0] - place[0], at[1] - place[1]) >= SIZE + this.robot.footprint.radius + 0.02;
    if (room) this.obstacles.push({ place, told: false });
    return room;
  }

  /** Where an obstacle stands in the robot's way: `far` metres before its edge. */
  ahead(far) {
    const [x, y] = centre(this.robot, this.pose);
    const reach = this.robot.footprint.radius + SIZE + far;
    return [x + reach * Math.cos(this.pose[2]), y + reach * Math.sin(this.pose[2])];
  }

  /** The obstacles that the robot sees now and that the service was not told of, no more than one step takes. */
  seen() {
    let room = MOST_POINTS;
    return this.obstacles.filter((obstacle) => {
      const [x, y] = obstacle.place;
      if (obstacle.told || Math.hypot(x - this.pose[0], y - this.pose[1]) > SEES) return false;
      room -= this.points(obstacle).length;
      return room >= 0;
    });
  }

  /** Points all over an obstacle, as a step takes them. */
  points({ place: [x, y] }) {
    const pitch = Math.max(this.occupancy.map.resolution, SIZE / 12);
    const points = [];
    for (let dx = -SIZE; dx <= SIZE; dx += pitch)
      for (let dy = -SIZE; dy <= SIZE; dy += pitch) if (Math.hypot(dx, dy) <= SIZE) points.push([x + dx, y + dy]);
    return points;
  }
}
