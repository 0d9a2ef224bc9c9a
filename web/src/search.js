/** Search box with examples and answers. */
import { $, BY_HAND, counted, cssColor, fill, fixed, h } from "./dom.js";
import { icon } from "./icons.js";

export class Search {
  /**
   * @param {(action: string, value?: any, anchor?: Element) => number} act
   * @param {{examples: string[], saved_prompts: string[]}} run
   */
  constructor(act, run) {
    this.act = act;
    this.run = run;
    this.typed = "";
    this.line = "";
    document.querySelector(".glass")?.append(icon("search"));
    $("question").addEventListener("submit", (/** @type {Event} */ event) => {
      event.preventDefault();
      this.ask($("prompts").value);
    });
    $("prompts").addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      if (event.key !== "Escape") return;
      event.stopPropagation();
      this.cancel();
      $("prompts").blur();
    });
    Object.assign($("prompts").dataset, { tip: "Type what to look for.", keys: "/" });
    Object.assign($("ask").dataset, {
      tip: "Search. Separate several prompts by commas. Put a prompt that contains a comma in double quotes.",
      keys: "Enter",
    });
    Object.assign($("cancel").dataset, { tip: "Stop the search or the explanation.", keys: "Escape" });
    $("cancel").addEventListener("click", () => this.cancel());
    this.showExamples(true);
  }

  /** @param {string} line */
  ask(line) {
    $("prompts").value = line;
    if (line.trim() === "") return this.act("clear", null, $("ask"));
    this.setBusy("Searching …");
    this.act("ask", { line }, $("ask"));
  }

  cancel() {
    this.setBusy(null);
    this.act("cancel", null, $("cancel"));
  }

  /** @param {string | null} text */
  setBusy(text) {
    $("busy").hidden = !text;
    $("busy").textContent = text ?? "";
    $("cancel").hidden = !text;
  }

  /** @param {boolean} shown */
  showExamples(shown) {
    const { examples, saved_prompts: saved } = this.run;
    const pill = (/** @type {string} */ text) =>
      h("button.pill", { type: "button", "data-tip": `Search for ${text}.`, onclick: () => this.ask(text) }, text);
    const pills = [
      ...(saved.length > 0 ? [h("span.soft.small", {}, "Saved:"), pill(saved.join(", "))] : []),
      ...(examples.length > 0 ? [h("span.soft.small", {}, "Try:"), ...examples.slice(0, 4).map(pill)] : []),
    ];
    $("examples").hidden = !shown || pills.length === 0;
    if (shown && $("examples").childElementCount === 0) $("examples").replaceChildren(...pills);
  }

  /** @param {any} state */
  show(state) {
    const box = $("prompts");
    if (state.line !== this.line && document.activeElement !== box) box.value = state.line;
    else if (state.line !== this.line && box.value === this.line) box.value = state.line;
    this.line = state.line;
    if (state.busy !== undefined) this.setBusy(state.busy);
    const problem = state.prompts.find((/** @type {any} */ one) => one.error)?.error ?? "";
    $("problem").textContent = problem && `${problem[0].toUpperCase()}${problem.slice(1).replace(/\.$/, "")}.`;
    $("problem").hidden = !problem;
    this.showExamples(!state.by_hand && state.prompts.every((/** @type {any} */ one) => one.error));
    const shownTexts = state.prompts
      .filter((/** @type {any} */ one) => !one.error)
      .map((/** @type {any} */ one) => one.text);
    const chips = state.prompts.map((/** @type {any} */ one) => this.chip(one, state, shownTexts));
    if (state.by_hand && state.selected > 0) {
      chips.push(
        h(
          "li",
          {},
          h(
            "span.chip",
            {},
            h("span.swatch", { style: `background: ${cssColor(BY_HAND)}` }),
            h("span", {}, "Selected by hand"),
          ),
        ),
      );
    }
    $("answers").hidden = chips.length === 0;
    fill($("answers"), chips);
  }

  /** @param {any} one @param {any} state @param {string[]} texts */
  chip(one, state, texts) {
    if (one.error) {
      const tip = one.error;
      return h(
        "li",
        {},
        h(
          "span.chip.failed",
          { "data-tip": tip, tabindex: "0", "aria-label": `${one.text}: ${tip}` },
          "⚠ ",
          one.text,
          h("small", {}, "not understood"),
        ),
      );
    }
    const index = texts.indexOf(one.text);
    const shown = state.shown === index && texts.length > 1;
    const verdict = one.verdict && one.verdict !== "found" ? one.verdict : null;
    const several = texts.length > 1;
    const tip =
      `${counted(one.count ?? 0, "Gaussian")}, best relevancy ${fixed(Math.min(1, one.relevancy ?? 0))}.` +
      (shown && !state.by_hand
        ? " Click to show all answers."
        : several || state.by_hand
          ? ` Click to show ${several ? "only this" : "the"} answer.`
          : "");
    const dim = state.by_hand || (state.shown !== null && !shown && several);
    return h(
      "li",
      {},
      h(
        `button.chip${dim ? ".dim" : ""}`,
        {
          type: "button",
          "aria-pressed": String(shown),
          "data-tip": tip,
          "data-key": `chip-${one.text}`,
          onclick: (/** @type {Event} */ event) =>
            (several || state.by_hand) &&
            this.act(
              "show_prompt",
              several && (!shown || state.by_hand) ? index : null,
              /** @type {Element} */ (event.currentTarget),
            ),
        },
        h("span.swatch", { style: `background: ${cssColor(one.color ?? [0.5, 0.5, 0.5])}` }),
        h("span", {}, one.text),
        h("small.num", {}, verdict ?? fixed(Math.min(1, one.relevancy ?? 0))),
      ),
    );
  }
}
