// What a tour says about a place in a panorama: a marker in its direction, at the panorama, opens a text box. Texts and
// addresses are those of the tour's author; text is never HTML.

import { nodeHere } from "./camera.js";
import { byId, explain, make } from "./dom.js";
import { column, distanceOf, dot } from "./graph.js";
import { camera, GRAPH, state } from "./state.js";

let markers = [];

export function makeNotes() {
  markers = HEADER.spots.flatMap(({ notes }, node) =>
    notes.map(({ direction, text, addresses }) => {
      const button = make("button", "note", "i");
      button.hidden = true;
      button.title = button.ariaLabel = `Information: ${text.split("\n")[0] || addresses[0]}`;
      const links = addresses.map((href) => Object.assign(make("a", "", href), { href, target: "_blank", rel: "noopener noreferrer" }));
      button.onclick = () => explain(text, links);
      byId("spots").append(button);
      return { node, direction, button };
    })
  );
}

// `toWindow`: from camera axes.
export function placeNotes(rotation, toWindow) {
  const here = nodeHere(), isThere = !state.doll.isOn && distanceOf(GRAPH.positions[here], camera.position) < HEADER.ringRadius;
  for (const { node, direction, button } of markers) {
    const place = [0, 1, 2].map((k) => dot(column(rotation, k), direction)), [left, top] = toWindow(place);
    button.hidden = !isThere || node !== here || place[2] < 0.1;
    button.style.transform = `translate(${left - 22}px, ${top - 22}px)`;
  }
}
