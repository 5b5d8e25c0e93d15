// The floor plan: outlines of rooms, doors, panoramas and the camera from above, the longest wall horizontal. It shows the
// world of the panorama at the camera, with rooms at approximate places dashed; rooms of other worlds, whose places are unknown,
// are a list.

import { placeNames } from "./choices.js";
import { byId, make } from "./dom.js";
import { goTo } from "./flight.js";
import { clamp, column, DEGREE, distanceOf, dot, indexOfLeast, minus, plus, scaled } from "./graph.js";
import { drawSvg } from "./measure.js";
import { camera, changed, state } from "./state.js";

const PLAN_MARGIN = 32;        // pixels
const LARGEST_PLAN_SCALE = 60; // pixels for a metre
const STOREY = 1.5;            // metres: rooms with a larger difference in height from the camera are faint
const PLAN_TEXT = 13;          // pixels, height of a room's name, at most

const flat = (position) => [0, 2].map((k) => dot(column(HEADER.level, k), position));
const drawnOf = (node) => HEADER.plan.drawn[node] || null;  // of a panorama at an approximate place
const worldOf = (node) => HEADER.plan.worlds[drawnOf(node)?.[0] ?? node];

// Where the plan shows a place around a panorama, to the right and forward (TourGraph.draw).
function draw(node, place) {
  const drawn = drawnOf(node);
  if (!drawn) return place;
  const [, right, forward, turn] = drawn, [c, s] = [Math.cos(turn), Math.sin(turn)], [x, z] = minus(place, flat(HEADER.spots[node].position));
  return [right + c * x + s * z, forward - s * x + c * z];
}

class Plan {
  constructor() {
    Object.assign(this, { panel: byId("plan"), world: null, marks: [] });
  }

  get isOpen() {
    return !this.panel.hidden;
  }

  toggle() {
    this.panel.hidden = this.isOpen;
    byId("map").setAttribute("aria-pressed", this.isOpen);
    changed();
  }

  // To the right and forward in metres.
  turned([right, forward]) {
    const [c, s] = [Math.cos(this.turn), Math.sin(this.turn)];
    return [c * right - s * forward, s * right + c * forward];
  }

  placeOf = (node) => this.turned(draw(node, flat(HEADER.spots[node].position)));

  make(world) {
    this.turn = HEADER.plan.turns[world];
    const { worlds, rooms, doors } = HEADER.plan, nodes = [...worlds.keys()].filter((node) => worldOf(node) === world);
    const outlines = rooms.map(({ nodes: [node], outline }) => {
      return worldOf(node) === world ? outline.map((corner) => this.turned(draw(node, corner))) : null;
    });
    const places = [...nodes.map((node) => this.placeOf(node)), ...outlines.flatMap((outline) => outline || [])];
    const size = byId("drawing").clientWidth, sides = [0, 1].map((k) => places.map((place) => place[k]));
    const [low, high] = [Math.min, Math.max].map((choose) => sides.map((side) => choose(...side)));
    const scale = Math.min((size - 2 * PLAN_MARGIN) / Math.max(...minus(high, low), 1e-6), LARGEST_PLAN_SCALE);
    const middle = scaled(plus(low, high), 0.5), tall = scale * (high[1] - low[1]) + 2 * PLAN_MARGIN;
    this.toPlan = ([right, forward]) => [0.5 * size + scale * (right - middle[0]), 0.5 * tall - scale * (forward - middle[1])];
    byId("drawing").style.height = `${tall}px`;
    const svg = drawSvg("svg", { width: size, height: tall, "aria-hidden": true }), named = new Set();
    this.marks = [];
    const add = (node, element) => {
      this.marks.push([node, element]);
      return element;
    };
    const names = [], dots = nodes.map((node) => this.toPlan(this.placeOf(node)));
    const write = (node, [x, y], text, width) => {
      const element = drawSvg("text", { "font-size": clamp(1.6 * width / text.length, 10, PLAN_TEXT) }, text);
      names.push({ x, y, element: add(node, element) });
    };
    rooms.forEach(({ name, nodes: [node, ...others], label: [right, forward, width], hasWalls }, k) => {
      if (!outlines[k]) return;
      const group = add(node, drawSvg("g", {})), [x, y] = this.toPlan(this.turned(draw(node, [right, forward])));
      group.append(drawSvg("polygon", { class: drawnOf(node) ? "about" : hasWalls ? "" : "open", points: outlines[k].map(this.toPlan).join(" ") }));
      for (const { ends } of doors.filter(({ room }) => room === k)) {
        const [[x1, y1], [x2, y2]] = ends.map((end) => this.toPlan(this.turned(draw(node, end))));
        group.append(drawSvg("line", { x1, y1, x2, y2 }));
      }
      svg[drawnOf(node) ? "prepend" : "append"](group);  // what is sure is on top
      if ([node, ...others].every((each) => named.has(each))) return;  // of a room whose outline is beside it
      [node, ...others].forEach((each) => named.add(each));
      write(node, [x, y], name, scale * width);
    });
    this.camera = drawSvg("path", { d: "M0 0L-9 -22L9 -22Z" });
    svg.append(this.camera);
    const buttons = nodes.map((node) => {
      const button = make("button", ""), [left, top] = this.toPlan(this.placeOf(node));
      if (!named.has(node)) write(node, [left, top], HEADER.spots[node].name, 80);
      button.title = button.ariaLabel = `Go to ${HEADER.spots[node].name}${drawnOf(node) ? " (about here)" : ""}`;
      button.style.transform = `translate(${left - 22}px, ${top - 22}px)`;
      button.onclick = ({ detail, clientX, clientY }) => goTo(detail ? this.nearest(nodes, clientX, clientY) : node);
      return add(node, button);
    });
    byId("drawing").replaceChildren(svg, ...buttons);
    svg.append(...names.map(({ element }) => element));  // over all outlines; then their width is known
    const sizes = names.map(({ x, y, element }) => ({ x, y, width: element.getComputedTextLength(), height: PLAN_TEXT }));
    placeNames(sizes, dots, [size, tall]).forEach((place, k) => {
      if (place) ["x", "y"].forEach((axis, i) => names[k].element.setAttribute(axis, place[i]));
      else names[k].element.remove();
    });
    const list = (title, listed) => listed.length === 0 ? [] : [make("p", "", title), ...listed.map((node) => {
      const button = make("button", "", HEADER.spots[node].name);
      button.onclick = () => goTo(node);
      return add(node, button);
    })];
    const dashed = list("Dashed: about here", nodes.filter(drawnOf)), others = [...worlds.keys()].filter((node) => !nodes.includes(node));
    byId("elsewhere").replaceChildren(...dashed, ...list("Not on the plan", others));
    byId("elsewhere").hidden = byId("elsewhere").children.length === 0;
    this.world = world;
  }

  // Areas of panoramas next to each other overlap.
  nearest(nodes, x, y) {
    const { left, top } = byId("drawing").getBoundingClientRect();
    return nodes[indexOfLeast(nodes.map((node) => distanceOf(this.toPlan(this.placeOf(node)), [x - left, y - top])))];
  }

  // The world of the panorama at the camera; for one alone, the one that is shown, at first the largest.
  chooseWorld() {
    const worlds = HEADER.plan.worlds.map((_, node) => worldOf(node)), sizeOf = (world) => worlds.filter((each) => each === world).length;
    const largest = worlds.reduce((best, world) => sizeOf(world) > sizeOf(best) ? world : best);
    const isAlone = sizeOf(worlds[state.here]) === 1 && sizeOf(largest) > 1;
    return isAlone ? this.world === null ? largest : this.world : worlds[state.here];
  }

  show() {
    if (!this.isOpen) return;
    const world = this.chooseWorld(), heightOf = (position) => dot(column(HEADER.level, 1), position);
    if (world !== this.world) this.make(world);
    const [x, y] = this.toPlan(this.turned(draw(state.here, flat(camera.position)))), turn = drawnOf(state.here)?.[3] ?? 0;
    this.camera.setAttribute("visibility", worldOf(state.here) === world ? "visible" : "hidden");
    this.camera.setAttribute("transform", `translate(${x} ${y}) rotate(${(camera.yaw + turn - this.turn) / DEGREE})`);
    const floorOf = (node) => heightOf(HEADER.spots[drawnOf(node)?.[0] ?? node].position);
    const [floor, ...others] = [state.here, ...this.marks.map(([node]) => node)].map(floorOf);
    this.marks.forEach(([node, element], k) => {
      const isElsewhere = worldOf(node) !== world;
      element.classList.toggle("faint", !isElsewhere && worldOf(state.here) === world && Math.abs(others[k] - floor) > STOREY);
      if (node === state.here && element.tagName === "BUTTON") element.setAttribute("aria-current", "location");
      else element.removeAttribute("aria-current");
    });
  }
}

export const plan = new Plan();
