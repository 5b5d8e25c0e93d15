// Vectors, matrices (arrays of rows), and the graph of a tour. The functions of the graph give the results of those of
// pansplat.tours.graph, walks, limits and outlook that they name; tests/web/test_modules.py compares them.
//
// A graph has `positions` and `parts` of panoramas; `edges`, whose first two numbers are panoramas; the `next` panorama
// on the way from one (row) to another one (column); the `poor` edges, along which the camera zooms; the `hysteresis` of a
// change of edge; the `reach` around a part, within which a camera that has jumped is in it; and the `clearances` of panoramas, relative to the axes `level`.
// Edges are numbers in `edges`.

export const DEGREE = Math.PI / 180;

export const minus = (a, b) => a.map((value, i) => value - b[i]);
export const plus = (a, b) => a.map((value, i) => value + b[i]);
/** @type {(a: number[], factor: number) => any} */
export const scaled = (a, factor) => a.map((value) => value * factor);
export const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
export const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
export const multiply = (a, b) => a.map((row) => b[0].map((_, k) => row.reduce((sum, value, i) => sum + value * b[i][k], 0)));
export const column = (matrix, k) => matrix.map((row) => row[k]);
// A vector in axes that are the columns of a rotation, and back.
/** @type {(axes: number[][], vector: number[]) => any} */
export const inAxes = (axes, vector) => [0, 1, 2].map((k) => dot(column(axes, k), vector));
export const fromAxes = (axes, vector) => axes.map((row) => dot(row, vector));
export const unit = (vector) => scaled(vector, 1 / Math.max(Math.hypot(...vector), 1e-9));
export const distanceOf = (a, b) => Math.hypot(...minus(a, b));
export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
export const timeOf = (now, began, seconds) => seconds ? clamp((now - began) / (1000 * seconds), 0, 1) : 1; // fraction of a duration
export const ease = (t) => t * t * (3 - 2 * t);
export const wrapAngle = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle)); // -pi to pi
export const indexOfLeast = (values) => values.indexOf(Math.min(...values));

export function closestOnEdge(graph, edge, position) {
  const [from, to] = graph.edges[edge].slice(0, 2).map((node) => graph.positions[node]);
  const along = minus(to, from);
  const fraction = clamp(dot(minus(position, from), along) / Math.max(dot(along, along), 1e-12), 0, 1);
  return plus(from, scaled(along, fraction));
}

// measure_distances, of one edge
const distanceToEdge = (graph, edge, position) => distanceOf(position, closestOnEdge(graph, edge, position));

export const partOfEdge = (graph, edge) => graph.parts[graph.edges[edge][0]];

// find_nearest_edge, without the distance; of one part if it is given
export function nearestEdge(graph, position, part = null) {
  return indexOfLeast(graph.edges.map((_, edge) => {
    return part === null || part === partOfEdge(graph, edge) ? distanceToEdge(graph, edge, position) : Infinity;
  }));
}

// follow_edge
export function followEdge(graph, position, current) {
  const part = partOfEdge(graph, current);
  let nearest = nearestEdge(graph, position);
  if (partOfEdge(graph, nearest) !== part && distanceToEdge(graph, nearest, position) > graph.reach) {
    nearest = nearestEdge(graph, position, part);
  }
  const limit = distanceToEdge(graph, nearest, position) + graph.hysteresis;
  return distanceToEdge(graph, current, position) <= limit ? current : nearest;
}

// limit_step
export function limitStep(graph, start, end, part = null) {
  const edge = nearestEdge(graph, end, part);
  const target = isPoor(graph, edge) ? limitAlong(graph, edge, start, end, part) : end;
  const most = Math.min(measureFree(graph, edge, start)[0], 0), [free, away] = measureFree(graph, edge, target);
  const slid = minus(target, scaled(away, Math.max(most - free, 0)));
  const isStep = distanceOf(slid, start) <= distanceOf(target, start) + 1e-9;
  return isStep && measureFree(graph, edge, slid)[0] >= most - 1e-9 ? slid : start;
}

// _measure_free
function measureFree(graph, edge, place) {
  const nodes = graph.edges[edge].slice(0, 2);
  const found = nodes.filter((node) => graph.clearances[node].length).map((node) => {
    const offset = minus(place, graph.positions[node]), distance = Math.hypot(...offset);
    const free = Math.max(findClearance(graph, node, offset) - distance - HEADER.clearance, HEADER.clearance - distance);
    return [free, scaled(offset, 1 / Math.max(distance, 1e-9))];
  });
  if (!found.length) return [Infinity, [0, 0, 0]];
  const [free, away] = found.reduce((best, each) => each[0] > best[0] ? each : best);
  const beside = isPoor(graph, edge) ? -Infinity : HEADER.clearance - distanceToEdge(graph, edge, place);
  return [Math.max(free, beside), away];
}

// find_bins, of one yaw and a horizon of `count` bins
export const findBin = (yaw, count) => Math.floor((wrapAngle(yaw) / (2 * Math.PI) + 0.5) * count) % count;

// find_clearance
function findClearance(graph, node, offset) {
  const [right, down, forward] = inAxes(graph.level, offset), table = graph.clearances[node];
  const row = Math.min(Math.floor(Math.atan2(Math.hypot(right, forward), -down) / Math.PI * table.length), table.length - 1);
  return table[row][findBin(Math.atan2(right, forward), table[row].length)] || Infinity;
}

// _limit_along
function limitAlong(graph, edge, start, end, part) {
  const [first, last] = graph.edges[edge].slice(0, 2).map((node) => graph.positions[node]);
  const length = Math.max(distanceOf(first, last), 1e-9), along = scaled(minus(last, first), 1 / length), reach = Math.min(HEADER.poorReach, length / 4);
  const depthOf = (place) => {
    const walked = dot(minus(place, first), along);
    return Math.min(walked, length - walked);
  };
  if (nearestEdge(graph, start, part) !== edge) return depthOf(end) <= reach ? end : start;
  const excess = Math.max(depthOf(end) - Math.max(depthOf(start), reach), 0);
  return minus(end, scaled(along, dot(minus(end, first), along) < length / 2 ? excess : -excess));
}

const isPoor = (graph, edge) => isZoom(graph, ...graph.edges[edge].slice(0, 2));

// is_zoom
export const isZoom = (graph, from, to) => {
  return graph.parts[from] !== graph.parts[to] || graph.poor.some((edge) => edge.includes(from) && edge.includes(to) && from !== to);
};

// find_way
export function findWay(graph, position, node, part = null) {
  const ends = graph.edges[nearestEdge(graph, position, part)].slice(0, 2), [from, to] = ends.map((end) => distanceOf(graph.positions[end], position));
  if (isZoom(graph, ...ends)) ends[from <= to ? 1 : 0] = ends[from <= to ? 0 : 1]; // no camera flies to the other end
  const ways = ends.map((start) => {
    const way = [start];
    while (way.at(-1) !== node) way.push(graph.next[way.at(-1)][node]);
    return way;
  });
  const [first, second] = ways.map((way) => {
    const places = [position, ...way.map((each) => graph.positions[each])];
    const zooms = way.map((each, i) => i > 0 && isZoom(graph, way[i - 1], each));
    const lengths = zooms.map((zoom, i) => zoom ? 0 : distanceOf(places[i], places[i + 1]));
    return [zooms.filter(Boolean).length, lengths.reduce((a, b) => a + b)];
  });
  return first[0] < second[0] || (first[0] === second[0] && first[1] <= second[1]) ? ways[0] : ways[1];
}
