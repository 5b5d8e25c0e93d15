// The doll's house view: the camera turns around the rooms from outside, and nothing is drawn that shows its back. docs/web.md
// describes it. The rooms are those of the part and the storey of the panorama that the camera leaves.

import { camera, nearestNode, parts, tangentOf, turned } from "./camera.js";
import { byId, calm, say } from "./dom.js";
import { ease, isWaiting, jump, jumpTo, lookOn, setTouring, takeStill } from "./flight.js";
import { clamp, column, distanceOf, dot, indexOfLeast, minus, plus, scaled } from "./graph.js";
import { changed, measureAt, rayOf, sorted } from "./loop.js";
import { DEGREE } from "./share.js";
import { headset } from "./xr.js";

const DOLL_FOV = 45;                               // degrees, vertical, of a landscape picture
const DOLL_PITCH = -45 * Math.PI / 180;            // of the first view
const LOWEST = -8 * Math.PI / 180;                 // pitch of a camera that looks along the floor
const DOLL_SECONDS = 1.6;                          // of a flight out of the rooms, or into one
const DOLL_ZOOM = [0.15, 2];                       // of the first distance
const DOLL_TURN = Math.PI / 2;                     // radians a second, by keys

class DollHouse {
  constructor() {
    Object.assign(this, { isOn: false, node: 0, heading: null, flight: null, center: null, distance: 0, first: 0, fov: 0 });
  }

  get isPossible() {
    return HEADER.doll !== null;
  }

  // Whether a panorama is among the rooms that are shown.
  shows(node) {
    const { parts, doll: { storeys } } = HEADER;
    return parts[node] === parts[this.node] && storeys[node] === storeys[this.node];
  }

  // The Gaussians in the rooms, as [view, first, count].
  get ranges() {
    return this.isOn ? HEADER.doll.ranges.filter(([view]) => this.shows(view)) : null;
  }

  toggle() {
    if (this.isOn) this.visit(this.node, this.heading);
    else this.enter();
  }

  // Flies out of the panorama at the camera.
  enter() {
    if (headset.session || !sorted) return;
    setTouring(false);
    this.node = nearestNode(camera.position);
    if (!this.isPossible || !HEADER.doll.boxes.some((box, view) => box && this.shows(view))) {
      say(byId("no-doll").textContent);
      return;
    }
    takeStill();
    this.setOn(true);
    camera.roll = 0;
    Object.assign(this, { fov: camera.fov, heading: { yaw: camera.yaw, pitch: camera.pitch } });
    const box = this.findBox(), yaws = [camera.yaw, camera.yaw + 0.5 * Math.PI];  // the one that is nearer to the rooms
    const distances = yaws.map((yaw) => this.fit(box, yaw, DOLL_PITCH)), best = Number(distances[1] < 0.95 * distances[0]);
    this.center = HEADER.level.map((row) => dot(row, scaled(plus(...box), 0.5)));
    this.first = this.distance = distances[best];
    this.flyTo({ ...this.place(yaws[best], DOLL_PITCH), yaw: yaws[best], pitch: DOLL_PITCH, fov: DOLL_FOV });
  }

  // Flies to a panorama, and ends there; by default it looks where the camera looks from outside.
  visit(node, heading = { yaw: lookOn(node, camera.yaw), pitch: 0 }) {
    if (!this.shows(node)) {
      jumpTo(node);
      return;
    }
    this.node = node;
    this.flyTo({ position: [...HEADER.spots[node].position], ...heading, fov: this.fov }, () => {
      jump(HEADER.spots[node].position, heading);
    });
  }

  // Without a flight.
  setOn(value) {
    if (this.isOn && !value) camera.fov = this.fov;
    this.isOn = value;
    this.flight = null;
    byId("doll").setAttribute("aria-pressed", value);
    changed();
  }

  // Corners of the box around the rooms, in level axes.
  findBox() {
    const boxes = HEADER.doll.boxes.filter((box, view) => box && this.shows(view));
    return [0, 1].map((end) => [0, 1, 2].map((k) => Math[end ? "max" : "min"](...boxes.map((box) => box[end][k]))));
  }

  // The distance from which a box fits into the picture.
  fit(box, yaw, pitch) {
    const rotation = turned(yaw, pitch), middle = scaled(plus(...box), 0.5);
    const tall = tangentOf(innerWidth, innerHeight, DOLL_FOV), wide = tall * innerWidth / innerHeight;
    let distance = 0;
    for (let corner = 0; corner < 8; corner++) {
      const offset = minus([0, 1, 2].map((k) => box[corner >> k & 1][k]), middle);
      const [x, y, z] = [0, 1, 2].map((k) => dot(column(rotation, k), offset));
      distance = Math.max(distance, Math.abs(x) / wide - z, Math.abs(y) / tall - z);
    }
    return 1.05 * distance;
  }

  // Where a camera with these angles sees the rooms.
  place(yaw, pitch) {
    const forward = HEADER.level.map((row) => dot(row, column(turned(yaw, pitch), 2)));
    return { position: minus(this.center, scaled(forward, this.distance)) };
  }

  orbit(yaw, pitch) {
    if (this.flight) return;
    camera.yaw += yaw;
    camera.pitch = clamp(camera.pitch + pitch, -89.9 * DEGREE, LOWEST);
    this.stay();
  }

  zoom(factor) {
    if (this.flight) return;
    this.distance = clamp(this.distance * factor, ...DOLL_ZOOM.map((limit) => limit * this.first));
    this.stay();
  }

  stay() {
    Object.assign(camera, this.place(camera.yaw, camera.pitch));
    changed();
  }

  // The keys that walk: sideways and up turn, forward comes nearer.
  move([right, up, forward], seconds) {
    if (right || up) this.orbit(-DOLL_TURN * seconds * right, -0.5 * DOLL_TURN * seconds * up);
    if (forward) this.zoom(Math.exp(-seconds * forward));
  }

  // Goes to the panorama nearest to what a point of the window shows.
  take(left, top) {
    const distance = measureAt(left, top);
    if (this.flight || distance === null) return;
    const point = plus(camera.position, scaled(rayOf(left, top), distance));
    this.visit(indexOfLeast(HEADER.spots.map(({ position }, node) => this.shows(node) ? distanceOf(position, point) : Infinity)));
  }

  flyTo(target, then = () => {}) {
    const start = { ...camera, position: [...camera.position] };
    this.flight = { start, target, then, began: null, seconds: calm.matches ? 0 : DOLL_SECONDS };
    changed();
  }

  advance(now) {
    const { flight } = this;
    if (!flight || isWaiting()) return;
    flight.began = flight.began === null ? now : flight.began;
    const t = flight.seconds ? clamp((now - flight.began) / (1000 * flight.seconds), 0, 1) : 1, part = ease(t);
    const mix = (from, to) => from + part * (to - from);
    const { start, target } = flight;
    camera.position = start.position.map((from, k) => mix(from, target.position[k]));
    for (const name of ["yaw", "pitch", "fov"]) camera[name] = mix(start[name], target[name]);
    changed();
    if (t < 1) return;
    this.flight = null;
    flight.then();
  }
}

export const doll = new DollHouse();
