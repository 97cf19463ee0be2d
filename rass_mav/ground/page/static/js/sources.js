// Where sources are, and where they may be.

import { by, make, say } from "./dom.js";
import { colour } from "./theme.js";
import { count, place, reading, unitName } from "./words.js";

/** What is drawn, as text: it is drawn again only when it is another. */
let drawn = "";

/**
 * The panel, and the regions on the map. Earlier times have no estimate.
 * @param {import("./state.js").State} state
 * @param {any} layer a group of the map
 */
export function showSources(state, layer) {
  const { estimate, trouble } = state.frame.sources;
  const now = state.past === null;
  by("sources-panel").hidden = !now || (estimate === null && !trouble);
  const note = by("sources-trouble");
  note.hidden = !trouble;
  say(note, trouble ? `${estimate === null ? "Sources are not located" : "Out of date"}: ${trouble}` : "");
  const text = JSON.stringify([estimate, now, colour("accent")]);
  if (text === drawn) return;
  drawn = text;
  layer.clearLayers();
  const sources = estimate?.sources ?? [];
  say(by("sources-summary"), estimate === null ? "" : summary(estimate));
  by("sources").replaceChildren(...sources.map((source) => make("li", {}, words(source, estimate.unit))));
  if (now) sources.forEach((source, index) => draw(layer, source, index + 1));
}

function summary({ verdict, why, readings, drones, unit, background, height_m: height, sources }) {
  const from = `from ${count(readings)} readings of ${drones} drones`;
  if (verdict === "too few readings") return `Too few readings: ${why}.`;
  if (verdict === "no fit") return `No fit, ${from}: ${why}.`;
  const ground = background === null ? "" : `; background ${reading(background)} ${unitName(unit)}`;
  if (verdict === "no source") return `None found, ${from}${ground}.`;
  const located = sources.filter(({ resolved }) => resolved).length;
  const rest = sources.length > located ? `, and ${sources.length - located} not resolved` : "";
  return `${located} located${rest}, ${from}, ${height.toFixed(0)} m above them${ground}.`;
}

function words({ place: at, strength, strength_range: within, area_m2: area, resolved, why, may_move: moves }, unit) {
  const certain = within === null ? "or any other" : `(${reading(within[0])} to ${reading(within[1])})`;
  const strong = `${reading(strength)} ${unitName(unit)} at 1 m ${certain}`;
  if (!resolved) return `Not resolved, near ${place(at)}: ${why}; as if ${strong}`;
  const radius = Math.sqrt(area / Math.PI);
  const either = moves ? ", if it rests or moves" : "";
  return `${place(at)}: ${strong}; with 95 % within ${count(Math.round(area))} m²${either}, as a circle of ${radius.toFixed(0)} m`;
}

/** A region, with its number in it: dashed if it cannot be relied on. */
function draw(layer, { place: at, region, resolved }, number) {
  const style = {
    color: colour("accent"), weight: 2, dashArray: resolved ? "" : "4 6", fillOpacity: resolved ? 0.12 : 0, interactive: false,
  };
  for (const ring of region) L.polygon(ring, style).addTo(layer);
  const html = make("span", {}, resolved ? `source ${number}` : `source ${number}?`);
  const icon = L.divIcon({ className: "source", html, iconAnchor: [0, -6] });
  L.marker(at, { icon, interactive: false, keyboard: false, zIndexOffset: -400 }).addTo(layer);
  if (resolved) L.circleMarker(at, { radius: 3, color: colour("accent"), fillOpacity: 1, interactive: false }).addTo(layer);
}
