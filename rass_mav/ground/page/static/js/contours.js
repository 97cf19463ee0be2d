// Lines on the ground along which readings have one value: the higher, the thicker.

import { by, make, say } from "./dom.js";
import { colour } from "./theme.js";
import { reading, unitName } from "./words.js";

/** What is drawn: it is drawn again only when it is another. */
let drawn = [];

const width = (index) => 1 + 0.8 * index;

/**
 * The lines of a unit, and what they mean.
 * @param {import("./state.js").State} state
 * @param {string | null} unit
 * @param {any} layer a group of the map
 */
export function showContours(state, unit, layer) {
  const found = (unit === null ? undefined : state.contours[unit]) ?? { levels: [], lines: [] };
  const now = [found, unit, colour("text")];
  if (now.every((part, index) => part === drawn[index])) return;
  drawn = now;
  layer.clearLayers();
  const named = new Set();
  for (const { level, line } of found.lines) {
    const weight = width(found.levels.indexOf(level));
    L.polyline(line, { color: colour("panel"), weight: weight + 2.5, opacity: 0.65, interactive: false }).addTo(layer);
    L.polyline(line, { color: colour("text"), weight, interactive: false }).addTo(layer);
    // Of one level the longest line comes first.
    if (named.has(level)) continue;
    named.add(level);
    // In turn at the western and at the northern end, so that the names of two lines close together are apart.
    const at = found.levels.indexOf(level) % 2 === 0 ? ([, east]) => -east : ([north]) => north;
    const end = line.reduce((best, place) => (at(place) > at(best) ? place : best));
    const icon = L.divIcon({ className: "level", html: make("span", {}, reading(level)), iconAnchor: [0, 8] });
    L.marker(end, { icon, interactive: false, keyboard: false, zIndexOffset: -600 }).addTo(layer);
  }
  showKey(found.levels.filter((level) => named.has(level)), found.levels, unit);
}

function showKey(shown, levels, unit) {
  by("contour-scale").hidden = shown.length === 0;
  say(by("contour-unit"), shown.length ? `Lines, ${unitName(unit)}` : "");
  by("contour-levels").replaceChildren(
    ...shown.flatMap((level) => {
      const sample = make("i", { class: "line" });
      sample.style.borderTopWidth = `${width(levels.indexOf(level))}px`;
      return [sample, make("span", {}, reading(level))];
    }),
  );
}
