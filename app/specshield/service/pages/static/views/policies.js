// The policies there are, and how far those are that are being made.

import { all } from "../lib/api.js";
import { called, el, percent } from "../lib/dom.js";

const EVERY = 2000; // [ms] between two looks

export async function show(place, { signal }) {
  const body = el("tbody");
  const heads = ["Policy", "Rule", "Method", "State"].map((name) => el("th", { scope: "col" }, name));
  place.append(
    el("h1", {}, "Policies"),
    el("p", {}, "A policy is made for a map, a robot and a rule. ", el("a", { href: "#/maps" }, "Make one: begin with a map.")),
    el("section", { class: "card scroll" }, el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), body)),
  );
  let before = "";
  while (!signal.aborted) {
    const policies = await all("v1/policies", { signal });
    const now = JSON.stringify(policies.map(({ id, status, progress }) => [id, status, progress]));
    if (now !== before) body.replaceChildren(...policies.map(row));
    before = now;
    await new Promise((done) => setTimeout(done, EVERY));
  }
}

function row(policy) {
  const how = policy.status === "training" ? `${policy.status}, ${percent(policy.progress)}` : policy.status;
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("a", { href: `#/policies/${policy.id}` }, called(policy))),
    el("td", {}, el("code", {}, policy.spec.formula)),
    el("td", {}, policy.method),
    el("td", {}, el("span", { class: `badge ${policy.status}` }, how)),
  );
}
