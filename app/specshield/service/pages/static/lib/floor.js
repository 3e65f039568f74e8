// A floor plan: walls, regions, and what is drawn on it. Points are in metres of the map frame; y is up.

import { picture } from "./api.js";
import { svg } from "./dom.js";
import { Occupancy } from "./occupancy.js";

const at = ([x, y]) => `${x.toFixed(3)},${(-y).toFixed(3)}`;
export const line = (points) => points.map(at).join(" ");

/** The members of a region that are no unions. */
const members = (region) => (region.type === "union" ? region.members : [region]);

export function shape(region) {
  if (region.type === "circle")
    return svg("circle", { cx: region.center[0], cy: -region.center[1], r: region.radius });
  return svg("polygon", { points: line(corners(region)) });
}

export function corners(region) {
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

export class Floor {
  /** map: as the API shows it. label: for those who do not see it. */
  constructor(map, label) {
    const [x0, y0, x1, y1] = map.bounds;
    this.map = map;
    this.rooms = []; // [name, place] of each, once the walls are known
    this.drawn = new Set(); // names of the regions
    this.unit = Math.max(x1 - x0, y1 - y0) / 100; // [m] about a hundredth of the picture
    this.layers = Object.fromEntries(
      ["walls", "rooms", "regions", "ways", "robots", "marks"].map((name) => [name, svg("g", { class: name })]),
    );
    this.element = svg(
      "svg",
      { class: "floor", viewBox: `${x0} ${-y1} ${x1 - x0} ${y1 - y0}`, role: "img", "aria-label": label },
      ...Object.values(this.layers),
    );
    this.element.style.setProperty("--unit", `${this.unit}px`);
    this.element.style.setProperty("--ratio", String((x1 - x0) / (y1 - y0)));
  }

  /** Draws the walls, and gives the cells. */
  async load(signal) {
    const { id, origin, width, height, resolution } = this.map;
    const bitmap = await createImageBitmap(await picture(`v1/maps/${id}/image.png`, { signal }));
    this.occupancy = new Occupancy(this.map, bitmap);
    const [w, h] = [width * resolution, height * resolution];
    const turned = `translate(${origin[0]} ${-origin[1]}) rotate(${(-180 * origin[2]) / Math.PI})`;
    const walls = { href: await this.occupancy.walls(), x: 0, y: -h, width: w, height: h, transform: turned };
    this.layers.walls.replaceChildren(svg("image", walls));
    const single = Object.entries(this.map.rooms).filter(([, room]) => room.type !== "union");
    this.rooms = single.map(([name, room]) => [name, this.roomiest(room)]);
    this.names();
    return this.occupancy;
  }

  /** Writes the names of the rooms, each where it has most space; not of those that are drawn as regions. */
  names() {
    const others = this.rooms.filter(([name]) => !this.drawn.has(name));
    this.layers.rooms.replaceChildren(...others.map(([name, place]) => this.text(place, name, "room")));
  }

  /** A point of a region with much free space around it; its middle where there is none. */
  roomiest(region) {
    const [part] = members(region);
    if (part.type === "circle") return part.center;
    const points = corners(part);
    const [low, high] = [Math.min, Math.max].map((pick) => [0, 1].map((k) => pick(...points.map((p) => p[k]))));
    let [best, most] = [[(low[0] + high[0]) / 2, (low[1] + high[1]) / 2], 0];
    for (let i = 1; i < 16; i++) {
      for (let j = 1; j < 16; j++) {
        const at = [low[0] + (i / 16) * (high[0] - low[0]), low[1] + (j / 16) * (high[1] - low[1])];
        if (!inside(points, at)) continue;
        while (most < 2 && this.occupancy.fits(at, most + 0.1)) [best, most] = [at, most + 0.1];
      }
    }
    return best;
  }

  /** regions: by name. avoided: names that the rule asks not to hold, `touches(R)` and the like among them. */
  regions(regions, avoided = []) {
    const bad = new Set(avoided.map((name) => name.replace(/^\w+\((.*)\)$/, "$1")));
    const shown = Object.entries(regions).map(([name, region]) => {
      const [x, y] = foot(region);
      const group = { class: `region ${bad.has(name) ? "avoid" : "visit"}`, "data-name": name };
      return svg("g", group, ...members(region).map(shape), this.text([x, y - 2.2 * this.unit], name));
    });
    this.layers.regions.replaceChildren(...shown);
    this.drawn = new Set(Object.keys(regions));
    this.names();
  }

  text([x, y], said, kind = "") {
    return svg("text", { x, y: -y, class: kind, "text-anchor": "middle" }, said);
  }

  /** The point of the map under a pointer. */
  point(event) {
    const seen = this.element.getScreenCTM().inverse();
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(seen);
    return [x, -y];
  }
}
