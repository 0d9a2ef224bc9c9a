/** Pointer tools: select, rectangle, lasso, brush, more like this and measure. */
import { MOUSE, TOUCH } from "three";
import { $, h, throttled } from "./dom.js";
import { icon } from "./icons.js";

/** @typedef {"select" | "like" | "rectangle" | "lasso" | "brush" | "measure"} Tool */

/** @type {[Tool, any, string, string, string][]} Name, icon, label, key, hint. */
export const TOOLS = [
  ["select", "select", "Select", "V", "Click an object to select it. Shift adds; Ctrl or Alt removes."],
  [
    "rectangle",
    "rectangle",
    "Rectangle",
    "R",
    "Drag a rectangle. Shift adds; Ctrl or Alt removes. Drag with the right button to move the view.",
  ],
  ["lasso", "lasso", "Lasso", "L", "Draw around Gaussians to select them. Shift adds; Ctrl or Alt removes."],
  [
    "brush",
    "brush",
    "Brush",
    "B",
    "Paint over Gaussians to select them. The wheel changes the size. Shift adds; Ctrl or Alt removes.",
  ],
  ["like", "alike", "More like this", "K", "Click an object to find all similar Gaussians."],
  ["measure", "measure", "Measure", "M", "Click two points to measure the distance between them."],
];
const CLICK_SLACK = 5;
const SVG = "http://www.w3.org/2000/svg";

/** @param {string} name @param {Record<string, any>} attributes @param {string} [text] */
function shape(name, attributes, text) {
  const element = document.createElementNS(SVG, name);
  Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, String(value)));
  if (text) element.textContent = text;
  return element;
}

/** @param {{shiftKey: boolean, ctrlKey: boolean, altKey: boolean, metaKey: boolean}} event */
const modeOf = (event) =>
  event.shiftKey ? "add" : event.ctrlKey || event.altKey || event.metaKey ? "remove" : "select";

/** Pointer tools. They dispatch `hover` events with a ray or null, and `probe` events with a ray. */
export class Tools extends EventTarget {
  /**
   * @param {import("./view.js").View3D} view
   * @param {(action: string, value?: any) => number} act Function that sends an action.
   */
  constructor(view, act) {
    super();
    this.view = view;
    this.act = act;
    /** @type {Tool} */
    this.tool = "select";
    this.radius = 24;
    /** @type {number[][]} */
    this.points = [];
    /** @type {{position: number[]}[]} Ends of the measured line. */
    this.ends = [];
    this.drawing = false;
    this.element = view.element;
    this.hover = throttled((ray) => this.dispatchEvent(Object.assign(new Event("hover"), { ray })), 90);
    this.listen();
    this.bar();
  }

  bar() {
    const buttons = TOOLS.map(([tool, name, label, key, hint]) =>
      h(
        "button.tool",
        {
          type: "button",
          role: "radio",
          id: `tool-${tool}`,
          "aria-label": label,
          "aria-checked": "false",
          "data-tip": `${label}. ${hint}`,
          "data-keys": key,
          "aria-keyshortcuts": key,
          onclick: () => this.choose(tool),
        },
        icon(name),
      ),
    );
    $("tools").replaceChildren(...buttons);
    this.choose("select");
  }

  /** @param {Tool} tool */
  choose(tool) {
    this.tool = tool;
    this.drawing = false;
    this.points = [];
    this.ends = [];
    $("stage").dataset.tool = tool;
    for (const [name] of TOOLS) $(`tool-${name}`).setAttribute("aria-checked", String(name === tool));
    $("hint").textContent = TOOLS.find(([name]) => name === tool)?.[4] ?? "";
    const drags = tool === "rectangle" || tool === "lasso" || tool === "brush";
    this.view.controls.mouseButtons.LEFT = drags ? null : MOUSE.ROTATE;
    this.view.controls.touches.ONE = drags ? null : TOUCH.ROTATE;
    this.draw();
  }

  listen() {
    const { element } = this;
    let start = { x: 0, y: 0, id: -1 };
    const at = (/** @type {PointerEvent} */ event) => {
      const box = element.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    const drags = () => ["rectangle", "lasso", "brush"].includes(this.tool);
    element.addEventListener("pointerdown", (event) => {
      element.focus({ preventScroll: true });
      this.hover(null);
      if (event.button !== 0 || !event.isPrimary) {
        this.drawing = false;
        this.points = [];
        start.id = -1;
        return this.draw();
      }
      start = { x: event.clientX, y: event.clientY, id: event.pointerId };
      if (!drags()) return;
      this.drawing = true;
      this.points = [at(event)];
      this.draw();
    });
    element.addEventListener("pointermove", (event) => {
      this.pointer = at(event);
      if (this.drawing && event.pointerId === start.id) {
        if (this.tool === "rectangle") this.points = [this.points[0], this.pointer];
        else this.points.push(this.pointer);
      } else if (event.buttons === 0 && event.pointerType !== "touch")
        this.hover(this.view.ray(this.pointer[0], this.pointer[1]));
      if (this.drawing || this.tool === "brush" || this.tool === "measure") this.draw();
    });
    element.addEventListener("pointerup", (event) => {
      if (event.pointerId !== start.id) return;
      const moved = Math.hypot(event.clientX - start.x, event.clientY - start.y);
      if (this.drawing) this.finish(event);
      else if (moved < CLICK_SLACK) this.click(event, at(event));
      start.id = -1;
    });
    element.addEventListener("pointercancel", () => {
      this.drawing = false;
      this.points = [];
      this.draw();
    });
    element.addEventListener("pointerleave", () => {
      this.pointer = undefined;
      this.hover(null);
      this.draw();
    });
    element.addEventListener(
      "wheel",
      (event) => {
        if (this.tool !== "brush" || event.shiftKey) return;
        event.preventDefault();
        event.stopImmediatePropagation();
        this.radius = Math.min(200, Math.max(4, this.radius * (event.deltaY < 0 ? 1.15 : 1 / 1.15)));
        this.draw();
      },
      { capture: true, passive: false },
    );
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    for (const type of ["keydown", "keyup"]) {
      document.addEventListener(type, (event) => {
        const mode = modeOf(/** @type {KeyboardEvent} */ (event));
        $("stage").dataset.mode = mode;
      });
    }
    this.view.addEventListener("move", () => this.ends.length > 0 && this.draw());
  }

  /** Click in the middle of the scene. @param {KeyboardEvent} event */
  pickMiddle(event) {
    this.click(event, [this.view.width / 2, this.view.height / 2]);
  }

  /** @param {PointerEvent | KeyboardEvent} event @param {number[]} point */
  click(event, [x, y]) {
    const ray = this.view.ray(x, y);
    if (this.tool === "measure") {
      if (this.ends.length > 1) this.ends = [];
      /** @type {{position: number[]}} */
      const pending = { position: [] };
      this.ends.push(pending);
      this.dispatchEvent(
        Object.assign(new Event("probe"), {
          ray,
          found: (/** @type {number[] | null} */ position) => {
            if (position) pending.position = position;
            else this.ends = this.ends.filter((end) => end !== pending);
            this.draw();
          },
        }),
      );
      return;
    }
    this.act("pick", { ...ray, mode: this.tool === "like" ? "like" : modeOf(event) });
    if (this.tool === "like") this.choose("select");
  }

  /** @param {PointerEvent} event */
  finish(event) {
    const { points, tool } = this;
    this.drawing = false;
    this.points = [];
    const mode = modeOf(event);
    const camera = this.view.intrinsics();
    if (tool === "brush") this.act("brush", { points, radius: this.radius, camera, mode });
    else {
      const [[x, y], [u, v]] = [points[0], points[points.length - 1]];
      const polygon =
        tool === "rectangle"
          ? [
              [x, y],
              [u, y],
              [u, v],
              [x, v],
            ]
          : points;
      const spread = Math.max(
        ...[0, 1].map((i) => Math.max(...polygon.map((p) => p[i])) - Math.min(...polygon.map((p) => p[i]))),
      );
      if (polygon.length > 2 && spread > CLICK_SLACK) this.act("region", { polygon, camera, mode });
      else this.click(event, points[0]);
    }
    this.draw();
  }

  /** Draw the shapes of the current tool over the scene. */
  draw() {
    const parts = [];
    const { points, pointer } = this;
    if (this.tool === "brush" && pointer) {
      if (this.drawing) {
        const line = points.map((p) => p.join(",")).join(" ");
        parts.push(
          shape("polyline", {
            points: line,
            fill: "none",
            stroke: "rgb(255 255 255 / 35%)",
            "stroke-width": 2 * this.radius,
            "stroke-linecap": "round",
            "stroke-linejoin": "round",
          }),
        );
      }
      parts.push(shape("circle", { class: "cursor", cx: pointer[0], cy: pointer[1], r: this.radius }));
    } else if (this.drawing && this.tool === "rectangle" && points.length > 1) {
      const [[x, y], [u, v]] = points;
      parts.push(
        shape("rect", {
          class: "shape",
          x: Math.min(x, u),
          y: Math.min(y, v),
          width: Math.abs(u - x),
          height: Math.abs(v - y),
        }),
      );
    } else if (this.drawing && this.tool === "lasso") {
      parts.push(shape("polygon", { class: "shape", points: points.map((p) => p.join(",")).join(" ") }));
    } else if (this.tool === "measure") parts.push(...this.ruler());
    $("overlay").replaceChildren(...parts);
  }

  ruler() {
    const known = this.ends
      .filter((end) => end.position.length === 3)
      .map((end) => ({ ...this.view.project(end.position), end }));
    const parts = [];
    const [from, to] = known;
    if (from && to && from.visible && to.visible) {
      const length = Math.hypot(...from.end.position.map((value, i) => value - to.end.position[i]));
      parts.push(shape("line", { class: "ruler", x1: from.x, y1: from.y, x2: to.x, y2: to.y }));
      const label = `${length.toPrecision(3)} units`;
      parts.push(shape("text", { x: (from.x + to.x) / 2, y: (from.y + to.y) / 2 - 9 }, label));
      $("hint").textContent = `Distance: ${label}. Click again to measure another distance.`;
    }
    return [
      ...parts,
      ...known
        .filter((end) => end.visible)
        .map((end) => shape("circle", { class: "dot", cx: end.x, cy: end.y, r: 4.5 })),
    ];
  }
}
