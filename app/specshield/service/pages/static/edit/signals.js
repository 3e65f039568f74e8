// The signals of a rule, such as a battery: their names, and the value that each holds until the robot sends one.

import { el } from "../lib/dom.js";
import { unfit } from "./names.js";

export class Signals {
  /** signals: by name; changed: called when they are others. places: gives the names of regions and rooms. */
  constructor(signals, places, changed) {
    Object.assign(this, { signals, places, changed });
    this.input = el("input", { value: written(signals), placeholder: "battery = 90, call = 0", spellcheck: "false", autocomplete: "off", oninput: () => this.read(false), onchange: () => this.read(true) });
    this.wrong = el("p", { class: "wrong", role: "alert" });
    const label = el("label", {}, "Signals, and what they hold until the robot sends them ", this.input);
    this.element = el("div", { class: "signals" }, label, this.wrong);
  }

  /** done: whether all is written; before that, what cannot be taken yet is not told. */
  read(done) {
    const found = Object.create(null);
    const why = this.input.value.split(/[,;\n]/).filter((part) => part.trim()).map((part) => this.take(part, found)).find(Boolean) ?? "";
    if (why && !done) return;
    const kept = written(this.signals);
    this.input.setAttribute("aria-invalid", String(why !== ""));
    this.wrong.textContent = why && `${why}. The rule still has ${kept ? `the signals ${kept}` : "no signals"}.`;
    if (why) return;
    for (const name of Object.keys(this.signals)) delete this.signals[name];
    Object.assign(this.signals, found);
    this.changed();
  }

  /** Takes one signal as it is written into `found`; why it cannot be taken, or "". */
  take(part, found) {
    const [name, value, more] = part.split("=").map((each) => each.trim());
    if (!value || more !== undefined || !Number.isFinite(Number(value))) return `"${part.trim()}" is not a name, = and a number`;
    const why = unfit(name, [...this.places(), ...Object.keys(found)], "place or signal");
    if (!why) found[name] = Number(value);
    return why && `"${name}" ${why}`;
  }
}

const written = (signals) => Object.entries(signals).map(([name, value]) => `${name} = ${value}`).join(", ");
