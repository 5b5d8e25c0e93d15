// Keys, pointers, the wheel, the device's motion, and buttons.

import { tangentOf, turn, walk } from "./camera.js";
import { orbit, resizeDoll, zoomDoll } from "./doll.js";
import { byId, canvas, say, showMore } from "./dom.js";
import { embed } from "./embed.js";
import { enterAt, flyTo, toggleDoll, toggleTour } from "./flight.js";
import { clamp, DEGREE, distanceOf, dot, multiply } from "./graph.js";
import { endWay, goHome, setPose } from "./jump.js";
import { measure } from "./measure.js";
import { plan } from "./plan.js";
import { openList } from "./rings.js";
import { copyLink, parsePose, savePicture } from "./share.js";
import { camera, changed, state } from "./state.js";

const DRAG = 5; // pixels; a click moves by less
const held = new Set(), fingers = new Map();
let pressed; // where the pointer went down; null when it has moved
const MOVES = {
  KeyW: [0, 0, 1],
  ArrowUp: [0, 0, 1],
  KeyS: [0, 0, -1],
  ArrowDown: [0, 0, -1],
  KeyA: [-1, 0, 0],
  ArrowLeft: [-1, 0, 0],
  KeyD: [1, 0, 0],
  ArrowRight: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
};
const PRESSES = {
  Space: () => toggleTour(),
  KeyF: () => toggleFull(),
  KeyR: () => goHome(),
  KeyH: () => byId("keys").showModal(),
  KeyL: () => openList(),
  KeyM: () => HEADER.spots.length > 1 && plan.toggle(),
  KeyO: () => toggleDoll(),
  KeyP: () => savePicture(),
};
const CLOSES = { KeyH: "keys", KeyL: "list" }; // the dialogs that a key opens and closes

function onHeld() {
  state.step = [0, 1, 2].map((k) => [...held].reduce((sum, code) => sum + MOVES[code][k], 0));
}

function onKey(event) {
  /** @type {HTMLDialogElement} */
  const open = document.querySelector("dialog[open]");
  state.isFast = event.shiftKey;
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (open) {
    if (open.id !== CLOSES[event.code] || event.repeat) return;
    open.close();
    event.preventDefault();
    return;
  }
  if (event.code === "Escape") {
    showMore(false);
    if (measure.isOn) measure.toggle(false);
  }
  if (event.code === "Enter" && event.target === canvas && measure.isOn) measure.take(0.5 * innerWidth, 0.5 * innerHeight);
  const onButton = event.target.tagName === "BUTTON" && (event.code === "Space" || event.code === "Enter");
  if (onButton) return;
  const spot = Number(/^(?:Digit|Numpad)([1-9])$/.exec(event.code)?.[1]) - 1;
  if (MOVES[event.code]) {
    held.add(event.code);
    onHeld();
  }
  else if (PRESSES[event.code] && !event.repeat) PRESSES[event.code]();
  else if (HEADER.spots[spot]) {
    endWay();
    flyTo(spot);
  }
  else return;
  event.preventDefault();
  if (MOVES[event.code]) endWay();
}

// One finger or the mouse turns: the scene follows the pointer. Two fingers pull the scene: sideways, and forward by
// moving down or apart.
function onMove(event) {
  const last = fingers.get(event.pointerId);
  if (!last) return;
  const moved = [event.clientX - last[0], event.clientY - last[1]];
  if (pressed && distanceOf(pressed, [event.clientX, event.clientY]) >= DRAG) {
    pressed = null;
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true }); // not a ring
  }
  const before = [...fingers.values()];
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  if (before.length === 1) {
    const { clientWidth, clientHeight } = canvas;
    const radians = 2 * tangentOf(clientWidth, clientHeight) / clientHeight;
    if (state.doll.isOn) orbit(2 * Math.PI * moved[0] / clientWidth, -Math.PI * moved[1] / clientHeight);
    else turn(-moved[0] * radians, moved[1] * radians);
  } else if (before.length === 2) {
    const metres = 2 * HEADER.speed / Math.min(canvas.clientWidth, canvas.clientHeight);
    const gap = distanceOf(...before), apart = distanceOf(...fingers.values());
    if (state.doll.isOn) zoomDoll(gap / Math.max(apart, 1));
    endWay();
    walk(-0.5 * moved[0] * metres, 0, (0.5 * moved[1] + apart - gap) * metres);
  }
}

function onWheel(event) {
  if (!embed.isEngaged) {
    say("Click the picture to change its field of view by the wheel");
    return;
  }
  event.preventDefault();
  const pixels = event.deltaY * (event.deltaMode ? 33 : 1); // or lines
  const factor = Math.exp(0.001 * clamp(pixels, -200, 200));
  if (state.doll.isOn) zoomDoll(factor);
  else camera.fov = clamp(camera.fov * factor, HEADER.minFov, HEADER.maxFov);
  changed();
}

// Look around by the device's motion: its axes in the earth's (east, north, up), turned by the screen's angle.
let motion = null;
function onOrientation({ alpha, beta, gamma }) {
  if (alpha === null || beta === null || gamma === null || state.doll.isOn) return;
  const [ca, sa, cb, sb, cg, sg] = [alpha, beta, gamma].map((degrees) => degrees * DEGREE)
    .flatMap((angle) => [Math.cos(angle), Math.sin(angle)]);
  const toEarth = multiply([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]], multiply([[1, 0, 0], [0, cb, -sb], [0, sb, cb]], [[cg, 0, sg], [0, 1, 0], [-sg, 0, cg]]));
  const angle = (screen.orientation ? screen.orientation.angle : 0) * DEGREE;
  const inLevel = (axis) => { // x east, y down, z north
    const [east, north, up] = toEarth.map((row) => dot(row, axis));
    return [east, -up, north];
  };
  const right = inLevel([Math.cos(angle), -Math.sin(angle), 0]), forward = inLevel([0, 0, -1]);
  const yaw = Math.atan2(forward[0], forward[2]), pitch = Math.asin(clamp(-forward[1], -1, 1));
  const across = [Math.cos(yaw), 0, -Math.sin(yaw)];
  const down = [Math.sin(yaw) * Math.sin(pitch), Math.cos(pitch), Math.cos(yaw) * Math.sin(pitch)];
  if (motion.last === null) motion.last = yaw;
  camera.yaw += yaw - motion.last; // so that a drag can turn the camera, too
  motion.last = yaw;
  camera.pitch = clamp(pitch, -HEADER.maxPitch, HEADER.maxPitch);
  camera.roll = Math.atan2(dot(right, down), dot(right, across));
  changed();
}

async function toggleMotion() {
  if (motion) {
    removeEventListener("deviceorientation", onOrientation);
    motion = null;
    camera.roll = 0;
  } else {
    const ask = /** @type {any} */ (DeviceOrientationEvent).requestPermission; // iOS only
    if (ask && await ask.call(DeviceOrientationEvent) !== "granted") return;
    motion = { last: null };
    addEventListener("deviceorientation", onOrientation);
  }
  byId("motion").setAttribute("aria-pressed", motion !== null);
  changed();
}

function toggleFull() {
  const root = document.documentElement;
  if (document.fullscreenElement) document.exitFullscreen();
  else if (root.requestFullscreen) root.requestFullscreen().catch(() => {});
}

export function listen() {
  addEventListener("keydown", onKey);
  addEventListener("keyup", (event) => {
    state.isFast = event.shiftKey;
    held.delete(event.code);
    onHeld();
  });
  addEventListener("blur", () => {
    held.clear();
    onHeld();
  });
  addEventListener("resize", () => {
    if (state.doll.isOn) resizeDoll([innerWidth, innerHeight]);
    changed();
  });
  addEventListener("hashchange", () => {
    const pose = parsePose(location.hash);
    if (pose) setPose(pose);
  });
  addEventListener("pointerdown", (event) => byId("more").parentElement.contains(event.target) || showMore(false));
  for (const surface of [canvas, byId("spots")]) { // rings are over the canvas
    surface.addEventListener("pointerdown", (event) => {
      if (surface === canvas) canvas.setPointerCapture(event.pointerId);
      pressed = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.focus({ preventScroll: true });
    });
    surface.addEventListener("pointermove", onMove);
    surface.addEventListener("wheel", onWheel, { passive: false });
    surface.addEventListener("contextmenu", (event) => event.preventDefault());
  }
  addEventListener("pointerup", (event) => fingers.delete(event.pointerId));
  addEventListener("pointercancel", (event) => fingers.delete(event.pointerId));
  byId("spots").addEventListener("click", (event) => event.detail && pressed === null && event.stopPropagation(), true);
  canvas.addEventListener("click", ({ clientX, clientY }) => {
    if (!pressed) return;
    if (measure.isOn) measure.take(clientX, clientY);
    else if (state.doll.isOn) enterAt(clientX, clientY);
  });
  byId("play").onclick = toggleTour;
  byId("home").onclick = goHome;
  byId("place").onclick = openList;
  byId("list").onclick = ({ target }) => target === byId("list") && target.close(); // a click beside the dialog
  byId("map").onclick = () => plan.toggle();
  byId("doll").onclick = toggleDoll;
  byId("doll").hidden = !HEADER.doll.length;
  byId("no-doll").hidden = HEADER.doll.length > 0;
  byId("more").onclick = () => showMore(byId("menu").hidden);
  for (const [id, act] of Object.entries({ measure: () => measure.toggle(), full: toggleFull, picture: savePicture, link: copyLink })) {
    byId(id).onclick = () => {
      showMore(false);
      act();
      canvas.focus({ preventScroll: true });
    };
  }
  byId("help").onclick = () => byId("keys").showModal();
  byId("motion").onclick = toggleMotion;
  byId("motion").hidden = !("DeviceOrientationEvent" in window && matchMedia("(pointer: coarse)").matches);
  byId("full").hidden = !document.documentElement.requestFullscreen;
  byId("play").hidden = byId("place").hidden = byId("map").hidden = HEADER.spots.length < 2;
  byId("buttons").hidden = false;
}
