// Which view is shown: the part of the address after '#', such as #/sessions/robot-1.

import { fetched, Problem } from "./lib/api.js";
import { el, problem } from "./lib/dom.js";
import { notice } from "./lib/notice.js";
import { patiently } from "./lib/patience.js";

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

const ANEW = "specshield.anew"; // in the tab: for which view the page began anew, to read its module
const main = document.querySelector("main");
let leaving = new AbortController();

async function show() {
  leaving.abort(); // what the view before still does
  leaving = new AbortController();
  const { signal } = leaving;
  const [path, query] = (location.hash.slice(1) || "/").split("?");
  mark(path);
  notice("");
  const [load, id] = found(path);
  const place = el("div", { class: "view" });
  main.replaceChildren(place);
  document.title = "specshield";
  headed(place, signal);
  if (!load) {
    place.append(el("h1", {}, "There is no such page"), el("p", {}, el("a", { href: "#/" }, "All robots")));
    return;
  }
  const shown = { id, query: new URLSearchParams(query), signal };
  try {
    await patiently(async () => {
      place.replaceChildren(); // what an attempt before has left
      await (await module(load, signal)).show(place, shown);
    }, signal);
  } catch (error) {
    if (!signal.aborted) fail(place, error);
  }
}

/** The view of a path, and what it is a view of. Nothing where there is none. */
function found(path) {
  const [match, load] = VIEWS.map(([form, load]) => [form.exec(path), load]).find(([match]) => match) ?? [];
  try {
    return match ? [load, decodeURIComponent(match[1] ?? "")] : [];
  } catch {
    return []; // an id that is written as none can be
  }
}

/**
 * A view's module. That it cannot be read tells nothing of the server, so that the server is asked. A browser
 * does not read a module again that it could not read once, unless the page begins anew.
 */
async function module(load, signal) {
  let loaded;
  try {
    loaded = await load();
  } catch (error) {
    await fetched("page/main.js", { cache: "no-store" });
    signal.throwIfAborted();
    if (sessionStorage.getItem(ANEW) === location.hash) throw error; // it did for this view, and still cannot
    sessionStorage.setItem(ANEW, location.hash);
    location.reload();
    return new Promise(() => {}); // this page is about to go
  }
  sessionStorage.removeItem(ANEW);
  return loaded;
}

/** As soon as the view has its heading, the window is called after it, and the keyboard is in the view. */
function headed(place, signal) {
  const changed = new MutationObserver(() => {
    const heading = place.querySelector("h1");
    if (!heading) return;
    changed.disconnect();
    document.title = `${heading.textContent} · specshield`;
    main.focus({ preventScroll: true });
  });
  changed.observe(place, { childList: true, subtree: true });
  signal.addEventListener("abort", () => changed.disconnect());
}

function fail(place, error) {
  if (!(error instanceof Problem)) console.error(error);
  if (!place.querySelector("h1")) place.append(el("h1", {}, "This cannot be shown"));
  place.append(problem(error));
}

function mark(path) {
  const section = path === "/" || path === "/floor" ? "/sessions" : path.startsWith("/try") ? "/policies" : path;
  for (const link of document.querySelectorAll("nav a")) {
    const here = section.startsWith(link.getAttribute("href").slice(1));
    link.toggleAttribute("aria-current", here);
    if (here) link.setAttribute("aria-current", "page");
  }
}

document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // what follows '#' is the view
  main.focus();
});
addEventListener("hashchange", show);
show();
