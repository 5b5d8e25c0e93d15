// Frames: the order of the Gaussians, drawing, pictures and measuring. A frame is drawn only if something changed. While it
// moves, the scale of the resolution follows the time between frames; at rest the image has the full resolution.

import {
  blendWeights, camera, currentPart, edges, fade, FADE_MS, GRAPH, nodeHere, rotationOf, shown, showViews, tangentOf,
  updateEdge,
} from "./camera.js";
import { doll } from "./doll.js";
import { canvas } from "./dom.js";
import { embed } from "./embed.js";
import { advanceFlight, advanceRoute, flight, isWaiting, route, still, updateStill } from "./flight.js";
import { clamp, column, distanceOf, dot, minus, scaled } from "./graph.js";
import { walkByKeys } from "./input.js";
import { arrived, isComplete, loadAround, worker } from "./loading.js";
import { measure } from "./measure.js";
import { placeNotes } from "./notes.js";
import { photographs } from "./photographs.js";
import { plan } from "./plan.js";
import { placeRings, showPlace } from "./rings.js";
import { headset, SORT_DISTANCE } from "./xr.js";

const MAX_PIXELS = 3e6;             // of the canvas: limits the memory of its render targets
const SLOW_MS = 45, FAST_MS = 25;   // of a frame: above, the resolution falls; below, it rises
const PAUSE_MS = 1000;              // a longer frame is not measured
const REST_MS = 200;                // after a change, until the full resolution is drawn
const LEAST_SCALE = 0.25;           // of the resolution
const scales = [1, 1];              // of the resolution while it moves: of Gaussians, and of photographs

export let renderer = null, sorted = null, sorting = false, dirty = true, drawnScale = 0, lastChange = 0, lastFrame = 0;

export function changed() {
  dirty = true;
  lastChange = performance.now();
}

// Draws the same camera again, when something of its picture has arrived.
export function refresh() {
  dirty = true;
}

// Draws the next frame, which another one has replaced.
export function redraw() {
  drawnScale = 0;
  changed();
}

// `value`: a renderer that has the data, or null while the graphics are lost.
export function setRenderer(value) {
  renderer = value;
  if (renderer && sorted) renderer.setSorted(sorted);
  changed();
}

// Whether the order is that of the part, and of the doll's house view or of panoramas, as the page shows it.
export const isSortedAs = (part = currentPart()) => sorted.part === part && (sorted.ranges !== null) === doll.isOn;

export const isSortedFor = (position, part, tolerance = 0) => {
  return sorted !== null && isSortedAs(part) && sorted.arrived === arrived && distanceOf(sorted.position, position) <= tolerance;
};

// `tolerance`: distance in metres for which the order of before is kept.
export function requestSort(tolerance) {
  if (sorting || isSortedFor(camera.position, currentPart(), tolerance)) return;
  sorting = true;
  worker.postMessage({ position: [...camera.position], part: currentPart(), ranges: doll.ranges });
}

export function onSorted(data) {
  sorting = false;
  sorted = data;
  if (renderer) renderer.setSorted(data);
  dirty = true;
}

// Whether the picture is final: all data is there and sorted for the camera, nothing moves or fades, and it is drawn.
export function isSettled() {
  const isDrawn = headset.session !== null || !dirty && drawnScale === 1, tolerance = headset.session ? SORT_DISTANCE : 0;
  const isMoving = [flight, route, doll.flight, fade, still].some((each) => each !== null);
  return isDrawn && !isMoving && photographs.isFinal() && isComplete() && isSortedFor(camera.position, currentPart(), tolerance) && sorted.views.every((view) => shown[view] === 1);
}

// Of the canvas at the full resolution.
export function fullSize() {
  const { clientWidth, clientHeight } = canvas, ratio = Math.min(devicePixelRatio || 1, 2);
  const full = Math.min(ratio, Math.sqrt(MAX_PIXELS / (clientWidth * clientHeight || 1)));
  return [clientWidth, clientHeight].map((side) => Math.max(Math.round(side * full), 1));
}

export function drawAt(width, height) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const rotation = rotationOf(camera), tangent = tangentOf(width, height), half = [tangent * width / height, tangent];
  const seen = { position: camera.position, rotation, center: [0, 0], half };
  if (!photographs.isOpaque) renderer.draw(seen, blendWeights(camera.position), null, [0, 0, width, height]);
  photographs.draw(seen, width, height);
  return rotation;
}

// Moves what moves by itself, `seconds` after the last time.
export function advance(now, seconds) {
  advanceFlight(now);
  advanceRoute(seconds);
  doll.advance(now);
  if (edges.length && !doll.isOn) updateEdge(now);
  updateStill(now);
  showViews(1000 * seconds / FADE_MS);
  photographs.update(seconds);
  loadAround();
  const node = nodeHere(), isMoving = flight !== null || doll.flight !== null || isWaiting();
  const isThere = !isMoving && !doll.isOn && distanceOf(GRAPH.positions[node], camera.position) < HEADER.spots[node].radius;
  embed.follow(isThere ? node : null, isMoving);
}

export function onFrame(now) {
  requestAnimationFrame(onFrame);
  if (headset.session) return;  // it has frames of its own
  const elapsed = now - lastFrame, seconds = Math.min(elapsed, 100) / 1000;
  lastFrame = now;
  walkByKeys(seconds);
  advance(now, seconds);
  if (sorted) requestSort();
  const moving = now - lastChange < REST_MS;
  const kind = Number(photographs.isOpaque);
  if (moving && drawnScale && elapsed < PAUSE_MS) scales[kind] = clamp(scales[kind] * (elapsed > SLOW_MS ? 0.85 : elapsed < FAST_MS ? 1.05 : 1), LEAST_SCALE, 1);
  const wanted = moving ? scales[kind] : 1;
  if (!renderer || !(sorted || photographs.isOpaque) || !(dirty || wanted > drawnScale)) return;
  dirty = false;
  drawnScale = wanted;
  const rotation = drawAt(...fullSize().map((side) => Math.max(Math.round(side * wanted), 1)));
  placeRings(rotation);
  showMarks(rotation);
  showPlace();
  plan.show();
}

// The place of a point of the window on the image plane, and its direction in the scene.
function planeOf(left, top) {
  const { clientWidth: width, clientHeight: height } = canvas, step = 2 * tangentOf(width, height) / height;
  return [(left - 0.5 * width) * step, (top - 0.5 * height) * step];
}

export function rayOf(left, top) {
  const ray = [...planeOf(left, top), 1];
  return scaled(rotationOf(camera).map((row) => dot(row, ray)), 1 / Math.hypot(...ray));
}

// The distance from the camera to what a point of the window shows, or null.
export function measureAt(left, top) {
  if (!renderer || !sorted) return null;
  const [width, height] = fullSize(), tangent = tangentOf(width, height), half = [tangent / height, tangent / height];
  const seen = { position: camera.position, rotation: rotationOf(camera), center: planeOf(left, top), half };
  return renderer.measure(seen, blendWeights(camera.position));
}

function showMarks(rotation) {
  const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
  const toCamera = (point) => [0, 1, 2].map((k) => dot(column(rotation, k), minus(point, camera.position)));
  const toWindow = ([x, y, z]) => [0.5 * width + focal * x / z, 0.5 * height + focal * y / z];
  measure.show(toCamera, toWindow);
  placeNotes(rotation, toWindow);
}

export function takePicture() {
  if (!renderer || !sorted) return null;
  drawAt(...fullSize());
  changed();
  return new Promise((resolve) => { canvas.toBlob(resolve, "image/png"); });
}
