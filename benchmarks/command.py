"""What a person waits for: whole commands in processes of their own, from a cold shell.

    python -m benchmarks.command             questions and help, CPU seconds (5 runs each), and lifts
    python -m benchmarks.command --quick     3 runs each
    python -m benchmarks.command --config outputs/.../config.yml      a run of your own in place of the fox

CLIP is ViT-B-16 with random weights, which take as long as trained ones. Where there is a GPU, lifts of patches are
timed too: a first one with empty caches of kernels, first ones with those filled (median of 3), and ones with every
stage cached (median of 3). The error of a new text is that of its vector against open_clip in float64.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.captures import SHARED
from benchmarks.overhead import HERE, run, spread
from benchmarks.report import RESULTS, Report
from normlift_ns.core.disk.arrays import load_arrays

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
from normlift_ns.scripts import lift
shown = lift.summary
def summary(run, before, total, queries):
    with open(os.environ["SECONDS_FILE"], "w") as file:
        json.dump({**before, **run.seconds, "total": total}, file)
    return shown(run, before, total, queries)
lift.summary = summary
lift.entrypoint()
"""


def lifted(trained: Path, folder: Path, name: str, *flags: object) -> dict[str, float]:
    """Lifts into folder/NAME, kernels cached in folder/kernels; seconds of every stage, and `wall` of the process."""
    seconds, kernels = folder / "seconds.json", folder / "kernels"
    environment = {"SECONDS_FILE": str(seconds), "TRITON_CACHE_DIR": f"{kernels}/t", "NUMBA_CACHE_DIR": f"{kernels}/n"}
    given = ("--load-config", trained, "--output-dir", folder / name, "--overwrite", *flags)
    cost = run(HERE, "lift", *given, program=LIFT, environment=environment)
    return {**json.loads(seconds.read_text()), "wall": cost.wall}


def add_questions(report: Report, trained: Path, folder: Path, repeats: int) -> None:
    texts = [f"a thing of kind {i}" for i in range(repeats)]
    subprocess.run([sys.executable, "-W", "ignore", "-c", WEIGHTS, MODEL, str(folder), *texts], check=True)
    exact = torch.load(folder / "rows.pt", weights_only=True).numpy()
    clip = ("--encoder-model", MODEL, "--encoder-pretrained", folder / "weights.safetensors")
    few = ("--regions", "grid", "--region-count", 4, *clip) if not torch.cuda.is_available() else clip
    lifted(trained, folder, "colour", "--encoder", "colour", "--timestamp", "run")
    lifted(trained, folder, "clip", *few, "--timestamp", "run")
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


def add_lifts(report: Report, trained: Path, folder: Path) -> None:
    clip = ("--regions", "patches", "--encoder-model", MODEL, "--encoder-pretrained", folder / "weights.safetensors")
    cold = lifted(trained, folder, "cold", *clip)
    first = [lifted(trained, folder, f"first{i}", *clip) for i in range(3)]
    cached = [lifted(trained, folder, "cold", *clip) for _ in range(3)]

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


def main(trained: Path, repeats: int, output: Path) -> None:
    report = Report("command_gpu" if torch.cuda.is_available() else "command")
    with tempfile.TemporaryDirectory() as name:
        add_questions(report, trained.absolute(), Path(name), repeats)
        if torch.cuda.is_available():
            add_lifts(report, trained.absolute(), Path(name))
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=FOX, help="config.yml of a trained run; by default the fox")
    parser.add_argument("--quick", action="store_true", help="3 runs each")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.config, 3 if arguments.quick else 5, arguments.output)
