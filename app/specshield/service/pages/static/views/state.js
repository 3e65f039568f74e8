// A line that says whether the view is live, so that a lost connection does not look like a robot at rest.

import { el, write } from "../lib/dom.js";

export class State {
  constructor() {
    this.element = el("p", { class: "state", role: "status" });
    this.last = null; // when something was heard of a robot
  }

  heard() {
    this.last = new Date();
  }

  /** connected: as `follow` tells it. */
  live(connected) {
    if (connected) this.lost = null;
    else this.lost ??= new Date();
    const last = this.last ? `the last event came at ${time(this.last)}` : "no event had come since this page was opened";
    this.say(connected ? "live" : `not live: the connection was lost at ${time(this.lost)} and is tried again; ${last}`);
    this.element.classList.toggle("lost", !connected);
  }

  /** For good: nothing more is to be heard. */
  over(text) {
    this.say(text);
    this.element.classList.remove("lost");
  }

  say(text) {
    write(this.element, text);
  }
}

const time = (date) => date.toLocaleTimeString();
