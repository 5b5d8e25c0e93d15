// Shows the doll's house: triangles with the element `atlas` as texture, of which only fronts are seen.

import { findHouse } from "./doll.js";
import { byId } from "./dom.js";
import { camera, changed, state } from "./state.js";

const houses = new WeakMap(); // what each renderer needs

export const canShowDoll = () => state.sorted !== null && byId("atlas")?.complete === true;

// Opens or closes the doll's house without a flight. `isDue`: it opens when its data is there.
export function setDoll(isOn, isDue = false) {
  const { doll } = state;
  if (doll.isOn && !isOn) camera.fov = doll.fov;
  Object.assign(doll, { isOn, isDue, flight: null });
  byId("doll").setAttribute("aria-pressed", isOn || isDue);
  changed();
}

function makeHouse(renderer) {
  const { gl } = renderer, triangles = gl.createVertexArray(), atlas = gl.createTexture();
  gl.bindVertexArray(triangles);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, Float32Array.from(HEADER.doll.flatMap(({ corners }) => corners.flat())), gl.STATIC_DRAW);
  for (const [place, count, offset] of [[0, 3, 0], [1, 2, 12]]) {
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, count, gl.FLOAT, false, 20, offset);
  }
  renderer.bind([atlas]);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, byId("atlas"));
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LOD, 3); // the margins of the textures are as wide
  const sharper = gl.getExtension("EXT_texture_filter_anisotropic");
  if (sharper) gl.texParameteri(gl.TEXTURE_2D, sharper.TEXTURE_MAX_ANISOTROPY_EXT, 8);
  return { triangles, atlas, ...renderer.link(SHADERS.house, "atlas") };
}

// Draws to the canvas, which has a depth and several samples a pixel.
export function drawHouse({ position, rotation, center, half }, width, height) {
  const { renderer } = state, { gl } = renderer, house = findHouse();
  if (!houses.has(renderer)) houses.set(renderer, makeHouse(renderer));
  const { triangles, atlas, program, places } = houses.get(renderer);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, width, height);
  gl.disable(gl.BLEND);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.CULL_FACE);
  gl.frontFace(gl.CW);
  gl.clearColor(0.11, 0.12, 0.13, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.useProgram(program);
  gl.uniformMatrix3fv(places.world_to_camera, false, rotation.flat());
  gl.uniformMatrix3fv(places.level, true, HEADER.level.flat());
  gl.uniform3fv(places.position, position);
  gl.uniform4f(places.window, ...center, ...half);
  renderer.bind([atlas]);
  gl.bindVertexArray(triangles);
  const first = HEADER.doll.slice(0, HEADER.doll.indexOf(house)).reduce((sum, { corners }) => sum + corners.length, 0);
  gl.drawArrays(gl.TRIANGLES, first, house.corners.length);
  gl.disable(gl.DEPTH_TEST);
  gl.disable(gl.CULL_FACE);
}
