// A robot on a floor: its body, the way it has driven, and the certified continuation.

import { svg } from "./dom.js";
import { centre, continuation } from "./motion.js";
import { sameFloor, sameRobot } from "./rules.js";

const COLORS = 8;

export class Mark {
  /** session: as the API shows it. index: which of the colours its robot has. */
  constructor(floor, session, index = 0) {
    const { robot, id } = session;
    Object.assign(this, { floor, session, robot });
    const color = `color-${index % COLORS}`;
    this.way = svg("polyline", { class: `way ${color}` });
    this.next = svg("polyline", { class: `next ${color}` });
    this.disc = svg("circle", { r: robot.footprint.radius });
    this.nose = svg("line");
    this.body = svg("g", { class: `robot ${color}`, hidden: true }, svg("title", {}, id), this.disc, this.nose);
    floor.layers.ways.append(this.next, this.way);
    floor.layers.robots.append(this.body);
    this.occupancy = null; // the cells of the session's own map, if it differs from the map
    this.fits = (point, radius) => (this.occupancy ?? floor.occupancy)?.fits(point, radius) ?? true;
  }

  /** items: of the trajectory, up to the step that is shown. Steps on another floor, before a switch, are left out. */
  show(items) {
    const last = items.at(-1);
    if (!last) return;
    const here = items.slice(items.findLastIndex((item) => !sameFloor(this.session, item)) + 1);
    const ahead = here.at(-1) === last && sameRobot(this.session, last) ? continuation(this.robot, last, this.fits) : [];
    this.way.setAttribute("points", this.floor.line(here.map((item) => item.pose)));
    this.next.setAttribute("points", this.floor.line(ahead));
    if (here.at(-1) === last) this.move(last.pose);
    else this.body.setAttribute("hidden", "");
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
