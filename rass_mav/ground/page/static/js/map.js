// The map: drones, their tracks and links, and the readings on the ground.

import { riskColours } from "./colours.js";
import { showContours } from "./contours.js";
import { by, make, say } from "./dom.js";
import { MetricGrid } from "./grid.js";
import { Groups } from "./groups.js";
import { Heat, scaleOf } from "./heat.js";
import { colour } from "./theme.js";
import { age, reading, unitName } from "./words.js";

/** A drone that was not heard for so long is marked, seconds. */
const SILENT_S = 180;
/** Below this zoom drones have only their numbers. */
const SAYING_ZOOM = 16;
/** Below this difference of its squares a map cannot be fitted, degrees. */
const LEAST_BOUNDS = 0.0005;
/** A place that somebody wants to see is shown from this zoom on. */
const LOOK_ZOOM = 17;
/** On a narrower page the key is folded, pixels. */
const NARROW_PX = 960;

/** The head of an arrow: how far it goes back and to the sides, pixels. On a shorter line there is none. */
const HEAD_PX = [12, 7];
const LEAST_ARROW_PX = 40;

/** A line with the head of an arrow in its middle, of the same size at each zoom. */
const Arrow = L.Polyline.extend({
  options: { smoothFactor: 0 },

  _projectLatlngs(latlngs, result, bounds) {
    L.Polyline.prototype._projectLatlngs.call(this, latlngs, result, bounds);
    const [from, to] = result[0] ?? [];
    if (to === undefined || from.distanceTo(to) < LEAST_ARROW_PX) return;
    const along = to.subtract(from).divideBy(from.distanceTo(to));
    const [back, side] = HEAD_PX;
    const tip = from.add(to).divideBy(2).add(along.multiplyBy(back / 2));
    const ends = [side, -side].map((far) => tip.subtract(along.multiplyBy(back)).add([-along.y * far, along.x * far]));
    ends.forEach((end) => bounds.extend(end));
    result[0] = [from, tip, ends[0], tip, ends[1], tip, to];
  },
});

/** The map of the page. */
export class MissionMap {
  /**
   * @param {import("./state.js").State} state
   * @param {(id: number) => void} choose called when somebody chooses a drone
   */
  constructor(state, choose) {
    this._state = state;
    this._choose = choose;
    this._map = L.map("map", { attributionControl: false, zoomSnap: 0.5, renderer: L.canvas({ padding: 0.3 }), maxZoom: 22 });
    this._map.setView([0, 0], 2);
    this._map.createPane("heat").style.zIndex = "350";
    this._map.createPane("grid").style.zIndex = "360";
    this._map.getPane("grid").style.pointerEvents = "none";
    by("legend").open = window.innerWidth > NARROW_PX;
    L.control.scale({ imperial: false, position: "topleft" }).addTo(this._map);
    this._grid = new MetricGrid({ maxZoom: 22, keepBuffer: 1, pane: "grid" });
    this._heat = new Heat(reading);
    this._tracks = L.layerGroup();
    this._links = L.layerGroup();
    this._contours = L.layerGroup();
    /** Regions of sources. */
    this.sources = L.layerGroup();
    /** Hot spots. */
    this.spots = L.layerGroup();
    /** Photographs and lines. */
    this.notes = L.layerGroup();
    this._tiles = null;
    this._lines = new Map();
    /** The places that each line of a track shows. */
    this._drawn = new WeakMap();
    this._joins = new Map();
    this._marks = new Map();
    this._groups = new Groups(this._map);
    this._peak = null;
    /** Whether the view stays as it is; null: there is none yet. */
    this._fitted = null;
    this._unit = null;
    this._layers();
    const zoomed = () => by("map").classList.toggle("far", this._map.getZoom() < SAYING_ZOOM);
    this._map.on("zoomend", () => {
      zoomed();
      this._clearPeak();
    });
    this._tooltip = L.tooltip({ direction: "top" });
    this._map.on("click", ({ latlng }) => this._tellSquare(latlng));
    by("fit").addEventListener("click", () => this.fit());
    // Who has moved the map keeps the view, whatever comes later.
    for (const name of ["pointerdown", "wheel", "keydown"]) by("map").addEventListener(name, () => this._keepView());
    new ResizeObserver(() => this._map.invalidateSize()).observe(by("map"));
    zoomed();
  }

  _layers() {
    const layers = { heat: this._heat, tracks: this._tracks, links: this._links, contours: this._contours, spots: this.spots, notes: this.notes, sources: this.sources, grid: this._grid };
    for (const [name, layer] of Object.entries(layers)) {
      const box = by(`show-${name}`);
      const set = () => (box.checked ? layer.addTo(this._map) : layer.remove());
      box.addEventListener("change", set);
      set();
    }
    by("unit").addEventListener("change", () => {
      this._unit = by("unit").value;
      this.show();
    });
  }

  /** Draw the operator's own map. */
  _showTiles(tiles) {
    if (this._tiles !== null || !tiles) return;
    this._tiles = L.tileLayer("/tiles/{z}/{x}/{y}", {
      minNativeZoom: tiles.least_zoom,
      maxNativeZoom: tiles.most_zoom,
      maxZoom: 22,
      ...(tiles.bounds && { bounds: [[tiles.bounds[1], tiles.bounds[0]], [tiles.bounds[3], tiles.bounds[2]]] }),
    });
    this._tiles.addTo(this._map).bringToBack();
    by("tiles-row").hidden = false;
    by("show-tiles").addEventListener("change", (event) => {
      if (event.target.checked) this._tiles.addTo(this._map).bringToBack();
      else this._tiles.remove();
    });
    // Lines would hide the map.
    by("show-grid").checked = false;
    this._grid.remove();
    // The owner's text may have marks; they are left out, not followed.
    say(by("credit"), new DOMParser().parseFromString(tiles.attribution, "text/html").body.textContent);
  }

  /** The map itself, for tools on it. */
  get leaflet() {
    return this._map;
  }

  /** Show everything there is. `below`: pixels that are left free there: the key covers the map, except on paper. */
  fit(below = 45 + by("legend").offsetHeight) {
    const places = this._state.shown.flatMap((figures) => (figures.place ? [figures.place] : []));
    for (const id of this._state.tracks.keys()) places.push(...this._state.track(id));
    if (places.length === 0) return false;
    let bounds = L.latLngBounds(places);
    if (bounds.getNorth() - bounds.getSouth() < LEAST_BOUNDS) bounds = bounds.getCenter().toBounds(200);
    // What needs attention may have made the map smaller at this moment.
    this._map.invalidateSize({ pan: false });
    // The buttons are above.
    this._map.fitBounds(bounds, { paddingTopLeft: [55, 60], paddingBottomRight: [40, below], maxZoom: 19, animate: false });
    return true;
  }

  /** Bring a drone into view. */
  reveal(id) {
    const figures = this._state.figures(id);
    if (figures?.place && !this._map.getBounds().pad(-0.05).contains(figures.place)) this._map.panTo(figures.place);
  }

  /** Show a place closely. */
  lookAt(place) {
    this._fitted = true;
    this._map.setView(place, Math.max(this._map.getZoom(), LOOK_ZOOM), { animate: false });
    by("map").scrollIntoView({ block: "nearest" });
  }

  _keepView() {
    if (this._fitted === false) this._fitted = true;
  }

  /** New colours. */
  repaint() {
    this._grid.redraw();
    this.show();
  }

  /** Draw the state. */
  show() {
    const state = this._state;
    if (state.frame === null) return;
    this._showTiles(state.frame.tiles);
    this._drawUnits();
    showContours(state, this._unit, this._contours);
    this._drawTracks();
    this._drawLinks();
    this._drawDrones();
    this._drawHeat();
    if (!this._fitted && this.fit()) {
      // While the store is read there is more to come; and the key grows with the lines.
      this._fitted = !state.frame.behind && state.frame.contours !== null;
      const base = state.shown.find((figures) => figures.base && figures.place);
      const first = base ?? state.shown.find((figures) => figures.place);
      if (first) this._grid.setOrigin(first.place);
    }
  }

  _drawUnits() {
    const units = this._state.units;
    if (this._unit === null || !units.includes(this._unit)) this._unit = units[0] ?? null;
    const select = by("unit");
    if (select.options.length !== units.length) {
      select.replaceChildren(...units.map((unit) => make("option", { value: unit }, unitName(unit))));
      select.value = this._unit ?? "";
      by("unit-row").hidden = units.length < 2;
    }
  }

  _drawHeat() {
    const field = this._unit === null ? undefined : this._state.field(this._unit);
    // Earlier times have the colours of now, so that they can be compared.
    const latest = this._unit === null ? undefined : this._state.fields.get(this._unit);
    const scale = latest ? scaleOf(latest) : null;
    this._heat.setField(field ?? null, scale);
    by("heat-scale").hidden = by("heat-note").hidden = !scale;
    if (!scale) {
      this._peak?.remove();
      return;
    }
    say(by("heat-unit"), unitName(this._unit));
    say(by("heat-low"), reading(scale.low));
    say(by("heat-high"), reading(scale.high));
    say(by("heat-note"), `Means of ${latest.side_m} m squares, paler where interpolated, at most ${latest.reach_m} m away`);
    this._drawPeak();
  }

  /** Where the highest reading is. */
  _drawPeak() {
    let highest = null;
    for (const { highest: found } of this._state.shown) {
      if (found?.place && found.unit === this._unit && (highest === null || found.reading > highest.reading)) highest = found;
    }
    if (highest === null || !by("show-heat").checked) {
      this._peak?.remove();
      return;
    }
    const text = `max ${reading(highest.reading)} ${unitName(highest.unit)}`;
    if (this._peak === null) {
      const icon = L.divIcon({ className: "peak", html: make("span"), iconAnchor: [-6, 8] });
      this._peak = L.marker(highest.place, { icon, interactive: false, keyboard: false, zIndexOffset: 3000 });
    }
    this._peak.setLatLng(highest.place).addTo(this._map);
    say(this._peak.getElement().firstChild, text);
    this._clearPeak();
  }

  /** Put its text where no mark is: beside the place, above or below it. */
  _clearPeak() {
    const element = this._peak?.getElement();
    if (!element) return;
    const [wide, high] = [element.offsetWidth, element.offsetHeight];
    const from = this._map.latLngToLayerPoint(this._peak.getLatLng());
    const marks = this._groups.obstacles.map(([point, radius]) => [point.subtract(from), radius]);
    const hidden = ([x, y]) =>
      marks.filter(([{ x: mx, y: my }, radius]) => {
        const [dx, dy] = [Math.max(x - mx, 0, mx - x - wide), Math.max(y - my, 0, my - y - high)];
        return dx * dx + dy * dy < radius * radius;
      }).length;
    const spots = [[12, -high / 2], [-12 - wide, -high / 2], [-wide / 2, -12 - high], [-wide / 2, 14]];
    const far = [[30, -34], [30, 20], [-30 - wide, -34], [-30 - wide, 20], [-wide / 2, -40], [-wide / 2, 40]];
    const [best] = [...spots, ...far].map((spot) => [hidden(spot), spot]).sort(([one], [other]) => one - other);
    [element.style.marginLeft, element.style.marginTop] = best[1].map((part) => `${Math.round(part)}px`);
  }

  _drawTracks() {
    const seen = new Set();
    for (const { drone } of this._state.shown) {
      seen.add(drone);
      const chosen = drone === this._state.chosen;
      const style = { color: colour(chosen ? "accent" : "track"), weight: chosen ? 2.5 : 1, opacity: chosen ? 0.9 : 0.45, interactive: false };
      const places = this._state.track(drone);
      if (!this._lines.has(drone)) this._lines.set(drone, L.polyline([], style).addTo(this._tracks));
      const line = this._lines.get(drone).setStyle(style);
      if (this._drawn.get(line) === places) continue;
      line.setLatLngs(places);
      this._drawn.set(line, places);
    }
    prune(this._lines, seen, this._tracks);
  }

  /** Links as the drones told them; an arrow goes to the next hop. */
  _drawLinks() {
    const seen = new Set();
    for (const figures of this._state.shown) {
      for (const [id, quality] of figures.neighbours ?? []) {
        const other = this._state.figures(id);
        if (!figures.place || !other?.place) continue;
        const next = id === figures.next_hop;
        const key = `${figures.drone} ${id} ${next}`;
        seen.add(key);
        const style = {
          color: colour(next ? "up" : "side"), weight: next ? 1.5 + 2.5 * quality : 1, opacity: next ? 0.9 : 0.5,
          dashArray: next ? "" : "3 6", interactive: false,
        };
        if (!this._joins.has(key)) this._joins.set(key, (next ? new Arrow([]) : L.polyline([])).addTo(this._links));
        this._joins.get(key).setLatLngs([figures.place, other.place]).setStyle(style);
      }
    }
    prune(this._joins, seen, this._links);
  }

  _drawDrones() {
    const seen = new Set();
    const items = [];
    for (const figures of this._state.shown) {
      if (!figures.place) continue;
      const { drone: id, place, risk } = figures;
      seen.add(id);
      if (!this._marks.has(id)) this._marks.set(id, this._newMark(figures));
      const mark = this._marks.get(id);
      this._paint(mark.getElement(), figures);
      const [chosen, base, guess] = [id === this._state.chosen, figures.base === true, figures.how === "guess"];
      mark.setZIndexOffset(chosen ? 1000 : guess ? -100 : base ? 400 : 0);
      items.push({ id, mark, place, risk, base, alone: chosen || base, level: this._state.level(id) });
    }
    prune(this._marks, seen, this._map);
    this._groups.arrange(items);
  }

  _newMark({ drone, place }) {
    const body = make("div", {}, make("span", { class: "dot" }), make("span", { class: "said", "aria-hidden": "true" }));
    const icon = L.divIcon({ className: "mark", html: body, iconSize: [26, 26] });
    const mark = L.marker(place, { icon, keyboard: true, riseOnHover: true }).addTo(this._map);
    mark.on("click", () => this._choose(drone));
    mark.getElement().addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      this._choose(drone);
    });
    return mark;
  }

  _paint(element, figures) {
    const [ground, text] = riskColours(figures.risk);
    const guess = figures.how === "guess";
    const old = figures.how === "set" || guess ? 0 : this._state.now - figures.placed;
    const silent = old > SILENT_S;
    element.classList.toggle("base", figures.base === true);
    element.classList.toggle("guess", guess);
    element.classList.toggle("unknown", figures.risk === null);
    element.classList.toggle("silent", silent);
    const level = this._state.level(figures.drone);
    element.classList.toggle("alarm", level === "alarm");
    element.classList.toggle("chosen", figures.drone === this._state.chosen);
    const [dot, said] = element.firstChild.children;
    dot.style.background = ground;
    dot.style.color = text;
    say(dot, `${figures.drone}${guess ? "?" : ""}`);
    const risk = figures.risk === null ? "?" : figures.risk.toFixed(2);
    say(said, guess ? "place: a guess" : silent ? `${risk}, ${age(old)}` : risk);
    const what = figures.base ? "Base" : "Drone";
    const known = guess ? "its position is a guess" : figures.how === "set" ? "position as configured" : `position known ${age(old)} ago`;
    element.setAttribute("aria-label", `${what} ${figures.drone}, ${level === "alarm" ? "alarm, " : ""}risk ${risk}, ${known}`);
  }

  _tellSquare(latlng) {
    const square = by("show-heat").checked ? this._heat.at(latlng) : null;
    if (square === null) {
      this._tooltip.remove();
      return;
    }
    const from = square.readings ? `mean of ${square.readings}` : "interpolated";
    const text = `${reading(square.value)} ${unitName(this._unit)}, ${from}`;
    this._tooltip.setLatLng(latlng).setContent(make("span", {}, text)).addTo(this._map);
  }
}

function prune(layers, seen, group) {
  for (const [key, layer] of layers) {
    if (seen.has(key)) continue;
    group.removeLayer(layer);
    layers.delete(key);
  }
}
