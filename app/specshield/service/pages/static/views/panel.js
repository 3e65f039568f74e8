// The decision of one step: its mode in words, and for each action the probability that the model wanted, the
// probability that it got, and whether the rule can still be kept after it.

import { el, metres, pair, percent } from "../lib/dom.js";
import { measure, ruleOf, sameFloor, sameRobot, within } from "../lib/rules.js";

const MODES = {
  prior: "The rule is settled: the model chooses alone.",
  shaped: "The closest to what the model wants that keeps the rule within reach.",
  completion: "The model has ended its task; the certified continuation completes the rule.",
  fallback: "Nothing that the model wants keeps the rule: the certified continuation decides.",
  violated: "The rule is broken; what can still be kept of it is kept.",
};
const REASONS = {
  infeasible: "no future was found that keeps the rule",
  zero_prior_mass: "the model gives no probability to any action that keeps the rule",
  margin_unattainable: "the margin that was asked for cannot be had; the largest there is, is kept",
};
const SEEN = 0.001; // a share below this is told with the rest

/** The model's own distribution: softmax of its logits. */
export function prior(logits) {
  if (!logits) return null;
  const most = Math.max(...logits.filter((value) => value !== null));
  const weights = logits.map((value) => (value === null ? 0 : Math.exp(value - most)));
  const sum = weights.reduce((total, weight) => total + weight, 0);
  return weights.map((weight) => weight / sum);
}

/** Why an action is forbidden, in words. measured: writes a robustness. */
function whyNot(decision, action, measured) {
  const value = decision.robustness[action];
  const told = decision.explanations?.[action];
  if (told?.detail && told.robustness > 0) return told.detail;
  if (told && told.robustness > 0) return `${told.conjunct} could still be kept, but not with ${inHand(decision)} in reserve`;
  if (told) {
    const late = told.late_by ? `it comes ${told.late_by} ${told.late_by === 1 ? "step" : "steps"} too late` : null;
    const misses = told.robustness === null ? null : `it falls short by ${Math.abs(told.robustness).toFixed(2)}`;
    const found = told.detail ?? [late, misses].filter(Boolean).join(", ");
    if (!found) return `no way was found that keeps ${told.conjunct}`;
    return `no way was found after it that keeps the rule; the best way found does not keep '${told.conjunct}': ${found}`;
  }
  if (value === null || value === undefined) return "was not looked at";
  if (decision.mode === "violated") return "no way was found after it that keeps what is left of the rule";
  if (value > 0) return `keeps the rule by ${measured(value)}, but not with ${inHand(decision)} in reserve`;
  return `no way was found after it that keeps the rule; the best misses it by ${measured(Math.abs(Math.min(0, value)))}`;
}

/** What a decision keeps in reserve for a robot that does not land exactly where it should. */
function inHand({ margin, slack }) {
  return [margin > 0 && metres(margin), slack > 0 && `${slack} steps`].filter(Boolean).join(" and ") || "what is kept";
}

export class Panel {
  constructor(session) {
    this.session = session;
    this.measured = measure(session.spec);
    this.element = el("section", { class: "card panel", "aria-label": "The decision at this step" });
  }

  show(item) {
    const { decision } = item;
    const rule = ruleOf(this.session, item);
    const head = el(
      "div",
      { class: "row spread" },
      el("h2", {}, `Step ${item.t}`, el("small", {}, within(item.t, rule))),
      decision && el("span", { class: `badge ${decision.spec_status}` }, decision.spec_status),
    );
    if (!decision) {
      this.element.replaceChildren(head, el("p", {}, "No decision was asked for at this step."));
      return;
    }
    const open = this.element.querySelector("details")?.open;
    const earlier = rule !== this.session.rules.at(-1) && this.earlier(rule, item);
    this.element.replaceChildren(head, ...[earlier].filter(Boolean), ...this.mode(decision), this.numbers(decision), this.actions(item));
    if (open) this.element.querySelector("details")?.setAttribute("open", "");
  }

  /** Which rule held at a step before a switch. */
  earlier({ formula }, item) {
    const elsewhere = sameFloor(this.session, item) ? "" : ", on another floor";
    return el("p", { class: "earlier" }, `Decided under an earlier rule${elsewhere}: `, el("code", {}, formula));
  }

  mode(decision) {
    const lost = decision.mode === "fallback" && !decision.witness;
    const short = decision.reason === "infeasible" && decision.feasible_mass > 0; // there are ways, and a threshold above theirs
    const reason = short ? "every way that was found keeps the rule by less than the threshold" : (REASONS[decision.reason] ?? decision.reason);
    const asked = short ? "The threshold that was asked for cannot be had: the certified continuation decides." : MODES[decision.mode];
    const said = lost ? "No way was found that keeps what is asked; this is what comes nearest." : asked;
    const warnings = decision.warnings.map((text) => el("li", {}, text));
    if (decision.in_collision) warnings.push(el("li", {}, "The robot touches an obstacle."));
    return [
      el("p", { class: "mode" }, el("strong", {}, decision.mode), " ", said ?? "", reason ? ` (${reason})` : ""),
      warnings.length ? el("ul", { class: "warnings" }, warnings) : null,
    ].filter(Boolean);
  }

  numbers(decision) {
    const { feasible_mass: mass, kl, residual, margin, slack, threshold_left: left, map_revision: revision, any_signal: any } = decision;
    const off = residual && `${metres(residual.translation)}, ${((180 * residual.rotation) / Math.PI).toFixed(1)}°`;
    return el(
      "dl",
      { class: "numbers" },
      pair("Feasible mass", mass === null ? "–" : percent(mass)),
      pair("Distance from the model", kl === null ? "–" : `${kl.toFixed(2)} nats`),
      pair("Off the expected pose", off ?? "–"),
      margin === undefined ? null : pair("Margin, slack", `${metres(margin)}, ${slack} steps`),
      left === undefined || left === null || left === 1 ? null : pair("Threshold left", left.toFixed(3)),
      typeof any === "boolean" && decision.mode !== "violated" ? pair("Kept", any ? "whatever the signals do" : "if the signals stay as they are") : null,
      revision ? pair("Own map", revision === 1 ? "changed once" : `changed ${revision} times`) : null,
    );
  }

  actions(item) {
    const { decision, logits } = item;
    const wanted = prior(logits);
    const { actions, robot } = this.session;
    if (!sameRobot(this.session, item)) return el("p", {}, "Decided for another robot, before a switch.");
    const groups = alike(robot.actions);
    const said = new Map(); // each reason, and the action that it was written out for
    const row = (group) => this.row(group.map((i) => actions[i]), robot.actions[group[0]], group, decision, wanted, said);
    const sum = (values, group) => (values ? group.reduce((total, i) => total + values[i], 0) : 0);
    const share = (group) => Math.max(sum(decision.distribution, group), sum(wanted, group));
    const seen = (group) => share(group) >= SEEN || group.includes(decision.action);
    const heads = () => ["Action", "Wanted and got", "Then the rule"].map((name) => el("th", { scope: "col" }, name));
    const table = (some) =>
      el("table", { class: "actions" }, el("thead", {}, el("tr", {}, heads())), el("tbody", {}, some));
    const [most, rest] = [groups.filter(seen).map(row), groups.filter((group) => !seen(group)).map(row)];
    return el(
      "div",
      {},
      el("p", { class: "key" }, el("i", { class: "wanted" }), "what the model wants ", el("i", { class: "got" }), "what it gets"),
      table(most),
      rest.length ? el("details", {}, el("summary", {}, `${rest.length} more that are below 0.1 %`), table(rest)) : null,
    );
  }

  /** group: the actions that do the same; they share a row. said: see `verdict`. */
  row(names, action, group, decision, wanted, said) {
    const sum = (values) => group.reduce((total, i) => total + values[i], 0);
    const [want, get] = [wanted ? sum(wanted) : null, sum(decision.distribution)];
    const bars = el(
      "td",
      { class: "bars", "aria-label": `wanted ${want === null ? "unknown" : percent(want)}, got ${percent(get)}` },
      want === null ? null : bar("wanted", want),
      bar("got", get),
    );
    const drawn = group.includes(decision.action) ? el("span", { class: "drawn", title: "The action drawn at this step" }, "drawn") : null;
    const head = el("th", { scope: "row", title: names.join(", ") }, names[0], names.length > 1 ? ` and ${names.length - 1} more` : "", drawn);
    head.append(el("small", { class: "does" }, does(action)));
    return el("tr", {}, head, bars, this.verdict(decision, group[0], action, names[0], said));
  }

  /** said: the reasons that have been written out, each with the name of its action; a new one is added. */
  verdict(decision, i, action, name, said) {
    if (action.terminal) return el("td", { class: "told" }, "ends the model's task");
    const [j, value] = [decision.j_values[i], decision.robustness[i]];
    if (j === null) return el("td", { class: "told" }, "was not looked at");
    if (j > 0 && decision.mode === "violated") return el("td", { class: "told can" }, "is broken; what is left of it can be kept");
    if (j > 0 || (j !== 0 && value > 0)) return el("td", { class: "told can" }, "can be kept", el("small", {}, ` by ${this.measured(value)}`));
    const why = whyNot(decision, i, this.measured);
    const first = said.get(why);
    if (!first) said.set(why, name);
    return el("td", { class: "told cannot" }, el("strong", {}, "forbidden: "), first ? `for the same reason as ${first}` : why);
  }
}

/** Indices of the actions, those that do the same together. */
function alike(actions) {
  const does = ({ translate, rotate, terminal }) => `${translate} ${rotate} ${terminal}`;
  return [...Map.groupBy(actions.keys(), (i) => does(actions[i])).values()];
}

function bar(kind, share) {
  const line = el("i", { class: kind });
  line.style.width = `${(100 * share).toFixed(1)}%`;
  return el("span", {}, line, el("small", {}, percent(share)));
}

/** What an action does, in words. */
export function does({ translate, rotate, terminal }) {
  if (terminal) return "ends the task";
  const turn = rotate && `turns ${rotate < 0 ? "right" : "left"} ${((180 * Math.abs(rotate)) / Math.PI).toFixed(0)}°`;
  const go = translate && `moves ${translate < 0 ? "back " : ""}${Math.abs(translate).toFixed(2)} m`;
  return [go, turn].filter(Boolean).join(", ") || "leaves the base where it is";
}
