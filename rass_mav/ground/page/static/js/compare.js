// The readings of several drones in one chart.

import { COMPARED, ComparisonChart } from "./chart.js";
import { by, make, say } from "./dom.js";
import { colour } from "./theme.js";
import { count, reading, unitName } from "./words.js";

/** The server is asked at most this often, milliseconds, and only while somebody can see the chart. */
const ASK_MS = 5000;
/** So many drones are in the chart at first: those with the highest readings. */
const FIRST = 4;

/** The panel. */
export class Comparison {
  /** @param {import("./state.js").State} state */
  constructor(state) {
    this._state = state;
    this._chart = new ComparisonChart(by("compare-chart"));
    /** The drones in the chart, in the order of their colours; null: nobody has chosen any. @type {number[] | null} */
    this._drones = null;
    this._unit = null;
    this._found = {};
    this._asked = { what: "", at: 0 };
    this._seen = false;
    this._options = "";
    new IntersectionObserver(([{ isIntersecting }]) => {
      this._seen = isIntersecting;
      this.show();
    }).observe(by("compare"));
    by("compare-add").addEventListener("change", () => {
      const id = Number(by("compare-add").value);
      by("compare-add").value = "";
      this._choose([...this._shown, id]);
    });
    by("compare-unit").addEventListener("change", () => {
      this._unit = by("compare-unit").value;
      this.show();
    });
    by("compare-log").addEventListener("change", () => this._draw());
  }

  /** Drones that are in the chart. */
  get _shown() {
    return this._drones ?? [];
  }

  get _most() {
    return Math.min(this._state.frame?.compared ?? 1, COMPARED);
  }

  _choose(drones) {
    this._drones = [...new Set(drones)].slice(0, this._most);
    this._asked.at = 0;
    this.show();
  }

  /** New colours. */
  repaint() {
    this._chart.clear();
    this._options = "";
    this.show();
  }

  /** Fill it. */
  show() {
    const { frame, units } = this._state;
    if (frame === null) return;
    by("compare").hidden = units.length === 0;
    if (units.length === 0) return;
    if (!units.includes(this._unit)) this._unit = units[0];
    if (this._drones === null && !frame.behind) this._drones = this._highest();
    this._controls();
    this._ask();
  }

  /** The drones with the highest readings. */
  _highest() {
    const found = [...this._state.drones.values()].filter(({ highest }) => highest?.unit === this._unit);
    found.sort((one, other) => other.highest.reading - one.highest.reading);
    return found.slice(0, FIRST).map(({ drone }) => drone).sort((one, other) => one - other);
  }

  _controls() {
    const others = [...this._state.drones.values()].filter(({ drone, highest }) => highest !== null && !this._shown.includes(drone));
    const ids = others.map(({ drone }) => drone).sort((one, other) => one - other);
    const options = JSON.stringify([this._unit, this._state.units, this._shown, ids]);
    if (options === this._options) return;
    this._options = options;
    const { units } = this._state;
    by("compare-unit").replaceChildren(...units.map((unit) => make("option", { value: unit }, unitName(unit))));
    by("compare-unit").value = this._unit;
    by("compare-unit-row").hidden = units.length < 2;
    const full = this._shown.length >= this._most;
    const first = full ? `${this._most} drones at most` : "Add a drone";
    by("compare-add").replaceChildren(make("option", { value: "" }, first), ...ids.map((id) => make("option", { value: String(id) }, `Drone ${id}`)));
    by("compare-add").disabled = full || ids.length === 0;
    by("compare-drones").replaceChildren(...this._shown.map((id, index) => this._chip(id, index)));
  }

  _chip(id, index) {
    const swatch = make("i", { "aria-hidden": "true" });
    swatch.style.background = colour(`drone-${index + 1}`);
    const chip = make("button", { type: "button", "aria-label": `Remove drone ${id} from the chart` }, swatch, `Drone ${id}`, make("span", { "aria-hidden": "true" }, "\u00d7"));
    chip.addEventListener("click", () => {
      this._choose(this._shown.filter((other) => other !== id));
      (by("compare-drones").children[Math.min(index, this._shown.length - 1)] ?? by("compare-add")).focus();
    });
    return make("li", {}, chip);
  }

  async _ask() {
    const drones = this._shown;
    const arrived = drones.map((id) => this._state.drones.get(id)?.arrived ?? 0);
    const what = JSON.stringify([drones, arrived]);
    if (drones.length === 0 || (!this._seen && this._asked.what !== "") || this._asked.what === what || Date.now() - this._asked.at < ASK_MS) {
      this._draw();
      return;
    }
    this._asked = { what, at: Date.now() };
    try {
      const answer = await fetch(`/api/readings?drones=${drones.join(",")}`);
      if (answer.ok) this._found = (await answer.json()).drones;
    } catch {
      // The feed says that the server is gone.
    }
    this._draw();
  }

  _draw() {
    const until = this._state.past === null ? Infinity : this._state.past.at;
    const log = by("compare-log").checked;
    const series = this._shown.map((id) => {
      const { utc, value } = this._found[id]?.[this._unit] ?? { utc: [], value: [] };
      const end = utc.findIndex((time) => time > until);
      return { id, utc: end < 0 ? utc : utc.slice(0, end), value: end < 0 ? value : value.slice(0, end) };
    });
    const values = series.flatMap(({ value }) => value).filter((value) => !log || value > 0);
    const left = series.reduce((sum, { value }) => sum + value.length, 0) - values.length;
    if (values.length === 0) this._chart.none(this._shown.length ? "No readings." : "No drone selected.");
    else this._chart.show(this._unit, series, log);
    const range = values.length ? `${reading(values.reduce((a, b) => Math.min(a, b)))} to ${reading(values.reduce((a, b) => Math.max(a, b)))} ${unitName(this._unit)}.` : "";
    say(by("compare-note"), left ? `${range} ${count(left)} readings of 0 or less cannot be shown on a logarithmic scale.` : range);
  }
}
