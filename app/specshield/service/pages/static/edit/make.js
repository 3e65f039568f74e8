// The form that asks for a policy: its robot, method and name.

import { ask } from "../lib/api.js";
import { el } from "../lib/dom.js";

const METHODS = {
  reachability: "computed in seconds",
  planner: "for every rule, slower at each step",
  dqn: "learned, takes minutes to hours",
};
const OWN = {
  footprint: { radius: 0.2 },
  on_contact: "stop",
  actions: [
    { name: "forward", translate: 0.25 },
    { name: "left", rotate: 0.5236 },
    { name: "right", rotate: -0.5236 },
    { name: "wait" },
    { name: "end", terminal: true },
  ],
};

/** A form that asks for a policy. spec: gives {map_id, spec} of what is on the page. */
export function makeForm(robots, spec) {
  const told = el("p", { class: "told", role: "alert" });
  const own = el("textarea", { rows: 8, "aria-label": "The robot as JSON", hidden: true, spellcheck: "false" });
  own.value = JSON.stringify(OWN, null, 1);
  const options = [...robots.map(({ name }) => el("option", { value: name }, name)), el("option", { value: "" }, "one of my own")];
  const robot = el("select", { name: "robot", onchange: () => (own.hidden = robot.value !== "") }, options);
  const methods = Object.entries(METHODS).map(([name, said]) => el("option", { value: name }, `${name}: ${said}`));
  const submit = el("button", { class: "main", disabled: true }, "Make it");
  const form = el(
    "form",
    { class: "card", "aria-label": "Make a policy" },
    el("h2", {}, "Policy"),
    el("p", {}, "A policy knows from where, and how, the rule can still be kept."),
    el("label", {}, "Robot ", robot),
    own,
    el("label", {}, "Method ", el("select", { name: "method" }, methods)),
    el("label", {}, "Name ", el("input", { name: "name", placeholder: "if you like", pattern: "[A-Za-z0-9][A-Za-z0-9_.\\-]*", maxlength: 64, title: "Letters a to z or A to Z, digits, '_', '.' and '-'; a letter or digit first" })),
    submit,
    told,
  );
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const { method, name } = Object.fromEntries(new FormData(form));
    told.textContent = "";
    submit.disabled = true;
    try {
      const body = { ...spec(), method, robot: robot.value || JSON.parse(own.value), ...(name && { name }) };
      const policy = await ask("v1/policies", { json: body });
      location.hash = `#/policies/${policy.id}`;
    } catch (error) {
      told.textContent = error.told?.() ?? `The robot is not JSON: ${error.message}`;
    }
    submit.disabled = false;
  });
  return { element: form, allow: (right) => (submit.disabled = !right) };
}
