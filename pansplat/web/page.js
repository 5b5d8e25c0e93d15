// The page: starts when the first views are there, and answers scripts. docs/web.md describes it. HEADER, SHADERS and
// WORKER of all modules are constants that export/page_files.py writes before them.

import { cameraFor, settleAt, showViews, tallOf } from "./camera.js";
import { byId, canvas } from "./dom.js";
import { embed } from "./embed.js";
import { flyTo } from "./flight.js";
import { listen } from "./input.js";
import { endWay, jumpTo, PHOTO_WAIT_MS, setPose } from "./jump.js";
import { fail, failure, load, loadAround } from "./loading.js";
import { isSettled, onFrame } from "./loop.js";
import { makeNotes } from "./notes.js";
import { photographs } from "./photographs.js";
import { drawAt } from "./picture.js";
import { Renderer } from "./renderer.js";
import { makeList, makeRings } from "./rings.js";
import { parsePose, poseOf } from "./share.js";
import { camera, changed, currentPart, isComplete, isSortedFor, redraw, shown, state } from "./state.js";
import { headset } from "./xr.js";

const BROWSERS = "Chrome or Edge 92, Firefox 113, Safari 16.4 or later"; // versions that have all that the page uses
const FROM_DISK =
  "Browsers read this folder only from a web server. Upload it, or show it with pansplat export --serve. A page that opens from disk is a file: export to a name that ends in .html.";
const lack = (what) => new Error(`This page needs ${what}, which is in ${BROWSERS}, unless the device lacks it.`);

// The poster has the scale and the place of the picture that follows.
function placePoster() {
  const { style } = byId("cover").querySelector("img"), tall = tallOf(innerWidth, innerHeight);
  style.height = `${100 * HEADER.tallest / tall}%`;
}

const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// `value`: a renderer that has the data, or null while the graphics are lost.
function setRenderer(value) {
  state.renderer = value;
  if (value && state.sorted) value.setSorted(state.sorted);
  changed();
}

async function main() {
  placePoster();
  addEventListener("resize", placePoster);
  if (HEADER.folder !== null && location.protocol === "file:") throw new Error(FROM_DISK);
  if (!window.DecompressionStream) throw lack("DecompressionStream");
  const linked = parsePose(location.hash);
  if (linked) Object.assign(camera, cameraFor(linked));
  settleAt(camera.position);
  canvas.ariaBusy = true;
  const received = []; // kept for a context that is lost
  const loading = load((data) => {
    received.push(data);
    if (state.renderer) state.renderer.add(data);
    if (isComplete()) canvas.ariaBusy = false;
  });
  loading.catch(() => {}); // an error that comes before it is awaited is reported later
  const gl = canvas.getContext("webgl2", { alpha: false, powerPreference: "high-performance" });
  if (!gl) throw lack("WebGL 2");
  headset.gl = gl;
  const makeRenderer = () => {
    if (gl.isContextLost()) return;
    const made = new Renderer(gl);
    received.forEach((data) => made.add(data));
    setRenderer(made);
  };
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    setRenderer(null);
    headset.lose();
  });
  canvas.addEventListener("webglcontextrestored", () => {
    try {
      makeRenderer();
    } catch (error) {
      fail(error);
    }
  });
  makeRenderer();
  while (!state.renderer) { // the context is lost
    if (failure) throw failure;
    await wait(50);
  }
  let isLoaded = false, isLate = false;
  const finish = () => {
    isLoaded = true;
  };
  loading.then(finish, finish);
  wait(PHOTO_WAIT_MS).then(() => {
    isLate = true;
  });
  while (!isLoaded && !photographs.isOpaque) { // it can be looked at before the Gaussians arrive
    if (isLate || !photographs.isExpected) loadAround();
    photographs.update(1);
    await wait(5);
  }
  loadAround();
  if (photographs.isOpaque) loading.catch(fail);
  else await loading;
  showViews(1);
  listen();
  headset.offer();
  makeRings();
  makeList();
  makeNotes();
  embed.listen([canvas, byId("spots")], window.pansplat);
  onFrame(performance.now());
  byId("cover").className = "done";
  setTimeout(() => {
    byId("cover").hidden = !failure;
  }, 700);
}

// A panorama by its number in the list, from 1, or its name.
function findNode(panorama) {
  const node = typeof panorama === "number" ? panorama - 1 : HEADER.spots.findIndex(({ name }) => name === panorama);
  if (!HEADER.spots[node]) throw new Error(`There is no panorama ${JSON.stringify(panorama)}; there are 1 to ${HEADER.spots.length}.`);
  return node;
}

// What scripts use, an EventTarget: docs/web.md, Embedding.
window.pansplat = Object.assign(new EventTarget(), {
  camera,
  panoramas: HEADER.spots.map(({ name }) => name),
  getPose: () => poseOf(camera),
  setPose,
  isSettled,
  async goTo(panorama, { jump = false } = {}) {
    const node = findNode(panorama);
    endWay();
    return embed.await(node, () => jump ? jumpTo(node) : flyTo(node));
  },
  async render(width, height) {
    await window.pansplat.ready;
    const place = [...camera.position];
    settleAt(place);
    loadAround();
    while (!state.sorted || !state.renderer || !isComplete() || !isSortedFor(place, currentPart()) || !photographs.isFinal([width, height])) {
      if (failure) throw failure;
      await wait(5);
      photographs.update(1, [width, height]);
    }
    settleAt(place);
    for (const view of state.sorted.views) shown[view] = 1;
    drawAt(width, height);
    const image = canvas.toDataURL("image/png");
    redraw();
    return image;
  },
});
window.pansplat.ready = main();
window.pansplat.ready.catch(fail);
