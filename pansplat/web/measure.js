"use strict";
// Distances in the picture: the depth at one point, and the distance of two.

const SVG = document.getElementById("marks").namespaceURI;
const NEAREST = 0.02;  // z of the ends of a line, of the distance of its farther end

function draw(tag, attributes, text = "") {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.textContent = text;
  return element;
}

class Measure {
  // `page`: the functions of page.js that are used below.
  constructor(page) {
    Object.assign(this, { page, isOn: false, points: [] });
  }

  toggle(value = !this.isOn) {
    this.isOn = value;
    this.points = [];
    document.getElementById("measure").setAttribute("aria-pressed", value);
    document.getElementById("marks").replaceChildren();
    this.page.say(value ? "Click two points, or press Enter for the middle of the picture" : "");
    this.page.changed();
  }

  // Takes the point of the scene at a place of the window.
  take(left, top) {
    const { page } = this, distance = page.measureAt(left, top);
    if (distance === null) {
      page.say("There is no surface to measure");
      return;
    }
    const { camera } = page, point = plus(camera.position, scaled(page.rayOf(left, top), distance));
    this.points = this.points.length === 1 ? [...this.points, point] : [point];
    const label = this.format(distance);
    page.say(this.points.length === 1 ? `${label} from the camera` : `${this.format(distanceOf(...this.points))} between the points`);
    page.changed();
  }

  format(distance) {
    return `${(distance / HEADER.unit).toFixed(2)} m`;
  }

  // Draws the points and their line over the picture. `project`: from the scene to camera axes, and from there to the window.
  show(toCamera, toWindow) {
    if (!this.isOn) return;
    const seen = this.points.map(toCamera), marks = [];
    if (seen.length === 2 && (seen[0][2] > 0 || seen[1][2] > 0)) {
      const near = NEAREST * Math.max(...seen.map((point) => Math.hypot(...point)));
      const [[x1, y1], [x2, y2]] = seen.map((point, i) => toWindow(this.clip(point, seen[1 - i], near)));
      marks.push(draw("line", { x1, y1, x2, y2 }));
      marks.push(draw("text", { x: 0.5 * (x1 + x2), y: 0.5 * (y1 + y2) - 8 }, this.format(distanceOf(...this.points))));
    }
    for (const point of seen.filter(([, , z]) => z > 0)) {
      const [cx, cy] = toWindow(point);
      marks.push(draw("circle", { cx, cy, r: 5 }));
    }
    document.getElementById("marks").replaceChildren(...marks);
  }

  // A point behind the camera moves along the line until it is in front.
  clip(point, other, near) {
    return point[2] >= near ? point : plus(point, scaled(minus(other, point), (near - point[2]) / (other[2] - point[2])));
  }
}
