// Ways of the camera that need no hand: flights along edges, the flight through all panoramas, and jumps, which fade: the
// image of the camera before covers the new one until that is sorted, then it fades out.

import {
  camera, cameraFor, currentPart, DOLLY_MS, edge, edges, FADE_MS, GRAPH, group, makeStart, nearestNode, nodeHere, parts,
  rotationOf, settleAt, turn,
} from "./camera.js";
import { doll } from "./doll.js";
import { byId, calm, canvas } from "./dom.js";
import {
  clamp, column, distanceOf, dot, findWay, followEdge, isFade, lengthOf, minus, nearestEdge, partOfEdge, plus, scaled,
} from "./graph.js";
import { isComplete } from "./loading.js";
import { changed, drawAt, fullSize, isSortedAs, renderer, sorted } from "./loop.js";
import { photographs } from "./photographs.js";
import { headset } from "./xr.js";

const TURN_SPEED = Math.PI / 2;     // radians a second, towards a link
const NEAR = HEADER.speed;          // metres: a second's walk
const DIRECTIONS = 24;              // of the bits of `blank`
const ZOOM = 0.4;                   // of the image before, while it fades along a poor edge
const PHOTO_WAIT_MS = 2000;         // of a fade along a poor edge, at most, for the photograph where it ends
const REST_SECONDS = 4;             // at a panorama, on a tour without flights

// The heading after a fade: away from the link back, or the start view; else that of before, or from another world, whose
// directions are unknown, the widest view.
function arriveAt(node, from) {
  const back = findLink(node, from), { start, ahead } = HEADER.spots[node], { worlds } = HEADER.plan;
  if (back && back.leave) return { yaw: lookOn(node, back.yaw + Math.PI), pitch: 0 };
  if (start) return { yaw: start[0], pitch: start[1] };
  return { yaw: worlds[node] === worlds[from] ? lookOn(node, camera.yaw) : ahead, pitch: 0 };
}

// A yaw at a panorama; if it faces a wall, that of the start view or of the widest view (choose_heading).
export function lookOn(node, yaw) {
  const { start, blank, ahead } = HEADER.spots[node], turns = yaw / (2 * Math.PI) + 0.5;
  return blank >> Math.floor(DIRECTIONS * (turns - Math.floor(turns))) & 1 ? start ? start[0] : ahead : yaw;
}

const findLink = (from, to) => HEADER.links.find((link) => link.from === from && link.to === to);

// `zoom`: of the image of before, by which a fast fade along a poor edge looks like a step.
export function jump(position, { yaw, pitch }, zoom = null) {
  takeStill(zoom);
  place({ position: [...position], yaw, pitch });
}

function place(pose) {
  if (doll.isOn) doll.setOn(false);  // before the pose, which may have a field of view
  Object.assign(camera, pose);
  headset.turnTo(camera.yaw);
  settleAt(camera.position);
  changed();
}

export function setPose(pose) {
  const next = cameraFor(pose);
  setTouring(false);
  goToPose(next);
}

// A smooth flight to a panorama along the edges; the direction of view stays the user's. To another part, the camera
// turns to the link, goes a step along it, and the image fades; without a link it fades at once.
export let flight = null, touring = false;
export function flyTo(spot) {
  if (doll.isOn) {
    doll.visit(spot);
    return;
  }
  if (calm.matches) {
    flight = { spot, legs: [{ from: edges.length ? nearestNode(camera.position) : spot, to: spot }], began: null };
    if (touring) flight.legs.push({ path: [GRAPH.positions[spot]], rest: REST_SECONDS });
    changed();
    return;
  }
  const way = edges.length ? findWay(GRAPH, camera.position, spot, partOfEdge(GRAPH, followEdge(GRAPH, camera.position, edge))) : [spot];
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
  flight = { spot, legs, began: null };
  changed();
}

export const ease = (t) => t * t * t * (t * (6 * t - 15) + 10);

export function advanceFlight(now) {
  if (!flight || isWaiting()) return;
  const leg = flight.legs[0];
  if (leg.to !== undefined) {
    const isElsewhere = parts[leg.from] !== parts[leg.to], isDolly = !isElsewhere && isFade(GRAPH, leg.from, leg.to) && !calm.matches;
    const arrival = isElsewhere ? arriveAt(leg.to, leg.from) : { ...camera, yaw: lookOn(leg.to, camera.yaw) };
    jump(GRAPH.positions[leg.to], arrival, isDolly ? zoomTowards(GRAPH.positions[leg.to]) : null);
    flight.legs.shift();
    if (!flight.legs.length) flight = null;
    return;
  }
  if (flight.began === null) beginLeg(leg, now);
  const t = leg.seconds ? clamp((now - flight.began) / (1000 * leg.seconds), 0, 1) : 1;
  if (leg.length) camera.position = t < 1 ? pointAlong(leg.path, ease(t) * leg.length) : [...leg.path.at(-1)];
  turn(leg.turn[0] * (ease(t) - leg.done), leg.turn[1] * (ease(t) - leg.done));  // a drag adds to it
  leg.done = ease(t);
  changed();
  if (t < 1) return;
  flight.began = null;
  flight.legs.shift();
  if (flight.legs.length) return;
  const { spot } = flight;
  flight = null;
  if (touring) flyTo((spot + 1) % HEADER.spots.length);
}

// Of an image, as of a camera that comes nearer; none if the way leads to the side or back.
function zoomTowards(position) {
  const way = minus(position, camera.position);
  return ZOOM * Math.max(dot(column(rotationOf(camera), 2), way) / Math.max(Math.hypot(...way), 1e-9), 0);
}

function beginLeg(leg, now) {
  flight.began = now;
  leg.length = lengthOf(leg.path);
  leg.done = 0;
  const yaw = leg.yaw === undefined && leg.end !== undefined ? lookOn(leg.end, camera.yaw) : leg.yaw;
  const across = yaw === undefined || headset.session ? 0 : Math.atan2(Math.sin(yaw - camera.yaw), Math.cos(yaw - camera.yaw));
  leg.turn = [across, leg.yaw === undefined ? 0 : -camera.pitch];
  const turning = headset.session ? 0 : Math.hypot(...leg.turn) / TURN_SPEED;  // the head turns itself
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
export let route = null;
function startRoute() {
  const distances = HEADER.route.map((sample) => distanceOf(sample.slice(0, 3), camera.position));
  const least = Math.min(...distances) + 0.02 * NEAR;
  const first = distances.findIndex((distance) => distance <= least), sample = HEADER.route[first];
  const offset = minus([...camera.position, camera.yaw, camera.pitch], sample);
  offset[3] -= 2 * Math.PI * Math.round(offset[3] / (2 * Math.PI));
  const time = first / HEADER.routeRate, seconds = Math.max(1, Math.abs(offset[3]) / TURN_SPEED);
  route = { time, began: time, seconds, last: null, offset };
}

export function advanceRoute(seconds) {
  if (!route || isWaiting()) return;
  const end = HEADER.route.length - 1, before = Math.floor(route.time * HEADER.routeRate);
  route.time += seconds;
  const at = Math.min(route.time * HEADER.routeRate, end), index = Math.min(Math.floor(at), end - 1);
  if (HEADER.jumps.some((jumped) => before <= jumped && jumped < index)) {
    const [x, y, z, yaw, pitch] = HEADER.route[index];
    jump([x, y, z], { yaw, pitch });
    Object.assign(route, { time: index / HEADER.routeRate, offset: [0, 0, 0, 0, 0], last: { yaw, pitch } });
    return;
  }
  const fraction = HEADER.jumps.includes(index) ? 0 : at - index;
  const sample = plus(HEADER.route[index], scaled(minus(HEADER.route[index + 1], HEADER.route[index]), fraction));
  const left = 1 - ease(clamp((route.time - route.began) / route.seconds, 0, 1));
  const [x, y, z, yaw, pitch] = plus(sample, scaled(route.offset, left));
  camera.position = [x, y, z];
  turn(yaw - (route.last ? route.last.yaw : yaw), pitch - (route.last ? route.last.pitch : pitch));
  route.last = { yaw, pitch };
  if (at === end) setTouring(false);
}

export function setTouring(value) {
  touring = value && HEADER.spots.length > 1;
  if (touring && doll.isOn) jumpTo(doll.node);
  byId("play").setAttribute("aria-pressed", touring);
  byId("play").querySelector("path").setAttribute("d", touring ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
  if (!touring) flight = route = null;
  else if (HEADER.route.length > 1 && !calm.matches) {
    flight = null;
    startRoute();
  } else if (!flight) {
    flyTo((nearestNode(camera.position) + 1) % GRAPH.positions.length);
  }
  changed();
}

export function goHome() {
  setTouring(false);
  flight = null;
  goToPose(makeStart());
}

// Goes to another camera; the image fades, unless the order of the Gaussians is right there too.
function goToPose(pose) {
  const isFar = distanceOf(pose.position, camera.position) > NEAR;
  const isElsewhere = edges.length && partOfEdge(GRAPH, nearestEdge(GRAPH, pose.position)) !== currentPart();
  if (isFar || isElsewhere || headset.session) takeStill();
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
  const isSame = parts[node] === currentPart(), from = edges.length ? nodeHere() : node;
  jump(GRAPH.positions[node], isSame ? { ...camera, yaw: lookOn(node, camera.yaw) } : arriveAt(node, from));
}

export const isFlying = () => flight !== null || route !== null;

// The still, the image of the last camera before a jump, covers the new one until that is sorted, then it fades out.
const stillCanvas = byId("still");
export let still = null;

export function takeStill(zoom = null) {
  if (!renderer || !sorted) return;
  if (headset.session) {  // it fades from black
    still = { taken: null, began: null, left: 1, position: null, zoom: null };
    return;
  }
  const size = fullSize();  // a photograph is drawn fast
  drawAt(...(photographs.isOpaque ? size : [canvas.width, canvas.height]));  // it can be copied in the task that drew it
  const context = stillCanvas.getContext("2d");
  const isSame = stillCanvas.width === size[0] && stillCanvas.height === size[1];
  context.globalAlpha = still && isSame ? 1 - still.left : 1;
  if (!isSame) [stillCanvas.width, stillCanvas.height] = size;
  context.drawImage(canvas, 0, 0, ...size);
  still = { taken: null, began: null, left: 1, position: null, zoom };
  showStill();
  changed();
}

export function updateStill(now) {
  if (!still) return;
  still.taken ??= now;
  still.position = still.position || [...camera.position];
  const isSorted = isSortedAs() && distanceOf(sorted.position, still.position) < NEAR;
  const isThere = still.zoom === null || !photographs.isExpected || now - still.taken > PHOTO_WAIT_MS;
  if (still.began === null && isSorted && isThere && isSeen()) still.began = now;
  if (still.began !== null) {
    const t = clamp((now - still.began) / (still.zoom === null ? FADE_MS : DOLLY_MS), 0, 1);
    still.left = 1 - t * t * (3 - 2 * t);
    if (t === 1) still = null;
  }
  showStill();
  changed();
}

function showStill() {
  const left = coverage();
  stillCanvas.hidden = !still || headset.session !== null;
  stillCanvas.style.opacity = left;
  stillCanvas.style.transform = still && still.zoom ? `scale(${1 + still.zoom * (1 - left)})` : "";
  byId("spots").style.opacity = 1 - left;
}

// Whether a view of the group at the camera is sorted, or all are empty.
const isSeen = () => doll.isOn || HEADER.groups[group].some((view) => sorted.views.includes(view) && HEADER.views[view].count) || isComplete();

// Whether nothing moves yet: the Gaussians have not arrived, or an image covers them.
export const isWaiting = () => !sorted || still !== null && still.began === null;

// How much of the picture the image covers, or the black in a headset.
export const coverage = () => still ? still.left : 0;
