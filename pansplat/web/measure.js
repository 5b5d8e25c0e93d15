// Distances in the picture: the depth at one point, and the distance of two, in the unit of the poses. All other lengths of
// a page are in about metres, whatever that unit is.

import { byId, say } from "./dom.js";
import { distanceOf, minus, plus, scaled } from "./graph.js";
import { measureAt, rayOf } from "./picture.js";
import { camera, changed, state } from "./state.js";

const SVG = byId("marks").namespaceURI;
const SINGLE_ERROR = 0.35; // relative error of a distance in a panorama alone: heights of cameras over the floor differ by as much
const NEAREST = 0.02; // least z of the ends of a line, as a share of the distance of its farther end

function drawSvg(tag, attributes, text = "") {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.textContent = text;
  return element;
}

class Measure {
  isOn = false;
  points = [];

  toggle(value = !this.isOn) {
    this.isOn = value;
    this.points = [];
    byId("measure").setAttribute("aria-pressed", value);
    byId("marks").replaceChildren();
    const hint = matchMedia("(pointer: coarse)").matches ? "Tap two points" : "Click two points, or press Enter for the middle of the picture";
    say(value ? hint : "");
    changed();
  }

  // Takes the point of the scene at a place of the window.
  take(left, top) {
    const distance = measureAt(left, top);
    if (distance === null) {
      say("There is no surface to measure");
      return;
    }
    const point = plus(camera.position, scaled(rayOf(left, top), distance));
    this.points = this.points.length === 1 ? [...this.points, point] : [point];
    const label = this.format(distance);
    say(this.points.length === 1 ? `${label} from the camera` : `${this.format(distanceOf(...this.points))} between the points`);
    changed();
  }

  // The scale of a panorama without others in its world is that of a camera of usual height.
  format(distance) {
    const { worlds } = HEADER.plan, isAlone = worlds.filter((world) => world === worlds[state.here]).length === 1;
    const [length, error] = [1, SINGLE_ERROR].map((factor) => (factor * distance / HEADER.unit).toFixed(2));
    return isAlone ? `${length} m ± ${error} m` : `${length} m`;
  }

  // Draws the points and their line over the picture. `toCamera`: from the scene to camera axes; `toWindow`: from there.
  show(toCamera, toWindow) {
    if (!this.isOn) return;
    const seen = this.points.map(toCamera), marks = [];
    if (seen.length === 2 && (seen[0][2] > 0 || seen[1][2] > 0)) {
      const near = NEAREST * Math.max(...seen.map((point) => Math.hypot(...point)));
      const [[x1, y1], [x2, y2]] = seen.map((point, i) => toWindow(this.clip(point, seen[1 - i], near)));
      marks.push(drawSvg("line", { x1, y1, x2, y2 }));
      marks.push(drawSvg("text", { x: 0.5 * (x1 + x2), y: 0.5 * (y1 + y2) - 8 }, this.format(distanceOf(...this.points))));
    }
    for (const point of seen.filter(([, , z]) => z > 0)) {
      const [cx, cy] = toWindow(point);
      marks.push(drawSvg("circle", { cx, cy, r: 5 }));
    }
    byId("marks").replaceChildren(...marks);
  }

  // A point behind the camera moves along the line until it is in front.
  clip(point, other, near) {
    return point[2] >= near ? point : plus(point, scaled(minus(other, point), (near - point[2]) / (other[2] - point[2])));
  }
}

export const measure = new Measure();
