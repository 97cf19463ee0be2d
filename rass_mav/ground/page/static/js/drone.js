// The panel of one drone.

import { ReadingsChart } from "./chart.js";
import { by, make, say, tell } from "./dom.js";
import { riskSentence, sum } from "./panels.js";
import { age, clock, count, place, reading, unitName } from "./words.js";

/** What the server has more is asked for at most this often, milliseconds. */
const ASK_MS = 3000;
const MOST_RANGES = 20;

/** The panel. */
export class DronePanel {
  /** @param {import("./state.js").State} state */
  constructor(state, closed) {
    this._state = state;
    this._chart = new ReadingsChart(by("drone-readings"));
    this._asked = { id: null, arrived: -1, at: 0 };
    this._more = null;
    by("drone-close").addEventListener("click", closed);
    by("drone").addEventListener("keydown", (event) => {
      if (event.key === "Escape") closed();
    });
  }

  /** Open it, and go there. */
  open() {
    this._more = null;
    this._asked = { id: null, arrived: -1, at: 0 };
    this._chart.none();
    this.show();
    by("drone").focus({ preventScroll: true });
    by("drone").scrollIntoView({ block: "nearest" });
  }

  /** New colours. */
  repaint() {
    this._chart.clear();
    this._showMore();
  }

  /** Fill it. */
  show() {
    const id = this._state.chosen;
    by("drone").hidden = id === null;
    if (id === null) return;
    const figures = this._state.figures(id);
    say(by("drone-title"), `${figures?.base ? "Base" : "Drone"} ${id}`);
    if (figures === undefined) {
      tell(by("drone-facts"), [["State", "not heard yet at this time"]]);
      by("drone-neighbours").replaceChildren();
      return;
    }
    this._facts(figures);
    this._neighbours(figures);
    this._ask(id);
  }

  _facts(figures) {
    const now = this._state.now;
    const ago = (utc) => `${age(now - utc)} ago (${clock(utc, now)})`;
    const lost = figures.lost === null ? "not known for earlier times" : Object.entries(figures.lost).map(([why, n]) => `${count(n)} ${why}`).join(", ") || "0";
    const facts = [
      ["Heard", figures.heard_by ? `by drone ${figures.heard_by[0]}, ${ago(figures.heard_by[1])}; nothing has arrived` : figures.heard === null ? "never" : ago(figures.heard)],
      ["Place", placeText(figures, ago)],
      ["Risk", figures.risk === null ? "unknown: the worst is assumed" : figures.risk.toFixed(3)],
      ["Data", `${count(figures.created)} created at least, ${count(figures.arrived)} arrived, ${count(figures.missing)} missing`],
      ["Lost", lost],
    ];
    if (figures.highest !== null) {
      const { reading: value, unit, utc, place: where } = figures.highest;
      facts.push(["Highest reading", `${reading(value)} ${unitName(unit)}, ${clock(utc, now)}${where ? `, at ${place(where)}` : ""}`]);
    }
    if (figures.status_utc === null) {
      facts.push(["Status", "none received: what it holds is unknown"]);
    } else {
      facts.push(
        ["Status", `${ago(figures.status_utc)}; newer data unknown`],
        ["In custody", `${count(figures.held)}, ${count(figures.alone)} of them with no other copy`],
        ["If it fails now", figures.base ? "is a base" : riskSentence(figures, now)],
        ["Replicas", `${count(figures.replicas)} for others`],
        ["Free space", figures.free === null ? "no limit" : `${count(figures.free)} data`],
        ["Route", figures.base ? "is a base" : figures.hops === null ? "none" : `${figures.hops} ${figures.hops === 1 ? "hop" : "hops"} to a base`],
        ["Next hop", figures.base ? "none: is a base" : figures.next_hop === null ? "none known" : `node ${figures.next_hop}`],
        ["Battery", figures.battery === null ? "unknown" : `${figures.battery} %`],
      );
    }
    tell(by("drone-facts"), facts);
    const notes = {
      unknown: "It may have created data that no node knows of: its numbers were lost in a crash.",
      damaged: "It had a damaged store, and data in it may be lost.",
    };
    by("drone-note").hidden = figures.store_faults.length === 0;
    say(by("drone-note"), figures.store_faults.map((fault) => notes[fault] ?? fault).join(" "));
  }

  _neighbours(figures) {
    const neighbours = [...(figures.neighbours ?? [])].sort((one, other) => other[1] - one[1]);
    const target = by("drone-neighbours");
    if (neighbours.length === 0) {
      target.replaceChildren(make("p", {}, figures.status_utc === null ? "Unknown." : "None."));
      return;
    }
    const rows = neighbours.map(([id, quality]) =>
      make("tr", {}, make("td", {}, String(id)), make("td", {}, `${Math.round(quality * 100)} %`), make("td", {}, id === figures.next_hop ? "next hop" : "")),
    );
    const head = make("tr", {}, ...["Node", "Beacons heard", "Route"].map((name) => make("th", { scope: "col" }, name)));
    target.replaceChildren(make("table", {}, make("thead", {}, head), make("tbody", {}, ...rows)));
  }

  async _ask(id) {
    const arrived = this._state.drones.get(id)?.arrived ?? 0;
    const same = this._asked.id === id;
    if (same && (this._asked.arrived === arrived || Date.now() - this._asked.at < ASK_MS)) return;
    this._asked = { id, arrived, at: Date.now() };
    try {
      const answer = await fetch(`/api/drone/${id}`);
      if (answer.ok && this._state.chosen === id) {
        this._more = await answer.json();
        this._showMore();
      }
    } catch {
      // The feed says that the server is gone.
    }
  }

  _showMore() {
    if (this._more === null) return;
    const [found] = Object.entries(this._more.readings).sort((one, other) => other[1].utc.length - one[1].utc.length);
    if (found === undefined) this._chart.none();
    else this._chart.show(...found);
    const ranges = this._more.missing_numbers;
    const shown = ranges.slice(-MOST_RANGES).map(({ epoch, first, last }) => `${epoch}-${first}${first === last ? "" : `..${last}`}`);
    const before = ranges.length > MOST_RANGES ? `; and ${ranges.length - MOST_RANGES} earlier ranges` : "";
    say(by("drone-missing"), shown.length ? `${shown.join(", ")}${before}. As known now.` : "None.");
  }
}

/** Where it is, and how that is known. */
function placeText({ place: at, placed, how }, ago) {
  if (at === null) return "unknown";
  if (how === "set") return `${place(at)}, as configured`;
  if (how === "guess") return `${place(at)}: a guess, taken from the first hop to it; set base.place in its configuration`;
  return `${place(at)}, ${ago(placed)}`;
}
