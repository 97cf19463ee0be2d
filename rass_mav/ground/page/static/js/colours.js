// Ramps that colour-blind people can tell apart, too.

const CIVIDIS = "00224e 123570 3b496c 575d6d 707173 8a8779 a69d75 c4b56c e4cf5b fee838";
const VIRIDIS = "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725";

const stops = (text) => text.split(" ").map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
const RISK = stops(CIVIDIS);
const HEAT = stops(VIRIDIS);

function mix(ramp, part) {
  const at = Math.min(Math.max(part, 0), 1) * (ramp.length - 1);
  const low = Math.min(Math.floor(at), ramp.length - 2);
  return ramp[low].map((value, index) => Math.round(value + (ramp[low + 1][index] - value) * (at - low)));
}

/**
 * The colour of a risk, and one for text on it.
 * @param {number | null} risk 0..1; null: unknown
 * @returns {[string, string]}
 */
export function riskColours(risk) {
  if (risk === null) return ["#ffffff", "#14181d"];
  const [r, g, b] = mix(RISK, risk);
  return [`rgb(${r},${g},${b})`, 0.299 * r + 0.587 * g + 0.114 * b > 120 ? "#14181d" : "#ffffff"];
}

/**
 * The colour of a reading.
 * @param {number} part 0..1 of the scale
 * @returns {string}
 */
export function heatColour(part) {
  const [r, g, b] = mix(HEAT, part);
  return `rgb(${r},${g},${b})`;
}
