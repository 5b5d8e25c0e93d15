// What is offered at a panorama, and where a way ends there: functions of HEADER, which need no browser.

import { distanceOf, findBin, inAxes, minus } from "./graph.js";
import { edges, GRAPH, parts } from "./state.js";

const LEVEL_WAY = 0.1; // metres to the side, from which on a way has a heading

const isFlown = (from, to) => {
  return edges.length ? edges.some(([a, b]) => (a === from && b === to) || (a === to && b === from)) : parts[from] === parts[to];
};

// The rings of a panorama, `{ node, link }`: those of its photograph's links, on the floor where the link meets it or where the
// other camera stands; those where its flights end, unless a surface hides them; and its own. Of another room only one.
// Where all flights are hidden, the nearest one stays. Without any ring: the panoramas whose links lead here; without these, the
// nearest panorama.
export function chooseRings(here) {
  const { rooms } = HEADER.plan, { hidden } = HEADER.spots[here];
  const roomOf = (node) => rooms.findIndex((nodes) => nodes.includes(node));
  const away = (node) => distanceOf(GRAPH.positions[node], GRAPH.positions[here]);
  const all = HEADER.links, links = all.filter(({ from }) => from === here), linked = links.map(({ to }) => to);
  const others = [...parts.keys()].filter((node) => node !== here).sort((a, b) => away(a) - away(b));
  const flown = others.filter((node) => isFlown(here, node) && !linked.includes(node));
  const seen = flown.filter((node) => !hidden.includes(node));
  const offered = [
    ...links.filter((link) => link.mark || parts[link.to] === parts[here]).map((link) => ({ node: link.to, link: link.mark ? link : null })),
    ...(seen.length || links.length ? seen : flown.slice(0, 1)).map((node) => ({ node, link: null })),
  ];
  if (!offered.length) offered.push(...all.filter(({ to }) => to === here).map(({ from }) => ({ node: from, link: null })));
  if (!offered.length) offered.push(...others.slice(0, 1).map((node) => ({ node, link: null })));
  const first = offered.filter(({ node }, k) => {
    const room = roomOf(node), isBefore = (other) => other.node === node || room >= 0 && roomOf(other.node) === room;
    return room >= 0 && room === roomOf(here) || !offered.slice(0, k).some(isBefore);
  });
  return [...first, { node: here, link: null }];
}

export const findLink = (from, to) => HEADER.links.find((link) => link.from === from && link.to === to);

// Yaw and pitch in the direction of a position, level; null straight above and below.
export function headingTo(position, from) {
  const [right, , forward] = inAxes(HEADER.level, minus(position, from));
  return Math.hypot(right, forward) > LEVEL_WAY ? { yaw: Math.atan2(right, forward), pitch: 0 } : null;
}

// Yaw and pitch of the way from one panorama to another that is no flight: that of its link, which may be on the floor, else
// of a place that is known; null where it is unknown.
export function findHeading(from, to) {
  const link = findLink(from, to), { worlds } = HEADER.plan;
  if (link) return { yaw: link.yaw, pitch: Math.max(link.pitch, HEADER.lowestPitch) };
  return worlds[from] === worlds[to] ? headingTo(GRAPH.positions[to], GRAPH.positions[from]) : null;
}

// Yaw and pitch at the end of a way with a heading: the start view of the panorama, else the heading, or the widest view where no
// heading is known. After a zoom the camera looks away from the link that leads back. Without a start view, it turns from a wall
// that is close.
export function chooseArrival(node, heading, from = null) {
  const { ahead: [yaw, pitch], hasStart, turns } = HEADER.spots[node], back = from !== null && findLink(node, from);
  if (!back && (hasStart || !heading)) return { yaw, pitch };
  const way = back ? back.yaw + Math.PI : heading.yaw;
  return { yaw: way + turns[findBin(way, turns.length)], pitch: 0 };
}

// Whether two boxes have a place in common; `[left, top, right, bottom]`.
export const isCovered = (a, b) => a[0] <= b[2] && a[2] >= b[0] && a[1] <= b[3] && a[3] >= b[1];
