// Shows the view that the address names after '#', such as #/sessions/robot-1.

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

const ANEW = "specshield.anew"; // key of the tab's storage: the view for whose module the page was loaded again
const main = document.querySelector("main");
let leaving = new AbortController();

async function show() {
  leaving.abort(); // ends what the view before still does
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
      place.replaceChildren(); // removes what an earlier attempt has left
      await (await module(load, signal)).show(place, shown);
    }, signal);
  } catch (error) {
    if (!signal.aborted) fail(place, error);
  }
}

/** The view of a path, and the id in it; [] if there is no such view. */
function found(path) {
  const [match, load] = VIEWS.map(([form, load]) => [form.exec(path), load]).find(([match]) => match) ?? [];
  try {
    return match ? [load, decodeURIComponent(match[1] ?? "")] : [];
  } catch {
    return []; // the id is not encoded correctly
  }
}

/**
 * A view's module. If it cannot be loaded, the error does not say why, so the server is asked for a file. A browser
 * tries to load a module only once, until the page is loaded again.
 */
async function module(load, signal) {
  let loaded;
  try {
    loaded = await load();
  } catch (error) {
    await fetched("page/main.js", { cache: "no-store" });
    signal.throwIfAborted();
    if (sessionStorage.getItem(ANEW) === location.hash) throw error; // the page was loaded again in vain
    sessionStorage.setItem(ANEW, location.hash);
    location.reload();
    return new Promise(() => {}); // this page is about to go
  }
  sessionStorage.removeItem(ANEW);
  return loaded;
}

/** Once the view has its heading, gives it to the window as the title, and moves the focus into the view. */
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
