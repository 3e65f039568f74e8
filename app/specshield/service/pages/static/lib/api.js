// Calls the server's API with the key that was entered in this tab.

import { askForKey, key } from "./key.js";
import { notice } from "./notice.js";

/** When the server last answered; null before its first answer. */
export let answeredAt = null;

/** A problem document (RFC 9457) as an error. */
export class Problem extends Error {
  constructor(told) {
    super(told.detail ?? told.title ?? "the server does not answer");
    Object.assign(this, told);
  }

  /** One sentence: where, what was wrong, what is valid. */
  told() {
    const where = this.path ? `${this.path}: ` : "";
    const expected = this.expected && !this.message.includes(this.expected) ? ` Expected: ${this.expected}.` : "";
    return `${where}${this.message}.${expected}`;
  }
}

const wait = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));

/** Waits for something from the network. If it does not come, or not all of it, throws a Problem. */
async function arrived(coming) {
  try {
    return await coming;
  } catch (error) {
    if (error.name === "AbortError" || error instanceof Problem) throw error;
    throw new Problem({ type: "no-answer", detail: "the server does not answer" });
  }
}

/** Sends a request until the server is ready and has its key. Returns a successful response. */
export async function fetched(path, options = {}) {
  for (let wrong = false; ; ) {
    const shown = key();
    const headers = { ...options.headers, ...(shown ? { Authorization: `Bearer ${shown}` } : {}) };
    const response = await arrived(fetch(path, { ...options, headers }));
    if (response.ok) {
      answeredAt = new Date();
      notice("");
      return response;
    }
    const told = await response.json().catch(() => ({ detail: `the server answered ${response.status} ${response.statusText}`.trim() }));
    if (response.status === 401) {
      await askForKey(wrong || shown !== null);
      wrong = true;
    } else if (told.type === "starting") {
      notice(`One moment: ${told.detail}.`);
      await wait(Number(response.headers.get("Retry-After")) || 1);
    } else throw new Problem({ ...told, status: response.status });
  }
}

/** Sends a request and returns the answer's JSON. json: a body to send. form: files to send. */
export async function ask(path, { json, form, ...options } = {}) {
  const sent =
    json !== undefined
      ? { method: "POST", body: JSON.stringify(json), headers: { "Content-Type": "application/json" } }
      : form !== undefined
        ? { method: "POST", body: form }
        : {};
  const response = await fetched(path, { ...sent, ...options });
  return response.status === 204 ? null : arrived(response.json());
}

/** Every item of a list. */
export async function all(path, options) {
  const items = [];
  for (let cursor = ""; cursor !== null; ) {
    const page = await ask(`${path}?limit=1000${cursor && `&cursor=${encodeURIComponent(cursor)}`}`, options);
    items.push(...page.items);
    cursor = page.next;
  }
  return items;
}

export const picture = async (path, options) => arrived((await fetched(path, options)).blob());

/**
 * The data of server-sent events as they come, by fetch, since an EventSource cannot send a key.
 * alive: called whenever the server has sent something, even a comment.
 */
export async function* events(path, signal, alive) {
  const response = await fetched(path, { signal, headers: { Accept: "text/event-stream" } });
  alive();
  if (!response.body) return;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  for (let rest = ""; ; ) {
    const { done, value } = await arrived(reader.read());
    if (done) return;
    alive();
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const data = block.split("\n").filter((line) => line.startsWith("data: "));
      if (data.length) yield JSON.parse(data.map((line) => line.slice(6)).join("\n"));
    }
  }
}
