// The time that is shown: now, or an earlier time, or one that runs.

import { by, say } from "./dom.js";
import { clock } from "./words.js";

/** Milliseconds between two steps while the time runs. */
const STEP_MS = 250;

/** The slider with its buttons. */
export class Slider {
  /**
   * @param {import("./state.js").State} state
   * @param {() => void} changed called when another time is shown
   */
  constructor(state, changed) {
    this._state = state;
    this._changed = changed;
    this._at = null;
    this._wanted = null;
    this._busy = false;
    this._timer = 0;
    by("slider").addEventListener("input", () => {
      const time = this._begin + Number(by("slider").value);
      this._pause();
      this._go(time);
    });
    by("play").addEventListener("click", () => (this._timer ? this._pause() : this._play()));
    by("live").addEventListener("click", () => this.live());
  }

  get _begin() {
    return this._state.frame?.begin ?? 0;
  }

  get _end() {
    return this._state.frame?.end ?? 0;
  }

  /** Show the present again. */
  live() {
    this._pause();
    this._at = this._wanted = null;
    this._state.past = null;
    this._changed();
  }

  _play() {
    if (this._at === null || this._at >= this._end) this._at = this._begin;
    this._timer = setInterval(() => this._step(), STEP_MS);
    this.show();
    this._go(this._at);
  }

  _pause() {
    clearInterval(this._timer);
    this._timer = 0;
    this.show();
  }

  _step() {
    // Where the server is slow, the time runs slower, instead of in jumps.
    if (this._busy) return;
    const next = this._at + (STEP_MS / 1000) * Number(by("speed").value);
    if (next >= this._end) this.live();
    else this._go(next);
  }

  async _go(time) {
    this._at = this._wanted = time;
    this.show();
    if (this._busy) return;
    this._busy = true;
    try {
      while (this._wanted !== null) {
        const wanted = this._wanted;
        this._wanted = null;
        const answer = await fetch(`/api/at?t=${wanted}`);
        if (!answer.ok) break;
        const past = await answer.json();
        // Meanwhile somebody may have asked for the present.
        if (this._at === null) break;
        this._state.past = past;
        this._changed();
      }
    } catch {
      // The feed says that the server is gone.
    } finally {
      this._busy = false;
    }
  }

  /** Draw it. */
  show() {
    const slider = by("slider");
    const length = Math.max(Math.ceil(this._end - this._begin), 1);
    slider.max = String(length);
    slider.disabled = this._state.frame?.begin == null;
    slider.value = String(this._at === null ? length : this._at - this._begin);
    const text = this._state.frame?.begin == null ? "-" : clock(this._at ?? this._end);
    say(by("clock"), this._at === null && text !== "-" ? `until ${text}` : text);
    slider.setAttribute("aria-valuetext", text);
    by("live").setAttribute("aria-pressed", String(this._at === null));
    by("play").setAttribute("aria-pressed", String(this._timer !== 0));
    say(by("play"), this._timer ? "Pause" : "Play");
  }
}
