// The table of drones: sorted and filtered, and cheap with some hundred rows.

import { riskColours } from "./colours.js";
import { by, make, say } from "./dom.js";
import { riskRange, riskSentence, sum } from "./panels.js";
import { age, count } from "./words.js";

const LEVELS = { note: 1, warning: 2, alarm: 3 };

/**
 * A column: its heading, what it is sorted by (null: unknown, which comes last), which way first, and what it shows: a
 * text, a smaller one below it, and a sentence for those who point at it or hear it.
 * @typedef {object} Column
 * @property {string} name
 * @property {boolean} [falls] the highest first
 * @property {(figures: any, state: import("./state.js").State) => number | null} key
 * @property {(figures: any, state: import("./state.js").State) => [string, string?, string?]} text
 */

/** @type {Column[]} The first is a button, of the drone's number. */
const COLUMNS = [
  { name: "Drone", key: ({ drone }) => drone, text: ({ drone, base }) => [String(drone), base ? "base" : ""] },
  {
    name: "Level",
    falls: true,
    key: ({ drone }, state) => LEVELS[state.level(drone)] ?? 0,
    text: ({ drone }, state) => [state.level(drone) ?? ""],
  },
  {
    name: "Heard",
    falls: true,
    key: ({ heard, heard_by: by }) => (by || heard === null ? Infinity : -heard),
    text: ({ heard, heard_by: by }, { now }) => (by ? [`by ${by[0]}`, "no data"] : [heard === null ? "never" : age(now - heard)]),
  },
  {
    name: "Battery",
    key: ({ battery }) => battery ?? null,
    text: ({ battery }) => [typeof battery === "number" ? `${battery} %` : "?"],
  },
  { name: "Store", falls: true, key: fullness, text: storeText },
  { name: "Risk", falls: true, key: ({ risk }) => risk ?? Infinity, text: ({ risk }) => [risk === null ? "?" : risk.toFixed(2)] },
  {
    name: "Arrived",
    falls: true,
    key: ({ arrived }) => arrived,
    text: ({ drone, arrived, created }, state) => [count(arrived), `of ${count(created)}${state.silent(drone) ? "+" : ""}`],
  },
  {
    name: "Missing",
    falls: true,
    key: ({ missing }) => missing,
    text: ({ missing, lost, store_faults }) => [
      count(missing),
      lost === null || (sum(lost) === 0 && store_faults.length === 0) ? "" : `${count(sum(lost))}${store_faults.length ? " or more" : ""} lost`,
    ],
  },
  {
    name: "Lost if it fails now",
    falls: true,
    key: ({ base, at_risk: data }) => (base ? -1 : data),
    text: (figures, { now }) => {
      if (figures.base) return [""];
      if (figures.at_risk === null) return ["unknown", "no status"];
      return [riskRange(figures), `${age(now - figures.status_utc)} ago`, `If it fails now: ${riskSentence(figures, now)}`];
    },
  },
];

/** How full a store is, 0..1; without a limit 0. */
function fullness({ status_utc: utc, held, free }) {
  if (utc === null) return null;
  return free === null || held + free === 0 ? 0 : held / (held + free);
}

function storeText(figures) {
  const { status_utc: utc, held, free } = figures;
  if (utc === null) return ["?"];
  // A part of a datum more is not full yet.
  return free === null ? [count(held), "no limit"] : [`${Math.floor(100 * fullness(figures))} %`, `${count(held)} data`];
}

/** The table with its filter. */
export class DroneTable {
  /**
   * @param {import("./state.js").State} state
   * @param {(id: number) => void} choose called when somebody chooses a drone
   */
  constructor(state, choose) {
    this._state = state;
    this._choose = choose;
    this._by = 0;
    this._falls = false;
    /** By drone. @type {Map<number, Row>} */
    this._rows = new Map();
    /** The rows that are shown, in order. @type {number[]} */
    this._order = [];
    this._body = by("drones").tBodies[0];
    // Ages grow every second, and laying out some hundred rows takes long: only those that somebody can see follow.
    this._watch = new IntersectionObserver((changes) => this._scrolled(changes), { root: by("drones").parentElement, rootMargin: "200px" });
    this._heads = COLUMNS.map((column, index) => this._head(column, index));
    by("drones").tHead.rows[0].replaceChildren(...this._heads);
    for (const id of ["drones-filter", "drones-attention"]) by(id).addEventListener("input", () => this.show());
    this._mark();
  }

  _head({ name, falls }, index) {
    const button = make("button", { type: "button" }, `${name} `, make("span", { "aria-hidden": "true" }));
    button.addEventListener("click", () => {
      this._falls = this._by === index ? !this._falls : falls === true;
      this._by = index;
      this._mark();
      this.show();
    });
    return make("th", { scope: "col" }, button);
  }

  /** Say in the head how the rows are sorted. */
  _mark() {
    this._heads.forEach((head, index) => {
      const sorted = index === this._by;
      if (sorted) head.setAttribute("aria-sort", this._falls ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
      say(head.firstChild.lastChild, sorted ? (this._falls ? "\u25bc" : "\u25b2") : "");
    });
  }

  _scrolled(changes) {
    for (const { target, isIntersecting } of changes) {
      const row = this._rows.get(Number(target.dataset.row));
      if (row !== undefined) row.seen = isIntersecting;
    }
    this.show();
  }

  /**
   * Fill it. Only what has changed is written: reading and writing the page is what takes long.
   * @param {boolean} [whole] rows that nobody can see, too: for paper
   */
  show(whole = false) {
    if (this._state.frame === null) return;
    const state = this._state;
    const all = state.shown;
    const wanted = this._sorted(all.filter((figures) => this._admits(figures)));
    const order = wanted.map(({ drone }) => drone);
    for (const figures of wanted) {
      if (!this._rows.has(figures.drone)) this._add(figures.drone);
      const row = this._rows.get(figures.drone);
      if (row.seen || whole) row.fill(figures, state);
    }
    if (order.length !== this._order.length || order.some((id, index) => id !== this._order[index])) this._arrange(order);
    const known = new Set(all.map(({ drone }) => drone));
    for (const [id, { element }] of this._rows) {
      if (known.has(id)) continue;
      this._watch.unobserve(element);
      this._rows.delete(id);
    }
    say(by("drones-count"), order.length === all.length ? `${count(all.length)} shown` : `${count(order.length)} of ${count(all.length)} shown`);
  }

  _add(id) {
    const row = new Row(id, this._choose);
    this._rows.set(id, row);
    this._watch.observe(row.element);
  }

  _admits({ drone, base }) {
    const level = this._state.level(drone);
    // At an earlier time nothing is known to need attention.
    if (by("drones-attention").checked && this._state.past === null && level === undefined) return false;
    const words = [String(drone), base ? "base" : "drone", level ?? ""];
    const asked = by("drones-filter").value.toLowerCase().split(/[\s,]+/).filter(Boolean);
    return asked.length === 0 || asked.some((one) => words.some((word) => (/^\d+$/.test(one) ? word === one : word.startsWith(one))));
  }

  _sorted(figures) {
    const key = (one) => COLUMNS[this._by].key(one, this._state);
    const sign = this._falls ? -1 : 1;
    const keyed = figures.map((one) => ({ one, key: key(one) }));
    keyed.sort((left, right) => {
      if (left.key === right.key) return left.one.drone - right.one.drone;
      if (left.key === null || right.key === null) return left.key === null ? 1 : -1;
      return left.key < right.key ? -sign : sign;
    });
    return keyed.map(({ one }) => one);
  }

  /** Put the rows in this order; the focus stays where it is. */
  _arrange(order) {
    const focused = document.activeElement;
    const kept = new Set(order);
    for (const id of this._order) if (!kept.has(id)) this._rows.get(id)?.element.remove();
    order.forEach((id, index) => {
      const { element } = this._rows.get(id);
      if (this._body.rows[index] !== element) this._body.insertBefore(element, this._body.rows[index] ?? null);
    });
    this._order = order;
    if (focused !== document.activeElement && this._body.contains(focused)) focused.focus({ preventScroll: true });
  }
}

/** A row of the table: its texts are remembered, so that only others are written. */
class Row {
  constructor(drone, choose) {
    this._button = make("button", { type: "button", "data-drone": String(drone) });
    this._button.addEventListener("click", () => choose(drone));
    this._cells = COLUMNS.map((_, index) => [index === 0 ? this._button : document.createTextNode(""), make("small")]);
    this._texts = COLUMNS.map(() => ["", "", ""]);
    this._look = "";
    /** Whether somebody may see it. */
    this.seen = true;
    this.element = make("tr", { "data-row": String(drone) }, ...this._cells.map((parts) => make("td", {}, ...parts)));
  }

  fill(figures, state) {
    COLUMNS.forEach(({ text }, index) => {
      const [large, small = "", sentence = ""] = text(figures, state);
      const [told, told_small, told_sentence] = this._texts[index];
      if (large !== told) this._cells[index][0].textContent = large;
      if (small !== told_small) this._cells[index][1].textContent = small;
      if (sentence !== told_sentence) this.element.cells[index].title = sentence;
      this._texts[index] = [large, small, sentence];
    });
    const level = state.level(figures.drone) ?? "";
    const chosen = figures.drone === state.chosen;
    const look = `${level} ${chosen} ${figures.risk} ${figures.base}`;
    if (look === this._look) return;
    this._look = look;
    this.element.className = [level, chosen ? "chosen" : ""].filter(Boolean).join(" ");
    const [ground, ink] = riskColours(figures.risk);
    this._button.style.background = ground;
    this._button.style.color = ink;
    this._button.setAttribute("aria-label", `${figures.base ? "Base" : "Drone"} ${figures.drone}: open its panel`);
  }
}
