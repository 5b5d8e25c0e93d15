// Ways of the camera that need no hand: flights along edges, zooms elsewhere, and jumps. docs/web.md describes them. A jump shows a
// still of the old picture until the new one is ready, then fades it out; in a zoom the still grows.

import { cameraFor, isFixed, nearestNode, nodeHere, nodeWithin, settleAt, turn } from "./camera.js";
import { chooseArrival, findHeading, headingTo } from "./choices.js";
import { findHouse, frameDoll, isInDoll, nearestInDoll, orbit, placeInDoll } from "./doll.js";
import { byId, calm, canvas, fullSize, say } from "./dom.js";
import { clamp, DEGREE, distanceOf, ease, findWay, followEdge, isZoom, minus, nearestEdge, partOfEdge, plus, scaled, wrapAngle } from "./graph.js";
import { photographs } from "./photographs.js";
import { drawAt, measureAt, rayOf } from "./picture.js";
import { camera, changed, currentPart, GRAPH, isComplete, makeStart, state } from "./state.js";

const DOLL_SECONDS = 1.6; // duration of a flight out of the rooms, or into one
const MAX_STILL = 8e6; // pixels of the image of a still, whose memory it limits
const NEAR = HEADER.speed; // metres: a second's walk
export const PHOTO_WAIT_MS = 2000; // longest wait for a photograph: at the end of a zoom, and before the first Gaussians are loaded

function jump(position, { yaw, pitch }, grows = false) {
  takeStill(grows);
  place({ position: [...position], yaw, pitch });
}

function place(pose) {
  if (state.doll.isOn) setDoll(false); // before the pose, which may have a field of view
  Object.assign(camera, pose);
  state.headset.turnTo(camera.yaw);
  settleAt(camera.position);
  changed();
}

export function setPose(pose) {
  const next = cameraFor(pose);
  setTouring(false);
  goToPose(next);
}

// ---- the doll's house ----

export function toggleDoll() {
  const { doll } = state;
  if (doll.isOn) visit(doll.node, doll.heading);
  else if (doll.isDue) setDoll(false);
  else enterDoll();
}

// Flies out of the panorama at the camera, once the Gaussians and the atlas are there.
function enterDoll() {
  const { doll } = state;
  if (state.headset.session) {
    setDoll(false);
    return;
  }
  setTouring(false);
  doll.node = nearestNode(camera.position);
  if (!findHouse()) {
    say(byId("no-doll").textContent);
    return;
  }
  if (!canShowDoll()) {
    setDoll(false, true);
    return;
  }
  takeStill();
  setDoll(true);
  camera.roll = 0;
  Object.assign(doll, { fov: camera.fov, heading: { yaw: camera.yaw, pitch: camera.pitch } });
  flyDoll(frameDoll([innerWidth, innerHeight]));
}

const canShowDoll = () => state.sorted !== null && byId("atlas")?.complete === true;

// Flies into a panorama, and ends there; by default in its start view, or its widest one.
function visit(node, heading = chooseArrival(node, null)) {
  if (!isInDoll(node)) {
    jumpTo(node);
    return;
  }
  state.doll.node = node;
  const { position } = HEADER.spots[node], { place, turn } = placeInDoll(node, position);
  flyDoll({ position: place, ...heading, yaw: heading.yaw + turn, fov: state.doll.fov }, () => jump(position, heading));
}

// Goes to the panorama nearest to what a point of the window shows.
export function enterAt(left, top) {
  const distance = measureAt(left, top);
  if (state.doll.flight || distance === null) return;
  visit(nearestInDoll(plus(camera.position, scaled(rayOf(left, top), distance))));
}

// Opens or closes the doll's house without a flight. `isDue`: it opens when its data is there.
function setDoll(isOn, isDue = false) {
  const { doll } = state;
  if (doll.isOn && !isOn) camera.fov = doll.fov;
  Object.assign(doll, { isOn, isDue, flight: null });
  byId("doll").setAttribute("aria-pressed", isOn || isDue);
  changed();
}

function flyDoll(target, then = () => orbit(0, 0)) {
  const start = { ...camera, position: [...camera.position] };
  state.doll.flight = { start, target, then, began: null, seconds: calm.matches ? 0 : DOLL_SECONDS };
  changed();
}

export function advanceDollFlight(now) {
  if (state.doll.isDue && canShowDoll()) enterDoll();
  const { flight } = state.doll;
  if (!flight || isWaiting()) return;
  flight.began ??= now;
  const t = flight.seconds ? clamp((now - flight.began) / (1000 * flight.seconds), 0, 1) : 1, part = ease(t);
  const mix = (from, to) => from + part * (to - from);
  camera.position = flight.start.position.map((from, k) => mix(from, flight.target.position[k]));
  for (const name of ["yaw", "pitch", "fov"]) camera[name] = mix(flight.start[name], flight.target[name]);
  changed();
  if (t < 1) return;
  state.doll.flight = null;
  flight.then();
}

// ---- flights and jumps ----

// The camera goes to a panorama along the edges. On each step it turns to the way, then it flies, looking ahead, or the image
// grows and fades. A leg has what changes: a `view` to turn to, a `path` of two places, or a `view` after a zoom to the
// panorama `to`.
export function flyTo(spot) {
  if (state.doll.isOn) {
    visit(spot);
    return;
  }
  const { legs, end } = planWay(spot);
  state.way = { spot, legs: calm.matches ? [{ to: spot, view: end }] : legs, began: null };
  if (state.isTouring) state.way.legs.push({ rest: HEADER.restSeconds });
  changed();
}

// The legs of a way, and yaw and pitch at its end.
function planWay(spot) {
  const walk = findWay(GRAPH, camera.position, spot, partOfEdge(GRAPH, followEdge(GRAPH, camera.position, state.edge)));
  const here = nodeHere(), ahead = { yaw: camera.yaw, pitch: camera.pitch }, legs = [];
  let from = nodeWithin(HEADER.stopReach), position = [...camera.position], heading = ahead, end = chooseArrival(spot, ahead);
  walk.forEach((node, i) => {
    const before = i > 0 ? walk[i - 1] : null, zooms = before !== null && isZoom(GRAPH, before, node);
    const isLeft = i === 0 && node === here && isZoom(GRAPH, node, walk[1] ?? node); // a zoom begins where the camera is
    if (node === from || isLeft) return;
    heading = zooms ? findHeading(before, node) : headingTo(GRAPH.positions[node], position) || ahead;
    if (heading) legs.push({ view: heading });
    end = chooseArrival(node, heading, zooms ? before : null);
    legs.push(zooms ? { to: node, view: end } : { from, to: node, path: [position, GRAPH.positions[node]] });
    [from, position] = [node, GRAPH.positions[node]];
  });
  if (!legs.length || legs.at(-1).path && (HEADER.spots[spot].hasStart || end.yaw !== heading.yaw)) legs.push({ view: end });
  return { legs, end };
}

export function advanceWay(now) {
  const { way } = state;
  if (!way || isWaiting() || state.still?.isZoom) return;
  const [leg] = way.legs;
  if (way.began === null) beginLeg(leg, now);
  const t = leg.seconds ? clamp((now - way.began) / (1000 * leg.seconds), 0, 1) : 1, step = ease(t) - leg.done;
  leg.done = ease(t);
  if (leg.turn) turn(leg.turn[0] * step, leg.turn[1] * step); // a drag adds to it
  if (leg.path) camera.position = t < 1 ? plus(leg.path[0], scaled(minus(leg.path[1], leg.path[0]), leg.done)) : [...leg.path[1]];
  if (leg.path) changed();
  if (t < 1) return;
  if (leg.to !== undefined && !leg.path) jump(GRAPH.positions[leg.to], leg.view, !calm.matches);
  way.began = null;
  way.legs.shift();
  if (way.legs.length) {
    if (!leg.seconds && leg.to === undefined) advanceWay(now); // a zoom begins with the picture at rest, which has the full resolution
    return;
  }
  state.way = null;
  if (state.isTouring) flyTo(nextOnTour(way.spot));
}

const nextOnTour = (node) => HEADER.walk[(HEADER.walk.indexOf(node) + 1) % HEADER.walk.length];

function beginLeg(leg, now) {
  state.way.began = now;
  leg.done = 0;
  leg.seconds = leg.rest || 0;
  const [least, most] = HEADER.flightSeconds;
  if (leg.path) leg.seconds = clamp(least + HEADER.metreSeconds * (distanceOf(...leg.path) - HEADER.shortFlight), least, most);
  else if (leg.view && leg.to === undefined && !state.headset.session) { // the head turns itself
    leg.turn = [wrapAngle(leg.view.yaw - camera.yaw), leg.view.pitch - camera.pitch];
    leg.seconds = HEADER.turnSeconds * Math.min(Math.hypot(...leg.turn) / HEADER.turnAngle, 1);
  }
}

export function setTouring(value) {
  if (state.doll.isDue) setDoll(false); // another way replaces it
  state.isTouring = value && HEADER.spots.length > 1;
  if (state.isTouring && state.doll.isOn) jump(GRAPH.positions[state.doll.node], state.doll.heading);
  byId("play").setAttribute("aria-pressed", state.isTouring);
  byId("play").querySelector("path").setAttribute("d", state.isTouring ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
  if (!state.isTouring) state.way = null;
  else if (!state.way) flyTo(nextOnTour(nodeHere()));
  changed();
}

export function goHome() {
  setTouring(false);
  goToPose(makeStart());
}

// Goes to another camera; the image fades, unless the order of the Gaussians is right there too.
function goToPose(pose) {
  const isFar = distanceOf(pose.position, camera.position) > NEAR;
  const isElsewhere = partOfEdge(GRAPH, nearestEdge(GRAPH, pose.position)) !== currentPart();
  if (isFar || isElsewhere || state.headset.session) takeStill();
  place(pose);
}

export function goTo(node) {
  setTouring(false);
  flyTo(node);
  canvas.focus({ preventScroll: true });
}

// Goes to a panorama without a flight.
export function jumpTo(node) {
  setTouring(false);
  jump(GRAPH.positions[node], state.doll.isOn ? chooseArrival(node, null) : planWay(node).end);
}

export const isOnWay = () => state.way !== null;

// The still, the image of the last camera before a jump, covers the new one until that is sorted, then it fades out.
const stillCanvas = byId("still");

// Takes the still from the picture; for a zoom it is large enough to grow.
function takeStill(grows = false) {
  if (!state.renderer || !state.sorted) return;
  const zoom = grows ? Math.tan(0.5 * camera.fov * DEGREE) / Math.tan(0.5 * HEADER.zoom * camera.fov * DEGREE) : 1;
  state.still = { taken: null, began: null, left: 1, position: null, isZoom: grows, zoom };
  if (state.headset.session) return; // it fades from black
  const full = fullSize(), larger = photographs.isOpaque ? Math.max(Math.min(zoom, Math.sqrt(MAX_STILL / (full[0] * full[1]))), 1) : 1;
  const size = full.map((side) => Math.round(side * larger)), isSame = stillCanvas.width === size[0] && stillCanvas.height === size[1];
  drawAt(...(photographs.isOpaque || grows ? size : [canvas.width, canvas.height])); // it can be copied in the task that drew it
  const context = stillCanvas.getContext("2d");
  context.globalAlpha = stillCanvas.hidden || !isSame ? 1 : 1 - Number(stillCanvas.style.opacity);
  if (!isSame) [stillCanvas.width, stillCanvas.height] = size;
  context.drawImage(canvas, 0, 0, ...size);
  showStill();
  changed();
}

export function updateStill(now) {
  const { still } = state;
  if (!still) return;
  still.taken ??= now;
  still.position ??= [...camera.position];
  if (still.began === null && isUncovered(now)) still.began = now;
  if (still.began !== null) {
    const t = clamp((now - still.began) / (1000 * (still.isZoom ? HEADER.zoomSeconds : HEADER.fadeSeconds)), 0, 1);
    still.left = 1 - ease(t);
    if (t === 1) state.still = null;
  }
  showStill();
  changed();
}

// Whether what the still covers is there: the photograph, for a zoom all of it that is in the picture, or the Gaussians, where a
// photograph is late.
function isUncovered(now) {
  const { still, sorted, doll } = state, isLate = now - still.taken > PHOTO_WAIT_MS;
  if (photographs.isOpaque && (!still.isZoom || isLate || photographs.isFinal())) return true;
  if (isFixed() && !doll.isOn && photographs.first.every(({ status }) => status !== "failed")) return false;
  const isSorted = doll.isOn || sorted.part === currentPart() && distanceOf(sorted.position, still.position) < NEAR + distanceOf(camera.position, still.position);
  return isSorted && (!still.isZoom || !photographs.isExpected || isLate) && isSeen();
}

function showStill() {
  const left = coverage();
  stillCanvas.hidden = !state.still || state.headset.session !== null;
  stillCanvas.style.opacity = left;
  stillCanvas.style.transform = state.still?.isZoom ? `scale(${state.still.zoom - (state.still.zoom - 1) * left})` : "";
  byId("spots").style.opacity = 1 - left;
}

// Whether a view of the group at the camera is sorted, or all are empty.
const isSeen = () => state.doll.isOn || HEADER.groups[state.group].some((view) => state.sorted.views.includes(view) && HEADER.views[view].count) || isComplete();

// Whether nothing moves yet: the Gaussians have not arrived, or are not sorted, or an image covers them.
export const isWaiting = () => {
  const { sorted, still, doll } = state;
  return !sorted || still !== null && still.began === null || !doll.isOn && sorted.part !== currentPart();
};

// How much of the picture the image covers, or the black in a headset.
export const coverage = () => state.still ? state.still.left : 0;
