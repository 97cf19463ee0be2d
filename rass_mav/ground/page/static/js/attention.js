// What needs attention: the banner, its sound and its notifications, and the log of what has begun and ended.

import { by, make, say } from "./dom.js";
import { clock } from "./words.js";

/** An alarm sounds this often until somebody acknowledges it, milliseconds. */
const AGAIN_MS = 4000;
/** Acknowledged conditions that are remembered. */
const MOST_KEPT = 500;

/** The banner. */
export class Attention {
  /** @param {import("./state.js").State} state */
  constructor(state) {
    this._state = state;
    this._known = new Set(kept("attention-known"));
    this._quiet = new Set(kept("attention-quiet"));
    this._sound = kept("attention-sound")[0] !== "off";
    this._audio = null;
    this._first = true;
    by("attention-ack").addEventListener("click", () => this._acknowledge());
    by("attention-sound").addEventListener("click", () => {
      this._sound = !this._sound;
      keep("attention-sound", [this._sound ? "on" : "off"]);
      this.show();
    });
    by("attention-notify").addEventListener("click", async () => {
      await Notification.requestPermission();
      this.show();
    });
    // A browser lets a page sound only after somebody has done something in it.
    for (const kind of ["pointerdown", "keydown"]) document.addEventListener(kind, () => this._allow(), { once: true });
    setInterval(() => this._ring(), AGAIN_MS);
  }

  /** Fill it. */
  show() {
    const { rows } = this._state.attention;
    by("attention").hidden = rows.length === 0;
    const list = by("attention-list");
    while (list.children.length > rows.length) list.lastElementChild.remove();
    rows.forEach((row, index) => {
      if (!list.children[index]) list.append(make("li", {}, make("b"), make("span"), make("small")));
      const line = list.children[index];
      const [level, text, act] = line.children;
      line.className = row.level;
      line.classList.toggle("quiet-row", row.keys.every((key) => this._quiet.has(key)));
      say(level, row.level === "note" ? "Note" : row.level === "alarm" ? "ALARM" : "Warning");
      say(text, row.text);
      say(act, row.do);
    });
    this._tellNew(rows);
    const ringing = this._ringing.length;
    by("attention-ack").hidden = ringing === 0;
    say(by("attention-ack"), `Acknowledge ${ringing === 1 ? "the alarm" : `${ringing} alarms`}`);
    const mute = this._sound && this._audio === null && ringing > 0;
    say(by("attention-sound"), !this._sound ? "Sound: off" : mute ? "Sound: click to allow" : "Sound: on");
    by("attention-sound").setAttribute("aria-pressed", String(this._sound));
    by("attention-notify").hidden = !("Notification" in window) || !isSecureContext || Notification.permission !== "default";
    this._showEvents();
  }

  /** Alarms that nobody has acknowledged. */
  get _ringing() {
    const alarms = this._state.attention.rows.filter((row) => row.level === "alarm");
    return alarms.flatMap((row) => row.keys).filter((key) => !this._quiet.has(key));
  }

  _tellNew(rows) {
    const now = new Set(rows.filter((row) => row.level === "alarm").flatMap((row) => row.keys));
    const fresh = rows.filter((row) => row.level === "alarm" && row.keys.some((key) => !this._known.has(key)));
    const over = [...this._known].filter((key) => !now.has(key));
    if (fresh.length) {
      const text = fresh.map((row) => `Alarm: ${row.text}.`).join(" ");
      say(by("attention-said"), text);
      this._notify(text);
    }
    if (!fresh.length && !over.length) return;
    // What is over and begins again is a new alarm.
    this._known = now;
    this._quiet = new Set([...this._quiet].filter((key) => now.has(key)));
    keep("attention-known", [...now].slice(0, MOST_KEPT));
    keep("attention-quiet", [...this._quiet].slice(0, MOST_KEPT));
    if (fresh.length) this._ring();
  }

  _acknowledge() {
    for (const key of this._ringing) this._quiet.add(key);
    keep("attention-quiet", [...this._quiet].slice(0, MOST_KEPT));
    this.show();
    by("attention-list").focus({ preventScroll: true });
  }

  _allow() {
    if (this._audio !== null || !("AudioContext" in window)) return;
    this._audio = new AudioContext();
    this._ring();
    if (this._state.frame !== null) this.show();
  }

  /** Two tones, if there is a reason. */
  _ring() {
    const audio = this._audio;
    if (!this._sound || audio === null || audio.state !== "running" || this._ringing.length === 0) return;
    [880, 660].forEach((hertz, index) => {
      const tone = new OscillatorNode(audio, { frequency: hertz });
      const volume = new GainNode(audio, { gain: 0.2 });
      const at = audio.currentTime + 0.25 * index;
      tone.connect(volume).connect(audio.destination);
      volume.gain.setTargetAtTime(0, at + 0.18, 0.02);
      tone.start(at);
      tone.stop(at + 0.25);
    });
    document.documentElement.dataset.rang = String(Number(document.documentElement.dataset.rang ?? 0) + 1);
  }

  _notify(text) {
    if (!("Notification" in window) || Notification.permission !== "granted") return;
    try {
      new Notification("rass-mav", { body: text, tag: "rass-mav-attention" });
    } catch {
      // Some phones allow them to service workers only. The banner and the sound remain.
    }
  }

  _showEvents() {
    const events = [...this._state.events].reverse();
    by("events-none").hidden = events.length > 0;
    const list = by("events");
    while (list.children.length > events.length) list.lastElementChild.remove();
    events.forEach(({ utc, begins, level, text }, index) => {
      if (!list.children[index]) list.append(make("li", {}, make("time"), make("span")));
      const line = list.children[index];
      line.className = begins ? level : "over";
      say(line.firstChild, utc === null ? "time unknown" : clock(utc, this._state.now));
      say(line.lastChild, text);
    });
  }
}

function kept(name) {
  try {
    const found = JSON.parse(localStorage.getItem(name) ?? "[]");
    return Array.isArray(found) ? found.map(String) : [];
  } catch {
    return [];
  }
}

function keep(name, values) {
  try {
    localStorage.setItem(name, JSON.stringify(values));
  } catch {
    // It holds until the page is closed.
  }
}
