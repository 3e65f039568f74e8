// Which view is shown: the part of the address after '#', such as #/sessions/robot-1.

import { Problem } from "./lib/api.js";
import { el, say } from "./lib/dom.js";

const VIEWS = [
  [/^\/(sessions)?$/, () => import("./views/sessions.js")],
  [/^\/sessions\/([^/]+)$/, () => import("./views/session.js")],
  [/^\/floor$/, () => import("./views/floor.js")],
  [/^\/maps$/, () => import("./views/maps.js")],
  [/^\/maps\/([^/]+)$/, () => import("./views/editor.js")],
  [/^\/policies$/, () => import("./views/policies.js")],
  [/^\/policies\/([^/]+)$/, () => import("./views/policy.js")],
  [/^\/try\/([^/]+)$/, () => import("./views/trial.js")],
];

const main = document.querySelector("main");
let leaving = new AbortController();

async function show() {
  leaving.abort(); // what the view before still does
  leaving = new AbortController();
  const { signal } = leaving;
  const [path, query] = (location.hash.slice(1) || "/").split("?");
  mark(path);
  const found = VIEWS.map(([form, load]) => [form.exec(path), load]).find(([match]) => match);
  const place = el("div", { class: "view" });
  main.replaceChildren(place);
  if (!found) {
    place.append(el("h1", {}, "There is no such page"), el("p", {}, el("a", { href: "#/" }, "All robots")));
    return;
  }
  try {
    const view = await found[1]();
    const [, name = ""] = found[0];
    await view.show(place, { id: decodeURIComponent(name), query: new URLSearchParams(query), signal });
    if (!signal.aborted) {
      document.title = `${place.querySelector("h1")?.textContent ?? ""} · specshield`;
      main.focus({ preventScroll: true });
    }
  } catch (error) {
    if (!signal.aborted) fail(place, error);
  }
}

function fail(place, error) {
  const told = error instanceof Problem ? error.told() : String(error);
  if (!(error instanceof Problem)) console.error(error);
  place.append(el("p", { class: "problem", role: "alert" }, told));
  say(told);
}

function mark(path) {
  const section = path === "/" || path === "/floor" ? "/sessions" : path.startsWith("/try") ? "/policies" : path;
  for (const link of document.querySelectorAll("nav a")) {
    const here = section.startsWith(link.getAttribute("href").slice(1));
    link.toggleAttribute("aria-current", here);
    if (here) link.setAttribute("aria-current", "page");
  }
}

addEventListener("hashchange", show);
show();
