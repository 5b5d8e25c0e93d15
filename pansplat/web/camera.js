// The camera, its projection, where it may go, the edge of the tour at it, and the weights of the views there. Convention:
// OpenCV axes (x right, y down, z forward), as everywhere in pansplat. Positions are in the scene's world, moved by its
// origin. Matrices are arrays of rows.

import { clamp, closestOnEdge, column, DEGREE, distanceOf, dot, ease, followEdge, fromAxes, indexOfLeast, limitStep, minus, multiply, nearestEdge, partOfEdge, plus, scaled, timeOf } from "./graph.js";
import { camera, changed, currentPart, edges, endsOfEdge, GRAPH, parts, shown, state } from "./state.js";

const SOFT = 0.3; // share of the way to the limit of the camera, at its end, in which steps become shorter

// Camera to world; positive yaw turns right, positive pitch up (viewer/core/camera.py). The device's motion adds a roll.
export function rotationOf({ yaw, pitch, roll }) {
  const [c, s] = [Math.cos(roll), Math.sin(roll)];
  return multiply(HEADER.level, multiply(turned(yaw, pitch), [[c, -s, 0], [s, c, 0], [0, 0, 1]]));
}

// Camera without roll to level axes.
export function turned(yaw, pitch) {
  const [cy, sy, cp, sp] = [yaw, pitch].flatMap((angle) => [Math.cos(angle), Math.sin(angle)]);
  return multiply([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]);
}

// Half the height of the image at distance 1. The field of view is that of a landscape image; a portrait one is taller.
export const tallOf = (width, height) => clamp(Math.sqrt(height / width), 1, HEADER.tallest);
export const tangentOf = (width, height, fov = camera.fov) => tallOf(width, height) * Math.tan(0.5 * fov * DEGREE);

export function turn(yaw, pitch) {
  camera.yaw += yaw;
  camera.pitch = clamp(camera.pitch + pitch, -HEADER.maxPitch, HEADER.maxPitch);
  changed();
}

// Moves along the camera's heading: right, up and forward in metres. The camera stays near the edges of its part;
// steps away from them become shorter near the limit. Nothing walks along poor edges, or into surfaces.
export function walk(right, up, forward) {
  const limit = HEADER.limits[currentPart()];
  if (state.doll.isOn || !state.sorted || !limit) return;
  const [cy, sy] = [Math.cos(camera.yaw), Math.sin(camera.yaw)];
  const local = [cy * right + sy * forward, -up, -sy * right + cy * forward];
  const step = plus(camera.position, fromAxes(HEADER.level, local));
  const target = limitStep(GRAPH, camera.position, step, currentPart());
  const from = closestOnEdge(GRAPH, nearestEdge(GRAPH, target, currentPart()), target);
  const before = distanceOf(camera.position, from), after = distanceOf(target, from);
  const outward = Math.max(after - before, 0), slower = clamp((1 - before / limit) / SOFT, 0, 1);
  const allowed = Math.min(after - (1 - slower) * outward, limit);
  camera.position = after > allowed ? plus(from, scaled(minus(target, from), allowed / after)) : target;
  changed();
}

const nearestOf = (nodes, position) => nodes[indexOfLeast(nodes.map((node) => distanceOf(GRAPH.positions[node], position)))];

// The nearest panorama, in a tour of the camera's part.
export const nearestNode = (position) => nearestOf([...parts.keys()].filter((node) => parts[node] === currentPart()), position);

// Whether the camera is where there are photographs and no Gaussians; it stays at them.
export const isFixed = () => HEADER.limits[currentPart()] === 0;

// The panorama at the camera; in the doll's house, the panorama that the camera left.
export const nodeHere = () => state.doll.isOn ? state.doll.node : nearestNode(camera.position);

// The panorama within a distance of the camera, metres; null without one, and in the doll's house.
export function nodeWithin(distance) {
  const node = nodeHere();
  return !state.doll.isOn && distanceOf(GRAPH.positions[node], camera.position) <= distance ? node : null;
}

// A camera for a pose of share.js, some of whose values may be missing; its position is within the limits. What is missing
// stays, in the doll's house that of before.
export function cameraFor({ position, yaw, pitch, fov }) {
  const { doll } = state, before = doll.isOn ? { position: GRAPH.positions[doll.node], ...doll.heading, fov: doll.fov } : camera;
  const found = { ...camera, ...before, position: [...before.position], roll: 0 };
  const check = (name, values) => {
    if (!values.every(Number.isFinite)) throw new Error(`The ${name} of a pose needs finite numbers, got ${JSON.stringify(values)}.`);
  };
  if (position !== undefined) {
    check("position", [0, 1, 2].map((k) => position[k]));
    const near = nearestEdge(GRAPH, position), closest = closestOnEdge(GRAPH, near, position), limit = HEADER.limits[partOfEdge(GRAPH, near)];
    const from = limit ? closest : GRAPH.positions[nearestOf(edges[near].slice(0, 2), closest)];
    const away = distanceOf(position, from);
    found.position = plus(from, scaled(minus(position, from), Math.min(limit / Math.max(away, 1e-9), 1)));
  }
  check("angles", [yaw, pitch, fov].filter((value) => value !== undefined));
  if (yaw !== undefined) found.yaw = yaw * DEGREE;
  if (pitch !== undefined) found.pitch = clamp(pitch * DEGREE, -HEADER.maxPitch, HEADER.maxPitch);
  if (fov !== undefined) found.fov = clamp(fov, HEADER.minFov, HEADER.maxFov);
  return found;
}

export const findSpot = (position) => HEADER.spots[nearestNode(position)];

// The place of the floor below a position: along an edge, between those of its panoramas.
export function floorPoint(position) {
  const [from, to] = endsOfEdge(), [start, end] = [from, to].map((node) => GRAPH.positions[node]);
  const part = distanceOf(closestOnEdge(GRAPH, state.edge, position), start) / Math.max(distanceOf(start, end), 1e-6);
  return plus(HEADER.spots[from].mark, scaled(minus(HEADER.spots[to].mark, HEADER.spots[from].mark), part));
}

const MIN_WEIGHT = 1e-4; // least weight of a view: with it, the other views fill the holes of a view at its own camera

// Weights of the views of a group in a picture of a position and a direction: blend_weights of pansplat. Other views
// have weight 0.
function groupWeights(group, position, forward) {
  const views = HEADER.groups[group], weights = HEADER.views.map(() => 0);
  const distances = views.map((view) => distanceOf(position, GRAPH.positions[view]));
  const nearest = Math.min(...distances);
  const closeness = views.map((view, i) => {
    const ahead = dot(minus(GRAPH.positions[view], position), forward) / (distances[i] || 1);
    return (distances[i] > 0 ? nearest / distances[i] : 1) * Math.exp(HEADER.ahead * ahead);
  });
  const sum = closeness.reduce((a, b) => a + b);
  for (const [i, view] of views.entries()) weights[view] = Math.max(closeness[i] / sum, MIN_WEIGHT);
  return weights;
}

// The views of the edge at the camera, and for a second after a change also those of the edge before. A view fades in
// when it has arrived.
export function blendWeights({ position, rotation }) {
  const { fade } = state, [weights, old] = [state, fade || state].map(({ group }) => groupWeights(group, position, column(rotation, 2)));
  const done = fade ? fade.done : 1;
  return weights.map((weight, view) => shown[view] * (done * weight + (1 - done) * old[view]));
}

// The views that are sorted fade in.
export function showViews(step) {
  const { sorted } = state;
  if (!sorted?.views.some((view) => shown[view] < 1)) return;
  const isFirst = !sorted.views.some((view) => shown[view] && HEADER.views[view].count);
  for (const view of sorted.views) shown[view] = isFirst ? 1 : Math.min(shown[view] + step, 1);
  changed();
}

// Chooses the edge at the camera; its views fade in.
export function updateEdge(now) {
  const { fade } = state;
  if (fade) {
    const t = timeOf(now, fade.began, HEADER.fadeSeconds);
    fade.done = ease(t);
    if (t === 1) state.fade = null;
    changed();
    return;
  }
  const chosen = followEdge(GRAPH, camera.position, state.edge);
  if (chosen === state.edge) return;
  const old = state.group, part = currentPart();
  settle(chosen);
  if (state.group !== old && part === currentPart()) state.fade = { group: old, began: now, done: 0 };
  changed();
}

// Shows the views of an edge at once.
function settle(number) {
  Object.assign(state, { edge: number, group: edges[number][2], fade: null });
}

export const settleAt = (position) => settle(nearestEdge(GRAPH, position));
