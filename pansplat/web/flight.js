// What moves the camera by itself: ways to a panorama, on which it turns, flies along edges, and zooms elsewhere, and flights out of
// the rooms, to the doll's house, and back. docs/web.md describes them.

import { nearestNode, nodeHere, turn } from "./camera.js";
import { chooseArrival, planWay } from "./choices.js";
import { findHouse, frameDoll, isInDoll, nearestInDoll, orbit, placeInDoll } from "./doll.js";
import { byId, calm, canvas, say } from "./dom.js";
import { clamp, distanceOf, ease, minus, plus, scaled, timeOf, wrapAngle } from "./graph.js";
import { canShowDoll, setDoll } from "./house.js";
import { endWay, isWaiting, jump, jumpTo, setTouring, takeStill } from "./jump.js";
import { measureAt, rayOf } from "./picture.js";
import { camera, changed, GRAPH, state } from "./state.js";

const DOLL_SECONDS = 1.6; // duration of a flight out of the rooms, or into one

export function goTo(node) {
  endWay();
  flyTo(node);
  canvas.focus({ preventScroll: true });
}

// Goes to a panorama along the edges; in a tour, the camera rests there.
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

export function advanceWay(now) {
  const { way } = state;
  if (!way || isWaiting() || state.still?.isZoom) return;
  const [leg] = way.legs;
  if (way.began === null) beginLeg(leg, now);
  const t = timeOf(now, way.began, leg.seconds), step = ease(t) - leg.done;
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

const nextOnTour = (node) => HEADER.walk[(HEADER.walk.indexOf(node) + 1) % HEADER.walk.length];

// Starts the tour, or ends it.
export function toggleTour() {
  if (state.isTouring || HEADER.spots.length < 2) {
    endWay();
    return;
  }
  if (state.doll.isDue) setDoll(false);
  setTouring(true);
  if (state.doll.isOn) jump(GRAPH.positions[state.doll.node], state.doll.heading);
  if (!state.way) flyTo(nextOnTour(nodeHere()));
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
  endWay();
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
  const t = timeOf(now, flight.began, flight.seconds), part = ease(t);
  const mix = (from, to) => from + part * (to - from);
  camera.position = flight.start.position.map((from, k) => mix(from, flight.target.position[k]));
  for (const name of ["yaw", "pitch", "fov"]) camera[name] = mix(flight.start[name], flight.target[name]);
  changed();
  if (t < 1) return;
  state.doll.flight = null;
  flight.then();
}
