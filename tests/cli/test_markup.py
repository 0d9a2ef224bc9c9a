"""Text is text: no markup, emoji code or escape of a prompt, path, name or label is interpreted by a command."""

import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from rich.console import Console

from normlift_ns.analysis.explain import ViewVote, Why
from normlift_ns.cli import common, evaluate, export, lift, query
from normlift_ns.errors import escape_unprintable
from tests.cli.conftest import run_entry

HOSTILE = [
    "[/red]", "[bold]red[/bold]", "[link=http://x]y[/link]", ":smile:", ":tada: [red", "a[0]\\[1]",
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "two\nlines", "\rover", "\u202eright to left", "\x9b2J", "\udc80",
    "$\\frac{$",
]  # fmt: skip
NUMBERS = {
    "fraction": 0.5, "centroid": [0.0] * 3, "extent": None, "peak": 0.5, "mean_reliability": None,
    "suggested_threshold": None, "histogram": None, "verdict": "probably not here", "read_as": "[/red]",
}  # fmt: skip
OBJECT = {
    "instance_id": 1, "size": 3, "centroid": [0.0] * 3, "box": {"min": [0.0] * 3, "max": [1.0] * 3},
    "mean_reliability": 0.5,
}  # fmt: skip


def summary(text: str) -> Any:
    told = {"gaussians": 1, "zero_evidence_share": 0, "excluded": 0, "left_out": 0, "reliability_quantiles": {}}
    forms = {"float16": {"bytes": 1, "bound": 0.1}}
    manifest = {"statistics": told, "forms": forms, "form": "float16", "features": {"kind": "given"}, "cost": {}}
    run = SimpleNamespace(field=SimpleNamespace(manifest=manifest), seconds={}, folder=text)
    return lift.lift_summary(run, {}, 1.0)  # type: ignore[arg-type]


TABLES: dict[str, Callable[[str], Any]] = {
    "query": lambda text: query.answer_table([{"text": text, **NUMBERS}], "lerf > 0.5", 0.5),
    "export": lambda text: export._objects_table([{"text": text, "objects": [OBJECT], "in_smaller_parts": 1}]),
    "export nothing": lambda text: export._objects_table([{"text": text, "objects": [], "in_smaller_parts": 1}]),
    "eval rows": lambda text: evaluate.rows_table([{"class": text, "iou": 0.5}], "ablation"),
    "eval columns": lambda text: evaluate.rows_table([{text: 0.5}]),
    "eval signals": lambda text: evaluate.signals_table([{"scene": text, "zero.share": 0.5}]),
    "lift": summary,
    "text": common.plain_text,
}


def printed(content: Any) -> str:
    file = io.StringIO()
    Console(file=file, width=200, force_terminal=True, color_system="truecolor").print(content)
    return file.getvalue()


def test_hostile_texts_are_shown_as_they_are():
    """Also on a console that would interpret markup, in colours."""
    for name, table in TABLES.items():
        for text in HOSTILE:
            shown = printed(table(text))
            assert escape_unprintable(text) in shown, (name, text)
            assert not [x for x in ("\x1b]", "\x1b[31m", "\x07", "\r", "\u202e", "\x9b") if x in shown], (name, text)
            shown.encode("utf8")


def test_lines_are_texts_too(capsys):
    for text in HOSTILE:
        common.info(f"Written: {text}/{'long/' * 60}end")
        common.print_error(f"{text} does not exist")
        shown = capsys.readouterr()
        assert shown.out == f"Written: {escape_unprintable(text)}/{'long/' * 60}end\n"
        assert shown.err == f"{escape_unprintable(text)} does not exist\n"
    common.CONSOLE.rule(HOSTILE[1])  # nor does the console interpret anything
    common.ERROR_CONSOLE.print(f"{HOSTILE[1]} :smile:")
    shown = capsys.readouterr()
    assert HOSTILE[1] in shown.out and shown.err == f"{HOSTILE[1]} :smile:\n"


def test_a_prompt_of_markup_is_asked_and_answered(lifted, tmp_path, monkeypatch, capsys):
    """From the flag to the table, the files and their names; the colour is what the encoder reads."""
    texts = ("red [/red]", ":smile: yellow", "[bold]green", "\x1b[31m orange")
    folder = tmp_path / "[x] :smile: [/red]"
    monkeypatch.setattr(common.CONSOLE, "_width", 200)
    flags = ("--output-json", folder / "a.json", "--render-dir", folder, "--render-views", "0003", "--text", *texts)
    assert run_entry(monkeypatch, query.entrypoint, "--load-config", lifted, *flags) == 0
    shown = capsys.readouterr().out
    for text in texts:
        assert escape_unprintable(text) in shown
    assert f"{folder}/a.json" in shown
    assert len(list(folder.glob("*.png"))) == len(texts)


def test_answers_and_reasons_fit_into_the_terminal_with_all_their_numbers():
    row = {"text": "tomato red", **NUMBERS, "centroid": [-0.18, 0.25, -0.45], "extent": [0.26, 0.27, 0.1]}
    votes = tuple(ViewVote(i, 13_320.0, 0.088, 0.994 - i, 0.21, ()) for i in range(2))
    why, names = Why(606, 0.1, 1.0, 1.0, 1.0, 16.6, 0.9, votes), ["images/0012.png", "images/0017.png"]
    for width in (60, 80, 120):
        for table, numbers in (
            (query.answer_table([row], "cosine > 0.5", 0.5, narrow=width < 100), "-0.18 0.25 -0.45 0.26 0.27 0.10"),
            (query.explanation_table(names, ["tomato red"], [why], narrow=width < 120), "8.8% 0.994 -0.006 21%"),
        ):
            Console(file=(file := io.StringIO()), width=width).print(table)
            shown = file.getvalue()
            assert max(map(len, shown.splitlines())) <= width and "…" not in shown
            assert all(number in shown for number in numbers.split())
        assert (width < 120) == ("13,320" not in shown)
