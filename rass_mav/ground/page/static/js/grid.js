// The ground where there is no map: lines of metres north and east of a place of the mission.

import { colour } from "./theme.js";

const DEGREE_M = 111320;
/** Lines are at least so many pixels apart. */
const LEAST_PX = 90;

/** The distance between two lines, metres: 1, 2 or 5 times a power of ten. */
function spacing(metresEachPixel) {
  const least = LEAST_PX * metresEachPixel;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((n) => n * power).find((step) => step >= least);
}

function label(metres, positive, negative) {
  const size = Math.abs(metres);
  if (size === 0) return "0";
  const text = size >= 1000 ? `${Number((size / 1000).toFixed(3))} km` : `${Number(size.toFixed(2))} m`;
  return `${text} ${metres > 0 ? positive : negative}`;
}

/** Text that can be read on any ground. */
function print(pen, text, x, y) {
  pen.save();
  pen.lineWidth = 3;
  pen.strokeStyle = colour("map");
  pen.strokeText(text, x, y);
  pen.restore();
  pen.fillText(text, x, y);
}

/** Beside a line at `x`, on the side where it fits into the tile. */
function write(pen, text, x, width) {
  const needed = pen.measureText(text).width + 4;
  print(pen, text, x + needed <= width ? x + 4 : x - needed, 14);
}

/**
 * A layer with the grid. `setOrigin(place)` says from where metres count.
 */
export const MetricGrid = L.GridLayer.extend({
  initialize(options) {
    L.GridLayer.prototype.initialize.call(this, options);
    this._origin = null;
  },

  setOrigin(place) {
    this._origin = place;
    if (this._map) this.redraw();
  },

  createTile(coords) {
    const size = this.getTileSize();
    const ratio = window.devicePixelRatio || 1;
    const tile = document.createElement("canvas");
    tile.width = size.x * ratio;
    tile.height = size.y * ratio;
    tile.setAttribute("aria-hidden", "true");
    if (this._origin !== null) this._draw(tile.getContext("2d"), coords, size, ratio);
    return tile;
  },

  _draw(pen, coords, size, ratio) {
    const corner = (x, y) => this._map.unproject([coords.x * size.x + x, coords.y * size.y + y], coords.z);
    const northWest = corner(0, 0);
    const southEast = corner(size.x, size.y);
    const [latitude, longitude] = this._origin;
    const width = DEGREE_M * Math.max(Math.cos((latitude * Math.PI) / 180), 0.01);
    const west = (northWest.lng - longitude) * width;
    const east = (southEast.lng - longitude) * width;
    const north = (northWest.lat - latitude) * DEGREE_M;
    const south = (southEast.lat - latitude) * DEGREE_M;
    // A tile is a little higher in the north than in the south; one spacing for all tiles of a zoom.
    const middle = Math.cos((latitude * Math.PI) / 180);
    const step = spacing((40075016 * Math.max(middle, 0.01)) / (256 * 2 ** coords.z));
    pen.scale(ratio, ratio);
    pen.strokeStyle = colour("line");
    pen.fillStyle = colour("line-text");
    pen.lineWidth = 1;
    pen.font = "11px system-ui, sans-serif";
    pen.beginPath();
    for (let n = Math.ceil(west / step); n * step < east; n += 1) {
      const x = ((n * step - west) / (east - west)) * size.x;
      pen.moveTo(x, 0);
      pen.lineTo(x, size.y);
      if (coords.y % 2 === 0 && n % 2 === 0) write(pen, label(n * step, "E", "W"), x, size.x);
    }
    for (let n = Math.floor(north / step); n * step > south; n -= 1) {
      const y = ((north - n * step) / (north - south)) * size.y;
      pen.moveTo(0, y);
      pen.lineTo(size.x, y);
      if (coords.x % 2 === 0 && n % 2 === 0) print(pen, label(n * step, "N", "S"), 4, y - 4);
    }
    pen.stroke();
  },
});
