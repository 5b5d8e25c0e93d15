// Draws the Gaussians of HEADER's views with WebGL 2 (docs/rendering.md), as they arrive.

import { inAxes, unit } from "./graph.js";

const TEXTURE_WIDTH = 2048; // WebGL 2 guarantees 2048 texels a side, which is 4,194,304 Gaussians

// Draws to a WebGL 2 context: one layer for each view, and their mean by nearness (docs/rendering.md, section 7).
export class Renderer {
  constructor(gl) {
    this.gl = gl;
    const float = gl.getExtension("EXT_color_buffer_float");
    const half = float || gl.getExtension("EXT_color_buffer_half_float");
    this.formats = half ? [gl.RGBA16F, gl.RG16F] : [gl.RGBA8, gl.RG8];
    this.hasDepth = Boolean(half);
    this.splat = this.link(SHADERS.splat, "geometry", "colors", "order", "scales");
    this.accumulate = this.link(SHADERS.accumulate);
    this.resolve = this.link(SHADERS.resolve, "sum_color", "sum_depth");
    const width = TEXTURE_WIDTH, height = Math.max(Math.ceil(HEADER.count / width), 1);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The scene is too large for this device.");
    this.geometry = this.makeTexture(width, height, gl.RGBA32UI);
    this.scales = this.makeTexture(width, height, gl.R32UI);
    this.colors = this.makeTexture(width, height, gl.RGBA8);
    this.order = this.makeTexture(width, height, gl.R32UI);
    this.ready = new Set(); // views that have an order
    this.splats = gl.createVertexArray();
    this.screen = gl.createVertexArray();
    gl.bindVertexArray(this.splats);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const corners = Uint16Array.from({ length: 6 * HEADER.batch }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.targets = [];
    this.size = [0, 0];
  }

  // `textures`: names of its textures, in the order of `bind`.
  link([vertex, fragment], ...textures) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(["The graphics driver rejects a shader.", gl.getProgramInfoLog(program), ...logs].join(" "));
    }
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name.replace("[0]", "")] = gl.getUniformLocation(program, name);
    }
    gl.useProgram(program);
    textures.forEach((name, unit) => gl.uniform1i(places[name], unit));
    return { program, places };
  }

  makeTexture(width, height, format) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    return texture;
  }

  // Writes texels from the index `start` on; `components` of an array are one texel.
  write(texture, values, components, start, channels, type) {
    const gl = this.gl, end = start + values.length / components;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (let first = start; first < end;) {
      const x = first % TEXTURE_WIDTH, width = Math.min(TEXTURE_WIDTH - x, end - first);
      const height = x === 0 ? Math.max(Math.floor((end - first) / TEXTURE_WIDTH), 1) : 1;
      const y = Math.floor(first / TEXTURE_WIDTH), offset = components * (first - start);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, width, height, channels, type, values, offset);
      first += width * height;
    }
  }

  // Takes the Gaussians of a view (unpack.js).
  add({ view, geometry, scales, colors }) {
    const gl = this.gl, { start } = HEADER.views[view];
    this.write(this.geometry, geometry, 4, start, gl.RGBA_INTEGER, gl.UNSIGNED_INT);
    this.write(this.scales, scales, 1, start, gl.RED_INTEGER, gl.UNSIGNED_INT);
    this.write(this.colors, colors, 4, start, gl.RGBA, gl.UNSIGNED_BYTE);
  }

  // Replaces the drawing order, and the colours if they depend on the position.
  setSorted({ views, order, colors }) {
    const gl = this.gl;
    this.write(this.order, order, 1, 0, gl.RED_INTEGER, gl.UNSIGNED_INT);
    if (colors) this.write(this.colors, colors, 4, 0, gl.RGBA, gl.UNSIGNED_BYTE);
    views.forEach((view) => this.ready.add(view));
  }

  // Targets of a size: the layer of one view, and the weighted sum of layers with the sum of weights. `depth`: a layer has
  // depths too.
  makeTargets(width, height, depth) {
    const gl = this.gl, [color, pair] = this.formats;
    return [depth ? [color, color] : [color], [color, pair]].map((formats) => {
      const framebuffer = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      const textures = formats.map((format, i) => {
        const texture = this.makeTexture(width, height, format);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
        return texture;
      });
      gl.drawBuffers(formats.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
      return { framebuffer, textures };
    });
  }

  removeTargets(targets) {
    for (const { framebuffer, textures } of targets) {
      this.gl.deleteFramebuffer(framebuffer);
      textures.forEach((texture) => this.gl.deleteTexture(texture));
    }
  }

  // Targets that are larger than the image if an earlier one was larger.
  resize(...size) {
    if (size.every((side, i) => side <= this.size[i])) return;
    this.size = size.map((side, i) => Math.max(side, this.size[i]));
    this.removeTargets(this.targets);
    this.targets = this.makeTargets(...this.size, false);
  }

  // Adds up the layers of the views in targets of `makeTargets`.
  addLayers(camera, weights, targets, width, height) {
    const gl = this.gl, [layer, sum] = targets;
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE0);
    this.setCamera(camera, width, height);
    let isFirst = true;
    const isReady = (view) => weights[view] && HEADER.views[view].count && this.ready.has(view);
    [...HEADER.views.keys()].filter(isReady).forEach((view) => {
      const { start, count } = HEADER.views[view];
      gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
      layer.textures.forEach((_, buffer) => gl.clearBufferfv(gl.COLOR, buffer, [0, 0, 0, 0]));
      this.drawLayer(start, count);
      gl.bindFramebuffer(gl.FRAMEBUFFER, sum.framebuffer);
      this.addLayer(layer.textures, weights[view], isFirst);
      isFirst = false;
    });
    if (!isFirst) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.framebuffer);
    for (const buffer of [0, 1]) gl.clearBufferfv(gl.COLOR, buffer, [0, 0, 0, 0]);
  }

  // Draws to a viewport (left, bottom, width, height) of a framebuffer, null for the canvas. `camera` has a `position`,
  // a `rotation` (camera to world), the `center` and `half` the size of the image on the image plane, and while it moves a
  // `shift` during the exposure, world axes.
  draw(camera, weights, framebuffer, [left, bottom, width, height]) {
    const gl = this.gl;
    this.resize(width, height);
    this.addLayers(camera, weights, this.targets, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(left, bottom, width, height);
    gl.disable(gl.BLEND);
    const { program, places } = this.resolve;
    gl.useProgram(program);
    gl.uniform2i(places.origin, left, bottom);
    gl.uniform3f(places.background, 0, 0, 0);
    this.bind(this.targets[1].textures);
    gl.bindVertexArray(this.screen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Mean radial distance of what one pixel shows, or null if that is nothing, or the device has no targets for it. `camera`
  // is that of a picture of the pixel alone.
  measure(camera, weights) {
    const gl = this.gl;
    if (!this.hasDepth) return null;
    const targets = this.makeTargets(1, 1, true), [, sum] = targets, values = new Float32Array(4);
    this.addLayers(camera, weights, targets, 1, 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sum.framebuffer);
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, values);
    this.removeTargets(targets);
    const [distance, coverage] = values;
    return coverage > 0.5 ? distance / coverage : null;
  }

  setCamera({ position, rotation, center, half, shift = [0, 0, 0] }, width, height) {
    const gl = this.gl, { program, places } = this.splat;
    const [[x, y], [w, h]] = [center, half], focal = [0.5 * width / w, 0.5 * height / h];
    gl.useProgram(program);
    // GLSL reads columns: the rows of camera-to-world are the columns of its inverse.
    gl.uniformMatrix3fv(places.world_to_camera, false, rotation.flat());
    gl.uniform3fv(places.position, position);
    gl.uniform3fv(places.shift, inAxes(rotation, shift));
    gl.uniform1f(places.near, HEADER.near);
    gl.uniform1f(places.filter_variance, HEADER.filterVariance / (focal[0] * focal[1]));
    gl.uniform2f(places.half_size, Math.abs(x) + w, Math.abs(y) + h);
    gl.uniform4f(places.window, x, y, w, h);
    gl.uniform1f(places.margin, 0.02 / Math.min(...focal));
    gl.uniform2f(places.principal, 0.5 * width - x * focal[0], 0.5 * height + y * focal[1]);
    gl.uniform2fv(places.focal, focal);
    gl.uniform2fv(places.color_range, HEADER.colorRange);
    const sides = [[-1, 0, w + x], [1, 0, w - x], [0, -1, h + y], [0, 1, h - y]].map(unit);
    gl.uniform3fv(places.sides, sides.flat());
  }

  bind(textures) {
    textures.forEach((texture, unit) => {
      this.gl.activeTexture(this.gl.TEXTURE0 + unit);
      this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
    });
  }

  drawLayer(start, count) {
    const gl = this.gl;
    gl.useProgram(this.splat.program);
    this.bind([this.geometry, this.colors, this.order, this.scales]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.splats);
    gl.uniform2i(this.splat.places.segment, start, count);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * HEADER.batch, gl.UNSIGNED_SHORT, 0, Math.ceil(count / HEADER.batch));
  }

  addLayer(textures, weight, isFirst) {
    const gl = this.gl, { program, places } = this.accumulate;
    gl.useProgram(program);
    gl.uniform1f(places.weight, weight);
    gl.uniform1i(places.layer_color, 0);
    gl.uniform1i(places.layer_depth, textures.length - 1);
    gl.uniform1i(places.with_depth, textures.length - 1);
    this.bind(textures);
    if (isFirst) gl.disable(gl.BLEND);
    else gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.blendEquationSeparate(gl.FUNC_ADD, gl.MAX);
    gl.bindVertexArray(this.screen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.blendEquation(gl.FUNC_ADD);
  }
}
