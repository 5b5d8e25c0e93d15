"use strict";
// The page: loads the scene, draws it with WebGL 2, and moves the camera. docs/web.md describes the data.
// Convention: OpenCV axes (x right, y down, z forward), as everywhere in pansplat. Positions are in the scene's world,
// moved by its origin. Matrices are arrays of rows.

(() => {
  const byId = (id) => document.getElementById(id);
  const canvas = byId("view"), bar = byId("bar");
  const MAX_PITCH = 89.9 * Math.PI / 180;
  const MIN_FOV = 20, MAX_FOV = 110;  // degrees, vertical
  const MIN_WEIGHT = 1e-4;            // of a view: with it, the other views fill the holes of a view at its own camera
  const BATCH = HEADER.batch;         // quads of one instance
  const FADE_MS = 1000;               // from the views of one edge to those of the next, and from part to part
  const SOFT = 0.3;                   // of the way to the limit of the camera, in which steps become shorter
  const TURN_SPEED = Math.PI / 2;     // radians a second, towards a link
  const MAX_PIXELS = 3e6;             // of the canvas: limits the memory of its render targets

  // ---- loading ----

  const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

  // The step of the progress bar becomes visible before the next one starts.
  const report = (fraction) => {
    bar.value = fraction;
    return wait(0);
  };

  async function load() {
    const gzip = [];
    for (let i = 0; i < PARTS.length; i++) {
      const text = atob(PARTS[i]), bytes = new Uint8Array(text.length);
      for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
      gzip.push(bytes);
      PARTS[i] = null;
      if (i % 4 === 3) await report(0.7 + 0.1 * i / PARTS.length);
    }
    if (PARTS.length !== HEADER.dataParts) throw new Error("A part of the scene is missing. Copy the whole folder.");
    await report(0.8);
    const stream = new Blob(gzip).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = new Uint8Array(await new Response(stream).arrayBuffer());
    await report(0.9);
    return unpack(data);
  }

  // Planes of bytes to arrays: the inverse of pansplat.web.data.pack_gaussians.
  function unpack(data) {
    const count = HEADER.count, plane = (k) => data.subarray(k * count, (k + 1) * count);
    const word = new DataView(new ArrayBuffer(4));
    const joined = (k, bytes) => {
      const out = new Float32Array(count), planes = [...Array(bytes)].map((_, b) => plane(k + b));
      const bits = new Uint32Array(out.buffer);
      for (let b = 0; b < bytes; b++) for (let i = 0; i < count; i++) bits[i] |= planes[b][i] << (24 - 8 * b);
      return out;
    };
    const means = new Float32Array(3 * count), geometry = new Float32Array(12 * count);
    for (let axis = 0; axis < 3; axis++) {
      const values = joined(3 * axis, 3);
      for (let i = 0; i < count; i++) means[3 * i + axis] = geometry[12 * i + axis] = values[i];
    }
    for (let axis = 0; axis < 3; axis++) {
      const values = joined(9 + 2 * axis, 2);
      for (let i = 0; i < count; i++) geometry[12 * i + 8 + axis] = values[i];
    }
    const quats = [15, 16, 17, 18].map(plane), colors = new Uint8Array(4 * count);
    for (let i = 0; i < count; i++) {
      for (let b = 0; b < 4; b++) word.setUint8(b, quats[b][i]);
      const packed = word.getUint32(0), largest = packed >>> 30;
      let rest = 1, shift = 20;
      for (let k = 0; k < 4; k++) {
        if (k === largest) continue;
        const value = (((packed >>> shift) & 1023) / 511 - 1) * Math.SQRT1_2;
        geometry[12 * i + 4 + k] = value;
        rest -= value * value;
        shift -= 10;
      }
      geometry[12 * i + 4 + largest] = Math.sqrt(Math.max(rest, 0));
      geometry[12 * i + 3] = plane(19)[i] / 255;
      for (let channel = 0; channel < 3; channel++) colors[4 * i + channel] = plane(20 + channel)[i];
    }
    const terms = (HEADER.degree + 1) ** 2 - 1;
    const harmonics = terms ? new Int8Array(3 * terms * count) : null;
    for (let k = 0; k < 3 * terms; k++) {
      const values = plane(23 + k);
      for (let i = 0; i < count; i++) harmonics[3 * terms * i + k] = values[i];
    }
    return { means, geometry, colors, harmonics };
  }

  // ---- drawing ----

  // Draws to a WebGL 2 context: one layer for each view, and their mean by nearness (docs/rendering.md, section 7).
  class Renderer {
    constructor(gl, scene) {
      this.gl = gl;
      const float = gl.getExtension("EXT_color_buffer_float");
      const half = float || gl.getExtension("EXT_color_buffer_half_float");
      this.format = half ? gl.RGBA16F : gl.RGBA8;
      this.splat = this.link(SHADERS.splat);
      this.accumulate = this.link(SHADERS.accumulate);
      this.resolve = this.link(SHADERS.resolve);
      // WebGL 2 guarantees 2048 texels a side, and `geometry` has three a Gaussian.
      const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE) || 4096, width = Math.min(1024, Math.floor(largest / 3));
      const height = Math.ceil(HEADER.count / width);
      if (height > largest) throw new Error("The scene is too large for this device.");
      this.rows = [width, height];
      this.geometry = this.upload(scene.geometry, 3 * width, height, gl.RGBA32F, gl.FLOAT, 12 * width * height);
      this.colors = this.upload(scene.colors, width, height, gl.RGBA8, gl.UNSIGNED_BYTE, 4 * width * height);
      this.order = this.makeTexture(width, height, gl.R32UI);
      this.splats = gl.createVertexArray();
      this.screen = gl.createVertexArray();
      gl.bindVertexArray(this.splats);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      const corners = Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
      this.targets = [];
      this.size = [0, 0];
    }

    link([vertex, fragment]) {
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
      return { program, places };
    }

    makeTexture(width, height, format) {
      const gl = this.gl, texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      return texture;
    }

    upload(values, width, height, format, type, length) {
      const texture = this.makeTexture(width, height, format);
      this.write(texture, values, width, height, this.gl.RGBA, type, length);
      return texture;
    }

    write(texture, values, width, height, channels, type, length) {
      const gl = this.gl, padded = new values.constructor(length);
      padded.set(values);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, channels, type, padded);
    }

    // Replaces the drawing order, and the colours if they depend on the position.
    setSorted({ order, colors }) {
      const gl = this.gl, texels = this.rows[0] * this.rows[1];
      this.write(this.order, order, ...this.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, texels);
      if (colors) this.write(this.colors, colors, ...this.rows, gl.RGBA, gl.UNSIGNED_BYTE, 4 * texels);
    }

    // The layer of one view, and the weighted sum of layers with the sum of weights; larger than the image if an earlier
    // one was larger.
    resize(...size) {
      if (size.every((side, i) => side <= this.size[i])) return;
      const gl = this.gl, [width, height] = this.size = size.map((side, i) => Math.max(side, this.size[i]));
      for (const { framebuffer, textures } of this.targets) {
        gl.deleteFramebuffer(framebuffer);
        textures.forEach((texture) => gl.deleteTexture(texture));
      }
      this.targets = [1, 2].map((count) => {
        const framebuffer = gl.createFramebuffer(), textures = [];
        gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
        const attachments = [...Array(count)].map((_, i) => gl.COLOR_ATTACHMENT0 + i);
        for (const attachment of attachments) {
          textures.push(this.makeTexture(width, height, this.format));
          gl.framebufferTexture2D(gl.FRAMEBUFFER, attachment, gl.TEXTURE_2D, textures.at(-1), 0);
        }
        gl.drawBuffers(attachments);
        return { framebuffer, textures };
      });
    }

    // Draws to a viewport (left, bottom, width, height) of a framebuffer, null for the canvas. `camera` has a `position`,
    // a `rotation` (camera to world), and the `center` and `half` the size of the image on the image plane.
    draw(camera, weights, framebuffer, [left, bottom, width, height]) {
      const gl = this.gl;
      this.resize(width, height);
      const [layer, sum] = this.targets;
      gl.viewport(0, 0, width, height);
      gl.disable(gl.DEPTH_TEST);
      gl.activeTexture(gl.TEXTURE0);
      this.setCamera(camera, width, height);
      let first = true;
      HEADER.views.forEach(({ start, count }, view) => {
        if (!weights[view]) return;
        gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
        gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
        if (count) this.drawLayer(start, count);
        gl.bindFramebuffer(gl.FRAMEBUFFER, sum.framebuffer);
        this.addLayer(layer.textures[0], weights[view], first);
        first = false;
      });
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.viewport(left, bottom, width, height);
      gl.disable(gl.BLEND);
      const { program, places } = this.resolve;
      gl.useProgram(program);
      gl.uniform2i(places.origin, left, bottom);
      gl.uniform3f(places.background, 0, 0, 0);
      gl.uniform1i(places.sum_color, 0);
      gl.uniform1i(places.sum_depth, 1);
      sum.textures.forEach((texture, unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, texture);
      });
      gl.bindVertexArray(this.screen);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    setCamera({ position, rotation, center, half }, width, height) {
      const gl = this.gl, { program, places } = this.splat;
      const [[x, y], [w, h]] = [center, half], focal = [0.5 * width / w, 0.5 * height / h];
      gl.useProgram(program);
      // GLSL reads columns: the rows of camera-to-world are the columns of its inverse.
      gl.uniformMatrix3fv(places.world_to_camera, false, rotation.flat());
      gl.uniform3fv(places.position, position);
      gl.uniform1f(places.near, HEADER.near);
      gl.uniform1i(places.exact, 1);
      gl.uniform1f(places.filter_variance, HEADER.filterVariance / (focal[0] * focal[1]));
      gl.uniform2f(places.half_size, Math.abs(x) + w, Math.abs(y) + h);
      gl.uniform4f(places.window, x, y, w, h);
      gl.uniform1f(places.margin, 0.02 / Math.min(...focal));
      gl.uniform2f(places.principal, 0.5 * width - x * focal[0], 0.5 * height + y * focal[1]);
      gl.uniform2fv(places.focal, focal);
      gl.uniform2fv(places.color_range, HEADER.colorRange);
      const sides = [[-1, 0, w + x], [1, 0, w - x], [0, -1, h + y], [0, 1, h - y]].map((side) => scaled(side, 1 / Math.hypot(...side)));
      gl.uniform3fv(places.sides, sides.flat());
      gl.uniform1i(places.geometry, 0);
      gl.uniform1i(places.colors, 1);
      gl.uniform1i(places.order, 2);
    }

    drawLayer(start, count) {
      const gl = this.gl;
      gl.useProgram(this.splat.program);
      [this.geometry, this.colors, this.order].forEach((texture, unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, texture);
      });
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.bindVertexArray(this.splats);
      gl.uniform2i(this.splat.places.segment, start, count);
      gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(count / BATCH));
    }

    addLayer(texture, weight, first) {
      const gl = this.gl, { program, places } = this.accumulate;
      gl.useProgram(program);
      gl.uniform1f(places.weight, weight);
      gl.uniform1i(places.layer_color, 0);
      gl.uniform1i(places.layer_depth, 0);
      gl.uniform1i(places.with_depth, 0);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      if (first) gl.disable(gl.BLEND);
      else gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE);
      gl.blendEquationSeparate(gl.FUNC_ADD, gl.MAX);
      gl.bindVertexArray(this.screen);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.blendEquation(gl.FUNC_ADD);
    }
  }

  // Weights of the views of a group at a position: normalised inverse distances (docs/rendering.md, section 7). Other
  // views have weight 0.
  function groupWeights(group, position) {
    const views = HEADER.groups[group], weights = HEADER.views.map(() => 0);
    const distances = views.map((view) => distanceOf(position, HEADER.views[view].position));
    const nearest = Math.min(...distances);
    const closeness = distances.map((distance) => distance > 0 ? nearest / distance : 1);
    const sum = closeness.reduce((a, b) => a + b);
    views.forEach((view, i) => { weights[view] = Math.max(closeness[i] / sum, MIN_WEIGHT); });
    return weights;
  }

  // The views of the edge at the camera, and for a second after a change also those of the edge before.
  function blendWeights(position) {
    const weights = groupWeights(group, position);
    if (!fade) return weights;
    const old = groupWeights(fade.group, position);
    return weights.map((weight, view) => fade.done * weight + (1 - fade.done) * old[view]);
  }

  // ---- the edge at the camera ----

  const { edges, parts, next, hysteresis, reach } = HEADER;
  const GRAPH = { positions: HEADER.spots.map((spot) => spot.position), edges, parts, next, hysteresis, reach };
  let edge = 0, group = edges.length ? edges[0][2] : 0, fade = null;

  // Chooses the edge at the camera; its views fade in.
  function updateEdge(now) {
    if (fade) {
      const t = clamp((now - fade.began) / FADE_MS, 0, 1);
      fade.done = t * t * (3 - 2 * t);
      if (t === 1) fade = null;
      changed();
      return;
    }
    const chosen = followEdge(GRAPH, camera.position, edge);
    if (chosen === edge) return;
    const old = group, part = currentPart();
    settle(chosen);
    if (group !== old && part === currentPart()) fade = { group: old, began: now, done: 0 };
    changed();
  }

  // Shows the views of an edge at once.
  function settle(number) {
    edge = number;
    group = edges[number][2];
    fade = null;
  }

  function settleAt(position) {
    if (edges.length) settle(nearestEdge(GRAPH, position));
  }

  const currentPart = () => edges.length ? partOfEdge(GRAPH, edge) : 0;
  const endsOfEdge = () => edges.length ? edges[edge].slice(0, 2) : [];

  // ---- fades between parts ----

  // The image of the last camera in the old part covers the new one until that is sorted, then it fades out.
  const still = byId("still");
  let frozen = null;

  function freeze() {
    if (!renderer || !sorted) return;
    if (headset.session) {  // it fades from black
      frozen = { began: null, left: 1 };
      return;
    }
    drawAt(canvas.width, canvas.height);  // what a canvas shows can be copied in the task that drew it
    const size = fullSize(), context = still.getContext("2d");
    const isSame = still.width === size[0] && still.height === size[1];
    context.globalAlpha = frozen && isSame ? 1 - frozen.left : 1;
    if (!isSame) [still.width, still.height] = size;
    context.drawImage(canvas, 0, 0, ...size);
    frozen = { began: null, left: 1 };
    showStill();
    changed();
  }

  function updateStill(now) {
    if (!frozen) return;
    if (frozen.began === null && sorted.part === currentPart()) frozen.began = now;
    if (frozen.began !== null) {
      const t = clamp((now - frozen.began) / FADE_MS, 0, 1);
      frozen.left = 1 - t * t * (3 - 2 * t);
      if (t === 1) frozen = null;
    }
    showStill();
    changed();
  }

  function showStill() {
    const left = frozen ? frozen.left : 0;
    still.hidden = !frozen || headset.session !== null;
    still.style.opacity = left;
    byId("spots").style.opacity = 1 - left;
  }

  const isWaiting = () => frozen !== null && frozen.began === null;

  // The heading after a fade: away from the link back, or the start view, or that of before.
  function arriveAt(node, from) {
    const back = findLink(node, from), { start } = HEADER.spots[node];
    if (back && back.leave) return { yaw: back.yaw + Math.PI, pitch: 0 };
    return start ? { yaw: start[0], pitch: start[1] } : { yaw: camera.yaw, pitch: 0 };
  }

  const findLink = (from, to) => HEADER.links.find((link) => link.from === from && link.to === to);

  function jump(position, { yaw, pitch }) {
    freeze();
    place({ position: [...position], yaw, pitch });
  }

  function place(pose) {
    Object.assign(camera, pose);
    headset.turnTo(camera.yaw);
    settleAt(camera.position);
    changed();
  }

  // ---- camera ----

  const makeStart = () => ({ ...HEADER.start, position: [...HEADER.start.position], roll: 0 });
  const camera = makeStart();

  // Camera to world; positive yaw turns right, positive pitch up (viewer/scene/camera.py). The device's motion adds a roll.
  function rotationOf({ yaw, pitch, roll }) {
    const [cy, sy, cp, sp, cr, sr] = [yaw, pitch, roll].flatMap((angle) => [Math.cos(angle), Math.sin(angle)]);
    const turned = multiply([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]);
    return multiply(HEADER.level, multiply(turned, [[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]));
  }

  // Half the height of the image at distance 1. The field of view is that of a landscape image; a portrait one is taller.
  const tangentOf = (width, height) => {
    const tall = clamp(Math.sqrt(height / width), 1, 1.5);
    return tall * Math.tan(0.5 * camera.fov * Math.PI / 180);
  };

  function turn(yaw, pitch) {
    camera.yaw += yaw;
    camera.pitch = clamp(camera.pitch + pitch, -MAX_PITCH, MAX_PITCH);
    changed();
  }

  // Moves along the camera's heading: right, up and forward in metres. The camera stays near the edges of its part, or
  // near the panoramas of a scene without edges; steps away from them become shorter near the limit.
  function walk(right, up, forward) {
    const [cy, sy] = [Math.cos(camera.yaw), Math.sin(camera.yaw)];
    const local = [cy * right + sy * forward, -up, -sy * right + cy * forward];
    const target = plus(camera.position, HEADER.level.map((row) => dot(row, local)));
    const from = edges.length ? closestOnEdge(GRAPH, nearestEdge(GRAPH, target, currentPart()), target) : nearestSpot(target);
    const limit = HEADER.limits[currentPart()], before = distanceOf(camera.position, from), after = distanceOf(target, from);
    const outward = Math.max(after - before, 0), slower = clamp((1 - before / limit) / SOFT, 0, 1);
    const allowed = Math.min(after - (1 - slower) * outward, limit);
    camera.position = after > allowed ? plus(from, scaled(minus(target, from), allowed / after)) : target;
    changed();
  }

  function nearestSpot(position) {
    return GRAPH.positions[nearestNode(position)];
  }

  // The nearest panorama, in a tour of the camera's part.
  function nearestNode(position) {
    const distances = GRAPH.positions.map((place, node) => parts[node] === currentPart() ? distanceOf(place, position) : Infinity);
    return distances.indexOf(Math.min(...distances));
  }

  // A smooth flight to a panorama along the edges; the direction of view stays the user's. To another part, the camera
  // turns to the link, goes a step along it, and the image fades; without a link it fades at once.
  let flight = null, touring = false;
  function flyTo(spot) {
    const way = edges.length ? findWay(GRAPH, camera.position, spot, partOfEdge(GRAPH, followEdge(GRAPH, camera.position, edge))) : [spot];
    const legs = [];
    let path = [[...camera.position]];
    way.forEach((node, i) => {
      if (i > 0 && isFade(GRAPH, way[i - 1], node)) {
        const link = findLink(way[i - 1], node);
        legs.push({ path });
        if (link && link.leave) legs.push({ path: path.slice(-1), yaw: link.yaw }, { path: [path.at(-1), link.leave] });
        legs.push({ path: [], from: way[i - 1], to: node });
        path = [];
      } else if (i + 1 < way.length && i === 0 && isFade(GRAPH, node, way[1])) return;  // it fades where the camera is
      path.push(GRAPH.positions[node]);
    });
    legs.push({ path });
    flight = { spot, legs, began: null };
    changed();
  }

  const ease = (t) => t * t * t * (t * (6 * t - 15) + 10);

  function advanceFlight(now) {
    if (!flight || isWaiting()) return;
    const leg = flight.legs[0];
    if (leg.to !== undefined) {
      jump(GRAPH.positions[leg.to], arriveAt(leg.to, leg.from));
      flight.legs.shift();
      return;
    }
    if (flight.began === null) beginLeg(leg, now);
    const t = leg.seconds ? clamp((now - flight.began) / (1000 * leg.seconds), 0, 1) : 1;
    if (leg.length) camera.position = t < 1 ? pointAlong(leg.path, ease(t) * leg.length) : [...leg.path.at(-1)];
    turn(leg.turn[0] * (ease(t) - leg.done), leg.turn[1] * (ease(t) - leg.done));  // a drag adds to it
    leg.done = ease(t);
    changed();
    if (t < 1) return;
    flight.began = null;
    flight.legs.shift();
    if (flight.legs.length) return;
    const { spot } = flight;
    flight = null;
    if (touring) flyTo((spot + 1) % HEADER.spots.length);
  }

  function beginLeg(leg, now) {
    flight.began = now;
    leg.length = lengthOf(leg.path);
    leg.done = 0;
    leg.turn = leg.yaw === undefined ? [0, 0] : [Math.atan2(Math.sin(leg.yaw - camera.yaw), Math.cos(leg.yaw - camera.yaw)), -camera.pitch];
    const turning = headset.session ? 0 : Math.hypot(...leg.turn) / TURN_SPEED;  // the head turns itself
    leg.seconds = leg.length ? clamp(1.2 * leg.length / HEADER.speed, 0.6, 3 * (leg.path.length - 1)) : turning;
  }

  function pointAlong(path, distance) {
    for (let i = 1; i < path.length; i++) {
      const step = minus(path[i], path[i - 1]), length = Math.hypot(...step);
      if (distance < length) return plus(path[i - 1], scaled(step, distance / length));
      distance -= length;
    }
    return [...path.at(-1)];
  }

  // The flight through all panoramas of a tour. It begins at the point of the route that is nearest to the camera, and
  // the difference in pose disappears at first. The camera turns with the route; a drag adds to it until a fade.
  let route = null;
  function startRoute() {
    const distances = HEADER.route.map((sample) => distanceOf(sample.slice(0, 3), camera.position));
    const least = Math.min(...distances) + 0.02 * HEADER.speed;
    const first = distances.findIndex((distance) => distance <= least), sample = HEADER.route[first];
    const offset = minus([...camera.position, camera.yaw, camera.pitch], sample);
    offset[3] -= 2 * Math.PI * Math.round(offset[3] / (2 * Math.PI));
    const time = first / HEADER.routeRate, seconds = Math.max(1, Math.abs(offset[3]) / TURN_SPEED);
    route = { time, began: time, seconds, last: null, offset };
  }

  function advanceRoute(seconds) {
    if (!route || isWaiting()) return;
    const end = HEADER.route.length - 1, before = Math.floor(route.time * HEADER.routeRate);
    route.time += seconds;
    const at = Math.min(route.time * HEADER.routeRate, end), index = Math.min(Math.floor(at), end - 1);
    if (HEADER.jumps.some((jumped) => before <= jumped && jumped < index)) {
      const [x, y, z, yaw, pitch] = HEADER.route[index];
      jump([x, y, z], { yaw, pitch });
      Object.assign(route, { time: index / HEADER.routeRate, offset: [0, 0, 0, 0, 0], last: { yaw, pitch } });
      return;
    }
    const part = HEADER.jumps.includes(index) ? 0 : at - index;
    const sample = plus(HEADER.route[index], scaled(minus(HEADER.route[index + 1], HEADER.route[index]), part));
    const left = 1 - ease(clamp((route.time - route.began) / route.seconds, 0, 1));
    const [x, y, z, yaw, pitch] = plus(sample, scaled(route.offset, left));
    camera.position = [x, y, z];
    turn(yaw - (route.last ? route.last.yaw : yaw), pitch - (route.last ? route.last.pitch : pitch));
    route.last = { yaw, pitch };
    if (at === end) setTouring(false);
  }

  function setTouring(value) {
    touring = value && HEADER.spots.length > 1;
    byId("play").setAttribute("aria-pressed", touring);
    byId("play").querySelector("path").setAttribute("d", touring ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
    if (!touring) flight = route = null;
    else if (HEADER.route.length > 1) {
      flight = null;
      startRoute();
    } else if (!flight) {
      flyTo((nearestNode(camera.position) + 1) % GRAPH.positions.length);
    }
    changed();
  }

  function goHome() {
    setTouring(false);
    flight = null;
    const isFar = edges.length && partOfEdge(GRAPH, nearestEdge(GRAPH, HEADER.start.position)) !== currentPart();
    if (isFar || headset.session) freeze();
    place(makeStart());
  }

  // ---- input ----

  const held = new Set(), fingers = new Map();
  const MOVES = {
    KeyW: [0, 0, 1], ArrowUp: [0, 0, 1], KeyS: [0, 0, -1], ArrowDown: [0, 0, -1], KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0],
    KeyD: [1, 0, 0], ArrowRight: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0],
  };
  const PRESSES = {
    Space: () => setTouring(!touring),
    KeyF: () => toggleFull(),
    KeyR: () => goHome(),
    KeyH: () => byId("keys").showModal(),
    KeyL: () => openList(),
  };

  function onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const onButton = event.target.tagName === "BUTTON" && (event.code === "Space" || event.code === "Enter");
    if (onButton) return;
    const digit = /^(Digit|Numpad)([1-9])$/.exec(event.code);
    if (MOVES[event.code]) held.add(event.code);
    else if (PRESSES[event.code] && !event.repeat) PRESSES[event.code]();
    else if (digit && HEADER.spots[digit[2] - 1]) {
      setTouring(false);
      flyTo(digit[2] - 1);
    }
    else return;
    event.preventDefault();
    if (MOVES[event.code]) setTouring(false);
  }

  function walkByKeys(seconds, fast) {
    const step = [0, 0, 0];
    for (const code of held) MOVES[code].forEach((value, i) => { step[i] += value; });
    if (step.some((value) => value)) walk(...scaled(step, seconds * HEADER.speed * (fast ? 3 : 1)));
  }

  // One finger or the mouse turns: the scene follows the pointer. Two fingers pull the scene: sideways, and forward by
  // moving down or apart.
  function onMove(event) {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const moved = [event.clientX - last[0], event.clientY - last[1]];
    const before = [...fingers.values()];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (before.length === 1) {
      const { clientWidth, clientHeight } = canvas;
      const radians = 2 * tangentOf(clientWidth, clientHeight) / clientHeight;
      turn(-moved[0] * radians, moved[1] * radians);
    } else if (before.length === 2) {
      const apart = ([a, b]) => distanceOf(a, b);
      const metres = 2 * HEADER.speed / Math.min(canvas.clientWidth, canvas.clientHeight);
      const pinch = apart([...fingers.values()]) - apart(before);
      setTouring(false);
      walk(-0.5 * moved[0] * metres, 0, (0.5 * moved[1] + pinch) * metres);
    }
  }

  // Look around by the device's motion: its axes in the earth's (east, north, up), turned by the screen's angle.
  let motion = null;
  function onOrientation({ alpha, beta, gamma }) {
    if (alpha === null || beta === null || gamma === null) return;
    const [ca, sa, cb, sb, cg, sg] = [alpha, beta, gamma].map((degrees) => degrees * Math.PI / 180)
      .flatMap((angle) => [Math.cos(angle), Math.sin(angle)]);
    const toEarth = multiply([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]],
      multiply([[1, 0, 0], [0, cb, -sb], [0, sb, cb]], [[cg, 0, sg], [0, 1, 0], [-sg, 0, cg]]));
    const angle = (screen.orientation ? screen.orientation.angle : 0) * Math.PI / 180;
    const inLevel = (axis) => {  // x east, y down, z north
      const [east, north, up] = toEarth.map((row) => dot(row, axis));
      return [east, -up, north];
    };
    const right = inLevel([Math.cos(angle), -Math.sin(angle), 0]), forward = inLevel([0, 0, -1]);
    const yaw = Math.atan2(forward[0], forward[2]), pitch = Math.asin(clamp(-forward[1], -1, 1));
    const across = [Math.cos(yaw), 0, -Math.sin(yaw)];
    const down = [Math.sin(yaw) * Math.sin(pitch), Math.cos(pitch), Math.cos(yaw) * Math.sin(pitch)];
    if (motion.last === null) motion.last = yaw;
    camera.yaw += yaw - motion.last;  // so that a drag can turn the camera, too
    motion.last = yaw;
    camera.pitch = clamp(pitch, -MAX_PITCH, MAX_PITCH);
    camera.roll = Math.atan2(dot(right, down), dot(right, across));
    changed();
  }

  async function toggleMotion() {
    if (motion) {
      removeEventListener("deviceorientation", onOrientation);
      motion = null;
      camera.roll = 0;
    } else {
      const ask = DeviceOrientationEvent.requestPermission;  // iOS only
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

  function listen() {
    addEventListener("keydown", onKey);
    addEventListener("keydown", (event) => { fast = event.shiftKey; });
    addEventListener("keyup", (event) => { fast = event.shiftKey; held.delete(event.code); });
    addEventListener("blur", () => held.clear());
    addEventListener("resize", changed);
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", onMove);
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode ? 33 : 1);  // or lines
      camera.fov = clamp(camera.fov * Math.exp(0.001 * clamp(pixels, -200, 200)), MIN_FOV, MAX_FOV);
      changed();
    }, { passive: false });
    byId("play").onclick = () => setTouring(!touring);
    byId("home").onclick = goHome;
    byId("place").onclick = openList;
    byId("list").onclick = (event) => { if (event.target === byId("list")) byId("list").close(); };  // beside it
    byId("full").onclick = toggleFull;
    byId("help").onclick = () => byId("keys").showModal();
    byId("motion").onclick = toggleMotion;
    byId("motion").hidden = !("DeviceOrientationEvent" in window && matchMedia("(pointer: coarse)").matches);
    byId("full").hidden = !document.documentElement.requestFullscreen;
    byId("play").hidden = byId("place").hidden = HEADER.spots.length < 2;
    byId("buttons").hidden = false;
  }

  // ---- hotspots ----

  function goTo(node) {
    setTouring(false);
    flyTo(node);
    canvas.focus({ preventScroll: true });
  }

  // Goes to a panorama without a flight.
  function jumpTo(node) {
    setTouring(false);
    const isSame = parts[node] === currentPart(), from = edges.length ? nearestNode(camera.position) : node;
    jump(GRAPH.positions[node], isSame ? camera : arriveAt(node, from));
  }

  // An element with children that are elements or text; text is never HTML.
  function make(tag, className, ...children) {
    const element = document.createElement(tag);
    element.className = className;
    element.append(...children);
    return element;
  }

  // A ring for each panorama, and one where each link to another part meets the floor.
  function makeRings() {
    const links = HEADER.links.filter((link) => link.mark);
    const marks = [...HEADER.spots.map((_, node) => ({ node, link: null })), ...links.map((link) => ({ node: link.to, link }))];
    return marks.map(({ node, link }) => {
      const { name, position, mark } = HEADER.spots[node], text = make("small", "");
      const label = make("span", "", make("b", "", name), text), button = make("button", link ? "fade" : "", label);
      const place = link ? { mark: link.mark, camera: null, radius: HEADER.spots[link.from].radius } : { mark, camera: position, radius: HEADER.spots[node].radius };
      button.hidden = true;
      button.onclick = () => goTo(node);
      byId("spots").append(button);
      return { node, link, button, label, text, ...place, isNext: false, size: null };
    });
  }

  // The rings of panoramas next to the edge, and of links from its ends. A link's text is a part of the label.
  function chooseRings() {
    if (ringsOf === edge) return;
    ringsOf = edge;
    const ends = endsOfEdge();
    for (const ring of rings) {
      const { name } = HEADER.spots[ring.node];
      const link = ring.link || HEADER.links.find(({ from, to }) => to === ring.node && ends.includes(from));
      const isHere = parts[ring.node] === currentPart() && (link || !edges.length || isReachable(GRAPH, edge, ring.node));
      ring.isNext = ring.link ? ends.includes(link.from) : isHere;
      ring.text.textContent = link && link.text !== name ? link.text : "";
      ring.button.title = ["Go to", name, ring.text.textContent].join(" ").trim();
      ring.button.ariaLabel = ring.button.title;
      ring.size = null;
    }
  }

  // Those of chooseRings without that at the camera.
  function findRings() {
    chooseRings();
    const isAtCamera = (ring) => ring.camera !== null && distanceOf(ring.camera, camera.position) < 2 * ring.radius;
    return rings.filter((ring) => ring.isNext && !isAtCamera(ring));
  }

  // Rings in perspective. A label that would cover the label of a nearer ring is not shown.
  function placeRings(rotation) {
    const found = findRings();
    const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
    const taken = [], placed = [];
    for (const ring of rings) {
      const { radius } = ring, offset = minus(ring.mark, camera.position);
      const [x, y, z] = [0, 1, 2].map((k) => dot(column(rotation, k), offset));
      ring.button.hidden = !found.includes(ring) || z < 0.1 * radius;
      if (!ring.button.hidden) placed.push({ ring, x, y, z, distance: Math.hypot(x, y, z) });
    }
    for (const { ring, x, y, z, distance } of placed.sort((a, b) => a.distance - b.distance)) {
      const { style } = ring.button, size = clamp(2 * ring.radius * focal / z, 16, 128), tall = size * clamp(y / distance, 0.25, 1);
      const [left, top] = [0.5 * width + focal * x / z, 0.5 * height + focal * y / z];
      style.width = `${size}px`;
      style.height = `${tall}px`;
      style.borderWidth = `${clamp(0.09 * size, 2, 6)}px`;
      style.transform = `translate(${left - 0.5 * size}px, ${top - 0.5 * tall}px)`;
      if (!ring.size) ring.size = [ring.label.offsetWidth, ring.label.offsetHeight];
      const box = [left - 0.5 * ring.size[0], top + 0.5 * tall, left + 0.5 * ring.size[0], top + 0.5 * tall + ring.size[1]];
      const isFree = taken.every((other) => box[0] > other[2] || box[2] < other[0] || box[1] > other[3] || box[3] < other[1]);
      ring.label.style.visibility = isFree ? "" : "hidden";
      if (isFree) taken.push(box);
    }
  }

  // ---- list of panoramas ----

  const isSingle = (node) => parts.filter((part) => part === parts[node]).length === 1;

  // The panoramas with a common world by part, then those without others.
  function makeList() {
    const nodes = [...HEADER.spots.keys()], placed = [...new Set(nodes.filter((node) => !isSingle(node)).map((node) => parts[node]))];
    const sections = placed.map((part, i) => {
      const title = placed.length > 1 ? `Placed panoramas, part ${i + 1}` : "Placed panoramas";
      return [title, nodes.filter((node) => parts[node] === part)];
    });
    sections.push(["Single photographs, not placed", nodes.filter(isSingle)]);
    for (const [title, members] of sections.filter((section) => section[1].length)) {
      byId("panoramas").append(make("h2", "", title));
      for (const node of members) {
        const button = make("button", "", `${node + 1}. ${HEADER.spots[node].name}`);
        button.onclick = () => {
          byId("list").close();
          goTo(node);
        };
        listed[node] = button;
        byId("panoramas").append(button);
      }
    }
  }

  function openList() {
    if (HEADER.spots.length < 2) return;
    byId("list").showModal();
    listed[here].focus();
  }

  // Names the panorama at the camera.
  function showPlace() {
    const node = nearestNode(camera.position);
    if (node === here) return;
    if (listed[here]) listed[here].removeAttribute("aria-current");
    here = node;
    listed[here].setAttribute("aria-current", "location");
    byId("name").textContent = HEADER.spots[here].name;
    byId("kind").textContent = isSingle(here) ? "single photograph" : "";
  }

  // ---- frames ----

  // A frame is drawn only if something changed. While it moves, the scale of the resolution follows the time between
  // frames; at rest the image has the full resolution.
  let renderer = null, rings = [], ringsOf = null, listed = [], here = null, fast = false, dirty = true, scale = 1, lastChange = 0, lastFrame = 0, drawnScale = 0;
  let sorter = null, sorting = false, sorted = null;
  const changed = () => { dirty = true; lastChange = performance.now(); };

  const isSortedFor = (position, part, tolerance = 0) => {
    return sorted !== null && sorted.part === part && distanceOf(sorted.position, position) <= tolerance;
  };

  // `tolerance`: distance in metres for which the order of before is kept.
  function requestSort(tolerance) {
    if (sorting || isSortedFor(camera.position, currentPart(), tolerance)) return;
    sorting = true;
    sorter.postMessage({ position: [...camera.position], part: currentPart() });
  }

  function onSorted({ data }) {
    sorting = false;
    sorted = data;
    if (renderer) renderer.setSorted(data);
    dirty = true;
  }

  // Of the canvas at the full resolution.
  function fullSize() {
    const { clientWidth, clientHeight } = canvas, ratio = Math.min(devicePixelRatio || 1, 2);
    const full = Math.min(ratio, Math.sqrt(MAX_PIXELS / (clientWidth * clientHeight || 1)));
    return [clientWidth, clientHeight].map((side) => Math.max(Math.round(side * full), 1));
  }

  function drawAt(width, height) {
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const rotation = rotationOf(camera), tangent = tangentOf(width, height), half = [tangent * width / height, tangent];
    renderer.draw({ position: camera.position, rotation, center: [0, 0], half }, blendWeights(camera.position), null, [0, 0, width, height]);
    return rotation;
  }

  // Moves what moves by itself, `seconds` after the last time.
  function advance(now, seconds) {
    advanceFlight(now);
    advanceRoute(seconds);
    if (edges.length) updateEdge(now);
    updateStill(now);
  }

  function onFrame(now) {
    requestAnimationFrame(onFrame);
    if (headset.session) return;  // it has frames of its own
    const elapsed = now - lastFrame, seconds = Math.min(elapsed, 100) / 1000;
    lastFrame = now;
    walkByKeys(seconds, fast);
    advance(now, seconds);
    requestSort();
    const moving = now - lastChange < 200;
    if (moving && drawnScale && elapsed < 1000) scale = clamp(scale * (elapsed > 45 ? 0.85 : elapsed < 25 ? 1.05 : 1), 0.25, 1);
    const wanted = moving ? scale : 1;
    if (!renderer || !sorted || !(dirty || wanted > drawnScale)) return;
    dirty = false;
    drawnScale = wanted;
    placeRings(drawAt(...fullSize().map((side) => Math.max(Math.round(side * wanted), 1))));
    showPlace();
  }

  // ---- headset ----

  const findSpot = (position) => HEADER.spots[nearestNode(position)];

  // Of the floor below a position: along an edge, between those of its panoramas.
  function floorPoint(position) {
    if (!edges.length) return findSpot(position).mark;
    const [from, to] = endsOfEdge(), [start, end] = [from, to].map((node) => GRAPH.positions[node]);
    const part = distanceOf(closestOnEdge(GRAPH, edge, position), start) / Math.max(distanceOf(start, end), 1e-6);
    return plus(HEADER.spots[from].mark, scaled(minus(HEADER.spots[to].mark, HEADER.spots[from].mark), part));
  }

  // What the headset needs of the page.
  const headset = new Headset({
    camera, advance, walk, goTo, jumpTo, goHome, setTouring, requestSort, blendWeights, findRings, findSpot, floorPoint, changed,
    get renderer() { return sorted && renderer; },
    get black() { return frozen ? frozen.left : 0; },
    get isFlying() { return flight !== null || route !== null; },
  });

  let failure = null;
  function fail(error) {
    failure = error;
    byId("cover").hidden = false;
    byId("cover").className = "failed";
    byId("message").textContent = error.message || String(error);
    bar.hidden = true;
    console.error(error);
  }

  async function main() {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This page needs WebGL 2, which this browser or device does not have.");
    if (!window.DecompressionStream) throw new Error("This browser is too old for this page. Please update it.");
    headset.gl = gl;
    let scene = null;
    const makeRenderer = () => {
      if (!scene || gl.isContextLost()) return;
      renderer = new Renderer(gl, scene);
      if (sorted) renderer.setSorted(sorted);
      changed();
    };
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); renderer = null; headset.lose(); });
    canvas.addEventListener("webglcontextrestored", () => {
      try { makeRenderer(); } catch (error) { fail(error); }
    });
    scene = await load();
    sorter = new Worker(URL.createObjectURL(new Blob([SORTER])));
    const first = new Promise((resolve, reject) => {
      sorter.onmessage = (event) => { onSorted(event); resolve(); };
      sorter.onerror = (event) => {
        const error = new Error(`The sorting failed: ${event.message}`);
        if (sorted) fail(error);
        else reject(error);
      };
    });
    const { count, views, harmonicsScale, colorRange: range } = HEADER;
    const base = scene.harmonics ? scene.colors : null;
    const { means, harmonics } = scene, moved = [means, harmonics].filter(Boolean).map((array) => array.buffer);
    sorter.postMessage({ count, views, parts, means, harmonics, base, harmonicsScale, range }, moved);  // not copied
    settleAt(camera.position);
    requestSort();
    makeRenderer();
    await first;
    while (!renderer) {  // the context is lost
      if (failure) throw failure;
      await wait(50);
    }
    await report(1);
    listen();
    headset.offer();
    rings = makeRings();
    makeList();
    requestAnimationFrame(onFrame);
    byId("cover").className = "done";
    setTimeout(() => { byId("cover").hidden = !failure; }, 700);
  }

  // For scripts: `await pansplat.ready`; `pansplat.camera` is {position, yaw, pitch, roll, fov}; `await
  // pansplat.render(width, height)` draws the camera's view with an order for its position and returns a PNG's data URL.
  window.pansplat = {
    camera,
    ready: main(),
    async render(width, height) {
      await this.ready;
      const place = [...camera.position];
      settleAt(place);
      while (!renderer || !isSortedFor(place, currentPart())) {
        if (failure) throw failure;
        await wait(5);
      }
      settleAt(place);
      drawAt(width, height);
      const image = canvas.toDataURL("image/png");
      drawnScale = 0;
      changed();
      return image;
    },
  };
  window.pansplat.ready.catch(fail);
})();
