// A robot on a floor: its body, the way it has driven, and the certified continuation.

import { svg } from "./dom.js";
import { centre, continuation } from "./motion.js";

const COLORS = 8;

export class Mark {
  /** robot: as the API shows it. index: which of the colours it has. */
  constructor(floor, robot, name, index = 0) {
    this.floor = floor;
    this.robot = robot;
    const color = `color-${index % COLORS}`;
    this.way = svg("polyline", { class: `way ${color}` });
    this.next = svg("polyline", { class: `next ${color}` });
    this.disc = svg("circle", { r: robot.footprint.radius });
    this.nose = svg("line");
    this.body = svg("g", { class: `robot ${color}`, hidden: true }, svg("title", {}, name), this.disc, this.nose);
    floor.layers.ways.append(this.next, this.way);
    floor.layers.robots.append(this.body);
    this.fits = (point, radius) => !floor.occupancy || floor.occupancy.fits(point, radius);
  }

  /** items: of the trajectory up to the one that is shown. ahead: whether to draw the continuation. */
  show(items, ahead = true) {
    const last = items.at(-1);
    if (!last) return;
    this.way.setAttribute("points", this.floor.line(items.map((item) => item.pose)));
    this.next.setAttribute("points", ahead ? this.floor.line(continuation(this.robot, last, this.fits)) : "");
    this.move(last.pose);
  }

  move(pose) {
    this.body.removeAttribute("hidden"); // now it is known where the robot is
    const [x, y] = this.floor.at(centre(this.robot, pose));
    const far = this.robot.footprint.radius * 1.25;
    this.disc.setAttribute("cx", x);
    this.disc.setAttribute("cy", y);
    const ends = { x1: x, y1: y, x2: x + far * Math.cos(pose[2]), y2: y - far * Math.sin(pose[2]) };
    for (const [name, value] of Object.entries(ends)) this.nose.setAttribute(name, value);
  }
}
