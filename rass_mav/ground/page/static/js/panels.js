// The head, totals, losses, the node.

import { by, make, say, tell } from "./dom.js";
import { age, clock, count, span } from "./words.js";

/**
 * At most how many data are lost with a drone, in words; none for earlier times, and where there is nothing to add.
 * @returns {string[]}
 */
export function bound({ at_most: most, at_risk: data }) {
  if (most === null) return [];
  if (most[0] <= data) return most[1] ? [data ? "or more" : "as far as is known"] : [];
  return [most[1] ? `perhaps ${count(most[0])} or more` : `at most ${count(most[0])}`];
}

/** What is lost if a drone fails now, in a sentence. @returns {string} */
export function riskSentence(figures, now) {
  const lost = [`${count(figures.at_risk)} data lost`, ...bound(figures)].join(", ");
  return `${lost}, of those older than ${age(now - figures.status_utc)}; newer data unknown`;
}

/** The same in the fewest characters: "6 to 2,905+", where 6 or 2,905 or more may be lost. @returns {string} */
export function riskRange({ at_most: most, at_risk: data }) {
  const more = most !== null && most[1] ? "+" : "";
  return most === null || most[0] <= data ? `${count(data)}${more}` : `${count(data)} to ${count(most[0])}${more}`;
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
  const known = shown.filter((figures) => figures.at_risk !== null || figures.base);
  say(by("n-risk"), known.length ? count(known.reduce((all, figures) => all + (figures.at_risk ?? 0), 0)) : "?");
  const { p50, p95 } = frame.delay_s;
  const parts = p50 === null || state.past !== null ? [] : [`Half of the data arrived within ${span(p50)}, 95 % within ${span(p95)}.`];
  const mute = shown.length - known.length;
  if (mute) parts.push(`At risk: without ${mute} of ${shown.length} drones, which sent no status.`);
  say(by("delays"), parts.join(" "));
  by("past-note").hidden = state.past === null;
}

/** What is out of the ordinary. */
export function showRemarks({ frame }) {
  const remarks = [...frame.remarks];
  if (frame.unlisted) remarks.push(`${frame.unlisted} data of further drones are not shown: this many ids are probably forged.`);
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
  unfounded: "deleted after a message that no base can confirm",
};

/** @param {import("./state.js").State} state */
export function showLosses(state) {
  const lost = Object.entries(state.frame.lost).filter(([, n]) => n > 0);
  const none = state.frame.totals.lost === 0 && lost.length === 0;
  const lines = none ? ["None reported."] : lost.map(([reason, n]) => `${count(n)} - ${reason}: ${REASONS[reason] ?? reason}`);
  if (state.past !== null) lines.push("As known now: the time of a loss is unknown.");
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

/** The mission's name, and how far the page is. @param {import("./state.js").State} state */
export function showHead(state, connection) {
  const { frame } = state;
  const badge = by("link");
  badge.classList.toggle("bad", connection !== "connecting" && connection !== "open");
  badge.classList.toggle("over", connection === "open" && frame !== null && frame.run !== "runs");
  say(badge, howFar(state, connection));
  if (frame === null) return;
  say(by("title"), frame.title);
  document.title = `${frame.title} - rass-mav`;
  by("logout").hidden = !frame.token;
}

/** How far the page is, in words. @param {import("./state.js").State} state */
export function howFar(state, connection) {
  const { frame } = state;
  if (connection === "refused") return "Too many pages are open";
  if (connection === "over") return "The page was stopped: the view is out of date";
  if (connection === "lost") return "No connection: the view is out of date";
  if (frame === null) return "Connecting ...";
  if (frame.behind) return "Reading the store ...";
  if (state.past !== null) return `At ${clock(state.past.at)}`;
  if (frame.run === "runs") return "Live";
  const what = frame.run === "ended" ? "Ended" : "Not running";
  if (frame.end === null) return what;
  // A mock swarm may have been ahead of the clock.
  const old = state.now - frame.end;
  return `${what}, last datum ${old < 60 ? `at ${clock(frame.end, state.now)}` : `${age(old)} ago`}`;
}
