"""Consensus on a GPU: 1.93 million Gaussians, 177 views of 128 regions, 50 million entries of evidence.

    python -m research.gpu_consensus            difference from the CPU, bit-exact repetition, then seconds
    python -m research.gpu_consensus --quick    the same with a hundredth of the Gaussians, on any device

The command writes results/gpu_consensus.json. In the synthetic scene, fourteen views with different starts show each
object. Most Gaussians of an object lie partly in the region next to their own.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from normlift_ns import Evidence
from normlift_ns.core.consensus import apply_consensus, consensus, region_overlaps, sample_gaussians, total_view_weights
from normlift_ns.core.sparse import SparseRows
from research.report import RESULTS, Report

GAUSSIANS, VIEWS, REGIONS, THINGS = 1_930_000, 177, 128, 1600
DIMENSION = 512


def made_evidence(gaussians: int, views: int, device: str) -> Evidence:
    """Return the evidence of the synthetic scene; see the module docstring."""
    g = torch.Generator().manual_seed(0)
    place = (torch.rand(gaussians, generator=g, dtype=torch.float64) * THINGS).to(device)
    start = torch.randint(0, THINGS, (views,), generator=g).tolist()
    rows, columns, weights = [], [], []
    for view in range(views):
        local = (place - start[view]) % THINGS + 0.4 * torch.randn(1, generator=g).item()
        here = ((local >= 0) & (local < REGIONS - 1)).nonzero().squeeze(1)
        inside = local[here] % 1
        for aside, share in ((0, 1 - 0.3 * inside), (1, 0.3 * inside)):
            kept = share > 0.04
            rows.append(here[kept])
            columns.append((local[here] + aside).long()[kept] + REGIONS * view)
            weights.append(share[kept].float() * (0.3 + (here[kept] % 97) / 50))
    found = SparseRows.from_coo(torch.cat(rows), torch.cat(columns).int(), torch.cat(weights), gaussians)
    nothing = torch.zeros(0, dtype=torch.int32, device=device)
    blank = SparseRows(torch.zeros(gaussians + 1, dtype=torch.int64, device=device), nothing, nothing.float())
    view_of = torch.arange(views, device=device).repeat_interleave(REGIONS).int()
    return Evidence(found, view_of, blank, views)


def seconds(run: Callable[[], Any], repeats: int = 5) -> float:
    """Return the shortest time of some runs, after a warm-up run."""
    found = []
    for _ in range(repeats + 1):
        _wait()
        start = perf_counter()
        run()
        _wait()
        found.append(perf_counter() - start)
    return min(found[1:])


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def check(device: str, table: Callable[[int], Tensor]) -> dict[str, float]:
    """Return the differences from the CPU on a small scene; raise RuntimeError if a second run gives other bits."""
    evidence = made_evidence(30_000, 12, "cpu")
    features = table(evidence.num_regions)
    here, there = (consensus(evidence.to(d), features.to(d)) for d in ("cpu", device))
    again = consensus(evidence.to(device), features.to(device))
    if not torch.equal(again.features, there.features) or again.agreement != there.agreement:
        raise RuntimeError("a second run of the consensus gave different bits")
    return {
        "feature_error": float((there.features.cpu() - here.features).abs().max()),
        "agreement_error": abs(there.agreement[0] - here.agreement[0]),
    }


def main(quick: bool, output: Path) -> None:
    torch.set_grad_enabled(False)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    report = Report("gpu_consensus")

    def table(rows: int) -> Tensor:
        return normalize(torch.randn(rows, DIMENSION, generator=torch.Generator().manual_seed(1)), dim=1)

    errors = check(device, table)
    print(errors, flush=True)
    evidence = made_evidence(GAUSSIANS // (100 if quick else 1), VIEWS, device)
    size, features = evidence.num_regions, table(evidence.num_regions).to(device)
    chosen, chance = sample_gaussians(evidence.rows, size, 50)
    rows = evidence.rows.select_rows(chosen)
    total = total_view_weights(evidence.select_gaussians(chosen))
    overlaps = region_overlaps(rows, evidence.region_view, chance, total)
    sampled, whole = (consensus(evidence, features, sample=k) for k in (50, 1000))
    distance = float((1 - (sampled.features * whole.features).sum(1)).mean())
    print(f"{evidence.nnz:,} entries; {len(chosen):,} Gaussians with {rows.weight.numel():,}")
    print(f"{overlaps.iou.weight.numel():,} overlaps, B {overlaps.agreement:.3f}, to 1,000 each {distance:.2e}")
    held = torch.cuda.memory_allocated() if device == "cuda" else 0
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    tasks = {
        "sample": lambda: sample_gaussians(evidence.rows, size, 50),
        "select": lambda: evidence.rows.select_rows(chosen),
        "weights": lambda: total_view_weights(evidence.select_gaussians(chosen)),
        "overlaps": lambda: region_overlaps(rows, evidence.region_view, chance, total),
        "sum": partial(apply_consensus, features, overlaps),
        "all": lambda: consensus(evidence, features),
    }
    for name, task in tasks.items():
        spent = seconds(task)
        report.add(f"{name}_s", spent, "s", errors["feature_error"])
        print(f"{name}: {spent:.4f} s", flush=True)
    report.add("sampled_cosine_distance", distance, "mean, against 1,000 Gaussians per region")
    if device == "cuda":
        report.add("memory_gib", (torch.cuda.max_memory_allocated() - held) / 2**30, "GiB beside the evidence")
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            consensus(evidence, features)
            _wait()
        print(profile.key_averages().table(sort_by="cuda_time_total", row_limit=25))
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a hundredth of the Gaussians")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.output)
