// Asks again while the server is away, and says so on the page.

import { answeredAt, Problem } from "./api.js";
import { problem } from "./dom.js";
import { notice } from "./notice.js";

const AGAIN = 2000; // [ms] before it asks again
const SHARE = 10; // Of the time that looks take, the pauses between them are at least so many times as long. By hand.
const LONGEST = 60_000; // [ms] for one look; chosen by hand: a connection that was cut off may stay silent for ever

export const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** Whether waiting may help: the server did not answer, had an error, or got too many requests. */
export const passes = (error) => error instanceof Problem && (!(error.status < 500) || [408, 429].includes(error.status));

/** The result of `work`, which is repeated until the server answers. */
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
 * Calls `look` every `wait` milliseconds, or less often if looks take long, while the page is visible, with a signal
 * that also ends a look that takes too long. An error against which waiting does not help ends this, and is shown in `place`.
 */
export async function again(look, wait, place, signal) {
  let took = 0; // [ms]
  const timed = async () => {
    const began = performance.now();
    await look(AbortSignal.any([signal, AbortSignal.timeout(LONGEST)]));
    took = performance.now() - began;
  };
  try {
    for (;;) {
      await pause(Math.max(wait, SHARE * took));
      if (signal.aborted) return;
      if (!document.hidden) await patiently(timed, signal);
    }
  } catch (error) {
    if (!signal.aborted) place.append(problem(error));
  }
}
