"use strict";
// A worker, with sorter.js: decodes the data of the page as its parts arrive, and hands over the Gaussians of each view when
// it is complete. docs/web.md describes the data.

let scene = null;
const arrived = [], writers = new Map(); // views, and where their data goes
let first = null; // what is sorted as soon as a view of its part has arrived, before the parts that wait

self.onmessage = ({ data }) => {
  if (data.header) begin(data.header);
  else if (data.chunk !== undefined) receive(data);
  else sort(data);
};

function begin(header) {
  ({ first } = header);
  const { count, degree } = header, terms = (degree + 1) ** 2 - 1;
  scene = { ...header, terms, means: new Float32Array(3 * count), order: new Uint32Array(count) };
  if (terms) Object.assign(scene, { harmonics: new Int8Array(3 * terms * count), base: new Uint8Array(4 * count), colors: new Uint8ClampedArray(4 * count) });
}

function receive({ view, chunk, isLast }) {
  if (!writers.has(view)) {
    const stream = new DecompressionStream("gzip");
    writers.set(view, stream.writable.getWriter());
    readView(view, stream.readable.getReader()).catch((error) => postMessage({ error: String(error.message || error) }));
  }
  const writer = writers.get(view);
  writer.write(typeof chunk === "string" ? decode(chunk) : new Uint8Array(chunk)).catch(() => {}); // its error is that of the reader
  if (isLast) writer.close().catch(() => {});
}

function decode(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

async function readView(view, reader) {
  const planes = new Uint8Array(scene.views[view].count * (23 + 3 * scene.terms));
  for (let filled = 0; filled < planes.length;) {
    const { value, done } = await reader.read();
    if (done) throw new Error("The data of the scene ends early.");
    planes.set(value, filled);
    filled += value.length;
  }
  const arrays = unpack(planes, view);
  arrived.push(view);
  postMessage({ view, ...arrays }, Object.values(arrays).map((array) => array.buffer));
  const isOwn = (each) => scene.parts[each] === first?.part, isEmpty = (each) => !scene.views[each].count;
  const isPart = isOwn(view) && (!isEmpty(view) || scene.loading.filter(isOwn).every(isEmpty)), isLast = arrived.length === scene.loading.length;
  if (!first || !isPart && !isLast) return;
  sort(first);
  first = null;
}

// Planes of bytes to texels (shaders/page.vert), and to the arrays of the worker: the inverse of
// pansplat.export.page_data.pack_gaussians.
function unpack(planes, view) {
  const { start, count } = scene.views[view], { terms, means } = scene;
  const plane = (k) => planes.subarray(k * count, (k + 1) * count);
  const geometry = new Uint32Array(4 * count), scales = new Uint32Array(count), colors = new Uint8Array(4 * count);
  const put = (target, step, offset, shift, k) => {
    const values = plane(k);
    for (let i = 0; i < count; i++) target[step * i + offset] |= values[i] << shift;
  };
  for (let axis = 0; axis < 3; axis++) {
    for (let byte = 0; byte < 3; byte++) put(geometry, 4, axis, 24 - 8 * byte, 3 * axis + byte);
  }
  const bits = new Uint32Array(means.buffer);
  for (let i = 0; i < count; i++) for (let axis = 0; axis < 3; axis++) bits[3 * (start + i) + axis] = geometry[4 * i + axis];
  for (let byte = 0; byte < 4; byte++) {
    put(scales, 1, 0, 24 - 8 * byte, 9 + byte);
    put(geometry, 4, 3, 24 - 8 * byte, 15 + byte);
  }
  put(geometry, 4, 0, 0, 19); // opacity
  put(geometry, 4, 1, 0, 13);
  put(geometry, 4, 2, 0, 14);
  for (let channel = 0; channel < 3; channel++) put(colors, 4, channel, 0, 20 + channel);
  if (terms) scene.base.set(colors, 4 * start);
  for (let k = 0; k < 3 * terms; k++) {
    const values = plane(23 + k);
    for (let i = 0; i < count; i++) scene.harmonics[3 * terms * (start + i) + k] = values[i];
  }
  return { geometry, scales, colors };
}
