// What several modules change while the page is shown; what one module alone changes is in that module. HEADER is PageHeader of
// pansplat/export/page_data.py. This module, graph.js, camera.js, choices.js and doll.js need no browser.

import { distanceOf, partOfEdge } from "./graph.js";

export const { edges, parts } = HEADER;
export const GRAPH = {
  ...HEADER,
  positions: HEADER.spots.map((spot) => spot.position),
  clearances: HEADER.spots.map((spot) => spot.clearances),
};

export function makeStart() {
  const { position, ahead: [yaw, pitch] } = HEADER.spots[HEADER.walk[0]];
  return { position: [...position], yaw, pitch, roll: 0, fov: HEADER.startFov };
}
export const camera = makeStart();

// How far each view has faded in. The first ones are there at once.
export const shown = HEADER.views.map(() => 0);

export const state = {
  // The edge at the camera, and the group that is blended there; `fade` is from the views of another group.
  edge: 0,
  group: edges[0][2],
  fade: null,
  // Views whose data is requested, those whose data is there, and those whose data does not arrive and is still tried.
  requested: new Set(),
  received: new Set(),
  missing: new Set(),
  // The last order of the worker (sorter.js).
  sorted: null,
  isSorting: false,
  renderer: null, // null while the graphics are lost
  // Whether the picture is old, its scale, and when it changed last.
  isDirty: true,
  drawnScale: 0,
  lastChange: 0,
  // flight.js and jump.js
  way: null,
  isTouring: false,
  still: null,
  doll: { isOn: false, isDue: false, node: 0, heading: null, flight: null, center: null, offsets: [], size: null, first: 0, zoom: 1, fov: 0, covered: [0, 0] },
  headset: { session: null, turnTo(_yaw) {} }, // xr.js
  here: null, // the panorama at the camera of the last frame
  step: [0, 0, 0], // right, up and forward, by the keys that are held
  isFast: false,
};

export function changed() {
  state.isDirty = true;
  state.lastChange = performance.now();
}

// Draws the same camera again, when something of its picture has arrived.
export function refresh() {
  state.isDirty = true;
}

// Draws again, because `render` has drawn another picture on the canvas.
export function redraw() {
  state.drawnScale = 0;
  changed();
}

export const currentPart = () => partOfEdge(GRAPH, state.edge);
export const endsOfEdge = () => edges[state.edge].slice(0, 2);
export const isComplete = () => [...state.requested].every((view) => state.received.has(view) || state.missing.has(view));

// Whether the order is that of a camera; the doll's house needs none.
export const isSortedFor = (position, part, tolerance = 0) => {
  const { sorted, received, doll } = state;
  return sorted !== null && (doll.isOn || sorted.part === part && sorted.arrived === received.size && distanceOf(sorted.position, position) <= tolerance);
};
