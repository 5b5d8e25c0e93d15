// The data, which arrives in chunks while the scene is shown, and failures. docs/web.md describes the data. A page in one file
// has all views; one with a folder loads those that the camera needs.

import { nodeHere } from "./camera.js";
import { byId, canvas } from "./dom.js";
import { camera, currentPart, edges, isSortedFor, parts, refresh, state } from "./state.js";

export let failure = null;
let worker = null, chunksArrived = 0;
let queue = Promise.resolve();             // of files: the first view comes first
let onMissing = fail;                      // reports a chunk that does not arrive

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

// In a page of one file a script for each chunk of the data calls this. The chunk is the element before: unlike text in a
// program, it is not kept.
window.addPart = (view, isLast) => {
  const { currentScript: script } = document, { previousElementSibling: element } = script;
  element.remove();
  script.remove();
  receive(view, isLast, element.textContent);
};

// Of the folder beside the page.
export async function fetchFile(name) {
  const response = await fetch(`${HEADER.folder}/${name}`);
  if (!response.ok) throw new Error(`${response.url} is missing`);
  return response;
}

const countChunks = () => [...state.requested].reduce((sum, view) => sum + HEADER.views[view].files.length, 0);

// Loads what the camera needs: the views of the edges at its panorama, and where a flight ends; all without edges.
export function loadAround() {
  if (state.requested.size === HEADER.loading.length) return;
  const nodes = [nodeHere(), ...(state.flight ? [state.flight.spot] : [])];
  const groups = edges.filter(([a, b]) => nodes.includes(a) || nodes.includes(b)).map(([, , each]) => each);
  const near = new Set([...groups, state.group].flatMap((each) => HEADER.groups[each]));
  const isAll = HEADER.folder === null || !edges.length;
  for (const view of HEADER.loading) {
    if (state.requested.has(view) || !(isAll || near.has(view))) continue;
    state.requested.add(view);
    canvas.ariaBusy = true;
    if (HEADER.folder === null) continue;
    queue = queue.then(() => fetchFile(...HEADER.views[view].files)).then((response) => response.arrayBuffer()).then(
      (chunk) => receive(view, true, chunk), () => onMissing(new Error("A part of the scene is missing. Copy the whole folder.")),
    );
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
export function load(onView) {
  return new Promise((resolve, reject) => {
    const fails = (error) => state.sorted ? fail(error) : reject(error);
    onMissing = fails;
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
      if (chunksArrived !== countChunks()) fails(new Error("A part of the scene is missing. Copy the whole folder."));
    });
  });
}
