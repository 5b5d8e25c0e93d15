// The document: elements, short messages, and the motion that a visitor prefers.

/** @type {(id: string) => any} */
export const byId = (id) => document.getElementById(id);
/** @type {HTMLCanvasElement & { ariaBusy: any }} */
export const canvas = byId("view");
export const calm = matchMedia("(prefers-reduced-motion: reduce)");

// A short message, that a screen reader reads too.
let spoken = null;
export function say(text) {
  byId("status").textContent = text;
  clearTimeout(spoken);
  spoken = setTimeout(() => {
    byId("status").textContent = "";
  }, 5000);
}

export function explain(text, links = []) {
  byId("notice-text").textContent = text;
  byId("notice-links").replaceChildren(...links);
  byId("notice").showModal();
}

export function showMore(isOpen) {
  byId("menu").hidden = !isOpen;
  byId("more").setAttribute("aria-expanded", isOpen);
}

// The text of the element before the script that runs. Both are removed: unlike text in a program, it is not kept.
export function takeText() {
  const { currentScript: script } = document, element = script.previousElementSibling;
  [element, script].forEach((each) => each.remove());
  return element.textContent;
}

// An element with children that are elements or text; text is never HTML.
export function make(tag, className, ...children) {
  const element = document.createElement(tag);
  element.className = className;
  element.append(...children);
  return element;
}

const MAX_PIXELS = 3e6; // largest number of pixels of the canvas, which limits the memory of its render targets

// The size of the canvas at the full resolution, pixels.
export function fullSize() {
  const { clientWidth, clientHeight } = canvas, ratio = Math.min(devicePixelRatio || 1, 2);
  const full = Math.min(ratio, Math.sqrt(MAX_PIXELS / (clientWidth * clientHeight || 1)));
  return [clientWidth, clientHeight].map((side) => Math.max(Math.round(side * full), 1));
}
