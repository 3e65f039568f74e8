// The list of policies, with the progress of those that are being made.

import { all } from "../lib/api.js";
import { called, el, keep, percent, write } from "../lib/dom.js";
import { again } from "../lib/patience.js";

const EVERY = 2000; // [ms] between two looks

export async function show(place, { signal }) {
  const body = el("tbody");
  const heads = ["Policy", "Rule", "Method", "State"].map((name) => el("th", { scope: "col" }, name));
  const look = async (signal) => {
    const policies = await all("v1/policies", { signal });
    keep(body, policies, { key: (policy) => policy.id, make: row, fill });
  };
  await look(signal);
  place.append(
    el("h1", {}, "Policies"),
    el("p", {}, "A policy is made for a map, a robot and a rule. ", el("a", { href: "#/maps" }, "Make one: begin with a map.")),
    el("section", { class: "card scroll" }, el("table", { class: "list" }, el("thead", {}, el("tr", {}, heads)), body)),
  );
  again(look, EVERY, place, signal);
}

function row(policy) {
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, el("a", { href: `#/policies/${policy.id}`, title: policy.id })),
    el("td", {}, el("code", {}, policy.spec.formula)),
    el("td", { "data-head": "Method" }, policy.method),
    el("td", { "data-head": "State" }, el("span")),
  );
}

function fill(row, policy) {
  const [name, , , state] = row.children;
  write(name.firstChild, called(policy));
  state.firstChild.className = `badge ${policy.status}`;
  write(state.firstChild, policy.status === "training" ? `being made, ${percent(policy.progress)}` : policy.status);
}
