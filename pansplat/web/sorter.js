"use strict";
// The worker of unpack.js: the drawing order and the colours of one camera position, of the views of one part. Neither depends on the
// camera's rotation. What belongs to other parts, and to views that have not arrived, is unchanged.

function sort({ position, part }) {
  const { parts, views: all, order, colors } = scene, views = arrived.filter((view) => parts[view] === part);
  for (const view of views) {
    sortView(all[view], position);
    if (colors) evaluateColors(all[view], position);
  }
  postMessage({ position, part, views, arrived: arrived.length, order, colors: colors && new Uint8Array(colors.buffer) });
}

// Writes the Gaussians of a view to the order, farthest first: a stable radix sort of the bits of the squared distances, which are
// in the order of the numbers.
function sortView({ start, count }, [x, y, z]) {
  const { means, order } = scene, squared = new Float32Array(count);
  for (let i = start, place = 0; place < count; i++, place++) {
    const dx = means[3 * i] - x, dy = means[3 * i + 1] - y, dz = means[3 * i + 2] - z;
    squared[place] = dx * dx + dy * dy + dz * dz;
  }
  const bits = new Uint32Array(squared.buffer);
  let from = new Uint32Array(count), to = new Uint32Array(count);
  for (let i = 0; i < count; i++) from[i] = i;
  for (const shift of [0, 16]) {
    const ends = new Uint32Array(65537);
    for (let i = 0; i < count; i++) ends[((bits[i] >>> shift) & 65535) + 1]++;
    for (let i = 0; i < 65536; i++) ends[i + 1] += ends[i];
    for (let i = 0; i < count; i++) to[ends[(bits[from[i]] >>> shift) & 65535]++] = from[i];
    [from, to] = [to, from];
  }
  for (let i = 0; i < count; i++) order[start + i] = start + from[count - 1 - i];
}

// RGB and a padding byte of a view's Gaussians: base colour plus harmonics of degree 1 to 3 (docs/conventions.md).
function evaluateColors({ start, count }, [x, y, z]) {
  const { means, base, harmonics, colors, terms, harmonicsScale, colorRange: [low, high] } = scene, basis = new Float32Array(terms);
  const unit = 255 / (high - low), step = unit * harmonicsScale / 127;
  for (let i = start; i < start + count; i++) {
    const dx = means[3 * i] - x, dy = means[3 * i + 1] - y, dz = means[3 * i + 2] - z;
    const inverse = 1 / Math.max(Math.hypot(dx, dy, dz), 1e-12);
    evaluateBasis(dx * inverse, dy * inverse, dz * inverse, basis);
    for (let channel = 0; channel < 3; channel++) {
      let sum = 0;
      for (let term = 0; term < terms; term++) sum += basis[term] * harmonics[3 * (terms * i + term) + channel];
      const black = -unit * low; // the clamp of colours at 0
      colors[4 * i + channel] = Math.max(base[4 * i + channel] + step * sum, black);
    }
  }
}

// Real spherical harmonics without the constant one, in the order and with the signs of 3DGS.
function evaluateBasis(x, y, z, basis) {
  basis[0] = -0.4886025119029199 * y;
  basis[1] = 0.4886025119029199 * z;
  basis[2] = -0.4886025119029199 * x;
  if (basis.length < 8) return;
  const xx = x * x, yy = y * y, zz = z * z;
  basis[3] = 1.0925484305920792 * x * y;
  basis[4] = -1.0925484305920792 * y * z;
  basis[5] = 0.31539156525252005 * (2 * zz - xx - yy);
  basis[6] = -1.0925484305920792 * x * z;
  basis[7] = 0.5462742152960396 * (xx - yy);
  if (basis.length < 15) return;
  basis[8] = -0.5900435899266435 * y * (3 * xx - yy);
  basis[9] = 2.890611442640554 * x * y * z;
  basis[10] = -0.4570457994644658 * y * (4 * zz - xx - yy);
  basis[11] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
  basis[12] = -0.4570457994644658 * x * (4 * zz - xx - yy);
  basis[13] = 1.445305721320277 * z * (xx - yy);
  basis[14] = -0.5900435899266435 * x * (xx - 3 * yy);
}
