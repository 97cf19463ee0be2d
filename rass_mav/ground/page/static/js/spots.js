// Hot spots: the list with places to copy, and their numbers on the map.

import { by, make, say } from "./dom.js";
import { clock, place, reading, unitName } from "./words.js";

/** What is drawn, as text: it is drawn again only when it is another. */
let drawn = "";

/**
 * The list, and the marks on the map. Earlier times have none.
 * @param {import("./state.js").State} state
 * @param {any} layer a group of the map
 * @param {(place: number[]) => void} show called when somebody wants to see a place on the map
 */
export function showSpots(state, layer, show) {
  const { hot_spots: spots, above } = state.frame;
  const now = state.past === null;
  by("spots-panel").hidden = !now;
  const text = JSON.stringify([spots, above, now]);
  if (text === drawn) return;
  drawn = text;
  layer.clearLayers();
  const high = above === null ? "above 100 uSv/h, or at which the risk of their drone was 1" : `above ${reading(above)}`;
  say(by("spots-summary"), spots.length ? `Readings ${high}, the highest first.` : `None: no readings ${high}.`);
  const list = by("spots");
  const held = list.contains(document.activeElement) ? document.activeElement.dataset.act : null;
  list.replaceChildren(...spots.map((spot, index) => row(spot, index + 1, show)));
  // Who is in the list stays there when it changes.
  if (held) list.querySelector(`[data-act="${held}"]`)?.focus();
  if (now) spots.forEach((spot, index) => mark(layer, spot, index + 1));
}

function row({ place: at, reading: value, unit, drone, utc }, number, show) {
  const text = place(at);
  const look = make("button", { type: "button", "data-act": `show ${number}`, "aria-label": `Show hot spot ${number} on the map` }, "Show");
  look.addEventListener("click", () => show(at));
  const copy = make("button", { type: "button", "data-act": `copy ${number}`, "aria-label": `Copy the place of hot spot ${number}: ${text}` }, "Copy");
  copy.addEventListener("click", async () => {
    const done = await copied(text);
    say(by("spots-said"), done ? `Copied: ${text}` : `Copying is not possible here: ${text}`);
  });
  const words = `${reading(value)} ${unitName(unit ?? "")}, drone ${drone}, ${clock(Date.parse(utc) / 1000)}`;
  return make("li", {}, make("code", {}, text), make("span", {}, words), make("span", { class: "acts" }, copy, look));
}

/** Copy a text. Where the page is not on this computer and not over HTTPS, browsers know the old way only. */
async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const field = make("textarea", { readonly: "", class: "unseen" });
    field.value = text;
    const before = document.activeElement;
    document.body.append(field);
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    before?.focus();
    return done;
  }
}

function mark(layer, { place: at }, number) {
  const icon = L.divIcon({ className: "spot", html: make("span", {}, String(number)), iconSize: [22, 22] });
  L.marker(at, { icon, interactive: false, keyboard: false, zIndexOffset: -300 }).addTo(layer);
}
