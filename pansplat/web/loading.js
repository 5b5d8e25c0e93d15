// The data, which arrives in parts while the scene is shown, and failures. docs/web.md describes the data.

import { camera, currentPart, parts } from "./camera.js";
import { byId } from "./dom.js";
import { onSorted, sorted } from "./loop.js";

export let worker = null, failure = null, partsArrived = 0, arrived = 0;  // parts of the data, views
export const isComplete = () => arrived === HEADER.loading.length;

export function fail(error) {
  if (failure) return;
  failure = error;
  byId("cover").hidden = false;
  byId("cover").className = "failed";
  byId("message").textContent = error.message || String(error);
  byId("bar").hidden = true;
  console.error(error);
}

// A script for each part of the data calls this. In a page of one file the part is the element before: unlike text in a
// program, it is not kept.
window.addPart = (text) => {
  const { currentScript: script } = document;
  if (text === undefined) {
    text = script.previousElementSibling.textContent;
    script.previousElementSibling.remove();
  }
  script.remove();
  partsArrived += 1;
  byId("bar").value = partsArrived / HEADER.dataParts;
  if (!worker) return;
  worker.postMessage({ text });
  if (partsArrived === HEADER.dataParts) worker.postMessage({ end: true });
};

// Starts the worker; `onView` gets the Gaussians of each view. Returns a promise of the first order.
export function load(onView) {
  return new Promise((resolve, reject) => {
    const fails = (error) => sorted ? fail(error) : reject(error);
    worker = new Worker(URL.createObjectURL(new Blob([WORKER])));
    worker.onmessage = ({ data }) => {
      if (data.error) fails(new Error(`The data of the scene cannot be read: ${data.error}`));
      else if (data.order) {
        onSorted(data);
        resolve();
      } else {
        arrived += 1;
        onView(data);
      }
    };
    worker.onerror = (event) => fails(new Error(`The worker failed: ${event.message}`));
    const { count, degree, views, loading, harmonicsScale, colorRange } = HEADER;
    const first = { position: [...camera.position], part: currentPart(), ranges: null };
    worker.postMessage({ header: { count, degree, views, loading, parts, harmonicsScale, colorRange, first } });
    addEventListener("DOMContentLoaded", () => {
      if (partsArrived !== HEADER.dataParts) fails(new Error("A part of the scene is missing. Copy the whole folder."));
    });
  });
}
