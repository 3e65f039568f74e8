// Chooses the step that is shown: always the newest one, or an earlier one by a slider or by playing.

import { button, el } from "../lib/dom.js";

const PACE = 80; // [ms] a step, when it is played

export class Replay {
  /** changed: called when another step is to be shown. */
  constructor(changed) {
    this.changed = changed;
    this.last = 0;
    this.t = 0;
    this.follows = true;
    this.slider = el("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "Step", oninput: () => this.go(Number(this.slider.value)) });
    this.play = button("Play", () => this.toggle());
    this.live = button("Newest", () => this.newest(), { "aria-pressed": "true" });
    this.told = el("span", { class: "number" }, "0");
    this.element = el("div", { class: "replay row", role: "group", "aria-label": "Replay" }, this.play, this.slider, this.told, this.live);
  }

  extend(t) {
    this.last = Math.max(this.last, t);
    this.slider.max = this.last;
    if (this.follows) this.t = this.last;
    this.mark();
  }

  go(t) {
    this.follows = false;
    this.t = Math.min(Math.max(t, 0), this.last);
    this.mark();
    this.changed();
  }

  newest() {
    this.stop();
    this.follows = true;
    this.t = this.last;
    this.mark();
    this.changed();
  }

  toggle() {
    if (this.timer) return this.stop();
    if (this.t >= this.last) this.t = 0;
    this.play.textContent = "Pause";
    this.timer = setInterval(() => {
      if (!this.element.isConnected || this.t >= this.last) this.stop();
      else this.go(this.t + 1);
    }, PACE);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = 0;
    this.play.textContent = "Play";
  }

  mark() {
    this.slider.value = this.t;
    this.told.textContent = `${this.t} / ${this.last}`;
    this.live.setAttribute("aria-pressed", String(this.follows));
  }
}
