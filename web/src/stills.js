/** Images rendered by the server, for browsers that are slow or do not support WebGL 2. */
import { $ } from "./dom.js";

const COARSE = 640;
const FINE = 1280;
const REST = 350;

export class Stills {
  /**
   * @param {import("./view.js").View3D} view
   * @param {(value: any) => number} send Function that requests an image.
   * @param {() => void} place Function that sends the camera to the server.
   * @param {() => void} shown Function that is called for each image that is shown.
   */
  constructor(view, send, place, shown) {
    this.view = view;
    this.send = send;
    this.place = place;
    this.whenShown = shown;
    /** True to request large images too, without another renderer. */
    this.fine = false;
    this.background = [0, 0, 0];
    this.waiting = false;
    this.again = false;
    this.timer = 0;
    this.url = "";
  }

  /** @param {string} css Hexadecimal color. */
  setBackground(css) {
    const hex = css.slice(1).replace(/^(.)(.)(.)$/, "$1$1$2$2$3$3");
    this.background = [0, 2, 4].map((i) => Number.parseInt(hex.slice(i, i + 2), 16) / 255);
  }

  /** @param {boolean} moving True for a small image, followed by a large one. */
  request(moving) {
    clearTimeout(this.timer);
    if (moving && this.fine) this.timer = setTimeout(() => this.request(false), REST);
    if (this.waiting && moving) return;
    this.place();
    const most = Math.min(2048, Math.round(Math.max(this.view.width, this.view.height)));
    const size = moving || !this.fine ? COARSE : FINE;
    const value = { max_size: Math.max(16, Math.min(most, size)), background: this.background };
    this.waiting = this.send(value) >= 0;
  }

  get shown() {
    return !$("still").hidden;
  }

  /** @param {Uint8Array} bytes */
  show(bytes) {
    this.waiting = false;
    this.last = new Blob([/** @type {any} */ (bytes)], { type: bytes[0] === 0x89 ? "image/png" : "image/jpeg" });
    const old = this.url;
    this.url = URL.createObjectURL(this.last);
    const image = $("still");
    image.onload = () => {
      image.hidden = false;
      $("loading").hidden = true;
      if (old) URL.revokeObjectURL(old);
      this.whenShown();
    };
    image.src = this.url;
  }

  hide() {
    clearTimeout(this.timer);
    this.waiting = false;
    $("still").hidden = true;
  }

  /** @returns {Promise<Blob | null>} */
  async blob() {
    return this.last ?? null;
  }
}
