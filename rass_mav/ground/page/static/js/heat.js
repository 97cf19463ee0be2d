// The readings on the ground: a square for each place where something was measured, or close to it.

import { heatColour } from "./colours.js";

/** The lowest reading of the scale is at least this part of the highest. */
const DYNAMIC = 1e-3;
/** Of squares with readings, and of those in between. */
const OPACITY = 0.7;
const PALE = 0.5;
/** Inside a square that is at least so many pixels wide there is its reading. */
const TEXT_PX = 46;

/**
 * The scale of a field: logarithmic, from the lowest to the highest reading.
 * @returns {{low: number, high: number, part: (reading: number) => number} | null} null: there is no reading above 0
 */
export function scaleOf(field) {
  let low = Infinity;
  let high = 0;
  for (const [, , value] of field.squares.values()) {
    if (value > high) high = value;
    if (value > 0 && value < low) low = value;
  }
  if (high <= 0) return null;
  low = Math.max(low, high * DYNAMIC);
  const range = Math.log(high / low);
  return { low, high, part: (value) => (range === 0 ? 0.5 : Math.log(Math.max(value, low) / low) / range) };
}

/** A function that finds each of its values once. */
function remembered(find) {
  const found = new Map();
  return (key) => {
    if (!found.has(key)) found.set(key, find(key));
    return found.get(key);
  };
}

/** A layer: one canvas over the map, drawn when the map or the field changes. */
export const Heat = L.Layer.extend({
  initialize(write) {
    this._field = null;
    this._scale = null;
    this._write = write;
  },

  onAdd(map) {
    this._canvas = L.DomUtil.create("canvas", "leaflet-zoom-hide", map.getPane("heat"));
    this._canvas.setAttribute("aria-hidden", "true");
    map.on("moveend zoomend resize viewreset", this.draw, this);
    this.draw();
  },

  onRemove(map) {
    map.off("moveend zoomend resize viewreset", this.draw, this);
    this._canvas.remove();
  },

  /** Show this field; null: none. `scale`: its colours, as of `scaleOf`; null: nothing is painted. */
  setField(field, scale) {
    // A field that has changed is another object.
    if (field === this._field && scale?.low === this._scale?.low && scale?.high === this._scale?.high) return;
    this._field = field;
    this._scale = scale;
    if (this._map) this.draw();
  },

  draw() {
    const map = this._map;
    const size = map.getSize();
    const ratio = window.devicePixelRatio || 1;
    L.DomUtil.setPosition(this._canvas, map.containerPointToLayerPoint([0, 0]));
    this._canvas.width = size.x * ratio;
    this._canvas.height = size.y * ratio;
    this._canvas.style.width = `${size.x}px`;
    this._canvas.style.height = `${size.y}px`;
    const scale = this._scale;
    if (this._field === null || scale === null) return;
    const pen = this._canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.font = "11px system-ui, sans-serif";
    const { origin, step, squares } = this._field;
    // Whole pixels, so that neighbours neither overlap nor leave a gap. Edges are projected once, not for each square.
    const corner = (row, column) => map.latLngToContainerPoint([origin[0] + row * step[0], origin[1] + column * step[1]]).round();
    const edgeX = remembered((column) => corner(0, column).x);
    const edgeY = remembered((row) => corner(row, 0).y);
    for (const [row, column, value, readings] of squares.values()) {
      const [left, right, top, bottom] = [edgeX(column), edgeX(column + 1), edgeY(row + 1), edgeY(row)];
      if (right < 0 || left > size.x || bottom < 0 || top > size.y) continue;
      pen.globalAlpha = readings ? OPACITY : PALE;
      pen.fillStyle = heatColour(scale.part(value));
      pen.fillRect(left, top, Math.max(right - left, 2), Math.max(bottom - top, 2));
      if (readings && right - left >= TEXT_PX) {
        pen.globalAlpha = 1;
        pen.fillStyle = scale.part(value) > 0.6 ? "#14181d" : "#ffffff";
        pen.fillText(this._write(value), (left + right) / 2, (top + bottom) / 2);
      }
    }
  },

  /** The square at a place: its reading, and how many readings are in it; null: nothing is painted there. */
  at({ lat, lng }) {
    if (!this._field) return null;
    const { origin, step, squares } = this._field;
    const row = Math.floor((lat - origin[0]) / step[0]);
    const column = Math.floor((lng - origin[1]) / step[1]);
    const square = squares.get(`${row} ${column}`);
    return square ? { value: square[2], readings: square[3] } : null;
  },
});
