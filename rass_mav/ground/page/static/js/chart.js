// Charts over time.

import { colour } from "./theme.js";
import { clock, reading, span, unitName } from "./words.js";

const HEIGHT = 190;

/** As wide as its longest text, so that none is cut. */
function fitted(chart, texts, index, cycle) {
  const own = chart.axes[index];
  if (cycle > 1) return own._size;
  const longest = Math.max(0, ...(texts ?? []).map((text) => (text ? measured(chart.ctx, own.font[0], String(text)) : 0)));
  return Math.ceil(own.ticks.size + own.gap + longest / devicePixelRatio) + 2;
}

function measured(pen, font, text) {
  pen.save();
  pen.font = font;
  const { width } = pen.measureText(text);
  pen.restore();
  return width;
}

/** The colours of drones in one chart: `--drone-1` and so on. Dashes tell the second half of them from the first. */
export const COMPARED = 8;

/** All charts, so that paper gets them in its own size at once. @type {Set<Chart>} */
const charts = new Set();

/** Bring all charts to the width that they have now. */
export function resizeCharts() {
  for (const chart of charts) chart.resize();
}

function axis(more) {
  return { stroke: colour("quiet"), grid: { stroke: colour("edge"), width: 0.5 }, ticks: { stroke: colour("edge") }, font: "12px system-ui", ...more };
}

/** Times of day, with seconds where minutes would repeat. */
function timeAxis() {
  return axis({
    space: 70,
    size: 36,
    values: (_, ticks) => ticks.map((utc) => (ticks.length > 1 && ticks[1] - ticks[0] < 60 ? clock(utc, utc) : clock(utc, utc).replace(/:\d\d$/, ""))),
  });
}

/** A single time has two minutes, and not the day after it. */
function widened({ data: [times] }, low, high) {
  return times.length === 1 ? [times[0] - 60, times[0] + 60] : [low, high];
}

/** A chart that is made when there is something to draw, and made again with new colours. */
class Chart {
  constructor(element) {
    this._element = element;
    this._chart = null;
    this._shape = "";
    charts.add(this);
    new ResizeObserver(() => this.resize()).observe(element);
  }

  _draw(shape, options, data) {
    if (this._chart !== null && this._shape === shape) {
      this._chart.setData(data);
      return;
    }
    this.clear();
    this._shape = shape;
    this._element.replaceChildren();
    this._chart = new uPlot({ width: this._width, height: HEIGHT, cursor: { drag: { x: false, y: false } }, ...options }, data, this._element);
    this._chart.root.querySelector("canvas").setAttribute("aria-hidden", "true");
  }

  get _width() {
    return Math.max(this._element.clientWidth, 100);
  }

  /** The element may have another width. */
  resize() {
    if (this._chart !== null && this._chart.width !== this._width) this._chart.setSize({ width: this._width, height: HEIGHT });
  }

  clear() {
    this._chart?.destroy();
    this._chart = null;
    this._shape = "";
  }

  /** Say that there is nothing to draw. */
  none(why = "None.") {
    this.clear();
    this._element.textContent = why;
  }
}

/** Arrivals in each span of time, and their delays. */
export class ArrivalsChart extends Chart {
  /**
   * @param {{span_s: number, start: number[], count: number[], p50: (number | null)[], p95: (number | null)[]}} arrivals
   * @param {number} until arrivals up to this time, seconds since 1970
   */
  show(arrivals, until) {
    const end = arrivals.start.findIndex((start) => start > until);
    const shown = end < 0 ? arrivals.start.length : end;
    if (shown === 0) {
      this.none("Nothing has arrived yet.");
      return;
    }
    const part = (name) => arrivals[name].slice(0, shown);
    const time = { value: (_, utc) => (utc === null ? "-" : clock(utc)), label: "Time" };
    const delay = (label, stroke, dash) => ({
      label, scale: "s", stroke, width: 1.5, dash, spanGaps: true, points: { size: 4 }, value: (_, s) => (s === null ? "-" : span(s)),
    });
    const options = {
      scales: { x: { range: (_, low, high) => [low, high + arrivals.span_s] }, n: { range: (_, low, high) => [0, Math.max(high ?? 1, 1)] }, s: { range: (_, low, high) => [0, Math.max(high ?? 1, 1)] } },
      axes: [
        timeAxis(),
        axis({ scale: "n", size: fitted, label: `data in ${span(arrivals.span_s)}`, labelSize: 16, labelFont: "12px system-ui" }),
        axis({ scale: "s", side: 1, size: fitted, grid: { show: false }, label: "delay", labelSize: 16, labelFont: "12px system-ui", values: (_, ticks) => ticks.map((s) => (s === 0 ? "0" : span(s))) }),
      ],
      series: [
        time,
        { label: "Arrived", scale: "n", fill: `${colour("bar")}66`, width: 0, paths: uPlot.paths.bars({ size: [0.9, 40], align: 1 }), points: { show: false }, value: (_, n) => (n === null ? "-" : String(n)) },
        delay("Delay of half", colour("curve")),
        delay("of 95 %", colour("curve-high"), [4, 3]),
      ],
    };
    this._draw(`arrivals ${arrivals.span_s}`, options, [part("start"), part("count"), part("p50"), part("p95")]);
  }
}

/** The readings of a drone. */
export class ReadingsChart extends Chart {
  /**
   * @param {string} unit
   * @param {{utc: number[], value: number[]}} readings
   */
  show(unit, readings) {
    const options = {
      scales: { x: { range: widened } },
      axes: [timeAxis(), axis({ size: fitted, values: (_, ticks) => ticks.map(reading) })],
      series: [
        { value: (_, utc) => (utc === null ? "-" : clock(utc)), label: "Time" },
        { label: unitName(unit), stroke: colour("bar"), width: 1.5, points: { size: 3 }, value: (_, value) => (value === null ? "-" : reading(value)) },
      ],
    };
    this._draw(`readings ${unit}`, options, [readings.utc, readings.value]);
  }
}

/** The readings of several drones, in one unit. */
export class ComparisonChart extends Chart {
  /**
   * @param {string} unit
   * @param {{id: number, utc: number[], value: number[]}[]} drones at most `COMPARED`
   * @param {boolean} log a logarithmic scale, on which 0 and less have no place
   */
  show(unit, drones, log) {
    const line = (id, index) => ({
      label: `Drone ${id}`, stroke: colour(`drone-${index + 1}`), width: 2, dash: index < COMPARED / 2 ? [] : [7, 4], spanGaps: true,
      points: { size: 4 }, value: (_, value) => (value === null ? "-" : reading(value)),
    });
    const options = {
      scales: { x: { range: widened }, y: log ? { distr: 3, range: (_, low, high) => (high > 4 * low ? [low / 1.25, high * 1.25] : [low / 2, high * 2]) } : {} },
      axes: [
        timeAxis(),
        axis({ size: fitted, label: unitName(unit), labelSize: 16, labelFont: "12px system-ui", values: (_, ticks) => ticks.map((value) => (value === null ? "" : reading(value))) }),
      ],
      series: [{ value: (_, utc) => (utc === null ? "-" : clock(utc)), label: "Time" }, ...drones.map(({ id }, index) => line(id, index))],
    };
    const tables = drones.map(({ utc, value }) => [utc, log ? value.map((one) => (one > 0 ? one : null)) : value]);
    this._draw(`comparison ${unit} ${log} ${drones.map(({ id }) => id)}`, options, uPlot.join(tables));
  }
}
