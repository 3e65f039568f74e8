// What happens to sessions, as it happens. A page that nobody sees keeps no connection: a browser has six.

import { events, Problem } from "./api.js";

/**
 * Calls `take` with each item of these sessions, and with {session, finished: true} at the end of one.
 * after: Map of id to the last step that is known, -1 for none; it is kept up to date.
 */
export async function follow(after, take, signal) {
  while (after.size && !signal.aborted) {
    await seen(signal);
    const stop = new AbortController();
    const hide = () => document.hidden && stop.abort();
    document.addEventListener("visibilitychange", hide);
    signal.addEventListener("abort", () => stop.abort());
    try {
      const places = [...after].map(([id, t]) => `session=${encodeURIComponent(`${id}:${t}`)}`);
      for await (const item of events(`v1/events?${places.join("&")}`, stop.signal)) {
        if (item.finished) after.delete(item.session);
        else after.set(item.session, item.t);
        take(item);
      }
    } catch (error) {
      if (error instanceof Problem && error.status < 500 && error.status !== 429) throw error;
    } finally {
      document.removeEventListener("visibilitychange", hide);
    }
    await new Promise((done) => setTimeout(done, 500));
  }
}

/** Resolves when the page can be seen. */
function seen(signal) {
  if (!document.hidden) return Promise.resolve();
  return new Promise((done) => {
    document.addEventListener("visibilitychange", done, { once: true, signal });
    signal.addEventListener("abort", done);
  });
}
