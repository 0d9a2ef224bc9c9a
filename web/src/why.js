/** Panel next to the scene with images that explain a selection. */
import { $, h } from "./dom.js";
import { button } from "./panel.js";
import { closesOutside } from "./shortcuts.js";

/** @param {any} message Message of the type `explanation`. @param {() => void} closed */
export function showExplanation(message, closed) {
  const close = () => {
    $("why").hidden = true;
    closed();
  };
  const group = (/** @type {string} */ title, /** @type {any[]} */ entries) =>
    entries.length > 0 && h("div", {}, h("h3", {}, title), h("div.images", {}, ...entries.map(figure)));
  const title = message.name === "selection" ? "Why? " : `Why ${message.name}? `;
  $("why").replaceChildren(
    h(
      "div.row.spread",
      {},
      h("p", {}, h("b", {}, title), message.text, message.problem ? h("span.warn", {}, ` ${message.problem}`) : ""),
      button("Close", "clear", "Close", "Escape", close, { bare: true }),
    ),
    h(
      "div.groups",
      {},
      ...[
        group("Strongest support", message.support ?? []),
        group("Images that disagree", message.disagreement ?? []),
      ].filter(Boolean),
    ),
  );
  $("why").dataset.selected = message.selected;
  $("why").hidden = false;
  closed();
}

/** Close the panel if it explains another selection. @param {any} state */
export function closeStaleExplanation(state) {
  const panel = $("why");
  if (!panel.hidden && panel.dataset.selected !== String(state.selected)) panel.querySelector("button")?.click();
}

/** @param {any} entry */
function figure(entry) {
  const label = `${entry.name}, ${Math.round(100 * entry.share)}\u00a0% of the weight`;
  const enlarge = () => {
    const dialog = h(
      "dialog",
      { "aria-label": entry.name },
      h("img", { src: entry.url, alt: label }),
      h("p.soft", {}, label),
    );
    document.body.append(dialog);
    closesOutside(dialog);
    dialog.addEventListener("close", () => dialog.remove());
    dialog.showModal();
  };
  return h(
    "figure",
    {},
    entry.url
      ? h("img", {
          src: entry.url,
          alt: `Image ${label}`,
          tabindex: "0",
          role: "button",
          onclick: enlarge,
          onkeydown: (/** @type {KeyboardEvent} */ event) => event.key === "Enter" && enlarge(),
        })
      : h("p.soft", {}, "No image"),
    h("figcaption", {}, label, Number.isFinite(entry.agreement) ? `, agreement ${entry.agreement.toFixed(2)}` : ""),
  );
}
