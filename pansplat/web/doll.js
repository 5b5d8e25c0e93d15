// The doll's house view: the camera turns around the rooms from outside, and nothing is drawn that shows its back. docs/web.md
// describes it. The rooms are those of the part and the storey of the panorama that the camera leaves.

import { tangentOf, turned } from "./camera.js";
import { clamp, column, DEGREE, distanceOf, dot, indexOfLeast, minus, plus, scaled } from "./graph.js";
import { camera, changed, state } from "./state.js";

const DOLL_FOV = 45;                               // degrees, vertical, of a landscape picture
const DOLL_PITCH = -45 * Math.PI / 180;            // of the first view
const LOWEST = -8 * Math.PI / 180;                 // pitch of a camera that looks along the floor
const DOLL_ZOOM = [0.15, 2];                       // of the first distance
const DOLL_TURN = Math.PI / 2;                     // radians a second, by keys

// Whether a panorama is among the rooms that are shown.
export function isInDoll(node) {
  const { parts, doll: { storeys } } = HEADER, { doll } = state;
  return parts[node] === parts[doll.node] && storeys[node] === storeys[doll.node];
}

// The boxes of the rooms, in level axes.
export const listBoxes = () => HEADER.doll === null ? [] : HEADER.doll.boxes.filter((box, view) => box && isInDoll(view));

// The Gaussians in the rooms, as [view, first, count].
export const listRanges = () => state.doll.isOn ? HEADER.doll.ranges.filter(([view]) => isInDoll(view)) : null;

// The first camera outside, from which all rooms are in a picture of a size.
export function frameDoll(size) {
  const boxes = listBoxes();
  const box = [0, 1].map((end) => [0, 1, 2].map((k) => Math[end ? "max" : "min"](...boxes.map((each) => each[end][k]))));
  const yaws = [camera.yaw, camera.yaw + 0.5 * Math.PI];  // the one that is nearer to the rooms
  const distances = yaws.map((yaw) => fitBox(box, yaw, DOLL_PITCH, size)), best = Number(distances[1] < 0.95 * distances[0]);
  const center = HEADER.level.map((row) => dot(row, scaled(plus(...box), 0.5)));
  Object.assign(state.doll, { center, first: distances[best], distance: distances[best] });
  return { position: placeOutside(yaws[best], DOLL_PITCH), yaw: yaws[best], pitch: DOLL_PITCH, fov: DOLL_FOV };
}

// The distance from which a box fits into the picture.
function fitBox(box, yaw, pitch, [width, height]) {
  const rotation = turned(yaw, pitch), middle = scaled(plus(...box), 0.5);
  const tall = tangentOf(width, height, DOLL_FOV), wide = tall * width / height;
  let distance = 0;
  for (let corner = 0; corner < 8; corner++) {
    const offset = minus([0, 1, 2].map((k) => box[corner >> k & 1][k]), middle);
    const [x, y, z] = [0, 1, 2].map((k) => dot(column(rotation, k), offset));
    distance = Math.max(distance, Math.abs(x) / wide - z, Math.abs(y) / tall - z);
  }
  return 1.05 * distance;
}

// Where a camera with these angles sees the rooms.
function placeOutside(yaw, pitch) {
  const forward = HEADER.level.map((row) => dot(row, column(turned(yaw, pitch), 2)));
  return minus(state.doll.center, scaled(forward, state.doll.distance));
}

export function orbit(yaw, pitch) {
  if (state.doll.flight) return;
  camera.yaw += yaw;
  camera.pitch = clamp(camera.pitch + pitch, -89.9 * DEGREE, LOWEST);
  camera.position = placeOutside(camera.yaw, camera.pitch);
  changed();
}

export function zoomDoll(factor) {
  const { doll } = state;
  if (doll.flight) return;
  doll.distance = clamp(doll.distance * factor, ...DOLL_ZOOM.map((limit) => limit * doll.first));
  orbit(0, 0);
}

// The keys that walk: sideways and up turn, forward comes nearer.
export function orbitByKeys([right, up, forward], seconds) {
  if (right || up) orbit(-DOLL_TURN * seconds * right, -0.5 * DOLL_TURN * seconds * up);
  if (forward) zoomDoll(Math.exp(-seconds * forward));
}

// The panorama of the rooms nearest to a point.
export const nearestInDoll = (point) => {
  return indexOfLeast(HEADER.spots.map(({ position }, node) => isInDoll(node) ? distanceOf(position, point) : Infinity));
};
