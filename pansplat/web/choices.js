// What is offered at a panorama, and where a way ends there: functions of HEADER, which need no browser.

import { distanceOf } from "./graph.js";
import { edges, GRAPH, parts } from "./state.js";

const isFlown = (from, to) => {
  return edges.length ? edges.some(([a, b]) => (a === from && b === to) || (a === to && b === from)) : parts[from] === parts[to];
};

// The rings of a panorama, `{ node, link }`: those of its photograph's links, on the floor where the link meets it or where the
// other camera stands; those where its flights end, unless a surface hides them; and its own. Of another room only one.
// Where all flights are hidden, the nearest one stays.
export function chooseRings(here) {
  const { rooms } = HEADER.plan, { hidden } = HEADER.spots[here];
  const roomOf = (node) => rooms.findIndex((nodes) => nodes.includes(node));
  const away = (node) => distanceOf(GRAPH.positions[node], GRAPH.positions[here]);
  const links = HEADER.links.filter(({ from }) => from === here), linked = links.map(({ to }) => to);
  const flown = HEADER.spots.map((_, node) => node).filter((node) => node !== here && isFlown(here, node) && !linked.includes(node));
  flown.sort((a, b) => away(a) - away(b));
  const seen = flown.filter((node) => !hidden.includes(node));
  const offered = [
    ...links.filter((link) => link.mark || parts[link.to] === parts[here]).map((link) => ({ node: link.to, link: link.mark ? link : null })),
    ...(seen.length || links.length ? seen : flown.slice(0, 1)).map((node) => ({ node, link: null })),
  ];
  const first = offered.filter(({ node }, k) => {
    const room = roomOf(node), isBefore = (other) => other.node === node || room >= 0 && roomOf(other.node) === room;
    return room >= 0 && room === roomOf(here) || !offered.slice(0, k).some(isBefore);
  });
  return [...first, { node: here, link: null }];
}

export const findLink = (from, to) => HEADER.links.find((link) => link.from === from && link.to === to);

const DIRECTIONS = 24;  // of the bits of `turned`

// Yaw and pitch at the end of a way to a panorama, by the table of choose_arrival (pansplat/tours/outlook.py). From another part
// the camera comes away from the link back; without one, the directions of another world are unknown.
export function chooseArrival(node, { yaw, pitch }, from = node) {
  const { turned, ahead } = HEADER.spots[node], { worlds } = HEADER.plan, back = findLink(node, from);
  const isElsewhere = parts[node] !== parts[from], isBack = isElsewhere && back && back.leave;
  const end = isBack ? { yaw: back.yaw + Math.PI, pitch: 0 } : { yaw, pitch: isElsewhere ? 0 : pitch };
  const turns = end.yaw / (2 * Math.PI) + 0.5, isUnknown = !isBack && worlds[node] !== worlds[from];
  const isTurned = isUnknown || turned >> Math.floor(DIRECTIONS * (turns - Math.floor(turns))) & 1;
  return isTurned ? { yaw: ahead[0], pitch: ahead[1] } : end;
}

// Whether two boxes have a place in common; `[left, top, right, bottom]`.
export const isCovered = (a, b) => a[0] <= b[2] && a[2] >= b[0] && a[1] <= b[3] && a[3] >= b[1];
