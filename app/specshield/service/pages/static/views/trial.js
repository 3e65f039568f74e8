// A simulated robot with a policy: a stand-in model drives it, and one can push it and put obstacles in its way.

import { ask } from "../lib/api.js";
import { button, called, el, svg } from "../lib/dom.js";
import { passes } from "../lib/patience.js";
import { abandon, Episode } from "../trial/episode.js";
import { goalSeeker, wanderer } from "../trial/model.js";
import { SIZE, World } from "../trial/world.js";
import { Floor } from "../lib/floor.js";
import { centre } from "../lib/motion.js";
import { Watch } from "./watch.js";

const TRIES = 60; // starts that the server may refuse before it is given up
const DRAWS = 5000; // places that are drawn for each of them, until the robot fits
const PACE = 120; // [ms] between two steps

export async function show(place, { id, signal }) {
  const policy = await ask(`v1/policies/${encodeURIComponent(id)}`, { signal });
  const map = await ask(`v1/maps/${policy.map_id}`, { signal });
  const robot = await resolved(policy.robot, signal);
  const floor = new Floor(map, `Floor ${called(map)}`);
  const rule = { ...policy.spec, map_id: policy.map_id };
  const { avoided } = await ask("v1/specs/validate", { json: rule, signal }).catch(() => ({ avoided: [] }));
  floor.regions(policy.spec.regions ?? {}, avoided);
  const told = el("p", { class: "told", role: "alert" });
  const model = el("select", {}, el("option", { value: "goal" }, "goes to a goal"), el("option", { value: "wander" }, "wanders"));
  const anywhere = button("Set it down anywhere", () => begin(null), { class: "main" });
  const setup = el(
    "section",
    { class: "card", "aria-label": "Begin" },
    el("h2", {}, "Begin"),
    el("p", {}, "Click on the floor to set the robot down there (Enter, on the floor: in the middle of what is seen), or:"),
    el("label", {}, "The model ", model),
    anywhere,
    told,
  );
  place.append(el("h1", {}, `Try ${called(policy)}`), el("p", {}, el("code", {}, policy.spec.formula)), el("div", { class: "watch" }, floor.frame, setup));
  const read = floor.load(signal); // who is quick sets the robot down before that
  floor.clicked(begin);
  await read;
  floor.element.classList.add("drawing");

  async function begin(point) {
    if (anywhere.disabled) return; // it is being set down
    anywhere.disabled = true;
    told.textContent = "The robot is set down …";
    let session = null;
    const leave = () => session && abandon(session);
    try {
      const occupancy = await read;
      session = await start(policy, occupancy, robot, point, signal);
      if (signal.aborted) return leave();
      signal.addEventListener("abort", leave);
      addEventListener("pagehide", leave, { signal });
      const watch = new Watch(session, map);
      await watch.load(signal);
      place.querySelector(".watch").replaceWith(watch.element);
      const world = new World(robot, watch.floor.occupancy, session.start);
      new Controls(watch, world, robot, model.value, signal, () => (session = null));
    } catch (error) {
      leave();
      session = null;
      const refused = error.type === "infeasible-start"; // what it expects, and its parts, are words for a program
      told.textContent = refused ? `${error.message}. Set the robot down elsewhere.` : (error.told?.() ?? error.message);
    }
    anywhere.disabled = false;
  }
}

/** A robot as /v1/robots has it, whatever a policy says of it. */
async function resolved(robot, signal) {
  if (typeof robot === "string") return ask(`v1/robots/${robot}`, { signal });
  const actions = robot.actions.map((action) => ({ translate: 0, rotate: 0, terminal: false, ...action }));
  return { name: "custom", on_contact: "stay", ...robot, actions, footprint: { offset: [0, 0], ...robot.footprint } };
}

/** A session at a point, or where it is taken of those drawn at random; `start` is its pose. */
async function start(policy, occupancy, robot, point, signal) {
  for (let refused = 0; ; ) {
    const pose = point ? [...point, 0] : drawn(occupancy, robot); // at a point, it looks along x
    try {
      const session = await ask("v1/sessions", { json: { policy_id: policy.id, initial_pose: pose } });
      return { ...session, start: pose };
    } catch (error) {
      refused += 1;
      if (point || !["infeasible-start", "invalid-pose"].includes(error.type) || refused >= TRIES) throw error;
    }
    signal.throwIfAborted();
  }
}

/** A pose at random at which the robot fits. */
function drawn(occupancy, robot) {
  const [x0, y0, x1, y1] = occupancy.map.bounds;
  for (let i = 0; i < DRAWS; i++) {
    const place = [x0 + Math.random() * (x1 - x0), y0 + Math.random() * (y1 - y0)];
    const pose = [...place, (2 * Math.random() - 1) * Math.PI];
    if (occupancy.fits(centre(robot, pose), robot.footprint.radius + 0.05)) return pose;
  }
  throw new Error(`Of ${DRAWS} places drawn at random, the robot fits at none. Click on the floor where it does.`);
}

class Controls {
  /** ended: called when the episode is over. */
  constructor(watch, world, robot, kind, signal, ended) {
    Object.assign(this, { watch, world, robot, kind, ended, mode: null, failure: null });
    this.episode = new Episode(watch.session, world, () => [], (item) => this.take(item));
    this.goal = svg("circle", { class: "goal", r: 0.15 });
    this.run = button("Run", () => this.toggle(), { class: "main" });
    this.modes = [
      ["goal", "Move the goal"],
      ["push", "Put the robot elsewhere"],
      ["drop", "Drop an obstacle"],
    ].map(([mode, name]) => button(name, () => this.choose(mode), { "aria-pressed": "false", "data-mode": mode }));
    this.told = el("p", { class: "hint", role: "status" }, "Run it, or go step by step.");
    const now = [
      button("Step", () => this.once()),
      button("Push the robot", () => this.shoved(this.world.push())),
      button("Obstacle before it", () => this.drop(this.world.ahead(0.1))),
    ];
    const card = el(
      "section",
      { class: "card controls", "aria-label": "Controls" },
      el("div", { class: "row" }, this.run, now),
      el("div", { class: "row", role: "group", "aria-label": "Then click on the floor" }, this.modes),
      this.told,
      el("p", {}, el("a", { href: `#/sessions/${watch.session.id}` }, "This session's own page")),
    );
    watch.side.prepend(card);
    watch.floor.layers.marks.append(this.goal);
    watch.floor.clicked((point) => this.clicked(point));
    for (const each of [watch.floor.element, card])
      each.addEventListener("keydown", (event) => event.key === "Escape" && this.mode && this.choose(this.mode));
    signal.addEventListener("abort", () => this.pause());
    this.setGoal(this.somewhere());
    watch.mark.move(world.pose);
    this.run.focus({ preventScroll: true }); // what had the focus is gone
    this.once();
  }

  /** A free place far from the robot. */
  somewhere() {
    const { occupancy } = this.world;
    const [x0, y0, x1, y1] = occupancy.map.bounds;
    const far = occupancy.distances(this.world.pose, this.robot.footprint.radius);
    let best = this.world.pose.slice(0, 2);
    for (let i = 0; i < 200; i++) {
      const point = [x0 + Math.random() * (x1 - x0), y0 + Math.random() * (y1 - y0)];
      if (Number.isFinite(far(point)) && far(point) > far(best)) best = point;
    }
    return best;
  }

  setGoal(point) {
    const { occupancy } = this.world;
    const fits = (at, radius) => occupancy.fits(at, radius);
    const distance = occupancy.distances(point, this.robot.footprint.radius + 0.03);
    this.episode.model = this.kind === "goal" ? goalSeeker(this.robot, fits, distance) : wanderer(this.robot);
    const [cx, cy] = this.watch.floor.at(point);
    this.goal.setAttribute("cx", cx);
    this.goal.setAttribute("cy", cy);
    this.goal.toggleAttribute("hidden", this.kind !== "goal");
  }

  /** Begins a mode: the keys go to the floor. The mode that is chosen already ends: they go back to its button. */
  choose(mode) {
    this.mode = this.mode === mode ? null : mode;
    for (const each of this.modes) each.setAttribute("aria-pressed", String(each.dataset.mode === this.mode));
    const { element } = this.watch.floor;
    element.classList.toggle("drawing", this.mode !== null);
    if (this.mode) element.focus();
    else this.modes.find((each) => each.dataset.mode === mode).focus({ preventScroll: true });
    this.tell(this.mode ? "Click on the floor. Enter takes the middle of what is seen, Escape leaves it." : "");
  }

  clicked(point) {
    const { mode } = this;
    if (mode) this.choose(mode);
    if (mode === "goal") this.setGoal(point);
    if (mode === "drop") this.drop(point);
    if (mode === "push") this.shoved(this.world.put([...point, this.world.pose[2]]));
  }

  drop(point) {
    if (!this.world.drop(point)) return this.tell("The robot stands there.");
    const [cx, cy] = this.watch.floor.at(point);
    this.watch.floor.layers.marks.append(svg("circle", { class: "obstacle", cx, cy, r: SIZE }));
    this.tell("An obstacle stands there. The service hears of it when the robot sees it.");
  }

  shoved(could) {
    this.watch.mark.move(this.world.pose);
    this.tell(could ? "The robot was pushed. The service hears of it with the next step." : "There is no room for it.");
  }

  async once() {
    if (this.busy || this.episode.over) return;
    this.busy = true;
    try {
      await this.episode.step();
      if (this.told.textContent === this.failure) this.tell("");
    } catch (error) {
      this.pause();
      this.failure = passes(error) ? `${error.told()} Step or Run sends this step again.` : (error.told?.() ?? error.message);
      this.tell(this.failure);
    }
    this.busy = false;
  }

  toggle() {
    if (this.timer) return this.pause();
    this.run.textContent = "Pause";
    this.timer = setInterval(() => this.once(), PACE);
  }

  pause() {
    clearInterval(this.timer);
    this.timer = 0;
    this.run.textContent = "Run";
  }

  take(item) {
    if (!item.finished) return this.watch.push(item);
    this.ended();
    this.pause();
    this.tell(`The episode is over: the rule is ${item.spec_status}.`);
    this.run.disabled = true;
  }

  tell(text) {
    this.told.textContent = text;
  }
}
