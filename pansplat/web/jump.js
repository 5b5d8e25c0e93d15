// Jumps of the camera, and the end of its ways. A still, the image of the last camera, covers the new picture until that is ready,
// then fades out; in a zoom it grows.

import { cameraFor, isFixed, settleAt } from "./camera.js";
import { chooseArrival, planWay } from "./choices.js";
import { byId, canvas, fullSize } from "./dom.js";
import { DEGREE, distanceOf, ease, nearestEdge, partOfEdge, timeOf } from "./graph.js";
import { setDoll } from "./house.js";
import { photographs } from "./photographs.js";
import { drawAt } from "./picture.js";
import { camera, changed, currentPart, GRAPH, isComplete, makeStart, state } from "./state.js";

const MAX_STILL = 8e6; // pixels of the image of a still, whose memory it limits
const NEAR = HEADER.speed; // metres: a second's walk
export const PHOTO_WAIT_MS = 2000; // longest wait for a photograph: at the end of a zoom, and before the first Gaussians are loaded

// Ends the way of the camera, and the tour.
export function endWay() {
  if (state.doll.isDue) setDoll(false); // another way replaces it
  state.way = null;
  setTouring(false);
}

export function setTouring(value) {
  state.isTouring = value;
  byId("play").setAttribute("aria-pressed", value);
  byId("play").querySelector("path").setAttribute("d", value ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
  changed();
}

export function jump(position, { yaw, pitch }, grows = false) {
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

// Goes to another camera; the image fades, unless the order of the Gaussians is right there too.
function goToPose(pose) {
  endWay();
  const isFar = distanceOf(pose.position, camera.position) > NEAR;
  const isElsewhere = partOfEdge(GRAPH, nearestEdge(GRAPH, pose.position)) !== currentPart();
  if (isFar || isElsewhere || state.headset.session) takeStill();
  place(pose);
}

export const setPose = (pose) => goToPose(cameraFor(pose));
export const goHome = () => goToPose(makeStart());

// Goes to a panorama without a flight.
export function jumpTo(node) {
  endWay();
  jump(GRAPH.positions[node], state.doll.isOn ? chooseArrival(node, null) : planWay(node).end);
}

const stillCanvas = byId("still");

// Takes the still from the picture; for a zoom it is large enough to grow.
export function takeStill(grows = false) {
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
    const t = timeOf(now, still.began, still.isZoom ? HEADER.zoomSeconds : HEADER.fadeSeconds);
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
