/** Tooltips with shortcuts, and toasts near the pressed element. */
import { $, h } from "./dom.js";

/** Place a box inside the window, below its anchor if possible. @param {HTMLElement} box @param {DOMRect} anchor */
function place(box, anchor) {
  const { width, height } = box.getBoundingClientRect();
  const left = Math.min(Math.max(8, anchor.left + anchor.width / 2 - width / 2), innerWidth - width - 8);
  const below = anchor.bottom + 8;
  const top = below + height < innerHeight - 4 ? below : anchor.top - height - 8;
  box.style.left = `${left}px`;
  box.style.top = `${Math.max(4, top)}px`;
}

/** Show `data-tip` and `data-keys` of an element under the pointer or with the focus as a tooltip. */
export function startTooltips() {
  const tip = $("tip");
  let timer = 0;
  const hide = () => {
    clearTimeout(timer);
    tip.hidden = true;
  };
  const show = (/** @type {Event} */ event, wait = 350) => {
    const element = event.target instanceof Element ? event.target.closest("[data-tip]") : null;
    hide();
    if (!element) return;
    timer = setTimeout(() => {
      if (!element.isConnected) return;
      const keys = element.getAttribute("data-keys");
      tip.replaceChildren(element.getAttribute("data-tip") ?? "", ...(keys ? [h("kbd", {}, keys)] : []));
      tip.hidden = false;
      place(tip, element.getBoundingClientRect());
    }, wait);
  };
  document.addEventListener("pointerover", (event) => event.pointerType !== "touch" && show(event));
  document.addEventListener("pointerdown", hide, true);
  document.addEventListener("focusin", (event) => {
    if (event.target instanceof Element && event.target.matches(":focus-visible:not(#prompts, [type=text])")) show(event, 600);
  });
  document.addEventListener("focusout", hide);
  document.addEventListener("input", hide);
  addEventListener("scroll", hide, true);
}

/**
 * Show a toast near its anchor.
 * @param {string | Node} content
 * @param {{kind?: string, anchor?: Element | null, seconds?: number}} [options] The anchor is the pressed element.
 */
export function toast(content, { kind = "info", anchor = null, seconds = 5 } = {}) {
  const box = h(`div.toast.${kind}`, { role: kind === "error" ? "alert" : "status" }, content);
  const shown = [...$("toasts").children];
  shown.filter((other) => other.textContent === box.textContent || shown.length > 2).forEach((other) => other.remove());
  $("toasts").append(box);
  const rect = anchor?.isConnected ? anchor.getBoundingClientRect() : null;
  const inside = rect && rect.width > 0 && rect.bottom > 0 && rect.top < innerHeight;
  const stage = $("stage").getBoundingClientRect();
  const middle = new DOMRect(stage.left + stage.width / 2, stage.bottom - 130, 0, 0);
  place(box, inside ? rect : middle);
  const close = () => box.remove();
  box.addEventListener("click", close);
  setTimeout(close, 1000 * (kind === "error" ? 2 * seconds : seconds));
}
