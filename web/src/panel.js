/** Panel with selection, objects, layers, history, cameras and advanced settings. */
import { $, BY_HAND, counted, cssColor, fill, fixed, grouped, h, throttled } from "./dom.js";
import { icon } from "./icons.js";

const COLORMAPS = ["viridis", "cividis", "inferno", "magma", "turbo"];
const RULES = [
  ["auto", "Automatic"],
  ["contrast", "Contrast with unrelated words"],
  ["lerf", "LERF, contrast with each negative"],
  ["margin", "Margin over negatives"],
  ["cosine", "Cosine"],
];

/** @typedef {(action: string, value?: any, anchor?: Element | null) => number} Act */

/**
 * @param {string} label @param {any} name Icon. @param {string} tip @param {string | null} keys
 * @param {(button: Element) => void} press @param {Record<string, any>} [more]
 */
export function button(label, name, tip, keys, press, more = {}) {
  const bare = more.bare === true;
  return h(
    bare ? "button.btn.square" : "button.btn",
    {
      type: "button",
      "data-tip": tip,
      "data-keys": keys,
      "aria-keyshortcuts": keys,
      "aria-label": bare ? label : null,
      onclick: (/** @type {Event} */ event) => press(/** @type {Element} */ (event.currentTarget)),
      ...more,
      bare: null,
    },
    name && icon(name),
    !bare && label,
  );
}

/** @param {string} id @param {string} title @param {string} tip @param {Node[]} children @param {boolean} [open] */
function fold(id, title, tip, children, open = false) {
  return h(
    "details",
    { id: `fold-${id}`, open },
    h("summary", { "data-tip": tip }, title, h("span.count", { id: `${id}-count` })),
    h("div", {}, ...children),
  );
}

export class Panel {
  /**
   * @param {Act} act
   * @param {any} run
   * @param {{goToCamera: (index: number) => void, sees: (point: number[]) => boolean, cameras: any[]}} scene
   */
  constructor(act, run, scene) {
    this.act = act;
    this.run = run;
    this.scene = scene;
    this.state = /** @type {any} */ (null);
    this.dragging = false;
    this.sendThreshold = throttled((value) => act("threshold", value), 60);
    this.sendReliability = throttled((value) => act("reliability", value), 60);
    this.build();
  }

  build() {
    const { act, run } = this;
    const simple =
      (/** @type {string} */ action, /** @type {any} */ value = null) =>
      (/** @type {Element} */ anchor) =>
        act(action, value, anchor);
    $("panel").replaceChildren(
      h("header", {}, h("h1", { id: "name" }, run.name), h("p.soft.small.num", { id: "facts" })),
      h(
        "section",
        { id: "selection", "aria-label": "Selection" },
        h(
          "div",
          { role: "status" },
          h("p.big.num", { id: "selected" }),
          h("p.soft.small.num", { id: "selected-more" }),
          h("p.warn.small", { id: "warning" }),
        ),
        h(
          "div",
          { id: "selection-actions" },
          button("Hide", null, "Hide the selected Gaussians.", "H", simple("hide"), { id: "do-hide" }),
          button(
            "Isolate",
            null,
            "Show only the selected Gaussians.",
            "I",
            (anchor) => this.isolate(null, this.state.objects ?? [], anchor),
            { id: "do-isolate" },
          ),
          button(
            "Show all",
            null,
            "Show all hidden Gaussians, except those of hidden layers.",
            "A",
            simple("show_all"),
            { id: "do-show" },
          ),
          button("Invert", null, "Select all other visible Gaussians.", "X", simple("invert"), { id: "do-invert" }),
          button("Why?", null, "Show the images that support this selection.", "W", simple("explain"), {
            id: "do-why",
          }),
          button(
            "Go to",
            null,
            "Move the camera to the first object in the list.",
            "G",
            (anchor) => this.goToFirst(anchor),
            { id: "do-go" },
          ),
          button("Clear", null, "Clear search and selection.", "Delete", simple("clear"), { id: "do-clear" }),
          button("Layer", null, "Save the selection as a layer.", "N", (anchor) => this.addLayer(anchor), {
            id: "do-layer",
          }),
        ),
        h(
          "div.row.spread",
          {},
          h(
            "div.row",
            { role: "group", "aria-label": "History" },
            button("Undo", "undo", "Undo the last step.", "Ctrl+Z", simple("undo"), { id: "do-undo", bare: true }),
            button("Redo", "redo", "Redo the last undone step.", "Ctrl+Shift+Z", simple("redo"), {
              id: "do-redo",
              bare: true,
            }),
          ),
          h(
            "div.row",
            { role: "group", "aria-label": "Size of the selection" },
            h("span.soft.small", {}, "Grow"),
            button("Shrink", "shrink", "Shrink the selection.", "[", (anchor) => this.grow(-1, anchor), {
              id: "do-shrink",
              bare: true,
            }),
            h("span.num", { id: "grow" }, "0"),
            button("Grow", "grow", "Grow the selection to similar neighbors.", "]", (anchor) => this.grow(1, anchor), {
              id: "do-grow",
              bare: true,
            }),
          ),
        ),
        h(
          "div.row",
          { role: "group", "aria-label": "Download" },
          h("span.soft.small", {}, "Download"),
          button(
            "PLY",
            null,
            "Download the selection as a PLY file of Gaussians.",
            null,
            simple("export", { format: "ply" }),
            { id: "save-ply" },
          ),
          button("GLB", null, "Download the selection as a GLB file.", null, simple("export", { format: "glb" }), {
            id: "save-glb",
          }),
          button(
            "Masks",
            null,
            "Download a mask of the selection for each training image.",
            null,
            simple("export", { format: "masks" }),
            { id: "save-masks" },
          ),
        ),
      ),
      h(
        "section",
        { id: "answer", "aria-label": "Answer", hidden: true },
        h(
          "div.row.spread",
          {},
          h("h2", { id: "threshold-title" }, "Threshold"),
          button("Use suggested", null, "Use the threshold at the dashed line.", "T", simple("suggested"), {
            id: "do-suggested",
          }),
        ),
        h("div", { id: "histograms" }),
        h(
          "label.field",
          {},
          h("span", {}, "Minimum relevancy", h("b.num", { id: "threshold-value" })),
          h("input", {
            id: "threshold",
            type: "range",
            min: 0,
            max: 1,
            step: 0.005,
            oninput: () => this.slid("threshold"),
            onchange: () => this.rested(),
            "data-tip": "Select Gaussians above this relevancy.",
          }),
        ),
        h(
          "label.field",
          {},
          h("span", {}, "Minimum reliability R", h("b.num", { id: "reliability-value" })),
          h("input", {
            id: "reliability",
            type: "range",
            min: 0,
            max: 1,
            step: 0.01,
            value: 0,
            oninput: () => this.slid("reliability"),
            onchange: () => this.rested(),
            "data-tip": "Deselect Gaussians whose reliability is below this number.",
          }),
        ),
      ),
      fold("objects", "Objects", "Separate parts of the selection.", [h("ul.list", { id: "objects" })], true),
      fold("layers", "Layers", "Selections that you have saved.", [
        h("p.soft.small", { id: "no-layers" }, "Save a selection as a layer to restore it later."),
        h("ul.list", { id: "layers" }),
      ]),
      fold("history", "History", "All steps. Click a step to go to it.", [h("ol.list", { id: "history" })]),
      fold("cameras", "Training cameras", "Move the camera to where an image was taken.", [
        h("div", { id: "cameras" }),
      ]),
      fold("advanced", "Advanced", "Negative prompts, rule, colormap, floaters and saved prompts.", this.advanced()),
    );
    $("facts").textContent =
      `${counted(run.num_gaussians, "Gaussian")} · ${counted(run.num_views, "image")}` +
      (run.num_left_out > 0 ? ` · ${grouped(run.num_left_out)} not drawn, to keep the browser responsive` : "");
    $("fold-cameras").addEventListener("toggle", () => this.showCameras(), { once: true });
  }

  advanced() {
    const { act, run } = this;
    const options = (/** @type {string[][]} */ rows) => rows.map(([value, text]) => h("option", { value }, text));
    return [
      h(
        "label.field",
        {},
        h("span", {}, "Negative prompts"),
        h("input", {
          id: "negatives",
          type: "text",
          placeholder: "Automatic",
          "data-tip": "Prompts to compare with, separated by commas. Leave empty for the default of the encoder.",
          onchange: () => {
            const texts = $("negatives")
              .value.split(",")
              .map((/** @type {string} */ text) => text.trim())
              .filter(Boolean);
            act("negatives", texts.length > 0 ? texts : null, $("negatives"));
          },
        }),
      ),
      h(
        "label.field",
        {},
        h("span", {}, "Relevancy rule"),
        h(
          "select",
          {
            id: "rule",
            "data-tip": "Formula that compares a Gaussian with prompts and negative prompts.",
            onchange: () => act("rule", $("rule").value, $("rule")),
          },
          ...options(RULES),
        ),
      ),
      h(
        "label.field",
        {},
        h("span", {}, "Colormap"),
        h(
          "select",
          {
            id: "colormap",
            "data-tip": "Colors of the heat map.",
            onchange: () => act("colormap", $("colormap").value, $("colormap")),
          },
          ...options(COLORMAPS.map((name) => [name, name])),
        ),
      ),
      h(
        "div.row",
        {},
        button(
          "Select likely floaters",
          null,
          "Select Gaussians that are probably not part of a surface. Check them before you hide them.",
          null,
          (anchor) => act("floaters", null, anchor),
          { id: "do-floaters" },
        ),
        button(
          "Remove weak evidence",
          null,
          "Remove Gaussians with weak evidence from the selection.",
          null,
          (anchor) => act("remove_weak", null, anchor),
          { id: "do-weak" },
        ),
        !run.read_only &&
          button(
            "Save prompts",
            null,
            "Save these prompts in the run, in addition to those already saved.",
            null,
            (anchor) => act("save_prompts", { replace: false }, anchor),
            { id: "do-save" },
          ),
      ),
    ];
  }

  /** @param {Element} anchor */
  goToFirst(anchor) {
    const first = this.state?.objects?.[0];
    if (first) this.act("go_to", { id: first.id }, anchor);
  }

  /**
   * Hide everything else, and move the camera to the first object if none is in view.
   * @param {number[] | null} ids Ids of objects; null for the selection.
   * @param {{id: number, center: number[]}[]} objects @param {Element} anchor
   */
  isolate(ids, objects, anchor) {
    this.act("isolate", ids, anchor);
    if (objects.length > 0 && !objects.some((one) => this.scene.sees(one.center))) {
      this.act("go_to", { id: objects[0].id }, anchor);
    }
  }

  /** @param {Element} anchor */
  addLayer(anchor) {
    const names = new Set((this.state?.layers ?? []).map((/** @type {any} */ layer) => layer.name));
    const chosen = this.state?.by_hand ? "" : (this.state?.line ?? "").slice(0, 40);
    let name = chosen || "Selection";
    for (let n = 2; names.has(name); n++) name = `${chosen || "Selection"} ${n}`;
    $("fold-layers").open = true;
    this.act("layer_add", { name }, anchor);
  }

  /** @param {number} steps @param {Element | null} anchor */
  grow(steps, anchor) {
    this.act("grow", (this.state?.grow ?? 0) + steps, anchor);
  }

  /** @param {"threshold" | "reliability"} name */
  slid(name) {
    this.dragging = true;
    const value = Number($(name).value);
    $(`${name}-value`).textContent = fixed(value);
    if (name === "threshold") this.moveLine(value);
    (name === "threshold" ? this.sendThreshold : this.sendReliability)(value);
  }

  rested() {
    this.dragging = false;
  }

  /** @param {number} value */
  moveLine(value) {
    for (const line of document.querySelectorAll("#histograms line.now")) {
      const svg = /** @type {SVGElement} */ (line.closest("svg"));
      const x = (100 * (value - Number(svg.dataset.low))) / (Number(svg.dataset.high) - Number(svg.dataset.low));
      line.setAttribute("x1", String(x));
      line.setAttribute("x2", String(x));
    }
  }

  /** @param {any} state */
  show(state) {
    const before = this.state;
    if (!state.details && before) {
      state = {
        ...state,
        histogram: state.prompts.length ? before.histogram : null,
        objects: before.objects,
        suggested: before.suggested,
      };
    }
    this.state = state;
    this.showSelection(state);
    this.showAnswer(state);
    if (state.objects) this.showObjects(state);
    this.showLayers(state);
    this.showHistory(state);
    $("rule").value = state.rule ?? "auto";
    $("colormap").value = state.colormap;
    if (document.activeElement !== $("negatives")) $("negatives").value = (state.negatives ?? []).join(", ");
    if (state.used_negatives?.length)
      $("negatives").placeholder = `Automatic: ${state.used_negatives.slice(0, 4).join(", ")} …`;
  }

  /** @param {any} state */
  showSelection(state) {
    const { selected, selected_visible: visible, hidden, history, step } = state;
    const some = selected > 0;
    $("selected").textContent = some ? `${grouped(selected)} selected` : "Nothing selected";
    const parts = [];
    if (some && visible !== selected)
      parts.push(visible === 0 ? "No visible objects selected" : `${grouped(visible)} visible`);
    if (hidden > 0) parts.push(`${grouped(hidden)} hidden`);
    if (some && state.by_hand) parts.push("by hand");
    if (some) parts.unshift(`of ${counted(state.total, "Gaussian")}`);
    $("selected-more").textContent = parts.join(" · ") || "Search, or click an object.";
    $("warning").textContent = state.warning ?? "";
    for (const id of [
      "do-hide",
      "do-isolate",
      "do-why",
      "do-go",
      "do-layer",
      "do-grow",
      "do-shrink",
      "save-ply",
      "save-glb",
      "save-masks",
    ])
      $(id).disabled = !some;
    $("do-show").disabled = hidden === 0;
    $("do-clear").disabled = !some && state.prompts.length === 0;
    $("do-undo").disabled = step === 0;
    $("do-redo").disabled = step >= history.length - 1;
    $("grow").textContent = state.grow > 0 ? `+${state.grow}` : String(state.grow ?? 0).replace("-", "−");
  }

  /** @param {any} state */
  showAnswer(state) {
    const asked = state.threshold !== null && state.threshold !== undefined && !state.by_hand;
    $("answer").hidden = !asked;
    if (!asked) return;
    const rows = state.histogram ?? [];
    const low = Math.min(0, ...rows.map((/** @type {any} */ row) => row.low));
    const high = Math.max(state.threshold, ...rows.map((/** @type {any} */ row) => row.high), rows.length > 0 ? 0 : 1);
    Object.assign($("threshold"), { min: low.toFixed(3), max: (high + 0.001).toFixed(3) });
    if (!this.dragging) {
      $("threshold").value = state.threshold;
      $("threshold-value").textContent = fixed(state.threshold);
      $("reliability").value = state.reliability;
      $("reliability-value").textContent = fixed(state.reliability);
    }
    $("do-suggested").disabled =
      state.suggested === null || state.suggested === undefined || Math.abs(state.suggested - state.threshold) < 1e-4;
    const shown =
      state.shown === null
        ? rows.slice(0, 3)
        : rows.filter(
            (/** @type {any} */ row) =>
              row.text === state.prompts.filter((/** @type {any} */ one) => !one.error)[state.shown]?.text,
          );
    fill(
      $("histograms"),
      shown.map((/** @type {any} */ row) => histogram(row, state.threshold, low, high)),
    );
    if (this.dragging) this.moveLine(Number($("threshold").value));
  }

  /** @param {any} state */
  showObjects(state) {
    const { act } = this;
    $("objects-count").textContent = state.objects.length
      ? grouped(state.objects.length + (state.more_objects ?? 0))
      : "";
    const colors = new Map(state.prompts.map((/** @type {any} */ one) => [one.text, one.color]));
    const rows = state.objects.map((/** @type {any} */ one) => {
      const facts = `${grouped(one.count)} · ${one.evidence.split(" (")[0]}`;
      const small = (
        /** @type {string} */ label,
        /** @type {any} */ name,
        /** @type {string} */ action,
        /** @type {any} */ value,
      ) =>
        button(`${label} ${one.name}`, name, label, null, (anchor) => act(action, value, anchor), {
          bare: true,
          "data-key": `${label}-${one.name}`,
        });
      return h(
        "li",
        { "data-id": one.id },
        h("span.swatch", { style: `background: ${cssColor((!state.by_hand && colors.get(one.text)) || BY_HAND)}` }),
        h(
          "button.main",
          {
            type: "button",
            "data-tip": "Select this object. Hold Shift to add it, or Ctrl to remove it.",
            "data-key": `object-${one.name}`,
            onclick: (/** @type {MouseEvent} */ event) =>
              act(
                "object",
                { id: one.id, mode: event.shiftKey ? "add" : event.ctrlKey || event.metaKey ? "remove" : "select" },
                /** @type {Element} */ (event.currentTarget),
              ),
          },
          h("span", {}, one.name),
          h("span.soft.small.num", {}, facts),
        ),
        small("Go to", "go", "go_to", { id: one.id }),
        button(`Isolate ${one.name}`, "isolate", "Isolate", null, (anchor) => this.isolate([one.id], [one], anchor), {
          bare: true,
          "data-key": `Isolate-${one.name}`,
        }),
        small("Hide", "hide", "hide", [one.id]),
        small("Download", "download", "export", { format: "ply", object: one.id }),
      );
    });
    const note =
      state.more_objects > 0 ? [h("li.soft.small", {}, `and ${grouped(state.more_objects)} more`)] : [];
    fill(
      $("objects"),
      rows.length ? [...rows, ...note] : [h("li.soft.small", {}, "This list shows the objects of the selection.")],
    );
  }

  /** @param {any} state */
  showLayers(state) {
    const { act } = this;
    const layers = state.layers ?? [];
    $("layers-count").textContent = layers.length || "";
    $("no-layers").hidden = layers.length > 0;
    fill(
      $("layers"),
      layers.map((/** @type {any} */ one) => {
        const { name, visible } = one;
        return h(
          "li",
          {},
          h(
            "button.main",
            {
              type: "button",
              "data-tip": "Select this layer.",
              "data-key": `layer-${name}`,
              onclick: () => act("layer_select", { name }),
            },
            h("span", {}, name),
            h("span.soft.small.num", {}, counted(one.count, "Gaussian")),
          ),
          button(
            visible ? `Hide ${name}` : `Show ${name}`,
            visible ? "show" : "hide",
            visible ? "Hide this layer." : "Show this layer.",
            null,
            (anchor) => act("layer_visible", { name, visible: !visible }, anchor),
            { bare: true, "aria-pressed": String(!visible), "data-key": `eye-${name}` },
          ),
          button(
            `Remove ${name}`,
            "trash",
            "Remove this layer from the list.",
            null,
            (anchor) => act("layer_remove", { name }, anchor),
            { bare: true, "data-key": `trash-${name}` },
          ),
        );
      }),
    );
  }

  /** @param {any} state */
  showHistory(state) {
    const { history, step } = state;
    $("history-count").textContent = history.length > 1 ? `${step} of ${history.length - 1}` : "";
    fill(
      $("history"),
      history.map((/** @type {any} */ one, /** @type {number} */ i) =>
        h(
          "li",
          {},
          h(
            `button.main${i > step ? ".undone" : ""}`,
            {
              type: "button",
              "data-tip": "Go to this step.",
              "data-key": `step-${i}`,
              "aria-current": i === step ? "step" : null,
              onclick: (/** @type {Event} */ event) =>
                this.act("go_to_step", i, /** @type {Element} */ (event.currentTarget)),
            },
            h("span", {}, one.text),
          ),
        ),
      ),
    );
    $("history").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  }

  showCameras() {
    const { cameras } = this.scene;
    const step = Math.max(1, Math.ceil(cameras.length / 48));
    const base = `/api/runs/${encodeURIComponent(this.run.id)}/images`;
    $("cameras").replaceChildren(
      ...cameras
        .map((camera, i) => ({ camera, i }))
        .filter(({ i }) => i % step === 0)
        .map(({ camera, i }) =>
          h(
            "button",
            {
              type: "button",
              "data-tip": camera.name,
              "aria-label": `View of ${camera.name}`,
              onclick: () => this.scene.goToCamera(i),
            },
            h("img", { loading: "lazy", alt: "", src: `${base}/${i}?max_size=160` }),
          ),
        ),
    );
  }
}

/** @param {any} row @param {number} threshold @param {number} low @param {number} high */
function histogram(row, threshold, low, high) {
  const space = "http://www.w3.org/2000/svg";
  const make = (/** @type {string} */ name, /** @type {Record<string, any>} */ attributes) => {
    const element = document.createElementNS(space, name);
    Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, String(value)));
    return element;
  };
  const x = (/** @type {number} */ value) => (100 * (value - low)) / (high - low || 1);
  const svg = make("svg", {
    viewBox: "0 0 100 40",
    preserveAspectRatio: "none",
    class: "histogram",
    role: "img",
    "aria-label": `Histogram of the relevancy for ${row.text}`,
    "data-low": low,
    "data-high": high,
  });
  const top = Math.max(1, ...row.counts.map((/** @type {number} */ count) => Math.log1p(count)));
  const width = (row.high - row.low) / row.counts.length;
  row.counts.forEach((/** @type {number} */ count, /** @type {number} */ i) => {
    const start = row.low + i * width;
    const height = (38 * Math.log1p(count)) / top;
    const inside = start + width > threshold;
    const style = inside && row.color ? `fill: ${cssColor(row.color)}` : "";
    svg.append(
      make("rect", {
        x: x(start),
        y: 40 - height,
        width: Math.max(0, x(start + width) - x(start) - 0.4),
        height,
        class: inside ? "in" : "",
        style,
      }),
    );
  });
  const line = (/** @type {number} */ value, /** @type {string} */ name) =>
    make("line", { x1: x(value), x2: x(value), y1: 0, y2: 40, class: name });
  if (Number.isFinite(row.suggested)) svg.append(line(row.suggested, "suggested"));
  svg.append(line(threshold, "now"));
  return h(
    "div",
    {},
    h(
      "p.soft.small",
      {},
      row.text,
      row.warning ? h("span.warn", {}, ` · ${row.warning.replace(`${row.text}: `, "")}`) : "",
    ),
    svg,
  );
}
