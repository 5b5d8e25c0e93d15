// Pictures of the camera, and what a point of the window shows.

import { blendWeights, isFixed, nodeHere, rotationOf, tangentOf } from "./camera.js";
import { findHouse, meetHouse, placeInDoll } from "./doll.js";
import { canvas, fullSize } from "./dom.js";
import { fromAxes, minus, plus, unit } from "./graph.js";
import { drawHouse } from "./house.js";
import { photographs } from "./photographs.js";
import { camera, changed, state } from "./state.js";

// `shift`: of the camera during the exposure, by which Gaussians blur.
export function drawAt(width, height, shift) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const rotation = rotationOf(camera), tangent = tangentOf(width, height), half = [tangent * width / height, tangent];
  const seen = { position: camera.position, rotation, center: [0, 0], half, shift };
  if (state.doll.isOn) drawHouse(seen, width, height);
  else if (!photographs.isOpaque) state.renderer.draw(seen, blendWeights(seen), null, [0, 0, width, height]);
  photographs.draw(seen, width, height);
  return rotation;
}

// The place of a point of the window on the image plane, and its direction in the scene.
function planeOf(left, top) {
  const { clientWidth: width, clientHeight: height } = canvas, step = 2 * tangentOf(width, height) / height;
  return [(left - 0.5 * width) * step, (top - 0.5 * height) * step];
}

export const rayOf = (left, top) => unit(fromAxes(rotationOf(camera), [...planeOf(left, top), 1]));

// The distance from the camera to what a point of the window shows, or null.
export function measureAt(left, top) {
  if (!state.renderer || !state.sorted) return null;
  if (state.doll.isOn) return meetHouse(camera.position, rayOf(left, top));
  if (isFixed()) return measureRoom(nodeHere(), rayOf(left, top));
  const [width, height] = fullSize(), tangent = tangentOf(width, height), half = [tangent / height, tangent / height];
  const seen = { position: camera.position, rotation: rotationOf(camera), center: planeOf(left, top), half };
  return state.renderer.measure(seen, blendWeights(seen));
}

// The same in a room without Gaussians, by the walls of the doll's house.
function measureRoom(node, ray) {
  const house = findHouse(node);
  if (!house) return null;
  const [origin, end] = [camera.position, plus(camera.position, ray)].map((place) => placeInDoll(node, place, house).place);
  return meetHouse(origin, minus(end, origin), house);
}

export function takePicture() {
  if (!state.renderer || !state.sorted) return null;
  drawAt(...fullSize());
  changed();
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}
