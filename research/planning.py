"""Estimates of a plan compared with the times of a lift, with the commands ns-normlift-check and ns-normlift.

    python -m research.planning                                  the fox and the tabletop, on the GPU if there is one
    python -m research.planning --load-config FILE --device cpu  another run, on a device
    python -m research.planning --quick                          colors, and 8 views

Each front end is planned and lifted twice: with empty caches, and with everything cached. Superpixels use colors.
Patches use CLIP's ViT-B-16 with random weights, which take as long as trained ones. Nothing is downloaded. The results
of the two kinds of machine are in separate files.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import torch

from research.command import lifted, make_weights
from research.overhead import HERE, run
from research.report import RESULTS, Report
from tests.captures import SHARED

CAPTURES = ("fox", "tabletop")


def planned(trained: Path, folder: Path, name: str, *flags: object) -> dict[str, float]:
    """Return the estimates of a check and its own time.

    The keys are the stages and `total` in seconds, `wall` for the time of the check itself, and `gib` and `gpu_gib` for
    memory.
    """
    file = folder / "plan.json"
    given = (
        "--load-config",
        trained,
        "--output-dir",
        folder / name,
        *flags,
        "--output-json",
        file,
        "--overwrite",
        "True",
    )
    kernels = folder / "kernels"
    environment = {"TRITON_CACHE_DIR": f"{kernels}/triton", "NUMBA_CACHE_DIR": f"{kernels}/numba"}
    cost = run(HERE, "check", *given, environment={**environment, "PYTHONPYCACHEPREFIX": f"{kernels}/python"})
    plan = json.loads(file.read_text())["plan"]
    memory = {"gib": plan["host_bytes"] / 2**30, "gpu_gib": (plan["device_bytes"] or 0) / 2**30}
    return {**plan["seconds"], "total": plan["total_s"], "wall": cost.wall, **memory}


def add_case(report: Report, trained: Path, folder: Path, name: str, *flags: object) -> None:
    """Add a plan and a lift with empty caches, and again with everything cached."""
    for state in ("first", "cached"):
        told, taken = planned(trained, folder, name, *flags), lifted(trained, folder, name, *flags)
        newest = max((folder / name).rglob("manifest.json"), key=lambda path: path.stat().st_mtime)
        cost = json.loads(newest.read_text())["cost"]
        case = f"{name}.{state}"
        report.add(f"{case}.ratio", told["total"] / taken["total"], "told total over measured total")
        report.add(f"{case}.told_s", told["total"], "s")
        report.add(f"{case}.taken_s", taken["total"], "s")
        report.add(f"{case}.wall_s", taken["wall"], "s, of the whole process")
        report.add(f"{case}.check_s", told["wall"], "s, of the check itself")
        report.add(f"{case}.told_gib", told["gib"], "GiB")
        report.add(f"{case}.taken_gib", cost["memory_gib"], "GiB")
        if "gpu_memory_gib" in cost:
            report.add(f"{case}.told_gpu_gib", told["gpu_gib"], "GiB")
            report.add(f"{case}.taken_gpu_gib", cost["gpu_memory_gib"], "GiB")
        for stage in taken:
            if stage in told and stage not in ("total", "wall"):
                report.add(f"{case}.{stage}.told_s", told[stage], "s")
                report.add(f"{case}.{stage}.taken_s", taken[stage], "s")


def main(runs: dict[str, Path], device: str, quick: bool, output: Path) -> None:
    report = Report(f"planning_{'cpu' if device == 'cpu' else 'gpu'}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ends: dict[str, tuple[object, ...]] = {"colour": ("--encoder", "color", "--regions", "superpixel")}
        if not quick:
            ends["patches"] = ("--regions", "patches", *make_weights(folder, ["fox"]))
        few = ("--max-views", 8) if quick else ()
        for capture, trained in runs.items():
            for end, flags in ends.items():
                add_case(report, trained.absolute(), folder, f"{capture}.{end}", *flags, *few, "--device", device)
    report.write(output)
    print(json.dumps({metric.key: metric.value for metric in report.metrics}, indent=1))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load-config", type=Path, help="config.yml of a trained run; by default fox and tabletop")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--quick", action="store_true", help="colors only, 8 views")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    outputs = SHARED / "captures" / "outputs"
    chosen = {name: outputs / name / "splatfacto" / "run" / "config.yml" for name in CAPTURES}
    if arguments.load_config is not None:
        chosen = {"run": arguments.load_config}
    main(chosen, arguments.device, arguments.quick, arguments.output)
