// The data, which arrives in chunks while the scene is shown, and failures. docs/web.md describes the data. A page in one file
// has all views; one with a folder loads those that the camera needs.

import { nodeHere } from "./camera.js";
import { byId, canvas, say, takeText } from "./dom.js";
import { camera, currentPart, edges, isComplete, isSortedFor, parts, refresh, state } from "./state.js";

const SILENCE_MS = 10000; // silence of a server after which a request has failed
export const TRIES = 3, PAUSE_AFTER_ERROR = 2000; // tries of a file that does not arrive, and milliseconds between two
const GZIP = 0x8b1f; // the first two bytes of a gzip
const MISSING = "A part of the scene did not arrive. Load the page again; if that does not help, copy the whole folder.";

export let failure = null;
let worker = null, chunksArrived = 0;
let queue = Promise.resolve(); // loads one file after the other; the first view comes first
let fails = fail; // the function that reports an error of the data

export function fail(error) {
  if (failure) return;
  failure = error;
  byId("cover").hidden = false;
  byId("cover").className = "failed";
  byId("message").textContent = error.message || String(error);
  byId("bar").hidden = true;
  console.error(error);
}

// `chunk`: base64, or bytes.
function receive(view, isLast, chunk) {
  chunksArrived += 1;
  byId("bar").value = chunksArrived / countChunks();
  if (worker) worker.postMessage({ view, chunk, isLast });
}

// In a page of one file a script for each chunk of the data calls this.
window.addChunk = (view, isLast) => receive(view, isLast, takeText());

// A file of the folder beside the page. A cache may hold what a server has answered in its place before.
export async function fetchFile(name, isAgain) {
  const stop = new AbortController(), chunks = [];
  const hear = (promise) => {
    const silence = setTimeout(() => stop.abort(), SILENCE_MS);
    return promise.finally(() => clearTimeout(silence));
  };
  const response = await hear(fetch(`${HEADER.folder}/${name}`, { signal: stop.signal, cache: isAgain ? "reload" : "default" }));
  if (!response.ok) throw new Error(`${response.url} is missing`);
  const reader = response.body.getReader(), type = response.headers.get("Content-Type") || "";
  for (;;) {
    const { done, value } = await hear(reader.read());
    if (done) return new Blob(chunks, { type });
    chunks.push(value);
  }
}

// Files load one by one. A file that fails is tried again for ever, in the background. A page without any Gaussians fails.
function loadView(view, tries = 1) {
  queue = queue.then(async () => {
    const blob = await fetchFile(...HEADER.views[view].files, tries > 1), chunk = await blob.arrayBuffer();
    if (new Uint16Array(chunk.slice(0, 2))[0] !== GZIP) throw new Error("this is no gzip"); // but a page of the server
    state.missing.delete(view);
    receive(view, true, chunk);
  }).catch(() => {
    setTimeout(() => failure || loadView(view, tries + 1), tries * PAUSE_AFTER_ERROR);
    if (tries !== TRIES) return;
    state.missing.add(view);
    canvas.ariaBusy = !isComplete();
    if (isComplete() && !state.received.size) fails(new Error(MISSING));
    else say(`A part of the scene at ${HEADER.spots[view].name} cannot be loaded yet`);
  });
}

const countChunks = () => [...state.requested].reduce((sum, view) => sum + HEADER.views[view].files.length, 0);

// Loads what the camera needs: the views of the edges at its panorama, and where a flight ends.
export function loadAround() {
  if (state.requested.size === HEADER.loading.length) return;
  const nodes = [nodeHere(), ...(state.way ? [state.way.spot] : [])];
  const groups = edges.filter(([a, b]) => nodes.includes(a) || nodes.includes(b)).map(([, , each]) => each);
  const near = new Set([...groups, state.group].flatMap((each) => HEADER.groups[each]));
  for (const view of HEADER.loading) {
    if (state.requested.has(view) || !(HEADER.folder === null || near.has(view))) continue;
    state.requested.add(view);
    canvas.ariaBusy = true;
    if (HEADER.folder !== null) loadView(view);
  }
}

// `tolerance`: distance in metres for which the order of before is kept.
export function requestSort(tolerance = 0) {
  if (state.isSorting || isSortedFor(camera.position, currentPart(), tolerance)) return;
  state.isSorting = true;
  worker.postMessage({ position: [...camera.position], part: currentPart() });
}

function onSorted(data) {
  Object.assign(state, { isSorting: false, sorted: data });
  if (state.renderer) state.renderer.setSorted(data);
  refresh();
}

// Starts the worker; `onView` gets the Gaussians of each view. Returns a promise of the first order.
/** @type {(onView: (data: any) => void) => Promise<void>} */
export function load(onView) {
  return new Promise((resolve, reject) => {
    fails = (error) => state.sorted ? fail(error) : reject(error);
    worker = new Worker(URL.createObjectURL(new Blob([WORKER])));
    worker.onmessage = ({ data }) => {
      if (data.error) fails(new Error(`The data of the scene cannot be read: ${data.error}`));
      else if (data.order) {
        onSorted(data);
        resolve();
      } else {
        state.received.add(data.view);
        onView(data);
      }
    };
    worker.onerror = (event) => fails(new Error(`The worker failed: ${event.message}`));
    const { count, degree, views, loading, harmonicsScale, colorRange } = HEADER;
    const first = { position: [...camera.position], part: currentPart() };
    worker.postMessage({ header: { count, degree, views, loading, parts, harmonicsScale, colorRange, first } });
    if (HEADER.folder !== null) return;
    loadAround();
    addEventListener("DOMContentLoaded", () => {
      if (chunksArrived !== countChunks()) fails(new Error(MISSING));
    });
  });
}
