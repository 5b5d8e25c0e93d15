// The doll's house view: the camera turns around the rooms from outside, and no wall is drawn that shows its back. docs/web.md
// describes it.

import { rotationOf, tangentOf, turned } from "./camera.js";
import { clamp, cross, DEGREE, distanceOf, dot, fromAxes, inAxes, indexOfLeast, minus, plus, scaled } from "./graph.js";
import { camera, changed, GRAPH, state } from "./state.js";

const DOLL_FOV = 45; // degrees, vertical, of a landscape picture
const DOLL_PITCH = -45 * DEGREE; // pitch of the first view
const LOWEST = -8 * DEGREE; // pitch of a camera that looks along the floor
const DOLL_ZOOM = [0.15, 2]; // nearest and farthest, as factors of the distance from which all rooms are in the picture
const BUTTON_ROW = 56; // height of the row of buttons at the bottom, pixels
const DOLL_TURN = Math.PI / 2; // radians a second, by keys

// The house of the panorama that the camera leaves: corners of triangles (x, y, z, and u, v in the atlas).
export const findHouse = (node = state.doll.node) => HEADER.doll.find(({ nodes }) => nodes.includes(node));

// Whether a panorama is in the house that is shown.
export const isInDoll = (node) => findHouse().nodes.includes(node);

// Where a place around a panorama is in the house, and what yaws there are turned by: rooms of other worlds stand beside it.
export function placeInDoll(node, place, { nodes, moves } = findHouse()) {
  const [turn, ...shown] = moves[nodes.indexOf(node)], offset = inAxes(HEADER.level, minus(place, GRAPH.positions[node]));
  return { place: plus(shown, fromAxes(HEADER.level, fromAxes(turned(turn, 0), offset))), turn };
}

// The first camera outside, from which all rooms are in a picture of a size.
export function frameDoll(size) {
  const { place, turn } = placeInDoll(state.doll.node, camera.position);
  Object.assign(camera, { position: place, yaw: camera.yaw + turn });
  const places = findHouse().corners.map((place) => inAxes(HEADER.level, place));
  const box = ["min", "max"].map((end) => [0, 1, 2].map((k) => places.reduce((found, place) => Math[end](found, place[k]), places[0][k])));
  const yaws = [camera.yaw, camera.yaw + 0.5 * Math.PI]; // the one that is nearer to the rooms
  const middle = scaled(plus(...box), 0.5), offsets = places.map((place) => minus(place, middle));
  const distances = yaws.map((yaw) => fit(offsets, yaw, DOLL_PITCH, size)), best = Number(distances[1] < 0.95 * distances[0]);
  Object.assign(state.doll, { center: fromAxes(HEADER.level, middle), offsets, size, first: distances[best], zoom: 1 });
  return { position: placeOutside(yaws[best], DOLL_PITCH), yaw: yaws[best], pitch: DOLL_PITCH, fov: DOLL_FOV };
}

// To the right and down: the ends of what is free between the floor plan, at the left or in a portrait picture at the top, and the
// buttons, -1 to 1; and half of the size of the picture at a distance of 1.
function frame([width, height]) {
  const tall = tangentOf(width, height, DOLL_FOV), [right, bottom] = state.doll.covered;
  const [left, top] = height > width ? [-1, Math.min(2 * bottom / height, 1) - 1] : [Math.min(2 * right / width, 1) - 1, -1];
  return [[left, 1, tall * width / height], [top, 1 - 2 * BUTTON_ROW / height, tall]];
}

// The least distance at which all places are in the free area of the window.
function fit(offsets, yaw, pitch, size) {
  const rotation = turned(yaw, pitch), sides = frame(size);
  const needed = offsets.map((offset) => {
    const [x, y, z] = inAxes(rotation, offset);
    return Math.max(...sides.map(([low, high, half], k) => 2 * Math.max([x, y][k] / half - high * z, low * z - [x, y][k] / half) / (high - low)));
  });
  return 1.05 * needed.reduce((most, each) => Math.max(most, each));
}

// Where a camera with these angles sees all rooms, unless a visitor has come nearer.
function placeOutside(yaw, pitch) {
  const { center, offsets, size, first, zoom } = state.doll, aside = frame(size).map(([low, high, half]) => 0.5 * (low + high) * half);
  const distance = zoom * Math.max(first, fit(offsets, yaw, pitch, size));
  return minus(center, scaled(fromAxes(rotationOf({ yaw, pitch, roll: 0 }), [...aside, 1]), distance));
}

export function orbit(yaw, pitch) {
  if (state.doll.flight) return;
  camera.yaw += yaw;
  camera.pitch = clamp(camera.pitch + pitch, -HEADER.maxPitch, LOWEST);
  camera.position = placeOutside(camera.yaw, camera.pitch);
  changed();
}

// Frames the house for a window of another size; during a flight its end follows.
export function resizeDoll(size) {
  const { doll } = state;
  Object.assign(doll, { size, first: fit(doll.offsets, camera.yaw, DOLL_PITCH, size) });
  orbit(0, 0);
}

export function zoomDoll(factor) {
  const { doll } = state;
  if (doll.flight) return;
  doll.zoom = clamp(doll.zoom * factor, ...DOLL_ZOOM);
  orbit(0, 0);
}

// The keys that walk: sideways and up turn, forward comes nearer.
export function orbitByKeys(step, seconds) {
  const [right, up, forward] = step;
  if (right || up) orbit(-DOLL_TURN * seconds * right, -0.5 * DOLL_TURN * seconds * up);
  if (forward) zoomDoll(Math.exp(-seconds * forward));
}

// The panorama of the rooms nearest to a point.
export const nearestInDoll = (point) => {
  return indexOfLeast(GRAPH.positions.map((position, node) => isInDoll(node) ? distanceOf(placeInDoll(node, position).place, point) : Infinity));
};

// The distance to the first front of the house along a ray; null without one. Corners are clockwise in front.
export function meetHouse(origin, ray, { corners } = findHouse()) {
  let nearest = null;
  for (let first = 0; first < corners.length; first += 3) {
    const [a, b, c] = corners.slice(first, first + 3), normal = cross(minus(b, a), minus(c, a)), toward = dot(normal, ray);
    if (toward <= 0 || Math.max(a[3], a[4]) > 1) continue; // backs, and the tops of walls
    const distance = dot(normal, minus(a, origin)) / toward, place = plus(origin, scaled(ray, distance));
    const isInside = [[a, b], [b, c], [c, a]].every(([from, to]) => dot(cross(minus(to, from), minus(place, from)), normal) >= 0);
    if (isInside && distance > 0 && (nearest === null || distance < nearest)) nearest = distance;
  }
  return nearest;
}
