// Photographs and lines that operators have put: in a strip, and at their places on the map.

import { by, make, say } from "./dom.js";
import { clock, count, place } from "./words.js";

/** Of a line, the strip shows so many characters. */
const SHORT = 90;

/** What is drawn, as text: it is drawn again only when it is another. */
let drawn = "";
/** The one in the dialog. */
let open = null;
let lookAt = null;

/**
 * The strip, and the marks on the map: those that had been created at the time that is shown.
 * @param {import("./state.js").State} state
 * @param {any} layer a group of the map
 * @param {(place: number[]) => void} show called when somebody wants to see a place on the map
 */
export function showNotes(state, layer, show) {
  const until = state.past === null ? Infinity : state.past.at;
  const notes = (state.frame.notes ?? []).filter(({ utc }) => utc <= until).reverse();
  const text = JSON.stringify(notes);
  if (text === drawn) return;
  drawn = text;
  lookAt = show;
  by("notes-panel").hidden = notes.length === 0;
  const list = by("notes");
  const held = list.contains(document.activeElement) ? document.activeElement.dataset.note : null;
  // A photograph that stays is not loaded again.
  const old = new Map([...list.children].map((item) => [item.dataset.key, item]));
  list.replaceChildren(...notes.map((note) => old.get(JSON.stringify(note)) ?? row(note)));
  if (held) list.querySelector(`[data-note="${CSS.escape(held)}"]`)?.focus();
  layer.clearLayers();
  for (const note of notes) if (note.place !== null) mark(layer, note);
}

const title = ({ text, drone }) => `${text === null ? "Photograph" : "Line"} of drone ${drone}`;

function row(note) {
  const { id, text, name, shown, parts, drone, utc } = note;
  const button = make("button", { type: "button", "data-note": id, "aria-label": `${title(note)}, ${clock(utc)}: ${short(text ?? name)}` });
  if (text !== null) button.append(make("span", { class: "words" }, short(text)));
  else if (shown) button.append(image(id, () => make("span", { class: "words" }, `${name}: cannot be shown`)));
  else button.append(make("span", { class: "words" }, `${name}: ${lacks(parts)}`));
  button.append(make("small", {}, `${drone}, ${clock(utc)}`));
  button.addEventListener("click", () => openNote(note));
  return make("li", { "data-key": JSON.stringify(note) }, button);
}

function lacks(parts) {
  return parts !== null && parts[0] < parts[1] ? `${count(parts[0])} of ${count(parts[1])} parts have arrived` : "too large to display";
}

function short(text) {
  return text.length > SHORT ? `${text.slice(0, SHORT)} ...` : text;
}

function image(id, instead) {
  const element = make("img", { alt: "", loading: "lazy", decoding: "async", src: `/api/picture/${id}` });
  element.addEventListener("error", () => element.replaceWith(instead()), { once: true });
  return element;
}

function mark(layer, note) {
  const svg = by(note.text === null ? "camera" : "bubble").content.firstElementChild.cloneNode(true);
  const icon = L.divIcon({ className: "note-mark", html: svg, iconSize: [22, 20], iconAnchor: [-6, 24] });
  // The strip has them for those who use no mouse.
  L.marker(note.place, { icon, keyboard: false, title: title(note), zIndexOffset: -200 }).on("click", () => openNote(note)).addTo(layer);
}

function openNote(note) {
  open = note;
  const { id, text, name, size, shown, parts, utc, place: at } = note;
  say(by("note-title"), title(note));
  say(by("note-about"), `${clock(utc)}, ${at === null ? "position unknown" : place(at)}${text === null ? `, ${name}, ${count(size)} bytes` : ""}`);
  say(by("note-text"), text !== null ? text + (new TextEncoder().encode(text).length < size ? " ..." : "") : shown ? "" : lacks(parts));
  by("note-show").hidden = at === null;
  const picture = by("note-image");
  picture.hidden = text !== null || !shown;
  if (picture.hidden) picture.removeAttribute("src");
  else {
    picture.src = `/api/picture/${id}`;
    picture.alt = `${title(note)}, ${name}`;
  }
  by("note").showModal();
}

by("note-image").addEventListener("error", () => {
  by("note-image").hidden = true;
  say(by("note-text"), "It cannot be shown: too large, or not a PNG, JPEG or WebP image.");
});
by("note").addEventListener("close", () => {
  by("note-image").removeAttribute("src");
  if (by("note").returnValue === "show" && open?.place) lookAt(open.place);
  by("note").returnValue = "";
});
