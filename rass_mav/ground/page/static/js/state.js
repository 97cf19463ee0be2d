// What the page knows of the mission, and what of it is shown: the latest, or an earlier time.

/** Points of a track that are kept here; the server keeps fewer. */
const MOST_POINTS = 2000;

/**
 * @typedef {object} Track
 * @property {number} span
 * @property {Map<number, number[]>} points
 * @property {number[][] | null} line the places up to the time `until`; null: to be made again
 * @property {number} until
 */

/** The state of the page. */
export class State {
  constructor() {
    /** The latest frame: totals, losses, arrivals and so on; null: nothing has come yet. */
    this.frame = null;
    /** Figures by drone. @type {Map<number, any>} */
    this.drones = new Map();
    /** Tracks by drone. @type {Map<number, Track>} */
    this.tracks = new Map();
    /** Radiation by unit. @type {Map<string, any>} */
    this.fields = new Map();
    /** An earlier state as the server tells it; null: now. */
    this.past = null;
    /** The drone whose panel is open. @type {number | null} */
    this.chosen = null;
    this.node = null;
    this._offset = 0;
  }

  /** What needs attention now, whatever time is shown. */
  get attention() {
    return this.frame?.attention ?? { rows: [], marks: {}, silent: [] };
  }

  /** What has begun and ended, the latest last. @returns {any[]} */
  get events() {
    return this.frame?.events ?? [];
  }

  /** The level of a drone's condition; undefined: it needs no attention, or an earlier time is shown. */
  level(id) {
    return this.past === null ? this.attention.marks[id] : undefined;
  }

  /** Whether nobody knows what a drone has created since it was heard. */
  silent(id) {
    return this.past === null && this.attention.silent.includes(id);
  }

  /** What needs attention has changed. */
  takeAttention({ now, attention, events }) {
    if (this.frame === null) return;
    this.takeNow(now);
    this.frame = { ...this.frame, attention, events };
  }

  /** Everything, from the beginning. */
  takeMission(mission) {
    this.drones.clear();
    this.tracks.clear();
    this.fields.clear();
    this.takeNews(mission);
  }

  /** What has changed. */
  takeNews(news) {
    if (this.frame === null && news.version === undefined) return;
    this.takeNow(news.now);
    this.node = news.node;
    this.frame = { ...this.frame, ...news };
    for (const figures of news.drones) this.drones.set(figures.drone, figures);
    for (const [id, track] of Object.entries(news.tracks)) mergeTrack(this.tracks, Number(id), track);
    for (const [unit, field] of Object.entries(news.fields)) mergeField(this.fields, unit, field);
  }

  /** Where sources are has been estimated anew. */
  takeSources(sources) {
    if (this.frame !== null) this.frame = { ...this.frame, sources };
  }

  /** Lines of equal readings have been drawn anew. */
  takeContours(contours) {
    if (this.frame !== null) this.frame = { ...this.frame, contours };
  }

  /** Whether data may still come. */
  takeRun(run) {
    if (this.frame !== null) this.frame.run = run;
  }

  /** The server's clock: ages do not depend on this computer's. */
  takeNow(now) {
    this._offset = now - Date.now() / 1000;
  }

  /** Seconds since 1970 at the time that is shown. */
  get now() {
    return this.past === null ? Date.now() / 1000 + this._offset : this.past.at;
  }

  /** The figures that are shown, by the drone's number. @returns {any[]} */
  get shown() {
    const drones = this.past === null ? [...this.drones.values(), ...(this.frame?.unheard ?? [])] : this.past.drones;
    return drones.sort((one, other) => one.drone - other.drone);
  }

  /** The figures of a drone that are shown. */
  figures(id) {
    if (this.past === null && this.drones.has(id)) return this.drones.get(id);
    const others = this.past === null ? (this.frame?.unheard ?? []) : this.past.drones;
    return others.find((figures) => figures.drone === id);
  }

  /** Lines of equal readings that are shown, by unit. @returns {Record<string, {levels: number[], lines: any[]}>} */
  get contours() {
    return (this.past === null ? this.frame?.contours : this.past.contours) ?? {};
  }

  /** The totals that are shown. */
  get totals() {
    return this.past === null ? this.frame.totals : this.past.totals;
  }

  /** The radiation that is shown, of a unit. */
  field(unit) {
    if (this.past === null) return this.fields.get(unit);
    const field = this.past.fields[unit];
    return field && mergedField(undefined, field);
  }

  /** The units of all readings. @returns {string[]} */
  get units() {
    return [...this.fields.keys()];
  }

  /**
   * The places of a drone up to the time that is shown: the same array as long as they are the same.
   * @returns {number[][]} latitude and longitude
   */
  track(id) {
    const track = this.tracks.get(id);
    if (track === undefined) return [];
    const until = this.past === null ? Infinity : this.past.at;
    if (track.line === null || track.until !== until) {
      track.until = until;
      track.line = [...track.points.values()]
        .filter(([utc]) => utc <= until)
        .sort((one, other) => one[0] - other[0])
        .map(([, latitude, longitude]) => [latitude, longitude]);
    }
    return track.line;
  }
}

function mergeTrack(tracks, id, { span_s: span, whole, points }) {
  let track = tracks.get(id);
  if (track === undefined || whole || track.span !== span || track.points.size > MOST_POINTS) {
    track = { span, points: new Map(), line: null, until: Infinity };
    tracks.set(id, track);
  }
  track.line = null;
  for (const point of points) {
    const slot = Math.floor(point[0] / span);
    const known = track.points.get(slot);
    if (known === undefined || known[0] <= point[0]) track.points.set(slot, point);
  }
}

function mergeField(fields, unit, field) {
  fields.set(unit, mergedField(fields.get(unit), field));
}

function mergedField(known, field) {
  const squares = known === undefined || field.whole ? new Map() : known.squares;
  for (const square of field.squares) squares.set(`${square[0]} ${square[1]}`, square);
  return { ...field, squares };
}
