// Numbers and times for people.

const UNITS = { usvh: "uSv/h", cpm: "cpm", cps: "cps", counts: "counts", "": "(no unit)" };
/** Made once: it takes long. */
const NUMBERS = new Intl.NumberFormat("en-GB");
/** Seconds since 1970 from which on a time can be a date: 2000-01-01. Nodes without a clock count from 1970. */
const FIRST_DATE = 946684800;

/**
 * A unit as people write it.
 * @param {string} unit
 * @returns {string}
 */
export function unitName(unit) {
  return Object.hasOwn(UNITS, unit) ? UNITS[unit] : unit;
}

/**
 * A length of time, rounded.
 * @param {number} seconds
 * @returns {string}
 */
export function span(seconds) {
  const s = Math.max(0, seconds);
  for (const [size, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (s >= 2 * size) return `${Math.round(s / size)} ${unit}`;
  }
  return `${s >= 10 ? Math.round(s) : s.toFixed(1)} s`;
}

/**
 * How long ago something was, in whole seconds.
 * @param {number} seconds
 * @returns {string}
 */
export function age(seconds) {
  const s = Math.max(0, seconds);
  return s < 120 ? `${Math.round(s)} s` : span(s);
}

/**
 * A time of day, with the date if it is not that of `other`; where the node has no date, the time since it began.
 * @param {number} utc seconds since 1970
 * @param {number} [other] seconds since 1970
 * @returns {string}
 */
export function clock(utc, other = Date.now() / 1000) {
  if (utc < FIRST_DATE) return `+${span(utc)}`;
  const date = new Date(utc * 1000);
  const two = (n) => String(n).padStart(2, "0");
  const time = `${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
  const day = `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
  return date.toDateString() === new Date(other * 1000).toDateString() ? time : `${day} ${time}`;
}

/**
 * A whole number with separators; "-" if it is unknown.
 * @param {number | null | undefined} n
 * @returns {string}
 */
export function count(n) {
  return n === null || n === undefined ? "-" : NUMBERS.format(n);
}

/**
 * A reading, to three digits.
 * @param {number} value
 * @returns {string}
 */
export function reading(value) {
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) return value.toExponential(2);
  return size >= 1000 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
}

/**
 * A place in degrees.
 * @param {number[]} place latitude and longitude
 * @returns {string}
 */
export function place([latitude, longitude]) {
  return `${latitude.toFixed(6)}, ${longitude.toFixed(6)}`;
}
