// How the page lasts through times when the server is away: it asks again, and says so.

import { answeredAt, Problem } from "./api.js";
import { problem } from "./dom.js";
import { notice } from "./notice.js";

const AGAIN = 2000; // [ms] before it is asked again
const LONGEST = 60_000; // [ms] for one look; chosen by hand: a server that is cut off may seem to be busy for ever

export const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** Whether waiting may mend it: the server did not answer, has trouble of its own, or is asked too often. */
export const passes = (error) => error instanceof Problem && (!(error.status < 500) || [408, 429].includes(error.status));

/** What `work` gives, as soon as the server answers. */
export async function patiently(work, signal) {
  for (;;) {
    try {
      return await work();
    } catch (error) {
      if (signal.aborted || !passes(error)) throw error;
      notice(trouble(error));
    }
    await pause(AGAIN);
    signal.throwIfAborted();
  }
}

function trouble(error) {
  const last = answeredAt ? ` It last answered at ${answeredAt.toLocaleTimeString()}.` : "";
  if (error.type === "no-answer") return `The server does not answer; trying again.${last}`;
  return `The server has trouble; trying again. It says: ${error.told()}`;
}

/**
 * Calls `look`, with a signal that also ends what takes too long, every `wait` milliseconds while the page is
 * seen. What waiting cannot mend ends it, and is told in `place`.
 */
export async function again(look, wait, place, signal) {
  try {
    for (;;) {
      await pause(wait);
      if (signal.aborted) return;
      if (!document.hidden) await patiently(() => look(AbortSignal.any([signal, AbortSignal.timeout(LONGEST)])), signal);
    }
  } catch (error) {
    if (!signal.aborted) place.append(problem(error));
  }
}
