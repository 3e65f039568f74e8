// What a session has learned of its map: draws the cells that it found to differ from the map.

import { ask } from "./api.js";
import { el, svg } from "./dom.js";
import { patiently, pause } from "./patience.js";

export const EVERY = 1000; // [ms] between two reads, at least: a robot with a scanner may change its map at each step

export class Learned {
  /**
   * session: as the API shows it. mark: of its robot. changed: called when the cells have changed.
   * name: of the robot, if the floor has several. every: milliseconds between two reads.
   */
  constructor(floor, session, mark, changed, name = "", every = EVERY) {
    Object.assign(this, { floor, session, mark, changed, name, every });
    const { rules, map_id } = session;
    this.since = rules[rules.findLastIndex((rule) => rule.map_id !== map_id) + 1].from; // its first step on this map
    this.known = { t: -1, map_revision: 0, occupied: [], free: [] };
    this.newest = 0; // revision of the map at the newest decision
    const { origin, resolution } = floor.map;
    const transform = `${floor.placed(origin)} scale(${resolution} ${-resolution})`;
    this.cells = ["occupied", "free"].map((kind) => svg("path", { class: kind, transform }));
    this.layer = svg("g", {}, ...this.cells);
    floor.layers.learned.append(this.layer);
    this.key = el("p", { class: "key learned", hidden: true });
  }

  /** Notes a decision, and reads what the session has learned if that has changed. */
  async heard({ t, decision }, signal) {
    if (t >= this.since) this.newest = decision.map_revision;
    if (this.reading) return;
    this.reading = true;
    try {
      while (this.known.map_revision < this.newest) {
        const path = `v1/sessions/${encodeURIComponent(this.session.id)}/learned`;
        const known = await patiently(() => ask(path, { signal }), signal);
        if (known.map_id !== this.session.map_id) return; // after a switch to another map, the view begins again
        this.take(known);
        await pause(this.every);
      }
    } catch (error) {
      if (!signal.aborted && error.status !== 404) throw error; // else the view was left, or the session erased
    } finally {
      this.reading = false;
    }
  }

  take(known) {
    this.known = known;
    this.own = this.floor.occupancy.changed(known.occupied, known.free);
    this.cells.forEach((path) => path.setAttribute("d", outline(known[path.getAttribute("class")], this.floor.map.width)));
    this.changed();
  }

  /** item: the last one that was decided, up to the step that is shown. */
  show(item) {
    const revision = item && item.t >= this.since ? item.decision.map_revision : 0;
    const { t, occupied, free, map_revision } = this.known;
    const shown = revision > 0 && occupied.length + free.length > 0;
    this.layer.toggleAttribute("hidden", !shown);
    this.key.hidden = !shown;
    this.mark.occupancy = shown ? this.own : null;
    const kinds = ["occupied", "free"].filter((kind) => this.known[kind].length);
    const told = kinds.flatMap((kind) => [el("span", {}, el("i", { class: kind }), `found ${kind}`), " "]);
    const when = revision === map_revision ? "" : ` What is drawn is from step ${t}.`;
    this.key.replaceChildren(this.name && `${this.name}: `, ...told, `The map says otherwise.${when}`);
  }
}

/** Cells as a path, in cells from the grid's origin. cells: row * width + column, ascending. */
function outline(cells, width) {
  const runs = [];
  for (let i = 0, n; i < cells.length; i += n) {
    const first = cells[i];
    for (n = 1; cells[i + n] === first + n && (first + n) % width; ) n++;
    runs.push(`M${first % width} ${Math.floor(first / width)}h${n}v1h${-n}z`);
  }
  return runs.join("");
}
