/** Keyboard shortcuts and their help dialog. */
import { $, h } from "./dom.js";

/** @typedef {{keys: string, text: string, run: () => void}} Shortcut */

const POINTER = [
  ["Drag", "Turn"],
  ["Right drag, or two fingers", "Move"],
  ["Wheel, or pinch", "Zoom"],
  ["Click", "Select an object"],
  ["Shift + click", "Add an object"],
  ["Ctrl or Alt + click", "Remove an object"],
  ["Arrow keys", "Turn the focused scene"],
  ["+  −", "Zoom the focused scene"],
  ["Enter", "Select the object in the middle of the focused scene"],
];

/** @param {KeyboardEvent} event @returns {string} Pressed keys, such as "Ctrl+Shift+Z". */
function pressed(event) {
  const key = event.key.length === 1 ? event.key.toUpperCase() : event.key;
  const shifts = event.shiftKey && (event.key.length > 1 || /[A-Z]/.test(key));
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${shifts ? "Shift+" : ""}${key}`;
}

/** @param {Shortcut[]} shortcuts */
export function startShortcuts(shortcuts) {
  const known = new Map(shortcuts.flatMap((one) => one.keys.split(" or ").map((keys) => [keys, one.run])));
  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.defaultPrevented) return;
    const target = /** @type {HTMLElement} */ (event.target);
    const typing = target.matches("input:not([type=range]):not([type=checkbox]), textarea, select");
    const keys = pressed(event);
    if (typing && keys !== "Escape") return;
    const run = known.get(keys);
    if (!run || (document.querySelector("dialog[open]") && keys !== "?")) return;
    event.preventDefault();
    run();
  });
  const rows = [
    ...shortcuts.map(({ keys, text }) => h("li", {}, text, h("kbd", {}, keys.replace(" or ", " / ")))),
    ...POINTER.map(([keys, text]) => h("li", {}, text, h("kbd", {}, keys))),
  ];
  const close = h("button.btn", { type: "button", onclick: () => $("help").close() }, "Close");
  $("help").replaceChildren(
    h("div.row.spread", {}, h("h2", { id: "help-title" }, "Shortcuts"), close),
    h("ul.keys", {}, ...rows),
    h(
      "p.small",
      {},
      h("a", { href: "/assets/licenses.txt", target: "_blank" }, "Licenses of the packages in this page"),
    ),
  );
  closesOutside($("help"));
}

/** Close a dialog when the user clicks outside it. @param {HTMLDialogElement} dialog */
export function closesOutside(dialog) {
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
}
