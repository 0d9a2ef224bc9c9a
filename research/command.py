"""What a person waits for: whole commands in processes of their own, from a cold shell.

    python -m research.command             questions and help (5 runs each), on a machine with a GPU lifts
    python -m research.command --quick     fewer runs
    python -m research.command --config outputs/.../config.yml      a run of your own in place of the fox

CLIP is ViT-B-16 with random weights, which take as long as trained ones. Lifts are of patches: a first one with empty
caches of kernels and bytecode, first ones with those filled (median of 3; pip leaves packages with their bytecode), and
ones with every stage cached (median of 3). The error of a new text is that of its vector against open_clip in float64.
What the file holds of the other kind of machine stays.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from normlift_ns.io.arrays import load_arrays
from research.overhead import HERE, run, spread
from research.report import RESULTS, Metric, Report, hardware
from tests.captures import SHARED

FOX = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
MODEL = "ViT-B-16"
KERNELS = ("evidence", "neighbors", "vote")
STAGES = ("features", *KERNELS, "lift", "store")
"""Of the summary; what is not among them is overhead."""
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


def lifted(trained: Path, folder: Path, name: str, *flags: object) -> dict[str, float]:
    """Lifts into folder/NAME, kernels cached in folder/kernels; seconds of every stage, and `wall` of the process."""
    seconds, kernels = folder / "seconds.json", folder / "kernels"
    environment = {
        "SECONDS_FILE": str(seconds),
        "TRITON_CACHE_DIR": f"{kernels}/triton",
        "NUMBA_CACHE_DIR": f"{kernels}/numba",
        "PYTHONPYCACHEPREFIX": f"{kernels}/python",
        "PYTHONDONTWRITEBYTECODE": "",
    }
    given = ("--load-config", trained, "--output-dir", folder / name, *flags)
    cost = run(HERE, "lift", *given, program=LIFT, environment=environment)
    taken = {**json.loads(seconds.read_text()), "wall": cost.wall}
    print(name, *(f"{stage} {value:.2f}" for stage, value in taken.items()), flush=True)
    return taken


def make_weights(folder: Path, texts: Sequence[str]) -> tuple[object, ...]:
    """Weights of a CLIP model, and rows.pt with the vectors of some texts in float64; the flags that name the model."""
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


def joined(report: Report, file: Path) -> Report:
    """The report, every unit with its machine, and what a file of it holds besides."""
    here = [replace(metric, unit=f"{metric.unit}; {hardware()}") for metric in report.metrics]
    before = [Metric(**row) for row in json.loads(file.read_text())["metrics"]] if file.is_file() else []
    keys = {metric.key for metric in here}
    return replace(
        report, metrics=sorted([*here, *(row for row in before if row.key not in keys)], key=lambda m: m.key)
    )


def main(trained: Path, quick: bool, output: Path) -> None:
    report = Report("command")
    with tempfile.TemporaryDirectory() as name:
        if torch.cuda.is_available():
            add_lifts(report, trained.absolute(), Path(name), 2 if quick else 3)
        else:
            add_questions(report, trained.absolute(), Path(name), 3 if quick else 5)
    joined(report, output / "command.json").write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=FOX, help="config.yml of a trained run; by default the fox")
    parser.add_argument("--quick", action="store_true", help="fewer runs")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.config, arguments.quick, arguments.output)
