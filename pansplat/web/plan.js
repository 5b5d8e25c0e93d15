// The floor plan: panoramas, edges and links from above, and the camera. Forward of the level axes is up.

import { camera } from "./camera.js";
import { byId } from "./dom.js";
import { goTo } from "./flight.js";
import { column, dot, minus, plus, scaled } from "./graph.js";
import { changed } from "./loop.js";
import { drawSvg } from "./measure.js";
import { here, isSingle } from "./rings.js";
import { DEGREE } from "./share.js";

const PLAN_MARGIN = 20;        // pixels
const LARGEST_PLAN_SCALE = 60; // pixels for a metre
const STOREY = 1.5;            // metres: panoramas with a larger difference in height from the camera are faint

class Plan {
  constructor() {
    Object.assign(this, { panel: byId("plan"), buttons: [] });
  }

  get isOpen() {
    return !this.panel.hidden;
  }

  toggle() {
    this.panel.hidden = this.isOpen;
    byId("map").setAttribute("aria-pressed", this.isOpen);
    if (this.isOpen && !this.buttons.length) this.make();
    changed();
  }

  // To the right, down, and forward, in metres.
  inLevel(position) {
    return [0, 1, 2].map((k) => dot(column(HEADER.level, k), position) / HEADER.unit);
  }

  make() {
    const places = HEADER.spots.map((spot) => this.inLevel(spot.position)), size = this.panel.clientWidth;
    const sides = [0, 2].map((k) => places.map((place) => place[k])), low = sides.map((side) => Math.min(...side));
    const high = sides.map((side) => Math.max(...side)), extent = Math.max(...minus(high, low));
    const scale = Math.min((size - 2 * PLAN_MARGIN) / Math.max(extent, 1e-6), LARGEST_PLAN_SCALE);
    const center = scaled(plus(low, high), 0.5);
    this.toPlan = ([right, , forward]) => [0.5 * size + scale * (right - center[0]), 0.5 * size - scale * (forward - center[1])];
    const svg = drawSvg("svg", { width: size, height: size, "aria-hidden": true });
    const line = (from, to, kind) => {
      const [[x1, y1], [x2, y2]] = [from, to].map((node) => this.toPlan(places[node]));
      svg.append(drawSvg("line", { x1, y1, x2, y2, class: kind }));
    };
    HEADER.links.filter(({ from, to }) => HEADER.parts[from] !== HEADER.parts[to]).forEach(({ from, to }) => line(from, to, "link"));
    HEADER.edges.filter(([from, to]) => from !== to).forEach(([from, to]) => line(from, to, "edge"));
    this.camera = drawSvg("path", { d: "M0 0L-9 -22L9 -22Z" });
    svg.append(this.camera);
    this.buttons = HEADER.spots.map(({ name }, node) => {
      const button = document.createElement("button"), [left, top] = this.toPlan(places[node]);
      button.title = button.ariaLabel = `Go to ${name}`;
      button.className = isSingle(node) ? "single" : "";
      button.style.transform = `translate(${left - 12}px, ${top - 12}px)`;
      button.onclick = () => goTo(node);
      return button;
    });
    this.heights = places.map(([, down]) => down);
    this.panel.replaceChildren(svg, ...this.buttons);
  }

  show() {
    if (!this.isOpen) return;
    const place = this.inLevel(camera.position), [x, y] = this.toPlan(place);
    this.camera.setAttribute("transform", `translate(${x} ${y}) rotate(${camera.yaw / DEGREE})`);
    this.buttons.forEach((button, node) => {
      button.classList.toggle("faint", Math.abs(this.heights[node] - this.heights[here]) > STOREY);
      if (node === here) button.setAttribute("aria-current", "location");
      else button.removeAttribute("aria-current");
    });
  }
}

export const plan = new Plan();
