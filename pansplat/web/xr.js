// The page in a headset (WebXR): both eyes, controllers and hands. docs/web.md describes it.
//
// The reference space of a session has x right, y up and z backwards, and its origin on the floor if the device knows it. A
// heading turns it into the scene, and the point between the eyes is the page's camera. So the page's functions work as
// without a headset: they move the camera, and the movement of the head is added to it.

import { blendWeights, findSpot, floorPoint, walk } from "./camera.js";
import { byId, calm, explain } from "./dom.js";
import { goTo } from "./flight.js";
import { clamp, column, cross, distanceOf, dot, fromAxes, minus, multiply, plus, scaled, unit } from "./graph.js";
import { coverage, endWay, goHome, jumpTo } from "./jump.js";
import { requestSort } from "./loading.js";
import { advance, SORT_DISTANCE } from "./loop.js";
import { photographs } from "./photographs.js";
import { findRings } from "./rings.js";
import { camera, changed, state } from "./state.js";

const XR_FEATURES = ["local-floor", "hand-tracking"];
const XR_AXES = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]; // from the axes of WebXR to those of OpenCV, and back
const SNAP_TURN = Math.PI / 6; // radians
const DEAD_ZONE = 0.2; // deflection of a stick below which it is at rest, 0 to 1
const MIN_POINTING = 0.06; // radians between a ray and the centre of a ring that it selects
const RAY_LENGTH = 3; // metres
const FLOOR_SPEED = 5; // share of the way to the height of a new floor that the camera moves, per second
const HEIGHT_RATIO = 1.5; // largest ratio of the heights of the head and of the panorama's camera over their floors
const MIN_RATE = 72, LOWEST_RATE = 60; // frames a second: if the device has a choice, and of any device
const MIN_SCALE = 0.4, SCALE_STEP = 0.85, FRAMES = 30; // least scale of the resolution, factor of a step, and frames before one
const PLAIN = 0, RING = 1, VIGNETTE = 2, PICTURE = 3; // shapes of shaders/mark.frag
const BUTTONS = { 4: () => goHome(), 5: () => headset.leave() }; // A and X, B and Y

const rowsOf = (matrix) => [0, 1, 2].map((row) => [0, 1, 2].map((k) => matrix[4 * k + row]));
const pointOf = ({ x, y, z }) => [x, y, z];

class Headset {
  gl = null;
  session = null;
  works = false;
  isEntering = false;

  // Shows the button where there is a headset, and otherwise what to do.
  async offer() {
    const button = byId("vr"), system = navigator.xr;
    this.works = Boolean(system) && await system.isSessionSupported("immersive-vr").catch(() => false);
    button.hidden = !this.works && isSecureContext;
    button.onclick = () => this.toggle();
    byId("no-vr").hidden = this.works || (isSecureContext && location.protocol !== "file:");
  }

  toggle() {
    if (this.session) this.leave();
    else if (this.works) this.enter();
    else explain(byId("no-vr").textContent);
  }

  async enter() {
    if (this.isEntering) return;
    this.isEntering = true;
    let session = null;
    try {
      session = await navigator.xr.requestSession("immersive-vr", { optionalFeatures: XR_FEATURES });
      await this.gl.makeXRCompatible();
      this.hasFloor = true;
      this.space = await session.requestReferenceSpace("local-floor").catch(() => {
        this.hasFloor = false;
        return session.requestReferenceSpace("local");
      });
      this.start(session);
    } catch (error) {
      const isDenied = error.name === "NotAllowedError" || error.name === "SecurityError";
      const advice = "Allow it in the settings of this site, then try again.";
      explain(isDenied ? `The browser does not allow VR on this page. ${advice}` : `VR could not start: ${error.message}`);
      if (session) session.end().catch(() => {});
    }
    this.isEntering = false;
  }

  start(session) {
    if (state.doll.isOn) jumpTo(state.doll.node);
    this.heading = this.headYaw = 0;
    Object.assign(this, { head: null, origin: null, left: null, floor: null, hovered: null });
    this.last = performance.now();
    this.motion = 0; // strength of the vignette
    this.pressed = new Map();
    this.isTurned = false;
    Object.assign(this, { scale: 1, times: [], interval: null, steady: 0, patience: 1, isRaised: false });
    session.updateRenderState({ baseLayer: this.makeLayer(session) });
    const rate = (session.supportedFrameRates || []).find((each) => each >= MIN_RATE);
    if (rate && rate !== session.frameRate) session.updateTargetFrameRate(rate).catch(() => {});
    session.addEventListener("end", () => this.end());
    session.addEventListener("select", (event) => this.select(event, calm.matches));
    session.addEventListener("squeeze", (event) => this.select(event, true));
    this.space.addEventListener("reset", () => {
      this.head = null;
    });
    this.session = session;
    byId("vr").setAttribute("aria-pressed", true);
    session.requestAnimationFrame((now, frame) => this.onFrame(now, frame));
  }

  makeLayer(session) {
    const options = { antialias: false, depth: false, stencil: false, alpha: false, ignoreDepthValues: true };
    const layer = new XRWebGLLayer(session, this.gl, { ...options, framebufferScaleFactor: this.scale });
    if ("fixedFoveation" in layer) layer.fixedFoveation = 1;
    return layer;
  }

  leave() {
    if (this.session) this.session.end().catch(() => {});
  }

  // The graphics are lost, and with them the session's layer.
  lose() {
    if (!this.session) return;
    this.leave();
    explain("The graphics of the headset were lost. Please enter VR again.");
  }

  // The session has ended, whoever ended it. The page goes on from the camera of before.
  end() {
    this.session = null;
    byId("vr").setAttribute("aria-pressed", false);
    changed();
  }

  onFrame(now, frame) {
    const { session } = this;
    if (!session) return;
    session.requestAnimationFrame((...next) => this.onFrame(...next));
    const elapsed = now - this.last, seconds = clamp(elapsed, 0, 100) / 1000;
    this.last = now;
    const pose = frame.getViewerPose(this.space);
    if (!pose || !state.renderer || !state.sorted) return; // not tracked; the graphics are lost
    advance(now, seconds);
    this.followHead(pose.transform, seconds);
    const isWalking = this.readControllers(seconds);
    if (!this.session) return; // a button has ended it
    this.left = [...camera.position];
    requestSort(SORT_DISTANCE);
    this.adaptScale(1000 * seconds);
    this.motion += (Number(isWalking || state.way !== null) - this.motion) * Math.min(8 * seconds, 1);
    const marks = this.findMarks(frame), layer = session.renderState.baseLayer;
    for (const view of pose.views) {
      if (view.requestViewportScale) view.requestViewportScale(this.scale);
      const { x, y, width, height } = layer.getViewport(view);
      if (!width || !height) continue;
      const eye = this.makeEye(view);
      state.renderer.draw(eye, blendWeights(eye), layer.framebuffer, [x, y, width, height]);
      photographs.draw(eye, width, height, layer.framebuffer, [x, y]);
      this.drawMarks(eye, [...marks, ...this.findVeils(eye)]);
    }
  }

  // ---- spaces ----

  // Rotation from the reference space to the scene.
  get toScene() {
    const [c, s] = [Math.cos(this.heading), Math.sin(this.heading)];
    return multiply(HEADER.level, multiply([[c, 0, s], [0, 1, 0], [-s, 0, c]], XR_AXES));
  }

  rotate(vector) {
    return fromAxes(this.toScene, vector);
  }

  pointInScene(point) {
    return plus(camera.position, this.rotate(minus(point, this.head)));
  }

  // The page has turned the camera.
  turnTo(yaw) {
    if (this.session) this.heading = yaw - this.headYaw;
  }

  // Moves the camera as the head has moved. A flight and a jump place the camera anew: then the movement since they began is
  // added.
  followHead({ position, matrix }, seconds) {
    const head = pointOf(position);
    const [right, , back] = [0, 1, 2].map((k) => column(multiply(XR_AXES, rowsOf(matrix)), k));
    const forward = scaled(back, -1), isSteep = Math.abs(forward[1]) > 0.95;
    this.headYaw = isSteep ? Math.atan2(-right[2], right[0]) : Math.atan2(forward[0], forward[2]);
    if (!this.head) this.begin(head);
    const isPlaced = this.left !== null && distanceOf(camera.position, this.left) > 0;
    camera.position = plus(camera.position, this.rotate(minus(head, isPlaced ? this.origin : this.head)));
    if (!isPlaced) this.origin = head;
    this.head = head;
    if (this.hasFloor) this.standOnFloor(seconds);
    Object.assign(camera, { yaw: this.heading + this.headYaw, pitch: Math.asin(clamp(-forward[1], -1, 1)), roll: 0 });
  }

  // The first pose, or that after the device has moved its reference space: the camera of before looks straight ahead. Heights
  // over the two floors that differ too much are not of one scale: then the head begins at the camera.
  begin(head) {
    const spot = findSpot(camera.position), height = distanceOf(spot.position, spot.mark);
    this.turnTo(camera.yaw);
    this.head = this.origin = head;
    this.hasFloor = this.hasFloor && head[1] > height / HEIGHT_RATIO && head[1] < height * HEIGHT_RATIO;
    this.floor = null;
  }

  // The head is over the scene's floor as it is over the room's.
  standOnFloor(seconds) {
    const down = column(HEADER.level, 1), floor = dot(down, floorPoint(camera.position));
    const isNew = this.floor === null || coverage() === 1;
    this.floor = isNew ? floor : this.floor + (floor - this.floor) * Math.min(FLOOR_SPEED * seconds, 1);
    camera.position = plus(camera.position, scaled(down, this.floor - this.head[1] - dot(down, camera.position)));
  }

  // A camera of Renderer.draw.
  makeEye({ transform, projectionMatrix: p }) {
    return {
      position: this.pointInScene(pointOf(transform.position)),
      rotation: multiply(this.toScene, multiply(rowsOf(transform.matrix), XR_AXES)),
      center: [p[8] / p[0], -p[9] / p[5]],
      half: [1 / p[0], 1 / p[5]],
    };
  }

  // ---- input ----

  // Sticks: the left one walks, the right one turns in steps and walks straight on. Returns whether it walks.
  readControllers(seconds) {
    let [right, forward, turn] = [0, 0, 0];
    for (const source of this.session.inputSources) {
      const { gamepad, handedness } = source;
      if (gamepad?.mapping !== "xr-standard") continue;
      const [x = 0, y = 0] = gamepad.axes.slice(gamepad.axes.length >= 4 ? 2 : 0);
      if (handedness === "left") right += x;
      else if (Math.abs(x) > Math.abs(y)) turn = x;
      if (handedness === "left" || Math.abs(y) > Math.abs(x)) forward -= y;
      const before = this.pressed.get(source) || [], pressed = gamepad.buttons.map((button) => button.pressed);
      this.pressed.set(source, pressed);
      for (const [button, act] of Object.entries(BUTTONS)) {
        if (pressed[button] && before[button] === false) act();
      }
    }
    if (Math.abs(turn) > 0.6 && !this.isTurned) {
      this.heading += Math.sign(turn) * SNAP_TURN;
      camera.yaw += Math.sign(turn) * SNAP_TURN;
    }
    this.isTurned = Math.abs(turn) > (this.isTurned ? 0.3 : 0.6);
    if (Math.hypot(right, forward) < DEAD_ZONE) return false;
    if (state.way) endWay();
    walk(...scaled([right, 0, forward], seconds * HEADER.speed));
    return true;
  }

  rayOf(source, frame) {
    const pose = frame.getPose(source.targetRaySpace, this.space);
    if (!pose || !this.head) return null;
    const direction = this.rotate(column(rowsOf(pose.transform.matrix), 2).map((value) => -value));
    return { origin: this.pointInScene(pointOf(pose.transform.position)), direction };
  }

  // The ring that a ray points at.
  findRing(ray) {
    const found = findRings().map((ring) => {
      const offset = minus(ring.mark, ray.origin), distance = Math.hypot(...offset);
      const angle = Math.acos(clamp(dot(ray.direction, offset) / Math.max(distance, 1e-6), -1, 1));
      return { ring, distance, angle, limit: Math.max(1.2 * HEADER.ringRadius / Math.max(distance, 1e-6), MIN_POINTING) };
    });
    return found.filter(({ angle, limit }) => angle < limit).sort((a, b) => a.angle - b.angle)[0] || null;
  }

  select({ inputSource, frame }, isJump) {
    const ray = this.rayOf(inputSource, frame), found = ray && this.findRing(ray);
    if (!found) return;
    if (isJump) jumpTo(found.ring.node);
    else goTo(found.ring.node);
  }

  // ---- resolution ----

  // Lowers the resolution when frames are late, and raises it after some steady seconds. Each raise that made frames late doubles
  // the wait before the next.
  adaptScale(elapsed) {
    const { session, scale, times } = this;
    times.push(elapsed);
    const sum = times.reduce((a, b) => a + b), isKnown = session.frameRate || this.interval;
    if (isKnown ? times.length < FRAMES : sum < 1000) return;
    this.times = [];
    if (!isKnown) { // the device states no rate: the median of the first second, which may be late
      this.interval = Math.min(times.sort((a, b) => a - b)[times.length >> 1], 1000 / LOWEST_RATE);
      return;
    }
    const mean = sum / FRAMES, isLate = mean > 1.15 * (session.frameRate ? 1000 / session.frameRate : this.interval);
    this.steady = isLate ? 0 : this.steady + FRAMES * mean / 1000;
    if (isLate) {
      this.scale = Math.max(scale * SCALE_STEP, MIN_SCALE);
      if (this.isRaised) this.patience = Math.min(2 * this.patience, 64);
      this.isRaised = false;
    } else if (this.steady > this.patience) {
      this.scale = Math.min(scale / SCALE_STEP, 1);
      this.isRaised = true;
      this.steady = 0;
    }
    if (this.scale !== scale && !("requestViewportScale" in XRView.prototype)) {
      session.updateRenderState({ baseLayer: this.makeLayer(session) });
    }
  }

  // ---- marks ----

  // Rings, rays of controllers and hands, and the name of the ring that one of them points at.
  findMarks(frame) {
    const marks = [], pointed = new Map(), down = column(HEADER.level, 1);
    const [right, ahead] = [0, 2].map((k) => column(HEADER.level, k));
    for (const source of this.session.inputSources) {
      const ray = source.targetRayMode === "tracked-pointer" ? this.rayOf(source, frame) : null;
      if (!ray) continue;
      const found = this.findRing(ray), along = scaled(ray.direction, 0.5 * (found ? found.distance : RAY_LENGTH));
      const center = plus(ray.origin, along), across = unit(cross(along, minus(center, camera.position)));
      marks.push({ center, axes: [along, scaled(across, 0.003)], shape: PLAIN, color: [0.6, 0.6, 0.6, 0.6] });
      if (found) pointed.set(found.ring, found.distance);
    }
    for (const ring of findRings()) {
      const strength = pointed.has(ring) ? 1 : 0.6, across = unit(cross(down, minus(ring.mark, camera.position)));
      const axes = (ring.isUpright ? [across, down] : [right, ahead]).map((axis) => scaled(axis, HEADER.ringRadius));
      marks.push({ center: ring.mark, axes, shape: RING, color: Array(4).fill(strength) });
    }
    const [ring] = pointed.keys();
    if (ring) {
      const size = 0.05 * pointed.get(ring), across = unit(cross(down, minus(ring.mark, camera.position)));
      const axes = [scaled(across, 8 * size), scaled(down, size)];
      marks.push({ center: minus(ring.mark, scaled(down, 2 * HEADER.ringRadius)), axes, shape: PICTURE, color: [1, 1, 1, 1], ring });
    }
    return marks;
  }

  // What covers an eye: a vignette while the camera moves, and the black of a fade.
  findVeils({ position, rotation }) {
    const cover = (shape, color, radius) => {
      const [right, down, forward] = [0, 1, 2].map((k) => column(rotation, k));
      return { center: plus(position, forward), axes: [scaled(right, 4), scaled(down, 4)], shape, color, radius };
    };
    const veils = [];
    if (this.motion > 0.01) veils.push(cover(VIGNETTE, [0, 0, 0, 1], 0.125 + 0.3 * (1 - this.motion)));
    if (coverage()) veils.push(cover(PLAIN, [0, 0, 0, coverage()], 0));
    return veils;
  }

  // Over what has been drawn in the viewport.
  drawMarks(eye, marks) {
    const { gl } = this;
    if (this.renderer !== state.renderer) {
      this.renderer = state.renderer;
      this.program = state.renderer.link(SHADERS.mark, "picture");
      this.picture = gl.createTexture();
      this.hovered = null;
    }
    const { program, places } = this.program;
    gl.useProgram(program);
    gl.uniformMatrix3fv(places.world_to_camera, false, eye.rotation.flat());
    gl.uniform3fv(places.position, eye.position);
    gl.uniform4f(places.window, ...eye.center, ...eye.half);
    state.renderer.bind([this.picture]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(state.renderer.screen);
    for (const { center, axes, shape, color, radius = 0, ring } of marks) {
      if (ring && ring !== this.hovered) this.writeLabel(ring);
      gl.uniform3fv(places.center, center);
      gl.uniform3fv(places.axis_1, axes[0]);
      gl.uniform3fv(places.axis_2, axes[1]);
      gl.uniform1i(places.shape, shape);
      gl.uniform4fv(places.color, color);
      gl.uniform1f(places.radius, radius);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }

  // Draws the name of a ring to the texture of labels.
  writeLabel(ring) {
    const { gl } = this, canvas = Object.assign(document.createElement("canvas"), { width: 1024, height: 128 });
    const context = canvas.getContext("2d");
    Object.assign(context, { font: "64px system-ui, sans-serif", textAlign: "center", textBaseline: "middle", lineWidth: 12 });
    const text = [HEADER.spots[ring.node].name, ring.text.textContent].filter(Boolean).join(" · ");
    context.strokeText(text, 512, 64, 1000);
    context.fillStyle = "#fff";
    context.fillText(text, 512, 64, 1000);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, canvas);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.generateMipmap(gl.TEXTURE_2D);
    this.hovered = ring;
  }
}

export const headset = new Headset();
state.headset = headset;
