// A floor plan: walls, regions, and what is drawn on it. Points are in metres of the map frame; y is up.

import { picture } from "./api.js";
import { el, svg } from "./dom.js";
import { Occupancy } from "./occupancy.js";
import { Zoom } from "./zoom.js";

/** The members of a region that are no unions. */
const members = (region) => (region.type === "union" ? region.members : [region]);

function corners(region) {
  if (region.type !== "rectangle") return region.vertices;
  const [[x0, y0], [x1, y1]] = [region.min, region.max];
  return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
}

/** Whether a point is in a polygon: a ray to the right crosses its outline an odd number of times. */
function inside(vertices, [x, y]) {
  const crossed = vertices.filter(([x1, y1], i) => {
    const [x0, y0] = vertices.at(i - 1);
    return y0 > y !== y1 > y && x < x0 + ((y - y0) * (x1 - x0)) / (y1 - y0);
  });
  return crossed.length % 2 === 1;
}

/** The lowest point of a region, at the middle of its width: where its name is written. */
function foot(region) {
  const first = members(region)[0];
  if (first.type === "circle") return [first.center[0], first.center[1] - first.radius];
  const [xs, ys] = [corners(first).map((p) => p[0]), corners(first).map((p) => p[1])];
  return [(Math.min(...xs) + Math.max(...xs)) / 2, Math.min(...ys)];
}

function middle(part) {
  if (part.type === "circle") return part.center;
  const points = corners(part);
  return [0, 1].map((k) => (Math.min(...points.map((p) => p[k])) + Math.max(...points.map((p) => p[k]))) / 2);
}

/** The region of a name that a rule avoids: `R` of `touches(R)`. */
export const bare = (name) => name.replace(/^\w+\((.*)\)$/, "$1");

export class Floor {
  /** map: as the API shows it. label: for people who do not see the picture. */
  constructor(map, label) {
    const [x0, y0, x1, y1] = map.bounds;
    this.map = map;
    // The picture counts from whole kilometres near the map: of a number in an SVG browsers keep some seven digits.
    this.from = [x0, y0].map((value) => 1000 * Math.round(value / 1000));
    this.rooms = Object.entries(map.rooms).filter(([, room]) => room.type !== "union");
    this.drawn = {}; // the regions, by name
    this.layers = Object.fromEntries(
      ["walls", "learned", "rooms", "regions", "ways", "robots", "marks"].map((name) => [name, svg("g", { class: name })]),
    );
    const keys = `${label}. Plus and minus zoom, arrows move what is seen.`;
    this.element = svg("svg", { class: "floor", role: "img", "aria-label": keys }, ...Object.values(this.layers));
    const [x, y] = this.at([x0, y1]);
    this.zoom = new Zoom(this.element, [x, y, x1 - x0, y1 - y0]);
    this.element.prepend(svg("rect", { class: "ground", x, y, width: x1 - x0, height: y1 - y0 })); // about it, no map
    this.frame = el("div", { class: "frame" }, this.element, this.zoom.buttons); // what a view puts in its place
    this.frame.style.setProperty("--ratio", String(this.zoom.ratio));
    this.layers.rooms.append(this.text([(x0 + x1) / 2, (y0 + y1) / 2], "The map is read …", "room"));
  }

  /** Draws the walls, and gives the cells. */
  async load(signal) {
    const { id, origin, width, height, resolution } = this.map;
    const bitmap = await createImageBitmap(await picture(`v1/maps/${id}/image.png`, { signal }));
    this.occupancy = new Occupancy(this.map, bitmap);
    const [w, h] = [width * resolution, height * resolution];
    const walls = { href: await this.occupancy.walls(), x: 0, y: -h, width: w, height: h, transform: this.placed(origin) };
    this.layers.walls.replaceChildren(svg("image", walls));
    this.names();
    return this.occupancy;
  }

  /** A transform: what is drawn at 0, 0 is then at this pose. */
  placed(pose) {
    return `translate(${this.at(pose).join(" ")}) rotate(${(-180 * pose[2]) / Math.PI})`;
  }

  /** Writes the names of the rooms, each where it has most space; not of those that are drawn as regions. */
  names() {
    if (!this.occupancy) return;
    const taken = Object.values(this.drawn).flatMap((region) => [foot(region), middle(members(region)[0])]);
    const others = this.rooms.filter(([name]) => !Object.hasOwn(this.drawn, name)).reverse(); // the small ones come last
    const texts = others.map(([name, room]) => {
      const place = this.roomiest(room, taken);
      taken.push(place);
      return this.text(place, name, "room");
    });
    this.layers.rooms.replaceChildren(...texts);
  }

  /** A point of a region with much free space around it, and far from those taken; else its middle. */
  roomiest(region, taken) {
    const [part] = members(region);
    if (part.type === "circle") return part.center;
    const points = corners(part);
    const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => pick(...points.map((p) => p[k]))));
    let [best, most] = [middle(part), 0];
    for (let i = 1; i < 16; i++) {
      for (let j = 1; j < 16; j++) {
        const at = [low[0] + (i / 16) * (high[0] - low[0]), low[1] + (j / 16) * (high[1] - low[1])];
        if (!inside(points, at)) continue;
        const apart = Math.min(...taken.map((other) => Math.hypot(at[0] - other[0], at[1] - other[1])));
        let free = 0;
        while (free < Math.min(2, apart / 2) && this.occupancy.fits(at, free + 0.1)) free += 0.1;
        if (free > most) [best, most] = [at, free];
      }
    }
    return best;
  }

  /** regions: by name. avoided: names that the rule asks not to hold, `touches(R)` and the like among them. */
  regions(regions, avoided = []) {
    const bad = new Set(avoided.map(bare));
    const shown = Object.entries(regions).map(([name, region]) => {
      const group = { class: `region ${bad.has(name) ? "avoid" : "visit"}`, "data-name": name };
      return svg("g", group, ...members(region).map((part) => this.shape(part)), this.text(foot(region), name, "foot"));
    });
    this.layers.regions.replaceChildren(...shown);
    this.drawn = { ...regions };
    this.names();
  }

  shape(region) {
    if (region.type !== "circle") return svg("polygon", { points: this.line(corners(region)) });
    const [cx, cy] = this.at(region.center);
    return svg("circle", { cx, cy, r: region.radius });
  }

  text(point, said, kind = "") {
    const [x, y] = this.at(point);
    return svg("text", { x, y, class: kind, dy: kind === "foot" ? "1.1em" : null, "text-anchor": "middle" }, said);
  }

  /** A point of the map in the picture, whose y goes down. */
  at([x, y]) {
    return [x - this.from[0], this.from[1] - y];
  }

  line(points) {
    return points.map((point) => this.at(point).map((value) => value.toFixed(3)).join(",")).join(" ");
  }

  /** What is seen of the map: its middle, and how long its shorter side is. */
  seen() {
    const [x, y] = this.zoom.middle;
    return { middle: [x + this.from[0], this.from[1] - y], side: Math.min(...this.zoom.seen()) };
  }

  /** The point of the map under a pointer. */
  point(event) {
    const [x, y] = this.zoom.point(event);
    return [x + this.from[0], this.from[1] - y];
  }

  /** Calls `work` with each point that is clicked. Enter stands for a click in the middle of what is seen. */
  clicked(work) {
    this.element.addEventListener("click", (event) => work(this.point(event)));
    this.element.addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault(); // else it would press a button to which `work` moves the focus
      work(this.seen().middle);
    });
  }
}
