// Files of the data for other programs, and paper.

import { by, make, say } from "./dom.js";

/** What people call the formats, those that most people want first; others have their own names. */
const NAMES = { csv: "CSV", gpx: "GPX", gpkg: "GeoPackage", geojson: "GeoJSON", kml: "KML" };

/** A button for each format of the server, once. */
export function showFormats(formats) {
  const place = by("save-formats");
  if (place.children.length || !formats) return;
  const known = Object.keys(NAMES);
  const rank = ({ name }) => (known.includes(name) ? known.indexOf(name) : known.length);
  const buttons = [...formats].sort((one, other) => rank(one) - rank(other)).map(({ name }) => {
    const button = make("button", { type: "button", "data-format": name }, titleOf(name));
    button.addEventListener("click", () => save(name, buttons));
    return button;
  });
  place.replaceChildren(...buttons);
}

function titleOf(name) {
  return NAMES[name] ?? name.toUpperCase();
}

async function save(name, buttons) {
  const title = titleOf(name);
  buttons.forEach((button) => (button.disabled = true));
  say(by("save-note"), `Preparing ${title} ...`);
  try {
    const answer = await fetch(`/api/export/${name}`);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    const file = /filename="([^"]+)"/.exec(answer.headers.get("Content-Disposition") ?? "")?.[1] ?? name;
    const url = URL.createObjectURL(await answer.blob());
    const link = make("a", { href: url, download: file });
    link.click();
    // The browser has taken it by then.
    setTimeout(() => URL.revokeObjectURL(url), 60000);
    say(by("save-note"), `Saved ${file}.`);
  } catch (error) {
    say(by("save-note"), `${title} was not saved: ${error.message}`);
  } finally {
    buttons.forEach((button) => (button.disabled = false));
    buttons.find((button) => button.dataset.format === name).focus({ preventScroll: true });
  }
}

/**
 * On paper the page is one column, light, with the whole map. `draw` draws everything at once, in the present colours
 * and sizes.
 * @param {any} map of Leaflet
 * @param {() => void} draw
 * @param {() => string} state what there is to say about how far the page is
 */
export function startPrint(map, draw, state) {
  const root = document.documentElement;
  let before = null;
  const lay = () => {
    map.invalidateSize({ animate: false, pan: false });
    draw();
  };
  const begin = () => {
    if (before !== null) return;
    before = { theme: root.dataset.theme, legend: by("legend").open, centre: map.getCenter(), zoom: map.getZoom(), snap: map.options.zoomSnap };
    // Paper is filled.
    map.options.zoomSnap = 0;
    root.dataset.theme = "light";
    root.classList.add("printing");
    by("legend").open = true;
    say(by("printed"), `Printed ${new Date().toLocaleString("en-GB")}. ${state()}`);
    lay();
  };
  const end = () => {
    if (before === null) return;
    root.dataset.theme = before.theme;
    root.classList.remove("printing");
    by("legend").open = before.legend;
    map.options.zoomSnap = before.snap;
    lay();
    map.setView(before.centre, before.zoom, { animate: false });
    before = null;
  };
  // What is not there yet, as tiles that come from the server, is waited for only with the button.
  window.addEventListener("beforeprint", begin);
  window.addEventListener("afterprint", end);
  by("print").addEventListener("click", async () => {
    begin();
    await new Promise((done) => {
      setTimeout(done, 3000);
      requestAnimationFrame(() => setTimeout(() => {
        const tiles = () => [...map.getContainer().querySelectorAll("img.leaflet-tile")].every((tile) => tile.complete);
        const look = () => (tiles() ? done() : setTimeout(look, 100));
        look();
      }));
    });
    window.print();
    // A phone may be done only later, and some browsers never say it: then whoever goes on with the page is.
    for (const kind of ["pointerdown", "keydown"]) document.addEventListener(kind, end, { once: true });
  });
}
