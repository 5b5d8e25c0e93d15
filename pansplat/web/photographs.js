// The photographs of the panoramas: where the camera stands at one, its photograph is shown, and Gaussians while it moves.
// docs/web.md describes it. Tiles of cube faces are files, or text in a page of one file. A large level is drawn over the smallest one, as far as it has arrived.

import { isFixed, nodeHere, nodeWithin, rotationOf, tangentOf } from "./camera.js";
import { fullSize, say, takeText } from "./dom.js";
import { clamp, column, distanceOf, dot, fromAxes, inAxes, minus, multiply, scaled, unit } from "./graph.js";
import { fetchFile, PAUSE_AFTER_ERROR, TRIES } from "./loading.js";
import { camera, changed, GRAPH, refresh, state } from "./state.js";

const DENSITY = 1.3; // texels of a pixel in the middle of a face, at least
const KEPT = 3; // photographs whose textures are kept
const AT_ONCE = 6; // tiles that are read at the same time
const SMALL_FACE = 2048; // largest face on a phone, texels
// Right, down and forward of each face (pansplat.geometry.cubemap.FACES), and its number in OpenGL.
const FACES = [
  [[1, 0, 0], [0, 1, 0], [0, 0, 1], 4],
  [[0, 0, -1], [0, 1, 0], [1, 0, 0], 0],
  [[-1, 0, 0], [0, 1, 0], [0, 0, -1], 5],
  [[0, 0, 1], [0, 1, 0], [-1, 0, 0], 1],
  [[1, 0, 0], [0, 0, 1], [0, -1, 0], 2],
  [[1, 0, 0], [0, 0, -1], [0, 1, 0], 3],
];
const texts = new Map(); // base64 of the tiles that have arrived in a page of one file

// In a page of one file a script for the smallest tiles of a photograph calls this, and one for the others.
window.addTile = (name, number) => takeText().split(" ").forEach((each, k) => texts.set(`${name}_${number + k}`, each));

async function readTile({ key, tries }) {
  if (HEADER.folder !== null) {
    try {
      return await createImageBitmap(await fetchFile(`${key}.jpg`, tries > 0));
    } catch {
      throw new Error(`${key}.jpg is missing, or is no tile`); // a web server may answer with a page
    }
  }
  const image = new Image();
  image.src = `data:image/jpeg;base64,${texts.get(key)}`;
  await image.decode();
  return image;
}

// One size of a photograph. `status` of a tile: null (not requested), "reading", "ready", "failed" (after TRIES tries); `due`: the
// time of the next try.
class Level {
  texture = null;
  isFresh = true;
  tiles = [];

  constructor(name, rotation, first, [size, step]) {
    this.size = size;
    const count = Math.ceil(size / step);
    FACES.forEach(([right, down, forward, face]) => {
      for (let row = 0; row < count; row++) {
        for (let across = 0; across < count; across++) {
          const [x, y] = [across, row].map((k) => (2 * k + 1) * step / size - 1);
          const ray = [0, 1, 2].map((k) => x * right[k] + y * down[k] + forward[k]);
          const direction = unit(fromAxes(rotation, ray));
          const reach = Math.atan(Math.SQRT2 * step / size);
          const key = `${name}_${first + this.tiles.length}`, place = { face, x: across * step, y: row * step };
          this.tiles.push({ key, ...place, direction, reach, status: null, tries: 0, due: 0 });
        }
      }
    });
  }

  get isReady() {
    return this.tiles.every(({ status }) => status === "ready");
  }

  take(tile, image) {
    const { gl } = state.renderer;
    gl.bindTexture(gl.TEXTURE_CUBE_MAP, this.texture || this.makeTexture());
    gl.texSubImage2D(gl.TEXTURE_CUBE_MAP_POSITIVE_X + tile.face, 0, tile.x, tile.y, gl.RGBA, gl.UNSIGNED_BYTE, image);
    this.isFresh = false;
  }

  makeTexture() {
    const { gl } = state.renderer;
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_CUBE_MAP, this.texture);
    gl.texStorage2D(gl.TEXTURE_CUBE_MAP, Math.floor(Math.log2(this.size)) + 1, gl.RGBA8, this.size, this.size);
    gl.texParameteri(gl.TEXTURE_CUBE_MAP, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    return this.texture;
  }

  bind(unit) {
    const { gl } = state.renderer;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_CUBE_MAP, this.texture);
    if (!this.isFresh) gl.generateMipmap(gl.TEXTURE_CUBE_MAP);
    this.isFresh = true;
  }

  release() {
    if (this.texture && !state.renderer.gl.isContextLost()) state.renderer.gl.deleteTexture(this.texture);
    this.texture = null;
    this.tiles.forEach((tile) => Object.assign(tile, { status: null, tries: 0, due: 0 }));
  }
}

class Photographs {
  opacity = 0;
  target = 0;
  node = null;
  wanted = null;
  last = null;
  reading = 0;
  made = new Map();
  renderer = null;
  program = null;

  // Whether nothing else is seen.
  get isOpaque() {
    return this.opacity === 1;
  }

  // Whether the picture has all of the photograph that it needs.
  isFinal(size = fullSize()) {
    if (!HEADER.photographs.length || state.headset.session) return true;
    if (this.last === null || this.renderer !== state.renderer || distanceOf(camera.position, this.last) > 0) return false;
    const node = this.findNode(), isDue = node !== null && this.levelsOf(node)[0].isReady;
    if (this.target !== Number(isDue) || this.opacity !== this.target) return false;
    return node === null || this.listMissing(node, size, true).every(({ status }) => status === "failed");
  }

  // The panorama at which the camera stands; null in a headset, whose eyes are beside it. In a part without Gaussians: the nearest
  // panorama.
  findNode() {
    return nodeWithin(isFixed() ? Infinity : state.headset.session ? -1 : HEADER.stopReach);
  }

  // What is shown of a flight: the photographs of both ends, near them.
  findFlown() {
    const [leg] = state.way?.legs || [];
    if (!leg?.path || !leg.done || state.headset.session) return null;
    const isFirst = leg.done < 0.5, node = isFirst ? leg.from : leg.to;
    const isReady = node !== null && this.levelsOf(node)[0].isReady;
    return { node, opacity: isReady ? clamp(2 - (isFirst ? leg.done : 1 - leg.done) / HEADER.covered, 0, 1) : 0 };
  }

  // The smallest tiles of the photograph at the camera.
  get first() {
    const node = HEADER.photographs.length && state.renderer ? this.findNode() : null;
    return node === null ? [] : this.levelsOf(node)[0].tiles;
  }

  // Whether the photograph at the camera, which is not shown yet, may arrive soon.
  get isExpected() {
    return !this.isOpaque && this.first.length > 0 && this.first.every(({ tries }) => !tries);
  }

  // The levels of a photograph that the device can hold, the smallest first.
  levelsOf(node) {
    if (!this.made.has(node)) {
      const { name, levels, rotation } = HEADER.photographs[node], { gl } = state.renderer;
      const most = Math.min(gl.getParameter(gl.MAX_CUBE_MAP_TEXTURE_SIZE), matchMedia("(pointer: coarse)").matches ? SMALL_FACE : Infinity);
      let first = 0;
      const made = levels.map((level) => {
        const each = new Level(name, rotation, first, level);
        first += each.tiles.length;
        return each;
      });
      this.made.set(node, made.filter(({ size }, k) => k === 0 || size <= most));
    }
    return this.made.get(node);
  }

  // The level that is sharp enough for a size of the picture.
  chooseLevel(node, [width, height]) {
    const density = 0.5 * height / tangentOf(width, height), levels = this.levelsOf(node);
    return levels.find(({ size }) => 0.5 * size >= DENSITY * density) || levels.at(-1);
  }

  // The tiles that have not arrived: those of the smallest level, then of the chosen one those in view, then the others.
  listMissing(node, size, isOnlySeen = false, view = camera) {
    const forward = column(rotationOf({ roll: 0, ...view }), 2), tangent = tangentOf(...size);
    const corner = Math.atan(Math.hypot(tangent, tangent * size[0] / size[1]));
    const away = ({ direction, reach }) => Math.acos(clamp(dot(direction, forward), -1, 1)) - reach - corner;
    const [preview] = this.levelsOf(node), level = this.chooseLevel(node, size);
    const tiles = [...preview.tiles, ...(level === preview ? [] : level.tiles)].filter(({ status }) => status !== "ready");
    const found = tiles.map((tile) => ({ tile, isPreview: preview.tiles.includes(tile), angle: away(tile) }));
    found.sort((a, b) => b.isPreview - a.isPreview || a.angle - b.angle);
    return found.filter(({ isPreview, angle }) => !isOnlySeen || isPreview || angle < 0).map(({ tile }) => tile);
  }

  // Reads what the photograph at the camera needs, or that where a flight ends, and fades; `seconds` after the last time.
  update(seconds, size = fullSize()) {
    if (!HEADER.photographs.length || !state.renderer) return;
    if (this.renderer !== state.renderer) { // the graphics were lost
      this.made.clear();
      Object.assign(this, { renderer: state.renderer, program: state.renderer.link(SHADERS.photograph, "preview", "detail"), opacity: 0 });
    }
    const isStill = this.last !== null && distanceOf(camera.position, this.last) === 0 || state.headset.session !== null;
    this.last = [...camera.position];
    const next = state.way?.legs.find(({ to }) => to !== undefined), flown = this.findFlown();
    this.wanted = next ? next.to : nodeHere();
    this.read(this.wanted, size, next?.view);
    if (flown) {
      Object.assign(this, { ...flown, target: flown.opacity });
      return;
    }
    const node = this.findNode(), isShown = node !== null && (isStill || node === this.node) && this.levelsOf(node)[0].isReady;
    if (isShown && this.node !== node) Object.assign(this, { node, opacity: 0 });
    this.target = isShown ? 1 : 0;
    if (this.opacity === this.target) return;
    const step = state.still?.began === null ? 1 : seconds / HEADER.stopSeconds; // the still covers it
    this.opacity = clamp(this.target, this.opacity - step, this.opacity + step);
    changed();
  }

  read(node, size, view = camera) {
    for (const old of [...this.made.keys()].filter((each) => each !== node && each !== this.node).slice(0, -KEPT + 1)) {
      this.made.get(old).forEach((level) => level.release());
      this.made.delete(old);
    }
    const levels = this.levelsOf(node);
    const isThere = ({ key }) => HEADER.folder !== null || texts.has(key), now = performance.now();
    const tiles = this.listMissing(node, size, false, view).filter((tile) => !tile.status && tile.due <= now && isThere(tile));
    tiles.slice(0, Math.max(AT_ONCE - this.reading, 0)).forEach(async (tile) => {
      const level = levels.find(({ tiles: each }) => each.includes(tile));
      tile.status = "reading";
      this.reading += 1;
      try {
        const image = await readTile(tile);
        if (this.made.get(node) === levels && this.renderer === state.renderer) {
          level.take(tile, image);
          tile.status = "ready";
          refresh();
        }
      } catch (error) {
        tile.tries += 1;
        Object.assign(tile, { status: tile.tries < TRIES ? null : "failed", due: performance.now() + PAUSE_AFTER_ERROR });
        console.warn(error);
        if (tile.status === "failed") say(`A part of the photograph of ${HEADER.spots[node].name} cannot be loaded`);
      }
      this.reading -= 1;
      if (this.wanted === node && this.renderer === state.renderer) this.read(node, size, view);
    });
  }

  // Draws over a viewport of the canvas or of a framebuffer; `seen` is a camera of Renderer.draw.
  draw({ rotation, center, half }, width, height, framebuffer = null, [left, bottom] = [0, 0]) {
    if (!this.opacity) return;
    const { gl, screen } = state.renderer, { program, places } = this.program, levels = this.levelsOf(this.node);
    const chosen = this.chooseLevel(this.node, [width, height]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(left, bottom, width, height);
    gl.useProgram(program);
    gl.uniform2f(places.origin, left, bottom);
    levels[0].bind(0);
    (chosen.texture ? chosen : levels.filter(({ texture }) => texture).at(-1)).bind(1);
    // The rows of the inverse are the columns of the rotation; y of a cube map is up.
    const turned = multiply([0, 1, 2].map((k) => column(rotation, k)), HEADER.photographs[this.node].rotation);
    gl.uniformMatrix3fv(places.camera_to_cube, false, turned.flatMap(([x, y, z]) => [x, -y, z]));
    const offset = minus(camera.position, GRAPH.positions[this.node]), away = Math.hypot(...offset);
    const part = state.headset.session ? 0 : Math.min(1 / HEADER.surfaces, HEADER.mostBeside / Math.max(away, 1e-9));
    gl.uniform3fv(places.beside, inAxes(rotation, scaled(offset, part)));
    gl.uniform4f(places.window, ...center, ...half);
    gl.uniform2f(places.size, width, height);
    gl.uniform1f(places.opacity, this.opacity);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(screen);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

export const photographs = new Photographs();
