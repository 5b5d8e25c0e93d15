// Frames. One is drawn only if something changed. While the picture moves, the scale of its resolution follows the time
// between frames; at rest it has the full resolution.

import { nodeWithin, showViews, tangentOf, updateEdge, walk } from "./camera.js";
import { orbitByKeys } from "./doll.js";
import { canvas, fullSize } from "./dom.js";
import { embed } from "./embed.js";
import { advanceDollFlight, advanceWay } from "./flight.js";
import { clamp, inAxes, minus, scaled } from "./graph.js";
import { isWaiting, updateStill } from "./jump.js";
import { loadAround, requestSort } from "./loading.js";
import { measure } from "./measure.js";
import { placeNotes } from "./notes.js";
import { photographs } from "./photographs.js";
import { drawAt } from "./picture.js";
import { plan } from "./plan.js";
import { placeRings, showPlace } from "./rings.js";
import { camera, currentPart, isComplete, isSortedFor, shown, state } from "./state.js";

const SLOW_MS = 45, FAST_MS = 25; // times of a frame: above the first the resolution falls, below the second it rises
const PAUSE_MS = 1000; // a longer frame is not measured
const REST_MS = 200; // after a change, until the full resolution is drawn
export const SORT_DISTANCE = 0.01; // metres from the point for which a headset's Gaussians are sorted
const LEAST_SCALE = 0.25; // scale of the resolution, at least
const EXPOSURE_MS = 1000 / 30; // longest exposure of a frame of a flight, during which its Gaussians blur
const scales = [1, 1]; // scales of the resolution while the picture moves: that of Gaussians, and that of photographs
let lastFrame = 0;

// Whether the picture is final: all data is there and sorted for the camera, nothing moves or fades, and it is drawn.
export function isSettled() {
  const isDrawn = state.headset.session !== null || !state.isDirty && state.drawnScale === 1, tolerance = state.headset.session ? SORT_DISTANCE : 0;
  const isMoving = state.doll.isDue || [state.way, state.doll.flight, state.fade, state.still].some((each) => each !== null);
  return isDrawn && !isMoving && photographs.isFinal() && isComplete() && isSortedFor(camera.position, currentPart(), tolerance) &&
    state.sorted.views.every((view) => shown[view] === 1);
}

// Moves what moves by itself, `seconds` after the last time.
export function advance(now, seconds) {
  advanceWay(now);
  advanceDollFlight(now);
  if (!state.doll.isOn) updateEdge(now);
  showViews(seconds / HEADER.fadeSeconds);
  photographs.update(seconds);
  updateStill(now);
  loadAround();
  const isMoving = state.way !== null || state.doll.flight !== null || isWaiting();
  embed.follow(isMoving ? null : nodeWithin(HEADER.ringRadius), isMoving);
}

export function onFrame(now) {
  requestAnimationFrame(onFrame);
  if (state.headset.session) return; // it has frames of its own
  const elapsed = now - lastFrame, seconds = Math.min(elapsed, 100) / 1000;
  const before = [...camera.position];
  lastFrame = now;
  if (state.doll.isOn) orbitByKeys(state.step, seconds);
  else if (state.step.some((value) => value)) walk(...scaled(state.step, seconds * HEADER.speed * (state.isFast ? HEADER.fast : 1)));
  advance(now, seconds);
  if (state.sorted) requestSort();
  const moving = now - state.lastChange < REST_MS;
  const kind = Number(photographs.isOpaque);
  if (moving && state.drawnScale && elapsed < PAUSE_MS) scales[kind] = clamp(scales[kind] * (elapsed > SLOW_MS ? 0.85 : elapsed < FAST_MS ? 1.05 : 1), LEAST_SCALE, 1);
  const wanted = moving ? scales[kind] : 1;
  if (!state.renderer || !(state.sorted || photographs.isOpaque) || !(state.isDirty || wanted > state.drawnScale)) return;
  state.isDirty = false;
  state.drawnScale = wanted;
  const shift = scaled(minus(camera.position, before), state.way && !state.still ? Math.min(EXPOSURE_MS / Math.max(elapsed, 1), 1) : 0);
  const rotation = drawAt(...fullSize().map((side) => Math.max(Math.round(side * wanted), 1)), shift);
  placeRings(rotation);
  showMarks(rotation);
  showPlace();
  plan.show();
}

function showMarks(rotation) {
  const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
  const toCamera = (point) => inAxes(rotation, minus(point, camera.position));
  const toWindow = ([x, y, z]) => [0.5 * width + focal * x / z, 0.5 * height + focal * y / z];
  measure.show(toCamera, toWindow);
  placeNotes(rotation, toWindow);
}
