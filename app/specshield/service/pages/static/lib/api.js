// The server's API, with the key that this tab was given.

const KEY = "specshield-key";

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

/** Asks until the server is ready and has its key; gives the response of a request that succeeded. */
export async function fetched(path, options = {}) {
  for (let wrong = false; ; ) {
    const key = sessionStorage.getItem(KEY);
    const headers = { ...options.headers, ...(key ? { Authorization: `Bearer ${key}` } : {}) };
    const response = await fetch(path, { ...options, headers });
    if (response.ok) {
      starting("");
      return response;
    }
    const told = await response.json().catch(() => ({ status: response.status, detail: response.statusText }));
    if (response.status === 401) {
      await askForKey(wrong || key !== null);
      wrong = true;
    } else if (told.type === "starting") {
      starting(`One moment: ${told.detail}.`);
      await wait(Number(response.headers.get("Retry-After")) || 1);
    } else throw new Problem(told);
  }
}

/** Says how far a server is that is not ready yet. */
function starting(text) {
  const place = document.getElementById("starting");
  if (place.textContent !== text) place.textContent = text;
}

/** JSON of an answer. json: a body to send; form: files to send. */
export async function ask(path, { json, form, ...options } = {}) {
  const sent =
    json !== undefined
      ? { method: "POST", body: JSON.stringify(json), headers: { "Content-Type": "application/json" } }
      : form !== undefined
        ? { method: "POST", body: form }
        : {};
  const response = await fetched(path, { ...sent, ...options });
  return response.status === 204 ? null : response.json();
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

export const picture = async (path, options) => (await fetched(path, options)).blob();

/** The data of server-sent events, as they come: by fetch, since an EventSource shows no key. */
export async function* events(path, signal) {
  const response = await fetched(path, { signal, headers: { Accept: "text/event-stream" } });
  if (!response.body) return;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  for (let rest = ""; ; ) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const data = block.split("\n").filter((line) => line.startsWith("data: "));
      if (data.length) yield JSON.parse(data.map((line) => line.slice(6)).join("\n"));
    }
  }
}

let asking = null;

/** Shows the dialog; all who wait for a key share it. */
function askForKey(wrong) {
  asking ??= new Promise((done) => {
    const dialog = document.getElementById("key");
    const form = dialog.querySelector("form");
    dialog.querySelector(".wrong").textContent = wrong ? "The server does not know this key." : "";
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    form.onsubmit = () => {
      sessionStorage.setItem(KEY, form.elements.key.value.trim());
      form.reset();
      asking = null;
      done();
    };
    dialog.showModal();
  });
  return asking;
}
