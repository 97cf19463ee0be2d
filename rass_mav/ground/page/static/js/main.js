// Puts the parts of the page together.

import { Attention } from "./attention.js";
import { ArrivalsChart, resizeCharts } from "./chart.js";
import { Comparison } from "./compare.js";
import { by } from "./dom.js";
import { DronePanel } from "./drone.js";
import { startFeed } from "./feed.js";
import { MissionMap } from "./map.js";
import { Measure } from "./measure.js";
import { howFar, showHead, showLosses, showNode, showRemarks, showTotals } from "./panels.js";
import { showFormats, startPrint } from "./save.js";
import { Slider } from "./slider.js";
import { showSources } from "./sources.js";
import { showNotes } from "./notes.js";
import { showSpots } from "./spots.js";
import { State } from "./state.js";
import { DroneTable } from "./table.js";
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
const table = new DroneTable(state, choose);
const comparison = new Comparison(state);
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
  showFormats(state.frame.exports);
  comparison.show();
  arrivals.show(state.frame.arrivals, state.past === null ? Infinity : state.past.at);
}

function showFigures() {
  showTotals(state);
  showRemarks(state);
  table.show();
  showLosses(state);
  showNode(state);
  panel.show();
}

/** Everything is drawn in new colours. */
function repaint() {
  arrivals.clear();
  panel.repaint();
  comparison.repaint();
  map.repaint();
}

startTheme(by("theme"), () => {
  repaint();
  changed();
});

new Measure(map.leaflet);
startPrint(
  map.leaflet,
  () => {
    resizeCharts();
    repaint();
    show();
    table.show(true);
    map.fit(40);
  },
  () => howFar(state, connection),
);

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
    node: ({ node, run, now }) => {
      state.takeNow(now);
      state.takeRun(run);
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
    beat: ({ run, now }) => {
      state.takeNow(now);
      state.takeRun(run);
    },
  },
  (now) => {
    if (now === connection) return;
    connection = now;
    changed();
  },
);

setInterval(() => {
  if (state.frame === null || document.hidden) return;
  showHead(state, connection);
  showFigures();
}, TICK_MS);
