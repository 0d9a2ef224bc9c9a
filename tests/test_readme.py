"""What the README, the pages, the reference and docstrings show is true; the site builds."""

import doctest
import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import torch

import normlift_ns
from normlift_ns.cli.lift import NormLift
from normlift_ns.options import VOTE_FLAGS, RefineConfig
from research.reference import COMMANDS, PAGE
from research.reference import page as reference

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(normlift_ns.__file__).parent
README = (ROOT / "README.md").read_text("utf8")
PYTHON = (ROOT / "docs" / "python.md").read_text("utf8")
FRONT_ENDS = (ROOT / "docs" / "front_ends.md").read_text("utf8")
PAGE_NAMES = ("front_ends", "splats", "scale", "check", "viewer", "objects", "install", "files", "troubleshooting")
PAGE_NAMES = (*PAGE_NAMES, "honest_answers", "python", "../README")
TERMINAL = {"--quiet", "--log-file", "--version", "--help"}
OTHERS = {"--app_opt", "--auto-scale-poses", "--center-method", "--csv", "--eval", "--filter-value", "--no-deps"}
OTHERS |= {"--normalize-world-space", "--no-normalize-world-space", "--orientation-method", "--white_background"}
OTHERS |= {"--xml", "--pose_opt", "--rendered-output-names", "--clip", "--scenes", "--texts", "--later", "--viewer"}
OTHERS |= {"--no-python", "--nnodes", "--nproc-per-node", "--rdzv-backend", "--rdzv-endpoint"}
OTHERS |= {"--keep-crs", "--torch-backend"}
"""Of other programs: pip, uv, torchrun, OpenSplat, ns-train, gsplat's trainer, our benchmarks, and so on."""


def python_of(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)


def flags(options: Any) -> set[str]:
    """Those of a command, of the options within it too."""
    hints, found = get_type_hints(options), set()
    for field in fields(options):
        hint = hints[field.name]
        name = VOTE_FLAGS.get(field.name, field.name) if options is RefineConfig else field.name
        found |= flags(hint) if is_dataclass(hint) else {f"--{name.replace('_', '-')}"}
    return found


@pytest.mark.slow
def test_the_python_script_runs_on_the_demo(tmp_path, monkeypatch, capsys):
    from normlift_ns.cli.demo import Demo  # noqa: PLC0415 (nerfstudio takes 20 s)

    monkeypatch.chdir(tmp_path)
    means = Demo().main()
    assert means["before refinement"] >= 0.76
    assert means["after refinement"] >= 0.8
    assert (tmp_path / "demo" / "pictures" / "overview.png").stat().st_size > 10_000
    (script,), (_, own, field, _) = python_of(README), python_of(PYTHON)
    capsys.readouterr()
    names: dict[str, Any] = {}
    exec(compile(script, "README.md", "exec"), names)
    shown = capsys.readouterr().out
    assert "tomato red" in shown
    assert (tmp_path / "demo" / "banana.ply").exists()
    assert names["picture"].size == (400, 300)
    exec(compile(field, "python.md", "exec"), names)
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(notebook.read_text("utf8"))["cells"]
        code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        start = time.process_time()
        exec(compile(code, notebook.name, "exec"), {})
        assert time.process_time() - start < 60, notebook.name
    (trained,) = Path("demo/outputs/room/splatfacto").glob("*/config.yml")
    names |= {"labels": np.zeros((300, 400), int), "vectors": np.eye(1, 8), "vector": torch.eye(8)[0]}
    exec(compile(own.replace("outputs/…/splatfacto/…/config.yml", str(trained)), "README.md", "exec"), names)
    assert names["run"].ask("fox")["fox"].fraction > 0.9


def test_the_lift_of_bare_tensors_runs(capsys):
    exec(compile(python_of(PYTHON)[3], "python.md", "exec"), {})
    assert capsys.readouterr().out == "tensor([[0.6000, 0.8000]]) tensor([0.5000])\n"


def commands(text: str) -> list[list[str]]:
    lines = re.sub(r"\\\n +", "", text)
    found = re.findall(r"^    (ns-(?:normlift|train normlift).*)$", lines, flags=re.MULTILINE)
    return [shlex.split(line, comments=True) for line in found]


def test_commands_that_are_shown_have_the_options_that_they_name():
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for name, *words in commands(page.read_text("utf8")):
            known = flags(NormLift) if name == "ns-train" else flags(COMMANDS[name]) | TERMINAL
            if name == "ns-normlift-batch":  # behind -- are options of ns-normlift
                known |= flags(NormLift)
            for word in words:
                flag = f"--{word.rsplit('.', 1)[1]}" if word.startswith("--pipeline.") else word
                if name != "ns-train" or flag != word:
                    assert not flag.startswith("--") or flag == "--" or flag in known, (page.name, name, word)


def test_options_that_are_named_exist():
    """In the whole text of a page; those of other programs are listed."""
    ours = set().union(*(flags(command) for command in COMMANDS.values())) | TERMINAL
    for name in PAGE_NAMES:
        text = (ROOT / "docs" / f"{name}.md").read_text("utf8")
        assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text)) - ours <= OTHERS, name


def test_the_readme_is_short_and_its_figures_are_those_of_the_results():
    from research.documents import documents  # noqa: PLC0415 (scikit-image)
    from research.tables import tables  # noqa: PLC0415

    assert len(README.splitlines()) <= 130
    made, shown = tables(documents()), README.split("## Accuracy")[1]
    header, *columns = [line.strip("| ").split(" | ") for line in made["grid-columns"].splitlines()]
    rows = [line for line in shown.splitlines() if line.startswith("| `--")]
    shown = " ".join(shown.split())
    for row, kind in zip(rows, ("masks", "patches", "superpixels"), strict=True):
        cells = next(cells for cells in columns if cells[0] == f"kind: {kind}")
        gain, worst = (metric("gate", f"choice.default.{kind}.{key}") for key in ("gain", "worst"))
        assert row.endswith(f"| {cells[header.index('paper')]} | {gain:+.1f} ({worst:+.1f}) |"), row
    gain, worst = (metric("gate", f"choice.default.real.{key}") for key in ("gain", "worst"))
    assert f"is {gain:.1f}, {worst:.1f} in the worst cell" in shown
    rooms = [metric("gate", f"{room}.default.masks.gain") for room in ("second", "third")]
    assert f"{rooms[0]:.1f} and {rooms[1]:.1f} points with masks" in shown
    form = "forced relative seen 0.2"
    damaged, least = (metric("gate", f"choice.{form}.{key}") for key in ("damaged", "worst 3"))
    assert f"gains {damaged:.1f} points of mIoU" in shown and f"{least:.1f} with 3" in shown
    hard = next(line for line in made["reliability-tabletop"].splitlines() if line.startswith("| hard |"))
    assert "51 to 100 %" in hard and "51 % of the Gaussians in its lowest tenth are right, and 100 %" in shown


def metric(document: str, key: str) -> float:
    found = json.loads((ROOT / "research" / "results" / f"{document}.json").read_text("utf8"))["metrics"]
    return next(x["value"] for x in found if x["key"] == key)


def test_times_of_the_readme_and_of_front_ends_are_those_of_the_results():
    room = {key: metric("h100", f"rooms_1930k.{key}") for key in ("evidence_lift_s", "rgb_s", "neighbors_s", "vote_s")}
    fox = [metric("cpu", f"fox_{key}_s") for key in ("evidence", "lift", "neighbors", "refine")]
    wanted = (
        f"{room['evidence_lift_s']:.2f} s (an RGB render: {room['rgb_s']:.2f} s; "
        f"stock gsplat: {metric('h100', 'rooms_1930k.gsplat512_s'):.0f} s)",
        f"{room['neighbors_s'] + room['vote_s']:.2f} s; {metric('h100', 'rooms_1930k.query_ms'):.1f} ms; "
        f"{metric('h100', 'rooms_1930k.peak_gib'):.1f} GiB",
        "; ".join(f"{seconds:.1f} s" for seconds in fox),
        f"H100 | {metric('front_ends', 'view_s'):.2f} s",
        f"first {metric('command', 'first.wall_s'):.0f} s; features cached {metric('command', 'cached.wall_s'):.1f} s",
    )
    for text in wanted:
        assert text in README
    keys = ("sam_encoder_s", "sam_decoder_s", "view_s", "view_clip_s", "sam_masks_l", "encode_300_s", "patches_s")
    encoder, decoder, view, clip, masks, encode, patches = (metric("front_ends", key) for key in keys)
    assert (
        f"costs {encoder + decoder:.2f} s of SAM ViT-H's network and {view:.2f} s in all, {clip:.2f} s of it for CLIP "
        f"on the {masks:.0f} masks of a level; CLIP on 300 masks takes {encode:.2f} s, and patches "
        f"{1000 * patches:.0f} ms"
    ) in " ".join(FRONT_ENDS.split())


def test_tables_of_the_pages_are_those_of_the_results_and_every_table_stands_on_one():
    from research import pages  # noqa: PLC0415 (scikit-image, matplotlib)

    made, shown = pages.tables(pages.documents()), set()
    for name in pages.PAGES:
        text = (ROOT / name).read_bytes().decode()
        assert pages.outdated(text, made) == [], "refresh them: python -m research.pages"
        assert pages.refreshed(text, made) == text
        shown |= {part.table for part in pages.split(text, made)}
    assert shown == {None, *made}


def test_messages_of_troubleshooting_are_in_the_code():
    code = "".join(path.read_text("utf8") for path in sorted((ROOT / "normlift_ns").rglob("*.py")))
    code = re.sub(r'"\n\s*f?"', "", code)
    page = (ROOT / "docs" / "troubleshooting.md").read_text("utf8")
    messages = re.findall(r"^\| `([^`]+)` \|", page, flags=re.MULTILINE)
    assert len(messages) > 20
    for part in (part.strip(" ;(") for message in messages for part in message.split("…")):
        assert part in code, part


def test_the_reference_is_made_of_the_code_and_has_every_public_name():
    assert PAGE.read_text("utf8") == reference(), "refresh it: python -m research.reference"
    shown = re.findall(r"^::: normlift_ns\.[\w.]*?(\w+)$", (PAGE.parent / "api.md").read_text("utf8"), re.MULTILINE)
    assert sorted(shown) == sorted(normlift_ns.__all__)


@pytest.mark.slow
def test_the_site_builds_with_examples_as_code_and_loads_nothing_from_elsewhere(tmp_path):
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stdout + built.stderr
    for made in tmp_path.glob("*.html"):
        loaded = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', made.read_text("utf8"))
        assert [url for url in loaded if "github.com/normlift-ns" not in url] == [], made.name
    text = (tmp_path / "api.html").read_text("utf8")
    assert "&gt;&gt;&gt; " not in re.sub(r"<pre.*?</pre>", "", text, flags=re.DOTALL)
    assert text.count("&gt;&gt;&gt;") > 50 and "nearest_neighbors" in text


OPENS_A_RUN = re.compile(r"\b(open_run|open_scene|lift_run)\(config\b|\[config\]")


@pytest.mark.parametrize("opens_a_run", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_examples(opens_a_run, request, tmp_path, monkeypatch):
    names = {}
    if opens_a_run:  # examples read the run `config` and write to `folder`
        names = {"config": request.getfixturevalue("lifted"), "folder": tmp_path}
        from nerfstudio.utils.rich_utils import CONSOLE  # noqa: PLC0415

        monkeypatch.setattr(CONSOLE, "quiet", True)
    texts = {path: path.read_text("utf8") for path in sorted(PACKAGE.rglob("*.py"))}
    printed: list[str] = []
    for path, text in texts.items():
        if ">>>" not in text or bool(OPENS_A_RUN.search(text)) != opens_a_run:
            continue
        name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        found = [test for test in doctest.DocTestFinder().find(import_module(name)) if test.examples]
        assert found, f"{path} has no examples"
        for test in found:
            test.globs |= names
            doctest.DocTestRunner(verbose=False).run(test, out=printed.append)
    assert printed == [], "".join(printed)
