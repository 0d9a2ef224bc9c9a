"""Two GPUs compared with one: evidence, exchange, lift, neighbors and vote; the front end; commands; 100 million
Gaussians.

    python -m research.gpu_scale                    all parts; starts its two processes itself
    python -m research.gpu_scale --only core        one part: core, front, large or command
    python -m research.gpu_scale --device cpu --quick    tiny, through gloo, for any machine

Times are measured between barriers of both processes, as medians of some rounds, with one GPU and two in turns. The
error is the largest difference of any number of any Gaussian between the two, and must be 0. SAM and CLIP have random
weights. Existing metrics of other parts are kept in the file.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from normlift_ns import Camera, Evidence, GaussianScene, LiftOptions, lift, rasterize_evidence
from normlift_ns.core.lift import Scalars
from normlift_ns.core.partition import Partition
from normlift_ns.distributed.communicator import EvidenceShard, TorchCommunicator, redistribute_evidence
from normlift_ns.distributed.launch import distributed_context, launch_processes
from normlift_ns.distributed.lift import vote_distributed
from normlift_ns.evidence_collection import chunk_views
from normlift_ns.pipeline import vote_directions
from normlift_ns.progress import StageTimer
from research import rooms
from research.command import joined as with_earlier
from research.report import RESULTS, Report
from tests.captures import SHARED

DIMENSION, REGIONS, MAPS = 512, 128, 16
ENTRY = 12
"""Bytes of an exchanged entry."""


class Case(NamedTuple):
    scene: GaussianScene
    cameras: Sequence[Camera]
    labels: Sequence[Tensor]
    """Label maps of some views, which all views use in turn."""
    table: Tensor

    @staticmethod
    def of(n: int, views: int, device: str, scale: float = 1.0, dimension: int = DIMENSION) -> Case:
        width, height = round(rooms.WIDTH * scale), round(rooms.HEIGHT * scale)
        maps = [rooms.voronoi_labels(REGIONS, width, height, seed=v, device=device) for v in range(min(MAPS, views))]
        g = torch.Generator(device).manual_seed(0)
        table = torch.randn(views * REGIONS, dimension, generator=g, device=device)
        scene = rooms.room(n, device=device, drawn_on=device)
        return Case(scene, rooms.cameras(views, width, height), maps, torch.nn.functional.normalize(table, dim=1))


class Found(NamedTuple):
    scalars: Scalars
    copied: Tensor
    seconds: dict[str, float]
    evidence: Evidence


class Clock:
    """Clock of the seconds between barriers."""

    def __init__(self, team: TorchCommunicator | None, device: str) -> None:
        self.team, self.device, self.seconds = team, device, dict[str, float]()
        self.last = self.now()

    def now(self) -> float:
        if self.device == "cuda":
            torch.cuda.synchronize()
        if self.team is not None:
            self.team.all_reduce(torch.zeros(1))
        return time.perf_counter()

    def lap(self, name: str) -> None:
        now = self.now()
        self.seconds[name], self.last = now - self.last, now


def rasterized(case: Case, views: Sequence[int]) -> Evidence:
    labels = [case.labels[v % len(case.labels)] for v in views]
    return rasterize_evidence(case.scene, [case.cameras[v] for v in views], labels, num_regions=[REGIONS] * len(views))


def core_alone(case: Case, device: str) -> Found:
    """Return the results for all Gaussians in one process, and the seconds of every step."""
    clock, stages = Clock(None, device), StageTimer(lambda stage, done, total: None)
    whole = [rasterized(case, views) for views in chunk_views(range(len(case.cameras)))]
    clock.lap("evidence")
    evidence = Evidence.merge(*whole)
    whole.clear()
    clock.lap("exchange")
    lifted = lift(evidence, case.table)
    clock.lap("lift")
    copied, _, _ = vote_directions(case.scene.means, lifted, lifted.scalars.own_evidence, LiftOptions(), stages)
    clock.lap("vote")
    return Found(lifted.scalars, copied, {**clock.seconds, "neighbors": stages.seconds["neighbors"]}, evidence)


def core(team: TorchCommunicator, case: Case, folder: Path, device: str) -> Found:
    """Return the results for all Gaussians with several processes, and the seconds of every step."""
    clock = Clock(team, device)
    portion = Partition.from_means(team, case.scene.means)
    chunks = chunk_views(range(len(case.cameras)), team.world_size)
    pieces = dict[int, EvidenceShard]()
    with team.shared_folder(folder):
        for number in team.claim_chunks(len(chunks)):
            pieces[number] = EvidenceShard.split(rasterized(case, chunks[number]), portion)
        clock.lap("evidence")
    evidence = redistribute_evidence(pieces, portion, len(chunks))
    pieces.clear()
    clock.lap("exchange")
    lifted = lift(evidence, case.table)
    clock.lap("lift")
    own = lifted.scalars.own_evidence
    stages = StageTimer(lambda stage, done, total: None)
    copied, _, _ = vote_distributed(case.scene.means, lifted, own, LiftOptions(), portion, stages)
    clock.lap("vote")
    clock.seconds |= {name: stages.seconds[name] for name in ("neighbors",)}
    return Found(lifted.scalars.map(portion.all_gather), portion.all_gather(copied), clock.seconds, evidence)


SMALL_VIEWS: dict[str, Any] = {"scale": 0.1, "dimension": 16}
STEPS = ("evidence", "exchange", "lift", "vote")


def total(seconds: Mapping[str, float]) -> float:
    return sum(seconds[step] for step in STEPS)


def difference(a: Found, b: Found) -> float:
    """Return the largest difference of any number of any Gaussian, or the number of copied directions that differ if
    larger."""
    pairs = [(getattr(a.scalars, f.name), getattr(b.scalars, f.name)) for f in fields(Scalars)]
    return max(float((a.copied != b.copied).sum()), *(float((x.double() - y.double()).abs().max()) for x, y in pairs))


def compare_core(
    team: TorchCommunicator, report: Report, name: str, case: Case, folder: Path, device: str, rounds: int
) -> None:
    one, two, wrong, entries = list[dict[str, float]](), list[dict[str, float]](), 0.0, 0
    for turn in range(rounds + 1):
        alone = core_alone(case, device) if team.rank == 0 else None
        team.all_reduce(torch.zeros(1))
        together = core(team, case, folder, device)
        entries = together.evidence.nnz
        if alone is not None:
            wrong = max(wrong, difference(alone, together))
            if turn > 0:  # the first one compiles
                one.append(alone.seconds)
                two.append(together.seconds)
        del alone, together
        team.all_reduce(torch.zeros(1))
    exchanged = int(team.all_reduce(torch.tensor([entries])).item())
    if team.rank > 0:
        return
    seconds = statistics.median(map(total, two))
    report.add(f"core_speedup_2{name}", statistics.median(map(total, one)) / seconds, "one GPU over two", wrong)
    report.add(f"core_one_s{name}", statistics.median(map(total, one)), "s")
    report.add(f"core_two_s{name}", seconds, "s", wrong)
    for step in (*STEPS, "neighbors"):
        for count, found in ((1, one), (2, two)):
            report.add(f"core{name}.{step}_s_{count}", statistics.median(x[step] for x in found), "s")
    moved = exchanged * (team.world_size - 1) / team.world_size * ENTRY / 2**30
    report.add(f"core{name}.exchanged_gib", moved, "GiB in all")
    spent = statistics.median(x["exchange"] for x in two)
    report.add(f"exchange_gib_s{name}", moved / spent, "GiB/s, sorting what came included")


def large(team: TorchCommunicator, report: Report, case: Case, folder: Path, device: str) -> None:
    if device == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    begin = time.perf_counter()
    found = core(team, case, folder, device)
    spent = time.perf_counter() - begin
    nnz = int(team.all_reduce(torch.tensor([found.evidence.nnz])).item())
    peak = torch.tensor([torch.cuda.max_memory_allocated() / 2**30 if device == "cuda" else 0.0])
    peak = float(team.all_gather(peak).max())
    changed = float((found.copied != torch.arange(len(found.copied), device=found.copied.device)).float().mean())
    if team.rank > 0:
        return
    n = len(case.scene)
    report.add("n100m.gaussians", n, f"Gaussians, {len(case.cameras)} views")
    report.add("n100m.evidence_s", found.seconds["evidence"], "s")
    for step in ("exchange", "lift", "vote", "neighbors"):
        report.add(f"n100m.{step}_s", found.seconds[step], "s")
    report.add("n100m.total_s", spent, "s, kernels compiled before")
    report.add("n100m.peak_gib_per_gpu", peak, "GiB, the larger of both")
    report.add("n100m.entries_per_gaussian", nnz / n, "entries")
    report.add("n100m.with_evidence", float((found.scalars.norm > 0).float().mean()), "share of Gaussians")
    report.add("n100m.copied", changed, "share of Gaussians")


def front(team: TorchCommunicator, report: Report, folder: Path, device: str, quick: bool) -> None:
    """Add the times of SAM and CLIP on random images, in chunks."""
    from normlift_ns.encoders.base import RegionFeatures, iterate_view_features  # noqa: PLC0415
    from research.front_end_inputs import SMALL, Size, injected_sam, random_clip, random_sam  # noqa: PLC0415

    size, count = (SMALL, 6) if quick else (Size(), 48)
    torch.manual_seed(0)
    mine = folder / f"clip{team.rank}"
    mine.mkdir()
    source = RegionFeatures(injected_sam(size, random_sam(size, device), device), random_clip(size, mine, device))
    g = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (count, size.height, size.width, 3), generator=g, dtype=torch.uint8)

    def see_chunk(chunk: Sequence[int]) -> None:
        for _ in iterate_view_features(source, ((images[v], str(v)) for v in chunk)):
            pass

    def see_alone() -> float:
        clock = Clock(None, device)
        for chunk in chunk_views(range(count)):
            see_chunk(chunk)
        clock.lap("all")
        return clock.seconds["all"]

    def see() -> float:
        clock, chunks = Clock(team, device), chunk_views(range(count), team.world_size)
        with team.shared_folder(folder):
            for number in team.claim_chunks(len(chunks)):
                see_chunk(chunks[number])
            clock.lap("all")
        return clock.seconds["all"]

    for _ in iterate_view_features(source, ((images[v], str(v)) for v in range(2))):  # compiles
        pass
    one = [see_alone()] if team.rank == 0 else []
    team.all_reduce(torch.zeros(1))
    two = [see(), see()]
    one += [see_alone()] if team.rank == 0 else []
    team.all_reduce(torch.zeros(1))
    if team.rank == 0:
        unit = f"one GPU over two, {count} images"
        report.add("front_end_speedup_2", statistics.mean(one) / statistics.mean(two), unit)
        report.add("front_end_one_s", statistics.mean(one), f"s, {count} images")
        report.add("front_end_two_s", statistics.mean(two), f"s, {count} images")


def sam_that_finds(folder: Path, quick: bool) -> None:
    """Write random weights of SAM whose masks pass the rules, with high predicted IoU and sharp borders."""
    from research.front_end_inputs import SMALL, Size, random_sam  # noqa: PLC0415

    torch.manual_seed(0)
    model = random_sam(SMALL if quick else Size(), "cpu")
    decoder = model.mask_decoder
    with torch.no_grad():
        decoder.iou_prediction_head.proj_out.bias.fill_(0.95)
        for network in decoder.output_hypernetworks_mlps:
            network.proj_out.weight.mul_(1000)
            network.proj_out.bias.mul_(1000)
    model.save_pretrained(folder)


def commands(report: Report, trained: Path, folder: Path, device: str, quick: bool) -> None:
    """Add the times of ns-normlift with SAM and CLIP of random weights on one device and on two.

    Caches of features are empty, and kernels are compiled.
    """
    from research.command import make_weights  # noqa: PLC0415

    sam_that_finds(folder / "sam", quick)
    flags = ["--load-config", str(trained), "--device", device, "--regions", "sam", "--sam-model", str(folder / "sam")]
    flags += [str(word) for word in make_weights(folder, ["fox"])] + (["--max-views", "4"] if quick else [])

    def lifted(devices: int, name: str, *more: str) -> float:
        words = [sys.executable, "-m", "normlift_ns.cli.lift", *flags, "--num-devices", str(devices)]
        words += ["--output-dir", str(folder / name), "--timestamp", "run", *more]
        begin = time.perf_counter()
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        print(done.stdout[-1500:], done.stderr[-1500:], flush=True)
        done.check_returncode()
        return time.perf_counter() - begin

    lifted(1, "warm", "--max-views", "2")
    one, two = lifted(1, "one"), lifted(2, "two")
    files = [next((folder / name).glob("*/normlift/run/normlift/field.safetensors")) for name in ("one", "two")]
    wrong = float(files[0].read_bytes() != files[1].read_bytes())
    report.add("whole_command_speedup_2", one / two, "one GPU over two, from the shell, SAM and CLIP", wrong)
    report.add("whole_command_one_s", one, "s")
    report.add("whole_command_two_s", two, "s", wrong)


PARTS = ("core", "front", "large", "command")


SIZES = (("", 1_930_000, 177), ("_10m", 10_000_000, 20))
"""Names, Gaussians and views."""
TINY = (("", 20_000, 21), ("_10m", 30_000, 5))


def work(team: TorchCommunicator, part: str, report: Report, folder: Path, device: str, quick: bool) -> None:
    """Run one part in both processes."""
    make: Callable[[int, int], Case] = partial(Case.of, device=device, **(SMALL_VIEWS if quick else {}))
    if part == "core":
        for name, n, views in TINY if quick else SIZES:
            compare_core(team, report, name, make(n, views), folder, device, 1 if quick else 7)
    if part == "front":
        front(team, report, folder, device, quick)
    if part == "large":
        core(team, make(200_000, 20), folder, device)  # compiles
        large(team, report, make(40_000, 12) if quick else make(100_000_000, 300), folder, device)


def worker(only: Sequence[str], output: Path, folder: Path, device: str, quick: bool) -> None:
    with distributed_context(device, print) as team, torch.no_grad():
        assert team is not None
        for part in only:
            report = Report("scale")
            work(team, part, report, folder, device, quick)
            if team.rank == 0:
                with_earlier(report, output / "scale.json").write(output)


def main(only: Sequence[str], output: Path, device: str, quick: bool, trained: Path) -> int:
    words = [sys.executable, "-m", "research.gpu_scale", "--device", device, "--output", str(output)]
    words += ["--quick"] * quick + ["--only", *(part for part in only if part != "command")]
    with tempfile.TemporaryDirectory() as name:
        code = launch_processes([[*words, "--folder", name]] * 2, print) if set(only) - {"command"} else 0
        if code == 0 and "command" in only:
            report = Report("scale")
            commands(report, trained.absolute(), Path(name), device, quick)
            with_earlier(report, output / "scale.json").write(output)
    return code


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="tiny scenes and networks")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--folder", type=Path, help="folder that both processes share")
    fox = SHARED / "captures" / "outputs" / "fox" / "splatfacto" / "run" / "config.yml"
    parser.add_argument("--config", type=Path, default=fox, help="config.yml of the run that commands lift")
    given = parser.parse_args()
    if "RANK" in os.environ:
        worker(given.only, given.output, given.folder, given.device, given.quick)
    else:
        sys.exit(main(given.only, given.output, given.device, given.quick, given.config))
