/** Page that connects the session on the server with the scene, the panel and the tools. */
import { Connection } from "./connection.js";
import { $, fixed, h, saveBlob, throttled } from "./dom.js";
import { icon } from "./icons.js";
import { button, Panel } from "./panel.js";
import { createRenderer, isSoftware, SceneRenderer } from "./scene.js";
import { Search } from "./search.js";
import { startShortcuts } from "./shortcuts.js";
import { startTooltips, toast } from "./notices.js";
import { Stills } from "./stills.js";
import { Tools, TOOLS } from "./tools.js";
import { View3D } from "./view.js";
import { closeStaleExplanation, showExplanation } from "./why.js";

/** @type {[string, string, string][]} Color mode, label and tooltip. */
const MODES = [
  ["overlay", "Overlay", "Show answers over the gray scene, more opaque for higher relevancy."],
  ["heat", "Heat map", "Show the relevancy of all Gaussians."],
  ["prompts", "Prompts", "Show each answer in its own color."],
  ["rgb", "RGB", "Show the trained colors."],
  ["reliability", "Reliability", "Show the reliability R, which is high if many images agree on a feature."],
  ["pca", "Features", "Show three principal components of the features as colors."],
];
const OUTLINED = ["overlay", "prompts"];
/** Milliseconds to wait for the first image from the server before the scene is loaded. */
const STILL_WAIT = 2500;
const parameters = new URLSearchParams(location.search);

/** @returns {Promise<any[]>} */
async function fetchRuns() {
  for (let wait = 300; ; wait = Math.min(3000, 2 * wait)) {
    try {
      const answer = await fetch("/api/runs");
      if (answer.ok) {
        const { runs } = await answer.json();
        if (runs.length > 0) return runs;
      }
    } catch {
      /* the server has not started yet */
    }
    await new Promise((resolve) => setTimeout(resolve, wait));
  }
}

class Page {
  /** @param {any} run @param {any[]} runs */
  constructor(run, runs) {
    this.run = run;
    this.runs = runs;
    this.state = /** @type {any} */ (null);
    this.revision = 0;
    /** @type {Map<number, Element | null>} Pressed elements, by the number of the action. */
    this.anchors = new Map();
    /** @type {Map<number, (position: number[] | null) => void>} */
    this.probes = new Map();
    this.silent = new Set();
    /** True until a frame at full resolution has the current colors. */
    this.unfinished = true;
    this.act = this.act.bind(this);
    this.stale = false;
    this.view = new View3D($("canvas"), run.up, run.radius);
    /** Renderer of the page; null before it has started, and without WebGL 2. @type {SceneRenderer | null} */
    this.scene = null;
    this.started = this.software = false;
    this.connection = new Connection(run.id, () => this.greeting());
    this.stills = new Stills(
      this.view,
      (value) => this.connection.send("still", value),
      () => this.sendCamera(),
      () => this.changed(false),
    );
    this.search = new Search(this.act, run);
    this.panel = new Panel(this.act, run, {
      goToCamera: (i) => this.view.goToCamera(this.cameras[i]),
      sees: (point) => this.view.sees(point),
      cameras: [],
    });
    this.tools = new Tools(this.view, this.act);
    /** @type {any[]} */
    this.cameras = [];
    this.settled = throttled(() => this.remember(), 700);
    this.build();
    this.listen();
  }

  /**
   * Return the token of this tab, the link in the URL or the last link, and the access token.
   * @returns {{token: string, link: string, access: string}}
   */
  greeting() {
    const { memory } = this.connection;
    const here = memory.search === location.search;
    const access = parameters.get("access") ?? memory.access ?? "";
    this.connection.remember({ token: memory.token || crypto.randomUUID(), search: location.search, access });
    return {
      token: this.connection.memory.token,
      link: here && memory.link ? memory.link : location.search.slice(1),
      access,
    };
  }

  /**
   * @param {string} action @param {any} [value] @param {Element | null} [anchor] Pressed element.
   * @returns {number} Number of the action.
   */
  act(action, value = null, anchor = null) {
    performance.mark("press");
    const seq = this.connection.send(action, value);
    if (seq < 0) toast("Connection lost. Try again in a moment.", { kind: "error", anchor });
    this.anchors.set(seq, anchor);
    this.anchors.delete(seq - 100);
    if (action === "ask") this.asked = seq;
    else this.setStale(false);
    return seq;
  }

  /** Dim the old answer if a new query fails. @param {boolean} stale */
  setStale(stale) {
    if (this.stale === stale) return;
    this.stale = stale;
    $("answers").classList.toggle("stale", stale);
    this.scene?.setBlend(stale ? 0.3 : Number($("blend").value));
  }

  build() {
    document.title = `${this.run.name} · normlift`;
    if (this.runs.length > 1) {
      const choose = h(
        "select",
        { "aria-label": "Scene", onchange: () => (location.search = `?run=${encodeURIComponent(choose.value)}`) },
        ...this.runs.map((one) =>
          h(
            "option",
            { value: one.id, selected: one.id === this.run.id },
            this.runs.filter((other) => other.name === one.name).length > 1 ? one.id : one.name,
          ),
        ),
      );
      $("name").replaceChildren(choose);
    }
    $("modes").replaceChildren(
      ...MODES.map(([mode, label, tip], i) =>
        h(
          "button.tool",
          {
            type: "button",
            role: "radio",
            id: `mode-${mode}`,
            "aria-checked": "false",
            "data-tip": tip,
            "data-keys": String(i + 1),
            "aria-keyshortcuts": String(i + 1),
            onclick: (/** @type {Event} */ event) =>
              this.act("color_mode", mode, /** @type {Element} */ (event.currentTarget)),
          },
          label,
        ),
      ),
      h("input", {
        id: "blend",
        type: "range",
        min: 0,
        max: 1,
        step: 0.01,
        value: 1,
        "aria-label": "Blend between scene and answer",
        "data-tip": "Blend between scene and answer.",
        oninput: () => this.scene?.setBlend(Number($("blend").value)),
      }),
    );
    const tool = (
      /** @type {string} */ label,
      /** @type {any} */ name,
      /** @type {string} */ tip,
      /** @type {string | null} */ keys,
      /** @type {(anchor: Element) => void} */ press,
      more = {},
    ) =>
      h(
        "button.tool",
        {
          type: "button",
          "aria-label": label,
          "data-tip": tip,
          "data-keys": keys,
          "aria-keyshortcuts": keys,
          onclick: (/** @type {Event} */ event) => press(/** @type {Element} */ (event.currentTarget)),
          ...more,
        },
        icon(name),
      );
    $("corner").replaceChildren(
      tool("Start view", "home", "Go back to the first view.", "Home", () => this.home && this.view.go(this.home), {
        id: "do-home",
      }),
      tool("Compare", "compare", "Compare scene and answer with a divider.", "C", () => this.toggleCompare(), {
        id: "do-compare",
        "aria-pressed": "false",
      }),
      tool("Screenshot", "camera", "Save an image of this view.", "S", (anchor) => this.screenshot(anchor), {
        id: "do-screenshot",
      }),
      tool("Link", "link", "Copy a link to this search and view.", null, (anchor) => this.copyLink(anchor), {
        id: "do-link",
      }),
      tool("Dark or light", "theme", "Switch between dark and light.", "D", () => this.switchTheme(), {
        id: "do-theme",
      }),
      tool("Help", "help", "List all shortcuts.", "?", () => $("help").showModal(), { id: "do-help" }),
    );
    this.showBackground();
    startTooltips();
    startShortcuts(this.shortcuts());
  }

  /** @returns {import("./shortcuts.js").Shortcut[]} */
  shortcuts() {
    const press = (/** @type {string} */ id) => () => $(id) && !$(id).disabled && $(id).click();
    return [
      {
        keys: "/",
        text: "Search",
        run: () => {
          $("prompts").focus();
          $("prompts").select();
        },
      },
      { keys: "Escape", text: "Cancel, close, or return to Select", run: () => this.escape() },
      ...TOOLS.map(([name, , label, keys]) => ({ keys, text: label, run: () => this.tools.choose(name) })),
      { keys: "H", text: "Hide the selection", run: press("do-hide") },
      { keys: "I", text: "Isolate the selection", run: press("do-isolate") },
      { keys: "A", text: "Show all", run: press("do-show") },
      { keys: "X", text: "Invert the selection", run: press("do-invert") },
      { keys: "[", text: "Shrink the selection", run: press("do-shrink") },
      { keys: "]", text: "Grow the selection", run: press("do-grow") },
      { keys: "W", text: "Explain the selection", run: press("do-why") },
      { keys: "G", text: "Go to the selection", run: press("do-go") },
      { keys: "N", text: "Save a layer", run: press("do-layer") },
      { keys: "T", text: "Use the suggested threshold", run: press("do-suggested") },
      { keys: "Delete", text: "Clear search and selection", run: press("do-clear") },
      { keys: "Ctrl+Z", text: "Undo", run: press("do-undo") },
      { keys: "Ctrl+Shift+Z or Ctrl+Y", text: "Redo", run: press("do-redo") },
      ...MODES.map(([mode, label], i) => ({ keys: String(i + 1), text: `Show ${label}`, run: press(`mode-${mode}`) })),
      { keys: "C", text: "Compare scene and answer", run: press("do-compare") },
      { keys: "S", text: "Save a screenshot", run: press("do-screenshot") },
      { keys: "D", text: "Switch between dark and light", run: press("do-theme") },
      { keys: "Home", text: "Go back to the first view", run: press("do-home") },
      {
        keys: "?",
        text: "Show or hide this list",
        run: () => ($("help").open ? $("help").close() : $("help").showModal()),
      },
    ];
  }

  escape() {
    if (!$("cancel").hidden) this.search.cancel();
    else if (!$("why").hidden) $("why").querySelector("button")?.click();
    else this.tools.choose("select");
  }

  listen() {
    const on = (/** @type {string} */ type, /** @type {(message: any, event: any) => void} */ handle) =>
      this.connection.addEventListener(type, (/** @type {any} */ event) => handle(event.message, event));
    on("state", (state) => this.show(state));
    on("codes", (header, { payload }) => this.paint(header, payload));
    on("still", (header, { payload }) => {
      if (header.revision >= this.revision && (!this.scene || this.unfinished)) this.stills.show(payload);
    });
    on("busy", ({ text }) => this.search.setBusy(text));
    on("message", ({ text, kind, seq }) => {
      if (kind !== "busy") this.search.setBusy(null);
      if (kind === "error" && seq === this.asked) this.setStale(true);
      toast(text, { kind, anchor: this.anchors.get(seq) ?? (seq === this.connection.greeted ? $("ask") : null) });
    });
    on("camera", (view, event) => this.moveCamera(view, event));
    on("hover", (message) => this.showHover(message));
    on("explanation", (message) => showExplanation(message, () => this.view.resize()));
    on("download", ({ name, url, text, seq }) => {
      h("a", { href: url, download: name }).click();
      toast(text || `Downloaded ${name}`, { kind: "done", anchor: this.anchors.get(seq) });
    });
    on("token", (message) => this.receiveToken(message));
    this.connection.addEventListener("status", (/** @type {any} */ event) =>
      this.showStatus(event.online, event.reason),
    );
    this.tools.addEventListener("hover", (/** @type {any} */ event) => {
      this.pointed = event.ray && this.state ? this.connection.send("hover", event.ray) : 0;
      if (!event.ray) $("hover").hidden = true;
    });
    this.tools.addEventListener("probe", (/** @type {any} */ event) =>
      this.probes.set(this.connection.send("hover", event.ray), event.found),
    );
    const rest = throttled(() => this.sendCamera(), 250);
    this.view.addEventListener("move", () => {
      $("hover").hidden = true;
      rest();
      if (this.scene && (this.scene.finished || !this.software)) this.stills.hide();
      else if (this.home) this.stills.request(true);
    });
    new ResizeObserver(() => this.view.resize()).observe($("stage"));
    $("canvas").addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => this.steer(event));
    $("stage").addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
      this.pointer = [event.clientX, event.clientY];
    });
    this.listenDivider();
    fetch(`/api/runs/${encodeURIComponent(this.run.id)}/cameras`)
      .then((answer) => answer.json())
      .then(({ cameras }) => {
        this.cameras = this.panel.scene.cameras = cameras;
      });
  }

  /** Start the renderer while the server renders the first image. */
  async start() {
    this.started = true;
    const renderer = createRenderer($("canvas"));
    if (!renderer) {
      $("loading").querySelector("p").textContent =
        "This browser does not support WebGL 2, so the server renders the scene.";
      $("blend").hidden = $("do-compare").hidden = this.stills.fine = true;
      return this.stills.request(false);
    }
    this.scene = new SceneRenderer(renderer, this.view, () => this.stills.shown);
    this.scene.addEventListener("frame", (/** @type {any} */ event) => this.drawn(event.full));
    this.scene.addEventListener("lost", () => {
      toast("The graphics driver has stopped. Reload the page to see the scene again.", { kind: "error", seconds: 60 });
    });
    this.showBackground();
    this.software = isSoftware(renderer);
    document.documentElement.classList.toggle("software", this.software);
    if (this.software) await this.firstStill();
    const digest = this.run.digest ? `?digest=${encodeURIComponent(this.run.digest)}` : "";
    try {
      await this.scene.load(`/api/runs/${encodeURIComponent(this.run.id)}/geometry${digest}`, (share) => {
        $("loading").querySelector("span").style.width = `${8 + 87 * share}%`;
      });
    } catch (error) {
      $("loading").querySelector("p").textContent =
        `The scene cannot be loaded (${error}). Reload the page to try again.`;
      return;
    }
    if (this.waiting) this.scene.paint(this.waiting.payload, this.waiting.palette);
  }

  /** Wait a moment for an image from the server, because a software renderer would delay this image. */
  firstStill() {
    return new Promise((resolve) => {
      $("still").addEventListener("load", resolve, { once: true });
      setTimeout(resolve, STILL_WAIT);
    });
  }

  /** @param {boolean} full */
  drawn(full) {
    if (!this.scene?.spark.activeSplats) return;
    $("canvas").classList.add("ready");
    $("loading").hidden = true;
    if (full) this.stills.hide();
    this.changed(full);
  }

  /** Measure the time since the last press, or since the page was opened. @param {boolean} full */
  changed(full) {
    const start = performance.getEntriesByName("press").at(-1)?.startTime ?? 0;
    if (this.unfinished) performance.measure(full ? "picture" : "coarse", { start });
    this.unfinished &&= !full;
  }

  /** @param {any} header @param {Uint8Array} payload */
  paint(header, payload) {
    this.revision = header.revision;
    if (this.scene?.splats) this.scene.paint(payload, header.palette);
    else this.waiting = { payload: payload.slice(), palette: header.palette };
    const press = performance.getEntriesByName("press").at(-1);
    if (press) performance.measure("colors", { start: press.startTime });
    this.unfinished = true;
    if (!this.started) this.start();
    else if (!this.scene || (this.software && this.scene.needsStill)) this.stills.request(false);
  }

  /** @param {any} state */
  show(state) {
    if (state.seq === this.asked && this.state?.revision !== state.revision && state.step !== this.state?.step)
      this.setStale(false);
    this.state = state;
    this.search.show(state);
    this.panel.show(state);
    closeStaleExplanation(state);
    for (const [mode] of MODES) $(`mode-${mode}`).setAttribute("aria-checked", String(mode === state.color_mode));
    this.scene?.setOutline(OUTLINED.includes(state.color_mode) && state.selected > 0);
    this.showLegend(state);
    if (state.details) this.settled();
  }

  /** @param {any} state */
  showLegend(state) {
    const { legend } = state;
    $("legend").hidden = !legend;
    if (!legend) return;
    const stops = legend.colors.map((/** @type {number[]} */ rgb) => `rgb(${rgb.join(" ")})`).join(", ");
    $("legend").replaceChildren(
      h("span", {}, legend.label),
      h("div.ramp", { style: `background: linear-gradient(to right, ${stops})` }),
      h("div.row.spread.num", {}, h("span", {}, fixed(legend.low)), h("span", {}, fixed(legend.high))),
    );
  }

  /** @param {any} message */
  showHover({ seq, label, relevancy, reliability, object, position }) {
    const probe = this.probes.get(seq);
    if (probe) {
      this.probes.delete(seq);
      probe(position);
      if (!position) toast("This position has no object. Click an object.", {});
      return;
    }
    if (seq !== this.pointed || !this.pointer) return;
    const known = reliability !== null && reliability !== undefined;
    $("hover").hidden = !known;
    if (!known) return;
    const facts = [
      relevancy === null ? "" : `relevancy ${fixed(relevancy)}`,
      `R ${fixed(reliability)}`,
      object?.name ?? "",
    ];
    $("hover").replaceChildren(...(label ? [h("b", {}, label)] : []), facts.filter(Boolean).join(" · "));
    const stage = $("stage").getBoundingClientRect();
    const x = Math.min(this.pointer[0] - stage.left + 16, stage.width - 220);
    const y = Math.min(this.pointer[1] - stage.top + 18, stage.height - 60);
    $("hover").style.transform = `translate(${x}px, ${y}px)`;
  }

  /** @param {any} view @param {any} event */
  moveCamera(view, event) {
    const target = { ...view, fov: view.fov ? (180 / Math.PI) * view.fov : undefined };
    const greeting = event.message.seq === this.connection.greeted;
    if (greeting && this.home) return this.sendCamera();
    if (!this.home) {
      this.home = { ...target, look_at: view.look_at };
      return this.view.go(target, false);
    }
    this.view.go(target);
  }

  sendCamera() {
    if (!this.home) return;
    const view = this.view.view();
    this.connection.send("camera", { ...view, fov: (Math.PI / 180) * view.fov });
  }

  /** Store the camera and the link, so that the page can restore them after a restart of the server. */
  remember() {
    this.sendCamera();
    this.silent.add(this.connection.send("link"));
  }

  /** @param {any} message */
  receiveToken({ token, link, seq }) {
    this.connection.remember({ ...(token ? { token } : {}), ...(link ? { link } : {}) });
    if (token || this.silent.delete(seq) || !link) return;
    const run = this.runs.length > 1 ? `run=${encodeURIComponent(this.run.id)}&` : "";
    history.replaceState(null, "", `?${run}${link}`);
    this.connection.remember({ search: location.search });
    const anchor = this.anchors.get(seq);
    const done = () => toast("Link copied", { kind: "done", anchor });
    const failed = () =>
      toast("The link is now the address of this page. Copy it from the address bar.", { kind: "done", anchor });
    navigator.clipboard ? navigator.clipboard.writeText(location.href).then(done, failed) : failed();
  }

  /** @param {Element} anchor */
  copyLink(anchor) {
    this.sendCamera();
    this.act("link", null, anchor);
  }

  /** @param {Element} anchor */
  async screenshot(anchor) {
    const name = `${this.run.name}.png`.replace(/[^\w.-]+/g, "_");
    const blob = this.scene ? await this.scene.screenshot() : await this.stills.blob();
    if (!blob) return toast("The page has no image yet. Try again in a moment.", { kind: "error", anchor });
    saveBlob(blob, name);
    toast(`Downloaded ${name}`, { kind: "done", anchor });
  }

  /** @param {boolean} online @param {string} reason Reason from the server for closing the connection. */
  showStatus(online, reason) {
    clearTimeout(this.offlineTimer);
    if (online) {
      $("offline").hidden = true;
      return;
    }
    this.search.setBusy(null);
    this.offlineTimer = setTimeout(() => {
      $("offline").textContent = reason ? `Connection closed: ${reason}` : "Connection lost. Reconnecting …";
      $("offline").hidden = false;
    }, 600);
  }

  toggleCompare() {
    const on = $("divider").hidden;
    $("divider").hidden = !on;
    $("do-compare").setAttribute("aria-pressed", String(on));
    this.setDivider(on ? 0.5 : null);
  }

  /** @param {number | null} share Position of the divider, as a fraction of the width. */
  setDivider(share) {
    this.scene?.setSplit(share === null ? -2 : 2 * share - 1);
    if (share === null) return;
    $("divider").style.left = `${100 * share}%`;
    $("divider").setAttribute("aria-valuenow", String(Math.round(100 * share)));
  }

  listenDivider() {
    const divider = $("divider");
    const move = (/** @type {number} */ x) => {
      const stage = $("stage").getBoundingClientRect();
      this.setDivider(Math.min(1, Math.max(0, (x - stage.left) / stage.width)));
    };
    divider.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) =>
      divider.setPointerCapture(event.pointerId),
    );
    divider.addEventListener(
      "pointermove",
      (/** @type {PointerEvent} */ event) => divider.hasPointerCapture(event.pointerId) && move(event.clientX),
    );
    divider.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const step = event.key === "ArrowLeft" ? -0.02 : event.key === "ArrowRight" ? 0.02 : 0;
      if (step !== 0)
        this.setDivider(Math.min(1, Math.max(0, Number(divider.getAttribute("aria-valuenow")) / 100 + step)));
    });
  }

  /** @param {KeyboardEvent} event */
  steer(event) {
    if (event.ctrlKey || event.metaKey) return;
    /** @type {Record<string, number[]>} */
    const turns = { ArrowLeft: [0.12, 0], ArrowRight: [-0.12, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
    const turn = turns[event.key];
    if (turn) this.view.turn(turn[0], turn[1]);
    else if (event.key === "+" || event.key === "=") this.view.zoom(1 / 1.15);
    else if (event.key === "-") this.view.zoom(1.15);
    else if (event.key === "Enter") this.tools.pickMiddle(event);
    else return;
    event.preventDefault();
  }

  switchTheme() {
    const theme = document.documentElement.dataset.theme === "light" ? "dark" : "light";
    localStorage.setItem("normlift:theme", theme);
    document.documentElement.dataset.theme = theme;
    this.showBackground();
  }

  showBackground() {
    const background = getComputedStyle(document.documentElement).getPropertyValue("--scene").trim();
    this.scene?.setBackground(background);
    this.stills.setBackground(background);
  }
}

document.documentElement.dataset.theme =
  localStorage.getItem("normlift:theme") ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
const runs = await fetchRuns();
/** @type {any} */ (window).page = new Page(runs.find((one) => one.id === parameters.get("run")) ?? runs[0], runs);
