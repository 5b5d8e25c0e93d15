// Vectors, matrices (arrays of rows), and the graph of a tour. The functions of the graph give the results of the methods of
// pansplat.tours.graph.TourGraph that they name; tests/web/test_browser.py compares them.
//
// A graph has `positions` and `parts` of panoramas; `edges`, whose first two numbers are panoramas; the `next` panorama
// on the way from one (row) to another one (column); the `poor` edges, along which the image fades; the `hysteresis` of a
// change of edge; and the `reach` around a part, within which a camera that has jumped is in it. Edges are numbers in
// `edges`.

export const DEGREE = Math.PI / 180;
const POOR_REACH = 0.5;  // metres that a camera may walk from a panorama along a poor edge, at most a quarter of it

export const minus = (a, b) => a.map((value, i) => value - b[i]);
export const plus = (a, b) => a.map((value, i) => value + b[i]);
export const scaled = (a, factor) => a.map((value) => value * factor);
export const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
export const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
export const multiply = (a, b) => a.map((row) => b[0].map((_, k) => row.reduce((sum, value, i) => sum + value * b[i][k], 0)));
export const column = (matrix, k) => matrix.map((row) => row[k]);
export const distanceOf = (a, b) => Math.hypot(...minus(a, b));
export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
export const indexOfLeast = (values) => values.indexOf(Math.min(...values));
export const lengthOf = (path) => path.slice(1).reduce((sum, point, i) => sum + distanceOf(point, path[i]), 0);

export function closestOnEdge(graph, edge, position) {
  const [from, to] = graph.edges[edge].slice(0, 2).map((node) => graph.positions[node]);
  const along = minus(to, from);
  const fraction = clamp(dot(minus(position, from), along) / Math.max(dot(along, along), 1e-12), 0, 1);
  return plus(from, scaled(along, fraction));
}

// measure_distance
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
  const edge = nearestEdge(graph, end, part), ends = graph.edges[edge].slice(0, 2), [first, last] = ends.map((node) => graph.positions[node]);
  if (!isFade(graph, ...ends)) return end;
  const length = Math.max(distanceOf(first, last), 1e-9), along = scaled(minus(last, first), 1 / length), reach = Math.min(POOR_REACH, length / 4);
  const depthOf = (place) => {
    const walked = dot(minus(place, first), along);
    return Math.min(walked, length - walked);
  };
  if (nearestEdge(graph, start, part) !== edge) return depthOf(end) <= reach ? end : start;
  const excess = Math.max(depthOf(end) - Math.max(depthOf(start), reach), 0);
  return minus(end, scaled(along, dot(minus(end, first), along) < length / 2 ? excess : -excess));
}

// is_fade
export const isFade = (graph, from, to) => {
  return graph.parts[from] !== graph.parts[to] || graph.poor.some((edge) => edge.includes(from) && edge.includes(to) && from !== to);
};

// find_way
export function findWay(graph, position, node, part = null) {
  const ends = graph.edges[nearestEdge(graph, position, part)].slice(0, 2), [from, to] = ends.map((end) => distanceOf(graph.positions[end], position));
  if (isFade(graph, ...ends)) ends[from <= to ? 1 : 0] = ends[from <= to ? 0 : 1];  // no camera flies to the other end
  const ways = ends.map((start) => {
    const way = [start];
    while (way.at(-1) !== node) way.push(graph.next[way.at(-1)][node]);
    return way;
  });
  const [first, second] = ways.map((way) => {
    const places = [position, ...way.map((each) => graph.positions[each])];
    const fades = way.map((each, i) => i > 0 && isFade(graph, way[i - 1], each));
    const lengths = fades.map((fade, i) => fade ? 0 : distanceOf(places[i], places[i + 1]));
    return [fades.filter(Boolean).length, lengths.reduce((a, b) => a + b)];
  });
  return first[0] < second[0] || (first[0] === second[0] && first[1] <= second[1]) ? ways[0] : ways[1];
}
