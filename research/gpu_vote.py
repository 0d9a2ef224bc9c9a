"""Neighbors and vote on one GPU: errors, times by stages, and tuning of the kernels.

    python -m research.gpu_vote            the room of 1.93 million Gaussians of `research.gpu`, and the fox
    python -m research.gpu_vote --quick    without the variants

Times are medians of three runs after a warm-up run. The error of a vote is the share of all Gaussians whose refined
direction differs by more than 1e-3 from that of a vote in float64 of the same directions.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from normlift_ns import Lifted, Neighbors, RefineConfig, lift, nearest_neighbors, refine
from normlift_ns.core import refine as voting
from normlift_ns.kernels import nearest
from normlift_ns.kernels import vote as kernel
from normlift_ns.kernels.vote import LaunchConfig
from research.gpu import ROOMS, Case, capture_case, room_case, timed, vote_errors
from research.gpu_cases import features
from research.gpu_stages import kernel_milliseconds
from research.report import RESULTS, Report
from tests.captures import SHARED

PRECISIONS = ("tf32x3", "halves", "certified")
TUNINGS = (
    LaunchConfig(64, 32, 3, 4, 128),
    LaunchConfig(64, 32, 3, 4),
    LaunchConfig(64, 32, 3, 4, 96),
    LaunchConfig(64, 64, 3, 4, 128),
    LaunchConfig(64, 32, 2, 4, 128),
    LaunchConfig(128, 32, 2, 4, 128),
    LaunchConfig(128, 64, 2, 4, 128),
    LaunchConfig(128, 32, 2, 4, 96),
    LaunchConfig(32, 32, 4, 4, 128),
    LaunchConfig(64, 32, 3, 2),
    LaunchConfig(32, 32, 3, 2),
    LaunchConfig(64, 32, 3, 1),
    LaunchConfig(64, 32, 3, 8),
    LaunchConfig(128, 64, 2, 8),
)
BLOCKS = (2**15, 2**16, 2**17, 2**18)
GAMMAS = (0.1, 0.03, 0.01)
KINDS = (RefineConfig(vote="paper"), RefineConfig(vote="posterior"))
MARGINS = (RefineConfig(vote="paper", sigma_d=3.0, delta=0.1), RefineConfig(vote="posterior", delta=0.3))
SORTED = (0, 512, 4096, 2**30)


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    kept = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, kept)


class Room:
    """A lifted case and its neighbors."""

    def __init__(self, report: Report, case: Case) -> None:
        self.report, self.case, self.means = report, case, case.scene.means
        evidence = case.evidence()
        self.lifted: Lifted = lift(evidence, features(evidence.num_regions))
        self.reliability, self.own = self.lifted.scalars.reliability, self.lifted.scalars.own_evidence
        self.neighbors: Neighbors = nearest_neighbors(self.means, RefineConfig().k)

    def add(self, key: str, value: float, unit: str, error: float | None = None) -> None:
        self.report.add(f"{self.case.name}.{key}", value, unit, error)
        print(f"{self.case.name}.{key}: {value:.5g} {unit}", "" if error is None else f"error {error:.3g}", flush=True)

    def vote(self, config: RefineConfig | None = None, read: Callable[..., Any] | None = None) -> torch.Tensor:
        given = {"own": self.own, "neighbors": self.neighbors}
        return refine(self.means, read or self.lifted.directions, self.reliability, config, **given)

    def turned(self, source: torch.Tensor, other: torch.Tensor) -> float:
        """Return the share of Gaussians to which two votes give different directions."""
        rows = (source != other).nonzero().squeeze(1)
        ours, theirs = (self.lifted.directions(x[rows].long()) for x in (source, other))
        return int(((ours - theirs).norm(dim=1) > 1e-3).sum()) / len(source)


def correctness(room: Room, configs: Sequence[RefineConfig]) -> None:
    """Compare votes with float64, with the products in tf32x3, with a second run, and with a run that reports
    progress."""
    told: list[int] = []
    again = nearest_neighbors(room.means, RefineConfig().k, progress=lambda done, of: told.append(done))
    same = all(torch.equal(a, b) for a, b in zip(again, room.neighbors))
    room.add("neighbors_with_progress_same_bits", same, f"1: yes, told {len(told)} times")
    for config in configs:
        name = f"{config.vote}_gamma_{config.numbers.gamma:g}_delta_{config.numbers.delta:g}"
        exact = room.vote(config, lambda rows: room.lifted.directions(rows).double())
        room.add(f"{name}.changed", float((exact != torch.arange(len(exact), device="cuda")).float().mean()), "share")
        found: dict[str, torch.Tensor] = {}
        for precision in PRECISIONS:
            with replaced(kernel, "vote", partial(kernel.vote, precision=precision)):
                seconds, source = timed(lambda config=config: room.vote(config))
                same = torch.equal(source, room.vote(config))
            room.add(f"{name}.{precision}.vote_s", seconds, "s", room.turned(source, exact))
            room.add(f"{name}.{precision}.same_bits_again", same, "1: yes")
            found[precision] = source
            other = room.turned(source, found[PRECISIONS[0]])
            room.add(f"{name}.{precision}.other_direction_than_tf32x3", other, "share")
            room.add(f"{name}.{precision}.other_source_than_float64", (source != exact).float().mean().item(), "share")
        error = vote_errors(room.case, room.lifted, config, room.neighbors, room.vote(config))
        room.add(f"{name}.vote_error_of_a_sample", error, "share, directions in float64 too")


def totals(room: Room) -> None:
    neighbors_s = timed(lambda: nearest_neighbors(room.means, RefineConfig().k))[0]
    room.add("neighbors_s", neighbors_s, "s")
    for config in KINDS:
        vote_s = timed(lambda config=config: room.vote(config))[0]
        room.add(f"{config.vote}.vote_s", vote_s, "s")
        room.add(f"{config.vote}.neighbors_vote_s", neighbors_s + vote_s, "s, to be 0.15 at most")


def stages(room: Room) -> None:
    """Measure every stage of a vote; the CPU waits for the GPU after each stage."""
    seconds: dict[str, float] = defaultdict(float)

    def timer(stage: str, step: Callable[..., Any]) -> Callable[..., Any]:
        def timed_step(*arguments: Any, **options: Any) -> Any:
            torch.cuda.synchronize()
            start = time.perf_counter()
            result = step(*arguments, **options)
            torch.cuda.synchronize()
            seconds[stage] += time.perf_counter() - start
            return result

        return timed_step

    places = [(voting, x) for x in ("spatial_order", "decay_width", "_any_reliable", "_members")]
    places += [(kernel, "halve"), (kernel, "vote")]
    kept = [getattr(owner, name) for owner, name in places]
    read = timer("directions", room.lifted.directions)
    try:
        for owner, name in places:
            setattr(owner, name, timer(name, getattr(owner, name)))
        start = time.perf_counter()
        room.vote(read=read)
        torch.cuda.synchronize()
        seconds["all"] = time.perf_counter() - start
    finally:
        for (owner, name), original in zip(places, kept):
            setattr(owner, name, original)
    seconds["vote"] -= seconds["halve"]
    for stage, spent in seconds.items():
        room.add(f"stage.{stage.strip('_')}_ms", 1e3 * spent, "ms")
    for part, run in (
        ("neighbours", lambda: nearest_neighbors(room.means, RefineConfig().k)),
        ("vote", room.vote),
    ):
        for name, spent in kernel_milliseconds(run, most=14).items():
            print(f"{room.case.name}, {part}: {spent:9.2f} ms  {name}", flush=True)


def blocks(room: Room) -> None:
    for block in BLOCKS:
        with replaced(voting, "_BLOCK", (block, block)):
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            held = torch.cuda.memory_allocated()
            seconds = timed(room.vote)[0]
            more = (torch.cuda.max_memory_allocated() - held) / 2**30
        room.add(f"block_{block}.vote_s", seconds, f"s, {more:.2f} GiB more on the GPU")


def variants(room: Room, most: int = 2**17) -> None:
    """Measure the kernel alone in one block of voters, scaled up to all voters."""
    n = len(room.means)
    voters = voting.spatial_order(room.means)
    voters = voters[n // 3 : n // 3 + most]
    gaussians = kernel.voters_and_neighbors(voters, room.neighbors.index, len(room.means))
    rows = room.lifted.directions(gaussians)
    row_of = torch.zeros(n, dtype=torch.int32, device=rows.device)
    row_of[gaussians] = torch.arange(len(gaussians), dtype=torch.int32, device=rows.device)
    halved = kernel.split_float16(rows)

    def cast(config: RefineConfig, precision: Any) -> torch.Tensor:
        source = torch.full((n,), -1, dtype=torch.int32, device=rows.device)
        arrays = (voters, room.neighbors.index, room.neighbors.distance, rows, row_of, room.reliability, source)
        numbers, width = config.numbers, float(voting.decay_width(room.neighbors.spacing, config))
        given = {"tau": numbers.tau, "gamma": numbers.gamma, "width": width, "delta": numbers.delta}
        own = room.own if config.vote == "posterior" else None
        kernel.vote(*arrays, **given, own=own, prior=config.prior, precision=precision)
        return source

    def spent(config: RefineConfig, precision: Any) -> tuple[float, torch.Tensor]:
        seconds, source = timed(lambda: cast(config, precision))
        return seconds * n / len(voters), source[voters]

    with replaced(kernel, "halve", lambda rows: halved):
        for config in KINDS:
            certified_s, certified = spent(config, "certified")
            other = float((certified != spent(config, "tf32x3")[1]).float().mean())
            undecided = float((spent(config, "first")[1][certified >= 0] < 0).float().mean())
            room.add(f"kernel.{config.vote}.certified_s", certified_s, "s, all voters", other)
            room.add(f"kernel.{config.vote}.undecided", undecided, "share of voters")
        plain_s, plain = spent(RefineConfig(), "tf32x3")
        room.add("kernel.tf32x3_s", plain_s, "s")
        for gamma in (RefineConfig().numbers.gamma, *GAMMAS):
            first_s, first = spent(RefineConfig(gamma=gamma), "first")
            full_s, full = spent(RefineConfig(gamma=gamma), "halves")
            share = float((first[full >= 0] < 0).float().mean())
            wrong = float(((first >= 0) & (first != full)).float().mean())
            room.add(f"kernel.gamma_{gamma}.undecided", share, "share of voters", wrong)
            room.add(f"kernel.gamma_{gamma}.first_s", first_s, "s")
            room.add(f"kernel.gamma_{gamma}.halves_s", full_s, "s")
        for tuning in TUNINGS:
            name = "_".join(str(x) for x in tuning)
            with replaced(kernel, "_HALVES", tuning):
                try:
                    seconds, source = spent(RefineConfig(), "certified")
                except Exception as error:  # anything at all: a variant that does not compile is an answer
                    print(f"{name}: {type(error).__name__}: {str(error)[:100]}", flush=True)
                    continue
            other = float((source != plain).float().mean())
            room.add(f"kernel.tuning_{name}_s", seconds, f"s, other source than tf32x3: {other:.2g}")


def trees(room: Room) -> None:
    """Measure the tree and the search for all neighbors, by the largest size of nodes that are sorted separately."""
    for most in SORTED:
        with replaced(nearest, "_SORTED_IN_A_BLOCK", most):
            tree_s = timed(lambda: nearest.build_kd_tree(room.means))[0]
            all_s, found = timed(lambda: nearest_neighbors(room.means, RefineConfig().k))
        same = all(torch.equal(a, b) for a, b in zip(found, room.neighbors))
        room.add(f"tree.sorted_{most}_s", tree_s, "s")
        room.add(f"neighbors.sorted_{most}_s", all_s, f"s, same bits: {same}")


def main(quick: bool, output: Path) -> None:
    report = Report("h100_vote")
    with torch.no_grad():
        name, n, views = next(room for room in ROOMS if room[1] == 1_930_000)
        room = Room(report, room_case(name, n, views))
        totals(room)
        correctness(room, (*KINDS, *MARGINS))
        stages(room)
        if not quick:
            variants(room)
            trees(room)
            blocks(room)
        del room
        torch.cuda.empty_cache()
        if (SHARED / "captures" / "fox").exists():
            fox = Room(report, capture_case("fox"))
            totals(fox)
            others = (RefineConfig(gamma=0.03), RefineConfig(gamma=0.4, delta=0.02, tau=0.8))
            correctness(fox, (*KINDS, *MARGINS, *others))
            stages(fox)
    report.write(output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="omit the variants")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    main(arguments.quick, arguments.output)
