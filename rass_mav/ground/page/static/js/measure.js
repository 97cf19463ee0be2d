// Measures distances on the map: a click adds a point, Enter the place in the middle or that of a drone, Escape ends.

import { by, say } from "./dom.js";
import { colour } from "./theme.js";
import { count } from "./words.js";

/** Points of a way. */
const MOST_POINTS = 50;

function metres(length) {
  return `${length < 10 ? length.toFixed(1) : count(Math.round(length))} m`;
}

/** The tool. */
export class Measure {
  /** @param {any} map of Leaflet */
  constructor(map) {
    this._map = map;
    this._points = [];
    this._layer = L.layerGroup();
    this._on = false;
    const box = map.getContainer();
    by("measure").addEventListener("click", () => this._set(!this._on));
    // Before the map and its marks see them.
    box.addEventListener("click", (event) => this._clicked(event), true);
    box.addEventListener("keydown", (event) => this._typed(event), true);
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && this._on) this._set(false);
    });
  }

  _set(on) {
    this._on = on;
    this._points = [];
    by("measure").setAttribute("aria-pressed", String(on));
    this._map.getContainer().classList.toggle("measuring", on);
    by("measured").hidden = !on;
    if (on) this._layer.addTo(this._map);
    else this._layer.remove();
    this._show();
  }

  _clicked(event) {
    if (!this._on || event.target.closest(".leaflet-control") || this._map.dragging.moved()) return;
    event.stopPropagation();
    this._add(this._map.mouseEventToLatLng(event));
  }

  _typed(event) {
    if (!this._on || event.key !== "Enter" || event.target.closest(".leaflet-control")) return;
    event.stopPropagation();
    event.preventDefault();
    const mark = event.target.closest(".mark")?.getBoundingClientRect();
    const box = this._map.getContainer().getBoundingClientRect();
    const at = mark ? [mark.x + mark.width / 2 - box.x, mark.y + mark.height / 2 - box.y] : this._map.getSize().divideBy(2);
    this._add(this._map.containerPointToLatLng(at));
  }

  _add(place) {
    if (this._points.length >= MOST_POINTS) return;
    this._points.push(place);
    this._show();
  }

  _show() {
    this._layer.clearLayers();
    const points = this._points;
    const legs = points.slice(1).map((point, index) => this._map.distance(points[index], point));
    const line = { color: colour("measure"), weight: 3, dashArray: "8 5", interactive: false };
    L.polyline(points, line).addTo(this._layer);
    for (const point of points) L.circleMarker(point, { ...line, dashArray: "", radius: 4, fillOpacity: 1 }).addTo(this._layer);
    if (points.length === 0) say(by("measured"), "Click on the map, or move it and press Enter. Escape ends.");
    else if (legs.length === 0) say(by("measured"), "Add the next point.");
    else {
      const all = metres(legs.reduce((sum, leg) => sum + leg, 0));
      say(by("measured"), legs.length === 1 ? all : `${all}, the last part ${metres(legs[legs.length - 1])}`);
    }
  }
}
