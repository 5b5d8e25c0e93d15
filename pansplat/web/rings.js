// The panoramas that can be visited: rings on the floor, the list, and the name of the one at the camera.

import { nodeHere, tangentOf } from "./camera.js";
import { chooseRings, isCovered } from "./choices.js";
import { isInDoll, placeInDoll } from "./doll.js";
import { byId, canvas, make } from "./dom.js";
import { goTo } from "./flight.js";
import { clamp, column, distanceOf, dot, minus } from "./graph.js";
import { camera, state } from "./state.js";

let rings = [], chosenFor = null, chosen = [];  // for a panorama

export function makeRings() {
  const links = HEADER.links.filter((link) => link.mark);
  const marks = [...HEADER.spots.map((_, node) => ({ node, link: null })), ...links.map((link) => ({ node: link.to, link }))];
  rings = marks.map(({ node, link }) => {
    const { name, position, mark } = HEADER.spots[node], text = make("small", "");
    const label = make("span", "", make("b", "", name), text), button = make("button", link && link.leave ? "fade" : "", label);
    const place = link ? { mark: link.mark, camera: null, radius: HEADER.spots[link.from].radius } : { mark, camera: position, radius: HEADER.spots[node].radius };
    button.hidden = true;
    button.onclick = () => goTo(node);
    byId("spots").append(button);
    return { node, link, button, label, text, ...place, size: null };
  });
}

// Chooses the rings of the nearest panorama. A link's text is a part of the label.
function update() {
  const here = nodeHere();
  if (chosenFor === here) return;
  chosenFor = here;
  chosen = chooseRings(here).map(({ node, link }) => rings.find((ring) => ring.node === node && ring.link === link));
  for (const ring of chosen) {
    const { name } = HEADER.spots[ring.node], link = HEADER.links.find(({ from, to }) => to === ring.node && from === here);
    ring.text.textContent = link && link.text !== name ? link.text : "";
    ring.button.title = ["Go to", name, ring.text.textContent].join(" ").trim();
    ring.button.ariaLabel = ring.button.title;
    ring.size = null;
  }
}

// Those of the nearest panorama, without that at the camera; of the doll's house all in it.
export function findRings() {
  update();
  if (state.doll.isOn) return rings.filter(({ link, node }) => !link && isInDoll(node));
  return chosen.filter((ring) => ring.camera === null || distanceOf(ring.camera, camera.position) >= 2 * ring.radius);
}

// Rings in perspective, but not under the buttons. A label that would cover these or the label of a nearer ring is not shown.
export function placeRings(rotation) {
  const found = findRings();
  const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
  const bars = ["buttons", "place"].map((id) => byId(id).getBoundingClientRect()).map((bar) => [bar.left, bar.top, bar.right, bar.bottom]);
  const taken = [...bars], placed = [];
  for (const ring of rings) {
    const { radius } = ring, isMoved = state.doll.isOn && isInDoll(ring.node), mark = isMoved ? placeInDoll(ring.node, ring.mark).place : ring.mark;
    const offset = minus(mark, camera.position);
    const [x, y, z] = [0, 1, 2].map((k) => dot(column(rotation, k), offset));
    ring.button.hidden = !found.includes(ring) || z < 0.1 * radius;
    if (!ring.button.hidden) placed.push({ ring, x, y, z, distance: Math.hypot(x, y, z) });
  }
  for (const { ring, x, y, z, distance } of placed.sort((a, b) => a.distance - b.distance)) {
    const { style } = ring.button, size = clamp(2 * ring.radius * focal / z, 16, 128), tall = size * clamp(y / distance, 0.25, 1);
    const [left, top] = [0.5 * width + focal * x / z, 0.5 * height + focal * y / z];
    ring.button.hidden = bars.some((bar) => isCovered([left - 0.5 * size, top - 0.5 * tall, left + 0.5 * size, top + 0.5 * tall], bar));
    if (ring.button.hidden) continue;
    style.width = `${size}px`;
    style.height = `${tall}px`;
    style.borderWidth = `${clamp(0.09 * size, 2, 6)}px`;
    style.transform = `translate(${left - 0.5 * size}px, ${top - 0.5 * tall}px)`;
    if (!ring.size) ring.size = [ring.label.offsetWidth, ring.label.offsetHeight];
    const box = [left - 0.5 * ring.size[0], top + 0.5 * tall, left + 0.5 * ring.size[0], top + 0.5 * tall + ring.size[1]];
    const isFree = taken.every((other) => !isCovered(box, other));
    ring.label.style.visibility = isFree ? "" : "hidden";
    if (isFree) taken.push(box);
  }
}

const listed = [];  // a button for each panorama

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
