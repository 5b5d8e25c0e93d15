// Ways of the camera that need no hand: flights along edges, the flight through all panoramas, and jumps, which fade: the
// image of the camera before covers the new one until that is sorted, then it fades out.

import { cameraFor, DOLLY_MS, FADE_MS, nearestNode, nodeHere, rotationOf, settleAt, turn } from "./camera.js";
import { chooseArrival, findLink } from "./choices.js";
import { findHouse, frameDoll, isInDoll, nearestInDoll, orbit, placeInDoll } from "./doll.js";
import { byId, calm, canvas, fullSize, say } from "./dom.js";
import {
  clamp, column, distanceOf, dot, findWay, followEdge, isFade, lengthOf, minus, nearestEdge, partOfEdge, plus, scaled,
} from "./graph.js";
import { photographs } from "./photographs.js";
import { drawAt, measureAt, rayOf } from "./picture.js";
import { camera, changed, currentPart, edges, GRAPH, isComplete, makeStart, parts, state } from "./state.js";

const DOLL_SECONDS = 1.6;            // of a flight out of the rooms, or into one
const TURN_SPEED = Math.PI / 2;     // radians a second, towards a link
const NEAR = HEADER.speed;          // metres: a second's walk
const ZOOM = 0.4;                   // of the image before, while it fades along a poor edge
export const PHOTO_WAIT_MS = 2000;  // for a photograph, at most: of a fade along a poor edge where it ends, and of the first Gaussians
const REST_SECONDS = 4;             // at a panorama, on a tour without flights

// `zoom`: of the image of before, by which a fast fade along a poor edge looks like a step.
export function jump(position, { yaw, pitch }, zoom = null) {
  takeStill(zoom);
  place({ position: [...position], yaw, pitch });
}

function place(pose) {
  if (state.doll.isOn) setDoll(false);  // before the pose, which may have a field of view
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

// Flies into a panorama, and ends there; by default it looks where the camera looks from outside.
function visit(node, heading = null) {
  if (!isInDoll(node)) {
    jumpTo(node);
    return;
  }
  state.doll.node = node;
  const { position } = HEADER.spots[node], { place, turn } = placeInDoll(node, position);
  const end = heading || chooseArrival(node, { yaw: camera.yaw - turn, pitch: 0 });
  flyDoll({ position: place, ...end, yaw: end.yaw + turn, fov: state.doll.fov }, () => jump(position, end));
}

// Goes to the panorama nearest to what a point of the window shows.
export function enterAt(left, top) {
  const distance = measureAt(left, top);
  if (state.doll.flight || distance === null) return;
  visit(nearestInDoll(plus(camera.position, scaled(rayOf(left, top), distance))));
}

// Without a flight. `isDue`: it opens when its data is there.
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
  const way = state.doll.flight;
  if (!way || isWaiting()) return;
  way.began ??= now;
  const t = way.seconds ? clamp((now - way.began) / (1000 * way.seconds), 0, 1) : 1, part = ease(t);
  const mix = (from, to) => from + part * (to - from);
  camera.position = way.start.position.map((from, k) => mix(from, way.target.position[k]));
  for (const name of ["yaw", "pitch", "fov"]) camera[name] = mix(way.start[name], way.target[name]);
  changed();
  if (t < 1) return;
  state.doll.flight = null;
  way.then();
}

// ---- flights and jumps ----

// A smooth flight to a panorama along the edges; the direction of view stays the user's. To another part, the camera
// turns to the link, goes a step along it, and the image fades; without a link it fades at once.
export function flyTo(spot) {
  if (state.doll.isOn) {
    visit(spot);
    return;
  }
  if (calm.matches) {
    state.flight = { spot, legs: [{ from: edges.length ? nearestNode(camera.position) : spot, to: spot }], began: null };
    if (state.isTouring) state.flight.legs.push({ path: [GRAPH.positions[spot]], rest: REST_SECONDS });
    changed();
    return;
  }
  const way = edges.length ? findWay(GRAPH, camera.position, spot, partOfEdge(GRAPH, followEdge(GRAPH, camera.position, state.edge))) : [spot];
  const legs = [];
  let path = [[...camera.position]];
  way.forEach((node, i) => {
    if (i > 0 && isFade(GRAPH, way[i - 1], node)) {
      const link = findLink(way[i - 1], node);
      legs.push({ path });
      if (link && link.leave) legs.push({ path: path.slice(-1), yaw: link.yaw }, { path: [path.at(-1), link.leave] });
      legs.push({ path: [], from: way[i - 1], to: node });
      path = [];
    } else if (i + 1 < way.length && i === 0 && isFade(GRAPH, node, way[1])) return;  // it fades where the camera is
    path.push(GRAPH.positions[node]);
  });
  legs.push({ path, end: spot });
  state.flight = { spot, legs, began: null };
  changed();
}

export const ease = (t) => t * t * t * (t * (6 * t - 15) + 10);

export function advanceFlight(now) {
  if (!state.flight || isWaiting()) return;
  const leg = state.flight.legs[0];
  if (leg.to !== undefined) {
    const isElsewhere = parts[leg.from] !== parts[leg.to], isDolly = !isElsewhere && isFade(GRAPH, leg.from, leg.to) && !calm.matches;
    jump(GRAPH.positions[leg.to], chooseArrival(leg.to, camera, leg.from), isDolly ? zoomTowards(GRAPH.positions[leg.to]) : null);
    state.flight.legs.shift();
    if (!state.flight.legs.length) state.flight = null;
    return;
  }
  if (state.flight.began === null) beginLeg(leg, now);
  const t = leg.seconds ? clamp((now - state.flight.began) / (1000 * leg.seconds), 0, 1) : 1;
  const isMoving = leg.length > 0 || leg.turn.some((angle) => angle);
  if (isMoving) {
    if (leg.length) camera.position = t < 1 ? pointAlong(leg.path, ease(t) * leg.length) : [...leg.path.at(-1)];
    turn(leg.turn[0] * (ease(t) - leg.done), leg.turn[1] * (ease(t) - leg.done));  // a drag adds to it
    leg.done = ease(t);
  }
  if (t < 1) return;
  state.flight.began = null;
  state.flight.legs.shift();
  if (state.flight.legs.length) {
    if (!isMoving) advanceFlight(now);  // a fade begins with the picture at rest, which has the full resolution
    return;
  }
  const { spot } = state.flight;
  state.flight = null;
  if (state.isTouring) flyTo((spot + 1) % HEADER.spots.length);
}

// Of an image, as of a camera that comes nearer; none if the way leads to the side or back.
function zoomTowards(position) {
  const way = minus(position, camera.position);
  return ZOOM * Math.max(dot(column(rotationOf(camera), 2), way) / Math.max(Math.hypot(...way), 1e-9), 0);
}

function beginLeg(leg, now) {
  state.flight.began = now;
  leg.length = lengthOf(leg.path);
  leg.done = 0;
  const { yaw, pitch } = leg.yaw !== undefined ? { yaw: leg.yaw, pitch: 0 } : leg.end !== undefined ? chooseArrival(leg.end, camera) : camera;
  const across = state.headset.session ? 0 : Math.atan2(Math.sin(yaw - camera.yaw), Math.cos(yaw - camera.yaw));
  leg.turn = [across, pitch - camera.pitch];
  const turning = state.headset.session ? 0 : Math.hypot(...leg.turn) / TURN_SPEED;  // the head turns itself
  leg.seconds = leg.rest || Math.max(turning, leg.length ? clamp(1.2 * leg.length / HEADER.speed, 0.6, 3 * (leg.path.length - 1)) : 0);
}

function pointAlong(path, distance) {
  for (let i = 1; i < path.length; i++) {
    const step = minus(path[i], path[i - 1]), length = Math.hypot(...step);
    if (distance < length) return plus(path[i - 1], scaled(step, distance / length));
    distance -= length;
  }
  return [...path.at(-1)];
}

// The flight through all panoramas of a tour. It begins at the point of the route that is nearest to the camera, and
// the difference in pose disappears at first. The camera turns with the route; a drag adds to it until a fade.
function startRoute() {
  const distances = HEADER.route.map((sample) => distanceOf(sample.slice(0, 3), camera.position));
  const least = Math.min(...distances) + 0.02 * NEAR;
  const first = distances.findIndex((distance) => distance <= least), sample = HEADER.route[first];
  const offset = minus([...camera.position, camera.yaw, camera.pitch], sample);
  offset[3] -= 2 * Math.PI * Math.round(offset[3] / (2 * Math.PI));
  const time = first / HEADER.routeRate, seconds = Math.max(1, Math.abs(offset[3]) / TURN_SPEED);
  state.route = { time, began: time, seconds, last: null, offset };
}

export function advanceRoute(seconds) {
  if (!state.route || isWaiting()) return;
  const end = HEADER.route.length - 1, before = Math.floor(state.route.time * HEADER.routeRate);
  state.route.time += seconds;
  const at = Math.min(state.route.time * HEADER.routeRate, end), index = Math.min(Math.floor(at), end - 1);
  if (HEADER.jumps.some((jumped) => before <= jumped && jumped < index)) {
    const [x, y, z, yaw, pitch] = HEADER.route[index];
    jump([x, y, z], { yaw, pitch });
    Object.assign(state.route, { time: index / HEADER.routeRate, offset: [0, 0, 0, 0, 0], last: { yaw, pitch } });
    return;
  }
  const fraction = HEADER.jumps.includes(index) ? 0 : at - index;
  const sample = plus(HEADER.route[index], scaled(minus(HEADER.route[index + 1], HEADER.route[index]), fraction));
  const left = 1 - ease(clamp((state.route.time - state.route.began) / state.route.seconds, 0, 1));
  const [x, y, z, yaw, pitch] = plus(sample, scaled(state.route.offset, left));
  camera.position = [x, y, z];
  turn(yaw - (state.route.last ? state.route.last.yaw : yaw), pitch - (state.route.last ? state.route.last.pitch : pitch));
  state.route.last = { yaw, pitch };
  if (at === end) setTouring(false);
}

export function setTouring(value) {
  if (state.doll.isDue) setDoll(false);  // another way replaces it
  state.isTouring = value && HEADER.spots.length > 1;
  if (state.isTouring && state.doll.isOn) jump(GRAPH.positions[state.doll.node], state.doll.heading);
  byId("play").setAttribute("aria-pressed", state.isTouring);
  byId("play").querySelector("path").setAttribute("d", state.isTouring ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
  if (!state.isTouring) Object.assign(state, { flight: null, route: null });
  else if (HEADER.route.length > 1 && !calm.matches) {
    state.flight = null;
    startRoute();
  } else if (!state.flight) {
    flyTo((nearestNode(camera.position) + 1) % GRAPH.positions.length);
  }
  changed();
}

export function goHome() {
  setTouring(false);
  state.flight = null;
  goToPose(makeStart());
}

// Goes to another camera; the image fades, unless the order of the Gaussians is right there too.
function goToPose(pose) {
  const isFar = distanceOf(pose.position, camera.position) > NEAR;
  const isElsewhere = edges.length && partOfEdge(GRAPH, nearestEdge(GRAPH, pose.position)) !== currentPart();
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
  jump(GRAPH.positions[node], chooseArrival(node, camera, edges.length ? nodeHere() : node));
}

export const isFlying = () => state.flight !== null || state.route !== null;

// The still, the image of the last camera before a jump, covers the new one until that is sorted, then it fades out.
const stillCanvas = byId("still");

export function takeStill(zoom = null) {
  if (!state.renderer || !state.sorted) return;
  if (state.headset.session) {  // it fades from black
    state.still = { taken: null, began: null, left: 1, position: null, zoom: null };
    return;
  }
  const size = fullSize();  // a photograph is drawn fast
  drawAt(...(photographs.isOpaque ? size : [canvas.width, canvas.height]));  // it can be copied in the task that drew it
  const context = stillCanvas.getContext("2d");
  const isSame = stillCanvas.width === size[0] && stillCanvas.height === size[1];
  context.globalAlpha = state.still && isSame ? 1 - state.still.left : 1;
  if (!isSame) [stillCanvas.width, stillCanvas.height] = size;
  context.drawImage(canvas, 0, 0, ...size);
  state.still = { taken: null, began: null, left: 1, position: null, zoom };
  showStill();
  changed();
}

export function updateStill(now) {
  if (!state.still) return;
  state.still.taken ??= now;
  state.still.position = state.still.position || [...camera.position];
  const isSorted = state.doll.isOn || state.sorted.part === currentPart() && distanceOf(state.sorted.position, state.still.position) < NEAR + distanceOf(camera.position, state.still.position);
  const isThere = state.still.zoom === null || !photographs.isExpected || now - state.still.taken > PHOTO_WAIT_MS;
  if (state.still.began === null && (photographs.isOpaque || isSorted && isThere && isSeen())) state.still.began = now;
  if (state.still.began !== null) {
    const t = clamp((now - state.still.began) / (state.still.zoom === null ? FADE_MS : DOLLY_MS), 0, 1);
    state.still.left = 1 - t * t * (3 - 2 * t);
    if (t === 1) state.still = null;
  }
  showStill();
  changed();
}

function showStill() {
  const left = coverage();
  stillCanvas.hidden = !state.still || state.headset.session !== null;
  stillCanvas.style.opacity = left;
  stillCanvas.style.transform = state.still && state.still.zoom ? `scale(${1 + state.still.zoom * (1 - left)})` : "";
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
