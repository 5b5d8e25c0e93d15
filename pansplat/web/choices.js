// The legs of ways, where they lead and end, and what boxes cover. No browser is needed.

import { nodeHere, nodeWithin } from "./camera.js";
import { findBin, findWay, followEdge, inAxes, isZoom, minus, partOfEdge } from "./graph.js";
import { camera, GRAPH, state } from "./state.js";

const LEVEL_WAY = 0.1; // metres to the side, from which on a way has a heading

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

// The legs of a way to a panorama, and yaw and pitch at its end. On each step the camera turns to the way, then it flies, looking
// ahead, or the image grows and fades. A leg has what changes: a `view` to turn to, a `path` of two places, or a `view` after a
// zoom to the panorama `to`.
export function planWay(spot) {
  const walk = findWay(GRAPH, camera.position, spot, partOfEdge(GRAPH, followEdge(GRAPH, camera.position, state.edge)));
  const here = nodeHere(), ahead = { yaw: camera.yaw, pitch: camera.pitch }, legs = [];
  let from = nodeWithin(HEADER.stopReach), position = [...camera.position], heading = ahead, end = chooseArrival(spot, ahead);
  walk.forEach((node, i) => {
    const before = i > 0 ? walk[i - 1] : null, zooms = before !== null && isZoom(GRAPH, before, node);
    const isLeft = i === 0 && node === here && isZoom(GRAPH, node, walk[1] ?? node); // a zoom begins where the camera is
    if (node === from || isLeft) return;
    heading = zooms ? findHeading(before, node) : headingTo(GRAPH.positions[node], position) || ahead;
    if (heading) legs.push({ view: heading });
    end = chooseArrival(node, heading, zooms ? before : null);
    legs.push(zooms ? { to: node, view: end } : { from, to: node, path: [position, GRAPH.positions[node]] });
    [from, position] = [node, GRAPH.positions[node]];
  });
  if (!legs.length || legs.at(-1).path && (HEADER.spots[spot].hasStart || end.yaw !== heading.yaw)) legs.push({ view: end });
  return { legs, end };
}

// Whether two boxes have a place in common; `[left, top, right, bottom]`.
export const isCovered = (a, b) => a[0] <= b[2] && a[2] >= b[0] && a[1] <= b[3] && a[3] >= b[1];
