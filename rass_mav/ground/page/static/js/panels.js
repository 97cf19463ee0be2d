// Totals, the table of drones, losses, the node.

import { riskColours } from "./colours.js";
import { by, make, say, tell } from "./dom.js";
import { age, clock, count, span } from "./words.js";

const COLUMNS = 8;

/**
 * A row for each drone. Rows and buttons stay, so that the focus does.
 * @param {import("./state.js").State} state
 * @param {(id: number) => void} choose
 */
export function showDrones(state, choose) {
  const body = by("drones").tBodies[0];
  const drones = state.shown;
  drones.forEach((figures, index) => {
    let row = body.rows[index];
    if (row === undefined) row = body.appendChild(newRow(choose));
    fill(row, figures, state);
  });
  while (body.rows.length > drones.length) body.deleteRow(-1);
}

function newRow(choose) {
  const row = make("tr");
  const button = make("button", { type: "button" });
  button.addEventListener("click", () => choose(Number(button.dataset.drone)));
  row.append(make("td", {}, button, make("small")));
  for (let n = 1; n < COLUMNS; n += 1) row.append(make("td", {}, "", make("small")));
  return row;
}

function fill(row, figures, state) {
  const [name, risk, created, arrived, missing, lost, atRisk, heard] = row.cells;
  const button = name.firstChild;
  row.classList.toggle("chosen", figures.drone === state.chosen);
  button.dataset.drone = String(figures.drone);
  say(button, String(figures.drone));
  const level = state.level(figures.drone);
  row.classList.toggle("alarm", level === "alarm");
  row.classList.toggle("warning", level === "warning");
  say(name.lastElementChild, [...(figures.base ? ["base"] : []), ...(level === undefined ? [] : [level])].join(", "));
  button.setAttribute("aria-label", `${figures.base ? "Base" : "Drone"} ${figures.drone}: open its panel`);
  const [ground, text] = riskColours(figures.risk);
  button.style.background = ground;
  button.style.color = text;
  set(risk, figures.risk === null ? "?" : figures.risk.toFixed(2));
  set(created, count(figures.created) + (state.silent(figures.drone) ? "+" : ""));
  set(arrived, count(figures.arrived));
  set(missing, count(figures.missing));
  set(lost, figures.lost === null ? "-" : count(sum(figures.lost)), figures.wounds.length ? "or more" : "");
  if (figures.base) set(atRisk, "");
  else if (figures.at_risk === null) set(atRisk, "unknown", "no status");
  else set(atRisk, `${count(figures.at_risk)} lost`, [...bound(figures), ...asOf(figures, state.now)].join(", "));
  if (figures.heard_by) set(heard, `by ${figures.heard_by[0]}`, "no data");
  else set(heard, figures.heard === null ? "never" : age(state.now - figures.heard));
}

/**
 * At most how many data are lost with a drone, in words; none for earlier times, and where there is nothing to add.
 * @returns {string[]}
 */
export function bound({ at_most: most, at_risk: data }) {
  if (most === null) return [];
  if (most[0] <= data) return most[1] ? [data ? "or more" : "as far as is known"] : [];
  return [most[1] ? `perhaps ${count(most[0])} or more` : `at most ${count(most[0])}`];
}

/** How old what a drone says is. @returns {string[]} */
export function asOf({ told }, now) {
  return told === null ? [] : [`as of ${age(now - told)} ago`];
}

function set(cell, text, more = "") {
  if (cell.firstChild.nodeType !== Node.TEXT_NODE) cell.prepend("");
  say(cell.firstChild, text);
  say(cell.lastElementChild, more);
}

/** The sum of the values of an object. */
export function sum(counts) {
  return Object.values(counts).reduce((total, n) => total + n, 0);
}

/** @param {import("./state.js").State} state */
export function showTotals(state) {
  const { totals, shown, frame } = state;
  say(by("n-created"), count(totals.created));
  say(by("n-created-what"), state.past === null && state.attention.silent.length ? "created at least" : "created");
  say(by("n-arrived"), count(totals.arrived));
  say(by("n-missing"), count(totals.missing));
  say(by("n-lost"), count(totals.lost));
  const told = shown.filter((figures) => figures.at_risk !== null || figures.base);
  say(by("n-risk"), told.length ? count(told.reduce((all, figures) => all + (figures.at_risk ?? 0), 0)) : "?");
  const { p50, p95 } = frame.delay_s;
  const parts = p50 === null || state.past !== null ? [] : [`Half of the data arrived within ${span(p50)}, 95 % within ${span(p95)}.`];
  const mute = shown.length - told.length;
  if (mute) parts.push(`At risk: without ${mute} of ${shown.length} drones, which sent no status.`);
  say(by("delays"), parts.join(" "));
  by("past-note").hidden = state.past === null;
}

/** What is out of the ordinary. */
export function showRemarks({ frame }) {
  const remarks = [...frame.remarks];
  if (frame.unlisted) remarks.push(`${frame.unlisted} data of further drones are not shown: so many ids are probably forged.`);
  remarks.push(...frame.off_map);
  if (frame.thinned > 1) remarks.push(`Earlier times show one of ${frame.thinned} readings.`);
  const list = by("remarks");
  list.hidden = remarks.length === 0;
  if (list.children.length !== remarks.length) list.replaceChildren(...remarks.map(() => make("li")));
  remarks.forEach((remark, index) => say(list.children[index], remark));
  by("trouble").hidden = !frame.trouble;
  say(by("trouble"), frame.trouble ? `The store cannot be read: ${frame.trouble}` : "");
}

const REASONS = {
  corrupted: "the checksum was wrong",
  overflow: "no space was left",
  expired: "the lifetime ran out",
  died: "all copies were on drones that failed",
  vanished: "sent without custody and never received",
  unfounded: "deleted after a message that nobody can confirm",
};

/** @param {import("./state.js").State} state */
export function showLosses(state) {
  const lost = Object.entries(state.frame.lost).filter(([, n]) => n > 0);
  const none = state.frame.totals.lost === 0 && lost.length === 0;
  const lines = none ? ["None reported."] : lost.map(([reason, n]) => `${count(n)} - ${reason}: ${REASONS[reason] ?? reason}`);
  if (state.past !== null) lines.push("As known now: when data were lost is not known.");
  const place = by("losses");
  if (place.children.length !== lines.length) place.replaceChildren(...lines.map(() => make("p")));
  lines.forEach((line, index) => say(place.children[index], line));
}

/** The running node of the store. @param {import("./state.js").State} state */
export function showNode(state) {
  const { node } = state;
  by("node-panel").hidden = !node;
  if (!node) return;
  const neighbours = node.neighbours.map(({ node_id: id, age_s: old }) => `${id} (${age(old)} ago)`);
  tell(by("node-facts"), [
    ["Node", `${node.node_id} (${node.role}), runs for ${span(node.uptime_s)}`],
    ...(node.role === "base" ? [] : [["Next hop", node.next_hop === null ? "none" : String(node.next_hop)]]),
    ["Hears", neighbours.length ? neighbours.join(", ") : "nobody"],
    ...(node.faults ? [["Faults", count(node.faults)]] : []),
  ]);
}

/** The name of the store, and how far the page is. @param {import("./state.js").State} state */
export function showHead(state, connection) {
  const { frame } = state;
  const badge = by("link");
  const bad = connection === "lost" || connection === "refused";
  badge.classList.toggle("bad", bad);
  if (connection === "refused") say(badge, "Too many pages are open");
  else if (bad) say(badge, "No connection: this is old");
  else if (frame === null) say(badge, "Connecting ...");
  else if (frame.behind) say(badge, "Reading the store ...");
  else say(badge, state.past === null ? "Live" : `At ${clock(state.past.at)}`);
  if (frame === null) return;
  say(by("store"), frame.store);
  by("logout").hidden = !frame.token;
}
