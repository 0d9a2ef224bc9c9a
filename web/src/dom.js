/** Helper functions for DOM elements. */

/**
 * Create an element.
 * @param {string} name Tag, with classes after dots.
 * @param {Record<string, any>} [attributes] Attributes; those that begin with "on" are event listeners.
 * @param {...(Node | string | null | undefined | false)} children
 * @returns {any}
 */
export function h(name, attributes = {}, ...children) {
  const [tag, ...classes] = name.split(".");
  const element = document.createElement(tag);
  if (classes.length > 0) element.className = classes.join(" ");
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "style") element.style.cssText = value;
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** @param {string} id @returns {any} */
export const $ = (id) => document.getElementById(id);

/** @param {number} count @returns {string} */
export const grouped = (count) => count.toLocaleString("en-US");

/** @param {number} count @param {string} noun @returns {string} Text such as "1 image" or "2 images". */
export const counted = (count, noun) => `${grouped(count)} ${noun}${count === 1 ? "" : "s"}`;

/** @param {number} value @param {number} [digits] */
export const fixed = (value, digits = 2) => (Number.isFinite(value) ? value.toFixed(digits) : "–");

/** Color of a selection made by hand. */
export const BY_HAND = [1, 0.75, 0.1];

/** @param {number[]} rgb Values in 0..1. */
export const cssColor = (rgb) => `rgb(${rgb.map((x) => Math.round(255 * x)).join(" ")})`;

/** Replace children if they differ, and keep the focus. @param {Element} parent @param {Node[]} children */
export function fill(parent, children) {
  const fresh = h("div", {}, ...children);
  if (fresh.innerHTML === parent.innerHTML && fresh.childNodes.length === parent.childNodes.length) return;
  const focused = parent.contains(document.activeElement) ? document.activeElement?.getAttribute("data-key") : null;
  parent.replaceChildren(...fresh.childNodes);
  if (focused) /** @type {HTMLElement | null} */ (parent.querySelector(`[data-key="${CSS.escape(focused)}"]`))?.focus();
}

/** @param {Blob} blob @param {string} name */
export function saveBlob(blob, name) {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

/**
 * Limit the calls of a function to one per interval; the last call is always made.
 * @param {(...values: any[]) => void} call @param {number} wait Interval in milliseconds.
 * @returns {(...values: any[]) => void}
 */
export function throttled(call, wait) {
  let timer = 0;
  let last = 0;
  return (...values) => {
    clearTimeout(timer);
    const left = last + wait - performance.now();
    const run = () => {
      last = performance.now();
      call(...values);
    };
    if (left <= 0) run();
    else timer = setTimeout(run, left);
  };
}
