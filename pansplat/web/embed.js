// The page in other pages and for scripts (docs/web.md, Embedding): events of arrival, and whether the wheel scrolls the host
// page.

class Embed {
  constructor() {
    this.isFramed = window.parent !== window;
    this.isEngaged = !this.isFramed; // whether the wheel and vertical strokes of a finger are the page's
    this.waiting = null; // the goTo whose end is awaited
    this.at = null;
  }

  // `surfaces` take the wheel after a click; `api` hears of arrivals.
  listen(surfaces, api) {
    this.api = api;
    if (!this.isFramed) return;
    const engage = (value) => {
      this.isEngaged = value;
      for (const { style } of surfaces) style.touchAction = value ? "none" : "pan-y";
    };
    engage(false);
    addEventListener("click", () => engage(true));
    addEventListener("keydown", ({ code }) => code === "Escape" && engage(false));
    addEventListener("blur", () => engage(false));
    document.documentElement.addEventListener("pointerleave", ({ pointerType }) => pointerType === "mouse" && engage(false));
  }

  // A promise of whether the camera arrives at the panorama; `go` starts the way to it.
  await(node, go) {
    if (this.waiting) this.waiting.resolve(false);
    go();
    return new Promise((resolve) => {
      this.waiting = { node, resolve };
    });
  }

  // Called in every frame with the panorama at a camera that has arrived, or null.
  follow(node, isMoving) {
    if (node !== null && node !== this.at) {
      const detail = { panorama: node + 1, name: HEADER.spots[node].name };
      this.api.dispatchEvent(new CustomEvent("arrive", { detail }));
    }
    this.at = node;
    if (!this.waiting || isMoving) return;
    this.waiting.resolve(node === this.waiting.node);
    this.waiting = null;
  }
}

export const embed = new Embed();
