// The page in other pages and for scripts (docs/web.md, Embedding): messages, arrivals, and whose the wheel is.
// A page may show what only its visitor can open, so messages are exchanged with stated origins only (HEADER.embed).

const CALLS = ["goTo", "getPose", "setPose", "render"];  // of window.pansplat, by messages

class Embed {
  constructor() {
    this.isFramed = window.parent !== window;
    this.hosts = this.isFramed ? HEADER.embed : [];
    this.isEngaged = !this.isFramed;  // whether the wheel and vertical strokes of a finger are the page's
    this.waiting = null;              // for the end of a goTo
    this.at = null;
  }

  // `canvas` takes the wheel after a click; `api` answers messages.
  listen(canvas, api) {
    this.api = api;
    if (!this.isFramed) return;
    const engage = (value) => {
      this.isEngaged = value;
      canvas.style.touchAction = value ? "none" : "pan-y";
    };
    engage(false);
    addEventListener("click", () => engage(true));
    addEventListener("keydown", (event) => { if (event.code === "Escape") engage(false); });
    addEventListener("blur", () => engage(false));
    document.documentElement.addEventListener("pointerleave", ({ pointerType }) => { if (pointerType === "mouse") engage(false); });
    this.post("ready", { panoramas: api.panoramas });
  }

  // The browser delivers a message only if the host has the origin.
  post(name, detail) {
    for (const origin of this.hosts) window.parent.postMessage({ pansplat: name, ...detail }, origin);
  }

  async answer({ source, origin, data }) {
    if (source !== window.parent || !this.hosts.includes(origin) || !data || !CALLS.includes(data.pansplat)) return;
    this.hosts = [origin];
    const { pansplat: call, id, values = [] } = data;
    try {
      await window.pansplat.ready;
      this.post("answer", { id, value: await window.pansplat[call](...values) });
    } catch (error) {
      this.post("answer", { id, error: error.message || String(error) });
    }
  }

  // A promise of whether the camera arrives at the panorama; `go` starts the way to it.
  await(node, go) {
    if (this.waiting) this.waiting.resolve(false);
    go();
    return new Promise((resolve) => { this.waiting = { node, resolve }; });
  }

  // In every frame: the panorama at a camera that has arrived, or null.
  follow(node, isMoving) {
    if (node !== null && node !== this.at) {
      const detail = { panorama: node + 1, name: HEADER.spots[node].name };
      this.post("arrive", detail);
      this.api.dispatchEvent(new CustomEvent("arrive", { detail }));
    }
    this.at = node;
    if (!this.waiting || isMoving) return;
    this.waiting.resolve(node === this.waiting.node);
    this.waiting = null;
  }
}

export const embed = new Embed();
