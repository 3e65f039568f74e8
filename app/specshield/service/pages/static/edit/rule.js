// The rule as text. It is checked while it is written: errors are underlined, and its windows are drawn on a time line.

import { ask } from "../lib/api.js";
import { button, el, later } from "../lib/dom.js";
import { renamed } from "./names.js";
import { Signals } from "./signals.js";
import { timeline } from "./timeline.js";

const PATTERNS = [
  ["be there once", (name) => `F[0,60] ${name}`],
  ["stay there a while", (name) => `F[0,60] G[0,5] ${name}`],
  ["keep the body out", (name) => `G[0,120] not touches(${name})`],
];

export class Rule {
  /** edited: called with the text at each change. told: called with the server's answer for a valid rule, with null
   *  for an invalid one.
   */
  constructor(text, map, regions, signals, edited, told) {
    Object.assign(this, { map, regions, signals, edited, told });
    const places = () => [...Object.keys(regions), ...Object.keys(map.rooms)];
    this.declared = new Signals(signals, places, () => this.changed());
    this.under = el("pre", { "aria-hidden": "true", class: "under" });
    this.input = el("textarea", {
      id: "rule", rows: 4, spellcheck: "false", autocomplete: "off", autocapitalize: "off", "aria-describedby": "rule-said",
      oninput: () => this.changed(), onscroll: () => (this.under.scrollTop = this.input.scrollTop),
    });
    this.input.value = text;
    this.said = el("p", { id: "rule-said", class: "said", role: "status" });
    this.lines = el("div", { class: "windows" });
    this.patterns = el("div", { class: "row", role: "group", "aria-label": "Add to the rule" });
    this.element = el(
      "section",
      { class: "card", "aria-label": "Rule" },
      el("h2", {}, el("label", { for: "rule" }, "Rule")),
      this.patterns,
      el("div", { class: "text" }, this.under, this.input),
      this.said,
      this.lines,
      this.declared.element,
      el("details", { class: "help" }, el("summary", {}, "How rules are written"), help()),
    );
    this.check = later(() => this.checkNow(), 200);
    this.show(null);
    this.changed();
  }

  get text() {
    return this.input.value.trim();
  }

  /** To be called when the text or the names in it have changed. */
  changed() {
    this.edited(this.input.value);
    this.mark(null);
    this.check();
  }

  /** To be called when a region has got another name. */
  renamed(from, to) {
    this.input.value = renamed(this.input.value, from, to);
  }

  /** Shows the patterns. name: of the region that is chosen at first; a room may be chosen too. */
  show(name) {
    const names = [...new Set([...Object.keys(this.regions), ...Object.keys(this.map.rooms)])];
    if (!names.length) return this.patterns.replaceChildren();
    const kept = name ?? this.place?.value;
    this.place = el("select", { "aria-label": "Place" }, names.map((each) => el("option", {}, each)));
    this.place.value = names.includes(kept) ? kept : (Object.keys(this.regions).at(-1) ?? names[0]);
    const add = ([words, of]) => button(words, () => this.add(of(this.place.value)));
    this.patterns.replaceChildren(this.place, ...PATTERNS.map(add));
  }

  add(part) {
    this.input.value = this.text ? `${this.text} and ${part}` : part;
    this.input.focus();
    this.changed();
  }

  async checkNow() {
    const { text } = this;
    this.asked?.abort();
    this.asked = new AbortController();
    if (!text) return this.tell("Draw a region, then say when the robot has to be where.", null);
    const body = { formula: this.input.value, regions: this.regions, signals: this.signals, map_id: this.map.id };
    try {
      const answer = await ask("v1/specs/validate", { json: body, signal: this.asked.signal });
      const only = answer.methods.length === 1 ? ` Of the methods only ${answer.methods[0]} takes such a rule.` : "";
      this.tell(`It looks at ${answer.horizon + 1} states: steps 0 to ${answer.horizon}.${only}`, answer);
    } catch (error) {
      if (error.name === "AbortError") return;
      this.tell(error.told?.() ?? error.message, null, error.position ?? 0);
    }
  }

  tell(said, answer, position = null) {
    this.said.textContent = said;
    this.said.classList.toggle("wrong", position !== null);
    this.input.setAttribute("aria-invalid", String(position !== null));
    this.mark(position);
    this.lines.replaceChildren(...(answer ? [timeline(answer)] : []));
    this.told(answer);
  }

  /** Underlines the word at a position of the text. */
  mark(position) {
    const text = this.input.value;
    if (position === null) return this.under.replaceChildren(text);
    const at = Math.min(position, text.length);
    const word = /^(\w+|.)?/s.exec(text.slice(at))[0] || " ";
    this.under.replaceChildren(text.slice(0, at), el("mark", {}, word), text.slice(at + word.length));
  }
}

function help() {
  const rows = [
    ["F[0,60] Dock", "at some step from 0 to 60 the robot's origin is in Dock"],
    ["G[0,120] not touches(Stairs)", "at no step up to 120 does its body touch Stairs"],
    ["inside(Dock)", "all of its body is in Dock"],
    ["F[0,60] G[0,5] Dock", "it gets there by step 60, and stays for five more"],
    ["G[0,120] battery > 20", "at no step up to 120 is the signal battery at 20 or below"],
    ["A U[0,30] B", "it is in A until it is in B, by step 30"],
    ["and   or   not   implies", "join parts; a step is one decision"],
  ];
  return el("dl", {}, rows.flatMap(([code, said]) => [el("dt", {}, el("code", {}, code)), el("dd", {}, said)]));
}
