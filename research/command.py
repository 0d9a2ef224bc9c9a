"""Times of whole commands, each in a process of its own.

    python -m research.command             queries and help (5 runs each); lifts on a machine with a GPU
    python -m research.command --quick     fewer runs
    python -m research.command --config outputs/.../config.yml      another trained run in place of the fox
    python -m research.command --before ../before   times with colors, in turns with another checkout
    python -m research.command --before ../before --lifts colors patches edges    only lifts, in turns

CLIP is ViT-B-16 with random weights, which take as long as trained ones. Lifts use patches: a first lift with empty
caches of kernels and bytecode, first lifts with these caches filled (median of 3; pip installs bytecode), and lifts
with every stage cached (median of 3). The error of a new text is that of its vector compared with open_clip in float64.
Existing metrics of the other kind of machine are kept in the file.

--before measures these cases with colors: lifts with empty caches of kernels and bytecode, with these caches filled but
no cached features, with every stage cached, and, if numba is installed, on two cores without the GPU. It also measures
--render-dir with one prompt and three views, and with five prompts and all views. A thousand color names with given
vectors are queried in a warm process on the GPU and on two cores. If its weights are on this machine, it measures edges
with ImageNet's classifier. --quick measures the other checkout once, and omits its slowest cases.

With --lifts, it measures three lifts of each kind: colors and patches with every stage cached, edges with an empty
cache. The error is the fraction of files of the field (of the regions) that differ.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from normlift_ns.encoders.weights import EDGES
from normlift_ns.io.arrays import load_arrays
from research.overhead import HERE, run, spread
from research.report import RESULTS, Metric, Report, hardware
from tests.captures import SHARED

FOX = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
MODEL = "ViT-B-16"
KERNELS = ("evidence", "neighbors", "vote")
STAGES = ("features", *KERNELS, "lift", "store")
"""Stages in the summary of a lift. All other time is overhead."""
WEIGHTS = """
import sys, torch, open_clip
from safetensors.torch import save_file
torch.manual_seed(0)
model = open_clip.create_model(sys.argv[1], pretrained_hf=False).eval()
save_file(model.state_dict(), sys.argv[2] + "/weights.safetensors")
with torch.no_grad():
    model.double()
    rows = model.encode_text(open_clip.get_tokenizer(sys.argv[1])(sys.argv[3:]))
torch.save(torch.nn.functional.normalize(rows, dim=1), sys.argv[2] + "/rows.pt")
"""
LIFT = """
import json, os
from normlift_ns.cli import lift, start
shown = lift.lift_summary
def summary(run, before, total):
    with open(os.environ["SECONDS_FILE"], "w") as file:
        json.dump({**before, **run.seconds, "total": total}, file)
    return shown(run, before, total)
lift.lift_summary = summary
start.lift()
"""


def caches(folder: Path) -> dict[str, str]:
    """Return environment variables that place the caches of kernels and bytecode in folder/kernels."""
    return {
        "TRITON_CACHE_DIR": f"{folder}/kernels/triton",
        "NUMBA_CACHE_DIR": f"{folder}/kernels/numba",
        "PYTHONPYCACHEPREFIX": f"{folder}/kernels/python",
        "PYTHONDONTWRITEBYTECODE": "",
        "PYTHONWARNINGS": "ignore",
    }


TWO_CORES = "import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])"
PROMPTS = """
import json, sys, time
if sys.argv[4] == "cpu":
    import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
import torch
from normlift_ns import open_run
from normlift_ns.encoders.registry import encoder_kind
from normlift_ns.progress import peak_gib
from normlift_ns.query import engine
from normlift_ns.query.arrays import open_quick
from normlift_ns.query.question import make_query
config, data, file, device = sys.argv[1:]
words = (2 * list(encoder_kind("color").words()))[:1000]
from pathlib import Path
found = {}
def measure(kind, field, means, rows):
    wait = torch.cuda.synchronize if device == "cuda" else (lambda: None)
    for count in (1, 1, 1000):
        question = make_query(field, rows, words[:count])
        wait(); start = time.perf_counter()
        answer = engine.run_query(field, means, question)
        wait(); found[f"{kind}_{count}_prompts_s"] = time.perf_counter() - start
        answer.to_json(); found[f"{kind}_{count}_prompts_summarized_s"] = time.perf_counter() - start
    peak = torch.cuda.max_memory_allocated() / 2**30 if device == "cuda" else peak_gib()
    found[f"{kind}_1000_prompts_peak_gib"] = peak
if device == "cpu":
    run = open_quick(Path(config))
    measure("query", run.field, run.field.arrays["means"], run.text_encoder.rows)
else:
    run = open_run(config, data=data)
    measure("ask", run.field.to(device), run.scene.gaussians.means.to(device), run.texts.rows)
json.dump(found, open(file, "w"))
"""
FIVE = ("red", "green", "blue", "brown", "orange")


def lifted(
    trained: Path, folder: Path, name: str, *flags: object, checkout: Path = HERE, program: str = LIFT
) -> dict[str, float]:
    """Lift into folder/NAME with kernels cached in folder/kernels; return the seconds of each stage and `wall` of the
    process."""
    seconds = folder / "seconds.json"
    environment = {"SECONDS_FILE": str(seconds), **caches(folder)}
    given = ("--load-config", trained, "--output-dir", folder / name, *flags)
    cost = run(checkout, "lift", *given, program=program, environment=environment)
    taken = {**json.loads(seconds.read_text()), "wall": cost.wall}
    print(name, *(f"{stage} {value:.2f}" for stage, value in taken.items()), flush=True)
    return taken


def make_weights(folder: Path, texts: Sequence[str]) -> tuple[object, ...]:
    """Write weights of a CLIP model, and rows.pt with the vectors of some texts in float64; return the flags of the
    model."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", WEIGHTS, MODEL, str(folder), *texts], check=True)
    return ("--encoder-model", MODEL, "--encoder-pretrained", folder / "weights.safetensors")


def add_questions(report: Report, trained: Path, folder: Path, repeats: int) -> None:
    texts = [f"a thing of kind {i}" for i in range(repeats)]
    clip = make_weights(folder, texts)
    exact = torch.load(folder / "rows.pt", weights_only=True).numpy()
    lifted(trained, folder, "colour", "--encoder", "color", "--timestamp", "run")
    lifted(trained, folder, "clip", "--regions", "grid", "--region-count", 4, *clip, "--timestamp", "run")
    runs = {name: next((folder / name).glob("*/normlift/run/config.yml")) for name in ("colour", "clip")}

    def ask(name: str, text: str) -> float:
        return run(HERE, "query", "--load-config", runs[name], "--text", text).cpu

    ask("colour", "red")
    ask("clip", "known")
    before = set(folder.glob("clip/**/*.safetensors"))
    new = [ask("clip", text) for text in texts]
    kept = sorted(set(folder.glob("clip/**/*.safetensors")) - before, key=os.path.getmtime)
    found = [load_arrays(path, key=path.stem).arrays["text"] for path in kept]
    error = max(float(np.linalg.norm(row - row_of)) for row, row_of in zip(found, exact, strict=True))
    questions = {
        "query_colour": ([ask("colour", "red") for _ in texts], None),
        "query_clip_known": ([ask("clip", "known") for _ in texts], None),
        "query_clip_new": (new, error),
        "help": ([run(HERE, "lift", "--help").cpu for _ in texts], None),
    }
    for name, (seconds, wrong) in questions.items():
        report.add(f"{name}_cpu_s", statistics.median(seconds), "s of CPU, median", wrong)
        report.add(f"{name}_cpu_s_spread", spread(seconds), "s, half of the distance between the quartiles")


def add_lifts(report: Report, trained: Path, folder: Path, repeats: int) -> None:
    flags = ("--regions", "patches", *make_weights(folder, ["fox"]))
    cold = lifted(trained, folder, "cold", *flags)
    first = [lifted(trained, folder, f"first{i}", *flags) for i in range(repeats)]
    cached = [lifted(trained, folder, "cold", *flags) for _ in range(repeats)]

    def add(name: str, seconds: list[float]) -> None:
        report.add(name, statistics.median(seconds), f"s, {min(seconds):.4g} to {max(seconds):.4g}")

    def overhead(taken: dict[str, float]) -> float:
        return taken["wall"] - sum(taken[stage] for stage in STAGES)

    add("cached_lift_wall_s", [taken["wall"] for taken in cached])
    add("first_lift_overhead_s", [overhead(taken) for taken in first])
    add("warm_kernels_s", [sum(taken[stage] for stage in KERNELS) for taken in first])
    add("cold_kernels_s", [sum(cold[stage] for stage in KERNELS)])
    add("cold_lift_wall_s", [cold["wall"]])
    add("first_lift_wall_s", [taken["wall"] for taken in first])
    for kind, group in (("first", first), ("cached", cached)):
        for stage in group[0]:
            add(f"{kind}.{stage}_s", [taken[stage] for taken in group])


def add_waits(report: Report, trained: Path, before: Path, folder: Path, quick: bool) -> None:
    """Add the waiting times of a user with the encoder color, for this checkout and another one, in turns."""
    checkouts = {"now": HERE, "before": before}
    folders = {name: folder / name for name in checkouts}
    data = trained.parents[4] / trained.parents[2].name
    colors = ("--encoder", "color")
    repeats = {"now": 3, "before": 1 if quick else 3}
    gpu, on_cpu = torch.cuda.is_available(), find_spec("numba") is not None
    found: dict[str, list[float]] = {}

    def note(name: str, seconds: float) -> None:
        found.setdefault(name, []).append(seconds)
        print(name, f"{seconds:.2f}", flush=True)

    def lift(name: str, case: str, output: str, *flags: object, program: str = LIFT) -> Path:
        given = ("--data", data, "--timestamp", "run", "--overwrite", True, *flags)
        taken = lifted(trained, folders[name], output, *given, checkout=checkouts[name], program=program)
        note(f"{name}.{case}_lift_s", taken["wall"])
        for stage, seconds in taken.items():
            found.setdefault(f"{name}.{case}_lift.{stage}_s", []).append(seconds)
        return next((folders[name] / output).glob("*/normlift/run/config.yml"))

    def pictures(name: str, case: str, config: Path, *flags: object) -> None:
        given = ("--load-config", config, "--data", data, "--render-dir", folders[name] / case, "--overwrite", True)
        cost = run(checkouts[name], "query", *given, *flags, environment=caches(folders[name]))
        note(f"{name}.{case}_s", cost.wall)

    def prompts(name: str, device: str, config: Path) -> None:
        file = folders[name] / "prompts.json"
        run(checkouts[name], "", config, data, file, device, program=PROMPTS, environment=caches(folders[name]))
        for key, value in json.loads(file.read_text()).items():
            note(f"{name}.{key}_{device}", value)

    def turns() -> Iterator[tuple[str, int]]:
        return ((name, turn) for turn in range(3) for name in checkouts if turn < repeats[name])

    configs = {}
    for name, turn in turns():
        shutil.rmtree(folders[name] / "kernels", ignore_errors=True)
        configs[name] = lift(name, "cold", f"cold{turn}", *colors)
    for name, turn in turns() if gpu else ():
        lift(name, "later", f"later{turn}", *colors)
        lift(name, "cached", "cold0", *colors)
    for name in checkouts:
        pictures(name, "first_pictures", configs[name], "--text", "red")
    for name, _ in turns():
        pictures(name, "pictures_3_views", configs[name], "--text", "red")
    for name in checkouts:
        views = json.loads((configs[name].parent / "normlift" / "manifest.json").read_text())["views_lifted"]
        all_views = ("--render-views", *(Path(view).stem for view in views))
        for _ in range(2 if name == "now" else int(not quick)):
            pictures(name, "pictures_45_views", configs[name], "--text", *FIVE, *all_views)
    slow = ("now",) if quick else ("now", "before")
    for name in slow if gpu else ():
        prompts(name, "cuda", configs[name])
    if EDGES.is_here:
        for turn in range(repeats["now"] if gpu else 1):
            lift("now", "edges", f"edges{turn}", "--regions", "edges", "--encoder", "imagenet")
    if gpu and on_cpu:  # two cores of this machine; without a GPU, the lifts above are those
        for name in checkouts:
            lift(name, "first_cpu", "some", *colors, "--device", "cpu", "--max-views", 2, program=TWO_CORES + LIFT)
            lift(name, "cpu", "cpu", *colors, "--device", "cpu", program=TWO_CORES + LIFT)
    for name in slow if on_cpu else ():
        prompts(name, "cpu", configs[name])
    for name, values in found.items():
        report.add(
            name,
            statistics.median(values),
            f"{'GiB' if 'gib' in name else 's'}, {min(values):.4g} to {max(values):.4g}",
        )


def add_lifts_in_turns(report: Report, trained: Path, before: Path, folder: Path, kinds: Sequence[str]) -> None:
    """Add lifts of this checkout and of another one, in turns, and whether their results are the same.

    Lifts of colors and patches have every stage cached. Lifts of edges start with an empty cache, kernels compiled.
    """
    checkouts = {"now": HERE, "before": before}
    folders = {name: folder / name for name in checkouts}
    data = trained.parents[4] / trained.parents[2].name
    clip = make_weights(folder, ["fox"]) if "patches" in kinds else ()
    flags = {
        "colors": ("--encoder", "color"),
        "patches": ("--regions", "patches", *clip),
        "edges": ("--regions", "edges", "--encoder", "imagenet"),
    }
    keys = {"colors": "cached_lift", "patches": "cached_patches_lift", "edges": "edges_lift"}

    def lift(name: str, kind: str, output: str) -> dict[str, float]:
        given = ("--data", data, "--timestamp", "run", "--overwrite", True, *flags[kind])
        return lifted(trained, folders[name], output, *given, checkout=checkouts[name])

    for kind in kinds:
        taken: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
        for name in checkouts:
            lift(name, kind, f"{kind}0")
        for turn in range(3):
            for name, found in taken.items():
                found.append(lift(name, kind, f"{kind}{turn + 1 if kind == 'edges' else 0}"))
        what = "*/normlift/.cache/regions/*" if kind == "edges" else "*/normlift/run/normlift/field.safetensors"
        now, earlier = (sorted((folders[name] / f"{kind}0").glob(what)) for name in checkouts)
        assert [file.name for file in now] == [file.name for file in earlier] != []
        differ = sum(a.read_bytes() != b.read_bytes() for a, b in zip(now, earlier)) / len(now)
        for name, found in taken.items():
            for stage in found[0]:
                seconds = [one[stage] for one in found]
                key = f"{name}.{keys[kind]}_s" if stage == "wall" else f"{name}.{keys[kind]}.{stage}_s"
                error = differ if stage == "wall" and name == "now" else None
                unit = f"s, {min(seconds):.4g} to {max(seconds):.4g}"
                report.add(key, statistics.median(seconds), unit, error)


def joined(report: Report, file: Path) -> Report:
    """Return the report with the machine in every unit, and with the other metrics of an existing file."""
    here = [replace(metric, unit=f"{metric.unit}; {hardware()}") for metric in report.metrics]
    before = [Metric(**row) for row in json.loads(file.read_text())["metrics"]] if file.is_file() else []
    keys = {metric.key for metric in here}
    return replace(
        report, metrics=sorted([*here, *(row for row in before if row.key not in keys)], key=lambda m: m.key)
    )


def main(trained: Path, quick: bool, before: Path | None, kinds: Sequence[str], output: Path) -> None:
    report = Report("lifts" if len(kinds) > 0 else "command")
    with tempfile.TemporaryDirectory() as name:
        if before is not None and len(kinds) > 0:
            add_lifts_in_turns(report, trained.absolute(), before.absolute(), Path(name), kinds)
        elif before is not None:
            add_waits(report, trained.absolute(), before.absolute(), Path(name), quick)
        elif torch.cuda.is_available():
            add_lifts(report, trained.absolute(), Path(name), 2 if quick else 3)
        else:
            add_questions(report, trained.absolute(), Path(name), 3 if quick else 5)
    joined(report, output / f"{report.name}.json").write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=FOX, help="config.yml of a trained run; by default the fox")
    parser.add_argument("--quick", action="store_true", help="fewer runs")
    parser.add_argument("--before", type=Path, help="another checkout, whose times with colors are compared")
    parser.add_argument(
        "--lifts", nargs="+", default=(), choices=("colors", "patches", "edges"), help="only these lifts"
    )
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.config, arguments.quick, arguments.before, arguments.lifts, arguments.output)
