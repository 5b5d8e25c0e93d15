"use strict";
// Vectors, and the graph of a tour. The functions of the graph give the results of the methods of
// pansplat.tours.TourGraph that they name; tests/web/test_browser.py compares them.
//
// A graph has `positions` of panoramas; `edges`, whose first two numbers are panoramas; the `next` panorama on the way
// from one (row) to another one (column); and the `hysteresis` of a change of edge. Edges are numbers in `edges`.

const minus = (a, b) => a.map((value, i) => value - b[i]);
const plus = (a, b) => a.map((value, i) => value + b[i]);
const scaled = (a, factor) => a.map((value) => value * factor);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const distanceOf = (a, b) => Math.hypot(...minus(a, b));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const lengthOf = (path) => path.slice(1).reduce((sum, point, i) => sum + distanceOf(point, path[i]), 0);

// measure_distance
function distanceToEdge(graph, edge, position) {
  const [from, to] = graph.edges[edge].slice(0, 2).map((node) => graph.positions[node]);
  const along = minus(to, from);
  const fraction = clamp(dot(minus(position, from), along) / Math.max(dot(along, along), 1e-12), 0, 1);
  return distanceOf(position, plus(from, scaled(along, fraction)));
}

// find_nearest_edge, without the distance
function nearestEdge(graph, position) {
  const distances = graph.edges.map((_, edge) => distanceToEdge(graph, edge, position));
  return distances.indexOf(Math.min(...distances));
}

// follow_edge
function followEdge(graph, position, current) {
  const nearest = nearestEdge(graph, position);
  const limit = distanceToEdge(graph, nearest, position) + graph.hysteresis;
  return distanceToEdge(graph, current, position) <= limit ? current : nearest;
}

// list_reachable
function isReachable(graph, edge, node) {
  const ends = graph.edges[edge].slice(0, 2);
  return graph.edges.some(([a, b]) => (a === node && ends.includes(b)) || (b === node && ends.includes(a)));
}

// find_way
function findWay(graph, position, node) {
  const ways = graph.edges[nearestEdge(graph, position)].slice(0, 2).map((start) => {
    const way = [start];
    while (way.at(-1) !== node) way.push(graph.next[way.at(-1)][node]);
    return way;
  });
  const [first, second] = ways.map((way) => lengthOf([position, ...way.map((each) => graph.positions[each])]));
  return first <= second ? ways[0] : ways[1];
}
