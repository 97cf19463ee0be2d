// Puts the parts of the page together.

import { Attention } from "./attention.js";
import { ArrivalsChart } from "./chart.js";
import { by } from "./dom.js";
import { DronePanel } from "./drone.js";
import { startFeed } from "./feed.js";
import { MissionMap } from "./map.js";
import { showDrones, showHead, showLosses, showNode, showRemarks, showTotals } from "./panels.js";
import { Slider } from "./slider.js";
import { showSources } from "./sources.js";
import { showNotes } from "./notes.js";
import { showSpots } from "./spots.js";
import { State } from "./state.js";
import { startTheme } from "./theme.js";

/** Ages grow while nothing arrives: milliseconds. */
const TICK_MS = 1000;

const state = new State();
let connection = "connecting";
let due = false;

/** Draw soon: once, however much has changed. */
function changed() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    show();
  });
}

function choose(id) {
  state.chosen = id;
  panel.open();
  map.reveal(id);
  changed();
}

function close() {
  const id = state.chosen;
  state.chosen = null;
  panel.show();
  document.querySelector(`#drones button[data-drone="${id}"]`)?.focus();
  changed();
}

const map = new MissionMap(state, choose);
const panel = new DronePanel(state, close);
const slider = new Slider(state, changed);
const attention = new Attention(state);
const arrivals = new ArrivalsChart(by("arrivals"));

function show() {
  showHead(state, connection);
  if (state.frame === null) return;
  attention.show();
  slider.show();
  map.show();
  showSpots(state, map.spots, (place) => map.lookAt(place));
  showNotes(state, map.notes, (place) => map.lookAt(place));
  showSources(state, map.sources);
  showFigures();
  arrivals.show(state.frame.arrivals, state.past === null ? Infinity : state.past.at);
}

function showFigures() {
  showTotals(state);
  showRemarks(state);
  showDrones(state, choose);
  showLosses(state);
  showNode(state);
  panel.show();
}

startTheme(by("theme"), () => {
  arrivals.clear();
  panel.repaint();
  map.repaint();
  changed();
});

startFeed(
  {
    mission: (mission) => {
      state.takeMission(mission);
      changed();
    },
    news: (news) => {
      state.takeNews(news);
      changed();
    },
    attention: (news) => {
      state.takeAttention(news);
      changed();
    },
    node: ({ node, now }) => {
      state.takeNow(now);
      state.node = node;
      changed();
    },
    sources: ({ sources }) => {
      state.takeSources(sources);
      changed();
    },
    contours: ({ contours }) => {
      state.takeContours(contours);
      changed();
    },
    beat: ({ now }) => state.takeNow(now),
  },
  (now) => {
    if (now === connection) return;
    connection = now;
    changed();
  },
);

setInterval(() => {
  if (state.frame !== null && !document.hidden) showFigures();
}, TICK_MS);
