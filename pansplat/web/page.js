"use strict";
// The page: shows the scene while its data arrives, and moves the camera. docs/web.md describes the data.
// Convention: OpenCV axes (x right, y down, z forward), as everywhere in pansplat. Positions are in the scene's world,
// moved by its origin. Matrices are arrays of rows.

(() => {
  const byId = (id) => document.getElementById(id);
  const canvas = byId("view"), bar = byId("bar");
  const MAX_PITCH = 89.9 * Math.PI / 180;
  const MIN_FOV = 20, MAX_FOV = 110;  // degrees, vertical
  const MIN_WEIGHT = 1e-4;            // of a view: with it, the other views fill the holes of a view at its own camera
  const FADE_MS = 1000;               // from the views of one edge to those of the next, and from part to part
  const SOFT = 0.3;                   // of the way to the limit of the camera, in which steps become shorter
  const TURN_SPEED = Math.PI / 2;     // radians a second, towards a link
  const MAX_PIXELS = 3e6;             // of the canvas: limits the memory of its render targets
  const REST_SECONDS = 4;             // at a panorama, on a tour without flights
  const BROWSERS = "Chrome or Edge 92, Firefox 113, Safari 16.4 or later";  // that have all that the page uses
  const lack = (what) => new Error(`This page needs ${what}, which is in ${BROWSERS}, unless the device lacks it.`);
  const calm = matchMedia("(prefers-reduced-motion: reduce)");

  // The poster has the scale and the place of the picture that follows.
  function placePoster() {
    const { style } = byId("cover").querySelector("img"), tall = tallOf(innerWidth, innerHeight);
    style.height = `${100 * HEADER.tallest / tall}%`;
  }

  // ---- weights ----

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

  // The views of the edge at the camera, and for a second after a change also those of the edge before. A view fades in
  // when it has arrived.
  function blendWeights(position) {
    if (doll.isOn) return null;
    const weights = groupWeights(group, position), old = fade ? groupWeights(fade.group, position) : weights;
    const done = fade ? fade.done : 1;
    return weights.map((weight, view) => shown[view] * (done * weight + (1 - done) * old[view]));
  }

  // How far each view has faded in. The first ones are there at once.
  const shown = HEADER.views.map(() => 0);
  function showViews(step) {
    if (!sorted || !sorted.views.some((view) => shown[view] < 1)) return;
    const isFirst = !sorted.views.some((view) => shown[view] && HEADER.views[view].count);
    sorted.views.forEach((view) => { shown[view] = isFirst ? 1 : Math.min(shown[view] + step, 1); });
    changed();
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

  // The image of the last camera before a jump covers the new one until that is sorted, then it fades out.
  const still = byId("still");
  let frozen = null;

  function freeze() {
    if (!renderer || !sorted) return;
    if (headset.session) {  // it fades from black
      frozen = { began: null, left: 1, position: null };
      return;
    }
    drawAt(canvas.width, canvas.height);  // what a canvas shows can be copied in the task that drew it
    const size = fullSize(), context = still.getContext("2d");
    const isSame = still.width === size[0] && still.height === size[1];
    context.globalAlpha = frozen && isSame ? 1 - frozen.left : 1;
    if (!isSame) [still.width, still.height] = size;
    context.drawImage(canvas, 0, 0, ...size);
    frozen = { began: null, left: 1, position: null };
    showStill();
    changed();
  }

  function updateStill(now) {
    if (!frozen) return;
    frozen.position = frozen.position || [...camera.position];
    const isSorted = isSortedAs() && distanceOf(sorted.position, frozen.position) < HEADER.speed;
    if (frozen.began === null && isSorted && isSeen()) frozen.began = now;
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

  // Whether a view of the group at the camera is sorted, or all are empty.
  const isSeen = () => doll.isOn || HEADER.groups[group].some((view) => sorted.views.includes(view) && HEADER.views[view].count) || isComplete();

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
    if (doll.isOn) doll.setOn(false);  // before the pose, which may have a field of view
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
  const tallOf = (width, height) => clamp(Math.sqrt(height / width), 1, HEADER.tallest);
  const tangentOf = (width, height, fov = camera.fov) => tallOf(width, height) * Math.tan(0.5 * fov * DEGREE);

  function turn(yaw, pitch) {
    camera.yaw += yaw;
    camera.pitch = clamp(camera.pitch + pitch, -MAX_PITCH, MAX_PITCH);
    changed();
  }

  // Moves along the camera's heading: right, up and forward in metres. The camera stays near the edges of its part, or
  // near the panoramas of a scene without edges; steps away from them become shorter near the limit.
  function walk(right, up, forward) {
    if (doll.isOn) return;
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

  // The panorama at the camera, or that from which it looked at the doll's house.
  const nodeHere = () => doll.isOn ? doll.node : nearestNode(camera.position);

  // A smooth flight to a panorama along the edges; the direction of view stays the user's. To another part, the camera
  // turns to the link, goes a step along it, and the image fades; without a link it fades at once.
  let flight = null, touring = false;
  function flyTo(spot) {
    if (doll.isOn) {
      doll.visit(spot);
      return;
    }
    if (calm.matches) {
      flight = { spot, legs: [{ from: edges.length ? nearestNode(camera.position) : spot, to: spot }], began: null };
      if (touring) flight.legs.push({ path: [GRAPH.positions[spot]], rest: REST_SECONDS });
      changed();
      return;
    }
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
      jump(GRAPH.positions[leg.to], isFade(GRAPH, leg.from, leg.to) ? arriveAt(leg.to, leg.from) : camera);
      flight.legs.shift();
      if (!flight.legs.length) flight = null;
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
    leg.seconds = leg.rest || leg.length ? leg.rest || clamp(1.2 * leg.length / HEADER.speed, 0.6, 3 * (leg.path.length - 1)) : turning;
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
    if (touring && doll.isOn) jumpTo(doll.node);
    byId("play").setAttribute("aria-pressed", touring);
    byId("play").querySelector("path").setAttribute("d", touring ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
    if (!touring) flight = route = null;
    else if (HEADER.route.length > 1 && !calm.matches) {
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
    goToPose(makeStart());
  }

  // Goes to another camera; the image fades, unless the order of the Gaussians is right there too.
  function goToPose(pose) {
    const isFar = distanceOf(pose.position, camera.position) > HEADER.speed;
    const isElsewhere = edges.length && partOfEdge(GRAPH, nearestEdge(GRAPH, pose.position)) !== currentPart();
    if (isFar || isElsewhere || headset.session) freeze();
    place(pose);
  }

  // A camera for a pose of share.js, some of whose values may be missing; its position is within the limits.
  function cameraFor({ position, yaw, pitch, fov }) {
    const found = { ...camera, position: [...camera.position], roll: 0 };
    const check = (name, values) => {
      if (!values.every(Number.isFinite)) throw new Error(`The ${name} of a pose needs finite numbers, got ${JSON.stringify(values)}.`);
    };
    if (position !== undefined) {
      check("position", [0, 1, 2].map((k) => position[k]));
      const edge = edges.length ? nearestEdge(GRAPH, position) : null;
      const distances = GRAPH.positions.map((each) => distanceOf(each, position));
      const from = edge === null ? GRAPH.positions[distances.indexOf(Math.min(...distances))] : closestOnEdge(GRAPH, edge, position);
      const limit = HEADER.limits[edge === null ? 0 : partOfEdge(GRAPH, edge)], away = distanceOf(position, from);
      found.position = plus(from, scaled(minus(position, from), Math.min(limit / Math.max(away, 1e-9), 1)));
    }
    check("angles", [yaw, pitch, fov].filter((value) => value !== undefined));
    if (yaw !== undefined) found.yaw = yaw * DEGREE;
    if (pitch !== undefined) found.pitch = clamp(pitch * DEGREE, -MAX_PITCH, MAX_PITCH);
    if (fov !== undefined) found.fov = clamp(fov, MIN_FOV, MAX_FOV);
    return found;
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
    KeyM: () => { if (HEADER.spots.length > 1) plan.toggle(); },
    KeyO: () => doll.toggle(),
    KeyP: () => share.savePicture(),
  };
  const CLOSES = { KeyH: "keys", KeyL: "list" };  // the dialogs that a key opens and closes

  function onKey(event) {
    const open = document.querySelector("dialog[open]");
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
    if (doll.isOn) doll.move(step, seconds);
    else if (step.some((value) => value)) walk(...scaled(step, seconds * HEADER.speed * (fast ? 3 : 1)));
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
      if (doll.isOn) doll.orbit(2 * Math.PI * moved[0] / clientWidth, -Math.PI * moved[1] / clientHeight);
      else turn(-moved[0] * radians, moved[1] * radians);
    } else if (before.length === 2) {
      const apart = ([a, b]) => distanceOf(a, b);
      const metres = 2 * HEADER.speed / Math.min(canvas.clientWidth, canvas.clientHeight);
      const pinch = apart([...fingers.values()]) - apart(before);
      if (doll.isOn) doll.zoom(apart(before) / Math.max(apart([...fingers.values()]), 1));
      setTouring(false);
      walk(-0.5 * moved[0] * metres, 0, (0.5 * moved[1] + pinch) * metres);
    }
  }

  // Look around by the device's motion: its axes in the earth's (east, north, up), turned by the screen's angle.
  let motion = null;
  function onOrientation({ alpha, beta, gamma }) {
    if (alpha === null || beta === null || gamma === null || doll.isOn) return;
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
    addEventListener("hashchange", () => {
      const pose = parsePose(location.hash);
      if (pose) setPose(pose);
    });
    addEventListener("pointerdown", (event) => { if (!byId("more").parentElement.contains(event.target)) showMore(false); });
    let pressed = null;  // where the pointer went down, until it moves
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pressed = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", onMove);
    canvas.addEventListener("click", ({ clientX, clientY }) => {
      if (!pressed || distanceOf(pressed, [clientX, clientY]) >= 5) return;
      if (measure.isOn) measure.take(clientX, clientY);
      else if (doll.isOn) doll.take(clientX, clientY);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (!embed.isEngaged) {
        say("Click the picture to change its field of view by the wheel");
        return;
      }
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode ? 33 : 1);  // or lines
      const factor = Math.exp(0.001 * clamp(pixels, -200, 200));
      if (doll.isOn) doll.zoom(factor);
      else camera.fov = clamp(camera.fov * factor, MIN_FOV, MAX_FOV);
      changed();
    }, { passive: false });
    byId("play").onclick = () => setTouring(!touring);
    byId("home").onclick = goHome;
    byId("place").onclick = openList;
    byId("list").onclick = (event) => { if (event.target === byId("list")) byId("list").close(); };  // beside it
    byId("map").onclick = () => plan.toggle();
    byId("doll").onclick = () => doll.toggle();
    byId("doll").hidden = !doll.isPossible;
    byId("more").onclick = () => showMore(byId("menu").hidden);
    for (const [id, act] of [["measure", () => measure.toggle()], ["full", toggleFull], ["picture", () => share.savePicture()], ["link", () => share.copyLink()]]) {
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

  // A short message, that a screen reader reads too.
  let spoken = null;
  function say(text) {
    byId("status").textContent = text;
    clearTimeout(spoken);
    spoken = setTimeout(() => { byId("status").textContent = ""; }, 5000);
  }

  function explain(text) {
    byId("notice-text").textContent = text;
    byId("notice").showModal();
  }

  function showMore(isOpen) {
    byId("menu").hidden = !isOpen;
    byId("more").setAttribute("aria-expanded", isOpen);
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
    const isSame = parts[node] === currentPart(), from = edges.length ? nodeHere() : node;
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
    if (doll.isOn) return rings.filter(({ link, node }) => !link && doll.shows(node));
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
    const node = nodeHere();
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
  let worker = null, sorting = false, sorted = null;
  const changed = () => { dirty = true; lastChange = performance.now(); };

  let arrived = 0;  // number of views
  const isComplete = () => arrived === HEADER.loading.length;

  // Whether the order is that of the part, and of the doll's house view or of panoramas, as the page shows it.
  const isSortedAs = (part = currentPart()) => sorted.part === part && (sorted.ranges !== null) === doll.isOn;

  const isSortedFor = (position, part, tolerance = 0) => {
    return sorted !== null && isSortedAs(part) && sorted.arrived === arrived && distanceOf(sorted.position, position) <= tolerance;
  };

  // `tolerance`: distance in metres for which the order of before is kept.
  function requestSort(tolerance) {
    if (sorting || isSortedFor(camera.position, currentPart(), tolerance)) return;
    sorting = true;
    worker.postMessage({ position: [...camera.position], part: currentPart(), ranges: doll.ranges });
  }

  function onSorted(data) {
    sorting = false;
    sorted = data;
    if (renderer) renderer.setSorted(data);
    dirty = true;
  }

  // Whether the picture is final: all data is there and sorted for the camera, nothing moves or fades, and it is drawn.
  function isSettled() {
    const isDrawn = headset.session !== null || !dirty && drawnScale === 1, tolerance = headset.session ? SORT_DISTANCE : 0;
    const isMoving = [flight, route, doll.flight, fade, frozen].some((each) => each !== null);
    return isDrawn && !isMoving && isComplete() && isSortedFor(camera.position, currentPart(), tolerance) && sorted.views.every((view) => shown[view] === 1);
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
    doll.advance(now);
    if (edges.length && !doll.isOn) updateEdge(now);
    updateStill(now);
    showViews(1000 * seconds / FADE_MS);
    const node = nodeHere(), isMoving = flight !== null || doll.flight !== null || isWaiting();
    const isThere = !isMoving && !doll.isOn && distanceOf(GRAPH.positions[node], camera.position) < HEADER.spots[node].radius;
    embed.follow(isThere ? node : null, isMoving);
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
    const rotation = drawAt(...fullSize().map((side) => Math.max(Math.round(side * wanted), 1)));
    placeRings(rotation);
    showMarks(rotation);
    showPlace();
    plan.show();
  }

  // ---- measuring and pictures ----

  // The place of a point of the window on the image plane, and its direction in the scene.
  function planeOf(left, top) {
    const { clientWidth: width, clientHeight: height } = canvas, step = 2 * tangentOf(width, height) / height;
    return [(left - 0.5 * width) * step, (top - 0.5 * height) * step];
  }

  function rayOf(left, top) {
    const ray = [...planeOf(left, top), 1];
    return scaled(rotationOf(camera).map((row) => dot(row, ray)), 1 / Math.hypot(...ray));
  }

  // The distance from the camera to what a point of the window shows, or null.
  function measureAt(left, top) {
    if (!renderer || !sorted) return null;
    const [width, height] = fullSize(), tangent = tangentOf(width, height), half = [tangent / height, tangent / height];
    const seen = { position: camera.position, rotation: rotationOf(camera), center: planeOf(left, top), half };
    return renderer.measure(seen, blendWeights(camera.position));
  }

  function showMarks(rotation) {
    const { clientWidth: width, clientHeight: height } = canvas, focal = 0.5 * height / tangentOf(width, height);
    const toCamera = (point) => [0, 1, 2].map((k) => dot(column(rotation, k), minus(point, camera.position)));
    measure.show(toCamera, ([x, y, z]) => [0.5 * width + focal * x / z, 0.5 * height + focal * y / z]);
  }

  function takePicture() {
    if (!renderer || !sorted) return null;
    drawAt(...fullSize());
    changed();
    return new Promise((resolve) => { canvas.toBlob(resolve, "image/png"); });
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
    leaveDollHouse: () => { if (doll.isOn) jumpTo(doll.node); },
    get renderer() { return sorted && renderer; },
    get black() { return frozen ? frozen.left : 0; },
    get isFlying() { return flight !== null || route !== null; },
  });

  const share = new Share({ camera, say, explain, takePicture });
  const measure = new Measure({ camera, say, changed, measureAt, rayOf });
  const doll = new DollHouse({
    camera, changed, ease, freeze, jump, jumpTo, measureAt, nearestNode, rayOf, setTouring, tangentOf,
    get isCalm() { return calm.matches; },
    get isWaiting() { return isWaiting(); },
    get isInHeadset() { return headset.session !== null; },
  });
  const plan = new Plan({ camera, changed, goTo, isSingle, get here() { return here; } });
  const embed = new Embed();

  function setPose(pose) {
    const next = cameraFor(pose);
    setTouring(false);
    goToPose(next);
  }

  let failure = null;
  function fail(error) {
    if (failure) return;
    failure = error;
    byId("cover").hidden = false;
    byId("cover").className = "failed";
    byId("message").textContent = error.message || String(error);
    bar.hidden = true;
    console.error(error);
  }

  // ---- loading ----

  const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

  // A script for each part of the data calls this. In a page of one file the part is the element before: unlike text in a
  // program, it is not kept.
  let partsArrived = 0;
  window.addPart = (text) => {
    const { currentScript: script } = document;
    if (text === undefined) {
      text = script.previousElementSibling.textContent;
      script.previousElementSibling.remove();
    }
    script.remove();
    partsArrived += 1;
    bar.value = partsArrived / HEADER.dataParts;
    if (!worker) return;
    worker.postMessage({ text });
    if (partsArrived === HEADER.dataParts) worker.postMessage({ end: true });
  };

  // Starts the worker; `onView` gets the Gaussians of each view. Returns a promise of the first order.
  function load(onView) {
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

  async function main() {
    placePoster();
    addEventListener("resize", placePoster);
    if (!window.DecompressionStream) throw lack("DecompressionStream");
    const linked = parsePose(location.hash);
    if (linked) Object.assign(camera, cameraFor(linked));
    settleAt(camera.position);
    canvas.ariaBusy = true;
    const received = [];  // kept for a context that is lost
    const loading = load((data) => {
      received.push(data);
      if (renderer) renderer.add(data);
      if (isComplete()) canvas.ariaBusy = false;
    });
    loading.catch(() => {});  // of an error that comes before it is awaited
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw lack("WebGL 2");
    headset.gl = gl;
    const makeRenderer = () => {
      if (gl.isContextLost()) return;
      renderer = new Renderer(gl);
      received.forEach((data) => renderer.add(data));
      if (sorted) renderer.setSorted(sorted);
      changed();
    };
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); renderer = null; headset.lose(); });
    canvas.addEventListener("webglcontextrestored", () => {
      try { makeRenderer(); } catch (error) { fail(error); }
    });
    makeRenderer();
    await loading;
    while (!renderer) {  // the context is lost
      if (failure) throw failure;
      await wait(50);
    }
    showViews(1);
    listen();
    headset.offer();
    rings = makeRings();
    makeList();
    embed.listen(canvas, window.pansplat);
    requestAnimationFrame(onFrame);
    byId("cover").className = "done";
    setTimeout(() => { byId("cover").hidden = !failure; }, 700);
  }

  // A panorama by its number in the list, from 1, or its name.
  function findNode(panorama) {
    const node = typeof panorama === "number" ? panorama - 1 : HEADER.spots.findIndex(({ name }) => name === panorama);
    if (!HEADER.spots[node]) throw new Error(`There is no panorama ${JSON.stringify(panorama)}; there are 1 to ${HEADER.spots.length}.`);
    return node;
  }

  // For scripts and host pages: docs/web.md, Embedding. An EventTarget.
  window.pansplat = Object.assign(new EventTarget(), {
    camera,
    panoramas: HEADER.spots.map(({ name }) => name),
    getPose: () => poseOf(camera),
    setPose,
    isSettled,
    async goTo(panorama, { jump = false } = {}) {
      const node = findNode(panorama);
      setTouring(false);
      return embed.await(node, () => jump ? jumpTo(node) : flyTo(node));
    },
    async render(width, height) {
      await this.ready;
      const place = [...camera.position];
      settleAt(place);
      while (!renderer || !isComplete() || !isSortedFor(place, currentPart())) {
        if (failure) throw failure;
        await wait(5);
      }
      settleAt(place);
      sorted.views.forEach((view) => { shown[view] = 1; });
      drawAt(width, height);
      const image = canvas.toDataURL("image/png");
      drawnScale = 0;
      changed();
      return image;
    },
  });
  window.pansplat.ready = main();
  window.pansplat.ready.catch(fail);
  addEventListener("message", (event) => embed.answer(event));
})();
