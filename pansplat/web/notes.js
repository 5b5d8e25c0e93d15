// What a tour says about a place in a panorama: a marker in its direction, at the panorama, opens a text box. Texts and
// addresses are those of the tour's author; text is never HTML.

import { nodeWithin } from "./camera.js";
import { byId, explain, make } from "./dom.js";
import { inAxes } from "./graph.js";

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
  const here = nodeWithin(HEADER.ringRadius);
  for (const { node, direction, button } of markers) {
    const place = inAxes(rotation, direction), [left, top] = toWindow(place);
    button.hidden = node !== here || place[2] < 0.1;
    button.style.transform = `translate(${left - 22}px, ${top - 22}px)`;
  }
}
