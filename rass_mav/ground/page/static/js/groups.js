// Marks that would hide each other share one, with their number and the most severe level among them.

import { riskColours } from "./colours.js";
import { make, say } from "./dom.js";

/** Marks, and shared marks, do not hide each other if they are farther apart than the sum of these, pixels. */
const [MARK_PX, GROUP_PX] = [13, 22];
/** Cells in which others are looked for, pixels: no two that are farther apart than two of these hide each other. */
const CELL_PX = 2 * GROUP_PX;
/** How often groups are joined because they have come near each other. */
const MOST_TURNS = 8;
/** A shared mark keeps this distance from a base, pixels. */
const CLEAR_PX = 34;
/** A shared mark in view is so far from the edge of the map, pixels: half of its size, with its border. */
const EDGE_PX = 20;
/** Farther in there is nothing more to see: from there on, marks are spread around their place. */
const MOST_ZOOM = 20;
/** The distance between marks that are spread, pixels. */
const SPREAD_PX = 34;
/** Drones that are named to somebody who does not see the map. */
const MOST_NAMED = 8;
const LEVELS = ["alarm", "warning", "note", undefined];

/**
 * @typedef {object} Item
 * @property {number} id
 * @property {any} mark of Leaflet
 * @property {number[]} place latitude and longitude
 * @property {boolean} alone it never shares a mark
 * @property {boolean} base
 * @property {string | undefined} level
 * @property {number | null} risk null: unknown
 */

/** The shared marks of a map. */
export class Groups {
  constructor(map) {
    this._map = map;
    /** @type {Item[]} */
    this._items = [];
    /** Shared marks by the first of their drones. @type {Map<number, any>} */
    this._marks = new Map();
    /** The drones that are spread. @type {Set<number>} */
    this._spread = new Set();
    this._rays = L.layerGroup().addTo(map);
    this._focus = null;
    map.on("zoomstart", () => this._spread.clear());
    map.on("zoomend moveend", () => this.arrange(this._items));
    map.on("click", () => this.fold());
    map.getContainer().addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.fold();
    });
  }

  /** Put spread marks back. */
  fold() {
    if (this._spread.size === 0) return;
    this._spread.clear();
    this.arrange(this._items);
  }

  /** Show each of them, alone or in a group. @param {Item[]} items */
  arrange(items) {
    this._items = items;
    const active = document.activeElement;
    const at = new Map(items.map((item) => [item, this._map.latLngToLayerPoint(item.place)]));
    const bases = items.filter(({ base }) => base).map((item) => at.get(item));
    const found = units(items.filter(({ alone, id }) => !alone && !this._spread.has(id)), at, bases);
    const single = found.filter((unit) => unit.items.length === 1).flatMap((unit) => unit.items);
    for (const item of [...single, ...items.filter(({ alone }) => alone)]) this._alone(item, item.place);
    this._scatter(items.filter(({ alone, id }) => !alone && this._spread.has(id)));
    const seen = new Set();
    for (const { items: group, point } of found) {
      if (group.length === 1) continue;
      group.sort((one, other) => one.id - other.id);
      seen.add(group[0].id);
      this._together(group, point, active);
    }
    for (const [id, shared] of this._marks) {
      if (seen.has(id)) continue;
      shared.mark.remove();
      this._marks.delete(id);
    }
    this._refocus();
  }

  /** What is drawn where, for labels that have to keep clear of it: middles and radii, pixels. */
  get obstacles() {
    const shown = this._items.filter(({ mark }) => !mark.getElement().classList.contains("grouped")).map(({ mark }) => [mark, 16]);
    const shared = [...this._marks.values()].map(({ mark }) => [mark, 20]);
    return [...shown, ...shared].map(([mark, radius]) => [this._map.latLngToLayerPoint(mark.getLatLng()), radius]);
  }

  _alone({ mark }, place) {
    mark.setLatLng(place);
    mark.getElement().classList.remove("grouped");
  }

  /** Around their place, as the seeds of a sunflower. */
  _scatter(items) {
    this._rays.clearLayers();
    if (items.length === 0) return;
    const from = middle(items.map(({ place }) => this._map.latLngToLayerPoint(place)));
    items.forEach((item, index) => {
      const angle = index * Math.PI * (3 - Math.sqrt(5));
      const far = SPREAD_PX * 0.62 * Math.sqrt(index + 1.5);
      const place = this._map.layerPointToLatLng(from.add([far * Math.cos(angle), far * Math.sin(angle)]));
      this._alone(item, place);
      L.polyline([item.place, place], { color: "#6b7480", weight: 1, interactive: false }).addTo(this._rays);
    });
  }

  /** @param {Item[]} group */
  _together(group, point, active) {
    const first = group[0].id;
    const place = this._map.layerPointToLatLng(this._whole(point));
    let shared = this._marks.get(first);
    if (shared === undefined) {
      const icon = L.divIcon({ className: "mark group", html: make("div", {}, make("span", { class: "dot" })), iconSize: [34, 34] });
      const mark = L.marker(place, { icon, keyboard: true, zIndexOffset: 200 }).addTo(this._map);
      shared = { mark, group };
      this._marks.set(first, shared);
      const open = (byKey) => this._open(this._marks.get(first).group, byKey);
      mark.on("click", () => open(false));
      mark.getElement().addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        open(true);
      });
    }
    shared.group = group;
    shared.mark.setLatLng(place);
    paint(shared.mark.getElement(), group);
    for (const { mark, id } of group) {
      // The focus goes with a drone into its group.
      if (mark.getElement() === active) this._focus = id;
      mark.getElement().classList.add("grouped");
    }
  }

  /** The point for a shared mark that is in view, so that none of it is beyond the edge. */
  _whole(point) {
    const at = this._map.layerPointToContainerPoint(point);
    const size = this._map.getSize();
    if (at.x < 0 || at.y < 0 || at.x > size.x || at.y > size.y) return point;
    const within = (value, most) => Math.max(EDGE_PX, Math.min(value, most - EDGE_PX));
    return this._map.containerPointToLayerPoint(L.point(within(at.x, size.x), within(at.y, size.y)));
  }

  /** Come nearer until they are apart; where that is no use, spread them. */
  _open(group, byKey) {
    const places = L.latLngBounds(group.map(({ place }) => place));
    const zoom = Math.min(this._map.getBoundsZoom(places.pad(0.2)), MOST_ZOOM);
    if (byKey) this._focus = group[0].id;
    if (zoom > this._map.getZoom()) {
      this._map.setView(places.getCenter(), zoom, { animate: false });
      return;
    }
    this._spread = new Set(group.map(({ id }) => id));
    this.arrange(this._items);
  }

  /** Who has come here by keyboard goes on with a drone, or with the group that it is in. */
  _refocus() {
    if (this._focus === null) return;
    const item = this._items.find(({ id }) => id === this._focus);
    this._focus = null;
    if (item === undefined) return;
    const hidden = item.mark.getElement().classList.contains("grouped");
    const shared = [...this._marks.values()].find(({ group }) => group.includes(item));
    (hidden ? shared?.mark : item.mark)?.getElement().focus({ preventScroll: true });
  }
}

/**
 * Sets of marks that would hide each other. In time that grows with their number only.
 * @param {Item[]} items
 * @param {Map<Item, any>} at their points
 * @param {any[]} bases points that shared marks keep clear of
 * @returns {{items: Item[], point: any}[]}
 */
function units(items, at, bases) {
  let found = items.map((item) => ({ items: [item], point: at.get(item) }));
  for (let turn = 0; turn < MOST_TURNS; turn += 1) {
    const merged = mergedOnce(found);
    for (const unit of merged) {
      if (unit.items.length > 1) unit.point = clear(unit.point, bases);
    }
    if (merged.length === found.length) break;
    found = merged;
  }
  return found;
}

function mergedOnce(before) {
  const cells = new Map();
  const found = [];
  for (const unit of before) {
    const [column, row] = [Math.floor(unit.point.x / CELL_PX), Math.floor(unit.point.y / CELL_PX)];
    const near = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => cells.get(`${column + x} ${row + y}`) ?? []));
    const other = near.find((one) => one.point.distanceTo(unit.point) < radius(one) + radius(unit));
    if (other === undefined) {
      const key = `${column} ${row}`;
      cells.set(key, [...(cells.get(key) ?? []), unit]);
      found.push(unit);
      continue;
    }
    const [own, more] = [other.items.length, unit.items.length];
    other.point = other.point.multiplyBy(own).add(unit.point.multiplyBy(more)).divideBy(own + more);
    other.items = [...other.items, ...unit.items];
  }
  return found;
}

function radius({ items }) {
  return items.length > 1 ? GROUP_PX : MARK_PX;
}

function middle(points) {
  return points.reduce((sum, point) => sum.add(point), L.point(0, 0)).divideBy(points.length);
}

/** A point that does not hide a base. */
function clear(point, bases) {
  const base = bases.find((one) => one.distanceTo(point) < CLEAR_PX);
  return base === undefined ? point : base.add([CLEAR_PX, 0]);
}

/** @param {Item[]} group */
function paint(element, group) {
  const level = LEVELS.find((one) => group.some((item) => item.level === one));
  const risks = group.map(({ risk }) => risk);
  const risk = risks.includes(null) ? null : Math.max(...risks);
  const [ground, text] = riskColours(risk);
  const dot = element.querySelector(".dot");
  element.classList.toggle("alarm", level === "alarm");
  element.classList.toggle("warning", level === "warning");
  element.classList.toggle("unknown", risk === null);
  dot.style.background = ground;
  dot.style.color = text;
  // Not the number of a drone.
  dot.classList.toggle("long", group.length > 99);
  say(dot, `×${group.length}${level === "alarm" ? "!" : ""}`);
  const named = group.slice(0, MOST_NAMED).map(({ id }) => id).join(", ");
  const more = group.length > MOST_NAMED ? ` and ${group.length - MOST_NAMED} more` : "";
  const worst = level === undefined ? "" : `, ${level} among them`;
  const highest = risk === null ? "a risk is unknown" : `highest risk ${risk.toFixed(2)}`;
  element.setAttribute("aria-label", `${group.length} drones: ${named}${more}${worst}, ${highest}. Enter shows them apart.`);
}
