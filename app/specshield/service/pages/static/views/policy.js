// One policy: the progress of its making, and the starts from which its rule can be kept.

import { ask, picture } from "../lib/api.js";
import { called, el, pair, percent, problem, say } from "../lib/dom.js";
import { patiently, pause } from "../lib/patience.js";

const EVERY = 700; // [ms] between two looks while it is made

export async function show(place, { id, signal }) {
  const path = `v1/policies/${encodeURIComponent(id)}`;
  let policy = await ask(path, { signal });
  const state = el("section", { class: "card", "aria-label": "State" });
  const figure = el("figure", { class: "heat" });
  place.append(
    el("h1", {}, called(policy)),
    el("div", { class: "watch" }, figure, el("div", { class: "stack" }, state, about(policy))),
  );
  state.replaceChildren(...stands(policy));
  watchOver();

  async function watchOver() {
    try {
      while (policy.status === "queued" || policy.status === "training") {
        await pause(EVERY);
        if (signal.aborted) return;
        policy = await patiently(() => ask(path, { signal }), signal);
        state.replaceChildren(...stands(policy));
      }
      if (policy.status !== "ready") return say("The policy could not be made.");
      say("The policy is ready.");
      figure.replaceChildren(el("p", { role: "status" }, "Looking from where the rule can be kept …"));
      const image = el("img", { alt: `From where ${policy.spec.formula} can be kept`, class: "whole" });
      image.src = URL.createObjectURL(await patiently(() => picture(`${path}/image.svg`, { signal }), signal));
      figure.replaceChildren(image);
    } catch (error) {
      if (!signal.aborted) figure.replaceChildren(problem(error));
    }
  }
}

function stands(policy) {
  const left = policy.eta_s === null ? "" : `, about ${Math.ceil(policy.eta_s)} s left`;
  const state = policy.status === "training" ? "being made" : policy.status;
  const head = el("div", { class: "row spread" }, el("h2", {}, "State"), el("span", { class: `badge ${policy.status}` }, state));
  if (policy.status === "failed") return [head, el("p", { class: "problem", role: "alert" }, policy.error ?? "It failed.")];
  if (policy.status !== "ready")
    return [head, el("progress", { max: 1, value: policy.progress, "aria-label": "Progress" }), el("p", {}, `${percent(policy.progress)}${left}`)];
  const share = policy.metrics.feasible_start;
  const any = policy.metrics.feasible_start_any_signal;
  return [
    head,
    typeof share === "number" ? el("p", {}, `By its own count, the rule can be kept from ${percent(share)} of the starts that it drew at random.`) : null,
    typeof any === "number" ? el("p", {}, `That is if the signals stay as they are. Whatever they do, it can be kept from ${percent(any)}.`) : null,
    policy.warnings.length ? el("ul", { class: "warnings" }, policy.warnings.map((text) => el("li", {}, text))) : null,
    share === 0 ? el("p", { class: "problem", role: "alert" }, "From no place can this rule be kept: its windows may be too short, or a region out of reach.") : null,
    el("p", {}, el("a", { class: "button main", href: `#/try/${policy.id}` }, "Try it")),
  ].filter(Boolean);
}

function about(policy) {
  const robot = typeof policy.robot === "string" ? policy.robot : "one of its own";
  return el(
    "section",
    { class: "card", "aria-label": "About this policy" },
    el("h2", {}, "Rule"),
    el("p", {}, el("code", {}, policy.spec.formula)),
    el(
      "dl",
      { class: "numbers" },
      pair("Map", el("a", { href: `#/maps/${policy.map_id}` }, policy.map_id.slice(0, 8))),
      pair("Robot", robot),
      pair("Method", policy.method),
      pair("Horizon", `${policy.horizon} steps`),
    ),
    el("p", { class: "id" }, policy.id),
  );
}
