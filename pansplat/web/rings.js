// The panoramas that can be visited: rings in the picture, arrows at its border, the list, and the name of the one at the camera.

import { nodeHere, tangentOf } from "./camera.js";
import { findLink, isCovered } from "./choices.js";
import { isInDoll, placeInDoll } from "./doll.js";
import { byId, canvas, make } from "./dom.js";
import { goTo } from "./flight.js";
import { clamp, column, distanceOf, dot, inAxes, minus, wrapAngle } from "./graph.js";
import { camera, state } from "./state.js";

const ARROW = 44, BORDER = 8; // pixels: size of an arrow, and to the border
const MAX_ARROWS = 3; // largest number of arrows at a side of the picture
let rings = [], chosenFor = null, chosen = []; // all rings, those of links with the panorama that they are offered `from`; the nearest panorama, and its rings

export function makeRings() {
  const ofLinks = HEADER.spots.flatMap((spot, from) => spot.rings.filter(({ mark }) => mark).map(({ node, mark }) => ({ node, from, mark })));
  rings = [...HEADER.spots.map((_, node) => ({ node, from: null, mark: null })), ...ofLinks].map(({ node, from, mark: linked }) => {
    const { name, position, mark } = HEADER.spots[node], text = make("small", "");
    const label = make("span", "", make("b", "", name), text), button = make("button", "", label);
    const place = linked ? { mark: linked, camera: null } : { mark, camera: position };
    const heightOf = (point) => dot(column(HEADER.level, 1), point);
    const isUpright = from !== null && heightOf(place.mark) < heightOf(HEADER.spots[from].mark) - 0.5 * HEADER.ringRadius;
    button.hidden = true;
    button.onclick = () => goTo(node);
    byId("spots").append(button);
    return { node, from, button, label, text, ...place, isUpright, size: null };
  });
}

// Takes the rings of the nearest panorama. A link's text is a part of the label.
function update() {
  const here = nodeHere();
  if (chosenFor === here) return;
  chosenFor = here;
  chosen = HEADER.spots[here].rings.map(({ node, mark }) => rings.find((ring) => ring.node === node && ring.from === (mark ? here : null)));
  for (const ring of chosen) {
    const { name } = HEADER.spots[ring.node], link = findLink(here, ring.node);
    ring.text.textContent = link && link.text !== name ? link.text : "";
    ring.button.title = ["Go to", name, ring.text.textContent].join(" ").trim();
    ring.button.ariaLabel = ring.button.title;
    ring.size = null;
  }
}

// The rings of the nearest panorama, without that at the camera; in the doll's house those of all panoramas in it.
export function findRings() {
  update();
  if (state.doll.isOn) return rings.filter(({ from, node }) => from === null && isInDoll(node));
  return chosen.filter((ring) => ring.camera === null || distanceOf(ring.camera, camera.position) >= HEADER.ringDistance);
}

// Rings in perspective, and arrows at the border to those that are outside or under a control, and to panoramas of which no place
// is known; none while the camera flies. A label that would cover a control or the label of a nearer ring is not shown.
export function placeRings(rotation) {
  const found = state.way?.legs[0].path ? [] : findRings();
  const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
  const bars = ["buttons", "place", "plan"].map((id) => byId(id).getBoundingClientRect()).map((bar) => [bar.left, bar.top, bar.right, bar.bottom]);
  const taken = [...bars], sides = { left: 0, right: 0, up: 0, down: 0 };
  for (const { button } of rings) button.hidden = true;
  const placed = found.map((ring) => {
    const isKnown = ring.from !== null || state.doll.isOn || HEADER.plan.worlds[ring.node] === HEADER.plan.worlds[nodeHere()];
    const isMoved = state.doll.isOn && isInDoll(ring.node), mark = isMoved ? placeInDoll(ring.node, ring.mark).place : ring.mark;
    const offset = minus(mark, camera.position);
    return { ring, offset, distance: Math.hypot(...offset), place: isKnown ? findPlace(ring, inAxes(rotation, offset), focal, bars) : null };
  });
  const places = placed.flatMap(({ place }) => place ? [place] : []);
  for (const { ring, offset, place } of placed.sort((a, b) => Number(!a.place) - Number(!b.place) || a.distance - b.distance)) {
    const { button, label } = ring, { style } = button, found = place ? { box: place, side: null } : findBorder(offset, focal, sides, [...taken, ...places]);
    if (!found) continue;
    const { box, side } = found, [left, top, right, bottom] = box;
    button.hidden = false;
    button.className = place ? "" : `arrow ${side}`;
    Object.assign(style, { width: `${right - left}px`, height: `${bottom - top}px`, transform: `translate(${left}px, ${top}px)` });
    style.borderWidth = place ? `${clamp(0.09 * (right - left), 2, 6)}px` : "";
    ring.size ||= [label.offsetWidth, label.offsetHeight];
    const [wide, tall] = ring.size, middle = [0.5 * (left + right - wide), 0.5 * (top + bottom - tall)];
    const [x0, y0] = { left: [right, middle[1]], right: [left - wide, middle[1]], down: [middle[0], top - tall] }[side] || [middle[0], bottom];
    const labelBox = [x0, y0, x0 + wide, y0 + tall], isFree = taken.every((other) => !isCovered(labelBox, other));
    label.style.visibility = isFree ? "" : "hidden";
    if (isFree) taken.push(labelBox);
    if (!place) taken.push(box);
  }
}

// The box of a ring in the picture; null for one outside or under a control. On the floor it is seen from above.
function findPlace({ isUpright }, [x, y, z], focal, bars) {
  const { clientWidth: width, clientHeight: height } = canvas, [left, top] = [0.5 * width + focal * x / z, 0.5 * height + focal * y / z];
  const size = clamp(2 * HEADER.ringRadius * focal / z, 16, 128), tall = isUpright ? size : size * clamp(y / Math.hypot(x, y, z), 0.25, 1);
  const box = [left - 0.5 * size, top - 0.5 * tall, left + 0.5 * size, top + 0.5 * tall];
  return z > 0.1 * HEADER.ringRadius && left > 0 && left < width && top > 0 && top < height && !bars.some((bar) => isCovered(box, bar)) ? box : null;
}

// The `box` of an arrow to where the camera turns towards an offset, and its `side`; null where the side is full.
function findBorder(offset, focal, sides, taken) {
  const { clientWidth: width, clientHeight: height } = canvas, [right, down, forward] = inAxes(HEADER.level, offset);
  const around = wrapAngle(Math.atan2(right, forward) - camera.yaw);
  const above = -Math.atan2(down, Math.hypot(right, forward)) - camera.pitch, isBeside = Math.abs(around) > Math.atan(0.5 * width / focal);
  const side = state.doll.isOn ? null : isBeside ? around < 0 ? "left" : "right" : above > 0 ? "up" : "down";
  if (side === null || sides[side] === MAX_ARROWS) return null;
  const most = [width, height].map((length) => length - ARROW - BORDER),
    half = 0.5 * ARROW,
    [x, y] = [around, -above].map((angle) => focal * Math.tan(clamp(angle, -1.5, 1.5)));
  const at = [0.5 * width + x - half, 0.5 * height + y - half];
  const inward = { left: [1, 0], right: [-1, 0], up: [0, 1], down: [0, -1] }[side], steps = [...Array(40).keys()].map((k) => (k % 2 ? 1 : -1) * half * Math.ceil(k / 2));
  const boxes = [0, 1, 2].flatMap((row) =>
    steps.map((step) => { // beside the place, else in a row above it
      const [left, top] = at.map((value, k) => clamp(value + (inward[k] ? 0 : step), BORDER, most[k]) + row * (ARROW + BORDER) * inward[k]);
      return [left, top, left + ARROW, top + ARROW];
    })
  );
  const box = boxes.find((each) => taken.every((other) => !isCovered(each, other)));
  if (!box) return null;
  sides[side] += 1;
  return { box, side };
}

const listed = []; // a button for each panorama

// The panoramas in the order of the tour.
export function makeList() {
  HEADER.spots.forEach(({ name }, node) => {
    const button = make("button", "", `${node + 1}. ${name}`);
    button.onclick = () => {
      byId("list").close();
      goTo(node);
    };
    listed.push(button);
  });
  byId("panoramas").append(...listed);
}

export function openList() {
  if (HEADER.spots.length < 2) return;
  byId("list").showModal();
  listed[state.here].focus();
}

// Names the panorama at the camera.
export function showPlace() {
  const node = nodeHere();
  if (node === state.here) return;
  if (listed[state.here]) listed[state.here].removeAttribute("aria-current");
  state.here = node;
  listed[state.here].setAttribute("aria-current", "location");
  byId("name").textContent = HEADER.spots[state.here].name;
}
