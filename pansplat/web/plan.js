// The floor plan: the drawing of `pansplat export NAME.svg` with the camera, and buttons on its panoramas.

import { byId, make } from "./dom.js";
import { resizeDoll } from "./doll.js";
import { goTo } from "./flight.js";
import { DEGREE, distanceOf, inAxes, indexOfLeast, minus } from "./graph.js";
import { camera, changed, GRAPH, state } from "./state.js";

class Plan {
  panel = byId("plan");
  buttons = null;

  get isOpen() {
    return !this.panel.hidden;
  }

  toggle() {
    this.panel.hidden = this.isOpen;
    byId("map").setAttribute("aria-pressed", this.isOpen);
    if (this.isOpen && this.buttons === null) this.make();
    const { right, bottom } = this.panel.getBoundingClientRect(); // 0 while it is hidden
    state.doll.covered = [right, bottom];
    if (state.doll.isOn) resizeDoll(state.doll.size);
    changed();
  }

  make() {
    const { drawing, size, places, isSure } = HEADER.plan, picture = make("img", ""), [wide, tall] = size;
    picture.src = `data:image/svg+xml;base64,${drawing}`;
    picture.alt = "";
    this.camera = byId("here");
    byId("legend").hidden = isSure;
    byId("drawing").style.aspectRatio = wide / tall;
    this.buttons = places.map(([x, y], node) => {
      const button = make("button", "");
      button.title = button.ariaLabel = `Go to ${HEADER.spots[node].name}`;
      Object.assign(button.style, { left: `${100 * x / wide}%`, top: `${100 * y / tall}%` });
      button.onclick = ({ detail, clientX, clientY }) => goTo(detail ? this.nearest(clientX, clientY) : node);
      return button;
    });
    byId("drawing").replaceChildren(picture, this.camera, ...this.buttons);
  }

  // Areas of panoramas next to each other overlap.
  nearest(x, y) {
    const { left, top, width } = byId("drawing").getBoundingClientRect(), scale = width / HEADER.plan.size[0];
    return indexOfLeast(HEADER.plan.places.map(([right, down]) => distanceOf([scale * right, scale * down], [x - left, y - top])));
  }

  show() {
    if (!this.isOpen) return;
    const { size, places } = HEADER.plan, [x, y, turn] = places[state.here], [c, s] = [Math.cos(turn), Math.sin(turn)];
    const [right, , forward] = inAxes(HEADER.level, minus(camera.position, GRAPH.positions[state.here]));
    const left = (x + c * right + s * forward) / size[0], top = (y + s * right - c * forward) / size[1];
    Object.assign(this.camera.style, { left: `${100 * left}%`, top: `${100 * top}%`, rotate: `${(camera.yaw + turn) / DEGREE}deg` });
    this.camera.toggleAttribute("hidden", turn === null);
    this.buttons.forEach((button, node) => {
      if (node === state.here) button.setAttribute("aria-current", "location");
      else button.removeAttribute("aria-current");
    });
  }
}

export const plan = new Plan();
