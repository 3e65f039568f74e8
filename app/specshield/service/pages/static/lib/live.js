// Follows sessions while they are stepped. A hidden page closes its connection, since a browser has only six.

import { ask, events } from "./api.js";
import { passes, pause } from "./patience.js";

const AGAIN = 500; // [ms] before a stream that ended is asked for again
const SILENT = 40_000; // [ms] of silence after which a connection counts as lost: the server sends a comment every 15 s

/**
 * Calls `take` with each item of these sessions, and at the end of a session with {session, finished: true}, also
 * with `erased: true` if the session no longer exists, and `anew: true` if another session has its id now.
 * after: Map of id to the last known step, -1 for none; it is kept up to date. created: Map of id to the session's
 * `created_at`.
 * connected: called with true when the stream is open, and with false when it is lost and opened again.
 */
export async function follow(after, created, take, connected, signal) {
  const end = (item) => {
    after.delete(item.session);
    take(item);
  };
  const fate = (id, signal) => become(id, created.get(id), signal);
  let doubted = false; // whether a stream has ended, so that sessions may have been erased since
  while (after.size && !signal.aborted) {
    await seen(signal);
    const line = new Line(signal);
    const alive = () => {
      line.heard();
      connected(true);
    };
    try {
      for (const id of doubted ? [...after.keys()] : []) {
        const told = await fate(id, line.signal);
        if (told.erased) end({ session: id, finished: true, ...told });
      }
      if (!after.size) return;
      const places = [...after].map(([id, t]) => `session=${encodeURIComponent(`${id}:${t}`)}`);
      for await (const item of events(`v1/events?${places.join("&")}`, line.signal, alive)) {
        if (item.finished) end({ ...item, ...(await fate(item.session, line.signal)) });
        else {
          after.set(item.session, item.t);
          take(item);
        }
      }
      if (after.size) connected(false); // the server stops, say, or the key was revoked
    } catch (error) {
      if (line.silent || passes(error)) {
        if (!signal.aborted) connected(false);
      } else if (!line.signal.aborted) throw error;
    } finally {
      line.close();
    }
    doubted = true;
    await pause(AGAIN);
  }
}

/** A connection whose signal ends it when the view is left, the page is hidden, or it is silent for too long. */
class Line {
  constructor(leaving) {
    this.stop = new AbortController();
    this.signal = AbortSignal.any([leaving, this.stop.signal]);
    this.hide = () => document.hidden && this.stop.abort();
    document.addEventListener("visibilitychange", this.hide);
    this.heard();
  }

  heard() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.silent = true;
      this.stop.abort();
    }, SILENT);
  }

  close() {
    clearTimeout(this.timer);
    document.removeEventListener("visibilitychange", this.hide);
    this.stop.abort(); // ends a stream that is not read to its end
  }
}

/** Whether a session still exists: {} if so, else {erased: true}, with `anew: true` if another has its id. */
async function become(id, created, signal) {
  try {
    const session = await ask(`v1/sessions/${encodeURIComponent(id)}`, { signal });
    return session.created_at === created ? {} : { erased: true, anew: true };
  } catch (error) {
    if (error.status === 404) return { erased: true };
    throw error;
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
